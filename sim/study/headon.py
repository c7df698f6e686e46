"""Head-on by a broken law: what distance the safety filter keeps over lag, delay and loss, and where safety ends.

The vehicles are the real thing: two agents with their event-triggered messages, on stub autopilots in lockstep. Only
the law is replaced, by one that flies at the other vehicle.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from math import dist
from random import Random
from typing import Literal

import numpy as np

from companion.config import FleetConfig
from companion.config.file import parse
from companion.core.frames import Ned
from companion.core.safety.filter import COLLISION_DISTANCE_M as COLLISION_M
from sim.lockstep.lockstep import Lockstep
from sim.lockstep.network import NetworkParameters
from sim.study.broken_law import BrokenLaw
from sim.study.common import FLYING_CODE, Column, Config, Figure, Outcome, Record, Table, proportion_text, table_of
from sim.study.figures import FAMILY, INK, panels, quartiles
from sim.study.never_near import NeverNear

TITLE = "Head-on by a broken law: lag, delay and loss"
SOURCES = FLYING_CODE
MEETING_S = 16.0
SCATTER_M = 0.05
"""how far the two pads' lines lie apart at most"""


Near = Literal["10 Hz", "20 Hz", "off"]
"""near mode as it is flown, at twice its rate, and without it"""


@dataclass(frozen=True, slots=True)
class Meeting:
    """What is the same in every meeting."""

    speed_m_s: float
    apart_m: float
    altitude_m: float
    lags_s: tuple[float, ...]
    delays_s: tuple[float, ...]
    losses: tuple[float, ...]
    noise_m: float
    gust_m_s2: float


def meeting_of(config: Config) -> Meeting:
    """The set-up's meeting; a missing or unknown key is refused."""
    return table_of(config, "meeting", Meeting)


def _fleet(meeting: Meeting, lag_s: float, barrier: bool, near: Near, aside_m: float) -> FleetConfig:
    half = 0.5 * meeting.apart_m
    return parse(
        {
            "fleet": {"name": "headon", "frame": "local"},
            "formation": {"altitude_m": meeting.altitude_m},
            "plan": {"automatic": False},
            "trigger": {"near_period_s": 0.05 if near == "20 Hz" else 0.1},
            "limits": {
                "barrier": barrier, "position_noise_m": meeting.noise_m, "velocity_noise_m_s": meeting.noise_m,
                "gust_m_s2": meeting.gust_m_s2,
            },
            "stub": {
                "lag_s": lag_s, "position_noise_m": meeting.noise_m, "velocity_noise_m_s": meeting.noise_m,
                "gust_m_s2": meeting.gust_m_s2, "origin_scatter_m": 0.0,
            },
            "vehicle": [{"id": 1, "pad_m": [-half, 0.0]}, {"id": 2, "pad_m": [half, aside_m]}],
        },
        "headon.toml",
    )  # fmt: skip


def meet(
    meeting: Meeting, seed: int, *, lag_s: float, delay_s: float, loss: float, barrier: bool = True,
    near: Near = "10 Hz",
) -> Record:  # fmt: skip
    """Fly one meeting; the smallest true distance of the two (m), and what it took."""
    config = _fleet(meeting, lag_s, barrier, near, Random(f"headon/{seed}").uniform(-SCATTER_M, SCATTER_M))
    fleet = Lockstep(config, seed=seed, network=NetworkParameters(delay_s=delay_s, loss=loss))
    laws = {}
    for i, v in fleet.vehicles.items():
        if near == "off":
            v.agent.publisher.near = NeverNear(v.agent.publisher.near.rate)
        v.agent.law = laws[i] = BrokenLaw(v.agent.law)
    fleet.take_off()
    start_ns, sent = fleet.now_ns, len(fleet.sent)
    for i, way in ((1, 1.0), (2, -1.0)):
        laws[i].velocity_ned_m_s = Ned(way * meeting.speed_m_s, 0.0, 0.0)

    def passed() -> bool:
        p = fleet.positions()
        return p[1].north > p[2].north and dist(p[1], p[2]) > 0.25 * meeting.apart_m

    fleet.run_until(start_ns * 1e-9 + MEETING_S, passed)
    rows = fleet.truth().reshape(-1, 2)
    met = rows["position_ned_m"][rows["time_unix_ns"][:, 0] >= fleet.now.fleet_ns - (fleet.now_ns - start_ns)]
    return {
        "minimum_distance_m": float(np.linalg.norm(met[:, 0] - met[:, 1], axis=1).min()),
        "passed": passed(),
        "messages": len(fleet.sent) - sent,
        "bound_looks": fleet.near_bound.looks,
        "bound_exceeded": fleet.near_bound.exceeded,
        "bound_worst": fleet.near_bound.worst,
        "not_attainable": sum(v.agent.safety.counts["peer distance not attainable"] for v in fleet.vehicles.values()),
    }


