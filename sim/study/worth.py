"""What do the messages buy? Every scenario flown with the shipped trigger, and with what a message count must be held
against: heartbeats alone, nothing received at all, a period with the same number of messages, 1, 2 and 20 Hz.

Judged by what the others do not know (the worst and the 99.9 % prediction error), by distances, by the time to respond
to what happens, and by the formation error last, since with a shared plan shape needs no messages.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.stats import t as student

from companion.core.safety.filter import COLLISION_DISTANCE_M as COLLISION_M
from companion.errors import ConfigError
from sim.study.common import (
    Column,
    Config,
    Figure,
    Floats,
    Outcome,
    Record,
    Table,
    fewer_percent,
    payload_bytes,
    proportion_text,
    same_number,
)
from sim.study.figures import FAMILY, GREY, INK, panels, spread
from sim.swarm.setup import Setup
from sim.swarm.state import CAUSES
from sim.swarm.swarm import Run, motion_table, quantile_m, run

TITLE = "What the messages buy"
FLOWN, SAME, BEATS, NOTHING = "flown trigger", "periodic, same number", "heartbeats only", "nothing received"
HERTZ, RAW = "1 Hz", "20 Hz, raw"
BOUNDED = 1.0 / 3.0
"""the trigger bounds what others do not know if its worst prediction error is at most this much of the period's"""
MEAN_S = 1.0
"""over which the mean velocity is averaged before it is compared with what the informed know"""


@dataclass(frozen=True, slots=True)
class About:
    """What a scenario is judged by."""

    events_s: tuple[float, ...]
    within: float
    """what the response must come to and stay: shape RMS (m), or leaderless the mean velocity's error (m/s)"""
    f_after_s: float
    every: int = 1
    must_m: float = 0.0
    must_fewer_percent: float = 0.0


def about_of(config: Config) -> dict[str, About]:
    """What each scenario of the set-up is judged by; every one must say it."""
    given, cases = config.values.get("about", {}), config.cases()
    if set(given) != set(cases):
        raise ConfigError(f"{config.where}: $.about must name the scenarios of $.cases: {', '.join(cases)}")
    try:
        return {k: _about(given[k]) for k in cases}
    except TypeError as error:
        raise ConfigError(f"{config.where}: $.about: {error}") from error


def _about(given: Record) -> About:
    values: Record = {name: tuple(v) if isinstance(v, list) else v for name, v in given.items()}
    return About(**values)


def schemes_of(config: Config, setup: Setup) -> dict[str, Setup]:
    """The ways to speak in one scenario."""
    return config.on(setup, "schemes")


def piece(config: Config, seed: int) -> Record:
    """Every scheme in every scenario under one seed."""
    found: Record = {}
    about = about_of(config)
    for scenario, setup in config.cases().items():
        if seed % about[scenario].every:
            continue
        found[scenario] = {}
        for name, scheme in schemes_of(config, setup).items():
            spoken = same_number(scheme, found[scenario][FLOWN]["messages"]) if name == SAME else scheme
            found[scenario][name] = figures_of(run(spoken, seed), about[scenario])
    return found


def figures_of(flight: Run, about: About) -> Record:
    """What is kept of one run. Errors are None where nobody ever predicted anybody."""
    setup = flight.setup
    known = flight.measures["bound_samples"] > 0
    error = flying_error_m(flight)
    late = flight.time_s > about.f_after_s
    responses = responses_s(flight, about)
    return {
        "messages": flight.messages,
        **flight.by_cause(),
        "received": flight.received,
        "fewer_percent": fewer_percent(flight.messages, setup),
        "bytes": payload_bytes(flight),
        "worst_m": flight.measures["prediction_error_max_m"] if known else None,
        "p999_m": quantile_m(flight.error_bins, 0.999) if known else None,
        "least_m": flight.measures["minimum_distance_m"],
        "close_pairs": close_pairs(flight, setup.barrier_radius_m),
        "response_s": None if None in responses else float(np.mean([r for r in responses if r is not None])),
        "f_m": float(np.sqrt(np.nanmean(error[late] ** 2))),
    }


def flying_error_m(flight: Run) -> Floats:
    """Distance from the slot about the centre of those that take part, shape (T, N); NaN for who has not joined."""
    offset = flight.position_m - flight.reference[:, :, :3]
    for agent, at_s, *_ in flight.setup.joins:
        offset[flight.time_s < at_s, int(agent)] = np.nan
    return np.asarray(np.linalg.norm(offset - np.nanmean(offset, axis=1, keepdims=True), axis=2))


