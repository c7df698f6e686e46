"""The own state: what the law gets, what the peers get, and what a jump does to both."""

import pytest

from companion.core.frames import Ned
from companion.core.values import ZERO, Instant
from companion.vehicle.observer import StateObserver

NORTH_M_S = 1.0


def at(seconds: float) -> Instant:
    return Instant(round(seconds * 1e9), 1_790_000_000_000_000_000 + round(seconds * 1e9))


def flown(bias_m_s: float, seconds: float = 20.0) -> StateObserver:
    """Steady flight north, whose velocity the estimator tells wrongly."""
    o = StateObserver()
    for k in range(round(seconds / 0.02)):
        t = k * 0.02
        o.observe(Ned(NORTH_M_S * t, 0.0, -5.0), Ned(NORTH_M_S + bias_m_s, 0.0, 0.0), (0.0, 0.0), at(t))
    return o


@pytest.mark.parametrize("bias_m_s", [-0.25, 0.0, 0.2])
def test_a_steady_bias_of_the_velocity_is_found_and_taken_out(bias_m_s: float) -> None:
    o = flown(bias_m_s)
    assert o.bias_m_s == pytest.approx((bias_m_s, 0.0, 0.0), abs=0.01)
    _, velocity = o.smoothed
    assert velocity == pytest.approx((NORTH_M_S, 0.0, 0.0), abs=0.02)


def test_before_the_first_measurement_nothing_is_known() -> None:
    o = StateObserver()
    assert o.observed_ns is None
    assert o.smoothed == (ZERO, ZERO)


def test_a_jump_begins_both_filters_anew_with_the_next_measurement_and_not_before() -> None:
    o = flown(0.2)
    known = o.smoothed
    o.start_anew()
    assert o.smoothed == known, "until then what was known is what is known"
    state = o.observe(Ned(100.0, 50.0, -5.0), Ned(1.0, 0.0, 0.0), (0.0, 0.0), at(20.02))
    assert o.bias_m_s == ZERO
    assert o.smoothed == (state.position_ned_m, state.velocity_ned_m_s) == (Ned(100.0, 50.0, -5.0), Ned(1.0, 0.0, 0.0))


def test_after_half_a_second_without_a_measurement_the_smoothed_state_is_the_measured_one() -> None:
    o = flown(0.0)
    o.observe(Ned(90.0, 0.0, -5.0), Ned(1.0, 0.0, 0.0), (0.0, 0.0), at(21.0))
    assert o.smoothed[0] == Ned(90.0, 0.0, -5.0)
