"""Plans: smooth in themselves and where they replace each other, ordered, and the same on every vehicle."""

import random
from itertools import pairwise, permutations
from math import atan2, cos, dist, hypot, inf, pi, sin, sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.formation import shape_slots
from companion.core.frames import Ned
from companion.core.trajectory.fleet import FleetTrajectory
from companion.core.trajectory.goto import goto_duration_s, goto_peaks
from companion.core.trajectory.history import TrajectoryHistory
from companion.core.trajectory.legs import (
    PLAN_ACCELERATION_M_S2,
    TURN_RAMP_S,
    GotoLeg,
    Leg,
    TurnLeg,
    VelocityLeg,
    leg_duration_s,
)
from companion.core.trajectory.polynomials import minimum_jerk
from companion.core.trajectory.slots import BLEND_MIN_S, SlotChange, blend_duration_s
from companion.core.trajectory.successors import assignment_matches, with_formation, with_legs

PROPERTY = settings(deadline=None, max_examples=40)
START_NS = 1_790_000_000_000_000_000
ZERO = Ned(0.0, 0.0, 0.0)
velocities = st.builds(Ned, st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-0.5, 0.5))
places = st.builds(Ned, st.floats(-60.0, 60.0), st.floats(-60.0, 60.0), st.floats(-20.0, 0.0))
offsets = st.builds(Ned, st.floats(-15.0, 15.0), st.floats(-15.0, 15.0), st.floats(-3.0, 3.0))
rates = st.one_of(st.floats(0.03, 0.5), st.floats(-0.5, -0.03))
legs: st.SearchStrategy[Leg] = st.one_of(
    st.builds(VelocityLeg, velocities, st.floats(0.0, 30.0)),
    st.builds(TurnLeg, rates, st.floats(0.01, 8.0)),
    st.builds(GotoLeg, places, st.floats(5.0, 40.0)),
)


def ns(seconds: float) -> int:
    return START_NS + round(seconds * 1e9)


def motion(**changed: object) -> FleetTrajectory:
    values: dict[str, object] = {
        "revision": 1, "start_ns": START_NS, "issuer": 0, "shape": "v",
        "slots": {1: SlotChange(Ned(0.0, 4.0, 0.0), Ned(0.0, 4.0, 0.0)), 2: SlotChange(ZERO, ZERO)},
        "blend_start_ns": START_NS, "blend_s": 0.0, "legs_start_ns": START_NS, "centre_ned_m": Ned(0.0, 0.0, -10.0),
        "velocity_ned_m_s": ZERO, "heading_rad": 0.0, "heading_rate_rad_s": 0.0, "heading_follows_turns": False,
        "legs": (),
    }  # fmt: skip
    return FleetTrajectory(**(values | changed))  # type: ignore[arg-type]


motions = st.builds(
    motion,
    slots=st.builds(lambda a, b: {1: SlotChange(a, b)}, offsets, offsets),
    blend_s=st.one_of(st.just(0.0), st.floats(8.0, 30.0)),
    centre_ned_m=places,
    velocity_ned_m_s=velocities,
    heading_rad=st.floats(-pi, pi),
    heading_rate_rad_s=st.floats(-0.4, 0.4),
    heading_follows_turns=st.booleans(),
    legs=st.lists(legs, max_size=4).map(tuple),
)
moments = st.integers(0, 10**9).map(lambda seed: random.Random(seed).uniform(0.01, 100.0))
"""seconds since the start, away from the round numbers at which legs meet"""


def boundaries_s(m: FleetTrajectory) -> list[float]:
    """Times since the start at which a leg ends."""
    times = [0.0]
    for leg in m.legs:
        times.append(times[-1] + leg_duration_s(leg, m.state_at(ns(times[-1])).centre.velocity))
    return times[1:]


def assert_continues(
    before: FleetTrajectory, after: FleetTrajectory, t_s: float, vehicle: int, *, velocity: bool = True
) -> None:
    a, b = before.reference(vehicle, ns(t_s)), after.reference(vehicle, ns(t_s))
    assert dist(a.position_ned_m, b.position_ned_m) < 1e-6
    assert abs(sin(0.5 * (a.heading_rad - b.heading_rad))) < 1e-9
    if velocity:
        assert dist(a.velocity_ned_m_s, b.velocity_ned_m_s) < 1e-6


