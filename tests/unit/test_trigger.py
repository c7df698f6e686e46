"""Triggers: just below, at and just above every threshold, and what a receiver may then be wrong by."""

import random
from math import exp, inf, nextafter, sqrt

import pytest

from companion.core.monitor import PeerMotion, prediction_error_bound_m, unheard_error_m
from companion.core.prediction import PlainKind, axis, weights
from companion.core.trigger.base import Situation, Trigger
from companion.core.trigger.error import RAISED_MAX_M, ErrorTrigger, exceeds
from companion.core.trigger.periodic import PeriodicTrigger
from companion.core.trigger.switching import SwitchingTrigger, switching_exceeds, switching_threshold

TRIGGER = ErrorTrigger(epsilon_m=0.5, gamma_s2=0.25, kappa=0.5)
SWITCHING = SwitchingTrigger(gamma_s2=0.5, alpha=0.75, beta=0.5, delta_min=0.25, delta_f=0.0625, eta=0.5)

MOTION = PeerMotion(
    sigma_p_m=0.0, sigma_v_m_s=0.0, sigma_gust_m_s2=0.0, a_max_m_s2=5.0, deviation_m_s2=12.0, drift_m_s=0.0,
    speed_m_s=8.0, lag_s=0.0, latency_s=0.1, t_min_s=0.05, t_max_s=10.0,
)  # fmt: skip


def below(x: float) -> float:
    return nextafter(x, -inf)


@pytest.mark.parametrize(
    ("error_p2", "error_v2", "residual_2", "fires"),
    [
        (below(0.25), 0.0, 0.0, False),
        (0.25, 0.0, 0.0, True),
        (nextafter(0.25, inf), 0.0, 0.0, True),
        (0.0, below(1.0), 0.0, False),  # gamma e_v^2 alone
        (0.0, 1.0, 0.0, True),
        (0.125, 0.5, 0.0, True),  # both together reach it
        (0.125, 0.5 - 1e-12, 0.0, False),
        (0.25, 0.0, 1e-9, False),  # a residual raises the threshold
        (0.2525 + 1e-12, 0.0, 0.01, True),
        (0.2525 - 1e-12, 0.0, 0.01, False),
        (0.26 + 1e-12, 0.0, 1.0, True),  # but by no more than 0.1 m
        (0.26 - 1e-12, 0.0, 1.0, False),
        (0.26 + 1e-12, 0.0, 1e6, True),
        (0.0, 0.0, 0.0, False),
    ],
)
def test_error_trigger_at_its_threshold(error_p2: float, error_v2: float, residual_2: float, fires: bool) -> None:
    assert exceeds(error_p2, error_v2, residual_2, TRIGGER) is fires


@pytest.mark.parametrize("t_s", [0.0, 1.0, 30.0])
def test_switching_threshold_decays_in_the_dynamic_mode_and_is_fixed_in_the_other(t_s: float) -> None:
    assert switching_threshold(0.25, 0.0, t_s, SWITCHING) == 0.0625  # E = eta is not yet dynamic
    assert switching_threshold(nextafter(0.25, inf), 1e-12, t_s, SWITCHING) == pytest.approx(
        0.75 * exp(-0.5 * t_s) + 0.25
    )
    assert switching_threshold(0.0625, 0.0625, t_s, SWITCHING) == 0.0625  # 0.25 m + 0.25 m/s
    assert switching_threshold(0.0625, 0.07, t_s, SWITCHING) > 0.0625


@pytest.mark.parametrize(
    ("error_p2", "error_v2", "t_s", "fires"),
    [
        (0.0625, 0.0, 5.0, True),  # delta_f
        (below(0.0625), 0.0, 5.0, False),
        (0.0, 0.125, 5.0, True),
        (0.0, below(0.125), 5.0, False),
        (0.5, 0.0, 0.0, False),  # dynamic: delta = 1 at the start
        (1.0, 0.0, 0.0, True),
        (below(1.0), 0.0, 0.0, False),
        (0.26, 0.0, 100.0, True),  # and delta_min at last
    ],
)
def test_switching_trigger_at_its_thresholds(error_p2: float, error_v2: float, t_s: float, fires: bool) -> None:
    assert switching_exceeds(error_p2, error_v2, t_s, SWITCHING) is fires


