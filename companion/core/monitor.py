"""What the others must reckon with in a vehicle that they hear, and the bounds that follow on their prediction.

A prediction starts from what the vehicle said of itself. That is its send filter's state (`core.estimate`), which is
not where it is: the filter takes over the estimate's noise, and it lags behind every acceleration that it is not told
of, that is gusts, and the difference between what is commanded and what a vehicle with a lag flies. So the bounds on
|p_j - p^_j|, p_j the true position, have the filter's own error in them. `docs/theory.md` derives both.
"""

from math import hypot, log, sqrt
from typing import NamedTuple

from companion.core.estimate import command_lag, gust_lag

SIGMAS = sqrt(2.0 * log(1e7))
"""5.68: a level Gaussian vector is longer than so many standard deviations of an axis with a probability of 1e-7"""


class PeerMotion(NamedTuple):
    """What the others must reckon with in a vehicle that they hear: its noise, and what it can do unseen."""

    sigma_p_m: float
    """of the position that it measures, about the true one"""
    sigma_v_m_s: float
    """of its velocity, from one control period to the next; what is slow its bias observer takes away"""
    sigma_gust_m_s2: float
    a_max_m_s2: float
    """the law's limit: its command swings by twice that at most"""
    deviation_m_s2: float
    """most by which its acceleration differs from the predicted one: what its filter may fly, and what the hold makes
    of its velocity"""
    drift_m_s: float
    """most speed that the hold leaves out of the prediction"""
    speed_m_s: float
    """most by which its velocity differs from the predicted one"""
    lag_s: float
    """from its command to its acceleration, first order"""
    latency_s: float
    """from its last look at its own prediction error to a message's arrival: control period and delay"""
    t_min_s: float
    """for so long after a message it does not look"""
    t_max_s: float
    """longest time without a message"""


def prediction_error_bound_m(epsilon_m: float, gamma_s2: float, motion: PeerMotion) -> float:
    """Bound on |p_j - p^_j| under a threshold epsilon while nothing is lost, at about 1 - 1e-7 for Gaussian noise (m).

    epsilon sqrt(1 + L^2/gamma) + own(L) + drift L + (2 a_max) L^2 / 2, with L the latency and `own_error_m`; or the
    same of the time L + t_min, without the threshold, after a message behind which the trigger does not look.
    """
    latency_s = motion.latency_s
    looked = epsilon_m * sqrt(1.0 + latency_s * latency_s / gamma_s2) + _unlooked_m(latency_s, motion)
    return max(looked, _unlooked_m(latency_s + motion.t_min_s, motion))


def _unlooked_m(time_s: float, motion: PeerMotion) -> float:
    """What the law may do in a time in which nobody compares, and the sample's own error (m)."""
    return own_error_m(time_s, motion) + (motion.drift_m_s + motion.a_max_m_s2 * time_s) * time_s


def unheard_error_m(age_s: float, motion: PeerMotion) -> float:
    """Bound on |p_j - p^_j| by the age of the sample behind it, whatever the vehicle has done since (m).

    min( own(age) + drift age + deviation age^2 / 2, own(0) + speed age ), with `own_error_m`
    """
    m = motion
    free = own_error_m(age_s, m) + (m.drift_m_s + 0.5 * m.deviation_m_s2 * age_s) * age_s
    return min(free, own_error_m(0.0, m) + m.speed_m_s * age_s)


def own_error_m(time_s: float, motion: PeerMotion) -> float:
    """How wrong a sample is about its own vehicle, carried a time ahead with its velocity (m).

    5.68 sqrt( sigma_p^2 + (sigma_v (0.06 s + 0.25 time))^2 + (sigma_gust ((1 + 2 time)/11 + time^2 / 2))^2 )
    + 2 a_max max(e + w time)

    The send filter takes over all of a slow position noise and, at 50 Hz, so little of a white velocity noise. What it
    lags behind a gust is `estimate.gust_lag`, behind a command `estimate.command_lag`.
    """
    m = motion
    gust_p, gust_v = gust_lag()
    noise_m = hypot(
        m.sigma_p_m,
        m.sigma_v_m_s * (0.06 + 0.25 * time_s),
        m.sigma_gust_m_s2 * (gust_p + gust_v * time_s + 0.5 * time_s * time_s),
    )
    return SIGMAS * noise_m + 2.0 * m.a_max_m_s2 * max(e + w * time_s for e, w in command_lag(m.lag_s))
