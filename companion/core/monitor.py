"""Measures of a flight, as control engineers use them. Arrays have shape (n, 3), fleet frame, m and m/s."""

from math import sqrt

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


def prediction_error_bound_m(
    *, epsilon_m: float, gamma_s2: float, sigma_p_m: float, sigma_v_m_s: float, sigma_gust_m_s2: float,
    a_max_m_s2: float, latency_s: float,
) -> float:  # fmt: skip
    """Bound on |p_j - p^_j| while nothing is lost, at about 1 - 1e-7 for Gaussian noise (m).

    epsilon + 5.7 sigma_p + L (epsilon/sqrt(gamma) + 5.7 sigma_v) + (2 a_max + 4 sigma_gust) L^2 / 2, with L the
    control period, the delay and t_min together. With kappa > 0 it holds for the threshold then in force.
    """
    return (
        epsilon_m
        + 5.7 * sigma_p_m
        + latency_s * (epsilon_m / sqrt(gamma_s2) + 5.7 * sigma_v_m_s)
        + 0.5 * (2.0 * a_max_m_s2 + 4.0 * sigma_gust_m_s2) * latency_s * latency_s
    )
