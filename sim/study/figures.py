"""Drawing: one style for every figure, matplotlib loaded only when a figure is wanted."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from companion.errors import ConfigError

Floats = npt.NDArray[np.float64]

BLUE, ORANGE, GREEN, RED, GREY, PURPLE = "#1f5fa8", "#d97b1c", "#2f8f5b", "#b8332f", "#7a7a7a", "#6b4fa0"
CYCLE = (BLUE, ORANGE, GREEN, RED, PURPLE, GREY, "#2aa1b3", "#a8327e", "#8c6d1f", "#444444")

_STYLE = {
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.labelsize": 9.0,
    "legend.fontsize": 8.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.2,
    "legend.frameon": False,
    "svg.hashsalt": "starling-fleet",
    "figure.constrained_layout.use": True,
}


def pyplot() -> Any:
    """matplotlib without a screen, in our style; a sentence if it is not installed."""
    try:
        import matplotlib as mpl
    except ModuleNotFoundError as missing:
        raise ConfigError(
            f"figures need {missing.name}, which is not installed: pip install 'starling-fleet[study]'"
        ) from missing
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    mpl.rcParams.update(_STYLE)
    mpl.rcParams["axes.prop_cycle"] = plt.cycler(color=CYCLE)
    return plt


def panels(rows: int, columns: int, width: float = 7.2, height: float = 3.2, **options: Any) -> tuple[Any, Any]:
    """A figure and its axes, always as a 2-D array."""
    return tuple(pyplot().subplots(rows, columns, figsize=(width, height), squeeze=False, **options))


def trajectories_3d(position_m: Floats, slots: Floats, title: str) -> Any:
    """3-D paths, shape (T, N, 3), with start, end and the final desired places; up is up."""
    plt = pyplot()
    fig = plt.figure(figsize=(7.2, 4.2))
    ax = fig.add_subplot(projection="3d", computed_zorder=False)
    for i in range(position_m.shape[1]):
        p = position_m[:, i]
        ax.plot(p[:, 0], p[:, 1], -p[:, 2], color=CYCLE[i % len(CYCLE)], lw=0.9)
    ax.scatter(*_up(position_m[0]), s=10, facecolor="white", edgecolor="black", label="start", depthshade=False)
    ax.scatter(*_up(position_m[-1]), s=14, color="black", label="end", depthshade=False)
    ax.scatter(*_up(slots), s=40, marker="+", color=RED, label="desired", depthshade=False)
    ax.set(xlabel="north (m)", ylabel="east (m)", zlabel="up (m)", title=title)
    ax.set_box_aspect((2.4, 1.2, 0.8))
    ax.view_init(22, -65)
    ax.legend(loc="upper left")
    return fig


def _up(p: Floats) -> tuple[Floats, Floats, Floats]:
    return p[:, 0], p[:, 1], -p[:, 2]


def snapshots(
    times: Sequence[float], positions: Sequence[Floats], slots: Sequence[Floats], range_m: float, notes: Sequence[str]
) -> Any:
    """Plan views at four moments: agents, neighbour graph within range, desired places."""
    fig, axes = panels(2, 2, 7.2, 6.0)
    for ax, t, p, d, note in zip(axes.flat, times, positions, slots, notes, strict=True):
        near = np.linalg.norm(p[:, None] - p[None, :], axis=2) <= range_m
        for i, j in zip(*np.nonzero(np.triu(near, 1)), strict=True):
            ax.plot(p[[i, j], 1], p[[i, j], 0], color="#bbbbbb", lw=0.7, zorder=1)
        ax.scatter(d[:, 1], d[:, 0], marker="+", s=45, color=RED, lw=1.0, zorder=2, label="desired")
        ax.scatter(p[:, 1], p[:, 0], s=22, color=BLUE, zorder=3, label="actual")
        for i in range(len(p)):
            ax.annotate(str(i + 1), (p[i, 1], p[i, 0]), xytext=(4, 3), textcoords="offset points", fontsize=6.5)
        ax.set(title=f"t = {t:g} s, {note}", xlabel="east (m)", ylabel="north (m)")
        ax.set_aspect("equal", adjustable="datalim")
    axes[0, 0].legend(loc="best")
    return fig
