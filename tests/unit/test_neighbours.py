"""The peer table: what is refused and counted, how peers are predicted, gated, lost and found again."""

from dataclasses import replace
from math import cos, dist, inf, nan, pi, sin

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.failsafe import Failsafe
from companion.core.formation import shape_slots
from companion.core.frames import Ned
from companion.core.monitor import PeerMotion, unheard_error_m
from companion.core.neighbours.gates import GATE_RESIDUAL_M, GATE_VELOCITY_M_S, is_outlier
from companion.core.neighbours.sample import PeerLimits, predict_sample
from companion.core.neighbours.table import (
    FUTURE_LIMIT_S,
    UNCERTAINTY_GROWTH_M_S,
    UNCERTAINTY_GROWTH_MAX_M,
    PeerTable,
)
from companion.core.prediction import PlainHold, PlainKind
from companion.core.safety.filter import nearest_hypothesis
from companion.core.trajectory.fleet import FleetTrajectory
from companion.core.trajectory.history import TrajectoryHistory
from companion.core.trajectory.legs import TurnLeg, VelocityLeg
from companion.core.trajectory.slots import SlotChange
from companion.core.trajectory.successors import with_legs
from companion.core.trigger.near import MISSING_MAX_M, certain_age_s
from companion.core.values import Instant, Neighbour, PeerMessage, PeerSample, Phase

PROPERTY = settings(deadline=None, max_examples=60)
START_NS = 1_790_000_000_000_000_000
ZERO = Ned(0.0, 0.0, 0.0)
MOTION = PeerMotion(
    sigma_p_m=0.01, sigma_v_m_s=0.01, sigma_gust_m_s2=0.0, a_max_m_s2=5.0, deviation_m_s2=12.0, drift_m_s=0.0,
    speed_m_s=8.0, lag_s=0.0, latency_s=0.1, t_min_s=0.05, t_max_s=5.0,
)  # fmt: skip
LIMITS = PeerLimits(
    hold=PlainHold("damped", 0.7), range_m=100.0, stale_after_s=12.0, heartbeat_s=5.7, isolated_flight_s=5.0,
    notice_lost_s=1.5, notice_spread_s=0.5,
    uncertainty_m=0.4, motion=MOTION, digest_size=3,
)  # fmt: skip
OWN = 1


def ns(seconds: float) -> int:
    return START_NS + round(seconds * 1e9)


def at(seconds: float) -> Instant:
    return Instant(round(seconds * 1e9), ns(seconds))


def column_at_1_m_s(count: int = 5, **changed: object) -> FleetTrajectory:
    """Vehicles 1, 2, ... in a column northward at 1 m/s, 4 m apart."""
    slots = shape_slots("column", count, 4.0)
    values: dict[str, object] = {
        "revision": 1, "start_ns": START_NS, "issuer": 0, "shape": "column",
        "slots": {i: SlotChange(s, s) for i, s in enumerate(slots, 1)}, "blend_start_ns": START_NS, "blend_s": 0.0,
        "legs_start_ns": START_NS, "centre_ned_m": Ned(0.0, 0.0, -10.0), "velocity_ned_m_s": Ned(1.0, 0.0, 0.0),
        "heading_rad": 0.0, "heading_rate_rad_s": 0.0, "heading_follows_turns": False, "legs": (),
    }  # fmt: skip
    return FleetTrajectory(**(values | changed))  # type: ignore[arg-type]


def table(motion: FleetTrajectory | None = None, **limits: object) -> PeerTable:
    motion = motion or column_at_1_m_s()
    changed = replace(LIMITS, **limits)  # type: ignore[arg-type]
    return PeerTable(OWN, frozenset(motion.slots) - {OWN}, changed, TrajectoryHistory([motion]))


def sample(t: PeerTable, vehicle: int, seconds: float, phase: Phase = Phase.FORMED, **changed: object) -> PeerSample:
    """Of a vehicle in its slot."""
    r = t.history.reference(vehicle, ns(seconds))
    made = PeerSample(vehicle, ns(seconds), r.position_ned_m, r.velocity_ned_m_s, 1, phase)
    return made._replace(**changed)


def message(s: PeerSample, sequence: int = 1, boot_id: int = 7, digest: tuple[PeerSample, ...] = ()) -> PeerMessage:
    return PeerMessage(boot_id, sequence, START_NS, 0, s, digest)


def predicted(t: PeerTable, seconds: float, gated: bool = False) -> dict[int, Neighbour]:
    now = at(seconds)
    motion = t.history.at(now.fleet_ns)
    moment = motion.state_at(now.fleet_ns)
    own = moment.slot(motion.slots[OWN]).position_ned_m
    return {n.vehicle_id: n for n in t.predict(own, now, moment, gated)}


def places(t: PeerTable, seconds: float, vehicle: int) -> list[Neighbour]:
    """Every place that is kept clear of for one vehicle."""
    now = at(seconds)
    motion = t.history.at(now.fleet_ns)
    moment = motion.state_at(now.fleet_ns)
    found = t.predict(moment.slot(motion.slots[OWN]).position_ned_m, now, moment, False)
    return [n for n in found if n.vehicle_id == vehicle]


# -- what is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"vehicle_id": 9}, "foreign id"),
        ({"vehicle_id": 0}, "foreign id"),
        ({"vehicle_id": OWN}, "own id"),
        ({"position_ned_m": Ned(nan, 0.0, 0.0)}, "not finite"),
        ({"position_ned_m": Ned(0.0, inf, 0.0)}, "not finite"),
        ({"velocity_ned_m_s": Ned(0.0, 0.0, -inf)}, "not finite"),
        ({"velocity_ned_m_s": Ned(0.0, nan, 0.0)}, "not finite"),
        ({"time_ns": ns(10.0 + FUTURE_LIMIT_S + 0.001)}, "from the future"),
        ({"time_ns": ns(10.0 + FUTURE_LIMIT_S)}, None),
        ({"time_ns": ns(10.0 - LIMITS.stale_after_s - 0.001)}, "too old on arrival"),
        ({"time_ns": ns(10.0 - LIMITS.stale_after_s)}, None),
        ({}, None),
    ],
)
def test_a_message_is_taken_or_refused_and_counted(changed: dict[str, object], reason: str | None) -> None:
    t = table()
    assert t.accept(message(sample(t, 2, 10.0, **changed)), at(10.0)) == reason
    assert t.rejected == ({} if reason is None else {reason: 1})
    assert (t.sample(2) is not None) is (reason is None)


