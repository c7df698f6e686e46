"""The safety filter: its barrier, its quadratic program, its limits, and flights that collide without it."""

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import cos, dist, hypot, inf, isfinite, nan, pi, sin, sqrt

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from companion.core.counts import OTHER
from companion.core.frames import Ned
from companion.core.safety.avoidance import sidestep
from companion.core.safety.filter import (
    COLLISION_DISTANCE_M,
    DOWNWASH_RATIO,
    LAG_ALLOWANCE_M,
    POLE_PER_S,
    HalfPlane,
    SafetyFilter,
    SafetyLimits,
    half_plane,
    nearest_hypothesis,
    out_of_reach,
    safety_radius_m,
)
from companion.core.safety.program import solve
from companion.core.values import Command, Neighbour, SafeSetpoint, VehicleState

PROPERTY = settings(deadline=None, max_examples=60)
ZERO = Ned(0.0, 0.0, 0.0)
DT_S = 0.02
LIMITS = SafetyLimits(
    speed_max_m_s=3.0, climb_max_m_s=1.5, descent_max_m_s=1.0, jerk_max_m_s3=30.0, avoidance_acceleration_m_s2=8.0
)


def command(u: Ned = ZERO, v_d: Ned = ZERO, a_d: Ned = ZERO, place: Ned = ZERO, yaw: float = 0.0) -> Command:
    return Command(u, place, v_d, a_d, yaw)


def state(position: Ned = ZERO, velocity: Ned = ZERO) -> VehicleState:
    return VehicleState(0, position, velocity)


def peer(
    position: Ned, velocity: Ned = ZERO, *, shares: bool = False, uncertainty_m: float = 0.35, **more: object
) -> Neighbour:
    return Neighbour(
        vehicle_id=int(more.pop("vehicle_id", 2)), position_ned_m=position, velocity_ned_m_s=velocity,  # type: ignore[call-overload]
        offset_ned_m=ZERO, age_s=0.1, in_formation=shares, shares_avoidance=shares, uncertainty_m=uncertainty_m,
        **more,  # type: ignore[arg-type]
    )  # fmt: skip


def applied(f: SafetyFilter, c: Command, ego: VehicleState, neighbours: Sequence[Neighbour] = ()) -> SafeSetpoint:
    setpoint = f.apply(c, ego, neighbours, ZERO, DT_S)
    assert setpoint is not None
    assert OTHER not in f.counts, "whatever acts has a name of its own"
    return setpoint


def acceleration(s: SafeSetpoint) -> tuple[float, float]:
    return s.acceleration_north_m_s2, s.acceleration_east_m_s2


commands_2d = st.tuples(st.floats(-8.0, 8.0), st.floats(-8.0, 8.0))


def missed(u: tuple[float, float], planes: Sequence[HalfPlane]) -> float:
    return max((p.b - p.g_north * u[0] - p.g_east * u[1] for p in planes), default=-inf)


def nearest(u: tuple[float, float], planes: Sequence[HalfPlane]) -> tuple[float, float]:
    rows = [list(p) for p in planes]
    return solve(*u, rows, len(rows), len(rows), 8.0, [[0.0] * 3 for _ in rows])[:2]


# -- the barrier -----------------------------------------------------------------------------------------------------

vectors = st.builds(Ned, *[st.floats(-6.0, 6.0)] * 3)
level = st.builds(Ned, st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), st.just(0.0))


def barrier_condition(ego: VehicleState, n: Neighbour, u: Ned, u_j: Ned) -> float:
    """(h'' + 5 h' + 6.25 h)/(2 r) at this moment, from h(t) along the two parabolas, differentiated numerically."""
    d = COLLISION_DISTANCE_M + LAG_ALLOWANCE_M + n.uncertainty_m

    def h(t: float) -> float:
        x = [
            p - q + (v - w) * t + 0.5 * (a - b) * t * t
            for p, q, v, w, a, b in zip(
                ego.position_ned_m, n.position_ned_m, ego.velocity_ned_m_s, n.velocity_ned_m_s, u, u_j, strict=True
            )
        ]
        return x[0] ** 2 + x[1] ** 2 + (x[2] / DOWNWASH_RATIO) ** 2 - d**2

    step = 1e-3
    h0, h1, h2 = h(0.0), h(step), h(-step)
    whole = (h1 + h2 - 2 * h0) / step**2 + 2 * POLE_PER_S * (h1 - h2) / (2 * step) + POLE_PER_S**2 * h0
    return whole / (2.0 * max(sqrt(h0 + d**2), COLLISION_DISTANCE_M))


@PROPERTY
@given(vectors, vectors, vectors, vectors, level, st.floats(0.0, 1.5))
def test_half_plane_of_a_peer_that_does_not_avoid_is_the_whole_barrier(
    p: Ned, v: Ned, q: Ned, w: Ned, u: Ned, uncertainty_m: float
) -> None:
    assume(hypot(p.north - q.north, p.east - q.east) > 0.01)
    ego, n = state(p, v), peer(q, w, uncertainty_m=uncertainty_m)
    plane = half_plane(ego, Ned(0.7, -0.3, 0.0), n)
    slack = plane.g_north * u.north + plane.g_east * u.east - plane.b
    assert slack == pytest.approx(barrier_condition(ego, n, u, ZERO), abs=1e-3, rel=1e-5)


@PROPERTY
@given(vectors, vectors, vectors, vectors, st.tuples(level, level), st.tuples(level, level))
def test_halves_of_a_pair_make_up_the_whole_barrier_whatever_the_plan_asks_of_each(
    p: Ned, v: Ned, q: Ned, w: Ned, u: tuple[Ned, Ned], a: tuple[Ned, Ned]
) -> None:
    assume(hypot(p.north - q.north, p.east - q.east) > 0.01)
    mine = half_plane(state(p, v), a[0], peer(q, w, shares=True, reference_acceleration_ned_m_s2=a[1]))
    theirs = half_plane(state(q, w), a[1], peer(p, v, shares=True, reference_acceleration_ned_m_s2=a[0]))
    slack = sum(x.g_north * y.north + x.g_east * y.east - x.b for x, y in ((mine, u[0]), (theirs, u[1])))
    assert slack == pytest.approx(barrier_condition(state(p, v), peer(q, w), *u), abs=1e-3, rel=1e-5)


@pytest.mark.parametrize(
    ("north", "closing", "b"),
    [(1.0, 0.0, 0.0), (2.0, 0.0, -18.75), (2.0, 1.0, -0.75), (2.0, 3.0, 23.25), (0.5, 0.0, 4.6875), (1.0, -1.0, -12.0)],
)
def test_the_barriers_poles_are_at_2_5_per_second(north: float, closing: float, b: float) -> None:
    """-(h'' + 5 h' + 6.25 h)/(2 r) of a peer that flies straight on, h = |x|^2 - (1 m)^2."""
    plane = half_plane(state(), ZERO, peer(Ned(north, 0.0, 0.0), Ned(-closing, 0.0, 0.0), vehicle_id=7))
    assert plane == pytest.approx((-1.0, 0.0, b / (2.0 * north), 7, -closing, 0.0))