@settings(deadline=None, max_examples=100)
@given(motions, moments)
def test_velocity_and_acceleration_are_the_derivatives(m: FleetTrajectory, t_s: float) -> None:
    h = 1e-4
    earlier, now, later = (m.reference(1, ns(t)) for t in (t_s - h, t_s, t_s + h))
    for k in range(3):
        assert (later.position_ned_m[k] - earlier.position_ned_m[k]) / (2 * h) == pytest.approx(
            now.velocity_ned_m_s[k], abs=2e-4
        )
        assert (later.velocity_ned_m_s[k] - earlier.velocity_ned_m_s[k]) / (2 * h) == pytest.approx(
            now.acceleration_ned_m_s2[k], abs=2e-4
        )
    turned = atan2(sin(later.heading_rad - earlier.heading_rad), cos(later.heading_rad - earlier.heading_rad))
    assert turned / (2 * h) == pytest.approx(m.state_at(ns(t_s)).rate, abs=1e-4)


@PROPERTY
@given(motions)
def test_legs_and_blends_meet_without_a_jump(m: FleetTrajectory) -> None:
    for t in [*boundaries_s(m), m.blend_s, TURN_RAMP_S]:
        before, after = m.reference(1, ns(t) - 20), m.reference(1, ns(t) + 20)
        assert dist(before.position_ned_m, after.position_ned_m) < 1e-5
        assert dist(before.velocity_ned_m_s, after.velocity_ned_m_s) < 1e-5


@PROPERTY
@given(motions, moments, st.lists(legs, max_size=2), st.sampled_from([None, True, False]))
def test_other_legs_take_over_without_a_jump(
    m: FleetTrajectory, t_s: float, new: list[Leg], follows: bool | None
) -> None:
    after = with_legs(m, at_ns=ns(t_s), issuer=3, legs=tuple(new), heading_follows_turns=follows)
    assert (after.revision, after.start_ns, after.issuer) == (m.revision + 1, ns(t_s), 3)
    assert after.order > m.order
    assert_continues(m, after, t_s, 1)


@PROPERTY
@given(motions, st.floats(0.0, 30.0), st.sampled_from(["line", "circle", "column", "spiral"]))
def test_another_formation_takes_over_without_a_jump(m: FleetTrajectory, wait_s: float, shape: str) -> None:
    slots = shape_slots(shape, len(m.slots), 4.0)
    t_s = m.blend_s + wait_s
    after = with_formation(m, at_ns=ns(t_s), issuer=3, shape=shape, slots=slots, pinned={}, speed_m_s=1.0)
    assert_continues(m, after, t_s, 1)
    assert after.order > m.order
    end = after.blend_end_ns
    own = after.state_at(end).slot(SlotChange(ZERO, ZERO)).position_ned_m
    assert dist(after.reference(1, end).position_ned_m, own) == pytest.approx(dist(slots[0], ZERO), abs=1e-6)


@pytest.mark.parametrize("t_s", [0.0, 2.0, 4.0, 7.9])
def test_a_formation_asked_for_amid_a_change_starts_where_the_slots_are(t_s: float) -> None:
    """Its slots start at rest, so the velocity may step by what the running change still moves at; no more."""
    v, line = shape_slots("v", 6, 4.0), shape_slots("line", 6, 4.0)
    at_rest = motion(slots={i + 1: SlotChange(s, s) for i, s in enumerate(v)})
    first = with_formation(at_rest, at_ns=START_NS, issuer=0, shape="line", slots=line, pinned={}, speed_m_s=1.0)
    second = with_formation(first, at_ns=ns(t_s), issuer=0, shape="v", slots=v, pinned={}, speed_m_s=1.0)
    for i in range(1, 7):
        assert_continues(first, second, t_s, i, velocity=False)
        step = dist(first.reference(i, ns(t_s)).velocity_ned_m_s, second.reference(i, ns(t_s)).velocity_ned_m_s)
        assert step <= 1.0


