"""A threat in a flock of three hundred: whether it opens, holds together and re-forms, and how fast a wave goes on from
those that see the threat to those that do not.

The wave: an agent that never sees the threat is reached when its nu is off by the threshold from what it was before.
Its delay is counted from the first flight of the nearest agent that has fled by then, its distance between the two
slots, and the speed is the inverse of the Theil-Sen slope of delay on distance. The exponent is the slope of their
logarithms: a wave that goes on at one speed has 1, what spreads by diffusion 2.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.stats import theilslopes

from companion.core.law.evasion import FLEES, Threat
from companion.core.safety.filter import COLLISION_DISTANCE_M as COLLISION_M
from sim.study.common import Column, Config, Figure, Floats, Outcome, Record, Table, fewer_percent, table_of
from sim.study.figures import BLUE, FAMILY, GREY, RED, panels
from sim.swarm.options import linked_pairs
from sim.swarm.swarm import Run, run

TITLE = "Evasion"
FLOWN = "flown trigger"
STARLINGS_M_S = (20.0, 40.0)
"""how fast the decision to turn goes through a flock of starlings (Attanasi et al., Nature Physics 10, 2014)"""
SHAPED = 0.95
"""the flock has its shape again when so many are within the limit of it"""
AFTER_S = 30.0
SHOWN_S = (-0.2, 4.0, 8.0, 38.0)
"""of the first scenario's snapshots, from the threat's begin"""


@dataclass(frozen=True, slots=True)
class Judged:
    """What the figures are made with, and what must hold."""

    must_m: float
    connected_within_s: float
    held_m: float
    within_m: float
    threshold_m_s: float


def piece(config: Config, seed: int) -> Record:
    """Every way to speak in every scenario under one seed."""
    judged = table_of(config, "judged", Judged)
    return {
        case: {name: figures_of(run(scheme, seed), judged) for name, scheme in config.on(setup, "schemes").items()}
        for case, setup in config.cases().items()
    }


def figures_of(flight: Run, judged: Judged) -> Record:
    """What is kept of one run; times from the threat's begin."""
    setup, t = flight.setup, flight.time_s - flight.setup.threat[0]
    flees = flight.common[:, :, 3] == FLEES
    fled = flees.any(axis=0)
    last_s = float(t[flees.any(axis=1)][-1]) if fled.any() else 0.0
    error = flight.formation_error_m()
    shaped = (error <= judged.within_m).mean(axis=1)
    local = (local_error_m(flight) <= judged.within_m).mean(axis=1)
    parts = parts_of(flight, judged.held_m)
    after = int(np.searchsorted(t, last_s + AFTER_S))
    off = (flight.common[-1, :, :2] - flight.common[np.searchsorted(t, 0.0) - 1, :, :2]).mean(axis=0)
    return {
        "messages": flight.messages,
        "fewer_percent": fewer_percent(flight.messages, setup),
        "least_m": flight.measures["minimum_distance_m"],
        "threat_least_m": threat_least_m(flight),
        "fled": int(fled.sum()),
        "last_s": last_s,
        "parts": int(parts.max()),
        "connected_s": _until(t, parts > 1, last_s),
        "lambda2": lambda2(flight, judged.held_m, min(after, len(t) - 1)),
        "shaped_s": _until(t, shaped < SHAPED, last_s),
        "shaped_after": float(shaped[after]) if after < len(t) else None,
        "local_s": _until(t, local < SHAPED, last_s),
        "error_max_m": float(error.max()),
        "drift_m_s": float(np.hypot(*off)),
        **wave(flight, fled, judged.threshold_m_s),
        "time_s": np.round(t, 3).tolist(),
        "shaped": np.round(shaped, 4).tolist(),
        "local": np.round(local, 4).tolist(),
        "shown": [
            [np.round(flight.position_m[k, :, :2], 2).tolist(), flees[k].astype(int).tolist()]
            for k in (min(int(np.searchsorted(t, s)), len(t) - 1) for s in SHOWN_S)
        ],
    }


def _until(t: Floats, bad: Any, from_s: float) -> float | None:
    """How long after `from_s` something was so for the last time; None: to the end."""
    last = np.flatnonzero(bad)
    if not last.size:
        return 0.0
    return None if last[-1] == len(t) - 1 else max(float(t[last[-1] + 1]) - from_s, 0.0)


