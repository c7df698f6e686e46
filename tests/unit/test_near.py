"""Near mode: who is near, who speaks, until when, and how far a peer may be whose message is missing."""

from itertools import pairwise
from math import hypot

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.core.frames import Ned
from companion.core.monitor import PeerMotion, unheard_error_m
from companion.core.prediction import axis, weights
from companion.core.safety.filter import HalfPlane, half_plane, push_m_s2, resting_push_m_s2
from companion.core.trigger.base import Situation
from companion.core.trigger.near import (
    MISSING_MAX_M,
    PUSH_M_S2,
    NearMode,
    certain_age_s,
    missing_m,
    near_bound_m,
    near_push_m_s2,
)
from companion.core.trigger.periodic import PeriodicTrigger
from companion.core.values import ZERO, Neighbour, VehicleState

MOTION = PeerMotion(
    sigma_p_m=0.05, sigma_v_m_s=0.05, sigma_gust_m_s2=0.3, a_max_m_s2=5.0, deviation_m_s2=13.7, drift_m_s=0.0,
    speed_m_s=8.0, lag_s=0.15, latency_s=0.07, t_min_s=0.05, t_max_s=10.0,
)  # fmt: skip
BOUND_M = 0.849
TICK_NS = 20_000_000
HOLD_NS = 1_000_000_000


def mode(period_s: float = 0.1) -> NearMode:
    return NearMode(PeriodicTrigger(period_s))


def at(time_ns: int, sent_ns: int) -> Situation:
    return Situation(0.0, 0.0, 0.0, 0.0, time_ns, sent_ns)


