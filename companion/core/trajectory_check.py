"""Whether a motion may be flown: one examination for fleet.toml, the command line, the operator's client and the wire.

Bounds on single values (the constants here) are held where a motion is read; they keep its arithmetic far from overflow
and from division by nothing. What needs the motion as a whole is `examine`: how long it is, how fast its centre and its
slots fly, how low, how near each other, and whether it stays inside the fence. What it costs is bounded too, and
counted in looks (`core.route`): the same motion costs every vehicle the same.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from math import hypot, inf, pi, radians, sqrt
from typing import NamedTuple

from companion.core.counts import RefusalKind
from companion.core.route import Breach, examined, only_stops, slots_apart_m, slots_continue
from companion.core.safety.fence import Fence
from companion.core.trajectory.fleet import REVISIONS, FleetTrajectory
from companion.core.trajectory.goto import GOTO_ACCELERATION_M_S2, GotoPeaks, goto_peaks
from companion.core.trajectory.legs import (
    TURN_RAMP_S,
    FreeLeg,
    GotoLeg,
    TurnLeg,
    VelocityLeg,
    leg_duration_s,
    turn_rate_and_time,
    velocity_ramp_s,
)
from companion.core.trajectory.slots import BLEND_MIN_S

# -- bounds on single values ---------------------------------------------------------------------------------------

LEGS_MAX = 100
MOTION_BYTES_MAX = 65_536
"""of a motion's JSON: 250 vehicles and 100 legs take 50 kB"""
VEHICLES_MAX = 250
DURATION_MAX_S = 86_400.0
"""of a leg, of a change of formation and of a whole motion but for a last leg without end: a day"""
PLACE_MAX_M = 1e5
"""no place of a motion is further than this from the fleet origin, no slot from the centre"""
VELOCITY_MAX_M_S = 12.0
"""the largest speed limit that fleet.toml takes"""
TURN_RATE_MIN_DEG_S, TURN_RATE_MAX_DEG_S = 0.01, 60.0
"""slower turns are straight lines to a double's precision"""
TURN_RATE_MIN_RAD_S, TURN_RATE_MAX_RAD_S = radians(TURN_RATE_MIN_DEG_S), radians(TURN_RATE_MAX_DEG_S)
TURN_ANGLE_MIN_DEG, TURN_ANGLE_MAX_DEG = 0.01, 36_000.0
TURN_ANGLE_MIN_RAD, TURN_ANGLE_MAX_RAD = radians(TURN_ANGLE_MIN_DEG), radians(TURN_ANGLE_MAX_DEG)
HEADING_MAX_RAD = 2.0 * pi

# -- what the motion as a whole must keep ----------------------------------------------------------------------------

REVISION_JUMP_MAX = 10_000
"""no motion is further ahead than this of those that are known: nobody may use up the revisions for all others"""
PLAN_SPEED_SHARE = 0.75
"""part of the speed limits that the centre may use; the rest is left to slots that turn or change, and to keep up"""
ALTITUDE_MIN_M = 1.0
"""no slot lower than this above the fleet origin"""
SPEED_SLACK = 1.01
"""speeds within legs are known to a per cent"""
STOP_SLACK = 1.5
"""a stop may ask slots for so much more: amid a turn that dies out some become faster before they stand"""
SLOTS_TOLERANCE_M = 0.05
"""slots that begin no further from those of the motion before begin where they are"""
BLEND_LOOKS = 16
"""parts of a change of formation at whose ends the slots' speeds are looked at"""
LEVEL_M_S = 1e-6


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """What of the configuration a motion must keep."""

    speed_max_m_s: float
    climb_max_m_s: float
    descent_max_m_s: float
    slots_apart_m: float
    """least distance of two slots while a motion that begins elsewhere than the one before changes its formation"""
    fence: Fence | None


class Fault(NamedTuple):
    """Why a motion is refused."""

    kind: RefusalKind
    sentence: str
    """for people; begins with "it", "its centre" or "its leg k" """
    leg: int | None = None
    """which leg is at fault; None: the motion as a whole"""
    breach: Breach | None = None
    """where it leads outside the fence, if that is the fault"""
    permanent: bool = False
    """whether it is so whatever motion it follows and whenever it comes"""


class Examination(NamedTuple):
    """What became of a motion."""

    fault: Fault | None
    looks: float
    """what it cost: a look is some 15 µs of a fast core"""


