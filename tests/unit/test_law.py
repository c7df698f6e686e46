"""The law: equivariant, saturated, within its budget, and Eq. (2) of the paper with the paper's gains."""

from collections.abc import Sequence
from itertools import pairwise
from math import inf, pi, sqrt
from random import Random

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from companion.core.frames import Ned
from companion.core.law.paper import paper_gains
from companion.core.law.starling import (
    NO_SUMS,
    Gains,
    StarlingLaw,
    Sums,
    combine,
    pair,
    separation,
    total,
    within_budget,
)
from companion.core.trajectory.fleet import Reference
from companion.core.values import ZERO, Neighbour, VehicleState
from sim.study.broken_law import GAIN_PER_S, PUSH_MAX_M_S2, BrokenLaw

PROPERTY = settings(deadline=None, max_examples=40)
FLIGHT = Gains(3.0, 3.0, 4.0, 1.0, 0.3, 2.0, 5.0, 1.0, 1.0, 1.0)
Vector = npt.NDArray[np.float64]


def vectors(limit: float) -> st.SearchStrategy[Vector]:
    return st.tuples(*[st.floats(-limit, limit)] * 3).map(lambda t: np.array(t, dtype=np.float64))


class Scene:
    """One vehicle (row 0) and its neighbours: positions, velocities, slots p_ref, and the plan's v_d and a_d."""

    def __init__(self, p: Vector, v: Vector, ref: Vector, v_d: Vector, a_d: Vector) -> None:
        self.p, self.v, self.ref, self.v_d, self.a_d = p, v, ref, v_d, a_d

    def moved(self, r: Vector, shift: Vector, drift: Vector) -> "Scene":
        return Scene(
            self.p @ r.T + shift, self.v @ r.T + drift, self.ref @ r.T + shift, r @ self.v_d + drift, r @ self.a_d
        )

    def reordered(self, order: Sequence[int]) -> "Scene":
        rows = [0, *(k + 1 for k in order)]
        return Scene(self.p[rows], self.v[rows], self.ref[rows], self.v_d, self.a_d)


@st.composite
def scenes(draw: st.DrawFn, least: int = 0, most: int = 6) -> Scene:
    n = 1 + draw(st.integers(least, most))
    rows = st.lists(vectors(8.0), min_size=n, max_size=n).map(np.array)
    return Scene(
        draw(rows), draw(st.lists(vectors(3.0), min_size=n, max_size=n).map(np.array)), draw(rows),
        draw(vectors(2.0)), draw(vectors(1.0)),
    )  # fmt: skip


def command(s: Scene, g: Gains) -> Vector:
    rows = ((*(s.p[0] - s.p[k]), *(s.v[0] - s.v[k]), *(s.ref[0] - s.ref[k])) for k in range(1, len(s.p)))
    sums = total([pair(*map(float, row), g) for row in rows])
    return np.array(finish(sums, s.p[0] - s.ref[0], s.v[0] - s.v_d, s.a_d, g))


def finish(sums: Sums, e: Vector, w: Vector, a: Vector, g: Gains) -> tuple[float, float, float]:
    """The command from errors e and w of place and velocity, with a_d."""
    ego = VehicleState(0, ned(e), ned(w))
    return combine(sums, ego, Reference(ZERO, ZERO, ned(a), 0.0), g)


def ned(x: Vector) -> Ned:
    return Ned(*map(float, x))


def saturated(x: Vector, limit: float) -> Vector:
    size = float(np.linalg.norm(x))
    return x if size <= limit else x * (limit / size)


def transcribed(s: Scene, g: Gains) -> tuple[Vector, Vector]:
    """u_sep (not yet clipped) and u_rest of the docstring, straight from its formulas."""
    n = len(s.p) - 1
    u_sep, alignment, cohesion = np.zeros(3), np.zeros(3), np.zeros(3)
    for k in range(1, n + 1):
        x = s.p[0] - s.p[k]
        r = max(float(np.linalg.norm(x)), 0.2)
        if r < g.r0:
            u_sep += g.k_s * (1 / r**2 - 1 / g.r0**2) * x / r
        alignment += saturated(s.v[0] - s.v[k], g.saturation_velocity)
        cohesion += saturated(x - (s.ref[0] - s.ref[k]), g.saturation_position)
    m = (s.p - s.ref).mean(axis=0)
    each = max(n, 1)
    u_rest = (
        -(g.k_a / each) * alignment
        - (g.k_c / each) * cohesion
        - g.k_v * (s.v[0] - s.v_d)
        + s.a_d
        - g.k_p * saturated(m, g.saturation_position)
    )
    return u_sep, u_rest