def test_full_share_is_taken_toward_a_peer_that_does_not_avoid() -> None:
    ego = state(velocity=Ned(1.0, 0.0, 0.0))
    half, whole = (half_plane(ego, ZERO, peer(Ned(2.0, 0.5, 0.0), shares=shares)) for shares in (True, False))
    assert whole.b == pytest.approx(2.0 * half.b)
    assert whole[:2] == half[:2] == pytest.approx((-4.0 / sqrt(17.0), -1.0 / sqrt(17.0)))


@pytest.mark.parametrize(("r", "size"), [(0.1, 0.2), (0.49, 0.98), (0.5, 1.0), (0.51, 1.0), (3.0, 1.0)])
@pytest.mark.parametrize("way", [(1.0, 0.0, 0.0), (0.0, -0.6, 2.0), (0.48, 0.64, -1.5)])
def test_a_half_plane_is_of_the_distances_acceleration_and_two_that_touch_do_not_outweigh_all_others(
    r: float, size: float, way: tuple[float, float, float]
) -> None:
    """|g| is 1 on one level; at rest b is 6.25 (d^2 - r^2)/(2 r)."""
    plane = half_plane(state(), ZERO, peer(Ned(*(-r * x for x in way))))
    assert hypot(plane.g_north, plane.g_east) == pytest.approx(size * hypot(*way[:2]))
    assert plane.b == pytest.approx(6.25 * (1.0 - r * r) / (2.0 * max(r, 0.5)))


def test_a_half_plane_of_a_wall_is_nobodys_and_stands() -> None:
    assert HalfPlane(1.0, 0.0, 2.0) == (1.0, 0.0, 2.0, 0, 0.0, 0.0)


def test_a_half_plane_tells_the_obstacles_velocity() -> None:
    drifting = peer(Ned(3.0, -1.0, 0.0), Ned(0.0, 0.4, 0.3), last_seen_ned_m=Ned(3.0, 1.0, 0.0))
    assert half_plane(state(), ZERO, drifting)[4:] == pytest.approx((0.0, 0.2))
    assert half_plane(state(), ZERO, peer(Ned(3.0, -1.0, 0.0), Ned(1.0, 0.4, 0.3)))[4:] == (1.0, 0.4)


def test_toward_a_peer_that_shares_the_command_counts_from_the_mean_of_both_slots() -> None:
    ego, mean = state(velocity=Ned(1.0, 0.0, 0.0)), Ned(0.5, -0.75, 0.0)
    own, theirs = Ned(2.0, -1.0, 0.0), Ned(-1.0, -0.5, 0.0)
    n = peer(Ned(2.0, 0.5, 0.0), shares=True, reference_acceleration_ned_m_s2=theirs)
    resting, moving = half_plane(ego, ZERO, n._replace(reference_acceleration_ned_m_s2=ZERO)), half_plane(ego, own, n)
    assert moving.b - resting.b == pytest.approx(moving.g_north * mean.north + moving.g_east * mean.east)


def test_safety_radius_is_collision_lag_and_uncertainty() -> None:
    assert safety_radius_m(0.35) == pytest.approx(1.0)
    assert safety_radius_m(0.0) == pytest.approx(0.65)


def test_vertical_distance_counts_less_by_the_downwash() -> None:
    """2.5 m above is as near as 1 m beside."""
    beside = half_plane(state(), ZERO, peer(Ned(-1.0, 0.0, 0.0)))
    above = half_plane(state(), ZERO, peer(Ned(-1e-2, 0.0, -2.5)))
    assert beside.b == pytest.approx(0.0, abs=1e-12)
    assert above.b == pytest.approx(0.0, abs=1e-3)


@PROPERTY
@given(vectors, vectors, vectors, vectors)
def test_the_nearest_place_of_a_lost_peer_is_the_nearest_of_its_segment(ego: Ned, a: Ned, b: Ned, v: Ned) -> None:
    place, velocity = nearest_hypothesis(ego, peer(a, v, last_seen_ned_m=b))
    shares = np.linspace(0.0, 1.0, 401)
    scale = np.array([1.0, 1.0, 1.0 / DOWNWASH_RATIO])  # the ellipsoid's measure
    segment = (1 - shares)[:, None] * np.array(a) + shares[:, None] * np.array(b)
    nearest = np.linalg.norm((segment - np.array(ego)) * scale, axis=1).min()
    # A segment shorter than a micrometre counts as a place.
    assert np.linalg.norm((np.array(place) - np.array(ego)) * scale) <= nearest + 1e-6
    share = dist(place, a) / dist(a, b) if dist(a, b) > 1e-4 else 0.0
    assert velocity == pytest.approx([(1 - share) * x for x in v], abs=1e-5)


@PROPERTY
@given(level, level, level)
def test_flying_along_a_lost_peers_segment_carries_nobody_away_from_it(ego: Ned, v: Ned, u: Ned) -> None:
    """Beside the segment only the motion across it counts: the barrier is that of a wall."""
    beside = Ned(ego.north, 0.5 + abs(ego.east), 0.0)
    n = peer(Ned(20.0, 0.0, 0.0), last_seen_ned_m=Ned(-20.0, 0.0, 0.0))
    plane = half_plane(state(beside, v), ZERO, n)
    wall = barrier_condition(
        state(Ned(0.0, beside.east, 0.0), Ned(0.0, v.east, 0.0)), peer(ZERO), Ned(0.0, u.east, 0.0), ZERO
    )
    slack = plane.g_north * u.north + plane.g_east * u.east - plane.b
    assert slack == pytest.approx(wall, abs=1e-3, rel=1e-5)


@PROPERTY
@given(vectors, vectors, vectors, vectors, level)
def test_beside_a_slanted_segment_the_barrier_is_that_of_its_line(p: Ned, v: Ned, a: Ned, b: Ned, u: Ned) -> None:
    """h'' + 5 h' + 6.25 h of the distance to the line, vertical lengths divided by the downwash, numerically."""
    scale = np.array([1.0, 1.0, 1.0 / DOWNWASH_RATIO])
    way = (np.array(b) - np.array(a)) * scale
    assume(np.linalg.norm(way) > 0.5)

    def across(t: float) -> np.ndarray:
        x = (np.array(p) + t * np.array(v) + 0.5 * t * t * np.array(u) - np.array(a)) * scale
        return x - way * (x @ way) / (way @ way)

    share = ((np.array(p) - np.array(a)) * scale) @ way / (way @ way)
    assume(0.01 < share < 0.99)
    assume(hypot(*across(0.0)[:2]) > 0.01)
    step = 1e-3
    h0, h1, h2 = (float(across(t) @ across(t)) - 1.0 for t in (0.0, step, -step))
    whole = (h1 + h2 - 2 * h0) / step**2 + 5.0 * (h1 - h2) / (2 * step) + 6.25 * h0
    whole /= 2.0 * max(sqrt(h0 + 1.0), COLLISION_DISTANCE_M)
    plane = half_plane(state(p, v), ZERO, peer(a, last_seen_ned_m=b))
    assert plane.g_north * u.north + plane.g_east * u.east - plane.b == pytest.approx(whole, abs=1e-3, rel=1e-4)