@PROPERTY
@given(velocities, velocities, st.floats(0.0, 60.0))
def test_a_velocity_leg_arrives_within_its_acceleration(v0: Ned, v1: Ned, duration_s: float) -> None:
    leg = VelocityLeg(v1, duration_s)
    m = motion(velocity_ned_m_s=v0, legs=(leg,))
    whole = leg_duration_s(leg, v0)
    assert whole >= duration_s
    assert m.state_at(ns(whole + 1e-3)).centre.velocity == pytest.approx(v1, abs=1e-6)
    assert m.state_at(ns(whole + 50.0)).centre.velocity == pytest.approx(v1, abs=1e-9)
    peak = max(hypot(*m.state_at(ns(whole * k / 200)).centre.acceleration) for k in range(201))
    assert peak <= PLAN_ACCELERATION_M_S2 + 1e-9


def test_a_leg_of_zero_velocity_holds_the_place() -> None:
    m = motion(velocity_ned_m_s=Ned(1.0, 0.0, 0.0), legs=(VelocityLeg(ZERO, 0.0),))
    stop = m.state_at(ns(3.0)).centre
    assert stop.velocity == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert m.state_at(ns(1000.0)).centre.position == pytest.approx(stop.position, abs=1e-9)


@PROPERTY
@given(velocities, rates, st.floats(0.01, 20.0))
def test_a_turn_keeps_the_speed_and_turns_by_its_angle(v0: Ned, rate: float, angle: float) -> None:
    m = motion(velocity_ned_m_s=v0, legs=(TurnLeg(rate, angle),), heading_follows_turns=True)
    whole = leg_duration_s(m.legs[0], v0)
    for k in range(21):
        v = m.state_at(ns(whole * k / 20)).centre.velocity
        assert hypot(v.north, v.east) == pytest.approx(hypot(v0.north, v0.east), abs=1e-9)
        assert v.down == v0.down
        assert abs(m.state_at(ns(whole * k / 20)).rate) <= abs(rate) + 1e-12
    end = m.state_at(ns(whole + 1.0))
    signed = angle if rate > 0 else -angle
    assert sin(0.5 * (end.heading_rad - signed)) == pytest.approx(0.0, abs=1e-9)
    c, s = cos(signed), sin(signed)
    expected = (c * v0.north - s * v0.east, s * v0.north + c * v0.east)
    assert end.centre.velocity[:2] == pytest.approx(expected, abs=1e-9)
    assert end.rate == 0.0


@PROPERTY
@given(velocities, rates, st.floats(0.01, 12.0), st.floats(0.0, 1.0))
def test_a_turns_place_is_the_integral_of_its_velocity(v0: Ned, rate: float, angle: float, part: float) -> None:
    m = motion(velocity_ned_m_s=v0, legs=(TurnLeg(rate, angle),))
    nodes, weights = np.polynomial.legendre.leggauss(16)
    whole = leg_duration_s(m.legs[0], v0)
    end = part * whole
    smooth = (TURN_RAMP_S, 0.5 * whole, whole - TURN_RAMP_S)  # between these the velocity has all derivatives
    pieces = sorted({0.0, end, *(t for t in smooth if t < end)})
    place = np.array(m.centre_ned_m)
    for a, b in pairwise(pieces):
        for x, w in zip(nodes, weights, strict=True):
            t = 0.5 * (a + b) + 0.5 * (b - a) * x
            place = place + 0.5 * (b - a) * w * np.array(m.state_at(ns(t)).centre.velocity)
    assert m.state_at(ns(end)).centre.position == pytest.approx(tuple(place), abs=1e-6)


