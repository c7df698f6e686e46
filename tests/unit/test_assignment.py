"""Assignments of least cost that every vehicle finds alike."""

import random
from itertools import pairwise, permutations, product
from math import dist, sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from companion.core.assignment import assign
from companion.core.formation import SHAPES, Slots, minimum_distance, shape_slots
from companion.core.frames import Ned

PROPERTY = settings(deadline=None, max_examples=60)
points = st.builds(Ned, *[st.floats(-20.0, 20.0)] * 3)
corners = st.builds(Ned, *[st.integers(0, 2).map(float)] * 2, st.just(0.0))
"""few places: most pairs of lists have several optima"""
LEVEL = [s for s in SHAPES if s != "sphere"]


def pairs_of(kind: st.SearchStrategy[Ned], most: int) -> st.SearchStrategy[tuple[list[Ned], list[Ned]]]:
    return st.integers(1, most).flatmap(lambda n: st.tuples(*[st.lists(kind, min_size=n, max_size=n)] * 2))


def cost(origins: list[Ned], slots: list[Ned], assignment: tuple[int, ...]) -> float:
    return sum(dist(o, slots[k]) ** 2 for o, k in zip(origins, assignment, strict=True))


@PROPERTY
@given(pairs_of(points, 6))
def test_assignment_is_the_cheapest_of_all_permutations(lists: tuple[list[Ned], list[Ned]]) -> None:
    origins, slots = lists
    best = min(cost(origins, slots, p) for p in permutations(range(len(slots))))
    found = assign(origins, slots)
    assert sorted(found) == list(range(len(slots)))
    assert cost(origins, slots, found) <= best + 1e-5


@PROPERTY
@given(pairs_of(points, 5), st.data())
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


@PROPERTY
@given(pairs_of(corners, 6), st.data())
def test_of_several_cheapest_assignments_the_smallest_is_taken(
    lists: tuple[list[Ned], list[Ned]], data: st.DataObject
) -> None:
    origins, slots = lists
    n = len(slots)
    pinned = dict(zip(data.draw(st.permutations(range(n))), data.draw(st.permutations(range(n))), strict=True))
    pinned = {row: pinned[row] for row in data.draw(st.sets(st.integers(0, n - 1)))}
    allowed = [p for p in permutations(range(n)) if all(p[row] == slot for row, slot in pinned.items())]
    assert assign(origins, slots, pinned) == min(allowed, key=lambda p: (cost_mm2(origins, slots, p), p))


def cost_mm2(origins: list[Ned], slots: list[Ned], assignment: tuple[int, ...]) -> int:
    return sum(round(1e6 * dist(o, slots[k]) ** 2) for o, k in zip(origins, assignment, strict=True))


@pytest.mark.parametrize("count", [9, 30, 50, 100])
@pytest.mark.parametrize(("before", "after"), [("grid", "v"), ("line", "circle"), ("sphere", "spiral")])
def test_a_solver_that_nobody_here_wrote_finds_none_cheaper(before: str, after: str, count: int) -> None:
    origins, slots = shape_slots(before, count, 4.0), shape_slots(after, count, 4.0)
    square_mm = [[round(1e6 * dist(o, s) ** 2) for s in slots] for o in origins]
    _, columns = linear_sum_assignment(np.array(square_mm))
    found = assign(origins, slots)
    assert sorted(found) == list(range(count))
    assert sum(square_mm[k][c] for k, c in enumerate(found)) == sum(square_mm[k][c] for k, c in enumerate(columns))


@pytest.mark.parametrize("shape", SHAPES)
def test_who_is_in_a_slot_already_keeps_it(shape: str) -> None:
    slots = shape_slots(shape, 20, 4.0)
    assert assign(slots, slots) == tuple(range(20))