def test_a_refused_message_brings_no_digest_and_no_presence() -> None:
    t = table()
    bad = sample(t, 2, 1.0, position_ned_m=Ned(nan, 0.0, 0.0))
    t.accept(message(bad, digest=(sample(t, 3, 0.5),)), at(1.0))
    assert t.sample(3) is None
    assert t.phases() == dict.fromkeys((2, 3, 4, 5))


def test_samples_are_ordered_by_their_time_and_a_repeat_is_refused() -> None:
    t = table()
    t.accept(message(sample(t, 2, 2.0)), at(2.0))
    for seconds in (2.0, 1.0):
        assert t.accept(message(sample(t, 2, seconds)), at(2.5)) == "repeated or out of order"
    assert t.accept(message(sample(t, 2, 2.5)), at(2.5)) is None
    assert t.rejected == {"repeated or out of order": 2}


@pytest.mark.parametrize("forged", [(1 << 31) - 4, (1 << 32) - 1, 0])
def test_a_forged_sequence_number_makes_nobody_deaf(forged: int) -> None:
    t = table()
    t.accept(message(sample(t, 2, 1.0), 5), at(1.0))
    t.accept(message(sample(t, 2, 1.5), forged), at(1.5))
    assert t.accept(message(sample(t, 2, 2.0), 6), at(2.0)) is None
    assert predicted(t, 2.0)[2].in_formation


def test_a_sample_from_slightly_ahead_silences_the_peer_no_longer_than_that() -> None:
    t = table()
    t.accept(message(sample(t, 2, 1.0)), at(1.0))
    t.accept(message(sample(t, 2, 1.0 + FUTURE_LIMIT_S)), at(1.0))
    assert t.accept(message(sample(t, 2, 1.5)), at(1.5)) == "repeated or out of order"
    assert t.accept(message(sample(t, 2, 2.1)), at(2.1)) is None


@PROPERTY
@given(st.lists(st.tuples(st.integers(2, 5), st.floats(0.0, 30.0)), min_size=1, max_size=30))
def test_the_newest_sample_stays_whatever_the_order_of_arrival(arrivals: list[tuple[int, float]]) -> None:
    t = table(stale_after_s=60.0)
    for vehicle, seconds in arrivals:
        t.accept(message(sample(t, vehicle, seconds)), at(30.0))
    for vehicle in {v for v, _ in arrivals}:
        kept = t.sample(vehicle)
        assert kept is not None
        assert kept.time_ns == max(ns(s) for v, s in arrivals if v == vehicle)


# -- digests ---------------------------------------------------------------------------------------------------------


def test_a_digest_is_newest_first_and_bounded() -> None:
    t = table()
    for vehicle, seconds in ((2, 3.0), (3, 9.0), (4, 1.0), (5, 9.0)):
        t.accept(message(sample(t, vehicle, seconds)), at(10.0))
    assert [s.vehicle_id for s in t.digest()] == [3, 5, 2]


def test_a_digest_leaves_the_lost_out() -> None:
    t = table()
    for vehicle in (2, 3):
        t.accept(message(sample(t, vehicle, 1.0)), at(1.0))
    t.presence(2, False, at(2.0))
    assert [s.vehicle_id for s in t.digest()] == [3]


def test_a_peer_heard_only_by_digest_is_a_neighbour_but_not_present() -> None:
    t = table()
    t.accept(message(sample(t, 2, 1.0), digest=(sample(t, 3, 0.9), sample(t, OWN, 0.9))), at(1.0))
    assert predicted(t, 1.1)[3].in_formation
    assert t.phases()[3] is None
    assert t.rejected == {}  # that others pass on what we said is as it should be


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"vehicle_id": 77}, "foreign id"),
        ({"velocity_ned_m_s": Ned(nan, 0.0, 0.0)}, "not finite"),
        ({"time_ns": ns(9.0)}, "from the future"),
    ],
)
def test_bad_hearsay_is_left_out_and_counted_and_the_rest_is_kept(changed: dict[str, object], reason: str) -> None:
    t = table()
    digest = (sample(t, 3, 0.9, **changed), sample(t, 4, 0.8))
    assert t.accept(message(sample(t, 2, 1.0), digest=digest), at(1.0)) is None
    assert t.rejected == {f"digest: {reason}": 1}
    assert t.sample(3) is None
    assert t.sample(4) is not None


# -- prediction ------------------------------------------------------------------------------------------------------

KINDS: tuple[PlainKind, ...] = ("damped", "zero", "first")
displacements = st.builds(Ned, *[st.floats(-3.0, 3.0)] * 3)


@PROPERTY
@given(st.sampled_from(KINDS), st.sampled_from(list(Phase)), displacements, displacements, st.floats(0.0, 11.0))
def test_receiver_predicts_what_the_sender_compares_with(
    kind: PlainKind, phase: Phase, shift: Ned, drift: Ned, age_s: float
) -> None:
    turn = column_at_1_m_s(legs=(TurnLeg(0.1, inf),), heading_follows_turns=True)
    t = table(turn, hold=PlainHold(kind, 0.7))
    r = turn.reference(3, ns(20.0))
    sent = PeerSample(
        3, ns(20.0), Ned(*map(sum, zip(r.position_ned_m, shift, strict=True))),
        Ned(*map(sum, zip(r.velocity_ned_m_s, drift, strict=True))), 1, phase,
    )  # fmt: skip
    t.accept(message(sent), at(20.0))
    sender = predict_sample(
        sent, (r.position_ned_m, r.velocity_ned_m_s), turn.reference(3, ns(20.0 + age_s)), ns(20.0 + age_s), t.limits
    )
    n = predicted(t, 20.0 + age_s)[3]
    assert (n.position_ned_m, n.velocity_ned_m_s, n.told) == sender
    assert n.age_s == pytest.approx(age_s, abs=1e-9)


