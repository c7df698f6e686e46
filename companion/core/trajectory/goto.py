"""How long a leg to a point takes within given speeds, and how fast it is flown."""

from math import hypot, inf, sqrt
from typing import NamedTuple

from companion.core.frames import Ned
from companion.core.trajectory.legs import PLAN_ACCELERATION_M_S2, GotoLeg
from companion.core.trajectory.polynomials import MINIMUM_JERK_BEND, fading, minimum_jerk
from companion.core.values import ZERO

GOTO_ACCELERATION_M_S2 = 2 * PLAN_ACCELERATION_M_S2
"""the largest acceleration of a goto leg, and of slots that change places"""
GOTO_MIN_S = 1.0
"""no goto leg is shorter"""
GOTO_SAMPLES = 64
"""parts of a goto leg at whose ends its speed and acceleration are looked at: both are known to 0.1 %"""


def _goto_samples() -> tuple[tuple[float, float, float, float], ...]:
    """Slopes and curvatures of `minimum_jerk` and `fading` within a goto leg, where the first is steepest included."""
    bend = sqrt(1.0 / 12.0)
    places = [k / GOTO_SAMPLES for k in range(1, GOTO_SAMPLES)] + [0.5 - bend, 0.5 + bend]
    return tuple((*minimum_jerk(x)[1:], *fading(x)[1:]) for x in places)


_GOTO_SAMPLES = _goto_samples()


def goto_duration_s(
    way: Ned, velocity: Ned, speed_m_s: float, climb_m_s: float = inf, descent_m_s: float = inf
) -> float:
    """Time of a goto leg over `way` (m) from `velocity` (m/s) whose greatest speed is `speed_m_s`.

    The leg's velocity at x = t/T is way m'(x)/T + velocity f'(x) (`minimum_jerk`, `fading`), so at each x the condition
    |v| <= speed is a quadratic in 1/T; the largest 1/T that meets all is the answer. It is smaller where the vertical
    speeds or GOTO_ACCELERATION_M_S2 ask for it, and T at least GOTO_MIN_S. A leg that begins faster than `speed_m_s`
    becomes no faster than it begins.
    """
    c = way.north**2 + way.east**2 + way.down**2
    b = way.north * velocity.north + way.east * velocity.east + way.down * velocity.down
    a = velocity.north**2 + velocity.east**2 + velocity.down**2
    top2 = max(speed_m_s * speed_m_s, a)
    climb, descent = max(climb_m_s, -velocity.down), max(descent_m_s, velocity.down)
    per_s = 1.0 / GOTO_MIN_S
    for m1, _, f1, _ in _GOTO_SAMPLES:
        if c > 1e-18:
            free, along = top2 - a * f1 * f1, b * f1
            root = sqrt(along * along + c * free)
            per_s = min(per_s, free / (m1 * (root + along)) if along > 0.0 else (root - along) / (c * m1))
        if way.down > 1e-9:
            per_s = min(per_s, (descent - velocity.down * f1) / (way.down * m1))
        elif way.down < -1e-9:
            per_s = min(per_s, (climb + velocity.down * f1) / (-way.down * m1))

    def acceleration2(s: float) -> float:
        return max(
            s * s * (c * m2 * m2 * s * s + 2.0 * b * m2 * f2 * s + a * f2 * f2) for _, m2, _, f2 in _GOTO_SAMPLES
        )

    if acceleration2(per_s) > GOTO_ACCELERATION_M_S2**2:
        least, most = 0.0, per_s
        for _ in range(40):
            middle = 0.5 * (least + most)
            least, most = (least, middle) if acceleration2(middle) > GOTO_ACCELERATION_M_S2**2 else (middle, most)
        per_s = least
    return 1.0 / per_s


def goto_leg(
    start: Ned, velocity: Ned, target: Ned, speed_m_s: float, climb_m_s: float = inf, descent_m_s: float = inf
) -> GotoLeg:
    """A leg from a place and a velocity to a point, at `speed_m_s` at most (`goto_duration_s`)."""
    way = Ned(target.north - start.north, target.east - start.east, target.down - start.down)
    return GotoLeg(target, goto_duration_s(way, velocity, speed_m_s, climb_m_s, descent_m_s))


class GotoPeaks(NamedTuple):
    """The greatest level speed, climb, descent (m/s) and acceleration (m/s^2) of a goto leg, where it is looked at."""

    level_m_s: float
    climb_m_s: float
    descent_m_s: float
    acceleration_m_s2: float


def goto_peaks(leg: GotoLeg, start: Ned, velocity: Ned) -> GotoPeaks:
    """How fast a goto leg is flown from a place and a velocity."""
    per_s = 1.0 / leg.duration_s
    n, e, d = ((b - a) * per_s for a, b in zip(start, leg.target_ned_m, strict=True))
    vn, ve, vd = velocity
    if velocity == ZERO:
        # Straight, so that where it is fastest and where it bends most are known.
        fastest, bend = minimum_jerk(0.5)[1], MINIMUM_JERK_BEND * per_s
        return GotoPeaks(
            fastest * hypot(n, e), max(-fastest * d, 0.0), max(fastest * d, 0.0), bend * sqrt(n * n + e * e + d * d)
        )
    level2, climb, descent, bend2 = vn * vn + ve * ve, max(-vd, 0.0), max(vd, 0.0), 0.0
    for m1, m2, f1, f2 in _GOTO_SAMPLES:
        x, y, z = n * m1 + vn * f1, e * m1 + ve * f1, d * m1 + vd * f1
        level2, climb, descent = max(level2, x * x + y * y), max(climb, -z), max(descent, z)
        x, y, z = n * m2 + vn * f2, e * m2 + ve * f2, d * m2 + vd * f2
        bend2 = max(bend2, x * x + y * y + z * z)
    return GotoPeaks(sqrt(level2), climb, descent, sqrt(bend2) * per_s)