def responses_s(flight: Run, about: About) -> list[float | None]:
    """How long after each event what must be within its limit is so, and stays so until the next (s); None: never."""
    setup, t = flight.setup, flight.time_s
    if setup.informed:
        kept = setup.keep_every
        wish = motion_table(setup, round(setup.duration_s / setup.dt_s))[::kept, 0, 3:6]
        off = flight.velocity_m_s.mean(axis=1) - wish[: len(t)]
        width = max(round(MEAN_S / (setup.dt_s * kept)), 1)
        total = np.vstack([np.zeros(3), np.cumsum(off, axis=0)])
        begin = np.maximum(np.arange(len(t)) - width + 1, 0)
        mean = (total[1:] - total[begin]) / (np.arange(len(t)) + 1 - begin)[:, None]
        beyond = np.linalg.norm(mean, axis=1) > about.within
    else:
        beyond = np.sqrt(np.nanmean(flying_error_m(flight) ** 2, axis=1)) > about.within
    found: list[float | None] = []
    for begin_s, end_s in pairwise((*about.events_s, setup.duration_s)):
        during = np.flatnonzero((t >= begin_s) & (t < end_s))
        last = during[beyond[during]]
        if not last.size:
            found.append(0.0)
        else:
            found.append(None if last[-1] == during[-1] else float(t[last[-1] + 1] - begin_s))
    return found


def close_pairs(flight: Run, distance_m: float) -> int:
    """How many pairs ever came nearer than a distance."""
    n = flight.position_m.shape[1]
    return sum(
        int((np.linalg.norm(flight.position_m[:, i + 1 :] - flight.position_m[:, i : i + 1], axis=2) < distance_m)
            .any(axis=0).sum())
        for i in range(n - 1)
    )  # fmt: skip


# -- what was found ----------------------------------------------------------------------------------------------------


def _column(records: Sequence[Record], key: str) -> Floats:
    return np.array([np.nan if r[key] is None else float(r[key]) for r in records])


def _row(records: Sequence[Record]) -> Record:
    row: Record = {"seeds": len(records)}
    for key in ("messages", *CAUSES, "fewer_percent", "bytes", "close_pairs"):
        row[key] = float(np.mean([r[key] for r in records]))
    row["received"] = int(sum(r["received"] for r in records))
    for key in ("worst_m", "p999_m", "least_m", "response_s", "f_m"):
        values = _column(records, key)
        values = values[np.isfinite(values)]
        for name, at in (("", 50), ("_q1", 25), ("_q3", 75)):
            row[f"{key}{name}"] = float(np.percentile(values, at)) if values.size else None
    worst = _column(records, "worst_m")
    row["worst_of_all_m"] = float(np.nanmax(worst)) if np.isfinite(worst).any() else None
    row["least_of_all_m"] = min(r["least_m"] for r in records)
    row["below"] = sum(r["least_m"] < COLLISION_M for r in records)
    row["close"] = proportion_text(row["below"], len(records))
    row["unanswered"] = sum(r["response_s"] is None for r in records)
    return row


def _better(ours: Floats, theirs: Floats, *, larger: bool = False) -> str:
    """Whether ours is the better of two figures over the same seeds: yes, no, or alike within 95 % of the difference.

    A response that never came counts as longer than any; where both never came, as equal.
    """
    gain = ours - theirs if larger else theirs - ours
    gain = gain[np.isfinite(gain)]
    if gain.size < 2 or not gain.any():
        return "alike"
    half = float(student.ppf(0.975, gain.size - 1)) * float(gain.std(ddof=1)) / np.sqrt(gain.size)
    return "alike" if abs(gain.mean()) <= half else "yes" if gain.mean() > 0 else "no"


def _judged(scenario: str, setup: Setup, by: dict[str, list[Record]], rows: dict[str, Record]) -> Record:
    """The flown trigger beside the period with the same number of messages."""
    ours, theirs = by[FLOWN], by[SAME]
    never = setup.duration_s

    def answered(records: Sequence[Record]) -> Floats:
        return np.nan_to_num(_column(records, "response_s"), nan=never)

    worst, other = _column(ours, "worst_m"), _column(theirs, "worst_m")
    ratio = float(worst.mean() / other.mean())
    return {
        "scenario": scenario,
        "messages": rows[FLOWN]["messages"],
        "same_messages": rows[SAME]["messages"],
        "worst_ratio": ratio,
        "p999_ratio": float(_column(ours, "p999_m").mean() / _column(theirs, "p999_m").mean()),
        "bounded": ratio <= BOUNDED,
        "smaller": _better(worst, other),
        "faster": _better(answered(ours), answered(theirs)),
        "nearer": _better(_column(ours, "f_m"), _column(theirs, "f_m")),
        "apart": _better(_column(ours, "least_m"), _column(theirs, "least_m"), larger=True),
        "below": rows[FLOWN]["below"],
        "same_below": rows[SAME]["below"],
    }


