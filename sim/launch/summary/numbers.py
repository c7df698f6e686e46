"""Means, percentiles and rounding; None where there is nothing to take them of."""

from collections.abc import Sequence

import numpy as np

from sim.launch.summary.flight import Array


def percentiles(nanoseconds: Array | None) -> dict[str, float | None]:
    """Median, 99th percentile and largest (ms)."""
    if nanoseconds is None or not len(nanoseconds):
        return {"p50": None, "p99": None, "max": None}
    p50, p99, most = np.percentile(nanoseconds * 1e-6, (50, 99, 100))
    return {"p50": rounded(float(p50)), "p99": rounded(float(p99)), "max": rounded(float(most))}


def per_vehicle(total: float, ids: Sequence[int], seconds: float) -> float | None:
    """A total as a rate of each of these vehicles (1/s)."""
    return total / len(ids) / seconds if ids and seconds else None


def rms(values: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.square(values).mean()))


def step_s(times: Array) -> float:
    """Median distance of times in ns (s)."""
    return float(np.median(np.diff(times))) * 1e-9 if len(times) > 1 else 0.0


def rounded(value: float | None, digits: int = 4) -> float | None:
    """As the summary holds a figure."""
    return None if value is None else round(value, digits)
