"""Whether a motion stays within the fence: for fleet.toml, for preflight, and for what an operator commands.

A motion is looked at from its start to the end of its last leg and of its change of formation; a turn without end for
one whole turn. What may follow for ever (a velocity that is kept) is left to the safety filter, which brakes.
"""

from collections.abc import Iterator
from math import dist, hypot, inf, pi
from typing import NamedTuple

from companion.core.fence import Fence
from companion.core.plan import TURN_RAMP_S, Motion, TurnLeg, VelocityLeg, leg_duration_s
from companion.core.values import ZERO

STEP_M = 0.25
"""shortest way between two looks"""
OUTSIDE_STEP = 1.0 / 16.0
"""outside, the way to the next look is this part of the depth, so that the worst is told to some per cent"""
LOOKS_MAX = 4000
"""most looks at one leg: a leg of weeks beside the edge must not stop a vehicle"""
TOLERANCE_M = 1e-6
SPEED_LOOKS = 16
SPEED_ALLOWANCE = 1.1
"""speeds are looked at in so many moments of a leg; between them they may be this much higher"""


class Breach(NamedTuple):
    """Where a motion first leads beyond a fence's margin."""

    leg: int | None
    """index of the leg; None: before the first leg or after the last, while slots change places"""
    vehicle_id: int
    outside_m: float
    """how far beyond the margin that leg leads at most"""
    time_s: float
    """when that is, from the motion's start"""

    def sentence(self) -> str:
        """For people, as the rest of a sentence about the motion."""
        where = "its formation" if self.leg is None else f"its leg {self.leg}"
        return f"{where} takes vehicle {self.vehicle_id} {self.outside_m:.2f} m beyond the fence's margin"


class _Stretch(NamedTuple):
    leg: int | None
    start_ns: int
    end_ns: int


def _stretches(motion: Motion) -> Iterator[_Stretch]:
    """The legs' times, none longer than it tells anything new, and what the change of formation takes besides."""
    now_ns = motion.legs_start_ns
    if now_ns > motion.start_ns:
        yield _Stretch(None, motion.start_ns, now_ns)
    v = motion.velocity_ned_m_s
    for k, leg in enumerate(motion.legs):
        duration = leg_duration_s(leg, v)
        since_ns = max(now_ns, motion.start_ns)
        if isinstance(leg, TurnLeg):
            # Of many turns the first and the last: those between are the same circle.
            once_ns = round((2.0 * pi / abs(leg.rate_rad_s) + 2.0 * TURN_RAMP_S) * 1e9)
            if duration == inf:
                yield _Stretch(k, since_ns, since_ns + once_ns)
                return
            end_ns = now_ns + round(duration * 1e9)
            if end_ns - since_ns > 2 * once_ns:
                yield _Stretch(k, since_ns, since_ns + once_ns)
                since_ns = end_ns - once_ns
        end_ns = now_ns + round(duration * 1e9)
        v = motion.moment(end_ns).centre.velocity
        if end_ns >= since_ns:
            yield _Stretch(k, since_ns, end_ns)
        now_ns = end_ns
    if motion.blend_end_ns > now_ns or not motion.legs:
        start_ns = max(now_ns, motion.start_ns)
        yield _Stretch(None, start_ns, max(motion.blend_end_ns, start_ns))


class _Extent(NamedTuple):
    """How far slots reach from the centre, level, and down between two values; the longest way of a change (m)."""

    level_m: float
    least_down_m: float
    most_down_m: float
    way_m: float


def _extent(motion: Motion) -> _Extent:
    ends = [slot for change in motion.slots.values() for slot in change]
    downs = [s.down for s in ends]
    way = max(dist(change.before, change.after) for change in motion.slots.values())
    return _Extent(max(hypot(s.north, s.east) for s in ends), min(downs), max(downs), way)