def held_pairs(flight: Run) -> Any:
    """Who heed each other, each pair once: two rows of agents."""
    n = flight.setup.formation.count
    linked = np.zeros((n, n), dtype=bool)
    linked[~np.eye(n, dtype=bool)] = linked_pairs(flight.setup) if flight.setup.nearest else 1
    return np.argwhere(np.triu(linked)).T


def parts_of(flight: Run, held_m: float) -> Any:
    """Into how many parts those that heed each other have fallen at each moment, shape (T,)."""
    a, b = held_pairs(flight)
    n = flight.setup.formation.count
    found = []
    for x in flight.position_m:
        near = np.linalg.norm(x[a] - x[b], axis=1) <= held_m
        graph = coo_array((np.ones(near.sum()), (a[near], b[near])), shape=(n, n))
        found.append(connected_components(graph, directed=False)[0])
    return np.array(found)


def local_error_m(flight: Run) -> Floats:
    """How far each is from where those that it heeds put it, on average, shape (T, N)."""
    a, b = held_pairs(flight)
    n, pairs = flight.setup.formation.count, np.arange(len(a))
    signs = coo_array((np.repeat([1.0, -1.0], len(a)), (np.r_[a, b], np.r_[pairs, pairs])), shape=(n, len(a))).tocsr()
    heeded = np.bincount(np.r_[a, b], minlength=n)[:, None]
    off = flight.position_m - flight.setup.formation.slots()
    return np.array([np.linalg.norm((signs @ (x[a] - x[b])) / heeded, axis=1) for x in off])


def lambda2(flight: Run, held_m: float, k: int) -> float:
    """The second smallest eigenvalue of that graph's Laplacian at one moment."""
    a, b = held_pairs(flight)
    n = flight.setup.formation.count
    x = flight.position_m[k]
    near = np.linalg.norm(x[a] - x[b], axis=1) <= held_m
    joined = np.zeros((n, n))
    joined[a[near], b[near]] = joined[b[near], a[near]] = 1.0
    return float(np.linalg.eigvalsh(np.diag(joined.sum(axis=1)) - joined)[1])


def threat_least_m(flight: Run) -> float:
    """The least distance of the threat itself to anybody while it is there (m)."""
    begins_s, north, east, v_north, v_east, _, lasts_s = flight.setup.threat
    since = flight.time_s - begins_s
    there = (since >= 0.0) & (since <= lasts_s)
    place = np.array([north, east]) + since[there, None] * np.array([v_north, v_east])
    return float(np.linalg.norm(flight.position_m[there, :, :2] - place[:, None], axis=2).min())


def wave(flight: Run, fled: Any, threshold_m_s: float) -> Record:
    """Who of those that saw nothing is reached when and how far off, and the speed with its 95 % interval."""
    t, nu = flight.time_s, flight.common[:, :, :2]
    begin = int(np.searchsorted(t, flight.setup.threat[0]))
    changed = np.linalg.norm(nu - nu[begin - 1], axis=2) >= threshold_m_s
    changed[:begin] = False
    slots = flight.setup.formation.slots()
    begun = np.argmax(flight.common[:, :, 3] == FLEES, axis=0)
    fleeing = np.flatnonzero(fled)
    delays, distances = [], []
    for i in np.flatnonzero(~fled & changed.any(axis=0)):
        reached = int(np.argmax(changed[:, i]))
        by_then = fleeing[begun[fleeing] <= reached]
        if not by_then.size:
            continue
        apart = np.linalg.norm(slots[by_then] - slots[i], axis=1)
        nearest = by_then[np.isclose(apart, apart.min())]
        delays.append(float(t[reached] - t[begun[nearest].min()]))
        distances.append(float(apart.min()))
    unseen = int((~fled).sum())
    found: Record = {
        "delay_s": np.round(delays, 3).tolist(), "distance_m": np.round(distances, 2).tolist(),
        "reached": len(delays) / max(unseen, 1), "reach_m": max(distances, default=0.0),
        "wave_m_s": None, "wave_low_m_s": None, "wave_high_m_s": None, "start_s": None, "exponent": None,
    }  # fmt: skip
    if len(delays) > 10 and np.ptp(distances) > 0.0:
        fit = theilslopes(delays, distances)
        later = np.array(delays) > 0.0
        if fit.slope > 0.0 and np.ptp(np.array(distances)[later]) > 0.0:
            found["exponent"] = float(theilslopes(np.log(np.array(delays)[later]), np.log(distances)[later]).slope)
        if fit.slope > 0.0:
            found["wave_m_s"], found["start_s"] = float(1.0 / fit.slope), float(fit.intercept)
            found["wave_low_m_s"] = float(1.0 / fit.high_slope)
            found["wave_high_m_s"] = float(1.0 / fit.low_slope) if fit.low_slope > 0.0 else None
    return found


