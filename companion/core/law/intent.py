"""Published intent: send what one intends instead of the noisy state, and track the intention locally.

Each vehicle keeps an anchor c_i, its estimate of the formation's common offset from the plan, started at the measured
p_i - p_ref - D_i and driven by messages alone:

    anchor   c' = w_i + g_i,  g_i = clip(-c_g mean_j sat_1(c_i - c^_j), c_max)
    control  u_rest = -k_d sat_1(v_i - v_d - w_i - g_i) - k_p sat_1(p_i - p_ref - D_i - c_i) + a_d
    predict  c^ = c_k + w_k tau + (1/c_g)(1 - e^(-c_g tau)) g_k
             e^(tau) = response of s^2 + k_d s + k_p to (e_k, e'_k);      p^ = p_ref + D + c^ + e^
    message  t, c, g, w, e = own state - intent, e'
    no plan  w' = -2 mean sat_1(w_i - w^_j), w(0) = own measured velocity; with a plan w = 0
    send     |c - c^| >= max(epsilon_c, kappa |mean_j(c_i - c^_j)|), or |p - p^|^2 + gamma |v - v^|^2 >= epsilon_p^2

Separation, the acceleration budget and the safety filter are those of `law` and `safety`. Plain floats, one function
per equation, as in `law`.
"""

from math import cos, exp, sin, sqrt
from typing import NamedTuple

from companion.core.law.consensus import saturated


class IntentGains(NamedTuple):
    """Gains of the published-intent law, per vehicle the same."""

    k_p: float
    """tracking of the own intended place (1/s^2)"""
    k_d: float
    """tracking of the own intended velocity (1/s)"""
    c_g: float
    """how fast anchors approach each other (1/s)"""
    c_max: float
    """largest speed of an anchor against the plan (m/s)"""
    saturation_position: float
    """norm at which a position error saturates (m)"""
    saturation_velocity: float
    """norm at which a velocity error saturates (m/s)"""


class IntentTrigger(NamedTuple):
    """Thresholds of the published-intent law."""

    epsilon_c_m: float
    """anchor"""
    kappa: float
    """part of the mean anchor residual that raises the anchor's threshold"""


def anchor_rate(n: float, sx: float, sy: float, sz: float, g: IntentGains) -> tuple[float, float, float]:
    """g_i (m/s) from the sum of sat_1(c_i - c^_j) over everyone heard."""
    rate = -g.c_g / max(n, 1.0)
    return saturated(rate * sx, rate * sy, rate * sz, g.c_max)


def rest(
    ex: float, ey: float, ez: float, wx: float, wy: float, wz: float, ax: float, ay: float, az: float, g: IntentGains
) -> tuple[float, float, float]:
    """u_rest (m/s^2) from e = p - p_ref - D - c (m), its rate v - v_d - w - g (m/s) and a_d (m/s^2)."""
    px, py, pz = saturated(ex, ey, ez, g.saturation_position)
    qx, qy, qz = saturated(wx, wy, wz, g.saturation_velocity)
    return ax - g.k_d * qx - g.k_p * px, ay - g.k_d * qy - g.k_p * py, az - g.k_d * qz - g.k_p * pz


class Response(NamedTuple):
    """e(tau) = ee e_k + ed e'_k and e'(tau) = de e_k + dd e'_k."""

    ee: float
    ed: float
    de: float
    dd: float


def response(tau_s: float, g: IntentGains) -> Response:
    """Free response of e'' + k_d e' + k_p e = 0 after tau_s."""
    half = 0.5 * g.k_d
    discriminant = half * half - g.k_p
    decay = exp(-half * tau_s)
    if discriminant > 1e-9:
        root = sqrt(discriminant)
        slow, fast = exp((root - half) * tau_s), exp((-root - half) * tau_s)
        c, s = 0.5 * (slow + fast), 0.5 * (slow - fast) / root
    elif discriminant < -1e-9:
        root = sqrt(-discriminant)
        c, s = decay * cos(root * tau_s), decay * sin(root * tau_s) / root
    else:
        c, s = decay, decay * tau_s
    return Response(c + half * s, s, -g.k_p * s, c - half * s)


def anchor_axis(c: float, g: float, w: float, tau_s: float, c_g: float) -> tuple[float, float]:
    """c^ (m) and its rate (m/s) of one axis, tau_s after the message."""
    left = exp(-c_g * tau_s)
    return c + w * tau_s + (1.0 - left) / c_g * g, w + left * g


def anchor_exceeds(error_2: float, mean_residual_2: float, t: IntentTrigger) -> bool:
    """Whether the anchor's squared error (m^2) reaches its threshold."""
    return error_2 >= max(t.epsilon_c_m * t.epsilon_c_m, t.kappa * t.kappa * mean_residual_2)
