"""The two quintic polynomials of time by which places and velocities change without a jump of acceleration."""

MINIMUM_JERK_BEND = 5.7735
"""peak of the second derivative of `minimum_jerk`; its slope's is 15/8"""


def minimum_jerk(x: float) -> tuple[float, float, float]:
    """Value, slope and curvature over x in [0, 1] of 10x^3 - 15x^4 + 6x^5, from rest to rest.

    Of all ways from rest to rest in a given time it has the least integral of squared jerk: T. Flash and N. Hogan, "The
    coordination of arm movements", Journal of Neuroscience 5 (1985) 1688-1703.
    """
    x = min(max(x, 0.0), 1.0)
    return (
        x * x * x * (10.0 - 15.0 * x + 6.0 * x * x),
        30.0 * x * x * (1.0 - x) ** 2,
        60.0 * x * (1.0 - x) * (1.0 - 2.0 * x),
    )


def fading(x: float) -> tuple[float, float, float]:
    """Value, slope and curvature over x in [0, 1] of the quintic with value 0, slope 1 at 0 and rest at 1: by it a
    velocity from before fades."""
    x = min(max(x, 0.0), 1.0)
    return (
        x - 6 * x**3 + 8 * x**4 - 3 * x**5,
        1 - 18 * x**2 + 32 * x**3 - 15 * x**4,
        -36 * x + 96 * x**2 - 60 * x**3,
    )