# -- what was found ----------------------------------------------------------------------------------------------------


def finish(config: Config, pieces: Sequence[Record], seeds: Sequence[int]) -> Outcome:
    """Whether it holds together, how fast the wave is, and how it looks."""
    judged = table_of(config, "judged", Judged)
    outcome = Outcome()
    rows = [_row(case, name, [p[case][name] for p in pieces]) for case in pieces[0] for name in pieces[0][case]]
    outcome.values["rows"] = rows
    outcome.tables.append(_table(rows, judged))
    for row in rows:
        if row["scheme"] != FLOWN:
            continue
        apart = row["connected_worst_s"]
        outcome.findings.append(
            f"{row['case']}: least distance {row['least_of_all_m']:.2f} m, in up to {row['parts']} parts, connected "
            f"{'not again' if apart is None else f'{apart:.1f} s'} after the last flight; wave "
            + ("none" if row["wave_m_s"] is None else f"{row['wave_m_s']:.1f} m/s ({row['wave_spread']})")
            + f", starlings {STARLINGS_M_S[0]:g} to {STARLINGS_M_S[1]:g} m/s."
        )
        if row["least_of_all_m"] < judged.must_m:
            outcome.broken = f"{row['case']}: {row['below']} seeds below {judged.must_m:g} m"
        elif apart is None or apart > judged.connected_within_s:
            outcome.broken = f"{row['case']}: not connected again within {judged.connected_within_s:g} s"
    outcome.figures += _figures(config, pieces[0], seeds[0], judged)
    return outcome


def _row(case: str, name: str, records: Sequence[Record]) -> Record:
    row: Record = {"case": case, "scheme": name, "seeds": len(records)}
    for key in ("messages", "fewer_percent", "fled", "least_m", "threat_least_m", "lambda2", "reached", "reach_m",
                "error_max_m", "drift_m_s"):  # fmt: skip
        row[key] = float(np.median([r[key] for r in records]))
    row["least_of_all_m"] = min(r["least_m"] for r in records)
    row["below"] = sum(r["least_m"] < COLLISION_M for r in records)
    row["parts"] = max(r["parts"] for r in records)
    for key in ("connected", "shaped", "local"):
        times = [r[f"{key}_s"] for r in records]
        row[f"{key}_worst_s"] = None if None in times else max(times)
    after = [r["shaped_after"] for r in records if r["shaped_after"] is not None]
    row["shaped_after"] = 100.0 * float(np.median(after)) if after else None
    speeds = [r["wave_m_s"] for r in records if r["wave_m_s"] is not None]
    row["wave_m_s"] = float(np.median(speeds)) if speeds else None
    row["start_s"] = float(np.median([r["start_s"] for r in records if r["wave_m_s"] is not None])) if speeds else None
    low = [r["wave_low_m_s"] for r in records if r["wave_low_m_s"] is not None]
    high = [r["wave_high_m_s"] for r in records if r["wave_high_m_s"] is not None]
    exponents = [r["exponent"] for r in records if r["exponent"] is not None]
    row["exponent"] = float(np.median(exponents)) if exponents else None
    row["wave_spread"] = f"{min(low):.1f}–{max(high):.1f}" if low and high else ""
    return row


def _table(rows: list[Record], judged: Judged) -> Table:
    return Table(
        "evasion", "A threat in the flock",
        (Column("case", "scenario"), Column("scheme", "messages are sent"), Column("seeds", "seeds"),
         Column("messages", "messages", 0), Column("fewer_percent", "fewer than 20 Hz (%)", 2),
         Column("fled", "fled", 0), Column("least_of_all_m", "least distance of all seeds (m)", 2),
         Column("below", f"seeds below {COLLISION_M} m"), Column("threat_least_m", "of the threat (m)", 2),
         Column("parts", "parts at most"), Column("connected_worst_s", "connected again, worst (s)", 1),
         Column("lambda2", f"λ2 {AFTER_S:g} s later", 4),
         Column("local_worst_s", "95 % in their neighbours' place, worst (s)", 1),
         Column("shaped_worst_s", "of the whole shape, worst (s)", 1),
         Column("shaped_after", f"within {judged.within_m:g} m {AFTER_S:g} s later (%)", 1),
         Column("drift_m_s", "common velocity changed by (m/s)", 3),
         Column("reached", "reached of those that saw nothing", 2), Column("reach_m", "farthest (m)", 0),
         Column("wave_m_s", "wave (m/s)", 1), Column("wave_spread", "95 %, all seeds (m/s)"),
         Column("exponent", "exponent", 1)),
        rows,
        f"Times are from the last moment at which anybody flees. Parts are of the graph of those that heed each other "
        f"and are within {judged.held_m:g} m. In place is within {judged.within_m:g} m. Medians over seeds unless "
        f"named. A wave arrives with a change of nu by {judged.threshold_m_s:g} m/s; its interval spans all seeds' "
        "95 % intervals.",
    )  # fmt: skip


