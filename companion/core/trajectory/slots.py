"""How slots pass from one formation to the next."""

from collections.abc import Sequence
from math import dist, hypot, inf, sqrt
from typing import NamedTuple

from companion.core.frames import Ned
from companion.core.trajectory.polynomials import MINIMUM_JERK_BEND

BLEND_MIN_S = 8.0
"""shortest time in which slots move from one formation to the next"""


class SlotChange(NamedTuple):
    """One vehicle's slot before and after the blend: offsets (forward, right, down) from the centre, m."""

    before: Ned
    after: Ned


def blend_duration_s(
    changes: Sequence["SlotChange"], speed_m_s: float, climb_m_s: float = inf, descent_m_s: float = inf
) -> float:
    """Time in which slots change places: minimum jerk, below the speeds and 1 m/s^2, and BLEND_MIN_S at least."""
    seconds = BLEND_MIN_S
    for before, after in changes:
        level, down = hypot(after.north - before.north, after.east - before.east), after.down - before.down
        vertical = down / descent_m_s if down > 0.0 else -down / climb_m_s
        seconds = max(
            seconds, 1.875 * level / speed_m_s, 1.875 * vertical, sqrt(MINIMUM_JERK_BEND * dist(before, after))
        )
    return seconds