@pytest.mark.parametrize("angle", [1e-4, 0.02, 0.29, 0.3, 0.31, 2.0])
def test_a_small_turn_is_as_gentle_as_a_large_one(angle: float) -> None:
    """A formation 15 m wide that turns by a degree must not be jerked round."""
    m = motion(velocity_ned_m_s=Ned(1.0, 0.0, 0.0), legs=(TurnLeg(0.1, angle),), heading_follows_turns=True)
    whole = leg_duration_s(m.legs[0], m.velocity_ned_m_s)
    moments = [m.state_at(ns(whole * k / 200)) for k in range(201)]
    assert max(abs(x.rate_change) for x in moments) <= 1.5 * 0.1 / TURN_RAMP_S + 1e-9
    assert max(abs(x.rate) for x in moments) <= 0.1 + 1e-12


def test_a_turn_to_the_right_is_clockwise_seen_from_above() -> None:
    m = motion(velocity_ned_m_s=Ned(1.0, 0.0, 0.0), legs=(TurnLeg(0.1, pi / 2),))
    assert m.state_at(ns(100.0)).centre.velocity == pytest.approx((0.0, 1.0, 0.0), abs=1e-9)


def test_an_endless_turn_is_a_circle_for_hours() -> None:
    m = motion(velocity_ned_m_s=Ned(1.0, 0.0, 0.0), legs=(TurnLeg(-0.1, inf),), heading_follows_turns=True)
    assert m.end_ns is None
    lap = 2 * pi / 0.1
    first = m.state_at(ns(10.0)).centre.position
    for laps in (1, 57, 570):
        assert dist(m.state_at(ns(10.0 + laps * lap)).centre.position, first) < 1e-4
    across = m.state_at(ns(10.0 + lap / 2)).centre.position
    assert dist(first, across) == pytest.approx(20.0, abs=1e-6)


@PROPERTY
@given(motions, st.floats(-5.0, 100.0))
def test_a_slots_place_alone_is_the_place_of_the_whole_slot(m: FleetTrajectory, t_s: float) -> None:
    now = m.state_at(ns(t_s))
    assert all(now.place(change) == now.slot(change).position_ned_m for change in m.slots.values())


@PROPERTY
@given(places, places, st.floats(1.0, 60.0))
def test_a_goto_from_rest_is_as_fast_as_it_is_looked_at(start: Ned, target: Ned, duration_s: float) -> None:
    leg = GotoLeg(target, duration_s)
    rest, hardly = goto_peaks(leg, start, ZERO), goto_peaks(leg, start, Ned(1e-12, 0.0, 0.0))
    assert rest == pytest.approx(hardly, rel=1e-4, abs=1e-9)


def test_slots_turn_with_the_heading_only_if_it_follows() -> None:
    turn = (TurnLeg(0.1, pi),)
    fixed = motion(velocity_ned_m_s=Ned(1.0, 0.0, 0.0), legs=turn)
    following = motion(velocity_ned_m_s=Ned(1.0, 0.0, 0.0), legs=turn, heading_follows_turns=True)
    for m, sign in ((fixed, 1.0), (following, -1.0)):
        t = ns(100.0)
        centre, slot = m.state_at(t).centre.position, m.reference(1, t).position_ned_m
        assert slot.east - centre.east == pytest.approx(sign * 4.0)


@PROPERTY
@given(places, velocities, places, st.floats(5.0, 60.0))
def test_a_goto_leg_ends_at_its_target_at_rest(start: Ned, v0: Ned, target: Ned, duration_s: float) -> None:
    m = motion(centre_ned_m=start, velocity_ned_m_s=v0, legs=(GotoLeg(target, duration_s),))
    for wait in (0.0, 1.0, 500.0):
        end = m.state_at(ns(duration_s + wait)).centre
        assert end.position == pytest.approx(target, abs=1e-6)
        assert end.velocity == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)


@PROPERTY
@given(places, places, st.floats(0.2, 5.0))
def test_goto_durations_keep_speed_and_acceleration(start: Ned, target: Ned, speed: float) -> None:
    whole = goto_duration_s(Ned(*(b - a for a, b in zip(start, target, strict=True))), ZERO, speed)
    m = motion(centre_ned_m=start, legs=(GotoLeg(target, whole),))
    centres = [m.state_at(ns(whole * k / 200)).centre for k in range(201)]
    assert max(hypot(*c.velocity) for c in centres) <= speed * (1 + 1e-6)
    assert max(hypot(*c.acceleration) for c in centres) <= 2 * PLAN_ACCELERATION_M_S2 * (1 + 1e-4)


