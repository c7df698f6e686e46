"""Flight without a plan: agreement on the common velocity from what the vehicles publish.

Each vehicle has an estimate nu_i of the common velocity, zero at hover, and

    nu_i' = -4 mean_j sat(nu_i - nu_j)            over the nu_j as they follow from what was last published

saturated at 1 m/s. Nothing is measured, so sensor noise cannot random-walk it; between vehicles that all hear each
other the mean of the nu_i stays what it was. nu_i stands for v_d in the law and in the hold (`core.prediction`). Who is
told where to go has its wish for nu_i, and draws the others: nobody passes the wish on.
"""

from math import sqrt

RATE_PER_S = 4.0
"""how fast the estimates of the common velocity approach each other"""
STEP_MAX_S = 0.2
"""a vehicle whose positions were gone for longer goes on from what it had agreed on then"""


def saturated(x: float, y: float, z: float, limit: float) -> tuple[float, float, float]:
    """The vector with its norm clipped at `limit`."""
    share = min(1.0, limit / max(sqrt(x * x + y * y + z * z), 1e-12))
    return share * x, share * y, share * z


def common_velocity_rate(n: float, sx: float, sy: float, sz: float) -> tuple[float, float, float]:
    """nu_i' (m/s^2) from the sum of the saturated differences to n published estimates (m/s)."""
    rate = -RATE_PER_S / max(n, 1.0)
    return rate * sx, rate * sy, rate * sz