@pytest.mark.parametrize(("north", "end", "moves"), [(21.0, 20.0, 0.5), (-21.0, -20.0, 0.0)])
def test_beyond_its_ends_a_lost_peers_segment_is_the_place_of_the_end(north: float, end: float, moves: float) -> None:
    ego = state(Ned(north, 0.4, 0.0), Ned(-1.0, 0.3, 0.0))
    lost = peer(Ned(20.0, 0.0, 0.0), Ned(0.5, 0.0, 0.0), last_seen_ned_m=Ned(-20.0, 0.0, 0.0))
    assert half_plane(ego, ZERO, lost) == half_plane(ego, ZERO, peer(Ned(end, 0.0, 0.0), Ned(moves, 0.0, 0.0)))


def test_a_lost_peer_whose_ends_meet_has_one_place() -> None:
    a = Ned(1.0, 2.0, 3.0)
    assert nearest_hypothesis(ZERO, peer(a, Ned(1.0, 0.0, 0.0), last_seen_ned_m=a)) == (a, (1.0, 0.0, 0.0))


@pytest.mark.parametrize("uncertainty", [0.0, 0.35, 1.0])
@pytest.mark.parametrize(("share", "kept"), [(0.999, False), (1.0, True), (1.001, True)])
def test_distance_at_the_safety_radius(share: float, kept: bool, uncertainty: float) -> None:
    """At rest: just inside it is pushed away, at it and just outside it may stay."""
    place = Ned(share * (COLLISION_DISTANCE_M + LAG_ALLOWANCE_M + uncertainty), 0.0, 0.0)
    f = SafetyFilter(LIMITS)
    s = applied(f, command(), state(), [peer(place, uncertainty_m=uncertainty)])
    assert (acceleration(s) == (0.0, 0.0)) is kept
    assert s.acceleration_north_m_s2 <= 0.0
    assert f.counts == ({} if kept else {"peer distance": 1})


@pytest.mark.parametrize(("share", "kept"), [(0.99, False), (1.0, True), (1.01, True)])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_distance_at_the_downwash(share: float, kept: bool, side: float) -> None:
    """Above or below one another, 2.5 times the safety radius is as near as it gets."""
    f = SafetyFilter(LIMITS)
    s = applied(f, command(), state(), [peer(Ned(0.1, 0.0, side * share * 2.5), uncertainty_m=0.35)])
    assert (acceleration(s) == (0.0, 0.0)) is kept
    assert f.counts["peer distance"] == (0 if kept else 1)


# -- peers out of reach ------------------------------------------------------------------------------------------------

far = st.builds(Ned, st.floats(-80.0, 80.0), st.floats(-80.0, 80.0), st.floats(-60.0, 60.0))
fast = st.builds(Ned, *[st.floats(-12.0, 12.0)] * 3)


@settings(deadline=None, max_examples=500)
@given(far, fast, far, fast, level, level, st.booleans(), st.floats(0.0, 3.0), st.floats(0.1, 8.0), st.floats(-pi, pi))
def test_a_peer_out_of_reach_binds_no_command(
    p: Ned, v: Ned, q: Ned, w: Ned, s: Ned, t: Ned, shares: bool, uncertainty_m: float, most: float, angle: float
) -> None:
    n = peer(q, w, shares=shares, uncertainty_m=uncertainty_m, reference_acceleration_ned_m_s2=t)
    if out_of_reach(state(p, v), s, n, most):
        plane = half_plane(state(p, v), s, n)
        assert most * (plane.g_north * cos(angle) + plane.g_east * sin(angle)) >= plane.b
        assert plane.b <= -most * hypot(plane.g_north, plane.g_east) + 1e-9


def test_the_filter_tells_the_half_planes_of_the_peers_within_reach_as_of_its_last_command() -> None:
    f, ego = SafetyFilter(LIMITS), state()
    near, far = peer(Ned(2.0, 0.0, 0.0)), peer(Ned(1000.0, 0.0, 0.0), vehicle_id=3)
    applied(f, command(), ego, [near, far])
    assert f.peer_planes == [half_plane(ego, ZERO, near)]
    applied(f, command(), ego, [far])
    assert f.peer_planes == []


@pytest.mark.parametrize("shares", [True, False])
@pytest.mark.parametrize("closing", [0.0, 2.0, 8.0])
def test_the_reach_is_not_much_longer_than_it_must_be(shares: bool, closing: float) -> None:
    """Where a peer is within reach some command comes near its edge: at three quarters of the way it is broken."""
    n = [peer(Ned(0.1 * k, 0.0, 0.0), shares=shares) for k in range(10, 600)]
    ego = state(velocity=Ned(closing, 0.0, 0.0))
    reach = max(x.position_ned_m.north for x in n if not out_of_reach(ego, ZERO, x, 8.0))
    plane = half_plane(ego, ZERO, peer(Ned(0.75 * reach, 0.0, 0.0), shares=shares))
    assert plane.b > -8.0 * hypot(plane.g_north, plane.g_east)


@PROPERTY
@given(
    st.lists(st.tuples(st.floats(0.3, 40.0), st.floats(-pi, pi), st.floats(-3, 3), st.floats(-3, 3)), max_size=12),
    commands_2d, st.booleans(),
)  # fmt: skip
def test_leaving_out_what_is_out_of_reach_changes_no_setpoint(
    crowd: list[tuple[float, float, float, float]], u: tuple[float, float], shares: bool
) -> None:
    """A lost peer whose line is a point is the same obstacle, and never left out."""
    quick, full = SafetyFilter(LIMITS), SafetyFilter(LIMITS)
    near, lines = [], []
    for k, (r, a, v, w) in enumerate(crowd):
        place = Ned(r * cos(a), r * sin(a), 0.0)
        near.append(peer(place, Ned(v, w, 0.0), vehicle_id=k + 2, shares=shares))
        lines.append(near[-1]._replace(last_seen_ned_m=place))
    assert applied(quick, command(Ned(*u, 0.0)), state(), near) == applied(full, command(Ned(*u, 0.0)), state(), lines)
    assert quick.counts == full.counts


@pytest.mark.parametrize("place", [inf, nan, 1e7, 1e160])
def test_a_peer_at_no_place_is_never_out_of_reach(place: float) -> None:
    assert not out_of_reach(state(), ZERO, peer(Ned(place, 0.0, 0.0)), 8.0)