@PROPERTY
@given(st.floats(0.0, 200.0), st.floats(0.2, 5.0))
def test_blend_durations_keep_speed_acceleration_and_their_minimum(way: float, speed: float) -> None:
    whole = blend_duration_s([SlotChange(ZERO, Ned(way, 0.0, 0.0))], speed)
    assert whole >= BLEND_MIN_S
    slopes = [minimum_jerk(k / 400) for k in range(401)]
    assert max(m1 for _, m1, _ in slopes) * way / whole <= speed * (1 + 1e-6)
    assert max(abs(m2) for _, _, m2 in slopes) * way / whole**2 <= 1.0 + 1e-4


@pytest.mark.parametrize(
    ("x", "expected"),
    [
        (-1.0, (0.0, 0.0, 0.0)),
        (0.0, (0.0, 0.0, 0.0)),
        (0.5, (0.5, 1.875, 0.0)),
        (1.0, (1.0, 0.0, 0.0)),
        (2.0, (1.0, 0.0, 0.0)),
    ],
)
def test_minimum_jerk_is_at_rest_at_both_ends(x: float, expected: tuple[float, ...]) -> None:
    assert minimum_jerk(x) == pytest.approx(expected)


def test_end_of_a_motion_is_that_of_its_legs_or_of_its_blend() -> None:
    assert motion().end_ns == START_NS
    assert motion(blend_s=9.0).end_ns == ns(9.0)
    assert motion(blend_s=9.0, legs=(GotoLeg(ZERO, 20.0),)).end_ns == ns(20.0)
    assert motion(legs=(VelocityLeg(ZERO, inf),)).end_ns is None


def test_without_a_blend_the_slots_are_there() -> None:
    there = motion(slots={1: SlotChange(ZERO, Ned(3.0, 0.0, 0.0))}, blend_s=0.0)
    assert there.reference(1, START_NS - 10).position_ned_m == (3.0, 0.0, -10.0)


def test_a_new_formation_has_the_assigned_slots_of_every_vehicle_once() -> None:
    v, circle = shape_slots("v", 7, 4.0), shape_slots("circle", 7, 4.0)
    ids = (4, 9, 2, 30, 7, 11, 5)
    before = motion(slots={i: SlotChange(s, s) for i, s in zip(ids, v, strict=True)})
    after = with_formation(
        before, at_ns=ns(5.0), issuer=1, shape="circle", slots=circle, pinned={9: 0, 30: 6}, speed_m_s=1.0
    )
    assert sorted(c.after for c in after.slots.values()) == sorted(circle)
    assert {i: c.before for i, c in after.slots.items()} == dict(zip(ids, v, strict=True))
    assert after.slots[9].after == circle[0]
    assert after.slots[30].after == circle[6]
    assert assignment_matches(after, circle, {9: 0, 30: 6})


def test_an_assignment_that_is_not_ours_is_told_apart() -> None:
    v, line = shape_slots("v", 5, 4.0), shape_slots("line", 5, 4.0)
    before = motion(slots={i: SlotChange(s, s) for i, s in enumerate(v, 1)})
    ours = with_formation(before, at_ns=ns(5.0), issuer=1, shape="line", slots=line, pinned={}, speed_m_s=1.0)
    changes = ours.slots
    swapped = {**changes, 1: SlotChange(changes[1].before, changes[2].after), 2: SlotChange(
        changes[2].before, changes[1].after)}  # fmt: skip
    assert assignment_matches(ours, line, {})
    assert not assignment_matches(motion(slots=swapped), line, {})
    assert not assignment_matches(ours, shape_slots("line", 5, 4.1), {})
    assert not assignment_matches(ours, shape_slots("line", 6, 4.0), {})
    assert not assignment_matches(ours, shape_slots("line", 4, 4.0), {})


# -- programmes: what is known of the motions ------------------------------------------------------------------------

