"""The fence: its geometry against a library, its barrier at the limits, flights that leave it without the filter."""

import random
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from math import cos, dist, e, exp, hypot, inf, isfinite, nan, pi, sin, sqrt

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import LineString, Point, Polygon

from companion.core.counts import OTHER
from companion.core.frames import Ned
from companion.core.safety.fence import (
    FENCE_POLE_PER_S,
    RETURN_SPEED_M_S,
    Fence,
    braking_pole_per_s,
    wall_plane,
)
from companion.core.safety.filter import SafetyFilter, SafetyLimits, half_plane
from companion.core.values import Command, Neighbour, SafeSetpoint, VehicleState

PROPERTY = settings(deadline=None, max_examples=60)
ZERO = Ned(0.0, 0.0, 0.0)
DT_S = 0.02
LAG_S = 0.3
DELAY_S = 0.1
LIMITS = SafetyLimits(
    speed_max_m_s=4.0, climb_max_m_s=1.5, descent_max_m_s=1.0, jerk_max_m_s3=100.0, avoidance_acceleration_m_s2=8.0
)
LEVEL_M = -10.0

CYLINDER = Fence(2.0, 50.0, radius_m=30.0, centre_north_m=5.0, centre_east_m=-3.0)
SQUARE = Fence(2.0, 50.0, corners_m=((-30.0, -30.0), (30.0, -30.0), (30.0, 30.0), (-30.0, 30.0)))
SHARP = Fence(2.0, 50.0, corners_m=((40.0, 0.0), (-30.0, 25.0), (-30.0, -25.0)))
"""a triangle whose northern corner is 39 degrees wide"""
NOTCHED = Fence(
    2.0, 50.0,
    corners_m=((-30.0, -30.0), (30.0, -30.0), (30.0, -6.0), (0.0, 0.0), (30.0, 6.0), (30.0, 30.0), (-30.0, 30.0)),
)  # fmt: skip
"""a square with a notch from the north to its middle: its inner corner points south"""
SLIT = Fence(
    2.0, 50.0,
    corners_m=((-30.0, -30.0), (0.0, -30.0), (0.0, -5.0), (25.0, -5.0), (25.0, 5.0), (0.0, 5.0), (0.0, 30.0),
               (-30.0, 30.0)),
)  # fmt: skip
"""half a square with a blind alley 10 m wide to the north"""
FENCES = {"cylinder": CYLINDER, "square": SQUARE, "sharp": SHARP, "notched": NOTCHED, "slit": SLIT}


def reversed_corners(fence: Fence) -> Fence:
    return replace(fence, corners_m=fence.corners_m[::-1])


def state(position: Ned, velocity: Ned = ZERO) -> VehicleState:
    return VehicleState(0, position, velocity)


HERE = Ned(0.0, 0.0, LEVEL_M)


def command(u: Ned = ZERO, place: Ned = HERE, v_d: Ned = ZERO) -> Command:
    return Command(u, place, v_d, ZERO, 0.0)


def with_fence(fence: Fence | None, **more: float) -> SafetyFilter:
    return SafetyFilter(replace(LIMITS, fence=fence, **more))  # type: ignore[arg-type]


def applied(
    f: SafetyFilter, c: Command, ego: VehicleState, neighbours: tuple[Neighbour, ...] = (), bias: Ned = ZERO
) -> SafeSetpoint:
    s = f.apply(c, ego, neighbours, bias, DT_S)
    assert s is not None
    assert OTHER not in f.counts, "whatever acts has a name of its own"
    return s


def acceleration(s: SafeSetpoint) -> tuple[float, float]:
    return s.acceleration_north_m_s2, s.acceleration_east_m_s2


# -- geometry --------------------------------------------------------------------------------------------------------

places = st.tuples(st.floats(-60.0, 60.0), st.floats(-60.0, 60.0))
polygons = st.sampled_from([SQUARE, SHARP, NOTCHED, SLIT, reversed_corners(NOTCHED), reversed_corners(SHARP)])


@settings(deadline=None, max_examples=300)
@given(polygons, places)
def test_clearance_of_a_polygon_is_a_librarys_distance_to_its_edge(fence: Fence, place: tuple[float, float]) -> None:
    polygon, point = Polygon(fence.corners_m), Point(place)
    distance = polygon.exterior.distance(point)
    if distance > 1e-9:
        expected = distance if polygon.contains(point) else -distance
        assert fence.edge_clearance_m(*place) == pytest.approx(expected, abs=1e-9)
    else:
        assert abs(fence.edge_clearance_m(*place)) <= 1e-9


@PROPERTY
@given(places)
def test_clearance_of_a_cylinder_is_the_distance_to_its_round_wall(place: tuple[float, float]) -> None:
    assert CYLINDER.edge_clearance_m(*place) == pytest.approx(30.0 - dist(place, (5.0, -3.0)))