def _cells(meeting: Meeting) -> list[tuple[float, float, float]]:
    return list(product(meeting.lags_s, meeting.losses, meeting.delays_s))


def piece(config: Config, seed: int) -> Record:
    """Every meeting under one seed."""
    meeting = meeting_of(config)
    return {
        "cells": [meet(meeting, seed, lag_s=g, delay_s=d, loss=x) for g, x, d in _cells(meeting)],
        "compared": [
            meet(meeting, seed, **{k: v for k, v in given.items() if k not in ("case", "must_m")})
            for given in _compared(config)
        ],
    }


def _compared(config: Config) -> list[Record]:
    """Single meetings beside the table: `case` names each, `must_m` is what it must keep, the rest are `meet`'s."""
    return list(config.values.get("compared", []))


def _row(records: Sequence[Record]) -> Record:
    distances = [r["minimum_distance_m"] for r in records]
    return {
        "median_m": float(np.median(distances)),
        "minimum_distance_m_median": float(np.median(distances)),
        "minimum_distance_m_q1": float(np.percentile(distances, 25)),
        "minimum_distance_m_q3": float(np.percentile(distances, 75)),
        "least_m": min(distances),
        "close": proportion_text(sum(d < COLLISION_M for d in distances), len(distances)),
        "bound_exceeded": f"{sum(r['bound_exceeded'] for r in records)} of {sum(r['bound_looks'] for r in records)}",
        "close_count": sum(d < COLLISION_M for d in distances),
        "passed": sum(r["passed"] for r in records) / len(records),
        "messages": float(np.mean([r["messages"] for r in records])),
    }


def finish(config: Config, pieces: Sequence[Record], seeds: Sequence[int]) -> Outcome:
    """The table, the edge of the safe region, and the distance over the delay."""
    meeting = meeting_of(config)
    outcome = Outcome()
    rows: list[Record] = []
    for k, (lag, loss, delay) in enumerate(_cells(meeting)):
        rows.append({"lag_s": lag, "loss_percent": 100 * loss, "delay_ms": 1000 * delay})
        rows[-1] |= _row([p["cells"][k] for p in pieces])
    shown = (
        Column("median_m", "minimum distance, median (m)", 2), Column("least_m", "least of all seeds (m)", 2),
        Column("close", f"seeds below {COLLISION_M} m"), Column("messages", "messages of both", 0),
        Column("bound_exceeded", "predictions beyond their bound"),
    )  # fmt: skip
    inputs = (
        Column("lag_s", "lag (s)", 2),
        Column("loss_percent", "loss (%)", 0),
        Column("delay_ms", "delay (ms)", 0),
    )
    outcome.tables.append(
        Table(
            "headon_table", f"Head-on at {meeting.speed_m_s:g} m/s each, event-triggered", (*inputs, *shown), rows,
            "Real agents on stub autopilots in lockstep, noise and gusts as in the set-up; only the law is broken.",
        )
    )  # fmt: skip
    edges = [_edge(rows, lag, loss) for lag, loss in product(meeting.lags_s, meeting.losses)]
    outcome.tables.append(
        Table(
            "headon_edge", "The edge of the safe region", (
                *inputs[:2],
                Column("safe_ms", f"longest delay with every seed above {COLLISION_M} m (ms)", 0),
            ),
            edges, f"Of {', '.join(f'{1000 * d:g}' for d in meeting.delays_s)} ms; – where not even the shortest is.",
        )
    )  # fmt: skip
    compared: list[Record] = []
    for k, given in enumerate(_compared(config)):
        compared.append({"case": given["case"], **_row([p["compared"][k] for p in pieces])})
        if compared[-1]["least_m"] < given["must_m"]:
            outcome.broken = (
                f"{given['case']}: two came to {compared[-1]['least_m']:.2f} m, must be {given['must_m']:g} m"
            )
    columns = (Column("case", "case"), *shown)
    outcome.tables.append(Table("headon_compared", "With and without what keeps the distance", columns, compared))
    outcome.values |= {"rows": rows, "edges": edges, "compared": compared}
    outcome.findings.append(_finding(rows, len(seeds)))
    outcome.figures.append(_figure(meeting, rows))
    return outcome


