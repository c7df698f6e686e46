"""Triggers: just below, at and just above every threshold, and what a receiver may then be wrong by."""

import random
from math import exp, inf, nextafter, sqrt

import pytest

from companion.core.hold import HoldKind, axis, weights
from companion.core.monitor import prediction_error_bound_m
from companion.core.trigger import (
    ErrorTrigger,
    Spacing,
    SwitchingTrigger,
    exceeds,
    switching_exceeds,
    switching_threshold,
)

TRIGGER = ErrorTrigger(epsilon_m=0.5, gamma_s2=0.25, kappa=0.5)
SWITCHING = SwitchingTrigger(gamma_s2=0.5, alpha=0.75, beta=0.5, delta_min=0.25, delta_f=0.0625, eta=0.5)
SPACING = Spacing(t_min_s=0.0625, t_max_s=8.0)


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


@pytest.mark.parametrize(
    ("since_s", "silence_limit_s", "fired", "sends"),
    [
        (below(0.0625), 8.0, True, False),  # t_min holds even a fired one back
        (0.0625, 8.0, True, True),
        (0.0625, 8.0, False, False),
        (below(6.5), 6.5, False, False),  # the jittered T_max
        (6.5, 6.5, False, True),
        (0.0, 8.0, True, False),
    ],
)
def test_spacing_between_messages(since_s: float, silence_limit_s: float, fired: bool, sends: bool) -> None:
    assert SPACING.decide(since_s, silence_limit_s, fired) is sends


def fly(
    seed: int, kind: HoldKind, trigger: ErrorTrigger, spacing: Spacing, delay_ticks: int
) -> tuple[float, float, int]:
    """A vehicle pushed about at up to 2 m/s^2 on a plan at 1 m/s, and one receiver of its messages.

    Returns the largest squared trigger error just after a decision, the largest position error of the receiver over
    the whole flight, and the number of messages. One axis, 20 ms ticks, 60 s.
    """
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
        if spacing.decide(t - sent[0] + 1e-9, spacing.t_max_s, exceeds((p - q) ** 2, (v - w) ** 2, 0.0, trigger)):
            sent = (t, p, v)
            messages += 1
            under_way.append((k + delay_ticks, sent))
            if delay_ticks == 0:
                received = under_way.pop()[1]
            q, w = held(sent, t)
        worst_after = max(worst_after, (p - q) ** 2 + trigger.gamma_s2 * (v - w) ** 2)
        worst_at_receiver = max(worst_at_receiver, abs(p - held(received, t)[0]))
    return worst_after, worst_at_receiver, messages


KINDS: tuple[HoldKind, ...] = ("damped", "zero", "first")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_receiver_prediction_error_stays_below_trigger_threshold(kind: HoldKind, seed: int) -> None:
    trigger = ErrorTrigger(0.3, 0.1, 0.0)
    worst, at_receiver, messages = fly(seed, kind, trigger, Spacing(0.02, 10.0), 0)
    assert worst < 0.3**2
    assert at_receiver < 0.3
    assert 10 < messages < 3000


@pytest.mark.parametrize("seed", range(3))
def test_with_delay_and_spacing_the_receiver_stays_within_the_stated_bound(seed: int) -> None:
    trigger = ErrorTrigger(0.3, 0.1, 0.0)
    _, at_receiver, _ = fly(seed, "damped", trigger, Spacing(0.06, 10.0), 4)
    bound = prediction_error_bound_m(
        epsilon_m=0.3, gamma_s2=0.1, sigma_p_m=0.0, sigma_v_m_s=0.0, sigma_gust_m_s2=0.0, a_max_m_s2=2.0,
        latency_s=0.02 + 0.08 + 0.06,
    )  # fmt: skip
    assert 0.3 < at_receiver <= bound


def test_a_silent_vehicle_still_speaks_every_t_max() -> None:
    _, _, messages = fly(0, "damped", ErrorTrigger(1e6, 0.1, 0.0), Spacing(0.02, 2.0), 0)
    assert messages == pytest.approx(30, abs=1)


def test_the_threshold_is_compared_in_metres() -> None:
    assert sqrt(TRIGGER.epsilon_m**2) == 0.5
    assert exceeds(0.51**2, 0.0, 0.0, TRIGGER)
    assert not exceeds(0.49**2, 0.0, 0.0, TRIGGER)
