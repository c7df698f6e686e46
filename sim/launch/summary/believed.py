"""The same figures as the companions' own estimates have them: what is judged where nobody knows the truth."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from companion.core.trajectory.history import TrajectoryHistory
from sim.launch.summary.flight import POSITION, TICK_ROWS, VELOCITY, Array, Flight
from sim.launch.summary.numbers import rms, rounded
from sim.launch.summary.steady import errors_from_slots, steady_at

STEP_NS = 100_000_000


def times_of(flight: Flight, ids: Sequence[int]) -> Array:
    """Ten times a second while every companion has ticked since the take-off."""
    rows = [flight.ticks.get(i, np.zeros(0, TICK_ROWS)) for i in ids]
    if not rows or not all(len(r) for r in rows):
        return np.zeros(0, np.int64)
    begin = max(flight.takeoff_ns, *(int(r["fleet_ns"][0]) for r in rows))
    return np.arange(begin, min(int(r["fleet_ns"][-1]) for r in rows), STEP_NS, dtype=np.int64)


def motion_of(flight: Flight, ids: Sequence[int], times: Array, axes: Sequence[str]) -> Array:
    """Positions or velocities as the companions have them, over (time, vehicle, axis)."""
    if not len(times):
        return np.zeros((0, len(ids), 3))
    rows = [flight.ticks[i] for i in ids]
    return np.stack(
        [np.stack([np.interp(times, r["fleet_ns"], r[axis]) for axis in axes], axis=1) for r in rows], axis=1
    )


def believed_errors(
    flight: Flight, history: TrajectoryHistory, ids: Sequence[int], formed: int | None, window: tuple[int, int]
) -> dict[str, Any]:
    """The same errors as the companions' own estimates have them."""
    times = times_of(flight, ids)
    times = times[steady_at(flight, history, times, formed) & (times >= window[0]) & (times <= window[1])]
    motion = (motion_of(flight, ids, times, axes) for axes in (POSITION, VELOCITY))
    return errors_from_slots(flight.config, history, ids, times, *motion)


def estimate_errors(
    flight: Flight, history: TrajectoryHistory, ids: Sequence[int], formed: int | None, window: tuple[int, int],
    true_times: Array, true_position: Array,
) -> dict[str, float | None]:  # fmt: skip
    """How wrong the estimates are, how alike among vehicles, and the formation error if they were not.

    Simulators may give all vehicles the same noise. Errors that are copies move all alike, and neither distances nor
    the formation error, which is about the centroid, see them. Shifted in time against each other they are seen.
    """
    nothing = dict.fromkeys(("error_rms_m", "pair_correlation", "formation_error_decorrelated_rms_m"))
    times = times_of(flight, ids)
    times = times[steady_at(flight, history, times, formed) & (times >= window[0]) & (times <= window[1])]
    if not len(true_times) or len(times) < 2 * len(ids) or len(ids) < 2:
        return nothing
    believed, velocity = (motion_of(flight, ids, times, axes) for axes in (POSITION, VELOCITY))
    error = np.empty_like(believed)
    for k in range(len(ids)):
        for axis in range(3):
            error[:, k, axis] = np.interp(times, true_times, true_position[:, k, axis]) - believed[:, k, axis]
    apart = len(times) // len(ids)
    shifted = np.stack([np.roll(error[:, k], k * apart, axis=0) for k in range(len(ids))], axis=1)
    figures = errors_from_slots(flight.config, history, ids, times, believed + shifted, velocity)
    return {
        "error_rms_m": rounded(rms(np.linalg.norm(error, axis=2))),
        "pair_correlation": rounded(_pair_correlation(error)),
        "formation_error_decorrelated_rms_m": figures["formation_error_rms_m"],
    }


def _pair_correlation(error: Array) -> float | None:
    """Mean correlation of two vehicles' level errors about their means; None where there are none."""
    level = error[:, :, :2] - error[:, :, :2].mean(axis=0)
    product = np.einsum("tia,tja->ij", level, level)
    size = np.sqrt(np.diag(product))
    if not size.all():
        return None
    i, j = np.triu_indices(len(size), 1)
    return float((product[i, j] / (size[i] * size[j])).mean())


def minimum_distance_m(flight: Flight, ids: Sequence[int]) -> float | None:
    """Smallest distance of any pair from the take-off on, by their own estimates."""
    p = motion_of(flight, ids, times_of(flight, ids), POSITION)
    i, j = np.triu_indices(len(ids), 1)
    distance = np.linalg.norm(p[:, i] - p[:, j], axis=2)
    return rounded(float(distance.min())) if distance.size else None
