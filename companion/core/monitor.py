"""Measures of a flight, as control engineers use them. Arrays have shape (n, 3), fleet frame, m and m/s."""

from math import sqrt
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def formation_error_m(positions: Array, references: Array) -> Array:
    """Each vehicle's distance from its slot about the common centre, shape (n,): the mean offset from the plan is
    taken out, so that it measures shape and not place."""
    offset = positions - references
    return np.asarray(np.linalg.norm(offset - offset.mean(axis=0), axis=1))


def centroid_error_m(positions: Array, references: Array) -> float:
    """Distance of the vehicles' centroid from the plan's (m)."""
    return float(np.linalg.norm((positions - references).mean(axis=0)))


def velocity_error_m_s(velocities: Array, references: Array) -> Array:
    """Each vehicle's velocity against the common one, shape (n,): slots' own velocities and the mean taken out."""
    relative = velocities - references
    return np.asarray(np.linalg.norm(relative - relative.mean(axis=0), axis=1))


def minimum_distance_m(positions: Array) -> float:
    """Smallest distance of any pair (m); infinite for one vehicle."""
    i, j = np.triu_indices(len(positions), 1)
    return float(np.linalg.norm(positions[i] - positions[j], axis=1).min(initial=np.inf))


def algebraic_connectivity(positions: Array, range_m: float) -> float:
    """lambda_2 of the Laplacian of the graph that joins vehicles within `range_m` (section 1.2 of the paper)."""
    distance = np.linalg.norm(positions[:, None] - positions[None, :], axis=2)
    adjacency = (distance <= range_m).astype(float)
    np.fill_diagonal(adjacency, 0.0)
    laplacian = np.diag(adjacency.sum(axis=1)) - adjacency
    return float(np.linalg.eigvalsh(laplacian)[1]) if len(positions) > 1 else 0.0


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