def fly(
    seed: int, kind: PlainKind, trigger: ErrorTrigger, spacing_s: tuple[float, float], delay_ticks: int
) -> tuple[float, float, int]:
    """A vehicle pushed about at up to 2 m/s^2 on a plan at 1 m/s, and one receiver of its messages.

    Returns the largest squared trigger error just after a decision, the largest position error of the receiver over
    the whole flight, and the number of messages. One axis, 20 ms ticks, 60 s; `spacing_s` is t_min and T_max.
    """
    t_min_s, t_max_s = spacing_s
    rng = random.Random(seed)
    dt = 0.02
    p, v = 0.0, 1.0
    sent = received = (0.0, p, v)
    under_way: list[tuple[int, tuple[float, float, float]]] = []
    worst_after = worst_at_receiver = 0.0
    messages = 0

    def held(sample: tuple[float, float, float], t: float) -> tuple[float, float]:
        then, position, velocity = sample
        return axis(position, velocity, then, 1.0, t, 1.0, weights(kind, t - then, 0.7))

    push = 0.0
    for k in range(1, 3001):
        t = k * dt
        push = 0.95 * push + rng.uniform(-0.3, 0.3)
        u = max(-2.0, min(2.0, push - 0.5 * (p - t) - 0.7 * (v - 1.0)))
        p, v = p + v * dt + 0.5 * u * dt * dt, v + u * dt
        while under_way and under_way[0][0] <= k:
            received = under_way.pop(0)[1]
        q, w = held(sent, t)
        since_s, fired = t - sent[0] + 1e-9, exceeds((p - q) ** 2, (v - w) ** 2, 0.0, trigger)
        if since_s >= t_max_s or (fired and since_s >= t_min_s):
            sent = (t, p, v)
            messages += 1
            under_way.append((k + delay_ticks, sent))
            if delay_ticks == 0:
                received = under_way.pop()[1]
            q, w = held(sent, t)
        worst_after = max(worst_after, (p - q) ** 2 + trigger.gamma_s2 * (v - w) ** 2)
        worst_at_receiver = max(worst_at_receiver, abs(p - held(received, t)[0]))
    return worst_after, worst_at_receiver, messages


KINDS: tuple[PlainKind, ...] = ("damped", "zero", "first")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_receiver_prediction_error_stays_below_trigger_threshold(kind: PlainKind, seed: int) -> None:
    trigger = ErrorTrigger(0.3, 0.1, 0.0)
    worst, at_receiver, messages = fly(seed, kind, trigger, (0.02, 10.0), 0)
    assert worst < 0.3**2
    assert at_receiver < 0.3
    assert 10 < messages < 3000


@pytest.mark.parametrize("seed", range(3))
def test_with_delay_and_spacing_the_receiver_stays_within_the_stated_bound(seed: int) -> None:
    trigger = ErrorTrigger(0.3, 0.1, 0.0)
    _, at_receiver, _ = fly(seed, "damped", trigger, (0.06, 10.0), 4)
    bound = prediction_error_bound_m(0.3, 0.1, MOTION._replace(a_max_m_s2=2.0, latency_s=0.02 + 0.08 + 0.06))
    assert 0.3 < at_receiver <= bound


def test_a_silent_vehicle_still_speaks_every_t_max() -> None:
    _, _, messages = fly(0, "damped", ErrorTrigger(1e6, 0.1, 0.0), (0.02, 2.0), 0)
    assert messages == pytest.approx(30, abs=1)


def test_the_threshold_is_compared_in_metres() -> None:
    assert sqrt(TRIGGER.epsilon_m**2) == 0.5
    assert exceeds(0.51**2, 0.0, 0.0, TRIGGER)
    assert not exceeds(0.49**2, 0.0, 0.0, TRIGGER)


# -- each kind as an object --------------------------------------------------------------------------------------------


