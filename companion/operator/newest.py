"""The newest motion of a fleet, as its vehicles tell it: what the operator's next motion follows."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import isfinite
from statistics import median

from companion.core.frames import Ned
from companion.core.trajectory.fleet import FleetTrajectory
from companion.core.trajectory_check import REVISION_JUMP_MAX
from companion.errors import RefusedError, WireError
from companion.wire.operator import Status, Whereabouts
from companion.wire.peer import motion_from_json

MOTION_AHEAD_NS = 3_600_000_000_000
"""a motion that begins later than this is nobody's: no vehicle takes one"""


@dataclass(frozen=True, slots=True)
class Newest:
    """What the vehicles fly by."""

    motion: FleetTrajectory | None
    """None: nobody tells one that could be followed"""
    unfollowed: Mapping[int, str]
    """vehicle id -> what is wrong with the plan that it tells"""

    @property
    def sentences(self) -> tuple[str, ...]:
        """Whose plan is left out, and why."""
        return tuple(f"vehicle {i}'s plan cannot be followed: {why}" for i, why in sorted(self.unfollowed.items()))


def newest_motion(statuses: Mapping[int, Status | None], now_ns: int) -> Newest:
    """The newest motion told (`now_ns`: UTC); whoever tells one that nobody could follow is left out by name."""
    motions: dict[int, FleetTrajectory] = {}
    unfollowed: dict[int, str] = {}
    for i, status in statuses.items():
        if status is not None:
            motion = _followable(status.motion, now_ns)
            if isinstance(motion, str):
                unfollowed[i] = motion
            else:
                motions[i] = motion
    for i in _too_far_ahead({i: m.revision for i, m in motions.items()}):
        unfollowed[i] = f"its revision {motions.pop(i).revision} is far ahead of all others"
    return Newest(max(motions.values(), key=lambda m: m.order, default=None), unfollowed)


def _followable(told: Mapping[str, object], now_ns: int) -> FleetTrajectory | str:
    """A motion as a vehicle tells it, or why nobody could follow it."""
    try:
        motion = motion_from_json(told)
        if motion.start_ns > now_ns + MOTION_AHEAD_NS:
            return "it starts more than an hour from now"
        here = motion.state_at(max(now_ns, motion.start_ns)).centre
        if not all(isfinite(x) for x in (*here.position, *here.velocity)):
            return "it leads nowhere"
    except (WireError, ArithmeticError, ValueError, LookupError, RecursionError) as error:
        return str(error) or type(error).__name__
    return motion


def _too_far_ahead(revisions: Mapping[int, int]) -> Iterator[int]:
    """Vehicles whose motion's revision the others would refuse; who starts late holds 0 and is no measure."""
    known = sorted(r for r in revisions.values() if r > 0) or [0]
    middle = known[(len(known) - 1) // 2]
    return (i for i, r in revisions.items() if r > middle + REVISION_JUMP_MAX)


def whereabouts(statuses: Mapping[int, Status | None], newest: FleetTrajectory) -> Whereabouts:
    """Where a fleet is that flies no shared motion: the middle of what its vehicles say, one by one axis.

    Each says it by the mean of its neighbours' places. So it is as good as what they know of each other, and a second
    old at most; a common velocity that changes adds to it what it changes until the next motion begins.
    RefusedError if nobody says it.
    """
    told = [s.centre for s in statuses.values() if s is not None and s.centre is not None]
    if not told:
        raise RefusedError("no vehicle says where the formation is")
    at_ns = max(c.time_ns for c in told)
    rows = [
        (*(p + v * (at_ns - c.time_ns) * 1e-9 for p, v in zip(c.position_ned_m, c.velocity_ned_m_s, strict=True)),
         *c.velocity_ned_m_s)
        for c in told
    ]  # fmt: skip
    north, east, down, v_north, v_east, _ = (median(column) for column in zip(*rows, strict=True))
    height = newest.state_at(at_ns).centre.position.down if newest.free_at(at_ns) else down
    return Whereabouts(at_ns, Ned(north, east, height), Ned(v_north, v_east, 0.0))
