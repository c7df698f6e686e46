"""Shapes for every size."""

from itertools import pairwise
from math import dist, inf, pi, sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.formation import (
    SHAPES,
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
