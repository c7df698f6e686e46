"""Holds: the damped and the returning one solve their differential equations, the others are what their names say."""

from math import cos, exp, hypot, sin

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from companion.core.frames import Ned
from companion.core.prediction import (
    PlainHold,
    PlainKind,
    Pull,
    ReturningHold,
    Weights,
    axis,
    damped,
    response,
    weights,
)
from companion.core.trajectory.fleet import Reference
from companion.core.values import ZERO, PeerSample, Phase

PROPERTY = settings(deadline=None, max_examples=60)
values = st.floats(-100.0, 100.0)
speeds = st.floats(-5.0, 5.0)
KINDS: tuple[PlainKind, ...] = ("damped", "zero", "first")
gains = st.floats(0.05, 10.0)


def reference(t: float) -> tuple[float, float, float]:
    """Some plan: position, velocity, acceleration of one axis."""
    return 0.8 * t + 2.0 * sin(0.4 * t), 0.8 + 0.8 * cos(0.4 * t), -0.32 * sin(0.4 * t)


@settings(deadline=None, max_examples=15)
@given(values, speeds, st.floats(0.2, 3.0), st.floats(0.0, 8.0))
def test_damped_hold_solves_its_differential_equation(p: float, v: float, damping_s: float, tau_s: float) -> None:
    """p' = v and v' = a_d - (v - v_d)/T_d: the vehicle flies its plan and loses what it had besides within T_d."""
    start = 3.0

    def rate(t: float, state: np.ndarray) -> list[float]:
        _, v_d, a_d = reference(t)
        return [state[1], a_d - (state[1] - v_d) / damping_s]

    solution = solve_ivp(rate, (start, start + tau_s), [p, v], rtol=1e-9, atol=1e-9)
    then, now = reference(start), reference(start + tau_s)
    held = axis(p, v, then[0], then[1], now[0], now[1], weights("damped", tau_s, damping_s))
    assert held == pytest.approx(tuple(solution.y[:, -1]), abs=1e-5)