@PROPERTY
@given(scenes(), vectors(100.0), st.floats(-pi, pi))
def test_command_turns_with_the_scene_about_the_vertical_and_ignores_where_it_is(
    scene: Scene, shift: Vector, angle: float
) -> None:
    r = Rotation.from_euler("z", angle).as_matrix()
    moved = command(scene.moved(r, shift, np.zeros(3)), FLIGHT)
    assert moved == pytest.approx(r @ command(scene, FLIGHT), abs=1e-7)


@PROPERTY
@given(scenes(), vectors(100.0), vectors(5.0), vectors(1.0))
def test_command_turns_with_the_scene_in_space_and_ignores_a_common_drift(
    scene: Scene, shift: Vector, drift: Vector, turn: Vector
) -> None:
    r = Rotation.from_rotvec(3.0 * turn).as_matrix()
    moved = command(scene.moved(r, shift, drift), FLIGHT)
    assert moved == pytest.approx(r @ command(scene, FLIGHT), abs=1e-7)


@PROPERTY
@given(scenes(least=2), st.randoms(use_true_random=False))
def test_order_of_neighbours_does_not_matter(scene: Scene, rng: "object") -> None:
    order = list(range(len(scene.p) - 1))
    rng.shuffle(order)  # type: ignore[attr-defined]
    assert command(scene.reordered(order), FLIGHT) == pytest.approx(command(scene, FLIGHT), abs=1e-9)


@PROPERTY
@given(scenes())
def test_command_stays_within_its_budget(scene: Scene) -> None:
    assert np.linalg.norm(command(scene, FLIGHT)) <= FLIGHT.a_max * (1 + 1e-9)


@PROPERTY
@given(scenes())
def test_command_is_separation_and_the_largest_part_of_the_rest(scene: Scene) -> None:
    u_sep, u_rest = transcribed(scene, FLIGHT)
    u_sep = saturated(u_sep, FLIGHT.a_max)
    u = command(scene, FLIGHT)
    size = float(np.linalg.norm(u_rest))
    assume(size > 1e-3)
    share = float((u - u_sep) @ u_rest) / size**2
    assert u == pytest.approx(u_sep + share * u_rest, abs=1e-7)
    assert -1e-9 <= share <= 1 + 1e-9
    if share < 1 - 1e-6:
        more = u_sep + min(1.0, share + 1e-4) * u_rest
        assert np.linalg.norm(more) > FLIGHT.a_max - 1e-9
    assert np.linalg.norm(u_sep + u_rest) > FLIGHT.a_max or share == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("sep", "rest", "expected"),
    [
        ((0.0, 0.0, 0.0), (3.0, 4.0, 0.0), (3.0, 4.0, 0.0)),  # just at the limit
        ((0.0, 0.0, 0.0), (6.0, 8.0, 0.0), (3.0, 4.0, 0.0)),
        ((9.0, 0.0, 0.0), (1.0, 0.0, 0.0), (5.0, 0.0, 0.0)),  # separation takes all
        ((9.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (4.0, 0.0, 0.0)),  # the rest may take it back
        ((5.0, 0.0, 0.0), (-20.0, 0.0, 0.0), (-5.0, 0.0, 0.0)),
        ((5.0, 0.0, 0.0), (0.0, 1.0, 0.0), (5.0, 0.0, 0.0)),
        ((3.0, 0.0, 0.0), (0.0, 8.0, 0.0), (3.0, 4.0, 0.0)),  # half of the rest
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((2.0, 0.0, 0.0), (1e-9, 0.0, 0.0), (2.0, 0.0, 0.0)),
    ],
)
def test_budget_of_known_cases(sep: tuple[float, ...], rest: tuple[float, ...], expected: tuple[float, ...]) -> None:
    assert within_budget(*sep, *rest, 5.0) == pytest.approx(expected, abs=1e-8)


@PROPERTY
@given(scenes(least=1), st.floats(0.1, 5.0), st.floats(0.1, 5.0), st.floats(0.1, 5.0), st.floats(0.5, 8.0))
def test_paper_gains_are_equation_2(scene: Scene, k_s: float, k_a: float, k_c: float, r0: float) -> None:
    assume(all(np.linalg.norm(scene.p[0] - p) >= 0.2 for p in scene.p[1:]))
    expected = np.zeros(3)
    for j in range(1, len(scene.p)):
        p_ij, v_ij = scene.p[0] - scene.p[j], scene.v[0] - scene.v[j]
        r_ij = np.sqrt((p_ij**2).sum())
        phi = 1 / r_ij**2 - 1 / r0**2 if r_ij < r0 else 0.0
        d_ij = scene.ref[0] - scene.ref[j]
        expected += k_s * phi * p_ij / r_ij - k_a * v_ij - k_c * (p_ij - d_ij)
    still = Scene(scene.p, scene.v, scene.ref, scene.v_d, np.zeros(3))
    assert command(still, paper_gains(k_s, k_a, k_c, r0)) == pytest.approx(expected, rel=1e-9, abs=1e-7)