@pytest.mark.parametrize("way", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 2.5), (0.48, 0.64, -1.5)])
@pytest.mark.parametrize(
    ("own", "theirs", "shares", "reach"),
    [
        (ZERO, ZERO, False, 1.0 + 16.0 / 6.25),
        (Ned(2.0, 1.0, 0.0), Ned(-1.0, -3.0, 0.0), False, 1.0 + (10.0 * 5.0 + 16.0) / 6.25),
        (Ned(0.0, 0.0, 4.0), Ned(0.0, 0.0, -1.0), False, 1.0 + (10.0 * 2.0 + 16.0) / 6.25),
        (ZERO, ZERO, True, 1.0 + 4.0 * (8.0 + 2.5) / 6.25),
        (Ned(2.0, 1.0, 0.0), Ned(-1.0, -3.0, 0.0), True, 1.0 + (10.0 * 5.0 + 4.0 * (8.0 + 2.5)) / 6.25),
    ],
)
def test_the_reach_is_the_safety_radius_and_what_braking_takes(
    own: Ned, theirs: Ned, shares: bool, reach: float, way: tuple[float, float, float]
) -> None:
    """d + (4 p w + k)/p^2 with p = 2.5 /s; k is 2 U, or 4 (U + S) with S the mean of what both plans ask."""
    asked, asked_of_peer = Ned(1.0, 2.0, 0.0), Ned(2.0, 2.0, 0.0)
    for share, beyond in ((1.0 - 1e-9, False), (1.0 + 1e-9, True)):
        n = peer(
            Ned(*(share * reach * x for x in way)), theirs, shares=shares, reference_acceleration_ned_m_s2=asked_of_peer
        )
        assert out_of_reach(state(velocity=own), asked, n, 8.0) is beyond


@pytest.mark.parametrize(("place", "left_out"), [(999_999.0, True), (1e6, False), (1_000_001.0, False)])
def test_a_peer_a_thousand_kilometres_away_is_looked_at_in_full(place: float, left_out: bool) -> None:
    assert out_of_reach(state(), ZERO, peer(Ned(0.0, place, 0.0)), 8.0) is left_out


@pytest.mark.parametrize("above", [0.0, 1e-6, 0.3, -0.3])
def test_two_vehicles_exactly_above_one_another_leave_in_opposite_directions(above: float) -> None:
    upper, lower = Ned(5.0, 5.0, -10.0 - above), Ned(5.0, 5.0, -10.0)
    one, two = (
        applied(SafetyFilter(LIMITS), command(), state(me), [peer(other, shares=True)])
        for me, other in ((upper, lower), (lower, upper))
    )
    assert hypot(*acceleration(one)) > 1.0
    if above != 0.0:
        assert acceleration(one) == pytest.approx([-x for x in acceleration(two)])


# -- nothing but finite setpoints ------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [nan, inf, -inf])
@pytest.mark.parametrize(
    "field",
    ["position", "velocity", "bias", "dt", "reference_position", "reference_velocity", "reference_acceleration", "yaw"],
)
@pytest.mark.parametrize("axis", range(3))
def test_a_state_or_reference_that_is_not_finite_gives_no_setpoint(bad: float, field: str, axis: int) -> None:
    broken = Ned(*(bad if k == axis else 0.5 for k in range(3)))
    f = SafetyFilter(LIMITS)
    c = Command(
        Ned(1.0, 0.0, 0.0),
        broken if field == "reference_position" else ZERO,
        broken if field == "reference_velocity" else ZERO,
        broken if field == "reference_acceleration" else ZERO,
        bad if field == "yaw" else 0.0,
    )
    ego = state(broken if field == "position" else ZERO, broken if field == "velocity" else ZERO)
    bias = broken if field == "bias" else ZERO
    assert f.apply(c, ego, [peer(Ned(1.5, 0.0, 0.0))], bias, bad if field == "dt" else DT_S) is None
    assert f.counts == {"not finite": 1}
    assert f.apply(command(), state(), [], ZERO, DT_S) is not None  # and nothing of it stays
    assert f.apply(c, ego, [], bias, bad if field == "dt" else DT_S) is None
    assert f.counts == {"not finite": 2}


def test_finite_numbers_whose_products_are_not_give_no_setpoint_and_nothing_of_them_stays() -> None:
    f = SafetyFilter(LIMITS)
    for ticks in (1, 2):
        assert f.apply(command(), state(velocity=Ned(1e308, 0.0, 0.0)), [], ZERO, DT_S) is None
        assert f.counts["not finite"] == ticks
    s = applied(f, command(), state(velocity=Ned(0.5, 0.0, 0.0)))
    assert acceleration(s) == (0.0, 0.0)
    assert s.velocity_north_m_s == 0.5


@pytest.mark.parametrize("bad", [nan, inf, -inf])
def test_a_command_that_is_not_finite_brakes(bad: float) -> None:
    f = SafetyFilter(LIMITS)
    s = applied(f, command(Ned(bad, 0.0, 0.0)), state(velocity=Ned(1.0, -0.5, 0.0)))
    assert acceleration(s) == (-1.0, 0.5)
    assert f.counts == {"command not finite: braking": 1}
    s = applied(f, command(Ned(0.0, bad, 0.0)), state(velocity=Ned(30.0, 0.0, 0.0)))
    assert acceleration(s) == pytest.approx((-8.0, 0.0))


@pytest.mark.parametrize("bad", [nan, inf, -inf])
@pytest.mark.parametrize("field", ["position", "velocity", "uncertainty", "other end", "reference"])
def test_a_peer_that_is_not_finite_makes_it_brake_and_the_others_are_kept_apart_from(bad: float, field: str) -> None:
    broken = Ned(9.0, bad, 0.0)
    strange = peer(
        broken if field == "position" else Ned(9.0, 0.0, 0.0),
        broken if field == "velocity" else ZERO,
        uncertainty_m=bad if field == "uncertainty" else 0.35,
        last_seen_ned_m=broken if field == "other end" else None,
        shares=field == "reference",
        reference_acceleration_ned_m_s2=broken if field == "reference" else ZERO,
    )
    f = SafetyFilter(LIMITS)
    s = applied(f, command(Ned(3.0, 0.0, 0.0)), state(velocity=Ned(1.0, -0.5, 0.0)), [strange])
    assert acceleration(s) == (-1.0, 0.5)
    assert f.counts == {"peer not finite: braking": 1}
    ahead = peer(Ned(1.1, 0.0, 0.0), vehicle_id=3)
    s = applied(f, command(Ned(3.0, 0.0, 0.0)), state(velocity=Ned(1.0, 0.0, 0.0)), [strange, ahead])
    assert s.acceleration_north_m_s2 < -2.0


anything = st.one_of(st.floats(), st.floats(-10.0, 10.0), st.sampled_from([nan, inf, -inf, 0.0, 1e200, -1e308, 1e38]))
any_vector = st.builds(Ned, anything, anything, anything)


