"""Measures of a flight against cases with known answers."""

from math import inf, isclose, sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from companion.core.monitor import PeerMotion, prediction_error_bound_m, unheard_error_m
from sim.measures import (
    algebraic_connectivity,
    centroid_error_m,
    formation_error_m,
    minimum_distance_m,
    velocity_error_m_s,
)

PROPERTY = settings(deadline=None, max_examples=40)
clouds = st.integers(1, 8).flatmap(lambda n: arrays(np.float64, (n, 3), elements=st.floats(-50.0, 50.0)))
vectors = arrays(np.float64, (3,), elements=st.floats(-50.0, 50.0))


@PROPERTY
@given(clouds, vectors)
def test_formation_error_does_not_see_a_common_shift_and_the_centroid_error_sees_only_it(
    slots: np.ndarray, shift: np.ndarray
) -> None:
    assert formation_error_m(slots + shift, slots) == pytest.approx(np.zeros(len(slots)), abs=1e-9)
    assert centroid_error_m(slots + shift, slots) == pytest.approx(float(np.linalg.norm(shift)), abs=1e-9)
    assert velocity_error_m_s(slots + shift, slots) == pytest.approx(np.zeros(len(slots)), abs=1e-9)


def test_one_vehicle_beside_its_slot_shares_its_error_with_the_centroid() -> None:
    slots = np.zeros((4, 3))
    positions = slots.copy()
    positions[0] = [0.0, 4.0, 0.0]
    assert formation_error_m(positions, slots) == pytest.approx([3.0, 1.0, 1.0, 1.0])
    assert centroid_error_m(positions, slots) == pytest.approx(1.0)


def test_minimum_distance_of_known_points() -> None:
    assert minimum_distance_m(np.array([[0.0, 0, 0], [3.0, 4.0, 0.0], [0.0, 0.0, 2.0]])) == pytest.approx(2.0)
    assert minimum_distance_m(np.zeros((1, 3))) == inf


def line_of(count: int) -> np.ndarray:
    return np.array([[float(k), 0.0, 0.0] for k in range(count)])


@pytest.mark.parametrize(
    ("positions", "range_m", "expected"),
    [
        (line_of(5), 10.0, 5.0),  # complete graph: n
        (line_of(5), 1.0, 2.0 - 2.0 * np.cos(np.pi / 5)),  # path: 2 - 2 cos(pi/n)
        (line_of(5), 0.999, 0.0),  # just out of range: no edge
        (np.array([[0.0, 0, 0], [1, 0, 0], [9, 0, 0], [10, 0, 0]]), 2.0, 0.0),  # two parts
        (line_of(1), 1.0, 0.0),
        (np.zeros((2, 3)), 1.0, 2.0),  # at one spot
    ],
)
def test_algebraic_connectivity_of_known_graphs(positions: np.ndarray, range_m: float, expected: float) -> None:
    assert algebraic_connectivity(positions, range_m) == pytest.approx(expected, abs=1e-9)


MOTION = PeerMotion(
    sigma_p_m=0.05, sigma_v_m_s=0.05, sigma_gust_m_s2=0.3, a_max_m_s2=5.0, deviation_m_s2=12.0, drift_m_s=0.0,
    speed_m_s=8.0, latency_s=0.1, t_max_s=10.0,
)  # fmt: skip


def test_the_prediction_bound_of_law_and_defaults() -> None:
    by_hand = 0.3 + 5.7 * 0.05 + 0.1 * (0.3 / sqrt(0.1) + 5.7 * 0.05) + 0.5 * (10.0 + 1.2) * 0.01
    assert isclose(prediction_error_bound_m(0.3, 0.1, MOTION), by_hand, rel_tol=1e-12)


def test_without_latency_and_noise_the_bound_is_the_threshold() -> None:
    still = MOTION._replace(sigma_p_m=0.0, sigma_v_m_s=0.0, sigma_gust_m_s2=0.0, latency_s=0.0)
    assert prediction_error_bound_m(0.3, 0.1, still) == 0.3


def test_the_bound_of_a_silent_vehicle_by_hand() -> None:
    assert unheard_error_m(0.0, MOTION) == 5.7 * 0.05
    assert isclose(unheard_error_m(0.5, MOTION), 5.7 * 0.05 + 0.5 * 5.7 * 0.05 + 0.5 * (12.0 + 1.2) * 0.25)
    assert isclose(unheard_error_m(0.5, MOTION._replace(drift_m_s=4.0)), unheard_error_m(0.5, MOTION) + 2.0)
    assert isclose(unheard_error_m(10.0, MOTION), 5.7 * 0.05 + 80.0)  # two that fly apart at 4 m/s each