def _edge(rows: Sequence[Record], lag: float, loss: float) -> Record:
    """The longest delay up to which all shorter ones keep every seed above a collision's distance."""
    mine = sorted(
        (r for r in rows if r["lag_s"] == lag and r["loss_percent"] == 100 * loss), key=lambda r: r["delay_ms"]
    )

    def longest(distance_m: float) -> float | None:
        held: float | None = None
        for r in mine:
            if r["least_m"] < distance_m:
                break
            held = r["delay_ms"]
        return held

    return {"lag_s": lag, "loss_percent": 100 * loss, "safe_ms": longest(COLLISION_M)}


def _finding(rows: Sequence[Record], seeds: int) -> str:
    close = sum(r["close_count"] for r in rows)
    worst = min(rows, key=lambda r: r["least_m"])
    return (
        f"{close} of {len(rows) * seeds} meetings come below {COLLISION_M} m; the least distance is "
        f"{worst['least_m']:.2f} m, at {worst['lag_s']:g} s of lag, {worst['delay_ms']:g} ms and "
        f"{worst['loss_percent']:g} % loss."
    )


def _figure(meeting: Meeting, rows: Sequence[Record]) -> Figure:
    fig, axes = panels(1, len(meeting.lags_s), 7.4, 3.4, sharey=True)
    for ax, lag in zip(axes[0], meeting.lags_s, strict=True):
        for k, loss in enumerate(meeting.losses):
            mine = [r for r in rows if r["lag_s"] == lag and r["loss_percent"] == 100 * loss]
            colour, marker = FAMILY[k]
            # side by side, so that no bar hides another
            x = np.array([r["delay_ms"] for r in mine]) + 8.0 * (k - 0.5 * (len(meeting.losses) - 1))
            middle, bars = quartiles(mine, "minimum_distance_m")
            ax.errorbar(x, middle, bars, fmt=marker + "-", ms=4, lw=1, capsize=1.5, color=colour,
                        label=f"{100 * loss:g} % loss")  # fmt: skip
            ax.plot(x, [r["least_m"] for r in mine], ":", marker=marker, ms=3, mfc="none", lw=1, color=colour,
                    label=f"{100 * loss:g} % loss, worst seed")  # fmt: skip
        ax.axhline(COLLISION_M, color=INK, ls="--", lw=1, label=f"{COLLISION_M} m: collision")
        ax.set(xlabel="delay (ms)", title=f"lag {lag:g} s", ylim=(0, None))
    axes[0, 0].set_ylabel("least distance (m)")
    fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return Figure(
        "headon", "Least distance of two vehicles sent at each other: median, interquartile range and worst seed.", fig
    )