def test_a_vehicle_in_its_slot_is_predicted_in_its_slot_through_a_turn() -> None:
    turn = column_at_1_m_s(legs=(TurnLeg(0.1, inf),), heading_follows_turns=True)
    t = table(turn)
    t.accept(message(sample(t, 4, 20.0)), at(20.0))
    n, r = predicted(t, 29.0)[4], turn.reference(4, ns(29.0))
    assert n.position_ned_m == pytest.approx(r.position_ned_m, abs=1e-9)
    assert n.velocity_ned_m_s == pytest.approx(r.velocity_ned_m_s, abs=1e-9)
    assert n.reference_velocity_ned_m_s == r.velocity_ned_m_s
    assert n.reference_acceleration_ned_m_s2 == r.acceleration_ned_m_s2
    own = turn.reference(OWN, ns(29.0)).position_ned_m
    assert n.offset_ned_m == pytest.approx([a - b for a, b in zip(own, r.position_ned_m, strict=True)])


def test_a_climbing_peer_stays_over_its_spot_and_comes_to_rest() -> None:
    t = table()
    up = sample(t, 2, 0.0, Phase.CLIMBING, position_ned_m=Ned(5.0, 6.0, -3.0), velocity_ned_m_s=Ned(0.3, 0.0, -1.5))
    t.accept(message(up), at(0.0))
    n = predicted(t, 11.9)[2]
    assert n.position_ned_m == pytest.approx((5.0, 6.0, -6.0), abs=0.01)
    assert n.velocity_ned_m_s == pytest.approx((0.0, 0.0, 0.0), abs=0.01)
    assert not n.in_formation
    assert not n.shares_avoidance
    assert n.last_seen_ned_m is None


def test_a_peer_that_ends_as_it_is_armed_may_be_anywhere_up_to_its_altitude() -> None:
    t = table()
    t.accept(message(sample(t, 2, 0.0, Phase.ARMED, position_ned_m=Ned(5.0, 6.0, 0.0))), at(0.0))
    assert predicted(t, 0.1)[2].last_seen_ned_m is None
    t.presence(2, False, at(0.1))
    n = predicted(t, 5.0)[2]
    assert n.position_ned_m == Ned(5.0, 6.0, -10.0)
    assert n.last_seen_ned_m == Ned(5.0, 6.0, 0.0)
    assert not n.shares_avoidance
    assert n.uncertainty_m > LIMITS.uncertainty_m


def test_a_peer_that_jumps_while_it_stands_armed_does_not_lie() -> None:
    t = table()
    for k, north in enumerate((0.0, 3.0)):
        there = sample(t, 2, 0.5 * k, Phase.ARMED, position_ned_m=Ned(north, 0.0, 0.0))
        t.accept(message(there, k + 1), at(0.5 * k))
    assert t.rejected == {}


def test_a_silent_peer_that_climbed_or_landed_is_somewhere_in_its_column() -> None:
    for phase, end in ((Phase.CLIMBING, -10.0), (Phase.LANDING, 0.0)):
        t = table()
        t.accept(message(sample(t, 2, 0.0, phase, position_ned_m=Ned(5.0, 6.0, -3.0))), at(0.0))
        assert predicted(t, 11.9)[2].last_seen_ned_m is None
        n = predicted(t, 12.5)[2]
        assert n.position_ned_m == Ned(5.0, 6.0, end)
        assert n.last_seen_ned_m == Ned(5.0, 6.0, -3.0)
        assert n.uncertainty_m > LIMITS.uncertainty_m


@pytest.mark.parametrize("phase", [Phase.RELEASED, Phase.DETACHED, Phase.IDLE])
def test_a_peer_that_follows_no_plan_is_predicted_by_its_own_velocity_which_fades(phase: Phase) -> None:
    t = table()
    v = Ned(1.0, -0.5, 0.2)
    t.accept(message(sample(t, 2, 0.0, phase, position_ned_m=Ned(5.0, 6.0, -3.0), velocity_ned_m_s=v)), at(0.0))
    n = predicted(t, 0.1)[2]
    assert n.position_ned_m == pytest.approx((5.1, 5.95, -2.98), abs=0.01)
    assert n.velocity_ned_m_s == pytest.approx(v, rel=0.06)
    assert predicted(t, 11.0)[2].position_ned_m == pytest.approx((7.0, 5.0, -2.6), abs=0.02)
    assert not n.in_formation
    assert not n.shares_avoidance


# -- peers that cannot be right --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shift_m", "faster_m_s", "lies"), [(1.4, 0.0, False), (1.8, 0.0, True), (0.0, 4.9, False), (0.0, 5.2, True)]
)
def test_a_peer_whose_state_no_motion_explains_is_kept_away_from_for_a_while(
    shift_m: float, faster_m_s: float, lies: bool
) -> None:
    # Half a second at 8 m/s^2 explains 1 m and 4 m/s; one of each is the margin. The plan's own motion is 0.5 m.
    t = table()
    t.accept(message(sample(t, 2, 1.0), 1), at(1.0))
    s = sample(t, 2, 1.5)
    p, v = s.position_ned_m, s.velocity_ned_m_s
    s = s._replace(position_ned_m=p._replace(east=p.east + shift_m + 0.3 * (shift_m > 0)),
                   velocity_ned_m_s=v._replace(east=v.east + faster_m_s))  # fmt: skip
    t.accept(message(s, 2), at(1.5))
    n = predicted(t, 1.6)[2]
    assert n.in_formation is n.shares_avoidance is not lies
    assert t.rejected == ({"a peer's state jumps": 1} if lies else {})
    assert len(places(t, 1.6, 2)) == (2 if lies else 1)
    # A while later what it says is a motion that both explain.
    later = sample(t, 2, 6.0)
    t.accept(message(moved(later, east=1.0), 3), at(6.0))
    assert predicted(t, 6.0)[2].in_formation
    assert len(places(t, 6.0, 2)) == 1


def test_of_two_places_the_one_that_is_not_told_of_is_left_after_as_long_as_a_peer_may_be_silent() -> None:
    t = table()
    t.accept(message(sample(t, 2, 1.0), 1), at(1.0))
    for k, seconds in enumerate((2.5, 7.0, 12.0, 14.4)):
        t.accept(message(moved(sample(t, 2, seconds), east=9.0), 2 + k), at(seconds))
        assert len(places(t, seconds, 2)) == 2
    assert not predicted(t, 14.4)[2].in_formation
    (n,) = places(t, 14.6, 2)
    assert n.in_formation
    assert n.position_ned_m.east == pytest.approx(9.0)


