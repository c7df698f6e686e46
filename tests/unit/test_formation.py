"""Shapes for every size, and assignments that every vehicle finds alike."""

import random
from itertools import pairwise, permutations, product
from math import dist, inf, pi, sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.formation import (
    SHAPES,
    Slots,
    assign,
    centred,
    minimum_distance,
    pairwise_distances_m,
    rotated,
    shape_slots,
)
from companion.core.frames import Ned

PROPERTY = settings(deadline=None, max_examples=60)
points = st.builds(Ned, *[st.floats(-20.0, 20.0)] * 3)
LEVEL = [s for s in SHAPES if s != "sphere"]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("spacing_m", [1.5, 4.0])
def test_every_shape_of_every_size_is_centred_with_its_spacing(shape: str, spacing_m: float) -> None:
    for count in range(1, 61):
        slots = shape_slots(shape, count, spacing_m)
        assert len(slots) == count
        assert np.mean(slots, axis=0) == pytest.approx(np.zeros(3), abs=1e-9)
        nearest = minimum_distance(slots)
        assert nearest == (inf if count == 1 else pytest.approx(spacing_m, abs=1e-9)), (shape, count)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_single_vehicle_is_the_centre(shape: str) -> None:
    assert shape_slots(shape, 1, 4.0) == ((0.0, 0.0, 0.0),)


@pytest.mark.parametrize("shape", LEVEL)
def test_level_shapes_are_level(shape: str) -> None:
    assert all(s.down == 0.0 for s in shape_slots(shape, 23, 4.0))


def test_a_shape_that_does_not_exist_is_a_key_error() -> None:
    with pytest.raises(KeyError):
        shape_slots("heart", 3, 4.0)


def test_a_v_opens_backward_with_equal_arms() -> None:
    slots = shape_slots("v", 9, 4.0)
    tip, rest = slots[0], slots[1:]
    assert all(s.north < tip.north for s in rest)
    right = sorted((s for s in rest if s.east > 0), key=lambda s: s.east)
    left = sorted((s for s in rest if s.east < 0), key=lambda s: -s.east)
    for arm in (right, left):
        assert [dist(a, b) for a, b in zip([tip, *arm], arm, strict=False)] == pytest.approx([4.0] * 4)
    assert [s.north for s in right] == pytest.approx([s.north for s in left])
    assert [s.east for s in right] == pytest.approx([-s.east for s in left])


def test_line_column_and_grid_lie_as_they_are_called() -> None:
    assert {s.north for s in shape_slots("line", 7, 2.0)} == {0.0}
    assert {s.east for s in shape_slots("column", 7, 2.0)} == {0.0}
    grid = shape_slots("grid", 9, 2.0)
    assert sorted({s.north for s in grid}) == [-2.0, 0.0, 2.0]
    assert sorted({s.east for s in grid}) == [-2.0, 0.0, 2.0]


@pytest.mark.parametrize("shape", ["circle", "sphere"])
def test_circle_and_sphere_have_one_radius(shape: str) -> None:
    slots = SHAPES[shape](17, 3.0)
    radii = [dist(s, (0.0, 0.0, 0.0)) for s in slots]
    assert radii == pytest.approx([radii[0]] * 17)


def test_spiral_turns_outward_with_its_spacing_along_it() -> None:
    slots = SHAPES["spiral"](40, 2.0)
    radii = [dist(s, (0.0, 0.0, 0.0)) for s in slots]
    assert radii == sorted(radii)
    assert [dist(a, b) for a, b in pairwise(slots)] == pytest.approx([2.0] * 39, abs=1e-9)


@pytest.mark.parametrize(
    ("heading_rad", "expected"),
    [
        (0.0, Ned(1.0, 2.0, 3.0)),
        (pi / 2, Ned(-2.0, 1.0, 3.0)),  # forward is east, right is south
        (pi, Ned(-1.0, -2.0, 3.0)),
        (-pi / 2, Ned(2.0, -1.0, 3.0)),
    ],
)
def test_heading_turns_clockwise_from_north(heading_rad: float, expected: Ned) -> None:
    assert rotated([Ned(1.0, 2.0, 3.0)], heading_rad)[0] == pytest.approx(expected)


@PROPERTY
@given(st.lists(points, min_size=2, max_size=8), st.floats(-10.0, 10.0))
def test_rotating_keeps_all_distances(slots: list[Ned], heading_rad: float) -> None:
    assert pairwise_distances_m(rotated(slots, heading_rad)) == pytest.approx(pairwise_distances_m(slots), abs=1e-9)