@PROPERTY
@given(vectors(300.0), vectors(50.0), vectors(8.0))
def test_one_neighbours_errors_saturate(d: Vector, dv: Vector, offset: Vector) -> None:
    s = pair(*map(float, (*d, *dv, *offset)), FLIGHT)
    assert np.linalg.norm(s[3:6]) <= 1 + 1e-9
    assert np.linalg.norm(s[6:9]) <= 1 + 1e-9
    assert s[9:12] == pytest.approx(tuple(d - offset))
    assert s[3:6] == pytest.approx(tuple(saturated(dv, 1.0)), abs=1e-9)
    assert s[6:9] == pytest.approx(tuple(saturated(d - offset, 1.0)), abs=1e-9)


@PROPERTY
@given(vectors(3.0))
def test_separation_repels_and_is_odd(d: Vector) -> None:
    away = np.array(separation(*map(float, d), FLIGHT)[:3])
    back = np.array(separation(*map(float, -d), FLIGHT)[:3])
    assert away == pytest.approx(-back)
    assert float(away @ d) >= 0.0


@pytest.mark.parametrize(
    ("distance_m", "expected"),
    [
        (2.0, 0.0),  # at r0
        (2.0 + 1e-9, 0.0),
        (100.0, 0.0),
        (1.0, 3.0 * (1.0 - 0.25)),
        (0.2, 3.0 * (25.0 - 0.25)),
        (0.1, 0.5 * 3.0 * (25.0 - 0.25)),  # grows no further; the direction's length goes to zero with it
        (0.0, 0.0),
    ],
)
def test_separation_of_known_distances(distance_m: float, expected: float) -> None:
    assert separation(distance_m, 0.0, 0.0, FLIGHT)[0] == pytest.approx(expected, abs=1e-12)
    assert separation(0.0, 0.0, -distance_m, FLIGHT)[2] == pytest.approx(-expected, abs=1e-12)


def test_separation_ends_continuously_at_its_range() -> None:
    steps = [separation(2.0 - k * 1e-4, 0.0, 0.0, FLIGHT)[0] for k in range(-20, 20)]
    assert max(abs(b - a) for a, b in pairwise(steps)) < 1e-3
    assert separation(2.0 - 1e-9, 0.0, 0.0, FLIGHT)[0] < 1e-8


def test_two_vehicles_at_one_spot_give_a_finite_command() -> None:
    scene = Scene(np.zeros((2, 3)), np.zeros((2, 3)), np.array([[0.0, 0, 0], [4.0, 0, 0]]), np.zeros(3), np.zeros(3))
    u = command(scene, FLIGHT)
    assert np.isfinite(u).all()
    assert u[0] < 0  # toward its slot, which is south of the other's


def test_a_vertical_stack_is_pushed_apart_along_the_vertical() -> None:
    s = separation(0.0, 0.0, 0.5, FLIGHT)
    assert s[:2] == (0.0, 0.0)
    assert s[2] > 0


@PROPERTY
@given(vectors(50.0), vectors(5.0), vectors(1.0))
def test_a_single_vehicle_tracks_the_plan_alone(e: Vector, w: Vector, a: Vector) -> None:
    g = FLIGHT._replace(a_max=inf)
    u = np.array(finish(NO_SUMS, e, w, a, g))
    assert u == pytest.approx(a - 1.0 * w - 0.3 * saturated(e, 1.0), abs=1e-9)


def test_a_formation_in_place_and_at_speed_is_left_alone() -> None:
    slots = np.array([[0.0, 0, 0], [-3.0, 3, 0], [-3.0, -3, 0]])
    v_d, a_d = np.array([1.0, 0.5, 0.0]), np.array([0.1, -0.2, 0.0])
    there = slots + np.array([7.0, 8.0, -9.0])
    scene = Scene(there, np.tile(v_d, (3, 1)), there, v_d, a_d)
    assert command(scene, FLIGHT) == pytest.approx(a_d)


@PROPERTY
@given(st.lists(st.tuples(*[st.floats(-10, 10)] * 13), max_size=6), st.randoms())
def test_the_total_is_the_sum_of_the_entries_whatever_their_order(rows: list[tuple[float, ...]], r: Random) -> None:
    shares = [Sums(*row) for row in rows]
    sums = total(shares)
    assert sums == pytest.approx(tuple(np.sum(np.array(rows).reshape(-1, 13), axis=0)), abs=1e-9)
    r.shuffle(shares)
    assert total(shares) == sums