@pytest.mark.parametrize("fence", FENCES.values(), ids=FENCES)
@pytest.mark.parametrize(
    ("altitude", "clearance", "room"),
    [(1.999, -0.001, -0.501), (2.0, 0.0, -0.5), (2.001, 0.001, -0.499), (2.5, 0.5, 0.0), (49.5, 0.5, 0.0),
     (49.999, 0.001, -0.499), (50.0, 0.0, -0.5), (50.001, -0.001, -0.501)],
)  # fmt: skip
def test_clearance_at_floor_and_ceiling(fence: Fence, altitude: float, clearance: float, room: float) -> None:
    place = Ned(-5.0, 0.0, -altitude)
    assert fence.clearance_m(place) == pytest.approx(clearance)
    assert fence.contains(place) is (clearance >= 0.0)
    assert fence.vertical_room_m(-altitude) == pytest.approx(room)
    assert fence.room_m(place) == pytest.approx(min(room, fence.edge_room_m(-5.0, 0.0)))


@pytest.mark.parametrize(("north", "inside"), [(34.999, True), (35.0, True), (35.001, False)])
def test_the_cylinder_contains_its_edge_and_nothing_beyond(north: float, inside: bool) -> None:
    assert CYLINDER.contains(Ned(north, -3.0, LEVEL_M)) is inside


@pytest.mark.parametrize("bad", [nan, inf, -inf])
@pytest.mark.parametrize("fence", [CYLINDER, SQUARE])
def test_a_place_that_is_not_finite_is_not_inside(fence: Fence, bad: float) -> None:
    for k in range(3):
        assert not fence.contains(Ned(*(bad if j == k else -10.0 for j in range(3))))


def test_a_fence_without_an_edge_limits_the_altitude_alone() -> None:
    fence = Fence(2.0, 50.0)
    assert fence.edge_clearance_m(1e4, -1e4) == inf
    assert fence.walls(1e4, -1e4) == ()
    assert fence.clearance_m(Ned(1e4, 0.0, LEVEL_M)) == 8.0


@settings(deadline=None, max_examples=200)
@given(st.sampled_from([*FENCES.values(), reversed_corners(NOTCHED)]), places)
def test_walls_are_the_distance_and_its_slope(fence: Fence, place: tuple[float, float]) -> None:
    """The least room of the walls is the room; each direction is the one in which its room grows by a metre a metre."""
    walls = fence.walls(*place)
    assert min(w.room_m for w in walls) == pytest.approx(fence.edge_room_m(*place), abs=2e-9)
    for w in walls:
        assert hypot(w.north, w.east) == pytest.approx(1.0)
    nearest = min(walls)
    rivals = [w for w in walls if w.room_m < nearest.room_m + 1e-4]
    one_way = all(dist(w[1:3], nearest[1:3]) < 1e-3 for w in rivals)
    if one_way and abs(fence.edge_clearance_m(*place)) > 0.01:
        step = 1e-6
        grown = fence.edge_room_m(place[0] + step * nearest.north, place[1] + step * nearest.east)
        assert (grown - nearest.room_m) / step == pytest.approx(1.0, abs=1e-3)


@settings(deadline=None, max_examples=200)
@given(st.sampled_from(list(FENCES.values())), places, st.floats(-4.0, 4.0), st.floats(-4.0, 4.0), places)
def test_every_wall_is_a_barrier_that_allows_no_more_than_the_true_one(
    fence: Fence, place: tuple[float, float], v_north: float, v_east: float, u: tuple[float, float]
) -> None:
    """n.u >= b implies h'' + 2 p h' + p^2 h >= 0 with h'' of the distance to that wall, differentiated numerically."""
    if fence.edge_room_m(*place) < 0.1:
        return
    step = 1e-3
    for k, wall in enumerate(fence.walls(*place)):
        if fence.radius_m is not None and dist(place, (5.0, -3.0)) < 14.0:
            continue  # the middle half, where the bend is held at that of its rim

        def h(t: float, k: int = k) -> float:
            there = (place[0] + v_north * t + 0.5 * u[0] * t * t, place[1] + v_east * t + 0.5 * u[1] * t * t)
            return fence.walls(*there)[k].room_m

        n_north, n_east, b = wall_plane(wall, v_north, v_east, 1.5)
        h0, h1, h2 = h(0.0), h(step), h(-step)
        true = (h1 + h2 - 2 * h0) / step**2 + 3.0 * (h1 - h2) / (2 * step) + 2.25 * h0
        slack = n_north * u[0] + n_east * u[1] - b
        assert slack <= true + 0.05 + 1e-4 * abs(true)