@PROPERTY
@given(values, speeds, values, values, speeds, speeds, st.floats(0.0, 60.0))
def test_zero_and_first_order_hold_ignore_the_plan(
    p: float, v: float, ref_then: float, ref_now: float, v_then: float, v_now: float, tau_s: float
) -> None:
    assert axis(p, v, ref_then, v_then, ref_now, v_now, weights("zero", tau_s, 0.7)) == (p, v)
    assert axis(p, v, ref_then, v_then, ref_now, v_now, weights("first", tau_s, 0.7)) == pytest.approx(
        (p + tau_s * v, v), abs=1e-9
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("tau_s", [0.0, -1e-9, -0.5, -100.0])
def test_a_sample_from_now_or_the_future_is_taken_as_it_is(kind: PlainKind, tau_s: float) -> None:
    assert axis(7.0, 2.0, 1.0, 0.5, 1.0, 0.5, weights(kind, tau_s, 0.7)) == (7.0, 2.0)


@PROPERTY
@given(values, speeds, values, speeds, st.floats(0.0, 1e5))
def test_an_old_damped_sample_flies_with_the_plan(p: float, v: float, ref: float, v_d: float, tau_s: float) -> None:
    position, velocity = axis(p, v, ref, v_d, ref + v_d * tau_s, v_d, damped(tau_s, 0.7))
    carried = 0.7 * (1.0 - exp(-tau_s / 0.7))
    assert position == pytest.approx(p + v_d * tau_s + carried * (v - v_d), abs=1e-6)
    assert abs(velocity - v_d) <= abs(v - v_d) + 1e-12


@PROPERTY
@given(values, speeds, values, speeds, values, speeds, st.floats(0.0, 20.0), values, speeds)
def test_hold_moves_with_a_shifted_and_drifting_frame(
    p: float, v: float, ref: float, v_d: float, ref_now: float, v_now: float, tau_s: float, shift: float, drift: float
) -> None:
    """Damped: what the plan does besides is added to the prediction and to nothing else."""
    w = damped(tau_s, 0.7)
    x, xv = axis(p, v, ref, v_d, ref_now, v_now, w)
    y, yv = axis(p + shift, v + drift, ref + shift, v_d + drift, ref_now + shift + drift * tau_s, v_now + drift, w)
    assert y == pytest.approx(x + shift + drift * tau_s, abs=1e-8)
    assert yv == pytest.approx(xv + drift, abs=1e-9)


@PROPERTY
@given(st.floats(0.05, 5.0), st.floats(0.0, 50.0), st.floats(0.0, 50.0))
def test_holding_twice_is_holding_once(damping_s: float, first_s: float, second_s: float) -> None:
    """Splitting the time changes nothing, so a prediction may be sent on as a sample."""
    a, b, whole = (damped(t, damping_s) for t in (first_s, second_s, first_s + second_s))
    assert a.velocity * b.velocity == pytest.approx(whole.velocity, abs=1e-12)
    assert a.position + a.velocity * b.position == pytest.approx(whole.position, abs=1e-9)


def test_weights_of_a_known_age() -> None:
    assert weights("damped", 0.7, 0.7) == pytest.approx(Weights(1.0, 0.7 * (1 - exp(-1)), exp(-1)))
    assert weights("zero", 5.0, 0.7) == (0.0, 0.0, 1.0)
    assert weights("first", 5.0, 0.7) == (0.0, 5.0, 1.0)


# -- the returning hold ------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=30)
@given(values, speeds, gains, gains, st.floats(0.0, 8.0))
@example(3.0, 1.0, 2.0, 1.0, 2.0).via("critically damped")
def test_returning_hold_solves_its_differential_equation(
    p: float, v: float, k_v: float, k_p: float, tau_s: float
) -> None:
    """p' = v and v' = a_d - k_v (v - v_d) - k_p (p - p_ref): the plan's pull, within its saturation."""
    start = 3.0

    def rate(t: float, state: np.ndarray) -> list[float]:
        place, v_d, a_d = reference(t)
        return [state[1], a_d - k_v * (state[1] - v_d) - k_p * (state[0] - place)]

    solution = solve_ivp(rate, (start, start + tau_s), [p, v], rtol=1e-9, atol=1e-9)
    then, now = reference(start), reference(start + tau_s)
    r, off, rate = response(tau_s, k_v, k_p), p - then[0], v - then[1]
    held = now[0] + r.ee * off + r.ed * rate, now[1] + r.de * off + r.dd * rate
    assert held == pytest.approx(tuple(solution.y[:, -1]), abs=2e-5)


def state(p: Ned, v: Ned) -> PeerSample:
    return PeerSample(2, 0, p, v, 0, Phase.FORMED)


PLACE = Reference(ZERO, ZERO, ZERO, 0.0)
vectors = st.builds(Ned, values, values, values)
velocities = st.builds(Ned, speeds, speeds, speeds)
pulls = st.builds(Pull, gains, gains, st.floats(0.01, 5.0), st.floats(2.0, 20.0))


@PROPERTY
@given(vectors, velocities, pulls, st.floats(0.0, 30.0))
def test_the_bounds_of_the_returning_hold_are_kept(p: Ned, v: Ned, pull: Pull, tau_s: float) -> None:
    hold, step_s = ReturningHold(pull, PlainHold("damped", 0.7)), 1e-4
    bounds = hold.bounds(hypot(v.north, v.east))
    a, b = (hold.at(state(p, v), (ZERO, ZERO), PLACE, t).velocity_ned_m_s for t in (tau_s, tau_s + step_s))
    assert hypot(b.north - a.north, b.east - a.east) / step_s <= bounds.braking_m_s2 * (1.0 + 1e-6) + 1e-6
    assert hypot(a.north, a.east) <= hypot(v.north, v.east) + bounds.gained_m_s + 1e-9


@PROPERTY
@given(vectors, pulls)
def test_what_is_beyond_the_saturation_and_the_limit_stays_and_the_direction_is_kept(p: Ned, pull: Pull) -> None:
    """Whoever stands far off is predicted to come as much nearer as one at the saturation, straight."""
    hold = ReturningHold(pull, PlainHold("damped", 0.7))
    held = hold.at(state(p, ZERO), (ZERO, ZERO), PLACE, 1e4).position_ned_m
    off_m = hypot(p.north, p.east)
    returns_m = min(off_m, pull.saturation_m) * min(1.0, pull.a_max_m_s2 / (pull.k_p * pull.saturation_m))
    if off_m < pull.saturation_m:
        returns_m = min(off_m, pull.a_max_m_s2 / pull.k_p)
    left = (off_m - returns_m) / max(off_m, 1e-12)
    assert (held.north, held.east) == pytest.approx((left * p.north, left * p.east), abs=1e-6)
    assert held.down == p.down


@PROPERTY
@given(vectors, velocities, st.floats(0.0, 30.0))
def test_where_no_motion_is_shared_and_along_the_vertical_it_is_the_damped_one(p: Ned, v: Ned, tau_s: float) -> None:
    plain = PlainHold("damped", 0.7)
    hold, free = ReturningHold(Pull(1.0, 0.3, 1.0, 5.0), plain), PLACE._replace(shared=False)
    assert hold.at(state(p, v), (ZERO, ZERO), free, tau_s) == plain.at(state(p, v), (ZERO, ZERO), free, tau_s)
    ours, theirs = (h.at(state(p, v), (ZERO, ZERO), PLACE, tau_s) for h in (hold, plain))
    assert (ours[0].down, ours[1].down) == (theirs[0].down, theirs[1].down)