@settings(deadline=None, max_examples=150)
@given(
    st.builds(Command, any_vector, any_vector, any_vector, any_vector, anything),
    st.builds(VehicleState, st.just(0), any_vector, any_vector),
    st.lists(
        st.builds(
            Neighbour, st.integers(2, 9), any_vector, any_vector, any_vector, anything, st.booleans(), st.booleans(),
            anything, st.one_of(st.none(), any_vector), any_vector, any_vector,
        ),
        max_size=3,
    ),
    any_vector,
    anything,
)  # fmt: skip
def test_whatever_comes_in_a_setpoint_is_finite_or_none(
    c: Command, ego: VehicleState, neighbours: list[Neighbour], bias: Ned, dt_s: float
) -> None:
    f = SafetyFilter(LIMITS)
    for _ in range(2):
        s = f.apply(c, ego, neighbours, bias, dt_s)
        if s is not None:
            assert all(isfinite(x) for x in s)
            assert hypot(*acceleration(s)) <= LIMITS.avoidance_acceleration_m_s2 * (1 + 1e-9)
    assert OTHER not in f.counts
    ordinary = f.apply(command(), state(), [], ZERO, DT_S)
    assert ordinary is not None
    assert isfinite(ordinary.velocity_north_m_s)


# -- limits ----------------------------------------------------------------------------------------------------------


def settled(limits: SafetyLimits, u: tuple[float, float] = (0.0, 0.0)) -> SafetyFilter:
    """A filter that has flown u last."""
    return SafetyFilter(limits, acceleration_m_s2=u)


@pytest.mark.parametrize(
    ("size", "flown", "acted"),
    [(7.999, 7.999, 0), (8.0, 8.0, 0), (8.001, 8.0, 1), (80.0, 8.0, 1)],
)
def test_acceleration_at_its_limit(size: float, flown: float, acted: int) -> None:
    f = settled(replace(LIMITS, jerk_max_m_s3=1e9))
    s = applied(f, command(Ned(0.6 * size, -0.8 * size, 0.0)), state())
    assert acceleration(s) == pytest.approx((0.6 * flown, -0.8 * flown))
    assert f.counts["acceleration"] == acted


@pytest.mark.parametrize(
    ("speed", "along", "flown", "acted"),
    [
        (1.0, 3.9, 3.9, 0),  # twice what is left: just below, at, just above
        (1.0, 4.0, 4.0, 0),
        (1.0, 4.1, 4.0, 1),
        (2.9, 1.0, 0.2, 1),
        (3.0, 0.0, 0.0, 0),
        (3.0, 0.1, 0.0, 1),
        (3.0, -1.0, -1.0, 0),
        (3.1, 0.0, -0.2, 1),  # too fast already
        (6.0, 0.0, -6.0, 1),
        (3.001, -0.1, -0.1, 0),
    ],
)
def test_speed_at_its_limit(speed: float, along: float, flown: float, acted: int) -> None:
    f = settled(replace(LIMITS, jerk_max_m_s3=1e9))
    s = applied(f, command(Ned(0.0, along, 0.0)), state(velocity=Ned(0.0, speed, 0.0)))
    assert acceleration(s) == pytest.approx((0.0, flown), abs=1e-9)
    assert hypot(s.velocity_north_m_s, s.velocity_east_m_s) <= 3.0 + 1e-9
    assert f.counts["speed"] == acted


def test_speed_limit_leaves_acceleration_across_the_velocity_alone() -> None:
    f = settled(replace(LIMITS, jerk_max_m_s3=1e9))
    s = applied(f, command(Ned(2.0, 2.0, 0.0)), state(velocity=Ned(0.0, 3.0, 0.0)))
    assert acceleration(s) == pytest.approx((2.0, 0.0))


def test_a_command_forward_for_ever_ends_at_the_speed_limit() -> None:
    f = SafetyFilter(LIMITS)
    v = 0.0
    for _ in range(1000):
        s = applied(f, command(Ned(9.0, 0.0, 0.0)), state(velocity=Ned(v, 0.0, 0.0)))
        v += DT_S * s.acceleration_north_m_s2
        assert v <= 3.0 + 1e-9
    assert v > 2.99


@pytest.mark.parametrize(
    ("change", "flown", "acted"), [(0.599, 0.599, 0), (0.6, 0.6, 0), (0.601, 0.6, 1), (5.0, 0.6, 1), (-5.0, -0.6, 1)]
)
@pytest.mark.parametrize(("north", "east"), [(0.0, 1.0), (1.0, 0.0), (0.6, -0.8)])
def test_jerk_at_its_limit(change: float, flown: float, acted: int, north: float, east: float) -> None:
    f = settled(LIMITS, (-1.0, -1.0))
    s = applied(f, command(Ned(-1.0 + change * north, -1.0 + change * east, 0.0)), state())
    assert acceleration(s) == pytest.approx((-1.0 + flown * north, -1.0 + flown * east))
    assert f.counts["jerk"] == acted


def test_jerk_never_delays_avoidance() -> None:
    f = settled(replace(LIMITS, jerk_max_m_s3=0.1), (2.0, 0.0))
    ego, n = state(velocity=Ned(2.0, 0.0, 0.0)), peer(Ned(1.5, 0.0, 0.0))
    s = applied(f, command(Ned(2.0, 0.0, 0.0)), ego, [n])
    plane = half_plane(ego, ZERO, n)
    needed = plane.b / plane.g_north
    assert needed < -4.0
    assert s.acceleration_north_m_s2 <= needed + 1e-3


@pytest.mark.parametrize(
    ("wanted", "flown"),
    [
        (0.999, 0.999),
        (1.0, 1.0),
        (1.001, 1.0),
        (-1.499, -1.499),
        (-1.5, -1.5),
        (-1.501, -1.5),
        (9.0, 1.0),
        (-9.0, -1.5),
    ],
)
def test_vertical_speed_at_its_limits(wanted: float, flown: float) -> None:
    s = applied(SafetyFilter(LIMITS), command(v_d=Ned(0.0, 0.0, wanted)), state())
    assert s.velocity_down_m_s == flown


def test_bias_goes_back_into_the_velocities_sent() -> None:
    f = SafetyFilter(LIMITS)
    s = f.apply(command(v_d=Ned(0.0, 0.0, 0.2)), state(velocity=Ned(1.0, 2.0, 0.0)), [], Ned(0.1, -0.2, 0.05), DT_S)
    assert s is not None
    assert (s.velocity_north_m_s, s.velocity_east_m_s) == pytest.approx((1.1, 1.8))
    assert s.velocity_down_m_s == pytest.approx(0.25)


