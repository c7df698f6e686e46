"""The figures of a report, each as SVG to stand in a page. One colour a vehicle, the same in all."""

import re
from collections.abc import Callable, Iterator
from io import StringIO
from typing import Any

import numpy as np

from companion.config import FleetConfig
from sim.report.series import Floats, Series
from sim.study.figures import CYCLE, GREY, INK, RED, panels, pyplot

POINTS_MOST = 500
"""of a line in a figure: more are thinner than a pixel"""
LEGEND_MOST = 12
"""vehicles that a legend names; more are told apart by their numbers at the paths' ends"""
LATENESS_BINS = 200


def drawings(series: Series, config: FleetConfig) -> Iterator[tuple[str, str, str]]:
    """Each figure's title, what it shows, and its SVG; none where nobody flew."""
    if not series.ids:
        return
    figures: list[tuple[str, str, Callable[[], Any]]] = [
        (
            "Paths from above", "Circles: where each was at take-off. Crosses: the wanted places at the end.",
            lambda: _above(series, config),
        ),
        ("Paths in three dimensions", "Up is up.", lambda: _solid(series)),
        (
            "Errors", "About the centroid: the formation's shape. The centroid against the plan: its place.",
            lambda: _errors(series),
        ),
        (
            "Distances", "The pairs that came closest, and the smallest distance of all pairs.",
            lambda: _distances(series, config),
        ),
        (
            "Who spoke when",
            "Black: since the longest silence was over. Coloured: before that, for a phase or a motion that was new, "
            "by the trigger, or near another.",
            lambda: _raster(series),
        ),
        ("Time between a vehicle's messages", "All vehicles together.", lambda: _intervals(series, config)),
        (
            "Connectivity", "lambda_2 of the graph of those that heed each other; 0 is a fleet that has fallen apart.",
            lambda: _connectivity(series),
        ),
        ("Lateness of the control loop", "The latest tick of each moment, of any vehicle.", lambda: _lateness(series)),
    ]  # fmt: skip
    for title, says, draw in figures:
        figure = draw()
        if figure is not None:
            yield title, says, _svg(figure)


def _svg(figure: Any) -> str:
    text = StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    pyplot().close(figure)
    # In a page of several figures their ids must not meet, and an XML head has no place.
    content = text.getvalue()[text.getvalue().index("<svg") :]
    content = re.sub(r"<metadata>.*?</metadata>", "", content, flags=re.DOTALL)
    return re.sub(r"\d+\.\d{4,}", lambda number: f"{float(number[0]):.2f}", content)


