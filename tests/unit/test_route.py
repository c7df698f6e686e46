"""Plans and the fence: what leads outside is found, on which leg and how far; what stays inside is not."""

import math
import time
from dataclasses import replace
from math import inf, pi, radians

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.formation import shape_slots
from companion.core.frames import Ned
from companion.core.route import RESOLUTION_M, Breach, examined, only_stops
from companion.core.safety.fence import Fence
from companion.core.trajectory.fleet import FleetTrajectory
from companion.core.trajectory.legs import GotoLeg, Leg, TurnLeg, VelocityLeg
from companion.core.trajectory.slots import SlotChange
from companion.core.trajectory.successors import with_formation, with_legs
from companion.core.values import ZERO

NEAR_M = 0.25
"""to this the depth of a breach is told, amid a curve"""
FENCE = Fence(2.0, 50.0, radius_m=50.0)
NOTCHED = Fence(
    2.0, 50.0,
    corners_m=((-60.0, -60.0), (60.0, -60.0), (60.0, -6.0), (0.0, 0.0), (60.0, 6.0), (60.0, 60.0), (-60.0, 60.0)),
)  # fmt: skip
OCTAGON = Fence(
    2.0, 50.0, corners_m=tuple((52.0 * math.cos(k * pi / 4), 52.0 * math.sin(k * pi / 4)) for k in range(8))
)


def motion(*legs: Leg, count: int = 5, shape: str = "v", velocity: Ned = ZERO, follow: bool = False) -> FleetTrajectory:
    slots = shape_slots(shape, count, 4.0)
    return FleetTrajectory(
        revision=1, start_ns=0, issuer=0, shape=shape, slots={k + 1: SlotChange(s, s) for k, s in enumerate(slots)},
        blend_start_ns=0, blend_s=0.0, legs_start_ns=0, centre_ned_m=Ned(0.0, 0.0, -10.0), velocity_ned_m_s=velocity,
        heading_rad=0.0, heading_rate_rad_s=0.0, heading_follows_turns=follow, legs=legs,
    )  # fmt: skip


def alone(*legs: Leg, velocity: Ned = ZERO) -> FleetTrajectory:
    return motion(*legs, count=1, velocity=velocity)


def first_breach(m: FleetTrajectory, fence: Fence) -> Breach | None:
    return examined(m, fence)[0]


def sampled_worst(m: FleetTrajectory, fence: Fence, end_s: float) -> float:
    """The least room of any slot, looked at 20 times a second."""
    return min(
        fence.room_m(m.reference(i, round(k * 5e7)).position_ned_m) for k in range(int(end_s * 20) + 1) for i in m.slots
    )


@pytest.mark.parametrize(
    ("north", "outside"), [(47.99, None), (48.0, None), (48.01, 0.01), (50.0, 2.0), (300.0, 252.0)]
)
def test_a_waypoint_just_inside_at_and_just_beyond_the_margin(north: float, outside: float | None) -> None:
    breach = first_breach(alone(VelocityLeg(ZERO, 5.0), GotoLeg(Ned(north, 0.0, -10.0), 60.0)), FENCE)
    if outside is None:
        assert breach is None
    else:
        assert breach is not None
        assert (breach.leg, breach.vehicle_id) == (1, 1)
        assert breach.outside_m == pytest.approx(outside, abs=1e-6)
        assert f"its leg 1 takes vehicle 1 {outside:.2f} m beyond" in breach.sentence()


@pytest.mark.parametrize(
    ("altitude", "outside"), [(2.49, 0.01), (2.5, None), (2.51, None), (49.5, None), (49.51, 0.01), (80.0, 30.5)]
)
def test_a_waypoint_at_floor_and_ceiling(altitude: float, outside: float | None) -> None:
    breach = first_breach(alone(GotoLeg(Ned(0.0, 0.0, -altitude), 60.0)), FENCE)
    assert (None if breach is None else pytest.approx(breach.outside_m, abs=1e-6)) == outside


def test_the_formations_extent_counts_and_the_outermost_vehicle_is_named() -> None:
    """Five in line, 16 m wide: the last one's slot is 8 m east of the centre."""
    inside, beyond = (motion(GotoLeg(Ned(0.0, east, -10.0), 60.0), shape="line") for east in (39.99, 40.01))
    assert first_breach(inside, FENCE) is None
    breach = first_breach(beyond, FENCE)
    assert breach is not None
    assert breach.vehicle_id == 5
    assert breach.outside_m == pytest.approx(0.01, abs=1e-4)


