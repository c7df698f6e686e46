"""Measures of a flight against cases with known answers."""

from collections.abc import Sequence
from math import exp, inf, log, sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from companion.core.estimate import alpha_beta, command_lag, gust_lag
from companion.core.monitor import PeerMotion, own_error_m, prediction_error_bound_m, unheard_error_m
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
    speed_m_s=8.0, lag_s=0.15, latency_s=0.07, t_min_s=0.05, t_max_s=10.0,
)  # fmt: skip


STILL = MOTION._replace(sigma_p_m=0.0, sigma_v_m_s=0.0, sigma_gust_m_s2=0.0, lag_s=0.0, a_max_m_s2=0.0)
"""without noise, gusts or a lag: nothing makes its sample wrong, and its law does nothing"""
MOTIONS = st.builds(
    PeerMotion,
    sigma_p_m=st.floats(0.0, 1.0), sigma_v_m_s=st.floats(0.0, 1.0), sigma_gust_m_s2=st.floats(0.0, 5.0),
    a_max_m_s2=st.floats(2.0, 20.0), deviation_m_s2=st.floats(40.0, 60.0), drift_m_s=st.floats(0.0, 4.0),
    speed_m_s=st.floats(4.0, 10.0), lag_s=st.sampled_from([0.0, 0.05, 0.15, 0.3, 0.5]),
    latency_s=st.floats(0.0, 0.5), t_min_s=st.floats(0.0, 0.5), t_max_s=st.floats(1.0, 20.0),
)  # fmt: skip


def test_the_prediction_bound_of_law_and_defaults() -> None:
    gust, ahead = 0.3 * (1.14 / 11 + 0.5 * 0.07**2), 0.05 * (0.06 + 0.25 * 0.07)
    swing = max(e + 0.07 * w for e, w in command_lag(0.15))
    own = sqrt(2.0 * log(1e7)) * sqrt(0.05**2 + ahead**2 + gust**2) + 10.0 * swing
    by_hand = 0.3 * sqrt(1.0 + 0.07**2 / 0.1) + own + 0.5 * 10.0 * 0.07**2
    assert own_error_m(0.07, MOTION) == pytest.approx(own, rel=1e-12)
    assert prediction_error_bound_m(0.3, 0.1, MOTION) == pytest.approx(by_hand, rel=1e-12)


def test_of_a_vehicle_that_is_where_it_says_the_bound_is_the_threshold_carried_on() -> None:
    assert prediction_error_bound_m(0.3, 0.1, STILL._replace(latency_s=0.0)) == 0.3
    assert prediction_error_bound_m(0.3, 0.09, STILL._replace(latency_s=0.4)) == pytest.approx(0.5)  # 3, 4, 5


def test_behind_a_message_the_trigger_does_not_look() -> None:
    """A threshold of nothing: what may happen in t_min and the latency remains."""
    blind = STILL._replace(a_max_m_s2=5.0, latency_s=0.1, t_min_s=0.4)
    assert prediction_error_bound_m(1e-9, 0.1, blind) == pytest.approx(0.5 * 10.0 * 0.5**2)


@PROPERTY
@given(MOTIONS, st.floats(0.0, 2.0), st.floats(0.001, 10.0), st.sampled_from(PeerMotion._fields), st.floats(0.0, 0.5))
def test_the_bound_grows_with_everything_that_may_make_a_prediction_wrong(
    motion: PeerMotion, epsilon_m: float, gamma_s2: float, name: str, more: float
) -> None:
    bound = prediction_error_bound_m(epsilon_m, gamma_s2, motion)
    assert epsilon_m <= bound <= prediction_error_bound_m(epsilon_m + more, gamma_s2, motion)
    assert bound >= prediction_error_bound_m(epsilon_m, gamma_s2 + more, motion) - 1e-12
    if name != "lag_s":  # by a lag of 0.15 s or more the filter's velocity errs less than its position more
        larger = motion._replace(**{name: getattr(motion, name) + more})
        assert bound <= prediction_error_bound_m(epsilon_m, gamma_s2, larger) + 1e-12