# -- the barrier's numbers -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("speed", "avoidance", "pole"),
    [(4.0, 8.0, 1.5), (7.248, 8.0, 1.5), (7.25, 8.0, 1.49975), (12.0, 8.0, e / 3.0), (4.0, 1.0, e / 8.0)],
)
def test_a_pole_brakes_from_the_speed_limit_with_half_of_what_avoidance_may(
    speed: float, avoidance: float, pole: float
) -> None:
    assert braking_pole_per_s(speed, avoidance) == pytest.approx(pole, rel=1e-4)
    assert pole <= FENCE_POLE_PER_S
    assert braking_pole_per_s(speed, avoidance) * speed / e <= 0.5 * avoidance + 1e-9


@pytest.mark.parametrize(("fence", "edge_north"), [(CYLINDER, 35.0), (SQUARE, 30.0)], ids=["radius", "edge"])
@pytest.mark.parametrize(("more", "acted"), [(0.001, 0), (0.0, 0), (-0.001, 1), (-0.1, 1)])
def test_a_push_outward_at_the_fences_limit(fence: Fence, edge_north: float, more: float, acted: int) -> None:
    """At rest p^2 h is the most that may push outward: 2.25 m/s^2 at 1 m before the margin."""
    ego = state(Ned(edge_north - 2.0 - 1.0 - more, -3.0, LEVEL_M))
    f = with_fence(fence)
    f.acceleration_m_s2 = (2.25, 0.0)
    s = applied(f, command(Ned(2.25, 0.0, 0.0)), ego)
    assert s.acceleration_north_m_s2 == pytest.approx(min(2.25, 2.25 * (1.0 + more)), abs=2e-3 if not acted else 1e-9)
    assert f.counts == ({"fence": 1} if acted else {})


@pytest.mark.parametrize(
    ("speed", "allowed"), [(0.0, 2.25), (0.5, 0.75), (0.75, 0.0), (1.0, -0.75), (2.0, -3.75), (4.0, -8.0)]
)
def test_toward_the_fence_the_allowed_push_falls_with_the_speed(speed: float, allowed: float) -> None:
    """-2 p v + p^2 h, one metre before the margin; no more than the acceleration limit."""
    f = with_fence(SQUARE)
    f.acceleration_m_s2 = (3.0, 0.0)
    s = applied(f, command(Ned(3.0, 0.0, 0.0)), state(Ned(27.0, 0.0, LEVEL_M), Ned(speed, 0.0, 0.0)))
    assert s.acceleration_north_m_s2 == pytest.approx(allowed, abs=0.005)
    assert f.counts["fence"] == 1
    assert f.counts["fence not attainable"] == (1 if speed == 4.0 else 0)


@pytest.mark.parametrize(
    ("place", "velocity", "wanted", "flown"),
    [
        ((28.0, 28.0), (1.0, 4.0 / 3.0), (0.0, -8.0), (-3.0, -sqrt(55.0))),
        ((28.0, 28.0), (4.0 / 3.0, 1.0), (-8.0, 0.0), (-sqrt(55.0), -3.0)),
        # Nearly all of it is needed.
        ((28.0, 28.0), (1.0, 7.4 / 3.0), (-2.4, -7.6), (-3.0, -sqrt(55.0))),
        ((28.0, 28.0), (7.4 / 3.0, 1.0), (-7.6, -2.4), (-sqrt(55.0), -3.0)),
        ((28.0, 0.0), (7.96 / 3.0, 0.0), (0.0, 8.0), (-7.96, sqrt(64.0 - 7.96**2))),
        ((0.0, 28.0), (0.0, 7.96 / 3.0), (8.0, 0.0), (sqrt(64.0 - 7.96**2), -7.96)),
    ],
)
def test_braking_comes_first_and_what_is_wanted_fills_the_acceleration_limit(
    place: tuple[float, float], velocity: tuple[float, float], wanted: tuple[float, float], flown: tuple[float, float]
) -> None:
    """At the margin a wall asks for 3 /s of the speed toward it; what is wanted leads along it."""
    f = with_fence(SQUARE, jerk_max_m_s3=1e9)
    s = applied(f, command(Ned(*wanted, 0.0)), state(Ned(*place, LEVEL_M), Ned(*velocity, 0.0)))
    assert acceleration(s) == pytest.approx(flown)
    assert f.counts == {"fence": 1, "acceleration": 1}


def test_braking_at_the_fence_is_not_delayed_by_jerk() -> None:
    f = with_fence(SQUARE, jerk_max_m_s3=0.1)
    f.acceleration_m_s2 = (2.0, 0.0)
    s = applied(f, command(Ned(2.0, 0.0, 0.0)), state(Ned(27.0, 0.0, LEVEL_M), Ned(2.0, 0.0, 0.0)))
    assert s.acceleration_north_m_s2 == pytest.approx(-3.75)