def test_the_velocity_sent_leads_the_measured_one_by_the_acceleration() -> None:
    f = settled(replace(LIMITS, jerk_max_m_s3=1e9))
    c, ego = command(Ned(0.5, -0.25, 0.0)), state(velocity=Ned(1.0, 2.0, 0.0))
    first, second = applied(f, c, ego), applied(f, c, ego)
    assert (first.velocity_north_m_s, first.velocity_east_m_s) == pytest.approx((1.01, 1.995))
    # The lead of the step before has leaked by 0.02 s / 1 s.
    assert (second.velocity_north_m_s, second.velocity_east_m_s) == pytest.approx((1.0198, 1.9901))


def test_above_the_speed_limit_the_limit_is_sent_even_while_braking() -> None:
    f = settled(replace(LIMITS, jerk_max_m_s3=1e9))
    s = applied(f, command(Ned(-0.6, -0.8, 0.0)), state(velocity=Ned(1.86, 2.48, 0.0)))
    assert acceleration(s) == pytest.approx((-0.6, -0.8))
    assert (s.velocity_north_m_s, s.velocity_east_m_s) == pytest.approx((1.8, 2.4))
    assert f.counts == {"speed": 1}


def test_altitude_and_yaw_pass_as_they_are() -> None:
    s = applied(SafetyFilter(LIMITS), command(place=Ned(1.0, 2.0, -12.5), yaw=-2.0), state())
    assert (s.position_down_m, s.yaw_rad) == (-12.5, -2.0)


def test_a_free_command_within_all_limits_is_not_touched() -> None:
    f = SafetyFilter(LIMITS)
    s = applied(f, command(Ned(0.3, -0.2, 0.0)), state(velocity=Ned(1.0, 0.0, 0.0)), [peer(Ned(4.0, 0.0, 0.0))])
    assert acceleration(s) == (0.3, -0.2)
    assert f.counts == {}


def test_with_the_barrier_off_peers_are_nothing_to_it() -> None:
    f = SafetyFilter(replace(LIMITS, barrier=False))
    near, nowhere = peer(Ned(0.3, 0.0, 0.0)), peer(Ned(nan, 0.0, 0.0))
    s = applied(f, command(Ned(0.3, -0.2, 0.0)), state(velocity=Ned(1.0, 0.0, 0.0)), [near, nowhere])
    assert acceleration(s) == (0.3, -0.2)
    assert f.counts == {}


def test_each_limit_is_counted_once_a_tick() -> None:
    f = SafetyFilter(LIMITS)
    for _ in range(5):
        applied(f, command(Ned(90.0, 0.0, 0.0)), state(velocity=Ned(5.0, 0.0, 0.0)), [peer(Ned(1.2, 0.1, 0.0))])
    assert set(f.counts.values()) == {5}


def test_a_calm_tick_after_a_hard_one_counts_nothing() -> None:
    f = settled(replace(LIMITS, jerk_max_m_s3=1e9))
    applied(f, command(Ned(90.0, 0.0, 0.0)), state())
    counted = dict(f.counts)
    applied(f, command(), state())
    assert counted == {"acceleration": 1}
    assert f.counts == counted


def test_a_blocked_vehicle_passes_the_one_that_blocks_it_most() -> None:
    ahead, beside = peer(Ned(1.3, 0.0, 0.0), vehicle_id=3), peer(Ned(1.5, -1.0, 0.0), vehicle_id=2)
    ego, c = state(velocity=Ned(1.0, 0.0, 0.0)), command(Ned(5.0, -2.0, 0.0))
    for n in (ahead, beside):
        plane = half_plane(ego, ZERO, n)
        assert plane.g_north * 5.0 + plane.g_east * -2.0 < plane.b
    both, alone = (
        applied(settled(replace(LIMITS, jerk_max_m_s3=1e9)), c, ego, others) for others in ([beside, ahead], [ahead])
    )
    assert acceleration(both) == pytest.approx(acceleration(alone))
    assert both.acceleration_east_m_s2 > -2.0


@pytest.mark.parametrize(
    ("u", "most", "less"),
    [
        # Nearer, so that in m^2/s^2 its edge is missed by less than the other's.
        ((-3.0, -3.0), peer(Ned(-0.8, -0.8, 0.0)), peer(Ned(-3.0, 0.5, 0.0), Ned(1.7, -0.28, 0.0), vehicle_id=3)),
        ((-3.0, 3.0), peer(Ned(-0.8, 0.8, 0.0)), peer(Ned(0.5, 3.0, 0.0), Ned(-0.28, -1.7, 0.0), vehicle_id=3)),
        # Nearly above.
        ((2.0, 2.0), peer(Ned(0.2, 0.2, -2.4)), peer(Ned(3.0, -0.5, 0.0), Ned(-2.1, 0.35, 0.0), vehicle_id=3)),
    ],
)
def test_the_one_that_blocks_most_is_told_by_the_acceleration_that_is_missing(
    u: tuple[float, float], most: Neighbour, less: Neighbour
) -> None:
    planes = [half_plane(state(), ZERO, n) for n in (most, less)]
    missing = [(p.b - p.g_north * u[0] - p.g_east * u[1]) / hypot(p.g_north, p.g_east) for p in planes]
    assert missing[0] > missing[1] > 0.0
    past_most, past_less = (
        nearest(sidestep(*u, p.g_north, p.g_east, -v.north, -v.east), planes)
        for p, v in zip(planes, (most.velocity_ned_m_s, less.velocity_ned_m_s), strict=True)
    )
    assert dist(past_most, past_less) > 0.02
    f = settled(replace(LIMITS, jerk_max_m_s3=1e9))
    assert acceleration(applied(f, command(Ned(*u, 0.0)), state(), [less, most])) == pytest.approx(past_most)


@pytest.mark.parametrize(
    ("u", "v", "sideways"),
    [
        ((1.0, 0.0), (0.0, 0.0), 0.9),
        ((0.5, 0.0), (0.0, 0.0), 0.45),  # half as much where it presses with half a m/s^2
        ((3.0, 0.0), (0.0, 0.0), 0.9),
        ((1.0, 2.0), (5.0, 0.0), 0.9),
        ((1.0, 0.0), (0.0, -0.4), 1.5),
        ((1.0, 0.0), (0.0, 0.2), 0.6),
        ((1.0, 0.0), (0.0, 0.6), 0.0),  # it passes already
        ((1.0, 0.0), (0.0, 0.7), 0.0),
        ((0.0, 2.0), (0.0, 0.0), 0.0),
        ((-1.0, 2.0), (0.0, 0.0), 0.0),  # it does not press
    ],
)
@pytest.mark.parametrize(("ahead", "size"), [((1.0, 0.0), 2.0), ((0.0, 1.0), 0.3), ((0.6, -0.8), 5.0)])
def test_a_blocked_vehicle_is_moved_along_the_obstacle_to_its_right(
    u: tuple[float, float], v: tuple[float, float], sideways: float, ahead: tuple[float, float], size: float
) -> None:
    """1.5 /s of what is missing to 0.6 m/s, times what it presses (m/s^2), 1 at most; written as (ahead, right)."""
    right = (-ahead[1], ahead[0])

    def turned(x: tuple[float, float]) -> tuple[float, float]:
        return x[0] * ahead[0] + x[1] * right[0], x[0] * ahead[1] + x[1] * right[1]

    moved = sidestep(*turned(u), -size * ahead[0], -size * ahead[1], *turned(v))
    assert moved == pytest.approx(turned((u[0], u[1] + sideways)))