def test_a_formation_that_turns_with_its_course_swings_its_arms_out() -> None:
    turn = TurnLeg(radians(6.0), pi / 2)
    line = motion(turn, shape="line", count=23, velocity=Ned(1.0, 0.0, 0.0), follow=True)
    long_fence = Fence(2.0, 50.0, corners_m=((-30.0, -60.0), (40.0, -60.0), (40.0, 60.0), (-30.0, 60.0)))
    assert first_breach(replace(line, heading_follows_turns=False), long_fence) is None
    breach = first_breach(line, long_fence)
    assert breach is not None
    assert breach.leg == 0
    assert breach.outside_m == pytest.approx(-sampled_worst(line, long_fence, 18.0), abs=NEAR_M)


@pytest.mark.parametrize(("speed", "inside"), [(3.0, True), (4.9, False)])
def test_a_circle_for_ever_is_looked_at_for_one_whole_turn(speed: float, inside: bool) -> None:
    """Radius v/omega: 28.6 m and 46.8 m, begun at its southernmost place after 3 s of ramp."""
    m = alone(TurnLeg(radians(6.0), inf), velocity=Ned(0.0, speed, 0.0))
    breach = first_breach(m, FENCE if not inside else Fence(2.0, 50.0, radius_m=70.0))
    assert (breach is None) is inside
    if breach is not None:
        assert breach.leg == 0
        assert breach.time_s <= 66.0


def test_of_many_turns_the_first_and_the_last_are_looked_at() -> None:
    m = alone(TurnLeg(radians(6.0), 200 * pi), GotoLeg(Ned(0.0, 0.0, -10.0), 60.0), velocity=Ned(1.0, 0.0, 0.0))
    assert first_breach(m, FENCE) is None
    falling = alone(TurnLeg(radians(6.0), 200 * pi), velocity=Ned(1.0, 0.0, 0.01))
    breach = first_breach(falling, FENCE)
    assert breach is not None
    assert breach.outside_m == pytest.approx(6003 * 0.01 - 7.5, abs=0.1)


def test_what_follows_the_last_leg_is_left_to_the_filter() -> None:
    assert first_breach(alone(VelocityLeg(Ned(1.0, 0.0, 0.0), 0.0)), FENCE) is None


def test_a_way_across_a_notch_is_refused_though_both_its_ends_are_inside() -> None:
    there = Ned(30.0, 30.0, -10.0)
    m = replace(alone(GotoLeg(there, 80.0)), centre_ned_m=Ned(30.0, -30.0, -10.0))
    assert NOTCHED.room_m(there) > 7.0
    breach = first_breach(m, NOTCHED)
    assert breach is not None
    assert breach.outside_m == pytest.approx(-sampled_worst(m, NOTCHED, 80.0), abs=NEAR_M)


def test_a_change_of_formation_near_the_edge_is_refused_before_any_leg() -> None:
    m = replace(motion(shape="column", count=9), centre_ned_m=Ned(0.0, 40.0, -10.0))
    assert first_breach(m, FENCE) is None
    line = with_formation(
        m, at_ns=10**9, issuer=0, shape="line", slots=shape_slots("line", 9, 4.0), pinned={}, speed_m_s=2.0
    )
    breach = first_breach(line, FENCE)
    assert breach is not None
    assert breach.leg is None
    assert "its formation takes vehicle" in breach.sentence()
    assert breach.outside_m == pytest.approx(8.0, abs=NEAR_M)


def test_a_way_back_is_taken_though_the_formation_first_drifts_further_out() -> None:
    drifting = replace(alone(velocity=Ned(1.5, 0.0, 0.0)), centre_ned_m=Ned(60.0, 0.0, -10.0))
    back = with_legs(drifting, at_ns=0, issuer=0, legs=(GotoLeg(Ned(0.0, 0.0, -10.0), 60.0),))
    assert back.state_at(5 * 10**9).centre.position.north > 63.0
    assert first_breach(back, FENCE) is None
    away = with_legs(drifting, at_ns=0, issuer=0, legs=(VelocityLeg(Ned(1.0, 0.0, 0.0), 5.0),))
    assert first_breach(away, FENCE) is not None


def test_a_motion_that_starts_outside_may_lead_back_but_no_further_out() -> None:
    outside = replace(alone(), centre_ned_m=Ned(60.0, 0.0, -10.0))
    back, further = (
        with_legs(outside, at_ns=0, issuer=0, legs=(GotoLeg(Ned(north, 0.0, -10.0), 60.0),)) for north in (0.0, 61.0)
    )
    assert first_breach(outside, FENCE) is None
    assert first_breach(back, FENCE) is None
    assert first_breach(further, FENCE) is not None