def _form_fault(motion: FleetTrajectory) -> Fault | None:
    """What is wrong with its times and its order, before anything is computed from them."""
    if len(motion.legs) > LEGS_MAX:
        return Fault(RefusalKind.LEGS, f"it has {len(motion.legs)} legs, may have {LEGS_MAX}", LEGS_MAX)
    for k, leg in enumerate(motion.legs[:-1]):
        if isinstance(leg, TurnLeg) and leg.angle_rad == inf:
            return Fault(RefusalKind.ENDLESS, f"its leg {k} turns for ever, but legs follow", k)
        if isinstance(leg, FreeLeg):
            return Fault(RefusalKind.ENDLESS, f"its leg {k} is free and never ends, but legs follow", k)
    if not motion.slots:
        return Fault(RefusalKind.NO_SLOTS, "it has no slots")
    if motion.legs_start_ns > motion.start_ns:
        return Fault(RefusalKind.TIMES, "its legs start after it does")
    if not (motion.blend_start_ns - motion.start_ns) * 1e-9 <= DURATION_MAX_S:
        return Fault(RefusalKind.TIMES, "its change of formation starts more than a day after it does")
    since_s = (motion.start_ns - motion.legs_start_ns) * 1e-9
    if motion.legs and not since_s <= DURATION_MAX_S:
        return Fault(
            RefusalKind.TOO_LONG, f"its legs began {since_s:.0f} s before it, may begin {DURATION_MAX_S:.0f} s before"
        )
    if not motion.legs and any(motion.velocity_ned_m_s):
        return Fault(RefusalKind.NO_LEG, "it has a velocity, but no leg")
    if motion.blend_s == 0.0:
        moved = [i for i, change in motion.slots.items() if change.before != change.after]
        if moved:
            return Fault(RefusalKind.SLOTS_JUMP, f"the slot of vehicle {moved[0]} changes in no time")
    elif not BLEND_MIN_S <= motion.blend_s <= DURATION_MAX_S:
        return Fault(RefusalKind.CHANGE, f"its slots change in {motion.blend_s:g} s, must take {BLEND_MIN_S:g} s")
    for k, (since, _, _, _) in enumerate(motion.leg_starts[1:]):
        if not (since <= DURATION_MAX_S or since == inf):
            return Fault(
                RefusalKind.TOO_LONG, f"its leg {k} ends after {since:.0f} s, may after {DURATION_MAX_S:.0f} s", k
            )
    return None


def _peaks(motion: FleetTrajectory) -> Iterator[tuple[int | None, GotoPeaks]]:
    """What the centre does at most, of the start and of each leg that changes its speed."""
    v = motion.velocity_ned_m_s
    yield None, GotoPeaks(hypot(v.north, v.east), max(-v.down, 0.0), max(v.down, 0.0), 0.0)
    for k, leg in enumerate(motion.legs):
        _, p, v, _ = motion.leg_starts[k]
        match leg:
            case VelocityLeg():
                # Between two velocities none is faster than both, and the first is the leg's before it.
                n, e, d = leg.velocity_ned_m_s
                yield k, GotoPeaks(hypot(n, e), max(-d, 0.0), max(d, 0.0), 0.0)
            case GotoLeg():
                yield k, goto_peaks(leg, p, v)


def _speed_fault(motion: FleetTrajectory, limits: MotionLimits) -> Fault | None:
    level, climb, descent = (
        PLAN_SPEED_SHARE * x for x in (limits.speed_max_m_s, limits.climb_max_m_s, limits.descent_max_m_s)
    )
    most = GotoPeaks(level, climb, descent, GOTO_ACCELERATION_M_S2)
    for leg, peaks in _peaks(motion):
        for came, may, verb, unit in zip(
            peaks, most, ("flies at", "climbs at", "sinks at", "accelerates with"), ("m/s", "m/s", "m/s", "m/s^2"),
            strict=True,
        ):  # fmt: skip
            if not came <= may * SPEED_SLACK:
                whose = "its centre" if leg is None else f"its leg {leg}"
                return Fault(RefusalKind.SPEED, f"{whose} {verb} {came:.2f} {unit}, may {may:g} {unit}", leg)
    return None


def _leg_at(motion: FleetTrajectory, fleet_ns: int) -> int | None:
    t = (fleet_ns - motion.legs_start_ns) * 1e-9
    for k in range(len(motion.leg_starts) - 1):
        if t <= motion.leg_starts[k + 1][0]:
            return k
    return None


