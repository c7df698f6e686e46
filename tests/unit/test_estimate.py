"""The own state's filters: a bias is found, noise is reduced, a gap starts them anew."""

import random
from math import hypot, inf, sin, sqrt

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.estimate import BiasObserver, SendFilter, VelocityReference

PROPERTY = settings(deadline=None, max_examples=50)


@pytest.mark.parametrize("dt_s", [0.01, 0.02, 0.05])
@pytest.mark.parametrize("bias", [-0.25, 0.0, 0.15])
def test_observer_finds_the_bias_of_a_moving_vehicle(dt_s: float, bias: float) -> None:
    observer = BiasObserver()
    velocity = 0.0
    for k in range(round(8.0 / dt_s)):
        velocity = observer.step(3.0 + 1.2 * k * dt_s, 1.2 + bias, dt_s)
    assert velocity == pytest.approx(1.2, abs=1e-3)
    assert observer.bias_m_s == pytest.approx(bias, abs=1e-3)


def test_observer_stays_calm_under_acceleration() -> None:
    """No bias is invented on a sinusoidal path of 2 m at 1 rad/s sampled at 50 Hz."""
    observer = BiasObserver()
    worst = 0.0
    for k in range(1000):
        t = 0.02 * k
        observer.step(2.0 * sin(t), 2.0 * sin(t + 1.5707963), 0.02)
        worst = max(worst, abs(observer.bias_m_s))
    assert worst < 0.03


def test_observer_first_measurement_and_gaps() -> None:
    observer = BiasObserver()
    assert observer.step(5.0, 1.0, 0.02) == 1.0
    for k in range(500):
        observer.step(5.0 + 0.02 * k, 1.2, 0.02)
    bias = observer.bias_m_s
    assert observer.step(500.0, 1.2, 0.51) == 1.2 - bias  # the position jumped while nothing came: no error
    assert (observer.position_m, observer.bias_m_s) == (500.0, bias)
    observer.step(600.0, 1.2, 0.0)
    observer.step(600.0, 1.2, -1.0)
    assert (observer.position_m, observer.bias_m_s) == (500.0, bias)


@PROPERTY
@given(st.floats(-50, 50), st.floats(-3, 3), st.floats(-2, 2), st.sampled_from([0.01, 0.02, 0.04]))
def test_send_filter_follows_a_known_acceleration_exactly(p: float, v: float, a: float, dt_s: float) -> None:
    f = SendFilter()
    for k in range(60):
        t = k * dt_s
        f.step(p + v * t + 0.5 * a * t * t, v + a * t, a, dt_s)
        assert f.position_m == pytest.approx(p + v * t + 0.5 * a * t * t, abs=1e-9)
        assert f.velocity_m_s == pytest.approx(v + a * t, abs=1e-9)


def test_send_filter_gains_per_ten_milliseconds() -> None:
    f = SendFilter(0.0, 0.0)
    f.step(1.0, 0.0, 0.0, 0.01)
    assert f.position_m == pytest.approx(0.02, rel=0.02)
    assert f.velocity_m_s == pytest.approx(0.01)
    f = SendFilter(0.0, 0.0)
    f.step(0.0, 1.0, 0.0, 0.01)
    assert f.velocity_m_s == pytest.approx(0.05, rel=0.03)


def test_send_filter_reduces_noise_and_forgets_a_wrong_start() -> None:
    rng = random.Random(3)
    f = SendFilter(10.0, 3.0)
    p2 = v2 = 0.0
    for k in range(6000):
        f.step(rng.gauss(0.0, 0.05), rng.gauss(0.0, 0.05), 0.0, 0.02)
        if k >= 1000:
            assert f.position_m is not None
            p2 += f.position_m**2 / 5000
            v2 += f.velocity_m_s**2 / 5000
    assert sqrt(p2) < 0.015
    assert sqrt(v2) < 0.025


def test_send_filter_starts_anew_after_a_gap_and_ignores_time_that_does_not_pass() -> None:
    f = SendFilter()
    f.step(1.0, 2.0, 5.0, 0.02)
    assert (f.position_m, f.velocity_m_s) == (1.0, 2.0)
    f.step(9.0, 9.0, 0.0, 0.0)
    f.step(9.0, 9.0, 0.0, -1.0)
    assert (f.position_m, f.velocity_m_s) == (1.0, 2.0)
    f.step(9.0, -1.0, 0.0, 0.51)
    assert (f.position_m, f.velocity_m_s) == (9.0, -1.0)
    f.step(10.0, -1.0, 0.0, 0.5)
    assert f.position_m is not None
    assert 8.0 < f.position_m < 10.0


def test_velocity_reference_starts_at_the_measured_velocity_and_again_after_reset() -> None:
    r = VelocityReference()
    assert r.step(0.0, 0.0, 1.0, -2.0, 0.02) == (1.0, -2.0)
    r.step(5.0, 5.0, 1.0, -2.0, 0.1)
    r.reset()
    assert r.step(0.0, 0.0, 3.0, 4.0, 0.02) == (3.0, 4.0)


def test_velocity_reference_leads_by_the_leaking_integral_of_the_command() -> None:
    r = VelocityReference()
    for _ in range(1000):
        north, east = r.step(0.4, -0.3, 1.0, 0.0, 0.02)
    assert (north, east) == pytest.approx((1.4, -0.3), abs=1e-6)


@PROPERTY
@given(
    st.lists(st.tuples(*[st.floats(-8, 8)] * 4, st.sampled_from([0.0, 0.02, 0.3, 5.0, 1e4])), min_size=1, max_size=20)
)
def test_velocity_reference_stays_near_the_measured_velocity(steps: list[tuple[float, ...]]) -> None:
    r = VelocityReference()
    for u_n, u_e, v_n, v_e, dt_s in steps:
        north, east = r.step(u_n, u_e, v_n, v_e, dt_s)
        assert hypot(north - v_n, east - v_e) <= 1.5 + 1e-9


def test_velocity_reference_takes_absurd_numbers_without_an_exception() -> None:
    r = VelocityReference()
    r.step(1.0, 0.0, 0.0, 0.0, 0.02)
    north, _ = r.step(1.0, 0.0, 1e200, -1e200, 0.02)
    assert abs(north) < inf