def _figures(config: Config, piece: Record, seed: int, judged: Judged) -> list[Figure]:
    cases = list(piece)
    fig, axes = panels(1, 2, 7.2, 4.2)
    ax = axes[0, 0]
    for (colour, marker), (name, r) in zip(FAMILY, piece[cases[0]].items(), strict=False):
        speed = "no wave" if r["wave_m_s"] is None else f"{r['wave_m_s']:.1f} m/s"
        ax.plot(r["distance_m"], r["delay_s"], marker, color=colour, ms=2.5, alpha=0.6, label=f"{name}: {speed}")
        if r["wave_m_s"] is not None:
            x = np.array([0.0, r["reach_m"]])
            ax.plot(x, r["start_s"] + x / r["wave_m_s"], color=colour, lw=1)
    far = max((r["reach_m"] for r in piece[cases[0]].values()), default=1.0)
    x = np.array([0.0, far])
    ax.fill_between(
        x, x / STARLINGS_M_S[1], x / STARLINGS_M_S[0], color=GREY, alpha=0.4, lw=0,
        label=f"starlings: {STARLINGS_M_S[0]:g}–{STARLINGS_M_S[1]:g} m/s",
    )  # fmt: skip
    ax.set(xlabel="distance from the nearest that has fled (m)", ylabel="delay (s)", title=cases[0], ylim=(0, 12))
    ax.legend(loc="upper right", fontsize=7, frameon=True, edgecolor="none")
    ax = axes[0, 1]
    for (colour, _), (name, r) in zip(FAMILY, piece[cases[0]].items(), strict=False):
        ax.plot(r["time_s"], 100.0 * np.array(r["local"]), color=colour, label=f"{name}, of its neighbours' place")
        ax.plot(r["time_s"], 100.0 * np.array(r["shaped"]), color=colour, ls="--", label=f"{name}, of the whole shape")
    ax.set(
        xlabel="time from the threat's begin (s)", ylabel=f"agents within {judged.within_m:g} m (%)", title=cases[0],
        ylim=(0, 102),
    )  # fmt: skip
    fig.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=7)
    waves = Figure(
        "evasion_wave",
        f"Left: when the wave reaches those that see no threat, with Theil-Sen lines; right: the shape (seed {seed})",
        fig,
    )
    return [waves, _snapshots(config, piece[cases[0]][FLOWN], cases[0], seed)]


def _snapshots(config: Config, r: Record, case: str, seed: int) -> Figure:
    threat = config.cases()[case].threat
    fig, axes = panels(2, 2, 7.2, 6.4)
    for ax, since_s, (places, flees) in zip(axes.flat, SHOWN_S, r["shown"], strict=True):
        p, f = np.array(places), np.array(flees, dtype=bool)
        ax.scatter(p[~f, 1], p[~f, 0], s=7, color=BLUE, lw=0, label="others")
        ax.scatter(p[f, 1], p[f, 0], s=10, color=RED, marker="^", lw=0, label="flee")
        if 0.0 <= since_s <= threat[6]:
            t = Threat(*threat[1:])
            at = (t.east_m + since_s * t.east_m_s, t.north_m + since_s * t.north_m_s)
            ax.plot(*at, marker="X", color="black", ms=8, ls="", label="threat")
        ax.set(title=f"t = {since_s:g} s", xlabel="east (m)", ylabel="north (m)")
        ax.set_aspect("equal", adjustable="datalim")
    handles, labels = axes[0, 1].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=3)
    return Figure("evasion_flock", f"The flock opens and closes ({case}, {FLOWN}, seed {seed})", fig)