def test_only_what_brings_the_same_formation_to_rest_only_stops() -> None:
    flying = motion(VelocityLeg(Ned(1.0, 0.0, 0.0), 30.0))
    hold = with_legs(flying, at_ns=10**10, issuer=0, legs=(VelocityLeg(ZERO, 0.0),))
    assert only_stops(hold, flying)
    assert not only_stops(replace(hold, legs=()), flying)
    assert not only_stops(replace(hold, legs=flying.legs), flying)
    assert not only_stops(replace(hold, slots=motion(shape="line").slots), flying)


def test_a_leg_of_months_beside_the_edge_is_looked_at_in_bounded_time() -> None:
    beside = replace(alone(VelocityLeg(ZERO, 1e7)), centre_ned_m=Ned(47.999, 0.0, -10.0))
    began = time.perf_counter()
    assert first_breach(beside, FENCE) is None
    assert time.perf_counter() - began < 5.0


legs = st.one_of(
    st.builds(
        VelocityLeg, st.builds(Ned, st.floats(-3, 3), st.floats(-3, 3), st.floats(-0.3, 0.3)), st.floats(0.0, 20.0)
    ),
    st.builds(TurnLeg, st.sampled_from([-0.2, 0.1, 0.3]), st.floats(0.2, 4.0)),
    st.builds(
        GotoLeg, st.builds(Ned, st.floats(-45, 45), st.floats(-45, 45), st.floats(-45, -5)), st.floats(30.0, 60.0)
    ),
)


@settings(deadline=None, max_examples=60)
@given(
    st.lists(legs, min_size=1, max_size=3),
    st.sampled_from([FENCE, NOTCHED, OCTAGON]),
    st.booleans(),
    st.sampled_from(["v", "line"]),
)
def test_the_march_finds_what_dense_sampling_finds(plan: list[Leg], fence: Fence, follow: bool, shape: str) -> None:
    m = replace(motion(*plan, shape=shape, follow=follow), centre_ned_m=Ned(-20.0, 0.0, -10.0))
    end_ns = m.end_ns
    assert end_ns is not None
    worst = sampled_worst(m, fence, end_ns * 1e-9)
    breach = first_breach(m, fence)
    if worst < -RESOLUTION_M:
        assert breach is not None
    if breach is not None:
        assert math.isclose(breach.outside_m, -fence.room_m(m.reference(breach.vehicle_id, round(breach.time_s * 1e9)).position_ned_m), abs_tol=1e-5)  # fmt: skip  # noqa: E501
        assert breach.outside_m <= -worst + NEAR_M


within = st.tuples(st.floats(-70.0, 70.0), st.floats(-70.0, 70.0))


@given(within, within, st.sampled_from([FENCE, NOTCHED, OCTAGON, Fence(2.0, 50.0)]))
def test_the_least_room_along_a_straight_way_is_what_dense_sampling_finds(
    a: tuple[float, float], b: tuple[float, float], fence: Fence
) -> None:
    sampled = min(fence.edge_room_m(*(p + (q - p) * k / 400 for p, q in zip(a, b, strict=True))) for k in range(401))
    least = fence.edge_rooms_along_m([(a, b)])[0]
    if sampled < 0.0:
        assert least < 0.5
    if least < -fence.margin_m:
        assert sampled < 0.0
    if min(sampled, least) >= 0.0:
        assert least == pytest.approx(sampled, abs=0.5)
        assert least <= sampled + 1e-9


@given(st.lists(within, min_size=1, max_size=4), st.sampled_from([FENCE, NOTCHED, OCTAGON, Fence(2.0, 50.0)]))
def test_rooms_of_many_places_are_each_ones(places: list[tuple[float, float]], fence: Fence) -> None:
    rooms = fence.edge_rooms_m(places)
    assert rooms == pytest.approx([fence.edge_room_m(*place) for place in places], abs=1e-9)


def test_a_way_that_touches_the_edge_has_no_room_even_without_a_margin() -> None:
    bare = replace(NOTCHED, margin_m=0.0)
    assert bare.edge_rooms_along_m([((-50.0, 0.0), (60.0, -6.0)), ((30.0, -20.0), (30.0, 20.0))]) == [-inf, -inf]
    assert bare.edge_rooms_along_m([((-50.0, 0.0), (-50.0, 0.0))]) == [pytest.approx(10.0)]
    assert bare.edge_rooms_along_m([((-50.0, 0.0), (-50.0, 1e-290))]) == [pytest.approx(10.0)]


def test_only_a_notch_makes_a_fence_that_is_not_convex() -> None:
    assert [f.convex for f in (FENCE, OCTAGON, NOTCHED, replace(OCTAGON, corners_m=OCTAGON.corners_m[::-1]))] == [
        True, True, False, True,
    ]  # fmt: skip