def test_a_peer_that_moves_without_changing_its_position_is_not_used() -> None:
    t = table()
    first = sample(t, 2, 1.0)
    for k, seconds in enumerate((1.0, 1.2, 1.4)):
        t.accept(message(first._replace(time_ns=ns(seconds)), k), at(seconds))
    assert predicted(t, 1.4)[2].in_formation
    t.accept(message(first._replace(time_ns=ns(1.5)), 9), at(1.5))
    assert not predicted(t, 1.5)[2].in_formation
    assert t.rejected == {"a peer's position frozen": 1}


def test_a_peer_that_stands_still_is_healthy() -> None:
    t = table()
    first = sample(t, 2, 1.0, velocity_ned_m_s=ZERO)
    for k in range(9):
        t.accept(message(first._replace(time_ns=ns(1.0 + k)), k), at(1.0 + k))
    assert predicted(t, 9.0)[2].in_formation
    assert t.rejected == {}


@pytest.mark.parametrize("phase", [Phase.PREFLIGHT, Phase.LANDED])
def test_a_peer_that_is_not_ours_to_move_is_where_it_was(phase: Phase) -> None:
    t = table()
    t.accept(message(sample(t, 2, 0.0, phase)), at(0.0))
    n = predicted(t, 9.0)[2]
    assert n.position_ned_m == t.history.reference(2, ns(0.0)).position_ned_m
    assert n.velocity_ned_m_s == ZERO
    assert not n.shares_avoidance


def test_neighbours_come_in_the_order_of_their_ids_and_only_those_ever_heard() -> None:
    t = table()
    for vehicle in (5, 2, 4):
        t.accept(message(sample(t, vehicle, 1.0)), at(1.0))
    assert list(predicted(t, 1.0)) == [2, 4, 5]


@pytest.mark.parametrize(("range_m", "heard"), [(7.999, [2]), (8.001, [2, 3]), (12.001, [2, 3, 4])])
def test_only_peers_within_range_are_neighbours(range_m: float, heard: list[int]) -> None:
    t = table(range_m=range_m)
    for vehicle in (2, 3, 4, 5):
        t.accept(message(sample(t, vehicle, 1.0)), at(1.0))
    assert list(predicted(t, 1.0)) == heard


def test_a_sample_from_slightly_ahead_counts_as_new() -> None:
    t = table()
    s = sample(t, 2, 5.5)
    t.accept(message(s), at(5.0))
    n = predicted(t, 5.0)[2]
    assert n.age_s == 0.0
    assert n.position_ned_m == pytest.approx(t.history.reference(2, ns(5.0)).position_ned_m)


def test_after_a_new_motion_old_samples_are_held_under_it() -> None:
    t = table()
    t.accept(message(sample(t, 2, 5.0)), at(5.0))
    t.history.adopt(with_legs(t.history.newest, at_ns=ns(4.0), issuer=1, legs=(VelocityLeg(ZERO, 0.0),)))
    t.plan_changed()
    s = t.sample(2)
    assert s is not None
    then, now = (t.history.reference(2, ns(x)) for x in (5.0, 9.0))
    expected = predict_sample(s, (then.position_ned_m, then.velocity_ned_m_s), now, ns(9.0), t.limits)
    n = predicted(t, 9.0)[2]
    assert (n.position_ned_m, n.velocity_ned_m_s, n.told) == expected


# -- gates -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("velocity", "residual", "outlier"),
    [
        ((GATE_VELOCITY_M_S - 1e-6, 0.0), (0.0, 0.0), False),
        ((GATE_VELOCITY_M_S + 1e-6, 0.0), (0.0, 0.0), True),
        ((0.5, -0.5), (0.0, 0.0), True),
        ((0.0, 0.0), (0.0, GATE_RESIDUAL_M - 1e-6), False),
        ((0.0, 0.0), (0.0, GATE_RESIDUAL_M + 1e-6), True),
        ((0.6, 0.0), (1.9, 0.0), False),
        ((0.0, 0.0), (-1.5, 1.5), True),
    ],
)
def test_gates_at_their_limits(velocity: tuple[float, float], residual: tuple[float, float], outlier: bool) -> None:
    assert is_outlier(*velocity, *residual) is outlier


def with_one_off(t: PeerTable, shift: Ned, drift: Ned) -> PeerTable:
    for vehicle in (2, 3, 4, 5):
        s = sample(t, vehicle, 10.0)
        if vehicle == 3:
            s = s._replace(position_ned_m=Ned(*map(sum, zip(s.position_ned_m, shift, strict=True))),
                velocity_ned_m_s=Ned(*map(sum, zip(s.velocity_ned_m_s, drift, strict=True))),
            )  # fmt: skip
        t.accept(message(s), at(10.0))
    return t


@pytest.mark.parametrize(
    ("shift", "drift", "taking_part"),
    [
        (ZERO, ZERO, True),
        (Ned(0.0, 1.99, 0.0), ZERO, True),
        (Ned(0.0, 2.01, 0.0), ZERO, False),
        (ZERO, Ned(0.0, 0.69, 0.0), True),
        (ZERO, Ned(-0.71, 0.0, 0.0), False),
        (Ned(0.0, 0.0, 9.0), Ned(0.0, 0.0, 3.0), True),  # altitude is not the law's
    ],
)
def test_a_formed_vehicle_gates_a_peer_that_is_off(shift: Ned, drift: Ned, taking_part: bool) -> None:
    t = with_one_off(table(), shift, drift)
    gated = predicted(t, 10.0, gated=True)
    assert gated[3].in_formation is taking_part
    assert gated[3].shares_avoidance  # and it counts for separation as before
    assert gated[3]._replace(in_formation=True) == predicted(t, 10.0)[3]
    assert all(gated[k].in_formation for k in (2, 4, 5))


def test_while_forming_nobody_is_gated() -> None:
    t = with_one_off(table(), Ned(0.0, 30.0, 0.0), Ned(3.0, 0.0, 0.0))
    assert all(n.in_formation for n in predicted(t, 10.0).values())


def test_the_outer_slots_of_a_turning_formation_are_not_gated_for_their_speed() -> None:
    """Vehicle 5 is 16 m behind: at 0.1 rad/s its slot moves at 1.6 m/s against the own one."""
    turn = column_at_1_m_s(legs=(TurnLeg(0.1, inf),), heading_follows_turns=True)
    t = table(turn)
    for vehicle in (2, 3, 4, 5):
        t.accept(message(sample(t, vehicle, 30.0)), at(30.0))
    neighbours = predicted(t, 30.0, gated=True)
    assert dist(neighbours[5].velocity_ned_m_s, turn.reference(OWN, ns(30.0)).velocity_ned_m_s) > 1.5
    assert all(n.in_formation for n in neighbours.values())