@pytest.mark.parametrize(
    ("obstacle", "east"),
    [
        (peer(Ned(1.3, 0.0, 0.0)), 0.9),
        (peer(Ned(1.3, 0.0, 0.0), Ned(0.0, 0.3, 0.0)), 1.35),
        (peer(Ned(1.3, 0.0, 0.0), Ned(0.0, -0.3, 0.0)), 0.45),
        (peer(Ned(1.3, 0.0, 0.0), Ned(0.0, -0.6, 0.0)), 0.0),
        # Lost, the one end drifting: its middle moves half as fast.
        (peer(Ned(1.3, -1.0, 0.0), Ned(0.0, 0.4, 0.0), last_seen_ned_m=Ned(1.3, 1.0, 0.0)), 1.2),
    ],
)
@pytest.mark.parametrize("quarters", range(4))
def test_what_counts_for_passing_is_the_speed_along_the_obstacle(
    obstacle: Neighbour, east: float, quarters: int
) -> None:
    def turned(x: Ned) -> Ned:
        for _ in range(quarters):
            x = Ned(-x.east, x.north, x.down)
        return x

    other = obstacle.last_seen_ned_m
    there = obstacle._replace(
        position_ned_m=turned(obstacle.position_ned_m), velocity_ned_m_s=turned(obstacle.velocity_ned_m_s),
        last_seen_ned_m=None if other is None else turned(other),
    )  # fmt: skip
    f = settled(replace(LIMITS, jerk_max_m_s3=1e9))
    s = applied(f, command(turned(Ned(3.0, 0.0, 0.0))), state(velocity=turned(Ned(1.0, 0.0, 0.0))), [there])
    right = turned(Ned(0.0, 1.0, 0.0))
    assert s.acceleration_north_m_s2 * right.north + s.acceleration_east_m_s2 * right.east == pytest.approx(east)


def test_reset_forgets_what_was_flown() -> None:
    f = SafetyFilter(LIMITS)
    for _ in range(50):
        applied(f, command(Ned(3.0, 0.0, 0.0)), state())
    f.reset()
    s = applied(f, command(), state(velocity=Ned(0.5, 0.0, 0.0)))
    assert acceleration(s) == (0.0, 0.0)
    assert s.velocity_north_m_s == 0.5


# -- where not everything can be had ---------------------------------------------------------------------------------


def test_avoidance_keeps_its_direction_at_the_acceleration_limit() -> None:
    """What the law wants besides is given up first: scaling the whole command down would give up distance."""
    limits = replace(LIMITS, jerk_max_m_s3=1e9, speed_max_m_s=100.0)
    ego, n = state(velocity=Ned(2.0, 0.0, 0.0)), peer(Ned(1.5, 0.0, 0.0))
    plane = half_plane(ego, ZERO, n)
    needed = plane.b / plane.g_north
    assert -7.9 < needed < -4.0
    f = SafetyFilter(limits)
    s = applied(f, command(Ned(0.0, 8.0, 0.0)), ego, [n])
    assert hypot(*acceleration(s)) <= 8.0 + 1e-9
    assert s.acceleration_north_m_s2 <= needed + 1e-3
    assert s.acceleration_east_m_s2 > 0.5
    assert f.counts["acceleration"] == 1
    assert f.counts["peer distance not attainable"] == 0


def test_between_two_that_come_nearer_it_stays_in_the_middle() -> None:
    f = SafetyFilter(LIMITS)
    closing = [
        peer(Ned(0.95, 0.0, 0.0), Ned(-1.0, 0.0, 0.0), vehicle_id=2),
        peer(Ned(-0.95, 0.0, 0.0), Ned(1.0, 0.0, 0.0), vehicle_id=3),
    ]
    s = applied(f, command(Ned(3.0, 0.0, 0.0)), state(), closing)
    assert f.counts["peer distance not attainable"] == 1
    assert s.acceleration_north_m_s2 == pytest.approx(0.0, abs=1e-6)


@PROPERTY
@given(
    st.lists(st.tuples(st.floats(0.05, 3.0), st.floats(-pi, pi), st.floats(-3, 3), st.floats(-3, 3)), max_size=9),
    commands_2d,
)
def test_in_any_crowd_the_command_is_admissible_and_misses_no_more_than_it_must(
    crowd: list[tuple[float, float, float, float]], u: tuple[float, float]
) -> None:
    neighbours = [
        peer(Ned(r * cos(a), r * sin(a), 0.0), Ned(v, w, 0.0), vehicle_id=k + 2) for k, (r, a, v, w) in enumerate(crowd)
    ]
    f = SafetyFilter(LIMITS)
    s = applied(f, command(Ned(*u, 0.0)), state(), neighbours)
    planes = [half_plane(state(), ZERO, n) for n in neighbours]
    assert hypot(*acceleration(s)) <= 8.0 + 1e-9
    if f.counts["peer distance not attainable"] == 0:
        assert missed(acceleration(s), planes) <= 1e-6
    else:
        # Against all commands on a grid of the admissible disc.
        grid = [(r * cos(a), r * sin(a)) for r in np.linspace(0, 8, 17) for a in np.linspace(-pi, pi, 48)]
        best = min(missed(x, planes) for x in grid)
        assert missed(acceleration(s), planes) <= best + 1e-6


# -- flights ---------------------------------------------------------------------------------------------------------


@dataclass
class Flyer:
    """A double integrator with its filter and a law of its own."""

    position: np.ndarray
    velocity: np.ndarray
    law: Callable[[float, np.ndarray, np.ndarray], np.ndarray]
    filter: SafetyFilter

    def state(self) -> VehicleState:
        return state(Ned(*map(float, self.position)), Ned(*map(float, self.velocity)))