def situation(**changed: float) -> Situation:
    values = {"error_position_2": 0.0, "error_velocity_2": 0.0, "mean_residual_2": 0.0, "formation_s": 0.0}
    return Situation(**{**values, "time_ns": 0, "sent_ns": 0, **changed})  # type: ignore[arg-type]


def test_the_objects_fire_as_their_formulas_say() -> None:
    assert TRIGGER.fires(situation(error_position_2=0.2525 + 1e-12, mean_residual_2=0.01))
    assert not TRIGGER.fires(situation(error_position_2=0.2525 - 1e-12, mean_residual_2=0.01))
    large = {"error_position_2": 0.9, "error_velocity_2": 0.0}
    assert not SWITCHING.fires(situation(**large))
    assert SWITCHING.fires(situation(**large, formation_s=2.0))


@pytest.mark.parametrize("kind", [TRIGGER, SWITCHING, PeriodicTrigger(0.5)])
def test_every_kind_states_where_its_bound_comes_from(kind: Trigger) -> None:
    assert kind.error_bound_m(MOTION) > 0.0
    assert kind.cause.startswith("$.trigger.")


def test_the_threshold_bounds_the_kinds_that_look_at_the_error() -> None:
    raised = sqrt(0.25 + RAISED_MAX_M**2)
    assert TRIGGER.error_bound_m(MOTION) == pytest.approx(prediction_error_bound_m(raised, 0.25, MOTION))
    assert SWITCHING.error_bound_m(MOTION) == prediction_error_bound_m(1.0, 0.5, MOTION)  # sqrt(0.75 + 0.25)
    steady = SWITCHING._replace(delta_f=4.0)
    assert steady.error_bound_m(MOTION) == prediction_error_bound_m(2.0, 0.5, MOTION)


def test_the_period_bounds_the_kind_that_does_not() -> None:
    assert PeriodicTrigger(0.5).error_bound_m(MOTION) == pytest.approx(0.5 * 12.0 * 0.6**2)
    assert PeriodicTrigger(60.0).error_bound_m(MOTION) == unheard_error_m(10.1, MOTION)  # T_max ends any silence
    bounds = [PeriodicTrigger(p).error_bound_m(MOTION) for p in (0.02, 0.05, 0.1, 0.5, 1.0, 5.0)]
    assert bounds == sorted(bounds)
    assert len(set(bounds)) == len(bounds)


@pytest.mark.parametrize("push", [-12.0, 12.0])
@pytest.mark.parametrize("period_s", [0.05, 0.5, 1.0])
def test_no_vehicle_within_its_limits_gets_farther_than_the_period_allows(push: float, period_s: float) -> None:
    """One that turns against what is predicted as hard as it can, seen just before its next message arrives."""
    age_s = period_s + MOTION.latency_s
    predicted_s, flown_s = 0.0, 0.5 * push * age_s**2
    assert abs(flown_s - predicted_s) <= PeriodicTrigger(period_s).error_bound_m(MOTION) * (1 + 1e-12)
    assert abs(flown_s - predicted_s) > 0.99 * PeriodicTrigger(period_s).error_bound_m(MOTION)


@pytest.mark.parametrize("tick_ns", [20_000_000, 16_000_000, 23_000_000, 50_000_000])
@pytest.mark.parametrize("period_s", [0.05, 0.1, 0.37, 1.0])
def test_a_period_is_kept_on_average_whatever_the_control_period(tick_ns: int, period_s: float) -> None:
    trigger, rng = PeriodicTrigger(period_s), random.Random(1)
    sent_ns, messages, gaps = 0, 0, []
    for k in range(1, 100_000_000_000 // tick_ns):
        now_ns = k * tick_ns + rng.randrange(2_000_000)
        if trigger.fires(situation(time_ns=now_ns, sent_ns=sent_ns)):
            gaps.append(now_ns - sent_ns)
            sent_ns, messages = now_ns, messages + 1
    assert messages == pytest.approx(100.0 / period_s, abs=2)
    assert max(gaps) <= period_s * 1e9 + tick_ns + 2_000_000
