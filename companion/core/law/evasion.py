"""Evasion: what a vehicle that sees a threat takes for the common velocity, where no motion is shared.

A threat (a predator) is a point that goes on with a level velocity, seen by whoever is within its radius R of the way
that it takes in the next 2 s. With q the nearest point of that way, a the direction from q to the vehicle, d the
distance and c the common velocity of before, a vehicle that sees it wishes

    w = c + s (V - min(c.a, 0)) a            s = smooth step from 0 at d = R to 1 at d = R/2, V the speed to flee with

as its nu (`core.law.consensus`), its rate bounded. Those in front of a threat that comes go to its sides, since the
way is nearest there, and the flock opens. At the radius the wish is the common velocity itself, so nothing jumps; from
R/2 on it leads away at V at least, however the fleet flew. Whoever flees holds no place in the formation; separation
and everything after the law stay.

Nobody is told that somebody flees: neighbours see its nu and its velocity, and come nearer, as with an informed one.
Once it sees nothing any more, it wishes c for some seconds, which takes back what it gave to the common velocity, and
is uninformed again. c is the common velocity's mean over the last minute of calm and not its last value: by the time
the threat is near, the wave of those who saw it first has come by, and lasted for seconds.
"""

from math import hypot
from typing import NamedTuple

CALM, FLEES, GOES_BACK = 0, 1, 2
"""what a vehicle does about a threat"""

AHEAD_S = 2.0
"""the way that a threat takes in this time is fled"""
SEEN_ON = 1.2
"""whoever flees sees a threat up to this times its radius"""
FLEE_SPEED_M_S = 2.0
"""V"""
FLEE_RATE_M_S2 = 3.0
"""the wish changes no faster than this"""
TOLD_RATE_M_S2 = 1.0
"""as much of that is told and flown ahead of: peers carry a rate on for 2 s (`core.prediction`), and what they reckon
with is no more than the speed to flee with, where the next message is lost"""
GO_BACK_S = 5.0
"""for so long the common velocity of before is wished"""
MEMORY_S = 60.0
"""over which the common velocity is averaged while calm"""


class Threat(NamedTuple):
    """What is fled, on the level (fleet frame)."""

    north_m: float
    """where it is when it begins"""
    east_m: float
    north_m_s: float
    east_m_s: float
    radius_m: float
    """within which it is seen, and fled"""
    lasts_s: float


class Evasion(NamedTuple):
    """What a vehicle remembers of it."""

    doing: int
    """CALM, FLEES or GOES_BACK"""
    north_m_s: float
    """the wish; of no meaning while calm"""
    east_m_s: float
    north_m_s2: float
    """its rate, within TOLD_RATE_M_S2"""
    east_m_s2: float
    calm_north_m_s: float
    """c"""
    calm_east_m_s: float
    left_s: float
    """of going back"""


NO_THREAT = Threat(0.0, 0.0, 0.0, 0.0, 1.0, -1.0)
"""never there: what keeps the mean of the common velocity while nothing is to be fled"""
UNDISTURBED = Evasion(CALM, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def away(threat: Threat, since_s: float, north: float, east: float) -> tuple[float, float, float]:
    """Distance (m) of a place from the way that a threat takes next, and the direction from there.

    `since_s`: time since the threat began. On the way itself the direction is to the right of it, or north.
    """
    from_north = north - threat.north_m - since_s * threat.north_m_s
    from_east = east - threat.east_m - since_s * threat.east_m_s
    speed_2 = threat.north_m_s * threat.north_m_s + threat.east_m_s * threat.east_m_s
    along = (from_north * threat.north_m_s + from_east * threat.east_m_s) / max(speed_2, 1e-12)
    along_s = min(max(along, 0.0), AHEAD_S)
    from_north -= along_s * threat.north_m_s
    from_east -= along_s * threat.east_m_s
    distance = hypot(from_north, from_east)
    if distance > 1e-6:
        return distance, from_north / distance, from_east / distance
    speed = hypot(threat.north_m_s, threat.east_m_s)
    if speed > 1e-6:
        return distance, -threat.east_m_s / speed, threat.north_m_s / speed
    return distance, 1.0, 0.0


def share_fled(distance: float, radius: float) -> float:
    """s: 0 at the radius, 1 at half of it and nearer, with a slope of 0 at both."""
    x = min(max(2.0 * (1.0 - distance / max(radius, 1e-6)), 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


def wish(
    threat: Threat, since_s: float, north: float, east: float, calm_north: float, calm_east: float, speed: float
) -> tuple[float, float]:
    """w (m/s) at a place (m), c being the common velocity of before and `speed` V."""
    distance, a_north, a_east = away(threat, since_s, north, east)
    toward = min(calm_north * a_north + calm_east * a_east, 0.0)
    size = share_fled(distance, threat.radius_m) * (speed - toward)
    return calm_north + size * a_north, calm_east + size * a_east


def evade(
    e: Evasion, threat: Threat, since_s: float, north: float, east: float, common_north: float, common_east: float,
    dt_s: float,
) -> Evasion:  # fmt: skip
    """One step at a place (m): `common` is the vehicle's nu of the step before (m/s), whoever it has it from."""
    distance, _, _ = away(threat, since_s, north, east)
    reach = threat.radius_m * (SEEN_ON if e.doing == FLEES else 1.0)
    doing, left_s = e.doing, e.left_s
    if 0.0 <= since_s <= threat.lasts_s and distance < reach:
        doing, left_s = FLEES, GO_BACK_S
    elif doing == FLEES:
        doing = GOES_BACK
    elif doing == GOES_BACK:
        left_s -= dt_s
        if left_s <= 0.0:
            doing = CALM
    calm_north, calm_east = e.calm_north_m_s, e.calm_east_m_s
    if doing == CALM:
        kept = min(dt_s / MEMORY_S, 1.0)
        calm_north += kept * (common_north - calm_north)
        calm_east += kept * (common_east - calm_east)
        return Evasion(CALM, common_north, common_east, 0.0, 0.0, calm_north, calm_east, 0.0)
    to_north, to_east = calm_north, calm_east
    if doing == FLEES:
        to_north, to_east = wish(threat, since_s, north, east, calm_north, calm_east, FLEE_SPEED_M_S)
    step_north, step_east = to_north - common_north, to_east - common_east
    allowed = min(1.0, FLEE_RATE_M_S2 * dt_s / max(hypot(step_north, step_east), 1e-12))
    step_north, step_east = allowed * step_north, allowed * step_east
    per_s = 1.0 / max(dt_s, 1e-6)
    per_s *= min(1.0, TOLD_RATE_M_S2 / max(per_s * hypot(step_north, step_east), 1e-12))
    return Evasion(
        doing, common_north + step_north, common_east + step_east, per_s * step_north, per_s * step_east, calm_north,
        calm_east, left_s,
    )  # fmt: skip
