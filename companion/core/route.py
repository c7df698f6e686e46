"""Whether a motion stays within the fence, found with few looks.

A motion is examined from its start to the end of its last leg and of its change of formation; a turn without end for
one whole turn. What may follow for ever (a velocity that is kept) is left to the safety filter, which brakes.

Between two looks a slot whose acceleration is at most a strays from the straight way by at most a t^2/8. So a straight
leg takes two looks however long it is, and a curve is halved only where its strip reaches the margin, down to
RESOLUTION_M. The work is counted in looks and ends at LOOKS_MAX: a motion that needs more is refused.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from math import dist, hypot, inf, isfinite, pi
from typing import NamedTuple

from companion.core.frames import Ned
from companion.core.safety.fence import Fence
from companion.core.trajectory.fleet import FleetTrajectory, TrajectoryState
from companion.core.trajectory.legs import (
    PLAN_ACCELERATION_M_S2,
    TURN_RAMP_S,
    FreeLeg,
    GotoLeg,
    TurnLeg,
    VelocityLeg,
    leg_duration_s,
    turn_rate_and_time,
    velocity_ramp_s,
)
from companion.core.trajectory.polynomials import MINIMUM_JERK_BEND
from companion.core.values import ZERO
from companion.core.vectors import lerp

RESOLUTION_M = 0.01
"""a breach between two looks that is no deeper than this may be missed"""
LOOKS_MAX = 400
"""most looks at a motion of up to ten vehicles; of more vehicles more, up to three times as many"""
SLOT_LOOKS = 0.1
"""cost of one slot's place over that of a look at the centre"""
POLYGON_LOOKS, EDGE_LOOKS = 1.0, 0.001
"""cost of asking about places beside a polygon, and of one of its edges for each place"""
DEPTH_PARTS = 24
"""a leg that leads outside is looked at in so many parts, and its worst part again, to tell how far it leads"""
DEPTH_SHARE = 0.3
"""of the most looks: what that may cost; beside a fence of many corners the parts are fewer"""
TOLERANCE_M = 1e-6


class Breach(NamedTuple):
    """Where a motion first leads beyond a fence's margin."""

    leg: int | None
    """index of the leg; None: before the first leg or after the last, while slots change places"""
    vehicle_id: int
    """0: nobody leads outside, but the motion takes more looks than it may"""
    outside_m: float
    """how far beyond the margin that leg leads at most"""
    time_s: float
    """when that is, from the motion's start"""

    def sentence(self) -> str:
        """For people, as the rest of a sentence about the motion."""
        where = "its formation" if self.leg is None else f"its leg {self.leg}"
        if self.vehicle_id == 0:
            return f"{where} takes too many looks beside the fence: fly fewer legs, or further inside"
        return f"{where} takes vehicle {self.vehicle_id} {self.outside_m:.2f} m beyond the fence's margin"


class _Span(NamedTuple):
    """A time in which a motion is smooth, with bounds on what bends its slots' ways."""

    leg: int | None
    start_ns: int
    end_ns: int
    centre_m_s2: float
    """no greater is the centre's acceleration"""
    straight: bool
    """whether the centre's way is straight, without turning back, at whatever pace"""
    rate_rad_s: float
    """nor the heading's rate"""
    rate_change_rad_s2: float


def _leg_spans(motion: FleetTrajectory, k: int, since_ns: int) -> Iterator[_Span]:
    """A leg's parts, none longer than it tells anything new; since_ns is when it begins."""
    leg, (_, p, v, _) = motion.legs[k], motion.leg_starts[k]
    duration = leg_duration_s(leg, v)
    match leg:
        case VelocityLeg():
            ramp_ns = since_ns + round(velocity_ramp_s(leg, v) * 1e9)
            yield _Span(k, since_ns, ramp_ns, PLAN_ACCELERATION_M_S2, _aligned(v, leg.velocity_ned_m_s), 0.0, 0.0)
            if duration < inf:
                yield _Span(k, ramp_ns, since_ns + round(duration * 1e9), 0.0, True, 0.0, 0.0)
        case GotoLeg():
            bend = MINIMUM_JERK_BEND * dist(p, leg.target_ned_m) / duration**2 + 4.0 * hypot(*v) / duration
            yield _Span(k, since_ns, since_ns + round(duration * 1e9), bend, v == ZERO, 0.0, 0.0)
        case FreeLeg():
            # Where the fleet goes nobody knows: the safety filter keeps each vehicle inside.
            yield _Span(k, since_ns, max(since_ns, motion.blend_end_ns), 0.0, True, 0.0, 0.0)
        case TurnLeg():
            rate = abs(turn_rate_and_time(leg)[0])
            turning = rate if motion.heading_follows_turns else 0.0
            ramp = (rate * hypot(v.north, v.east), False, turning, 1.5 * turning / TURN_RAMP_S)
            steady = (*ramp[:3], 0.0)
            from_ns, once_ns = since_ns + round(TURN_RAMP_S * 1e9), round(2.0 * pi / rate * 1e9)
            yield _Span(k, since_ns, from_ns, *ramp)
            # Of many turns the first and the last: those between are the same circle, once the slots are there.
            once_ns = max(from_ns, motion.start_ns, motion.blend_end_ns) + once_ns - from_ns
            if duration == inf:
                yield _Span(k, from_ns, from_ns + once_ns, *steady)
                return
            end_ns = since_ns + round(duration * 1e9)
            until_ns = end_ns - round(TURN_RAMP_S * 1e9)
            if until_ns - from_ns > 2 * once_ns:
                yield _Span(k, from_ns, from_ns + once_ns, *steady)
                from_ns = until_ns - once_ns
            yield _Span(k, from_ns, until_ns, *steady)
            yield _Span(k, until_ns, end_ns, *ramp)