def test_gating_with_nobody_or_one_peer_gates_nobody() -> None:
    assert predicted(table(), 1.0, gated=True) == {}
    t = table()
    s = sample(t, 2, 1.0)
    t.accept(message(s._replace(position_ned_m=Ned(50.0, 0.0, 0.0))), at(1.0))
    assert predicted(t, 1.0, gated=True)[2].in_formation


# -- near mode -------------------------------------------------------------------------------------------------------


def test_of_a_peer_in_near_mode_a_missing_message_is_known_and_its_uncertainty_grows_until_it_is_heard() -> None:
    t = table()
    t.accept(replace(message(sample(t, 2, 0.0)), due_soon=True), at(0.0))
    assert predicted(t, 0.1)[2].uncertainty_m == LIMITS.uncertainty_m
    assert predicted(t, 0.3)[2].uncertainty_m == pytest.approx(unheard_error_m(0.3, MOTION))
    assert predicted(t, 0.35)[2].uncertainty_m > LIMITS.uncertainty_m + 0.3
    assert predicted(t, 3.0)[2].uncertainty_m == LIMITS.uncertainty_m + MISSING_MAX_M
    t.accept(replace(message(sample(t, 2, 3.0), sequence=2), due_soon=True), at(3.0))
    assert predicted(t, 3.1)[2].uncertainty_m == LIMITS.uncertainty_m


def test_of_any_other_peer_silence_means_nothing() -> None:
    t = table()
    t.accept(message(sample(t, 2, 0.0)), at(0.0))
    assert predicted(t, 3.0)[2].uncertainty_m == LIMITS.uncertainty_m


def test_a_peer_that_leaves_near_mode_is_not_missed() -> None:
    t = table()
    t.accept(replace(message(sample(t, 2, 0.0)), due_soon=True), at(0.0))
    t.accept(message(sample(t, 2, 0.1), sequence=2), at(0.1))
    assert predicted(t, 3.0)[2].uncertainty_m == LIMITS.uncertainty_m


def test_what_others_pass_on_of_a_near_peer_stands_for_its_missing_message() -> None:
    t = table()
    t.accept(replace(message(sample(t, 2, 0.0)), due_soon=True), at(0.0))
    t.accept(message(sample(t, 3, 0.4), digest=(sample(t, 2, 0.4),)), at(0.4))
    assert predicted(t, 0.5)[2].uncertainty_m == LIMITS.uncertainty_m


def test_a_lost_peer_that_spoke_in_near_mode_is_held_as_lost_and_not_as_late() -> None:
    t = table()
    t.accept(replace(message(sample(t, 2, 0.0)), due_soon=True), at(0.0))
    t.presence(2, False, at(1.0))
    n = predicted(t, 2.0)[2]
    assert n.last_seen_ned_m is not None
    assert n.uncertainty_m == pytest.approx(LIMITS.uncertainty_m + UNCERTAINTY_GROWTH_M_S)


def test_the_age_up_to_which_the_bound_is_certain_is_where_it_reaches_its_cap() -> None:
    age_s = certain_age_s(LIMITS.uncertainty_m, MOTION)
    assert unheard_error_m(age_s, MOTION) == pytest.approx(LIMITS.uncertainty_m + MISSING_MAX_M)


# -- the lost --------------------------------------------------------------------------------------------------------


def test_a_peer_goes_stale_just_after_its_time() -> None:
    t = table()
    t.accept(message(sample(t, 2, 0.0)), at(0.0))
    fresh = predicted(t, 12.0)[2]
    assert fresh.in_formation
    assert fresh.uncertainty_m == 0.4
    stale = predicted(t, 12.001)[2]
    assert not stale.in_formation
    assert not stale.shares_avoidance
    assert t.phases()[2] is None


def test_a_silent_peer_may_have_stopped_right_after_its_last_sample() -> None:
    t = table()
    s = sample(t, 2, 0.0)
    t.accept(message(s), at(0.0))
    n = predicted(t, 14.0)[2]
    assert n.last_seen_ned_m == pytest.approx(s.position_ned_m)
    assert n.position_ned_m == pytest.approx(t.history.reference(2, ns(14.0)).position_ned_m)
    assert n.velocity_ned_m_s == pytest.approx((1.0, 0.0, 0.0))


def test_a_peer_whose_presence_ended_flew_on_until_shortly_before() -> None:
    t = table()
    t.accept(message(sample(t, 2, 0.0)), at(0.0))
    t.presence(2, False, at(6.0))
    n = predicted(t, 8.0)[2]
    stopped = t.history.reference(2, ns(6.0 - LIMITS.notice_lost_s)).position_ned_m
    assert n.last_seen_ned_m == pytest.approx(stopped)
    assert n.position_ned_m == pytest.approx(t.history.reference(2, ns(8.0)).position_ned_m)
    assert not n.shares_avoidance


def test_a_peer_heard_just_before_its_end_did_not_stop_before_that() -> None:
    t = table()
    s = sample(t, 2, 5.8)
    t.accept(message(s), at(5.8))
    t.presence(2, False, at(6.0))
    assert predicted(t, 6.0)[2].last_seen_ned_m == pytest.approx(s.position_ned_m)


def test_a_lost_peer_flies_on_no_longer_than_it_would_alone_and_notices_it_later() -> None:
    t = table()
    t.accept(message(sample(t, 2, 0.0)), at(0.0))
    t.presence(2, False, at(1.0))
    last = t.history.reference(2, ns(1.0 + LIMITS.notice_spread_s + LIMITS.isolated_flight_s)).position_ned_m
    for seconds in (6.5, 7.5, 60.0):
        n = predicted(t, seconds)[2]
        assert n.position_ned_m == pytest.approx(last)
        assert n.velocity_ned_m_s == ZERO


@pytest.mark.parametrize("since_s", [0.0, 1.0, 3.0, 3.34, 60.0])
def test_uncertainty_of_a_lost_peer_grows_to_its_cap(since_s: float) -> None:
    t = table()
    t.accept(message(sample(t, 2, 0.0)), at(0.0))
    t.presence(2, False, at(1.0))
    grown = min(UNCERTAINTY_GROWTH_M_S * since_s, UNCERTAINTY_GROWTH_MAX_M)
    assert predicted(t, 1.0 + since_s)[2].uncertainty_m == pytest.approx(0.4 + grown)