def test_what_flies_along_the_fence_is_left_alone() -> None:
    f = with_fence(SQUARE)
    s = applied(f, command(Ned(0.0, 1.0, 0.0)), state(Ned(28.0, 0.0, LEVEL_M), Ned(0.0, 3.0, 0.0)))
    assert acceleration(s) == (0.0, 1.0)
    assert f.counts == {}


@pytest.mark.parametrize(
    ("place", "inward"),
    [((40.0, 0.0), (-1.0, 0.0)), ((-5.0, -31.0), (0.0, 1.0)), ((60.0, 60.0), (-sqrt(0.5), -sqrt(0.5)))],
)
def test_outside_it_is_driven_back_gently_and_counted(place: tuple[float, float], inward: tuple[float, float]) -> None:
    f = with_fence(SQUARE)
    pressed = (-5.0 * inward[0], -5.0 * inward[1])
    f.acceleration_m_s2 = pressed
    s = applied(f, command(Ned(*pressed, 0.0)), state(Ned(*place, LEVEL_M)))
    back = s.acceleration_north_m_s2 * inward[0] + s.acceleration_east_m_s2 * inward[1]
    assert back == pytest.approx(2.0 * FENCE_POLE_PER_S * RETURN_SPEED_M_S)
    assert f.counts == {"outside the fence": 1, "fence": 1}


@pytest.mark.parametrize(("more", "outside"), [(-0.001, 0), (0.0, 0), (0.001, 1)])
def test_outside_is_counted_from_the_edge_on(more: float, outside: int) -> None:
    f = with_fence(SQUARE)
    applied(f, command(), state(Ned(30.0 + more, 0.0, LEVEL_M)))
    assert f.counts["outside the fence"] == outside


@pytest.mark.parametrize("place", [(1e200, 0.0), (-1e154, 1e154), (1e308, 1e308)])
@pytest.mark.parametrize("fence", [CYLINDER, NOTCHED])
def test_absurd_places_give_a_finite_setpoint_or_none(fence: Fence, place: tuple[float, float]) -> None:
    f = with_fence(fence)
    s = f.apply(command(), state(Ned(*place, LEVEL_M), Ned(1e200, 0.0, 0.0)), [], ZERO, DT_S)
    assert s is None or all(isfinite(x) for x in s)
    ordinary = f.apply(command(), state(Ned(0.0, -15.0, LEVEL_M)), [], ZERO, DT_S)
    assert ordinary is not None
    assert acceleration(ordinary) == (0.0, 0.0)


# -- peers before the fence ------------------------------------------------------------------------------------------


def peer(position: Ned, velocity: Ned = ZERO, vehicle_id: int = 2) -> Neighbour:
    return Neighbour(vehicle_id, position, velocity, ZERO, 0.1, False, False, 0.35)


def test_a_vehicle_pressed_to_the_fence_by_a_peer_avoids_the_peer_and_misses_the_fence_least() -> None:
    ego = state(Ned(28.0, 0.0, LEVEL_M))
    closing = peer(Ned(26.9, 0.0, LEVEL_M), Ned(1.0, 0.0, 0.0))
    f = with_fence(SQUARE)
    s = applied(f, command(), ego, (closing,))
    plane = half_plane(ego, ZERO, closing)
    needed = plane.b / plane.g_north
    assert 0.5 < needed < 8.0
    assert s.acceleration_north_m_s2 == pytest.approx(needed, abs=1e-6)
    assert f.counts == {"peer distance": 1, "fence not attainable": 1}


@pytest.mark.parametrize(("angle", "room"), [(pi / 6, 0.0), (pi / 6, 1.5), (-pi / 6, 0.0), (0.09, 2.9), (-0.09, 2.9)])
@pytest.mark.parametrize("wall", [(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)], ids=["N", "S", "E", "W"])
def test_of_what_keeps_the_peer_the_command_that_misses_the_fence_least_is_flown(
    angle: float, room: float, wall: tuple[float, float]
) -> None:
    """The one on the peer's edge, as far along it as the acceleration limit allows."""
    out, along = (-wall[0], -wall[1]), (-wall[1], wall[0])
    away = Ned(out[0] * cos(angle) + along[0] * sin(angle), out[1] * cos(angle) + along[1] * sin(angle), 0.0)
    place = Ned((28.0 - room) * out[0], (28.0 - room) * out[1], LEVEL_M)
    closing = peer(
        Ned(place.north - 2.0 * away.north, place.east - 2.0 * away.east, LEVEL_M),
        Ned(4.0 * away.north, 4.0 * away.east, 0.0),
    )
    plane = half_plane(state(place), ZERO, closing)
    needed = plane.b / hypot(plane.g_north, plane.g_east)
    assert needed == pytest.approx(7.3125)
    f = with_fence(SQUARE)
    s = applied(f, command(), state(place), (closing,))
    beside = sqrt(64.0 - needed**2) * (1.0 if angle > 0.0 else -1.0)
    outward = needed * cos(angle) - beside * sin(angle)
    assert outward > 2.25 * room + 0.1, "the fence is missed by this much"
    u = acceleration(s)
    assert u[0] * out[0] + u[1] * out[1] == pytest.approx(outward, abs=1e-6)
    assert u[0] * along[0] + u[1] * along[1] == pytest.approx(needed * sin(angle) + beside * cos(angle), abs=1e-3)
    assert f.counts["fence not attainable"] == 1
    assert f.counts["peer distance not attainable"] == 0


