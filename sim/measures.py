"""Measures of a flight, as control engineers use them. Arrays have shape (n, 3), fleet frame, m and m/s."""

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