def _speeds(motion: Motion, extent: _Extent, stretch: _Stretch) -> tuple[float, float]:
    """No slot's level and vertical speed is greater over a stretch (m/s)."""
    span = stretch.end_ns - stretch.start_ns
    level = vertical = 0.0
    for k in range(SPEED_LOOKS + 1):
        now = motion.moment(stretch.start_ns + span * k // SPEED_LOOKS)
        v, changing = now.centre.velocity, abs(now.blend[1]) * extent.way_m
        level = max(level, hypot(v.north, v.east) + abs(now.rate) * extent.level_m + changing)
        vertical = max(vertical, abs(v.down) + changing)
    return SPEED_ALLOWANCE * level + 0.01, SPEED_ALLOWANCE * vertical + 0.01


def _room(motion: Motion, fence: Fence, extent: _Extent, fleet_ns: int) -> tuple[float, float, int]:
    """Room that is left to every slot at a time: level, vertical, and the vehicle that has least of both.

    Where the centre has more level room than the slots reach, that is the answer: their places are not looked at.
    """
    moment = motion.moment(fleet_ns)
    north, east, down = moment.centre.position
    level = fence.edge_room_m(north, east) - extent.level_m
    vertical = min(fence.vertical_room_m(down + extent.least_down_m), fence.vertical_room_m(down + extent.most_down_m))
    if level >= 0.0 and vertical >= 0.0:
        return level, vertical, 0
    level, vertical, least, vehicle = inf, inf, inf, 0
    for i, change in motion.slots.items():
        place = moment.slot(change).position_ned_m
        edge, height = fence.edge_room_m(place.north, place.east), fence.vertical_room_m(place.down)
        level, vertical = min(level, edge), min(vertical, height)
        if min(edge, height) < least:
            least, vehicle = min(edge, height), i
    return level, vertical, vehicle


def first_breach(motion: Motion, fence: Fence | None) -> Breach | None:
    """The first leg that leads a slot beyond the fence's margin, with the worst of that leg; None if all stay inside.

    The motion is marched along: the next look is when a slot could first touch the margin, and at least STEP_M on. A
    motion that starts beyond the margin is a way back if it ends no further out, whatever it passes: the safety filter
    holds the vehicles meanwhile.
    """
    if fence is None or not motion.slots:
        return None
    extent = _extent(motion)
    stretches = list(_stretches(motion))
    level, vertical, _ = _room(motion, fence, extent, motion.start_ns)
    allowed = min(level, vertical, 0.0) - TOLERANCE_M
    if allowed < -2.0 * TOLERANCE_M:
        end = stretches[-1]
        level, vertical, vehicle = _room(motion, fence, extent, end.end_ns)
        room = min(level, vertical)
        return Breach(end.leg, vehicle, -room, (end.end_ns - motion.start_ns) * 1e-9) if room < allowed else None
    for stretch in stretches:
        worst = _worst(motion, fence, extent, stretch, allowed)
        if worst is not None:
            return worst
    return None


def _worst(motion: Motion, fence: Fence, extent: _Extent, stretch: _Stretch, allowed_m: float) -> Breach | None:
    level_m_s, vertical_m_s = _speeds(motion, extent, stretch)
    worst: Breach | None = None
    least_ns = (stretch.end_ns - stretch.start_ns) // LOOKS_MAX
    now_ns = stretch.start_ns
    while True:
        level, vertical, vehicle = _room(motion, fence, extent, now_ns)
        room = min(level, vertical)
        if room < allowed_m and (worst is None or -room > worst.outside_m):
            worst = Breach(stretch.leg, vehicle, -room, (now_ns - motion.start_ns) * 1e-9)
        if now_ns >= stretch.end_ns:
            return worst
        way_level, way_vertical = (max(x, -OUTSIDE_STEP * x, STEP_M) for x in (level, vertical))
        step_s = min(way_level / level_m_s, way_vertical / vertical_m_s)
        now_ns = min(now_ns + max(round(step_s * 1e9), least_ns, 1), stretch.end_ns)


def only_stops(motion: Motion, before: Motion) -> bool:
    """Whether a motion does nothing but bring the formation of the one before to rest: that is never refused."""
    rests = all(isinstance(leg, VelocityLeg) and leg.velocity_ned_m_s == ZERO for leg in motion.legs)
    return bool(motion.legs) and rests and motion.slots == before.slots