@pytest.mark.parametrize("axis", [0, 1])
def test_a_peer_that_takes_nearly_the_whole_acceleration_is_avoided_beyond_the_margin(axis: int) -> None:
    def along(x: float, down: float = 0.0) -> Ned:
        return Ned(x, 0.0, down) if axis == 0 else Ned(0.0, x, down)

    f = with_fence(SQUARE)
    s = applied(f, command(), state(along(28.0, LEVEL_M)), (peer(along(25.9, LEVEL_M), along(4.8)),))
    needed = (-(4.8**2) + 5.0 * 4.8 * 2.1 - 3.125 * (2.1**2 - 1.0)) / 2.1
    assert 7.95 < needed < 8.0
    assert acceleration(s) == pytest.approx(tuple(along(needed))[:2], abs=1e-6)
    assert f.counts == {"peer distance": 1, "fence not attainable": 1}


@pytest.mark.parametrize(("miss", "counted"), [(0.0095, 0), (0.0105, 1), (0.5, 1)])
def test_a_fence_missed_by_a_hundredth_of_a_m_s2_is_counted(miss: float, counted: int) -> None:
    place = Ned(28.0 - (7.3125 - miss) / 2.25, 0.0, LEVEL_M)
    closing = peer(Ned(place.north - 2.0, 0.0, LEVEL_M), Ned(4.0, 0.0, 0.0))
    f = with_fence(SQUARE)
    s = applied(f, command(), state(place), (closing,))
    assert s.acceleration_north_m_s2 == pytest.approx(7.3125, abs=1e-6)
    assert f.counts["fence not attainable"] == counted


def test_between_two_peers_that_cannot_both_be_avoided_the_fence_is_still_kept_where_it_costs_them_nothing() -> None:
    """They close in from both sides; braking before the fence, at 3 /s of 1 m/s, brings neither nearer."""
    ego = state(Ned(28.0, 0.0, LEVEL_M), Ned(1.0, 0.0, 0.0))
    sides = (
        peer(Ned(28.0, 0.9, LEVEL_M), Ned(1.0, -1.5, 0.0), 2),
        peer(Ned(28.0, -0.9, LEVEL_M), Ned(1.0, 1.5, 0.0), 3),
    )
    f = with_fence(SQUARE)
    s = applied(f, command(), ego, sides)
    assert acceleration(s) == pytest.approx((-3.0, 0.0), abs=1e-6)
    assert f.counts["peer distance not attainable"] == 1
    assert f.counts["fence not attainable"] == 0


def test_where_neither_can_be_kept_the_peers_miss_no_more_than_without_a_fence() -> None:
    ego = state(Ned(28.5, 0.0, LEVEL_M))
    crowd = (
        peer(Ned(28.5, 0.6, LEVEL_M), Ned(0.0, -2.0, 0.0), 2),
        peer(Ned(28.4, -0.6, LEVEL_M), Ned(0.0, 2.0, 0.0), 3),
    )
    planes = [half_plane(ego, ZERO, n) for n in crowd]
    missed = []
    for fence in (None, SQUARE):
        f = with_fence(fence)
        u = acceleration(applied(f, command(), ego, crowd))
        assert f.counts["peer distance not attainable"] == 1
        missed.append(max(p.b - p.g_north * u[0] - p.g_east * u[1] for p in planes))
    assert missed[1] <= missed[0] + 1e-6


