"""Drawing: one style for every figure, matplotlib loaded only when a figure is wanted."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from companion.errors import ConfigError

Floats = npt.NDArray[np.float64]

# Okabe and Ito, "Color Universal Design": told apart with every kind of colour vision, and apart in grey too with the
# markers beside them. Their yellow is left out, since it cannot be seen on white.
BLUE, ORANGE, GREEN, RED, PURPLE, SKY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9"
INK, GREY = "#000000", "#7F7F7F"
CYCLE = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY, INK, GREY)
MARKERS = "osD^vPX*<>dhp"
FAMILY = tuple((CYCLE[k % len(CYCLE)], MARKERS[k % len(MARKERS)]) for k in range(len(CYCLE) * len(MARKERS)))
"""colour and marker of one series after the other: no two are alike"""

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
    "svg.fonttype": "none",
    "figure.constrained_layout.use": True,
}


def pyplot() -> Any:
    """matplotlib without a screen, in our style; a sentence if it is not installed."""
    try:
        import matplotlib as mpl
    except ModuleNotFoundError as missing:
        raise ConfigError(
            f"figures need {missing.name}, which is not installed: pip install 'starling-fleet[sim]'"
        ) from missing
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    mpl.rcParams.update(_STYLE)
    mpl.rcParams["axes.prop_cycle"] = plt.cycler(color=CYCLE)
    return plt


def panels(rows: int, columns: int, width: float = 7.2, height: float = 3.2, **options: Any) -> tuple[Any, Any]:
    """A figure and its axes, always as a 2-D array."""
    return tuple(pyplot().subplots(rows, columns, figsize=(width, height), squeeze=False, **options))


def spread(
    ax: Any, rows: Sequence[Mapping[str, Any]], key: str, y: Floats, label: str, look: tuple[str, str]
) -> None:  # fmt: skip
    """Median and interquartile range over seeds of each row at its height y; a row that has none is left out."""
    shown = [k for k, row in enumerate(rows) if row[key] is not None]
    middle, low, high = (np.array([rows[k][name] for k in shown]) for name in (key, f"{key}_q1", f"{key}_q3"))
    ax.errorbar(
        middle, y[shown], xerr=[middle - low, high - middle], fmt=look[1], color=look[0], ms=4, lw=1, capsize=1.5,
        label=label,
    )  # fmt: skip


def quartiles(rows: Sequence[Mapping[str, Any]], key: str) -> tuple[Floats, Floats]:
    """Medians of the rows, shape (n,), and their bars to the quartiles, shape (2, n), for `errorbar`."""
    middle, low, high = (np.array([r[f"{key}_{name}"] for r in rows], dtype=float) for name in ("median", "q1", "q3"))
    return middle, np.stack([middle - low, high - middle])


def trajectories_3d(position_m: Floats, slots: Floats, title: str) -> Any:
    """3-D paths, shape (T, N, 3), with start, end and the final desired places; up is up."""
    plt = pyplot()
    fig = plt.figure(figsize=(7.2, 4.2))
    ax = fig.add_subplot(projection="3d", computed_zorder=False)
    for i in range(position_m.shape[1]):
        p = position_m[:, i]
        ax.plot(p[:, 0], p[:, 1], -p[:, 2], color=SKY, lw=0.9, label="path" if i == 0 else None)
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
        label: str | None = f"within {range_m:g} m"
        for i, j in zip(*np.nonzero(np.triu(near, 1)), strict=True):
            ax.plot(p[[i, j], 1], p[[i, j], 0], color="#bbbbbb", lw=0.7, zorder=1, label=label)
            label = None
        ax.scatter(d[:, 1], d[:, 0], marker="+", s=45, color=RED, lw=1.0, zorder=2, label="desired")
        ax.scatter(p[:, 1], p[:, 0], s=22, color=BLUE, zorder=3, label="actual")
        for i in range(len(p)):
            ax.annotate(str(i + 1), (p[i, 1], p[i, 0]), xytext=(4, 3), textcoords="offset points", fontsize=6.5)
        ax.set(title=f"t = {t:g} s, {note}", xlabel="east (m)", ylabel="north (m)")
        ax.set_aspect("equal", adjustable="datalim")
    fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return fig