def fly(flyers: list[Flyer], seconds: float, obstacles: Callable[[float], list[Neighbour]] | None = None) -> float:
    """All fly by their laws through their filters; returns the smallest distance of any two or to an obstacle."""
    nearest = inf
    for k in range(round(seconds / DT_S)):
        t = k * DT_S
        states = [f.state() for f in flyers]
        there = obstacles(t) if obstacles is not None else []
        flown = []
        for i, f in enumerate(flyers):
            neighbours = [
                peer(s.position_ned_m, s.velocity_ned_m_s, shares=True, vehicle_id=j + 2)
                for j, s in enumerate(states)
                if j != i
            ]
            u = f.law(t, f.position, f.velocity)
            s = applied(f.filter, command(Ned(*map(float, u))), states[i], [*neighbours, *there])
            flown.append(np.array([*acceleration(s), 0.0]))
            for n in there:
                nearest = min(nearest, dist(nearest_hypothesis(states[i].position_ned_m, n)[0], f.position))
        for f, u in zip(flyers, flown, strict=True):
            f.position = f.position + DT_S * f.velocity + 0.5 * DT_S**2 * u
            f.velocity = f.velocity + DT_S * u
        for a, b in combinations(flyers, 2):
            nearest = min(nearest, float(np.linalg.norm(a.position - b.position)))
    return nearest


def toward(target: Callable[[float], tuple[np.ndarray, np.ndarray]], speed: float = 2.0) -> Callable[..., np.ndarray]:
    """A law that goes to a moving target at up to a speed relative to it, and knows of nobody."""

    def law(t: float, p: np.ndarray, v: np.ndarray) -> np.ndarray:
        place, velocity = target(t)
        error = place - p
        size = float(np.linalg.norm(error))
        wanted = velocity + (error if size <= speed else error * speed / size)
        u = 3.0 * (wanted - v)
        return u / max(1.0, float(np.linalg.norm(u)) / 5.0)

    return law


def resting(*place: float) -> Callable[[float], tuple[np.ndarray, np.ndarray]]:
    return lambda _: (np.array(place), np.zeros(3))


def head_on(limits: SafetyLimits, aside: float = 0.0) -> list[Flyer]:
    south, north = np.array([-8.0, 0.0, -10.0]), np.array([8.0, aside, -10.0])
    v = np.array([2.0, 0.0, 0.0])
    return [
        Flyer(south, v, toward(resting(*north)), SafetyFilter(limits)),
        Flyer(north, -v, toward(resting(*south)), SafetyFilter(limits)),
    ]


@pytest.mark.parametrize("aside", [0.0, 0.1, -0.3])
def test_two_sent_head_on_pass_each_other_at_their_distance(aside: float) -> None:
    flyers = head_on(LIMITS, aside)
    assert fly(flyers, 25.0) >= 0.99
    for f, end in zip(flyers, (8.0, -8.0), strict=True):
        assert f.position[0] == pytest.approx(end, abs=0.1)


@pytest.mark.parametrize("aside", [0.0, 0.1, -0.3])
def test_the_same_two_collide_without_the_filter(aside: float) -> None:
    assert fly(head_on(replace(LIMITS, barrier=False), aside), 25.0) < COLLISION_DISTANCE_M


@pytest.mark.parametrize("barrier", [True, False])
def test_one_avoids_alone_a_vehicle_that_flies_straight_on(barrier: bool) -> None:
    flyer = head_on(replace(LIMITS, barrier=barrier))[:1]

    def straight(t: float) -> list[Neighbour]:
        return [peer(Ned(8.0 - 2.0 * t, 0.0, -10.0), Ned(-2.0, 0.0, 0.0), vehicle_id=9)]

    nearest = fly(flyer, 20.0, straight)
    assert nearest >= 0.97 if barrier else nearest < COLLISION_DISTANCE_M


def slot_from(start: float) -> Callable[[float], tuple[np.ndarray, np.ndarray]]:
    return lambda t: (np.array([start + t, 0.0, -10.0]), np.array([1.0, 0.0, 0.0]))


@pytest.mark.parametrize("barrier", [True, False])
@pytest.mark.parametrize("length", [0.0, 5.0])
def test_a_follower_passes_a_lost_vehicle_that_stopped_in_its_column(length: float, barrier: bool) -> None:
    """At 1 m/s, 3 m behind; where the lost one is, is known to a line along the column's way."""
    follower = Flyer(
        np.array([0.0, 0.0, -10.0]), np.array([1.0, 0.0, 0.0]), toward(slot_from(0.0)),
        SafetyFilter(replace(LIMITS, barrier=barrier)),
    )  # fmt: skip
    lost = peer(Ned(3.0 + length, 0.0, -10.0), vehicle_id=5, uncertainty_m=0.6, last_seen_ned_m=Ned(3.0, 0.0, -10.0))
    nearest = fly([follower], 30.0, lambda _: [lost])
    if barrier:
        assert nearest >= 1.24
        assert follower.position == pytest.approx([30.0, 0.0, -10.0], abs=0.2)
    else:
        assert nearest < COLLISION_DISTANCE_M


@pytest.mark.parametrize("barrier", [True, False])
def test_a_column_of_followers_passes_it_one_after_the_other(barrier: bool) -> None:
    flyers = [
        Flyer(
            np.array([-3.0 * k, 0.0, -10.0]), np.array([1.0, 0.0, 0.0]), toward(slot_from(-3.0 * k)),
            SafetyFilter(replace(LIMITS, barrier=barrier)),
        )
        for k in range(3)
    ]  # fmt: skip
    lost = peer(Ned(6.0, 0.0, -10.0), vehicle_id=9, last_seen_ned_m=Ned(3.0, 0.0, -10.0))
    nearest = fly(flyers, 45.0, lambda _: [lost])
    assert nearest >= 0.97 if barrier else nearest < COLLISION_DISTANCE_M
    if barrier:
        for k, f in enumerate(flyers):
            assert f.position == pytest.approx([45.0 - 3.0 * k, 0.0, -10.0], abs=0.3)


@pytest.mark.parametrize(("count", "seed"), [(3, 0), (6, 1)])
def test_vehicles_that_change_places_across_a_circle_arrive(count: int, seed: int) -> None:
    """All want through the middle at once, some centimetres off a perfect symmetry, which would stop them for ever."""
    rng = random.Random(seed)
    flyers = []
    for k in range(count):
        angle = 2 * pi * k / count
        place = np.array([6.0 * cos(angle) + rng.gauss(0, 0.05), 6.0 * sin(angle) + rng.gauss(0, 0.05), 0.0])
        flyers.append(Flyer(place, np.zeros(3), toward(resting(*-place), 1.0), SafetyFilter(LIMITS)))
    targets = [-f.position for f in flyers]
    assert fly(flyers, 30.0) >= 0.98
    assert max(float(np.linalg.norm(f.position - x)) for f, x in zip(flyers, targets, strict=True)) < 0.2


def test_a_vehicle_lifted_into_another_from_below_is_let_by() -> None:
    """One rises at 1 m/s straight through the place of a hovering one, which steps aside."""
    hovering = Flyer(np.array([0.0, 0.0, -10.0]), np.zeros(3), toward(resting(0.0, 0.0, -10.0)), SafetyFilter(LIMITS))
    nearest = fly([hovering], 20.0, lambda t: [peer(Ned(0.0, 0.0, -t), Ned(0.0, 0.0, -1.0), vehicle_id=4)])
    assert nearest > COLLISION_DISTANCE_M
