"""The law of the paper, Eq. (2), as it stands: the starling law with gains that leave all else out."""

from math import inf

from companion.core.law.starling import Gains


def paper_gains(k_s: float, k_a: float, k_c: float, r0: float) -> Gains:
    """Eq. (2) as printed, with the repulsive sign: plain sums, no saturation, no plan, no limit."""
    return Gains(k_s, k_a, k_c, 0.0, 0.0, r0, inf, inf, inf, 0.0)
