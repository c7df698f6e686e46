"""The graph of those that heed each other: undirected, the same for all, and how near it is to falling apart."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.formation import shape_slots
from companion.core.frames import Ned
from companion.core.neighbours.graph import among, connectivity, mutual_nearest

coordinates = st.floats(-50.0, 50.0)
slots = st.lists(st.builds(Ned, coordinates, coordinates, st.just(0.0)), min_size=2, max_size=25).map(
    lambda places: dict(enumerate(places, 1))
)


def line(count: int, nearest: int) -> dict[int, frozenset[int]]:
    return mutual_nearest(dict(enumerate(shape_slots("line", count, 4.0), 1)), nearest)


@settings(deadline=None, max_examples=40)
@given(slots, st.integers(1, 9))
def test_whom_one_heeds_heeds_it_and_each_heeds_as_many_as_it_may(places: dict[int, Ned], nearest: int) -> None:
    graph = mutual_nearest(places, nearest)
    assert all(i in graph[j] and i != j for i in graph for j in graph[i])
    assert all(len(graph[i]) >= min(nearest, len(places) - 1) for i in graph)


@settings(deadline=None, max_examples=40)
@given(slots, st.integers(1, 9))
def test_lambda2_is_the_laplacians_second_eigenvalue(places: dict[int, Ned], nearest: int) -> None:
    graph = mutual_nearest(places, nearest)
    n = len(places)
    laplacian = np.zeros((n, n))
    for i in graph:
        laplacian[i - 1, i - 1] = len(graph[i])
        for j in graph[i]:
            laplacian[i - 1, j - 1] = -1.0
    exact = float(np.linalg.eigvalsh(laplacian)[1])
    found = connectivity(graph).lambda2
    assert exact - 1e-6 <= found <= exact + 0.1 * max(1.0, exact)


@pytest.mark.parametrize(("nearest", "breaks"), [(1, True), (2, True), (4, False)])
def test_a_chain_breaks_with_one_of_its_links_and_a_wider_one_does_not(nearest: int, breaks: bool) -> None:
    assert connectivity(line(9, nearest)).breaks is breaks


def test_one_that_a_single_neighbour_holds_is_named() -> None:
    graph = {1: {2, 3, 4}, 2: {1, 3}, 3: {1, 2}, 4: {1}}
    found = connectivity({i: frozenset(others) for i, others in graph.items()})
    assert found.edge == 4
    assert found.breaks


def test_what_has_fallen_apart_has_a_lambda2_of_nothing() -> None:
    graph = line(9, 2)
    parted = connectivity(among(graph, graph.keys() - {4, 5}))
    assert parted.breaks
    assert parted.lambda2 == pytest.approx(0.0, abs=1e-3)