def _spans(motion: FleetTrajectory) -> Iterator[_Span]:
    """The legs from the motion's start on, and what the change of formation takes besides."""
    now_ns = motion.start_ns
    for k, (since, _, _, _) in enumerate(motion.leg_starts):
        if since == inf:
            return
        since_ns = motion.legs_start_ns + round(since * 1e9)
        if k == 0 and since_ns > now_ns:
            yield _Span(None, now_ns, since_ns, 0.0, True, 0.0, 0.0)
        if k == len(motion.legs):
            now_ns = max(since_ns, motion.start_ns)
            break
        for span in _leg_spans(motion, k, since_ns):
            if span.end_ns >= motion.start_ns:
                yield span._replace(start_ns=max(span.start_ns, motion.start_ns))
    yield _Span(None, now_ns, max(motion.blend_end_ns, now_ns), 0.0, True, 0.0, 0.0)


def _aligned(a: Ned, b: Ned) -> bool:
    """Whether two velocities have one direction, or one of them is none."""
    across = (
        a.north * b.east - a.east * b.north,
        a.east * b.down - a.down * b.east,
        a.down * b.north - a.north * b.down,
    )
    return across == (0.0, 0.0, 0.0) and a.north * b.north + a.east * b.east + a.down * b.down >= 0.0


@dataclass
class _Moment:
    """The motion at one time, between two pieces of its way: what both ask of it there is computed once."""

    fleet_ns: int
    motion: FleetTrajectory
    fence: Fence
    state: TrajectoryState

    @cached_property
    def centre_edge_room_m(self) -> float:
        """Room of the centre to the edge."""
        north, east, _ = self.state.centre.position
        return self.fence.edge_rooms_m([(north, east)])[0]

    @cached_property
    def places(self) -> list[Ned]:
        """Where the slots are."""
        return [self.state.place(change) for change in self.motion.slots.values()]

    @cached_property
    def vertical_room_m(self) -> float:
        """Least room of any slot to floor and ceiling."""
        downs = [p.down for p in self.places]
        return min(self.fence.vertical_room_m(min(downs)), self.fence.vertical_room_m(max(downs)))

    @cached_property
    def rooms_m(self) -> list[float]:
        """Room of each slot to the nearest margin."""
        edge_rooms_m = self.fence.edge_rooms_m([(p.north, p.east) for p in self.places])
        vertical_room_m = self.fence.vertical_room_m
        return [min(room, vertical_room_m(p.down)) for room, p in zip(edge_rooms_m, self.places, strict=True)]

    @cached_property
    def room_m(self) -> float:
        """Least room of any slot."""
        return min(self.rooms_m)