@settings(deadline=None, max_examples=150)
@given(
    st.sampled_from(list(FENCES.values())),
    places,
    st.lists(st.tuples(st.floats(0.1, 3.0), st.floats(-pi, pi), st.floats(-3, 3), st.floats(-3, 3)), max_size=5),
    st.tuples(st.floats(-8.0, 8.0), st.floats(-8.0, 8.0)),
    st.tuples(st.floats(-4.0, 4.0), st.floats(-4.0, 4.0)),
)
def test_the_priority_of_limits_in_any_crowd_anywhere(
    fence: Fence,
    place: tuple[float, float],
    crowd: list[tuple[float, float, float, float]],
    u: tuple[float, float],
    v: tuple[float, float],
) -> None:
    """Acceleration always; peers as well as without the fence; the fence unless it is counted."""
    ego = state(Ned(*place, LEVEL_M), Ned(*v, 0.0))
    neighbours = tuple(
        peer(Ned(place[0] + r * cos(a), place[1] + r * sin(a), LEVEL_M), Ned(x, y, 0.0), k + 2)
        for k, (r, a, x, y) in enumerate(crowd)
    )
    planes = [half_plane(ego, ZERO, n) for n in neighbours]

    def missed(f: SafetyFilter) -> tuple[tuple[float, float], float]:
        flown = acceleration(applied(f, command(Ned(*u, 0.0)), ego, neighbours))
        worst = max((p.b - p.g_north * flown[0] - p.g_east * flown[1] for p in planes), default=-inf)
        return flown, worst

    alone, fenced = with_fence(None), with_fence(fence)
    (_, peers_alone), (flown, peers_fenced) = missed(alone), missed(fenced)
    assert hypot(*flown) <= 8.0 + 1e-9
    assert peers_fenced <= max(peers_alone, 0.0) + 1e-6
    if fenced.counts["fence not attainable"] == 0:
        pole = braking_pole_per_s(4.0, 8.0)
        for wall in fence.walls(*place):
            n_north, n_east, b = wall_plane(wall, *v, pole)
            assert n_north * flown[0] + n_east * flown[1] >= b - 0.011


# -- floor, ceiling, bias ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("asked", "sent", "acted"),
    [(2.499, 2.5, 1), (2.5, 2.5, 0), (2.501, 2.501, 0), (49.499, 49.499, 0), (49.5, 49.5, 0), (49.501, 49.5, 1),
     (-100.0, 2.5, 1), (1e6, 49.5, 1)],
)  # fmt: skip
def test_the_altitude_sent_at_floor_and_ceiling(asked: float, sent: float, acted: int) -> None:
    f = with_fence(CYLINDER)
    s = applied(f, command(place=Ned(0.0, 0.0, -asked)), state(Ned(0.0, 0.0, -10.0)))
    assert s.position_down_m == -sent
    assert f.counts["altitude"] == acted


@pytest.mark.parametrize(
    ("altitude", "down", "sent"),
    [
        (48.5, -0.999, -0.999), (48.5, -1.0, -1.0), (48.5, -1.001, -1.0),  # 1 m/s for the metre that is left
        (49.5, -0.001, 0.0), (49.5, 0.0, 0.0), (49.5, 0.5, 0.5), (49.6, -0.5, 0.0), (55.0, -1.0, 0.0),
        (3.0, 0.499, 0.499), (3.0, 0.5, 0.5), (3.0, 0.501, 0.5), (2.5, 0.001, 0.0), (2.4, 0.3, 0.0), (2.4, -0.3, -0.3),
        (20.0, -1.501, -1.5), (20.0, 1.001, 1.0),
    ],
)  # fmt: skip
@pytest.mark.parametrize("who", ["reference", "vehicle"])
def test_the_vertical_velocity_ends_at_floor_and_ceiling(altitude: float, down: float, sent: float, who: str) -> None:
    """Whichever of the place flown to and the vehicle is nearer to the limit counts."""
    there, middle = Ned(0.0, 0.0, -altitude), Ned(0.0, 0.0, -25.0)
    c = command(place=there if who == "reference" else middle, v_d=Ned(0.0, 0.0, down))
    s = applied(with_fence(CYLINDER), c, state(middle if who == "reference" else there))
    assert s.velocity_down_m_s == pytest.approx(sent)


def test_a_climb_for_ever_ends_at_the_ceilings_margin() -> None:
    """The vehicle follows as PX4 does, at the velocity sent and 1/s toward the altitude sent."""
    f = with_fence(CYLINDER)
    down, highest = -40.0, 0.0
    for k in range(3000):
        asked = command(place=Ned(0.0, 0.0, -40.0 - 1.0 * k * DT_S), v_d=Ned(0.0, 0.0, -1.0))
        s = applied(f, asked, state(Ned(0.0, 0.0, down)))
        down += DT_S * (s.velocity_down_m_s + (s.position_down_m - down))
        highest = max(highest, -down)
    assert highest <= 49.5 + 1e-9
    assert -down == pytest.approx(49.5, abs=0.01)
    assert f.counts["altitude"] > 1000