def _thin(count: int) -> slice:
    return slice(None, None, max(count // POINTS_MOST, 1))


def _known(path: Floats) -> Floats:
    return path[np.isfinite(path).all(axis=1)]


def _colour(k: int) -> str:
    return CYCLE[k % len(CYCLE)]


def _named(ax: Any, count: int) -> None:
    if count <= LEGEND_MOST:
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def _above(series: Series, config: FleetConfig) -> Any:
    figure, axes = panels(1, 1, 7.2, 5.2)
    ax, thin = axes[0, 0], _thin(len(series.times_s))
    for k, i in enumerate(series.ids):
        path = _known(series.position_m[thin, k])
        ax.plot(path[:, 1], path[:, 0], color=_colour(k), lw=1.0, label=f"vehicle {i}")
        if len(path):
            ax.plot(path[0, 1], path[0, 0], "o", color=_colour(k), mfc="white", ms=5)
            ax.annotate(str(i), path[-1, 1::-1], textcoords="offset points", xytext=(4, 4), color=_colour(k))
            ax.plot(*series.slots_m[-1, k, 1::-1], "+", color=INK, ms=7)
    fence = config.fence
    if fence is not None and fence.polygon_m is not None:
        north, east = np.array([*fence.polygon_m, fence.polygon_m[0]]).T
        ax.plot(east, north, color=RED, lw=1.0, ls="--", label="fence")
    ax.set(xlabel="east (m)", ylabel="north (m)")
    ax.set_aspect("equal", adjustable="datalim")
    _named(ax, len(series.ids))
    return figure


def _solid(series: Series) -> Any:
    figure = pyplot().figure(figsize=(7.2, 4.6))
    ax = figure.add_subplot(projection="3d", computed_zorder=False)
    thin = _thin(2 * len(series.times_s))
    for k, i in enumerate(series.ids):
        path = _known(series.position_m[thin, k])
        ax.plot(path[:, 1], path[:, 0], -path[:, 2], color=_colour(k), lw=0.9, label=f"vehicle {i}")
    ax.set(xlabel="east (m)", ylabel="north (m)", zlabel="up (m)")
    ax.set_box_aspect((2.0, 2.0, 1.0))
    return figure


def _errors(series: Series) -> Any:
    figure, axes = panels(2, 1, 7.2, 4.6, sharex=True)
    thin = _thin(len(series.times_s))
    about, own = axes[0, 0], axes[1, 0]
    about.plot(series.times_s[thin], series.formation_error_m[thin], color=_colour(0), label="about the centroid, RMS")
    about.plot(series.times_s[thin], series.centroid_error_m[thin], color=_colour(1), label="centroid against the plan")
    about.set(ylabel="error (m)", yscale="log")
    about.legend(loc="upper right")
    away = np.linalg.norm(series.position_m - series.slots_m, axis=2)
    for k, i in enumerate(series.ids):
        own.plot(series.times_s[thin], away[thin, k], color=_colour(k), lw=0.8, label=f"{i}")
    own.set(xlabel="time since take-off (s)", ylabel="each from its place (m)", yscale="log")
    return figure


def _distances(series: Series, config: FleetConfig) -> Any:
    if not series.closest:
        return None
    figure, axes = panels(1, 1, 7.2, 3.2)
    ax, thin = axes[0, 0], _thin(len(series.times_s))
    ax.plot(series.times_s[thin], series.nearest_m[thin], color=GREY, lw=2.2, label="nearest of all")
    for k, pair in enumerate(series.closest):
        ax.plot(
            series.times_s[thin], pair.distance_m[thin], color=_colour(k), lw=0.9,
            label=f"{pair.ids[0]} and {pair.ids[1]}: {pair.least_m:.2f} m at least",
        )  # fmt: skip
    if config.limits.barrier:
        ax.axhline(config.safety_radius_m, color=RED, lw=1.0, ls="--", label="safety radius")
    ax.set(xlabel="time since take-off (s)", ylabel="distance (m)")
    known = series.nearest_m[np.isfinite(series.nearest_m)]
    ax.set_ylim(0.0, 2.5 * float(np.median(known)) if len(known) else None)
    ax.legend(loc="upper right")
    return figure


def _raster(series: Series) -> Any:
    figure, axes = panels(1, 1, 7.2, 0.9 + 0.16 * len(series.ids))
    ax = axes[0, 0]
    for k, i in enumerate(series.ids):
        times, silent = series.messages_s[i], series.after_silence[i]
        for rows, colour in ((times[silent], INK), (times[~silent], _colour(k))):
            ax.plot(rows, np.full(len(rows), k), "|", color=colour, ms=7)
    ax.set(xlabel="time since take-off (s)", ylabel="vehicle")
    ax.set_yticks(range(len(series.ids)), [str(i) for i in series.ids])
    ax.set_ylim(len(series.ids) - 0.5, -0.5)
    return figure


def _intervals(series: Series, config: FleetConfig) -> Any:
    gaps = [np.diff(t) for t in series.messages_s.values() if len(t) > 1]
    between = np.concatenate(gaps) if gaps else np.zeros(0)
    if not len(between):
        return None
    figure, axes = panels(1, 1, 7.2, 2.6)
    ax = axes[0, 0]
    least, most = config.trigger.t_min_s, config.trigger.t_max_s
    ax.hist(np.clip(between, 0.5 * least, None), bins=np.geomspace(0.5 * least, 1.3 * most, 40), color=_colour(0))
    ax.axvline(most, color=RED, lw=1.0, ls="--", label=f"longest silence, {most:g} s")
    ax.set(xlabel="time between two messages of a vehicle (s)", ylabel="how often", xscale="log")
    ax.legend(loc="upper left")
    return figure


def _connectivity(series: Series) -> Any:
    if len(series.ids) < 2 or not len(series.lambda2):
        return None
    figure, axes = panels(1, 1, 7.2, 2.2)
    axes[0, 0].plot(series.lambda2_s, series.lambda2, color=_colour(2))
    axes[0, 0].set(xlabel="time since take-off (s)", ylabel="lambda_2")
    axes[0, 0].set_ylim(bottom=0.0)
    return figure


def _lateness(series: Series) -> Any:
    if not series.lateness:
        return None
    figure, axes = panels(1, 1, 7.2, 2.2)
    times = np.concatenate([t for t, _ in series.lateness.values()])
    late = np.concatenate([x for _, x in series.lateness.values()])
    edges = np.linspace(times.min(), times.max(), LATENESS_BINS + 1)
    most = np.zeros(LATENESS_BINS)
    np.maximum.at(most, np.clip(np.searchsorted(edges, times, side="right") - 1, 0, LATENESS_BINS - 1), late)
    axes[0, 0].step(edges[:-1], most, where="post", color=_colour(0))
    axes[0, 0].set(xlabel="time since take-off (s)", ylabel="latest tick (ms)")
    axes[0, 0].set_ylim(bottom=0.0)
    return figure