def test_a_lost_peer_is_a_neighbour_while_either_of_its_ends_is_in_range() -> None:
    t = table(range_m=6.0)
    t.accept(message(sample(t, 2, 0.0)), at(0.0))
    t.presence(2, False, at(0.5))
    now = at(20.0)
    moment = t.history.newest.state_at(now.fleet_ns)
    last, stopped = (t.history.reference(2, ns(x)).position_ned_m for x in (5.5, 0.0))
    beyond = Ned(last.north + 5.9, last.east, last.down)
    behind = Ned(stopped.north - 5.9, stopped.east, stopped.down)
    assert [len(t.predict(ego, now, moment, False)) for ego in (beyond, behind)] == [1, 1]
    out = Ned(stopped.north - 6.1, stopped.east, stopped.down)
    assert t.predict(out, now, moment, False) == []


@pytest.mark.parametrize(("beside_m", "heard"), [(0.9, 1), (0.999, 1), (1.001, 0), (1.5, 0)])
def test_a_lost_peer_is_a_neighbour_beside_the_middle_of_its_line(beside_m: float, heard: int) -> None:
    """Both its ends are out of range; somewhere between them it may be within."""
    t = table(range_m=1.0)
    t.accept(message(sample(t, 2, 0.0)), at(0.0))
    t.presence(2, False, at(0.5))
    now = at(20.0)
    last, stopped = (t.history.reference(2, ns(x)).position_ned_m for x in (5.5, 0.0))
    assert dist(last, stopped) > 3.0
    middle = [0.5 * (a + b) for a, b in zip(last, stopped, strict=True)]
    ego = Ned(middle[0], middle[1], middle[2] - beside_m)
    assert len(t.predict(ego, now, t.history.newest.state_at(now.fleet_ns), False)) == heard


@pytest.mark.parametrize("phase", [Phase.LANDED, Phase.PREFLIGHT, Phase.IDLE])
def test_a_lost_peer_that_stood_on_the_ground_has_one_place(phase: Phase) -> None:
    t = table()
    pad = Ned(4.0, 0.0, -1.0)
    t.accept(message(sample(t, 2, 0.0, phase, position_ned_m=pad, velocity_ned_m_s=ZERO)), at(0.0))
    t.presence(2, False, at(1.0))
    n = predicted(t, 30.0)[2]
    assert n.last_seen_ned_m is None
    assert n.position_ned_m == pad


def test_a_lost_peer_whose_companion_had_started_in_flight_is_there_or_beneath() -> None:
    t = table()
    there = Ned(4.0, 0.0, -8.0)
    t.accept(message(sample(t, 2, 0.0, Phase.IDLE, position_ned_m=there, velocity_ned_m_s=ZERO)), at(0.0))
    assert predicted(t, 1.0)[2].last_seen_ned_m is None
    t.presence(2, False, at(1.0))
    n = predicted(t, 30.0)[2]
    assert {n.position_ned_m, n.last_seen_ned_m} == {there, there._replace(down=0.0)}


def lost_by_presence(**limits: object) -> PeerTable:
    t = table(**limits)
    t.accept(message(sample(t, 2, 0.0), 1), at(0.0))
    t.presence(2, False, at(6.0))
    return t


def test_a_lost_peer_comes_back_with_a_new_message_and_not_by_its_presence_alone() -> None:
    t = lost_by_presence()
    t.presence(2, True, at(7.0))
    assert not predicted(t, 7.0)[2].in_formation
    assert t.phases()[2] is None
    t.accept(message(sample(t, 2, 7.5), 2), at(7.5))
    assert predicted(t, 7.5)[2].in_formation
    t = lost_by_presence()
    t.accept(message(sample(t, 2, 7.0), 2), at(7.0))
    assert predicted(t, 7.0)[2].in_formation
    assert t.phases()[2] is Phase.FORMED
    t = lost_by_presence()
    t.accept(message(sample(t, 2, 5.0), 0, boot_id=8), at(7.0))  # restarted
    assert predicted(t, 7.0)[2].in_formation


def test_a_late_message_from_before_its_end_brings_nobody_back() -> None:
    t = lost_by_presence()
    assert t.accept(message(sample(t, 2, 5.5), 2), at(6.5)) is None
    n = predicted(t, 7.0)[2]
    assert not n.in_formation
    assert n.last_seen_ned_m == pytest.approx(t.history.reference(2, ns(5.5)).position_ned_m)
    assert t.phases()[2] is None


@pytest.mark.parametrize(("seconds", "back"), [(5.9, False), (6.1, True)])
def test_hearsay_brings_a_lost_peer_back_if_it_is_younger_than_the_loss(seconds: float, back: bool) -> None:
    t = lost_by_presence()
    t.accept(message(sample(t, 3, 7.0), digest=(sample(t, 2, seconds),)), at(7.0))
    assert predicted(t, 7.0)[2].in_formation is back


def test_hearsay_brings_a_silent_peer_back() -> None:
    t = table()
    t.accept(message(sample(t, 2, 0.0)), at(0.0))
    assert not predicted(t, 13.0)[2].in_formation
    t.accept(message(sample(t, 3, 13.0), digest=(sample(t, 2, 9.0),)), at(13.0))
    n = predicted(t, 13.0)[2]
    assert n.in_formation
    assert n.last_seen_ned_m is None


# -- one examination for every sample ----------------------------------------------------------------------------------


def moved(s: PeerSample, north: float = 0.0, east: float = 0.0, down: float = 0.0) -> PeerSample:
    p = s.position_ned_m
    return s._replace(position_ned_m=Ned(p.north + north, p.east + east, p.down + down))


def heard(t: PeerTable, vehicle: int = 2, until_s: int = 4) -> PeerTable:
    for second in range(1, until_s + 1):
        t.accept(message(sample(t, vehicle, float(second)), second), at(float(second)))
    return t


