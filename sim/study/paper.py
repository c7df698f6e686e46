"""What the two examples of the paper have in common: their error measure, their curves and their comparison rows."""

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from sim.study.common import Record, measured
from sim.study.figures import BLUE, GREEN, GREY, ORANGE, panels
from sim.swarm.setup import Setup
from sim.swarm.swarm import Run, run

Floats = npt.NDArray[np.float64]


def per_axis_rms_m(flown: Run) -> Floats:
    """Formation error as the paper's printed values have it: RMS over vehicles and axes, shape (T,).

    For starts spread evenly in a ball of radius R it is R/sqrt(5) at t = 0, as printed; a maximum would be near R.
    """
    offset = flown.position_m - flown.reference[:, :, :3]
    offset = offset - offset.mean(axis=1, keepdims=True)
    return np.asarray(np.sqrt((offset**2).mean(axis=(1, 2))))


def per_axis_velocity_rms_m_s(flown: Run) -> Floats:
    """The same of the velocities, about their mean, shape (T,)."""
    relative = flown.velocity_m_s - flown.velocity_m_s.mean(axis=1, keepdims=True)
    return np.asarray(np.sqrt((relative**2).mean(axis=(1, 2))))


def at(flown: Run, values: Floats, time_s: float) -> float:
    """The value at a time."""
    return float(values[min(round(time_s / (flown.setup.keep_every * flown.setup.dt_s)), len(values) - 1)])


def example_record(flown: Run, times_s: tuple[float, ...]) -> Record:
    """What is kept of one run of an example."""
    errors = per_axis_rms_m(flown)
    gaps = flown.intervals_s()
    speeds = np.linalg.norm(flown.velocity_m_s.mean(axis=1), axis=1)
    keep = measured(flown)
    return {
        "interval_mean_s": float(gaps.mean()),
        "interval_median_s": float(np.median(gaps)),
        "counts": flown.per_agent().tolist(),
        "errors_m": [at(flown, errors, t) for t in times_s],
        "speed_m_s": [at(flown, speeds, t) for t in times_s],
        "messages": flown.messages,
        "formation_rmse_m": keep["formation_rmse_m"],
        "formation_rmse_centred_m": keep["formation_rmse_centred_m"],
        "velocity_rmse_m_s": keep["velocity_rmse_m_s"],
    }


def error_curves(flown: Run, title: str) -> tuple[Any, float]:
    """Formation, velocity and total error on a logarithmic axis, and the fitted rate of the formation error (1/s)."""
    t = flown.time_s
    formation, velocity = per_axis_rms_m(flown), per_axis_velocity_rms_m_s(flown)
    floor = float(np.median(formation[t > 0.6 * t[-1]]))
    falling = (t < 8.0) & (formation > 3.0 * floor)
    rate = float(-np.polyfit(t[falling], np.log(formation[falling]), 1)[0]) if falling.sum() > 10 else float("nan")
    fig, axes = panels(1, 1, 7.2, 3.2)
    ax = axes[0, 0]
    ax.semilogy(t, formation, color=BLUE, label="formation error (m)")
    ax.semilogy(t, velocity, color=ORANGE, label="velocity error (m/s)")
    ax.semilogy(t, np.hypot(formation, velocity), color=GREY, lw=0.9, label="total")
    if np.isfinite(rate):
        ax.semilogy(
            t[falling], formation[0] * np.exp(-rate * t[falling]), "--", color=GREEN, label=f"e^(-{rate:.2f} t)"
        )
    ax.set(xlabel="time (s)", ylabel="RMS per axis", title=title, ylim=(1e-4, 2))
    ax.legend(ncols=4, loc="upper right")
    return fig, rate


def first_run(setup: Setup, seed: int) -> Run:
    """The run that the figures show."""
    return run(replace(setup, keep_every=1), seed)