@dataclass(slots=True)
class _March:
    """One examination of a motion."""

    motion: FleetTrajectory
    fence: Fence
    allowed_m: float = 0.0
    """room that no slot may fall below"""
    looks: float = 0.0
    _level_m: float = field(init=False)
    """how far slots reach from the centre, level, before or after their change"""
    _least_down_m: float = field(init=False)
    _most_down_m: float = field(init=False)
    _way_m: float = field(init=False)
    """the longest way of a change"""
    _looks_max: float = field(init=False)
    _centre_cost: float = field(init=False)
    _slots_cost: float = field(init=False)
    _end: _Moment | None = field(default=None, init=False)
    """of the last span, where the next one begins"""

    def __post_init__(self) -> None:
        ends = [slot for change in self.motion.slots.values() for slot in change]
        self._level_m = max(hypot(s.north, s.east) for s in ends)
        self._least_down_m, self._most_down_m = min(s.down for s in ends), max(s.down for s in ends)
        self._way_m = max(dist(*change) for change in self.motion.slots.values())
        count = len(self.motion.slots)
        edges = len(self.fence.corners_m)
        asking = POLYGON_LOOKS if edges > 0 else 0.0
        self._looks_max = LOOKS_MAX * min(max(count / 10.0, 1.0), 3.0)
        self._centre_cost = 1.0 + asking + EDGE_LOOKS * edges
        self._slots_cost = SLOT_LOOKS * count + asking + EDGE_LOOKS * edges * count

    @property
    def exhausted(self) -> bool:
        """Whether the looks are used up."""
        return self.looks > self._looks_max

    def least_room(self, fleet_ns: int) -> tuple[float, int]:
        """Least room of any slot at a time, and the vehicle that has it."""
        self.looks += self._slots_cost
        return min(zip(self._moment(fleet_ns).rooms_m, self.motion.slots, strict=True))

    def _bend_m_s2(self, span: _Span, start_ns: int, end_ns: int) -> float:
        """No slot's acceleration is greater between two times of a span; 0 where all ways are straight."""
        m, bend = self.motion, 0.0
        rate, change = span.rate_rad_s, span.rate_change_rad_s2
        if m.heading_rate_rad_s != 0.0 and start_ns - m.legs_start_ns < TURN_RAMP_S * 1e9:
            rate += abs(m.heading_rate_rad_s)
            change += 1.5 * abs(m.heading_rate_rad_s) / TURN_RAMP_S
        bend = (change + rate * rate) * self._level_m
        if m.blend_s > 0.0 and start_ns < m.blend_end_ns and end_ns > m.blend_start_ns:
            bend += (2.0 * rate * 1.875 / m.blend_s + MINIMUM_JERK_BEND / m.blend_s**2) * self._way_m
        # Slots that are rigidly about a centre on a straight way fly straight; others do not, at an uneven pace.
        return 0.0 if bend == 0.0 and span.straight else bend + span.centre_m_s2

    def inside(self, span: _Span) -> bool:
        """Whether every slot stays inside over a span; also False once the looks are used up."""
        start = self._moment(span.start_ns)
        self._end = self._moment(span.end_ns)
        stack = [(start, self._end)]
        while stack:
            first, last = stack.pop()
            start_ns, end_ns = first.fleet_ns, last.fleet_ns
            self.looks += self._centre_cost
            if self.exhausted:
                return False
            seconds = (end_ns - start_ns) * 1e-9
            strip = 0.125 * self._bend_m_s2(span, start_ns, end_ns) * seconds * seconds
            if self._all_inside(first, last, strip):
                continue
            self.looks += self._slots_cost
            if not min(first.room_m, last.room_m) >= self.allowed_m:
                return False
            least, wide = self._slots_inside(first, last, strip)
            if least >= self.allowed_m:
                continue
            middle_ns = (start_ns + end_ns) // 2
            if wide > RESOLUTION_M and start_ns < middle_ns < end_ns:
                middle = self._moment(middle_ns)
                stack += [(middle, last), (first, middle)]
        return True

    def _all_inside(self, first: _Moment, last: _Moment, strip: float) -> bool:
        """Whether a strip about the centre's way that is wide enough for every slot is inside."""
        a, b = first.state.centre.position, last.state.centre.position
        fence, need = self.fence, self.allowed_m + strip
        lowest, highest = max(a.down, b.down) + self._most_down_m, min(a.down, b.down) + self._least_down_m
        if fence.lowest_down_m - lowest < need or highest - fence.highest_down_m < need:
            return False
        if fence.convex:
            room = min(first.centre_edge_room_m, last.centre_edge_room_m)
        else:
            room = fence.edge_rooms_along_m([((a.north, a.east), (b.north, b.east))])[0]
        return room - self._level_m >= need

    def _moment(self, fleet_ns: int) -> _Moment:
        if self._end is not None and self._end.fleet_ns == fleet_ns:
            return self._end
        return _Moment(fleet_ns, self.motion, self.fence, self.motion.state_at(fleet_ns))

    def _slots_inside(self, first: _Moment, last: _Moment, strip: float) -> tuple[float, float]:
        """Least room of the strips about the slots' ways, and how wide or (beside a notch) how long what may be halved
        is."""
        if self.fence.convex:
            # On a straight way the least room is that at one of its ends.
            return min(first.room_m, last.room_m) - strip, strip
        self.looks += self._slots_cost
        ways = [((a.north, a.east), (b.north, b.east)) for a, b in zip(first.places, last.places, strict=True)]
        least = min(first.vertical_room_m, last.vertical_room_m, *self.fence.edge_rooms_along_m(ways))
        return least - strip, max(strip, *(dist(a, b) for a, b in ways))

    def deepest(self, spans: list[_Span]) -> Breach | None:
        """How far the spans of one leg lead outside at most."""
        worst: Breach | None = None
        start_ns, end_ns = spans[0].start_ns, spans[-1].end_ns
        parts = min(max(int(DEPTH_SHARE * self._looks_max / (2.0 * self._slots_cost)), 2), DEPTH_PARTS)
        for _ in range(2):
            step_ns = max((end_ns - start_ns) // parts, 1)
            for at_ns in (*range(start_ns, end_ns, step_ns), end_ns):
                room, vehicle = self.least_room(at_ns)
                if room < self.allowed_m and (worst is None or -room > worst.outside_m):
                    worst = Breach(spans[0].leg, vehicle, -room, (at_ns - self.motion.start_ns) * 1e-9)
            if worst is None:
                return None
            at_ns = self.motion.start_ns + round(worst.time_s * 1e9)
            start_ns, end_ns = max(at_ns - step_ns, start_ns), min(at_ns + step_ns, end_ns)
        return worst


def examined(motion: FleetTrajectory, fence: Fence) -> tuple[Breach | None, float]:
    """The first leg that leads a slot beyond the fence's margin, with the worst of that leg (None if all stay inside);
    and the looks that it took.

    A motion that starts beyond the margin is a way back if it ends no further out, whatever it passes: the safety
    filter holds the vehicles meanwhile.
    """
    march = _March(motion, fence)
    room, _ = march.least_room(motion.start_ns)
    march.allowed_m = min(room, 0.0) - TOLERANCE_M
    spans = list(_spans(motion))
    if march.allowed_m < -2.0 * TOLERANCE_M:
        end = spans[-1]
        room, vehicle = march.least_room(end.end_ns)
        if isfinite(motion.leg_starts[-1][0]):
            # A velocity that is kept must lead back too.
            room, vehicle = min((room, vehicle), march.least_room(end.end_ns + 1_000_000_000))
        if room >= march.allowed_m:
            return None, march.looks
        return Breach(end.leg, vehicle, -room, (end.end_ns - motion.start_ns) * 1e-9), march.looks
    for span in spans:
        if march.inside(span):
            continue
        if march.exhausted:
            return Breach(span.leg, 0, 0.0, (span.start_ns - motion.start_ns) * 1e-9), march.looks
        return march.deepest([s for s in spans if s.leg == span.leg]), march.looks
    return None, march.looks


def only_stops(motion: FleetTrajectory, before: FleetTrajectory) -> bool:
    """Whether a motion does nothing but bring the formation of the one before to rest: that is never refused."""
    rests = all(isinstance(leg, VelocityLeg) and leg.velocity_ned_m_s == ZERO for leg in motion.legs)
    return bool(motion.legs) and rests and motion.slots == before.slots


def slots_apart_m(motion: FleetTrajectory) -> float:
    """The least distance of two slots from the motion's start to the end of its change of formation (m).

    All pass from before to after by the same share at a time, so that two slots' offset moves on a straight line.
    """
    gone = motion.state_at(motion.start_ns).blend[0]
    now = [(lerp(*change, gone), change.after) for change in motion.slots.values()]
    least2 = inf
    for k, (a, a_after) in enumerate(now):
        for b, b_after in now[:k]:
            x, y, z = a.north - b.north, a.east - b.east, a.down - b.down
            dx = a_after.north - b_after.north - x
            dy = a_after.east - b_after.east - y
            dz = a_after.down - b_after.down - z
            way2 = dx * dx + dy * dy + dz * dz
            share = min(max(-(x * dx + y * dy + z * dz) / way2, 0.0), 1.0) if way2 > 0.0 else 0.0
            x, y, z = x + share * dx, y + share * dy, z + share * dz
            least2 = min(least2, x * x + y * y + z * z)
    return least2**0.5 if isfinite(least2) else inf


def slots_continue(motion: FleetTrajectory, before: FleetTrajectory, tolerance_m: float) -> bool:
    """Whether a motion's slots begin where those of the one before are then."""
    gone, there = (m.state_at(motion.start_ns).blend[0] for m in (motion, before))
    return all(
        dist(lerp(*change, gone), lerp(*before.slots[i], there)) <= tolerance_m for i, change in motion.slots.items()
    )