def test_without_a_fence_altitude_passes_as_it_is() -> None:
    s = applied(with_fence(None), command(place=Ned(0.0, 0.0, -900.0), v_d=Ned(0.0, 0.0, -1.0)), state(ZERO))
    assert (s.position_down_m, s.velocity_down_m_s) == (-900.0, -1.0)


@pytest.mark.parametrize(
    ("bias", "used", "acted"),
    [(0.999, 0.999, 0), (1.0, 1.0, 0), (1.001, 1.0, 1), (1e30, 1.0, 1), (-0.999, -0.999, 0), (-1.001, -1.0, 1)],
)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_velocity_bias_sent_is_bounded(bias: float, used: float, acted: int, axis: int) -> None:
    f = with_fence(None)
    s = applied(f, command(), state(ZERO), bias=Ned(*(bias if k == axis else 0.0 for k in range(3))))
    assert (s.velocity_north_m_s, s.velocity_east_m_s, s.velocity_down_m_s)[axis] == used
    assert f.counts["velocity bias"] == acted


@PROPERTY
@given(*[st.floats(-1e6, 1e6)] * 6)
def test_no_horizontal_speed_sent_exceeds_the_limit_and_the_bias(
    vn: float, ve: float, bn: float, be: float, un: float, ue: float
) -> None:
    f = with_fence(None)
    for _ in range(3):
        s = applied(f, command(Ned(un, ue, 0.0)), state(ZERO, Ned(vn, ve, 0.0)), bias=Ned(bn, be, 0.0))
        assert hypot(s.velocity_north_m_s, s.velocity_east_m_s) <= 4.0 + sqrt(2.0) + 1e-9


# -- flights -----------------------------------------------------------------------------------------------------------

Push = Callable[[float, Ned, Ned], tuple[float, float]]


def fly(
    fence: Fence | None,
    place: Ned,
    velocity: Ned,
    push: Push,
    *,
    seconds: float = 20.0,
    lag_s: float = LAG_S,
    delay_s: float = DELAY_S,
    gust: Push = lambda t, p, v: (0.0, 0.0),
    around: Fence | None = None,
    limits: SafetyLimits = LIMITS,
) -> float:
    """A double integrator with lag under delayed states, pushed by a broken law; its least clearance of the fence."""
    f = SafetyFilter(replace(limits, fence=fence))
    p, v, flown = place, velocity, (0.0, 0.0)
    known: deque[VehicleState] = deque(maxlen=round(delay_s / DT_S) + 1)
    least = inf
    for k in range(round(seconds / DT_S)):
        known.append(state(p, v))
        s = applied(f, command(Ned(*push(k * DT_S, p, v), 0.0)), known[0])
        assert hypot(*acceleration(s)) <= limits.avoidance_acceleration_m_s2 + 1e-9
        keep = exp(-DT_S / lag_s) if lag_s > 0.0 else 0.0
        flown = tuple(u + (a - u) * keep for u, a in zip(acceleration(s), flown, strict=True))  # type: ignore[assignment]
        g = gust(k * DT_S, p, v)
        a = (flown[0] + g[0], flown[1] + g[1])
        p = Ned(p.north + DT_S * (v.north + 0.5 * DT_S * a[0]), p.east + DT_S * (v.east + 0.5 * DT_S * a[1]), p.down)
        v = Ned(v.north + DT_S * a[0], v.east + DT_S * a[1], 0.0)
        least = min(least, (around or fence or CYLINDER).edge_clearance_m(p.north, p.east))
    return least


def straight(north: float, east: float, push_m_s2: float = 5.0) -> Push:
    """At the speed limit in one direction, pushed by a_max."""
    size = hypot(north, east)
    return lambda t, p, v: (push_m_s2 * north / size, push_m_s2 * east / size)


INTO = [
    ("cylinder", (-20.0, -3.0), (1.0, 0.0)),
    ("cylinder", (-10.0, 5.0), (1.0, 1.0)),
    ("square", (0.0, 0.0), (1.0, 0.0)),
    ("square", (0.0, 0.0), (1.0, 1.0)),  # a corner
    ("square", (0.0, 10.0), (1.0, 0.4)),
    ("sharp", (-10.0, 0.0), (1.0, 0.0)),  # between walls that come together
    ("notched", (-20.0, 0.0), (1.0, 0.0)),  # the notch's point, head on
    ("notched", (-20.0, -1.5), (1.0, 0.05)),
    ("notched", (10.0, 20.0), (0.3, -1.0)),  # the notch's side
    ("slit", (-20.0, 0.0), (1.0, 0.0)),  # into the blind alley, to its end
    ("slit", (-20.0, -15.0), (1.0, 0.62)),  # at the alley's inner corner
]


