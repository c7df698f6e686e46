"""Trajectories that take over from another: with other legs, into another formation, back over the pads.

Each starts where the one before has taken the formation at that time, so no slot jumps.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import cos, dist, inf, sin

from companion.core.assignment import assign
from companion.core.formation import Slots
from companion.core.frames import Ned
from companion.core.trajectory.fleet import PADS, FleetTrajectory, Then
from companion.core.trajectory.goto import goto_leg
from companion.core.trajectory.legs import TURN_RAMP_S, FreeLeg, GotoLeg, Leg, VelocityLeg
from companion.core.trajectory.slots import SlotChange, blend_duration_s
from companion.core.values import ZERO
from companion.core.vectors import lerp

PAD_TOLERANCE_M = 0.05


def with_legs(
    motion: FleetTrajectory,
    *,
    at_ns: int,
    issuer: int,
    legs: tuple[Leg, ...],
    then: Then = "stay",
    heading_follows_turns: bool | None = None,
) -> FleetTrajectory:
    """The motion that takes over from `motion` at `at_ns` with other legs; the slots go on as they were."""
    now = motion.state_at(at_ns)
    return replace(
        motion,
        revision=motion.revision + 1,
        start_ns=at_ns,
        issuer=issuer,
        legs_start_ns=at_ns,
        centre_ned_m=now.centre.position,
        velocity_ned_m_s=now.centre.velocity,
        heading_rad=now.heading_rad,
        heading_rate_rad_s=now.rate,
        heading_follows_turns=motion.heading_follows_turns if heading_follows_turns is None else heading_follows_turns,
        legs=legs,
        then=then,
    )


def going_on(motion: FleetTrajectory, at_ns: int, position_ned_m: Ned, velocity_ned_m_s: Ned) -> FleetTrajectory:
    """A motion whose centre is not shared, as if it went on from where it is: what takes over starts there."""
    heading = motion.state_at(at_ns).heading_rad
    return replace(
        motion,
        start_ns=min(motion.start_ns, at_ns),
        legs_start_ns=at_ns,
        centre_ned_m=position_ned_m,
        velocity_ned_m_s=velocity_ned_m_s,
        heading_rad=heading,
        heading_rate_rad_s=0.0,
        legs=(VelocityLeg(velocity_ned_m_s, 0.0),),
    )


def freed(motion: FleetTrajectory) -> FleetTrajectory:
    """The same motion with nothing shared of its centre's from its start on."""
    now = motion.state_at(motion.start_ns)
    return replace(
        motion,
        legs_start_ns=motion.start_ns,
        centre_ned_m=now.centre.position,
        velocity_ned_m_s=now.centre.velocity,
        heading_rad=now.heading_rad,
        heading_rate_rad_s=now.rate,
        legs=(FreeLeg(),),
        then="stay",
    )


def with_formation(
    motion: FleetTrajectory,
    *,
    at_ns: int,
    issuer: int,
    shape: str,
    slots: Slots,
    pinned: Mapping[int, int],
    speed_m_s: float,
    climb_m_s: float = inf,
    descent_m_s: float = inf,
) -> FleetTrajectory:
    """The motion that takes over from `motion` at `at_ns` with its vehicles moving to other slots.

    Each vehicle's next slot is assigned from the slots it is in at `at_ns`, both nominal (`assignment.assign`);
    `pinned` names the slots of vehicles that always take the same. The legs go on as they were.
    """
    m = motion.state_at(at_ns).blend[0]
    ids = sorted(motion.slots)
    before = [lerp(*motion.slots[i], m) for i in ids]
    order = assign(before, slots, _rows(ids, pinned))
    changes = [SlotChange(a, slots[k]) for a, k in zip(before, order, strict=True)]
    return replace(
        motion,
        revision=motion.revision + 1,
        start_ns=at_ns,
        issuer=issuer,
        shape=shape,
        slots=dict(zip(ids, changes, strict=True)),
        blend_start_ns=at_ns,
        blend_s=blend_duration_s(changes, speed_m_s, climb_m_s, descent_m_s),
    )


def with_return(
    motion: FleetTrajectory,
    home: FleetTrajectory,
    *,
    at_ns: int,
    issuer: int,
    speed_m_s: float,
    climb_m_s: float = inf,
    descent_m_s: float = inf,
) -> FleetTrajectory:
    """The motion that takes over from `motion` at `at_ns` and brings every vehicle back over its own pad, to land.

    `home` is the first motion, in which each stands over its pad. The centre flies to the pads' centre while the slots
    pass into the pads' arrangement, each vehicle to its own; neither is faster than `speed_m_s`.
    """
    centre = home.state_at(0).centre.position
    here = motion.state_at(at_ns)
    far = at_ns + round(1e9 * TURN_RAMP_S)
    stopped = with_legs(motion, at_ns=at_ns, issuer=issuer, legs=(VelocityLeg(ZERO, 0.0),))
    c, s = cos(stopped.state_at(far).heading_rad), sin(stopped.state_at(far).heading_rad)
    slots = {}
    for i, change in motion.slots.items():
        pad = home.reference(i, 0).position_ned_m
        north, east, down = (x - y for x, y in zip(pad, centre, strict=True))
        slots[i] = SlotChange(lerp(*change, here.blend[0]), Ned(c * north + s * east, c * east - s * north, down))
    flight = goto_leg(here.centre.position, here.centre.velocity, centre, speed_m_s, climb_m_s, descent_m_s)
    seconds = max(blend_duration_s(list(slots.values()), speed_m_s, climb_m_s, descent_m_s), flight.duration_s)
    return replace(
        stopped, shape=PADS, slots=slots, blend_start_ns=at_ns, blend_s=seconds,
        legs=(GotoLeg(centre, seconds),), then="land",
    )  # fmt: skip


def over_the_pads(motion: FleetTrajectory, home: FleetTrajectory) -> bool:
    """Whether the slots of a motion of shape "pads" are the pads' arrangement, and a return ends over each own pad."""
    ids = sorted(home.slots)
    if set(ids) != set(motion.slots):
        return False
    rows = [(motion.slots[i].after, home.slots[i].after) for i in ids]
    if any(
        abs(dist(a, b) - dist(pad_a, pad_b)) > PAD_TOLERANCE_M
        for k, (a, pad_a) in enumerate(rows)
        for b, pad_b in rows[:k]
    ):
        return False
    if not motion.returns or motion.end_ns is None:
        return not motion.returns
    end = motion.state_at(motion.end_ns)
    return all(
        dist(end.slot(motion.slots[i]).position_ned_m, home.reference(i, 0).position_ned_m) <= PAD_TOLERANCE_M
        for i in ids
    )


def assignment_matches(motion: FleetTrajectory, slots: Slots, pinned: Mapping[int, int]) -> bool:
    """Whether a received motion's slots are what this vehicle assigns from its own configuration; else refused."""
    ids = sorted(motion.slots)
    if len(slots) != len(ids):
        return False
    order = assign([motion.slots[i].before for i in ids], slots, _rows(ids, pinned))
    return all(dist(motion.slots[i].after, slots[k]) < 1e-3 for i, k in zip(ids, order, strict=True))


def _rows(ids: Sequence[int], pinned: Mapping[int, int]) -> dict[int, int]:
    return {row: pinned[i] for row, i in enumerate(ids) if i in pinned}