def finish(config: Config, pieces: Sequence[Record], seeds: Sequence[int]) -> Outcome:  # noqa: ARG001
    """Who is better at what, every scheme of every scenario, and what that means."""
    outcome = Outcome()
    about, cases = about_of(config), config.cases()
    summary: dict[str, dict[str, Record]] = {}
    judged: list[Record] = []
    for scenario, setup in cases.items():
        mine = [p[scenario] for p in pieces if scenario in p]
        if not mine:
            continue
        by = {name: [m[name] for m in mine] for name in mine[0]}
        rows = summary[scenario] = {name: _row(records) for name, records in by.items()}
        judged.append(_judged(scenario, setup, by, rows))
        must, flown = about[scenario], rows[FLOWN]
        if must.must_m and not flown["least_of_all_m"] >= must.must_m:
            outcome.broken = (
                f"{scenario}: {flown['below']} of {flown['seeds']} seeds below {COLLISION_M} m, the least "
                f"{flown['least_of_all_m']:.2f} m, must be {must.must_m:g} m"
            )
        elif must.must_fewer_percent and not flown["fewer_percent"] >= must.must_fewer_percent:
            outcome.broken = (
                f"{scenario}: {flown['fewer_percent']:.2f} % fewer messages than 20 Hz, must be "
                f"{must.must_fewer_percent:g} %"
            )
    outcome.values |= {"judged": judged, "rows": summary}
    outcome.tables += [_judged_table(judged), _table(summary, cases)]
    outcome.findings += _findings(judged, summary)
    outcome.figures += _figures(summary)
    return outcome


def _judged_table(judged: list[Record]) -> Table:
    return Table(
        "worth_judged", "The flown trigger beside a period with the same number of messages",
        (Column("scenario", "scenario"), Column("messages", "messages, trigger", 0),
         Column("same_messages", "messages, period", 0),
         Column("worst_ratio", "worst prediction error, trigger/period", 2),
         Column("p999_ratio", "99.9 %, trigger/period", 2), Column("bounded", "≤ 1/3"),
         Column("faster", "trigger responds faster"), Column("nearer", "nearer to formation"),
         Column("apart", "farther apart"), Column("below", f"seeds below {COLLISION_M} m, trigger"),
         Column("same_below", "period")),
        judged,
        "Ratios are of the means over seeds. Yes and no hold with 95 % confidence over the paired seeds, alike is "
        "neither; a response that never comes counts as the whole flight.",
    )  # fmt: skip


def _table(summary: dict[str, dict[str, Record]], cases: dict[str, Setup]) -> Table:
    rows = [
        {"scenario": scenario, "scheme": name, "safety_m": cases[scenario].barrier_radius_m, **row}
        for scenario, schemes in summary.items()
        for name, row in schemes.items()
    ]
    return Table(
        "worth_all", "Every way to speak in every scenario",
        (Column("scenario", "scenario"), Column("scheme", "messages are sent"), Column("seeds", "seeds"),
         Column("messages", "messages", 0), *(Column(c, c, 0) for c in CAUSES),
         Column("fewer_percent", "fewer than 20 Hz (%)", 2), Column("worst_m", "worst prediction error, median (m)", 2),
         Column("worst_of_all_m", "of all seeds (m)", 2), Column("p999_m", "99.9 % (m)", 2),
         Column("least_of_all_m", "least distance of all seeds (m)", 2), Column("least_m", "median (m)", 2),
         Column("close", f"seeds below {COLLISION_M} m"), Column("safety_m", "safety distance (m)", 2),
         Column("close_pairs", "pairs below it", 1), Column("response_s", "response, median (s)", 1),
         Column("unanswered", "seeds without one"), Column("f_m", "F, median (m)", 3)),
        rows,
        "Messages are of all vehicles and the whole flight, by cause; a period counts as the trigger. Of what is sent "
        f"under “{NOTHING}” none arrives, so that nobody predicts anybody.",
    )  # fmt: skip


def _findings(judged: Sequence[Record], summary: dict[str, dict[str, Record]]) -> list[str]:
    bounded = [r["scenario"] for r in judged if r["bounded"]]
    nothing = [f"{r['scenario']} ({r['worst_ratio']:.2f})" for r in judged if not r["bounded"]]
    found = [
        "At an equal number of messages the trigger's worst prediction error is at most a third of the period's in: "
        + (", ".join(bounded) or "no scenario") + ".",
        "By that measure it buys nothing in: " + (", ".join(nothing) or "none") + ".",
    ]  # fmt: skip
    for key, text in (("faster", "responds faster"), ("nearer", "is nearer to formation"), ("apart", "keeps farther")):
        ways = {way: [r["scenario"] for r in judged if r[key] == way] for way in ("yes", "no", "alike")}
        found.append(
            f"The trigger {text} than the period in {len(ways['yes'])} of {len(judged)} scenarios"
            + (f", and is worse in: {', '.join(ways['no'])}" if ways["no"] else "") + "."
        )  # fmt: skip
    silent = [
        f"{scenario} ({rows[NOTHING]['f_m']:.3f} m, flown {rows[FLOWN]['f_m']:.3f} m)"
        for scenario, rows in summary.items()
        if rows[NOTHING]["f_m"] <= 1.02 * rows[FLOWN]["f_m"]
    ]
    if silent:
        found.append("Formation error is no larger with nothing received at all in: " + ", ".join(silent) + ".")
    return found