orders = st.tuples(st.integers(1, 4), st.integers(0, 3), st.integers(0, 3))


def proposal(order: tuple[int, int, int]) -> FleetTrajectory:
    revision, start_s, issuer = order
    return motion(revision=revision, start_ns=ns(float(start_s)), issuer=issuer, centre_ned_m=Ned(*map(float, order)))


def after_adopting(found: list[tuple[int, int, int]]) -> TrajectoryHistory:
    history = TrajectoryHistory([motion(revision=0)])
    for order in found:
        history.adopt(proposal(order))
    return history


@PROPERTY
@given(st.lists(orders, min_size=1, max_size=5), st.randoms(use_true_random=False))
def test_the_same_proposals_in_any_order_and_repeated_end_in_the_same_motion(
    found: list[tuple[int, int, int]], rng: random.Random
) -> None:
    again = [*found, *rng.choices(found, k=3)]
    rng.shuffle(again)
    first, second = after_adopting(found).newest, after_adopting(again).newest
    assert first.order == second.order == max(proposal(o).order for o in found)
    assert first.centre_ned_m == second.centre_ned_m


@PROPERTY
@given(st.lists(orders, min_size=1, max_size=8))
def test_a_programmes_motions_ascend_and_are_few(found: list[tuple[int, int, int]]) -> None:
    known = after_adopting(found).motions
    assert [m.revision for m in known] == sorted({m.revision for m in known})
    assert len(known) <= 4


def test_adopting_says_whether_something_changed() -> None:
    history = TrajectoryHistory([motion(revision=0)])
    assert history.adopt(proposal((1, 2, 3)))
    assert not history.adopt(proposal((1, 2, 3)))
    assert not history.adopt(proposal((1, 2, 2)))
    assert not history.adopt(proposal((1, 3, 9)))
    assert history.adopt(proposal((1, 2, 4)))
    assert history.adopt(proposal((1, 1, 0)))
    assert history.adopt(proposal((2, 9, 0)))
    assert not history.adopt(proposal((1, 9, 9)))


def test_two_proposals_for_one_revision_leave_one() -> None:
    for order in permutations([(1, 3, 5), (1, 2, 1), (1, 2, 4)]):
        assert [m.order for m in after_adopting(list(order)).motions[1:]] == [proposal((1, 2, 4)).order]


def test_a_motion_is_in_force_from_its_start_on() -> None:
    history = after_adopting([(1, 1, 0), (2, 3, 0)])
    for t_s, revision in ((-5.0, 0), (0.0, 0), (0.999999999, 0), (1.0, 1), (2.999999999, 1), (3.0, 2), (50.0, 2)):
        assert history.at(ns(t_s)).revision == revision


def test_a_vehicle_flies_from_one_motion_into_the_next_without_a_step() -> None:
    first = motion(velocity_ned_m_s=Ned(1.0, 0.0, 0.0), legs=(TurnLeg(0.2, inf),), heading_follows_turns=True)
    history = TrajectoryHistory([first])
    at_ns = ns(11.3)
    history.adopt(with_legs(first, at_ns=at_ns, issuer=1, legs=(GotoLeg(ZERO, 30.0),)))
    for vehicle in (1, 2):
        before, after = history.reference(vehicle, at_ns - 1), history.reference(vehicle, at_ns)
        assert dist(before.position_ned_m, after.position_ned_m) < 1e-6
        assert dist(before.velocity_ned_m_s, after.velocity_ned_m_s) < 1e-6


def test_speeds_of_slots_in_a_turn_are_their_lever_times_the_rate() -> None:
    m = motion(velocity_ned_m_s=Ned(1.0, 0.0, 0.0), legs=(TurnLeg(0.1, inf),), heading_follows_turns=True)
    speed = hypot(*m.reference(1, ns(60.0)).velocity_ned_m_s)
    assert speed == pytest.approx(1.0 - 0.1 * 4.0)  # on the inside of the turn
    assert sqrt(sum(a * a for a in m.reference(1, ns(60.0)).acceleration_ned_m_s2)) == pytest.approx(0.1 * 0.6)
