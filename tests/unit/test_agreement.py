"""Without a shared motion: what vehicles agree on, that senders and receivers predict alike, who draws the others."""

from dataclasses import dataclass, field
from math import hypot, inf
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config import FleetConfig, load
from companion.core.frames import Ned
from companion.core.law.evasion import FLEE_SPEED_M_S, GO_BACK_S, Threat
from companion.core.neighbours.gates import GATE_VELOCITY_M_S, outliers
from companion.core.neighbours.sample import Foresight
from companion.core.neighbours.table import PeerTable
from companion.core.prediction import common_way
from companion.core.trajectory.fleet import FleetTrajectory
from companion.core.trajectory.history import TrajectoryHistory
from companion.core.trajectory.legs import FreeLeg, GotoLeg, TurnLeg, VelocityLeg
from companion.core.trajectory.successors import freed, going_on, with_legs
from companion.core.trajectory_check import examine
from companion.core.values import ZERO, CommonMotion, Instant, Neighbour, PeerMessage, PeerSample, Phase, VehicleState
from companion.vehicle.agreement import Agreement
from companion.wire.peer import decode_motion, decode_state, encode_motion, encode_state

PROPERTY = settings(deadline=None, max_examples=12)
BEGUN_NS = 1_790_000_000_000_000_000
STEP_S = 0.1
"""between two ticks: slower than in flight, the same to within what is asked"""
velocities = st.builds(lambda n, e: Ned(n, e, 0.0), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
commons = st.builds(CommonMotion, *[st.floats(-1.5, 1.5, width=32)] * 2, *[st.floats(-0.5, 0.5, width=32)] * 2)


def fleet(count: int = 4, **plan: object) -> FleetConfig:
    def edit(tables: dict[str, Any]) -> None:
        tables["vehicle"] = tables["vehicle"][:count]
        tables["plan"] = {"kind": "none", **plan}

    return load(Path(__file__).resolve().parents[2] / "fleet.toml", edit)


FREE = fleet()


def ns(seconds: float) -> int:
    return BEGUN_NS + round(seconds * 1e9)


def at(seconds: float) -> Instant:
    return Instant(round(seconds * 1e9), ns(seconds))


def free_motion(config: FleetConfig, from_s: float = 0.0) -> FleetTrajectory:
    formed = config.first_formation
    return with_legs(formed, at_ns=ns(from_s), issuer=1, legs=(FreeLeg(),))


@dataclass
class One:
    """One vehicle that hears what the test has it hear, and flies exactly as it means to."""

    config: FleetConfig
    id: int
    motion: FleetTrajectory
    table: PeerTable = field(init=False)
    agreement: Agreement = field(init=False)
    position: Ned = field(init=False)
    heard: list[Neighbour] = field(default_factory=list)

    def __post_init__(self) -> None:
        others = frozenset(v.id for v in self.config.vehicles) - {self.id}
        history = TrajectoryHistory([self.config.first_motion, self.motion])
        self.table = PeerTable(self.id, others, self.config.peer_limits, history)
        self.agreement = Agreement(self.config, self.id, self.table)
        self.position = self.motion.reference(self.id, self.motion.start_ns).position_ned_m

    def tick(self, seconds: float, part: bool = True) -> Ned:
        """One control tick; returns the own slot."""
        now = at(seconds)
        plan = self.table.history.at(now.fleet_ns)
        ego = VehicleState(now.fleet_ns, self.position, self.velocity)
        moment = self.agreement.advance(plan, plan.state_at(now.fleet_ns), ego, self.heard, part, now)
        self.heard = self.table.predict(self.position, now, moment, False)
        return self.agreement.place(plan, moment, ego, self.heard, part, now).slot(plan.slots[self.id]).position_ned_m

    def fly(self, seconds: float) -> None:
        """One control tick, and the way that it means to fly until the next."""
        self.tick(seconds)
        p, v = self.position, self.velocity
        self.position = Ned(p.north + STEP_S * v.north, p.east + STEP_S * v.east, p.down)

    @property
    def velocity(self) -> Ned:
        told = self.agreement.told
        return ZERO if told is None else Ned(told.north_m_s, told.east_m_s, 0.0)

    def message(self, seconds: float, **changed: object) -> PeerMessage:
        sample = PeerSample(
            self.id, ns(seconds), self.position, self.velocity, self.motion.revision, Phase.MOVING, self.agreement.told
        )
        return PeerMessage(self.id, 1, self.motion.start_ns, self.motion.issuer, sample._replace(**changed), ())


def all_hear(fleet_of: list[One], seconds: float) -> None:
    for sender in fleet_of:
        for other in fleet_of:
            if other is not sender:
                other.table.accept(sender.message(seconds), at(seconds))


def flown(config: FleetConfig, seconds: float, wishes: dict[int, tuple[float, float]]) -> list[One]:
    """All hear all at each tick and fly as they mean to; those named are told where to go at the beginning."""
    motion = free_motion(config)
    ones = [One(config, v.id, motion) for v in config.vehicles]
    for one in ones:
        one.tick(-STEP_S)
        one.tick(0.0)
        if one.id in wishes:
            one.agreement.inform((VelocityLeg(Ned(*wishes[one.id], 0.0), 0.0),), ns(0.0))
    for k in range(1, round(seconds / STEP_S) + 1):
        all_hear(ones, (k - 1) * STEP_S)
        for one in ones:
            one.fly(k * STEP_S)
    return ones


def mean_velocity(ones: list[One]) -> tuple[float, float]:
    return sum(o.velocity.north for o in ones) / len(ones), sum(o.velocity.east for o in ones) / len(ones)


def spread_m_s(ones: list[One]) -> float:
    north, east = mean_velocity(ones)
    return max(hypot(o.velocity.north - north, o.velocity.east - east) for o in ones)


# -- agreement ---------------------------------------------------------------------------------------------------------


@PROPERTY
@given(st.lists(velocities, min_size=4, max_size=4))
def test_what_all_take_for_the_common_velocity_keeps_its_mean_and_becomes_one(begun: list[Ned]) -> None:
    config = FREE
    ones = flown(config, 0.0, {})
    for one, v in zip(ones, begun, strict=True):
        # Each gets its own by a wish that was fulfilled long ago, and forgets it.
        one.agreement.inform((VelocityLeg(v, 0.0),), ns(-20.0))
        one.tick(STEP_S)
        one.agreement.inform((), ns(STEP_S))
    before, apart = mean_velocity(ones), spread_m_s(ones)
    for k in range(2, 20):
        all_hear(ones, (k - 1) * STEP_S)
        for one in ones:
            one.fly(k * STEP_S)
    after = mean_velocity(ones)
    assert hypot(after[0] - before[0], after[1] - before[1]) < 1e-6
    assert spread_m_s(ones) <= 0.1 * apart + 1e-6


def test_nobody_moves_whom_nobody_tells_to() -> None:
    assert all(one.velocity == ZERO for one in flown(FREE, 3.0, {}))


def test_all_follow_the_one_that_knows_and_none_but_it_has_a_wish() -> None:
    ones = flown(FREE, 25.0, {2: (0.6, -0.8)})
    assert all(hypot(o.velocity.north - 0.6, o.velocity.east + 0.8) < 0.05 for o in ones)
    assert [o.id for o in ones if o.agreement.wish is not None] == [2]


def test_whoever_is_told_to_forget_its_wish_goes_on_with_what_all_have() -> None:
    ones = flown(FREE, 25.0, {2: (0.6, -0.8)})
    ones[1].agreement.inform((), ns(25.0))
    all_hear(ones, 25.0)
    for one in ones:
        one.tick(25.0 + STEP_S)
    assert ones[1].agreement.wish is None
    assert hypot(ones[1].velocity.north - 0.6, ones[1].velocity.east + 0.8) < 0.05


def test_the_informed_of_the_file_begin_with_the_shared_legs_and_a_companion_started_later_does_not() -> None:
    legs = [{"kind": "velocity", "north_m_s": 1.0, "duration_s": 60.0}]
    config = fleet(informed=[2], legs=legs)
    motion = free_motion(config)
    knows, other, late = One(config, 2, motion), One(config, 1, motion), One(config, 2, motion)
    for one in (knows, other):
        one.tick(-STEP_S)
        one.tick(0.0)
    late.tick(0.0)
    assert [o.agreement.wish is not None for o in (knows, other, late)] == [True, False, False]
    assert knows.tick(10.0) is not None
    assert knows.velocity == pytest.approx(Ned(1.0, 0.0, 0.0))


def test_who_comes_late_takes_the_mean_of_what_it_hears() -> None:
    config = FREE
    motion = free_motion(config)
    late, others = One(config, 1, motion), [One(config, i, motion) for i in (2, 3)]
    for one, v in zip(others, (0.4, 0.8), strict=True):
        late.table.accept(one.message(0.0, common=CommonMotion(v, 0.0, 0.0, 0.0)), at(0.0))
    late.tick(0.0, part=False)
    late.tick(STEP_S, part=False)
    assert late.agreement.told is None
    late.tick(2 * STEP_S, part=True)
    assert late.velocity == pytest.approx(Ned(0.6, 0.0, 0.0), abs=0.01)


def test_a_common_motion_beyond_the_limits_is_flown_no_faster_than_they_allow() -> None:
    config = FREE
    one, liar = One(config, 1, free_motion(config)), One(config, 2, free_motion(config))
    one.tick(-STEP_S)
    for k in range(120):
        t = k * STEP_S
        one.table.accept(liar.message(t, common=CommonMotion(5.0, 0.0, 0.0, 0.0)), at(t))
        one.tick(t)
    assert one.velocity.north == pytest.approx(0.75 * config.limits.speed_max_m_s)


def test_near_the_fence_nobody_keeps_a_common_motion_that_leads_out() -> None:
    config = FREE
    fence = config.geofence
    assert fence is not None
    one = One(config, 1, free_motion(config))
    one.tick(-STEP_S)
    one.tick(0.0)
    one.agreement.inform((VelocityLeg(Ned(1.0, 0.0, 0.0), 0.0),), ns(0.0))
    one.position = one.position._replace(north=196.0, east=0.0)
    for t in (10.0, 10.0 + STEP_S, 10.0 + 2 * STEP_S):
        slot = one.tick(t)
    assert 0.0 <= one.velocity.north <= 0.5 * fence.edge_room_m(slot.north, slot.east) + 1e-9


def test_the_slot_is_where_the_neighbours_are_wherever_the_shared_motion_began() -> None:
    config = FREE
    motion = free_motion(config)
    one = One(config, 1, motion)
    one.tick(-STEP_S)
    away = Ned(70.0, -30.0, 0.0)
    for i in (2, 3, 4):
        other = One(config, i, motion)
        p = other.position
        other.position = Ned(p.north + away.north, p.east + away.east, p.down)
        one.table.accept(other.message(0.0, common=CommonMotion(0.0, 0.0, 0.0, 0.0)), at(0.0))
    one.tick(0.0, part=False)
    slot, home = one.tick(STEP_S, part=False), motion.reference(1, ns(0.0)).position_ned_m
    assert slot == pytest.approx(Ned(home.north + away.north, home.east + away.east, home.down))
    assert one.agreement.centre is not None
    centre = motion.state_at(ns(0.0)).centre.position
    assert one.agreement.centre.position_ned_m == pytest.approx(
        Ned(centre.north + away.north, centre.east + away.east, centre.down)
    )


@pytest.mark.parametrize(
    ("said", "gated"),
    [
        ((2.0, 0.0), frozenset()), ((2.0 - GATE_VELOCITY_M_S + 0.01, 0.0), frozenset()),
        ((2.0 - GATE_VELOCITY_M_S - 0.01, 0.0), frozenset({4})), (None, frozenset({4})),
    ],
)  # fmt: skip
def test_one_that_flies_as_it_says_is_no_outlier_however_the_others_fly(
    said: tuple[float, float] | None, gated: frozenset[int]
) -> None:
    stands = [Neighbour(i, Ned(4.0 * i, 0.0, 0.0), ZERO, Ned(-4.0 * i, 0.0, 0.0), 0.0, True, True, 0.3) for i in (2, 3)]
    flees = Neighbour(4, Ned(16.0, 0.0, 0.0), Ned(2.0, 0.0, 0.0), Ned(-16.0, 0.0, 0.0), 0.0, True, True, 0.3)
    assert outliers([*stands, flees], ZERO, {2: (0.0, 0.0), 3: (0.0, 0.0), 4: said}) == gated
    assert outliers([*stands, flees], ZERO) == {4}


# -- what is fled ------------------------------------------------------------------------------------------------------


def scared(threat: Threat, seconds: float, position: Ned | None = None, wish: Ned | None = None) -> One:
    """One alone that stands where it is, and is told of a threat after the first tick."""
    one = One(FREE, 1, free_motion(FREE))
    one.position = position or one.position
    one.tick(-STEP_S)
    one.tick(0.0)
    if wish is not None:
        one.agreement.inform((VelocityLeg(wish, 0.0),), ns(-20.0))
    one.agreement.scare(threat, ns(0.0))
    for k in range(1, round(seconds / STEP_S) + 1):
        one.tick(k * STEP_S)
    return one


def beside(one: Ned, lasts_s: float = 60.0, east_m: float = 3.0, radius_m: float = 10.0) -> Threat:
    return Threat(one.north, one.east - east_m, 0.0, 0.0, radius_m, lasts_s)


HOME = free_motion(FREE).reference(1, ns(0.0)).position_ned_m


def test_who_flees_takes_that_for_nu_tells_it_and_has_its_place_where_it_is() -> None:
    one = scared(beside(HOME), 5.0)
    assert one.agreement.flees
    assert one.velocity == pytest.approx(Ned(0.0, FLEE_SPEED_M_S, 0.0))
    one.position = Ned(HOME.north + 7.0, HOME.east + 1.0, HOME.down)
    slot = one.tick(5.0 + STEP_S)
    assert (slot.north, slot.east) == pytest.approx((one.position.north, one.position.east))


def test_what_it_says_of_the_centre_is_what_the_neighbours_say_while_it_flees() -> None:
    one, other = One(FREE, 1, free_motion(FREE)), One(FREE, 2, free_motion(FREE))
    for o in (one, other):
        o.tick(-STEP_S)
        o.tick(0.0)
    one.table.accept(other.message(0.0), at(0.0))
    one.agreement.scare(beside(HOME), ns(0.0))
    one.position = one.position._replace(east=HOME.east + 2.0)
    for k in range(1, 20):
        one.tick(k * STEP_S)
    assert one.agreement.flees
    assert one.agreement.centre is not None
    centre = free_motion(FREE).state_at(ns(2.0)).centre.position
    assert one.agreement.centre.position_ned_m == pytest.approx(centre)


def test_after_the_threat_it_wishes_what_all_had_and_is_then_uninformed() -> None:
    one = scared(beside(HOME, lasts_s=3.0), 3.0 + 2.0)
    assert not one.agreement.flees
    assert one.velocity == pytest.approx(ZERO)
    late, liar = scared(beside(HOME, lasts_s=3.0), 3.0 + GO_BACK_S + 1.0), One(FREE, 2, free_motion(FREE))
    said = CommonMotion(0.5, 0.0, 0.0, 0.0)
    late.table.accept(liar.message(9.0, common=said), at(9.0))
    for k in range(91, 100):
        late.tick(k * STEP_S)
    assert late.velocity.north > 0.2


def test_who_is_informed_flees_too_and_goes_back_to_its_wish() -> None:
    wish = Ned(0.0, -1.0, 0.0)
    assert scared(beside(HOME), 5.0, wish=wish).velocity.east == pytest.approx(FLEE_SPEED_M_S)
    assert scared(beside(HOME, lasts_s=3.0), 6.0, wish=wish).velocity == pytest.approx(wish)
    assert scared(beside(HOME, lasts_s=3.0), 20.0, wish=wish).velocity == pytest.approx(wish)


def test_a_threat_at_the_fence_chases_nobody_out() -> None:
    fence = FREE.geofence
    assert fence is not None
    edge = Ned(0.0, 197.5, HOME.down)
    one = scared(Threat(0.0, 194.0, 0.0, 0.0, 20.0, 60.0), 5.0, edge)
    assert one.agreement.flees
    assert one.velocity.east <= 0.5 * fence.edge_room_m(edge.north, edge.east) + 1e-9


def test_who_is_not_in_formation_flees_nothing_and_a_shared_motion_ends_a_threat() -> None:
    one = scared(beside(HOME), 2.0)
    one.tick(2.0 + STEP_S, part=False)
    assert not one.agreement.flees
    one = scared(beside(HOME), 2.0)
    shared = with_legs(
        going_on(one.motion, ns(2.0), ZERO, ZERO), at_ns=ns(2.1), issuer=0, legs=(VelocityLeg(ZERO, 0.0),)
    )
    assert one.table.history.adopt(shared)
    one.tick(2.2)
    assert not one.agreement.flees
    assert one.agreement.told is None


# -- prediction --------------------------------------------------------------------------------------------------------


@PROPERTY
@given(commons, st.floats(0.0, 30.0))
def test_the_way_of_a_common_motion_has_its_velocity(common: CommonMotion, tau_s: float) -> None:
    h = 1e-4
    before, after, now = common_way(common, tau_s), common_way(common, tau_s + 2 * h), common_way(common, tau_s + h)
    assert (after.north_m - before.north_m) / (2 * h) == pytest.approx(now.north_m_s, abs=1e-5)
    assert (after.east_m - before.east_m) / (2 * h) == pytest.approx(now.east_m_s, abs=1e-5)


@PROPERTY
@given(commons, st.floats(0.0, 12.0), st.floats(-2.0, 2.0), st.booleans())
def test_receivers_predict_a_sender_as_it_predicts_itself(
    common: CommonMotion, age_s: float, off_m: float, takes_over: bool
) -> None:
    config = FREE
    motion = free_motion(config)
    sender, receiver = One(config, 2, motion), One(config, 1, motion)
    if takes_over:
        seen = going_on(motion, ns(0.0), Ned(5.0, 6.0, -10.0), Ned(0.5, 0.0, 0.0))
        after = with_legs(seen, at_ns=ns(3.0), issuer=0, legs=(VelocityLeg(ZERO, 0.0),))
        for one in (sender, receiver):
            assert one.table.history.adopt(after)
    sender.position = sender.position._replace(north=sender.position.north + off_m)
    message = sender.message(0.0, common=common)
    receiver.tick(0.0)
    assert receiver.table.accept(decode_state(encode_state(message)), at(0.0)) is None
    then = sender.table.history.reference(2, ns(0.0))
    expected = sender.table.foresight.at(
        message.sample, (then.position_ned_m, then.velocity_ned_m_s), ns(age_s)
    )  # fmt: skip
    receiver.tick(age_s)
    (found,) = receiver.heard
    assert found.position_ned_m == pytest.approx(expected[0], abs=1e-3)
    assert found.velocity_ned_m_s == pytest.approx(expected[1], abs=1e-3)


@PROPERTY
@given(velocities, st.floats(0.0, 15.0))
def test_a_vehicle_that_goes_on_with_the_common_motion_is_where_the_hold_says(v: Ned, age_s: float) -> None:
    config = FREE
    motion = free_motion(config)
    foresight = Foresight(TrajectoryHistory([config.first_motion, motion]), config.peer_limits)
    p = Ned(40.0, -3.0, -10.0)
    sample = PeerSample(2, ns(0.0), p, v, 2, Phase.MOVING, CommonMotion(v.north, v.east, 0.0, 0.0))
    place, velocity, _ = foresight.at(sample, foresight.reference_then(sample), ns(age_s))
    assert place == pytest.approx(Ned(p.north + v.north * age_s, p.east + v.east * age_s, p.down))
    assert velocity == pytest.approx(v)


@PROPERTY
@given(velocities, st.floats(0.1, 8.0), st.floats(0.1, 8.0))
def test_a_shared_motion_that_takes_over_carries_a_sample_on_from_where_it_was_by_then(
    v: Ned, until_s: float, since_s: float
) -> None:
    config = FREE
    motion = free_motion(config)
    centre = Ned(300.0, 0.0, -10.0)
    shared = with_legs(
        going_on(motion, ns(until_s), centre, v), at_ns=ns(until_s), issuer=0, legs=(VelocityLeg(v, 0.0),)
    )
    foresight = Foresight(TrajectoryHistory([config.first_motion, motion, shared]), config.peer_limits)
    p = Ned(295.0, 4.0, -10.0)
    sample = PeerSample(2, ns(0.0), p, v, 2, Phase.MOVING, CommonMotion(v.north, v.east, 0.0, 0.0))
    place, _, _ = foresight.at(sample, foresight.reference_then(sample), ns(until_s + since_s))
    gone_s = until_s + since_s
    assert place == pytest.approx(Ned(p.north + v.north * gone_s, p.east + v.east * gone_s, p.down), abs=1e-6)


# -- the motion that is not shared -------------------------------------------------------------------------------------


def test_a_free_leg_never_ends_stands_in_what_is_shared_and_survives_the_wire() -> None:
    motion = free_motion(FREE, from_s=5.0)
    assert motion.end_ns is None
    assert motion.free_from_ns == ns(5.0)
    assert not motion.free_at(ns(4.9))
    assert motion.free_at(ns(5.0))
    assert motion.state_at(ns(50.0)).centre.velocity == ZERO
    assert decode_motion(encode_motion(motion)) == motion


def test_legs_after_a_free_one_are_refused() -> None:
    config = FREE
    motion = with_legs(config.first_formation, at_ns=ns(0.0), issuer=1, legs=(FreeLeg(), VelocityLeg(ZERO, 1.0)))
    fault = examine(motion, config.motion_limits, config.first_formation).fault
    assert fault is not None
    assert "never ends, but legs follow" in fault.sentence


def test_another_formation_leaves_it_free_and_any_other_motion_starts_where_the_fleet_is() -> None:
    config = FREE
    motion = free_motion(config)
    seen = going_on(motion, ns(10.0), Ned(30.0, 2.0, -10.0), Ned(0.5, 0.0, 0.0))
    formed = freed(config.motion_into("line", seen, ns(12.0), 0))
    assert formed.free_at(ns(12.0))
    assert examine(formed, config.motion_limits, motion).fault is None
    held = with_legs(seen, at_ns=ns(12.0), issuer=0, legs=(VelocityLeg(ZERO, 0.0),))
    assert held.centre_ned_m == pytest.approx(Ned(31.0, 2.0, -10.0))
    assert held.velocity_ned_m_s == Ned(0.5, 0.0, 0.0)


@pytest.mark.parametrize(
    ("leg", "said"),
    [
        (VelocityLeg(Ned(0.0, 0.0, -0.5), 0.0), "a wish is level"),
        (VelocityLeg(Ned(9.0, 0.0, 0.0), 0.0), "it flies at 9.00 m/s, may 3 m/s"),
        (GotoLeg(Ned(5.0, 0.0, -10.0), 10.0), "nobody has a place that the others share"),
        (FreeLeg(), "nobody has a place that the others share"),
    ],
)
def test_what_cannot_be_wished_is_said(leg: Any, said: str) -> None:
    config = FREE
    assert said in str(One(config, 1, free_motion(config)).agreement.refusal(leg))


def test_a_turn_for_ever_can_be_wished() -> None:
    config = FREE
    assert One(config, 1, free_motion(config)).agreement.refusal(TurnLeg(0.1, inf)) is None