@PROPERTY
@given(st.lists(points, min_size=1, max_size=8))
def test_centring_keeps_all_distances_and_has_no_mean(slots: list[Ned]) -> None:
    moved = centred(slots)
    assert np.mean(moved, axis=0) == pytest.approx(np.zeros(3), abs=1e-9)
    assert pairwise_distances_m(moved) == pytest.approx(pairwise_distances_m(slots), abs=1e-9)


def test_distances_come_in_the_order_of_pairs_with_their_vertical_scale() -> None:
    slots = [Ned(0.0, 0.0, 0.0), Ned(3.0, 0.0, 0.0), Ned(0.0, 0.0, 5.0)]
    assert pairwise_distances_m(slots) == pytest.approx([3.0, 5.0, sqrt(34.0)])
    assert pairwise_distances_m(slots, 2.5) == pytest.approx([3.0, 2.0, sqrt(13.0)])
    assert minimum_distance(slots, 2.5) == pytest.approx(2.0)
    assert minimum_distance([]) == minimum_distance(slots[:1]) == inf


def cost(origins: list[Ned], slots: list[Ned], assignment: tuple[int, ...]) -> float:
    return sum(dist(o, slots[k]) ** 2 for o, k in zip(origins, assignment, strict=True))


@PROPERTY
@given(st.integers(1, 6).flatmap(lambda n: st.tuples(*[st.lists(points, min_size=n, max_size=n)] * 2)))
def test_assignment_is_the_cheapest_of_all_permutations(lists: tuple[list[Ned], list[Ned]]) -> None:
    origins, slots = lists
    best = min(cost(origins, slots, p) for p in permutations(range(len(slots))))
    found = assign(origins, slots)
    assert sorted(found) == list(range(len(slots)))
    assert cost(origins, slots, found) <= best + 1e-5


@PROPERTY
@given(st.integers(2, 5).flatmap(lambda n: st.tuples(*[st.lists(points, min_size=n, max_size=n)] * 2)), st.data())
def test_assignment_with_pinned_slots_is_the_cheapest_that_keeps_them(
    lists: tuple[list[Ned], list[Ned]], data: st.DataObject
) -> None:
    origins, slots = lists
    n = len(slots)
    rows = data.draw(st.lists(st.integers(0, n - 1), unique=True, max_size=n))
    taken = data.draw(st.permutations(range(n)))
    pinned = dict(zip(rows, taken, strict=False))
    allowed = [p for p in permutations(range(n)) if all(p[row] == slot for row, slot in pinned.items())]
    found = assign(origins, slots, pinned)
    assert found in allowed
    assert cost(origins, slots, found) <= min(cost(origins, slots, p) for p in allowed) + 1e-5


@pytest.mark.parametrize("seed", range(10))
def test_permuted_copies_of_one_problem_have_the_same_answer(seed: int) -> None:
    rng = random.Random(seed)
    origins = [Ned(*(rng.uniform(-20, 20) for _ in range(3))) for _ in range(12)]
    slots = list(shape_slots("v", 12, 4.0))
    found = assign(origins, slots)
    order = list(range(12))
    rng.shuffle(order)
    again = assign([origins[k] for k in order], slots)
    assert [found[k] for k in order] == list(again)


@pytest.mark.parametrize("count", [2, 5, 10, 20, 30])
def test_the_last_bits_of_coordinates_decide_nothing(count: int) -> None:
    """Two machines whose sines differ in the last bit: symmetrical shapes are full of equal costs."""
    rng = random.Random(count)

    def shaken(slots: Slots) -> list[Ned]:
        return [Ned(*(x * (1 + rng.uniform(-1, 1) * 4e-16) for x in s)) for s in slots]

    names = ["v", "circle", "line", "grid", "v"]
    for before, after in pairwise(names):
        a, b = shape_slots(before, count, 4.0), shape_slots(after, count, 4.0)
        assert {assign(shaken(a), shaken(b)) for _ in range(5)} == {assign(a, b)}


@pytest.mark.parametrize(("before", "after"), list(product(LEVEL, repeat=2)))
def test_paths_flown_together_keep_apart(before: str, after: str) -> None:
    """The least sum of squares keeps straight, simultaneous paths of equal spacings at spacing/sqrt(2) at least."""
    a, b = shape_slots(before, 12, 4.0), shape_slots(after, 12, 4.0)
    order = assign(a, b)
    start, end = np.array(a), np.array([b[k] for k in order])
    nearest = min(minimum_distance((1 - m) * start + m * end) for m in np.linspace(0.0, 1.0, 101))
    assert nearest >= 4.0 / sqrt(2.0) - 1e-6