@pytest.mark.parametrize("n", [1, 4, 15])
def test_the_crowd_does_not_make_the_law_stiffer(n: int) -> None:
    """With n equal neighbours the command is that of one."""
    one = pair(6.0, 0.0, 0.0, 0.3, 0.0, 0.0, 5.5, 0.0, 0.0, FLIGHT)
    sums = total([one] * n)
    g, nowhere = FLIGHT._replace(k_p=0.0), np.zeros(3)
    assert finish(sums, nowhere, nowhere, nowhere, g) == pytest.approx((-3.0 * 0.3 - 4.0 * 0.5, 0.0, 0.0))


def test_the_default_budget_is_on_the_norm_and_not_on_the_axes() -> None:
    u = finish(NO_SUMS, np.zeros(3), np.full(3, -10.0), np.zeros(3), FLIGHT)
    assert sqrt(sum(x * x for x in u)) == pytest.approx(5.0)


# -- the law as an object --------------------------------------------------------------------------------------------

levels = st.builds(Ned, *[st.floats(-6.0, 6.0)] * 3)
egos = st.builds(VehicleState, st.just(0), levels, levels)
references = st.builds(Reference, levels, levels, levels, st.floats(-pi, pi))


@st.composite
def surroundings(draw: st.DrawFn) -> list[Neighbour]:
    """Peers in and out of formation, lost ones, each at its own slot."""
    return [
        Neighbour(
            k + 2, draw(levels), draw(levels), draw(levels), 0.1, draw(st.booleans()), draw(st.booleans()), 0.35,
            draw(st.none() | levels), draw(levels),
        )
        for k in range(draw(st.integers(0, 5)))
    ]  # fmt: skip


def flat(x: Ned) -> Vector:
    return np.array([x.north, x.east, 0.0])


@settings(deadline=None, max_examples=150)
@given(egos, references, surroundings(), st.booleans())
def test_the_law_that_is_flown_is_its_formulas_in_the_level_plane(
    ego: VehicleState, reference: Reference, neighbours: list[Neighbour], alone: bool
) -> None:
    """Distances count in space, all else on the level: altitude is flown by position."""
    g = FLIGHT._replace(vertical=0.0)
    u_sep, alignment, cohesion, residuals = np.zeros(3), np.zeros(3), np.zeros(3), []
    for n in neighbours:
        formed = n.in_formation and not alone
        if formed or n.last_seen_ned_m is None:
            x = np.array(ego.position_ned_m) - np.array(n.position_ned_m)
            r = max(float(np.linalg.norm(x)), 0.2)
            u_sep += g.k_s * max(1 / r**2 - 1 / g.r0**2, 0.0) * flat(Ned(*x)) / r
        if formed:
            asked = flat(reference.velocity_ned_m_s) - flat(n.reference_velocity_ned_m_s)
            alignment += saturated(flat(ego.velocity_ned_m_s) - flat(n.velocity_ned_m_s) - asked, 1.0)
            residuals.append(flat(ego.position_ned_m) - flat(n.position_ned_m) - flat(n.offset_ned_m))
            cohesion += saturated(residuals[-1], 1.0)
    count = len(residuals)
    off = flat(ego.position_ned_m) - flat(reference.position_ned_m)
    mean = off - np.sum(residuals, axis=0) / (count + 1) if residuals else off
    rest = (
        -(g.k_a * alignment + g.k_c * cohesion) / max(count, 1)
        - g.k_v * (flat(ego.velocity_ned_m_s) - flat(reference.velocity_ned_m_s))
        + flat(reference.acceleration_ned_m_s2)
        - g.k_p * saturated(mean, 1.0)
    )
    wanted, residual = StarlingLaw(g).command(ego, reference, neighbours, alone=alone)
    assert wanted == pytest.approx(within_budget(*u_sep, *rest, g.a_max), abs=1e-6)
    assert residual == pytest.approx(np.mean(residuals, axis=0) if residuals else np.zeros(3))


@given(egos, references, surroundings(), levels)
@PROPERTY
def test_a_law_that_breaks_flies_at_its_velocity_and_speaks_as_before(
    ego: VehicleState, reference: Reference, neighbours: list[Neighbour], velocity: Ned
) -> None:
    sound = StarlingLaw(FLIGHT)
    broken = BrokenLaw(sound)
    whole = sound.command(ego, reference, neighbours, alone=False)
    assert broken.command(ego, reference, neighbours, alone=False) == whole
    broken.velocity_ned_m_s = velocity
    flown, residual = broken.command(ego, reference, neighbours, alone=False)
    wanted = GAIN_PER_S * (flat(velocity) - flat(ego.velocity_ned_m_s))
    assert flown == pytest.approx(saturated(wanted, PUSH_MAX_M_S2))
    assert residual == whole.residual_ned_m