@pytest.mark.parametrize("boot_id", [7, 8])
@pytest.mark.parametrize("phase", [Phase.FORMED, Phase.DETACHED, Phase.LANDED, Phase.IDLE])
def test_a_state_that_nothing_explains_is_another_place_beside_the_old_one(boot_id: int, phase: Phase) -> None:
    t = heard(table())
    lie = moved(sample(t, 2, 5.0, phase), north=30.0)
    assert t.accept(message(lie, 6, boot_id), at(5.0)) is None
    told, kept = places(t, 5.0, 2)
    assert told.position_ned_m == pytest.approx(lie.position_ned_m)
    assert kept.position_ned_m == pytest.approx(sample(t, 2, 5.0).position_ned_m)
    assert not any(n.in_formation or n.shares_avoidance for n in (told, kept))
    assert t.rejected["a peer's state jumps"] == 1
    # Its own next word decides nothing yet, and later everything.
    assert t.accept(message(sample(t, 2, 5.5), 7), at(5.5)) is None
    assert len(places(t, 5.5, 2)) == 2


@pytest.mark.parametrize("phase", [Phase.LANDED, Phase.IDLE])
def test_nobody_is_believed_to_have_landed_without_a_landing(phase: Phase) -> None:
    t = heard(table())
    t.accept(message(sample(t, 2, 4.5, phase, velocity_ned_m_s=ZERO), 5), at(4.5))
    aloft = [n for n in places(t, 5.0, 2) if n.velocity_ned_m_s.north > 0.9] if phase is Phase.LANDED else [1]
    assert aloft, "it is still flown around where it should be"


def test_a_landing_that_is_told_of_is_believed() -> None:
    t = heard(table())
    where = sample(t, 2, 4.5).position_ned_m
    for k, (seconds, phase, down) in enumerate(
        ((4.5, Phase.LANDING, -10.0), (9.0, Phase.LANDING, -7.0), (13.0, Phase.LANDED, -5.0))
    ):
        t.accept(
            message(
                sample(
                    t, 2, seconds, phase, position_ned_m=where._replace(down=down), velocity_ned_m_s=Ned(0.0, 0.0, 1.0)
                ),
                5 + k,
            ),
            at(seconds),
        )
    assert len(places(t, 13.0, 2)) == 1
    assert t.phases()[2] is Phase.LANDED
    assert t.rejected == {}


def test_a_digest_opens_no_place_and_moves_nobody_far() -> None:
    t = heard(table())
    for k, lie in enumerate((
        moved(sample(t, 2, 4.5), north=30.0),
        moved(sample(t, 2, 4.5), north=2.5),
        sample(t, 2, 4.5, Phase.LANDED),
        sample(t, 2, 4.5, Phase.LANDING),
    )):  # fmt: skip
        assert t.accept(message(sample(t, 3, 4.6 + 0.1 * k), k, digest=(lie,)), at(5.0)) is None
    assert t.rejected == {"digest: contradicts what was heard": 4}
    (n,) = places(t, 5.0, 2)
    assert n.in_formation
    assert n.position_ned_m == pytest.approx(sample(t, 2, 5.0).position_ned_m)
    # Within what a message would have told, and step after step, it is taken, but never further from what was heard.
    for k in range(40):
        creep = moved(sample(t, 2, 5.0 + 0.02 * k), north=0.1 * k)
        t.accept(message(sample(t, 3, 5.0 + 0.02 * k), 9 + k, digest=(creep,)), at(6.0))
    (n,) = places(t, 6.0, 2)
    assert 1.0 < dist(n.position_ned_m, sample(t, 2, 6.0).position_ned_m) <= 2.01


def test_two_processes_under_one_id_are_a_fault_of_that_id() -> None:
    t = table()
    for k in range(4):
        t.accept(message(sample(t, 2, 1.0 + k), k, boot_id=(7, 8)[k % 2]), at(1.0 + k))
    assert t.rejected == {"two sources under one id": 1}
    assert [e.failsafe for e in t.events] == [Failsafe.TWO_SOURCES]
    (n,) = places(t, 4.0, 2)
    assert not n.in_formation
    assert not n.shares_avoidance
    t.accept(message(sample(t, 2, 9.0), 9, boot_id=8), at(9.0))
    assert not predicted(t, 14.9)[2].in_formation
    assert predicted(t, 15.1)[2].in_formation


def test_a_peer_that_restarts_is_one_source() -> None:
    t = heard(table())
    for k in range(3):
        t.accept(message(sample(t, 2, 5.0 + k), k, boot_id=8), at(5.0 + k))
    assert t.accept(message(sample(t, 2, 4.5), 5, boot_id=7), at(7.0)) == "repeated or out of order"
    assert t.rejected == {"repeated or out of order": 1}
    assert predicted(t, 7.0)[2].in_formation


def test_a_flood_of_places_does_not_push_out_the_one_that_lasted() -> None:
    t = heard(table())
    for k in range(20):
        t.accept(message(moved(sample(t, 2, 4.1 + 0.01 * k), north=20.0 * (k + 2)), k, boot_id=k), at(5.0))
    truth = sample(t, 2, 5.0).position_ned_m
    assert min(dist(n.position_ned_m, truth) for n in places(t, 5.0, 2)) < 0.01
    assert len(places(t, 5.0, 2)) <= 3


def test_one_lost_in_the_air_that_tells_from_the_ground_elsewhere_is_believed_after_two_minutes() -> None:
    t = lost_by_presence(range_m=300.0)
    t.presence(2, True, at(8.0))
    pad = Ned(-20.0, 5.0, 0.0)
    for second in range(8, 135, 5):
        t.accept(
            message(sample(t, 2, float(second), Phase.IDLE, position_ned_m=pad, velocity_ned_m_s=ZERO), second, 8),
            at(float(second)),
        )
        found = places(t, float(second), 2)
        assert len(found) == (2 if second <= 128 else 1)
        assert found[0].position_ned_m == pad
    assert t.phases()[2] is Phase.IDLE


@pytest.mark.parametrize("down", [-10.0, -4.0, 0.0])
def test_one_lost_in_the_air_comes_back_near_where_it_may_be_or_beneath(down: float) -> None:
    t = lost_by_presence()
    near = Ned(8.0, 3.0, down)
    t.accept(message(sample(t, 2, 20.0, Phase.IDLE, position_ned_m=near, velocity_ned_m_s=ZERO), 1, 8), at(20.0))
    (n,) = places(t, 20.0, 2)
    assert n.position_ned_m == near
    assert n.last_seen_ned_m is None


# -- the path of the lost, and who hears nobody ------------------------------------------------------------------------