def _figures(summary: dict[str, dict[str, Record]]) -> list[Figure]:
    scenarios = list(summary)
    shown = (FLOWN, SAME, BEATS, HERTZ, RAW)
    figures = []
    for name, key, label, caption, line in (
        ("worth_error", "worst_m", "worst prediction error (m)", "Worst error of any prediction", None),
        ("worth_distance", "least_m", "least distance (m)", "Least distance of any two", COLLISION_M),
        ("worth_response", "response_s", "time to respond (s)", "Time to respond, of the seeds that did", None),
    ):
        fig, axes = panels(1, 1, 7.2, 0.42 * len(scenarios) + 1.4)
        ax = axes[0, 0]
        names = shown if key != "least_m" else (*shown, NOTHING)
        for k, scheme in enumerate(names):
            at = np.arange(len(scenarios), dtype=np.float64)[::-1] + 0.3 - 0.6 * k / (len(names) - 1)
            spread(ax, [summary[s][scheme] for s in scenarios], key, at, scheme, FAMILY[k])
        if line is not None:
            ax.axvline(line, color=INK, ls="--", lw=1.0, label=f"{line:g} m: collision")
        ax.set_yticks(np.arange(len(scenarios))[::-1], scenarios)
        ax.grid(axis="y", visible=False)
        for between in np.arange(len(scenarios) - 1) + 0.5:
            ax.axhline(between, color=GREY, lw=0.4)
        ax.set(xlabel=label, ylim=(-0.6, len(scenarios) - 0.4))
        if key == "worst_m":
            ax.set_xscale("log")
        fig.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3)
        figures.append(Figure(name, f"{caption}: median and interquartile range over seeds.", fig))
    figures.append(Figure("worth_causes", "Messages of the flown trigger by cause, mean over seeds.", _causes(summary)))
    figures.append(
        Figure("worth_t_max", "Worst prediction error and messages over the longest silence; median and interquartile "
               "range over seeds.", _t_max(summary))
    )  # fmt: skip
    return figures


def _causes(summary: dict[str, dict[str, Record]]) -> Any:
    fig, axes = panels(1, 1, 7.2, 0.3 * len(summary) + 1.4)
    ax = axes[0, 0]
    y = np.arange(len(summary))[::-1]
    left = np.zeros(len(summary))
    for k, cause in enumerate(CAUSES):
        # of a vehicle, since scenarios differ in their number
        width = np.array([rows[FLOWN][cause] / rows[FLOWN]["first"] for rows in summary.values()])
        ax.barh(y, width, left=left, height=0.6, color=FAMILY[k][0], hatch=("", "//", "..", "xx")[k],
                edgecolor="white", label=cause)  # fmt: skip
        left += width
    ax.set_yticks(y, list(summary))
    ax.set_xlabel("messages of a vehicle and flight")
    fig.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return fig


def _t_max(summary: dict[str, dict[str, Record]]) -> Any:
    fig, axes = panels(1, 2, 7.2, 3.8)
    schemes = {2.0: "T_max 2 s", 5.0: "T_max 5 s", 10.0: FLOWN, 30.0: "T_max 30 s"}
    chosen = [s for s in ("steady flight", "crossing slots, all faults", "leaderless, 2 of 10 informed",
                          "a failing motor", "partition and re-join") if s in summary]  # fmt: skip
    for k, scenario in enumerate(chosen):
        rows = [summary[scenario][name] for name in schemes.values()]
        colour, marker = FAMILY[k]
        x = np.array(list(schemes)) * 1.04 ** (k - 2)
        middle = np.array([r["worst_m"] for r in rows])
        low, high = (np.array([r[f"worst_m_{q}"] for r in rows]) for q in ("q1", "q3"))
        axes[0, 0].errorbar(x, middle, [middle - low, high - middle], color=colour, marker=marker, capsize=2,
                            label=scenario)  # fmt: skip
        axes[0, 1].plot(x, [r["messages"] for r in rows], color=colour, marker=marker)
    for ax, label in ((axes[0, 0], "worst prediction error (m)"), (axes[0, 1], "messages of all vehicles")):
        ax.set(xscale="log", yscale="log", xlabel="longest silence T_max (s)", ylabel=label)
        ax.set_xticks(list(schemes), [f"{t:g}" for t in schemes])
        ax.set_xticks([], minor=True)
    fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return fig