def _times_of_slots(motion: FleetTrajectory) -> Iterator[int]:
    """Times at which slots move against each other fastest, or may (fleet ns)."""
    start_ns, zero_ns = motion.start_ns, motion.legs_start_ns
    if motion.blend_end_ns > start_ns and motion.blend_s > 0.0:
        from_ns = max(motion.blend_start_ns, start_ns)
        span_ns = motion.blend_end_ns - from_ns
        yield from (from_ns + span_ns * k // BLEND_LOOKS for k in range(BLEND_LOOKS + 1))
    if motion.heading_rate_rad_s != 0.0:
        yield from (zero_ns + round(TURN_RAMP_S * k / 8 * 1e9) for k in range(9))
    if motion.heading_follows_turns:
        # A turn keeps the angle between course and slots, so a slot is fastest when the turn is.
        for leg, (since, _, _, _) in zip(motion.legs, motion.leg_starts, strict=False):
            if isinstance(leg, TurnLeg):
                whole = turn_rate_and_time(leg)[1]
                yield zero_ns + round((since + min(TURN_RAMP_S, 0.5 * whole)) * 1e9)


def _slots_fault(motion: FleetTrajectory, limits: MotionLimits, slack: float) -> tuple[Fault | None, int]:
    """Slots that would have to be faster than the limits let a vehicle fly, and the times looked at."""
    looks = 0
    most = [slack * x for x in (limits.speed_max_m_s, limits.climb_max_m_s, limits.descent_max_m_s)]
    for at_ns in _times_of_slots(motion):
        if at_ns < motion.start_ns:
            continue
        looks += 1
        moment = motion.state_at(at_ns)
        for i, change in motion.slots.items():
            v = moment.slot(change).velocity_ned_m_s
            level2 = v.north * v.north + v.east * v.east
            if not (level2 <= most[0] * most[0] and -v.down <= most[1] and v.down <= most[2]):
                speed = f"{sqrt(level2):.2f} m/s level, {-v.down:.2f} m/s up"
                leg = _leg_at(motion, at_ns)
                where = "" if leg is None else f", in its leg {leg}"
                return Fault(RefusalKind.SLOT_SPEED, f"the slot of vehicle {i} moves at {speed}{where}", leg), looks
    return None, looks


def _altitude_fault(motion: FleetTrajectory) -> Fault | None:
    """A leg that leads a slot to the ground; a motion that begins lower may not sink further."""
    gone = motion.state_at(motion.start_ns).blend[0]
    lowest = max(max(a.down + gone * (b.down - a.down), b.down) for a, b in motion.slots.values())
    allowed = max(-ALTITUDE_MIN_M, motion.state_at(motion.start_ns).centre.position.down + lowest) + 1e-6
    for k, leg in enumerate(motion.legs):
        since, _, v, _ = motion.leg_starts[k]
        duration = leg_duration_s(leg, v)
        downs = [motion.leg_starts[k + 1][1].down]
        if v.down > LEVEL_M_S and not isinstance(leg, TurnLeg):
            # Begun sinking it may pass below its end.
            ramp = velocity_ramp_s(leg, v) if isinstance(leg, VelocityLeg) else duration
            at = (motion.legs_start_ns + round((since + ramp * k / 8) * 1e9) for k in range(1, 8))
            downs += [motion.state_at(t).centre.position.down for t in at]
        if not max(downs) + lowest <= allowed:
            lowest_m = -(max(downs) + lowest)
            sentence = f"its leg {k} leads to {lowest_m:.2f} m above the origin, must stay at {ALTITUDE_MIN_M:g} m"
            return Fault(RefusalKind.LOW, sentence, k)
        if duration == inf:
            break
    return None


def examine(motion: FleetTrajectory, limits: MotionLimits, before: FleetTrajectory | None = None) -> Examination:
    """Whether a motion may follow `before` (None: nothing is known that it follows).

    Bringing the same slots to rest is never refused for where that happens.
    """
    if before is not None and before.slots.keys() != motion.slots.keys():
        return Examination(Fault(RefusalKind.VEHICLES, "its vehicles are not this fleet's"), 1.0)
    looks = 1.0 + 0.5 * len(motion.legs)
    stops = before is not None and only_stops(motion, before)
    fault = _form_fault(motion) or _speed_fault(motion, limits)
    if fault is None and not stops:
        fault = _altitude_fault(motion)
    if fault is None:
        fault, times = _slots_fault(motion, limits, STOP_SLACK if stops else SPEED_SLACK)
        looks += times
    if fault is None and (before is None or not slots_continue(motion, before, SLOTS_TOLERANCE_M)):
        apart_m = slots_apart_m(motion)
        looks += 0.05 * len(motion.slots) ** 2
        if not apart_m >= limits.slots_apart_m:
            sentence = (
                f"its slots come within {apart_m:.2f} m of each other, must stay {limits.slots_apart_m:.2f} m apart"
            )
            fault = Fault(RefusalKind.SLOTS_MEET, sentence)
    if fault is None and not stops and limits.fence is not None:
        breach, more = examined(motion, limits.fence)
        looks += more
        if breach is not None and breach.vehicle_id == 0:
            fault = Fault(RefusalKind.LOOKS, breach.sentence(), breach.leg, breach)
        elif breach is not None:
            sentence = f"it leads outside the fence, {breach.sentence()}"
            fault = Fault(RefusalKind.FENCE, sentence, breach.leg, breach)
    if fault is None and motion.then == "stay" and abs(motion.climb_at_end_m_s) > LEVEL_M_S:
        sentence = "it climbs or sinks for ever; give an altitude to go to"
        fault = Fault(RefusalKind.CLIMB, sentence, len(motion.legs) - 1)
    return Examination(None if fault is None else fault._replace(permanent=not stops), looks)


def revision_fault(revision: int, own: int, told: Iterable[int]) -> str | None:
    """Why a motion's revision is out of all order: none that can be told, or too far ahead of one's own newest and of
    every one `told` by a peer.

    Whoever starts late holds revision 0 and hears from the others' states how far they are.
    """
    if revision >= REVISIONS:
        return "the revisions of motions are used up"
    newest = max([own, *told])
    if revision > newest + REVISION_JUMP_MAX:
        return f"its revision {revision} is more than {REVISION_JUMP_MAX} ahead of {newest}, the newest known"
    return None
