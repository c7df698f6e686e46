"""What the others must reckon with in a vehicle that they hear, and the bounds that follow on their prediction."""

from math import sqrt
from typing import NamedTuple


class PeerMotion(NamedTuple):
    """What the others must reckon with in a vehicle that they hear: its noise, and what it can do unseen."""

    sigma_p_m: float
    """of the position that it sends, about the true one"""
    sigma_v_m_s: float
    sigma_gust_m_s2: float
    a_max_m_s2: float
    """the law's limit"""
    deviation_m_s2: float
    """most by which its acceleration differs from the predicted one: what its filter may fly, and what the hold makes
    of its velocity"""
    drift_m_s: float
    """most speed that the hold leaves out of the prediction"""
    speed_m_s: float
    """most by which its velocity differs from the predicted one"""
    latency_s: float
    """control period, delay and t_min together"""
    t_max_s: float
    """longest time without a message"""


def prediction_error_bound_m(epsilon_m: float, gamma_s2: float, motion: PeerMotion) -> float:
    """Bound on |p_j - p^_j| under a threshold epsilon while nothing is lost, at about 1 - 1e-7 for Gaussian noise (m).

    epsilon + 5.7 sigma_p + L (epsilon/sqrt(gamma) + 5.7 sigma_v) + (2 a_max + 4 sigma_gust) L^2 / 2, with L the
    latency. With kappa > 0 it holds for the threshold then in force.
    """
    m, latency_s = motion, motion.latency_s
    return (
        epsilon_m
        + 5.7 * m.sigma_p_m
        + latency_s * (epsilon_m / sqrt(gamma_s2) + 5.7 * m.sigma_v_m_s)
        + 0.5 * (2.0 * m.a_max_m_s2 + 4.0 * m.sigma_gust_m_s2) * latency_s * latency_s
    )


def unheard_error_m(age_s: float, motion: PeerMotion) -> float:
    """Bound on |p_j - p^_j| by the age of the sample behind it, whatever the vehicle has done since (m).

    5.7 sigma_p + min( (drift + 5.7 sigma_v) age + (deviation + 4 sigma_gust) age^2 / 2, speed age )
    """
    m = motion
    free = (m.drift_m_s + 5.7 * m.sigma_v_m_s + 0.5 * (m.deviation_m_s2 + 4.0 * m.sigma_gust_m_s2) * age_s) * age_s
    return 5.7 * m.sigma_p_m + min(free, m.speed_m_s * age_s)