def test_a_peer_stays_near_for_a_second_after_it_was_found_so() -> None:
    m = mode()
    assert not m.active(0)
    assert not m.promised
    m.see([7, 3], 0)
    m.see([3], HOLD_NS // 2)
    assert m.peers(HOLD_NS - 1) == (3, 7)
    assert m.peers(HOLD_NS) == (3,)
    assert m.active(HOLD_NS)
    assert m.peers(HOLD_NS // 2 + HOLD_NS) == ()
    assert not m.active(HOLD_NS // 2 + HOLD_NS)


def in_slots(offset: Ned, *, in_formation: bool = True, slot_velocity: Ned = ZERO) -> Neighbour:
    return Neighbour(
        2, ZERO, ZERO, offset, 0.0, in_formation, True, BOUND_M, reference_velocity_ned_m_s=slot_velocity
    )  # fmt: skip


RADIUS_M = 0.65 + BOUND_M
CLOSEST_M = RADIUS_M + 0.2
NORTH = Ned(1.0, 0.0, 0.0)


@pytest.mark.parametrize("distance_m", [3.4, 4.0, 100.0])
def test_a_push_of_2_m_s2_makes_near_where_the_slots_are_wide(distance_m: float) -> None:
    assert near_push_m_s2(in_slots(Ned(0.0, distance_m, 0.0)), ZERO, CLOSEST_M, RADIUS_M) == PUSH_M_S2


@pytest.mark.parametrize("slot_velocity", [ZERO, NORTH, Ned(1.0, 0.0, -0.5)])
def test_in_tight_slots_it_takes_2_m_s2_less_than_the_slots_leave(slot_velocity: Ned) -> None:
    """Whether they stand, fly on together or, turning, about each other."""
    tight = in_slots(Ned(0.0, CLOSEST_M, 0.0), slot_velocity=slot_velocity)
    turning = in_slots(Ned(0.0, CLOSEST_M, 0.0), slot_velocity=slot_velocity._replace(north=-1.0))
    for n in (tight, turning):
        left = resting_push_m_s2(CLOSEST_M, RADIUS_M)
        assert near_push_m_s2(n, slot_velocity, CLOSEST_M, RADIUS_M) == pytest.approx(left - PUSH_M_S2)
        assert left > 0.5


@pytest.mark.parametrize(
    "neighbour",
    [
        in_slots(Ned(0.0, CLOSEST_M, 0.0), in_formation=False),  # gated, apart or landing
        in_slots(Ned(0.0, CLOSEST_M, 0.0), slot_velocity=Ned(0.0, 0.1, 0.0)),  # slots that approach or part
        in_slots(Ned(0.0, CLOSEST_M, 0.0), slot_velocity=Ned(0.0, -0.1, 0.0)),
    ],
)
def test_out_of_steady_slots_2_m_s2_make_near_however_tight(neighbour: Neighbour) -> None:
    assert near_push_m_s2(neighbour, ZERO, CLOSEST_M, RADIUS_M) == PUSH_M_S2


@pytest.mark.parametrize(("rate_m_s", "steady"), [(0.0499, True), (-0.0499, True), (0.0501, False), (-0.0501, False)])
def test_slots_keep_their_distance_up_to_5_cm_s_along_any_axis(rate_m_s: float, steady: bool) -> None:
    left = resting_push_m_s2(CLOSEST_M, RADIUS_M) - PUSH_M_S2
    for offset, velocity in (
        (Ned(CLOSEST_M, 0.0, 0.0), Ned(rate_m_s, 0.0, 0.0)),
        (Ned(0.0, -CLOSEST_M, 0.0), Ned(0.0, rate_m_s, 0.0)),
        (Ned(CLOSEST_M, 0.0, 0.5), Ned(0.0, 0.0, rate_m_s * hypot(CLOSEST_M, 0.2) / 0.5)),
    ):
        push = near_push_m_s2(in_slots(offset, slot_velocity=velocity), ZERO, CLOSEST_M, RADIUS_M)
        assert (push < PUSH_M_S2) is steady
        alike = near_push_m_s2(in_slots(offset, slot_velocity=velocity), velocity, CLOSEST_M, RADIUS_M)
        assert alike == pytest.approx(left, abs=0.2)


@pytest.mark.parametrize("velocity", [Ned(1.0, -1.0, 0.0), Ned(0.0, 1.0, -1.0), Ned(1.0, 0.0, -1.0)])
def test_slots_that_turn_about_each_other_on_a_slope_keep_their_distance(velocity: Ned) -> None:
    """Along each axis they approach or part; the parts cancel."""
    side_m = CLOSEST_M / 2.0
    turning = in_slots(Ned(side_m, side_m, side_m), slot_velocity=velocity)
    standing = in_slots(Ned(side_m, side_m, side_m))
    expected = near_push_m_s2(standing, ZERO, CLOSEST_M, RADIUS_M)
    assert near_push_m_s2(turning, ZERO, CLOSEST_M, RADIUS_M) == expected < PUSH_M_S2


def test_height_between_slots_counts_by_the_downwash() -> None:
    above = near_push_m_s2(in_slots(Ned(0.0, 0.0, 2.5 * 1.8)), ZERO, CLOSEST_M, RADIUS_M)
    assert above == pytest.approx(near_push_m_s2(in_slots(Ned(0.0, 1.8, 0.0)), ZERO, CLOSEST_M, RADIUS_M))


def test_slots_that_cross_never_make_it_less_than_the_closest_configured_would() -> None:
    crossing, closest = in_slots(Ned(0.0, 0.1, 0.0)), in_slots(Ned(0.0, CLOSEST_M, 0.0))
    assert near_push_m_s2(crossing, ZERO, CLOSEST_M, RADIUS_M) == near_push_m_s2(closest, ZERO, CLOSEST_M, RADIUS_M)


def test_who_is_named_speaks_for_a_second_and_names_nobody_for_it() -> None:
    """Two that name each other because they are named would never end."""
    m = mode()
    m.named(0)
    assert m.active(HOLD_NS - 1)
    assert m.peers(0) == ()
    assert not m.active(HOLD_NS)


def test_a_promised_message_is_sent_though_nobody_is_near_any_more() -> None:
    m = mode()
    m.promised = True
    assert not m.fires(at(90_000_000, 10_000_000), active=False)
    assert m.fires(at(100_000_000, 10_000_000), active=False)
    m.promised = False
    assert not m.fires(at(100_000_000, 10_000_000), active=False)


@pytest.mark.parametrize("period_s", [0.05, 0.1, 0.2])
def test_a_near_vehicle_keeps_its_promise_to_within_a_control_period(period_s: float) -> None:
    m, sent_ns, gaps = mode(period_s), 0, []
    for k in range(1, 1000):
        if m.fires(at(k * TICK_NS, sent_ns), active=True):
            gaps.append(k * TICK_NS - sent_ns)
            sent_ns = k * TICK_NS
    assert max(gaps) <= round(period_s * 1e9) + TICK_NS
    assert len(gaps) == pytest.approx(20.0 / period_s, abs=2)


def pair(distance_m: float, closing_m_s: float, uncertainty_m: float = BOUND_M) -> tuple[HalfPlane, HalfPlane]:
    """Two head-on, each as the other's filter sees it."""
    planes = []
    for side in (0.5, -0.5):
        ego = VehicleState(0, Ned(-side * distance_m, 0.0, -10.0), Ned(side * closing_m_s, 0.0, 0.0))
        other = Neighbour(
            2, Ned(side * distance_m, 0.0, -10.0), Ned(-side * closing_m_s, 0.0, 0.0), ZERO, 0.0, True, True,
            uncertainty_m,
        )  # fmt: skip
        planes.append(half_plane(ego, ZERO, other))
    return planes[0], planes[1]


@given(st.floats(0.1, 30.0), st.floats(-6.0, 6.0))
def test_both_of_a_pair_that_know_the_same_find_each_other_near_alike(distance_m: float, closing_m_s: float) -> None:
    one, other = (push_m_s2(p) for p in pair(distance_m, closing_m_s))
    assert one == pytest.approx(other, abs=1e-9)


@given(st.floats(0.5, 30.0), st.floats(-6.0, 6.0), st.floats(0.0, 20.0))
def test_the_push_is_what_just_breaks_the_half_plane(distance_m: float, closing_m_s: float, push: float) -> None:
    plane, _ = pair(distance_m, closing_m_s)
    size = hypot(plane.g_north, plane.g_east)
    kept = plane.g_north * (-push * plane.g_north / size) + plane.g_east * (-push * plane.g_east / size) >= plane.b
    assert kept is (push <= push_m_s2(plane)) or push == pytest.approx(push_m_s2(plane))


def test_the_push_is_told_in_m_s2_whatever_the_half_planes_scale_and_direction() -> None:
    """A gradient is shorter than 1 where the peer is above or below."""
    assert push_m_s2(HalfPlane(0.3, -0.4, -1.0)) == pytest.approx(2.0)
    assert push_m_s2(HalfPlane(0.0, 0.1, 0.3)) == pytest.approx(-3.0)


def test_at_rest_a_pair_that_shares_the_avoidance_is_near_from_2_m_on_at_the_default_radius() -> None:
    radius_m = 0.65 + BOUND_M
    assert resting_push_m_s2(2.25, radius_m) < PUSH_M_S2 < resting_push_m_s2(2.3, radius_m)
    assert resting_push_m_s2(radius_m, radius_m) == 0.0
    assert push_m_s2(pair(2.25, 0.0)[0]) == pytest.approx(resting_push_m_s2(2.25, radius_m))


def test_a_message_that_is_missing_makes_near_in_tight_slots_too() -> None:
    """So the peer is named and speaks again: its word that the next one is not due may be what was lost."""
    n = in_slots(Ned(0.0, CLOSEST_M, 0.0))._replace(uncertainty_m=BOUND_M + MISSING_MAX_M)
    assert push_m_s2(pair(CLOSEST_M, 0.0, n.uncertainty_m)[0]) < near_push_m_s2(n, ZERO, CLOSEST_M, RADIUS_M)
    assert push_m_s2(pair(CLOSEST_M, 0.0)[0]) > near_push_m_s2(n, ZERO, CLOSEST_M, RADIUS_M) + 1.9


# -- the bound -------------------------------------------------------------------------------------------------------


@given(st.floats(0.0, 10.0))
def test_the_bound_of_a_near_peer_is_the_triggers_until_its_sample_is_old(age_s: float) -> None:
    bound = near_bound_m(age_s, BOUND_M, MOTION)
    assert BOUND_M <= bound <= BOUND_M + 1.0
    assert bound == pytest.approx(min(max(BOUND_M, unheard_error_m(age_s, MOTION)), BOUND_M + 1.0))


def test_a_message_that_comes_when_it_is_due_is_covered_by_the_triggers_bound() -> None:
    assert missing_m(0.1 + MOTION.latency_s, BOUND_M, MOTION) == 0.0
    assert missing_m(0.3, BOUND_M, MOTION) > 0.1


@pytest.mark.parametrize("bound_m", [0.1, BOUND_M, 3.0])
def test_the_bound_is_certain_up_to_the_age_at_which_its_growth_meets_the_cap(bound_m: float) -> None:
    age_s = certain_age_s(bound_m, MOTION)
    assert missing_m(age_s - 1e-6, bound_m, MOTION) < MISSING_MAX_M
    assert missing_m(age_s + 1e-6, bound_m, MOTION) == MISSING_MAX_M


@given(
    st.floats(-4.0, 4.0), st.floats(-8.0, 8.0), st.floats(-8.0, 8.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0)
)  # fmt: skip
def test_whatever_a_near_peer_does_unheard_it_stays_within_its_bound(
    v: float, first: float, then: float, turn: float, share: float
) -> None:
    """The damped hold against one that flies any two accelerations the filter may ask for, one axis, no noise."""
    age_s = share * certain_age_s(BOUND_M, MOTION)
    t1 = turn * age_s
    t2 = age_s - t1
    flown = v * age_s + 0.5 * first * t1 * t1 + first * t1 * t2 + 0.5 * then * t2 * t2
    predicted, _ = axis(0.0, v, 0.0, 0.0, 0.0, 0.0, weights("damped", age_s, 0.7))
    assert abs(flown - predicted) <= near_bound_m(age_s, BOUND_M, MOTION)


@pytest.mark.parametrize("distance_m", [1.5, 2.0, 2.5, 3.0, 4.0])
@pytest.mark.parametrize("closing_m_s", [-2.0, 0.0, 2.0, 4.0])
def test_a_growing_bound_never_makes_the_filter_jump(distance_m: float, closing_m_s: float) -> None:
    """The pair stands still in this test, so that only the radius moves: tick by tick, up to its cap."""
    asked = [-push_m_s2(pair(distance_m, closing_m_s, near_bound_m(k * 0.02, BOUND_M, MOTION))[0]) for k in range(60)]
    steps = [b - a for a, b in pairwise(asked)]
    assert min(steps) >= 0.0
    assert max(steps) < 0.7, "m/s^2 in one control period; the vehicle's own lag smooths that"
    assert asked[-1] - asked[0] < 4.5