@PROPERTY
@given(MOTIONS, st.floats(0.0, 20.0), st.floats(0.0, 1.0))
def test_the_bound_of_a_silent_vehicle_grows_with_its_silence(motion: PeerMotion, age_s: float, more_s: float) -> None:
    assert unheard_error_m(0.0, motion) == own_error_m(0.0, motion)
    assert unheard_error_m(age_s, motion) <= unheard_error_m(age_s + more_s, motion) + 1e-9
    assert unheard_error_m(age_s, motion) <= own_error_m(0.0, motion) + motion.speed_m_s * age_s


def test_the_bound_of_a_silent_vehicle_by_hand() -> None:
    assert unheard_error_m(0.5, MOTION) == pytest.approx(own_error_m(0.5, MOTION) + 0.5 * 12.0 * 0.25)
    assert unheard_error_m(0.1, MOTION._replace(drift_m_s=4.0)) == pytest.approx(unheard_error_m(0.1, MOTION) + 0.4)
    assert unheard_error_m(10.0, MOTION) == pytest.approx(own_error_m(0.0, MOTION) + 80.0)  # two apart at 4 m/s each


# -- what a send filter lags behind ------------------------------------------------------------------------------------


def filter_run(flown: Sequence[float], told: Sequence[float], dt_s: float) -> np.ndarray:
    """(p_f - p, v_f - v) at each step of a vehicle that flies and tells its filter these accelerations (m/s^2)."""
    p = v = filtered_p = filtered_v = 0.0
    errors = []
    for a, u in zip(flown, told, strict=True):
        p, v = p + dt_s * v + 0.5 * dt_s * dt_s * a, v + dt_s * a
        filtered_p, filtered_v = alpha_beta(filtered_p, filtered_v, p, v, u, dt_s)
        errors.append((filtered_p - p, filtered_v - v))
    return np.array(errors)


def test_a_constant_gust_is_followed_as_far_behind_as_is_said() -> None:
    p, v = gust_lag()
    assert (p, v) == pytest.approx((1 / 11, 2 / 11))
    assert filter_run([1.0] * 8000, [0.0] * 8000, 0.001)[-1] == pytest.approx([-p, -v], rel=4e-3)


@PROPERTY
@given(st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=30), st.floats(0.0, 0.5))
def test_no_gust_within_its_size_takes_the_filter_farther_behind(gusts: list[float], ahead_s: float) -> None:
    flown = np.repeat(gusts, 10)
    errors = filter_run(flown.tolist(), [0.0] * len(flown), 0.02)
    p, v = gust_lag()
    assert np.abs(errors @ [1.0, ahead_s]).max() <= p + ahead_s * v


@PROPERTY
@given(st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=30), st.floats(0.0, 0.5), st.sampled_from([0.05, 0.15, 0.3]))
def test_no_command_within_its_limit_takes_the_filter_farther_ahead(
    commands: list[float], ahead_s: float, lag_s: float
) -> None:
    """Ten to twenty-fold from the limit to its opposite included, at rest and at the limit before."""
    told = np.repeat([commands[0], *np.sign(commands), *commands], 10)
    flown, a = [], 0.0
    for u in told:
        a += (1.0 - exp(-0.02 / lag_s)) * (u - a)
        flown.append(a)
    errors = filter_run(flown, told.tolist(), 0.02)
    bound = 2.0 * max(e + ahead_s * w for e, w in command_lag(lag_s))
    assert np.abs(errors @ [1.0, ahead_s]).max() <= bound * (1 + 1e-3)


def test_a_reversal_of_the_command_comes_near_what_is_said() -> None:
    told = [-1.0] * 3000 + [1.0] * 1000
    flown, a = [], -1.0
    for u in told:
        a += (1.0 - exp(-0.001 / 0.15)) * (u - a)
        flown.append(a)
    errors = filter_run(flown, told, 0.001)[2500:]
    for ahead_s in (0.0, 0.07, 0.2):
        bound = 2.0 * max(e + ahead_s * w for e, w in command_lag(0.15))
        assert (errors @ [1.0, ahead_s]).max() == pytest.approx(bound, rel=0.01)


def test_without_a_lag_the_filter_is_not_ahead() -> None:
    assert command_lag(0.0) == ((0.0, 0.0),)