def test_a_peer_lost_in_a_turn_is_kept_clear_of_along_its_arc_and_not_its_chord() -> None:
    turn = column_at_1_m_s(legs=(TurnLeg(0.2, inf),))
    t = table(turn, isolated_flight_s=20.0)
    t.accept(message(sample(t, 2, 20.0)), at(20.0))
    t.presence(2, False, at(21.0))
    now = at(34.0)
    moment = turn.state_at(now.fleet_ns)
    for second in range(20, 35):
        on_the_arc = turn.reference(2, ns(float(second))).position_ned_m
        (n,) = (n for n in t.predict(on_the_arc, now, moment, False) if n.vehicle_id == 2)
        assert n.last_seen_ned_m is not None
        assert dist(n.position_ned_m, n.last_seen_ned_m) <= 0.201
        assert dist(nearest_hypothesis(on_the_arc, n)[0], on_the_arc) < 0.03
    a, b = (turn.reference(2, ns(x)).position_ned_m for x in (20.0, 34.0))
    middle = Ned(*(0.5 * (x + y) for x, y in zip(a, b, strict=True)))
    (n,) = (n for n in t.predict(middle, now, moment, False) if n.vehicle_id == 2)
    assert dist(nearest_hypothesis(middle, n)[0], middle) > 3.0
    end = turn.reference(2, now.fleet_ns)
    _, velocity = nearest_hypothesis(end.position_ned_m, t.predict(end.position_ned_m, now, moment, False)[0])
    assert velocity == pytest.approx(end.velocity_ned_m_s, abs=0.05)


def test_who_hears_nobody_is_deaf_when_heartbeats_of_all_are_missing() -> None:
    t = table(heartbeat_s=5.0, stale_after_s=12.0, isolated_flight_s=3.0)
    for k, vehicle in enumerate((2, 3, 4, 5)):
        t.accept(message(sample(t, vehicle, 1.0 + k)), at(1.0 + k))
    assert not t.deaf(at(19.0))
    assert t.deaf(at(19.1))  # 4 s, and 15 s more
    # Nobody is lost before it, too, has heard nobody for so long; then it stood no earlier.
    assert len([n for i, n in predicted(t, 17.9).items() if n.in_formation]) == 4
    lost = predicted(t, 19.1)
    assert not any(n.in_formation for n in lost.values())
    assert lost[3].last_seen_ned_m == pytest.approx(t.history.reference(3, ns(19.0)).position_ned_m)
    assert lost[5].last_seen_ned_m == pytest.approx(t.history.reference(5, ns(18.0)).position_ned_m)
    t.accept(message(sample(t, 4, 20.0)), at(20.0))
    assert not t.deaf(at(20.0))


@pytest.mark.parametrize(("count", "after_s"), [(3, 26.0), (5, 26.0), (10, 13.8), (13, 10.5), (30, 10.5)])
def test_the_more_peers_are_to_be_heard_the_sooner_their_silence_is_no_chance(count: int, after_s: float) -> None:
    t = table(column_at_1_m_s(count), heartbeat_s=10.0, stale_after_s=21.0)
    for vehicle in range(2, count + 1):
        t.accept(message(sample(t, vehicle, 1.0)), at(1.0))
    assert not t.deaf(at(0.9 + after_s))
    assert t.deaf(at(1.1 + after_s))


def test_one_that_alone_is_silent_may_have_stopped_at_any_time() -> None:
    t = table()
    for vehicle in (2, 3, 4):
        t.accept(message(sample(t, vehicle, 1.0)), at(1.0))
    for second in range(5, 20, 4):
        for vehicle in (3, 4):
            t.accept(message(sample(t, vehicle, float(second)), second), at(float(second)))
    found = predicted(t, 18.0)
    assert found[2].last_seen_ned_m == pytest.approx(t.history.reference(2, ns(1.0)).position_ned_m)
    assert found[3].in_formation
    assert not t.deaf(at(18.0))


def test_of_two_vehicles_none_is_deaf() -> None:
    t = table(column_at_1_m_s(2))
    t.accept(message(sample(t, 2, 1.0)), at(1.0))
    assert not t.deaf(at(100.0))


def test_presence_of_strangers_is_counted_and_of_oneself_ignored() -> None:
    t = table()
    t.presence(99, True, at(0.0))
    t.presence(OWN, False, at(0.0))
    assert t.rejected == {"foreign id": 1}


def test_silence_is_counted_from_the_last_peers_end() -> None:
    t = table()
    assert t.silent_for_s(at(0.0)) is None
    assert t.oldest_age_s(at(0.0)) is None
    for vehicle in (2, 3):
        t.accept(message(sample(t, vehicle, float(vehicle))), at(4.0))
    assert t.silent_for_s(at(5.0)) == 0.0
    assert t.oldest_age_s(at(5.0)) == pytest.approx(3.0)
    t.presence(2, False, at(6.0))
    assert t.silent_for_s(at(7.0)) == 0.0
    t.presence(3, False, at(8.0))
    assert t.silent_for_s(at(10.5)) == pytest.approx(2.5)


@PROPERTY
@given(st.floats(-pi, pi), st.floats(0.0, 30.0), displacements)
def test_predictions_turn_and_shift_with_the_whole_scene(angle: float, seconds: float, shift: Ned) -> None:
    c, s = cos(angle), sin(angle)

    def turned(v: Ned, by: Ned = ZERO) -> Ned:
        return Ned(c * v.north - s * v.east + by.north, s * v.north + c * v.east + by.east, v.down + by.down)

    plain = column_at_1_m_s()
    moved = column_at_1_m_s(
        centre_ned_m=turned(plain.centre_ned_m, shift), velocity_ned_m_s=turned(plain.velocity_ned_m_s),
        heading_rad=angle,
    )  # fmt: skip
    results = []
    for motion, is_moved in ((plain, False), (moved, True)):
        t = table(motion)
        p, v = Ned(3.0, 1.0, -9.0), Ned(1.3, 0.2, 0.1)
        if is_moved:
            p, v = turned(p, shift), turned(v)
        t.accept(message(sample(t, 2, 1.0, position_ned_m=p, velocity_ned_m_s=v)), at(1.0))
        results.append(predicted(t, 1.0 + seconds)[2])
    a, b = results
    assert b.position_ned_m == pytest.approx(turned(a.position_ned_m, shift), abs=1e-8)
    assert b.velocity_ned_m_s == pytest.approx(turned(a.velocity_ned_m_s), abs=1e-9)
    assert b.offset_ned_m == pytest.approx(turned(a.offset_ned_m), abs=1e-8)
