"""Hold: what a sample says about now. The sender and every receiver call this one function, so they agree.

damped   p^ = p_k + [p_ref(t) - p_ref(t_k)] + T_d (1 - e^(-tau/T_d)) (v_k - v_d(t_k))
         v^ = v_d(t) + e^(-tau/T_d) (v_k - v_d(t_k))                            tau = t - t_k
zero     p^ = p_k, v^ = v_k                                                     (the paper's)
first    p^ = p_k + tau v_k, v^ = v_k

Where no motion is shared, the sender's own estimate nu_k of the common velocity stands for v_d, and its rate a_k fades:

         v_d(t_k + tau) = nu_k + a_k T_a (1 - e^(-tau/T_a)),   p_ref(t) - p_ref(t_k) its integral
"""

from math import exp
from typing import Literal, NamedTuple

from companion.core.values import CommonMotion

RATE_FADES_S = 2.0
"""T_a: how long a common velocity goes on changing as it did"""
HoldKind = Literal["damped", "zero", "first"]


class Weights(NamedTuple):
    """How much of plan and of own motion a sample of a given age keeps."""

    plan: float
    """1: the prediction moves with the plan; 0: it ignores it"""
    position: float
    """seconds by which the velocity relative to the plan carries the position on"""
    velocity: float
    """the part of the velocity relative to the plan that is left"""


def weights(kind: HoldKind, tau_s: float, damping_s: float) -> Weights:
    """Weights of a sample tau_s old; a sample from the future (clocks apart) counts as new."""
    tau_s = max(tau_s, 0.0)
    if kind == "damped":
        return damped(tau_s, damping_s)
    return first(tau_s) if kind == "first" else zero()


def damped(tau_s: float, damping_s: float) -> Weights:
    """Weights of the damped hold with time constant T_d = damping_s."""
    left = exp(-tau_s / damping_s)
    return Weights(1.0, damping_s * (1.0 - left), left)


def zero() -> Weights:
    """Weights of the zero-order hold: the sample as it was."""
    return Weights(0.0, 0.0, 1.0)


def first(tau_s: float) -> Weights:
    """Weights of the first-order hold: the sample's own velocity goes on."""
    return Weights(0.0, tau_s, 1.0)


def axis(
    p: float, v: float, ref_then: float, vref_then: float, ref_now: float, vref_now: float, w: Weights
) -> tuple[float, float]:
    """Predicted position (m) and velocity (m/s) of one axis from the sample (p, v)."""
    relative = v - w.plan * vref_then
    return (
        p + w.plan * (ref_now - ref_then) + w.position * relative,
        w.plan * vref_now + w.velocity * relative,
    )


class CommonWay(NamedTuple):
    """What a published common motion makes of a time since."""

    north_m: float
    """by so much the fleet has gone on"""
    east_m: float
    north_m_s: float
    """and so fast it is now"""
    east_m_s: float


def common_way(common: CommonMotion, tau_s: float) -> CommonWay:
    """The way and the velocity tau_s after a common motion was published."""
    gained_s = RATE_FADES_S * (1.0 - exp(-tau_s / RATE_FADES_S))
    way_s2 = RATE_FADES_S * (tau_s - gained_s)
    return CommonWay(
        common.north_m_s * tau_s + common.north_m_s2 * way_s2,
        common.east_m_s * tau_s + common.east_m_s2 * way_s2,
        common.north_m_s + common.north_m_s2 * gained_s,
        common.east_m_s + common.east_m_s2 * gained_s,
    )