@pytest.mark.parametrize(("name", "place", "way"), INTO)
def test_a_vehicle_at_the_speed_limit_brakes_before_the_fence(
    name: str, place: tuple[float, float], way: tuple[float, float]
) -> None:
    """4 m/s, pressed on with 5 m/s^2, 0.3 s of lag and 100 ms of delay: of the 2 m of margin two thirds stay."""
    v = Ned(4.0 * way[0] / hypot(*way), 4.0 * way[1] / hypot(*way), 0.0)
    fence = FENCES[name]
    assert fly(fence, Ned(*place, LEVEL_M), v, straight(*way)) > 1.3
    assert fly(fence, Ned(*place, LEVEL_M), v, straight(*way), lag_s=0.0, delay_s=0.0) > 1.99
    assert fly(None, Ned(*place, LEVEL_M), v, straight(*way), around=fence) < 0.0, "without the filter it leaves"


@pytest.mark.parametrize(("speed", "avoidance"), [(12.0, 8.0), (8.0, 4.0), (4.0, 1.0), (0.2, 8.0)])
def test_whatever_the_limits_it_brakes_before_the_fence(speed: float, avoidance: float) -> None:
    limits = replace(LIMITS, speed_max_m_s=speed, avoidance_acceleration_m_s2=avoidance)
    wide = Fence(2.0, 50.0, radius_m=100.0)
    least = fly(
        wide, ZERO, Ned(speed, 0.0, 0.0), straight(1.0, 0.0), seconds=200.0 if speed < 1 else 60.0, limits=limits
    )
    assert least > 0.9


def outward(fence: Fence) -> Push:
    """A law that always pushes away from the fence's inside, at a_max and along its slope."""

    def push(t: float, p: Ned, v: Ned) -> tuple[float, float]:
        wall = min(fence.walls(p.north, p.east))
        return -5.0 * wall.north, -5.0 * wall.east

    return push


@settings(deadline=None, max_examples=40)
@given(
    st.sampled_from(list(FENCES.values())), st.tuples(st.floats(-25.0, 25.0), st.floats(-25.0, 25.0)),
    st.integers(0, 2**32), st.floats(0.0, 0.3), st.sampled_from([0.0, 0.06, 0.1]), st.floats(0.1, 8.0),
)  # fmt: skip
def test_no_law_and_no_gust_of_1_m_s2_takes_a_vehicle_out_of_the_fence(
    fence: Fence, place: tuple[float, float], seed: int, lag_s: float, delay_s: float, change_s: float
) -> None:
    """From rest inside; the law pushes outward or anywhere, the gust is as large as it gets and turns at will. Half of
    the margin stays."""
    if fence.edge_room_m(*place) < 0.1:
        return
    rng = random.Random(seed)
    out = outward(fence)
    turns = [rng.uniform(-pi, pi) for _ in range(400)]
    honest = [rng.random() < 0.7 for _ in range(400)]

    def push(t: float, p: Ned, v: Ned) -> tuple[float, float]:
        k = int(t / change_s)
        return out(t, p, v) if honest[k] else (5.0 * cos(turns[k]), 5.0 * sin(turns[k]))

    def gust(t: float, p: Ned, v: Ned) -> tuple[float, float]:
        k = int(t / change_s)
        wall = min(fence.walls(p.north, p.east))
        return (-wall.north, -wall.east) if honest[-1 - k] else (cos(turns[-1 - k]), sin(turns[-1 - k]))

    start = Ned(*place, LEVEL_M)
    assert fly(fence, start, ZERO, push, lag_s=lag_s, delay_s=delay_s, gust=gust) > 1.0


def test_a_vehicle_blown_out_comes_back_slowly_and_stays() -> None:
    """Twelve metres outside, its law pressing on: back behind the edge at a metre per second."""
    f = SafetyFilter(replace(LIMITS, fence=SQUARE))
    p, v, fastest = Ned(42.0, 0.0, LEVEL_M), ZERO, 0.0
    for _ in range(1500):
        s = applied(f, command(Ned(5.0, 0.0, 0.0)), state(p, v))
        p = Ned(p.north + DT_S * v.north, 0.0, LEVEL_M)
        v = Ned(v.north + DT_S * s.acceleration_north_m_s2, 0.0, 0.0)
        fastest = max(fastest, -v.north)
    assert fastest <= RETURN_SPEED_M_S + 0.01
    assert p.north == pytest.approx(28.0, abs=0.05)
    assert 500 < f.counts["outside the fence"] < 800


def test_the_sides_of_a_notch_are_straight_lines_to_a_library() -> None:
    """The notched fence is what its drawing says: its inner corner is on the line of sight between two places."""
    assert LineString([(20.0, -20.0), (20.0, 20.0)]).crosses(Polygon(NOTCHED.corners_m).exterior)
    assert not NOTCHED.contains(Ned(20.0, 0.0, LEVEL_M))
