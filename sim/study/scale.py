"""Cost of a step and time to form against the number of agents."""

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sim.study.common import Column, Config, Figure, Outcome, Record, Table, statistics
from sim.study.figures import FAMILY, GREY, RED, panels, quartiles
from sim.swarm.neighbour_list import NeighbourList
from sim.swarm.options import rules_of, run_options
from sim.swarm.setup import Setup
from sim.swarm.swarm import kernels, reference_table, run, starts, state_of, with_list

TITLE = "Scale: what a step costs, how long a swarm takes to form"
BAR_MS = 20.0


def seeds_used(seeds: Sequence[int]) -> Sequence[int]:
    """Costs do not depend on luck: three seeds are enough."""
    return seeds[:3]


def step_costs(setup: Setup, seed: int, steps: int, relative_speed_m_s: float) -> Record:
    """CPU time of each part of a control step, median of `steps` steps, one thread.

    The agents move with the plan and against each other at `relative_speed_m_s`, each along its own direction, turning
    round every two seconds; everything runs on them as in any other study, but for their dynamics.
    """
    loops = kernels()
    from sim.swarm import exchange
    from sim.swarm.command import command

    n = setup.formation.count
    plain, filtered = (run_options(replace(setup, barrier=b)) for b in (False, True))
    g, ig, et, st, it = rules_of(setup)
    table = reference_table(setup, steps + 6)
    x, v = starts(setup, seed)
    rng = np.random.default_rng([seed, 5])
    way = rng.normal(size=(n, 3))
    way *= relative_speed_m_s / np.linalg.norm(way, axis=1, keepdims=True)
    near = NeighbourList(setup.range_m)
    # sorted by cell, so that neighbours in space are neighbours in memory
    order = near.sorted_order(x)
    way = way[order]
    s = state_of(setup, seed, plain, table, x[order].copy(), v[order].copy(), setup.formation.slots()[order], near)
    whole, barriers, rebuilt, messages = [], [], 0, 0
    turn = round(2.0 / setup.dt_s)
    for k in range(steps + 5):
        s.v[:] = np.array(setup.velocity_m_s) + (1.0 if (k // turn) % 2 == 0 else -1.0) * way
        begin = time.thread_time_ns()
        s = with_list(s, near)
        loops.place_slots(k, s, table)
        loops.measure(k, s, plain)
        loops.filter_own(k, s, plain)
        exchange.send(k, k, s, table, plain, et, st, it, ig)
        exchange.predict_all(k, s, table, plain, ig)
        law = time.thread_time_ns()
        command(k, s, table, plain, g, ig)
        middle = time.thread_time_ns()
        command(k, s, table, filtered, g, ig)
        end = time.thread_time_ns()
        s.x[:] += setup.dt_s * s.v
        if k == 4:
            rebuilt, messages = near.rebuilt, int(s.counts[0])
        if k >= 5:
            whole.append((middle - begin) * 1e-6)
            barriers.append((end - middle - (middle - law)) * 1e-6)
    return {
        "count": n,
        "neighbours": float(near.within_range(s.x)),
        "step_ms": float(np.median(whole)),
        "step_mean_ms": float(np.mean(whole)),
        "filter_ms": float(np.median(barriers)),
        "rebuilds": near.rebuilt - rebuilt,
        "messages": int(s.counts[0]) - messages,
    }


def piece(config: Config, seed: int) -> Record:
    """Costs and formation times of every N under one seed."""
    cost, forming = config.values["cost"], config.values["formation_time"]

    def sized(count: int) -> Setup:
        return replace(config.base, formation=replace(config.base.formation, count=count))

    step_costs(sized(20), seed, 10, 0.35)
    formed = []
    for count in forming["counts"]:
        row: Record = {"count": count}
        for law in ("flown", "intent"):
            setup = sized(count)
            if law == "intent":
                setup = replace(setup, law="intent", trigger="intent", epsilon_m=0.4)
            flight = run(setup, seed)
            error = np.sqrt((flight.formation_error_m() ** 2).mean(axis=1))
            outside = np.nonzero(error > forming["formed_m"])[0]
            last = int(outside[-1]) + 1 if outside.size else 0
            row[f"{law}_formed_s"] = float(flight.time_s[last]) if last < len(error) else None
            row[f"{law}_error_end_m"] = float(error[-1])
            row[f"{law}_messages_per_agent_s"] = flight.messages / count / setup.duration_s
        formed.append(row)
    return {
        "cost": [step_costs(sized(c), seed, cost["steps"], cost["relative_speed_m_s"]) for c in cost["counts"]],
        "formed": formed,
    }


def finish(config: Config, pieces: Sequence[Record], seeds: Sequence[int]) -> Outcome:  # noqa: ARG001
    """Tables, fitted slopes and their figure."""
    cost: list[Record] = []
    for k in range(len(pieces[0]["cost"])):
        rows = [p["cost"][k] for p in pieces]
        spread = {key: statistics([r[key] for r in rows]) for key in rows[0] if key != "count"}
        cost.append({
            "count": rows[0]["count"], **{key: s["median"] for key, s in spread.items()},
            **{f"{key}_{q}": s[q] for key, s in spread.items() for q in ("median", "q1", "q3")},
        })  # fmt: skip
    formed: list[Record] = []
    for k in range(len(pieces[0]["formed"])):
        rows = [p["formed"][k] for p in pieces]
        row: Record = {"count": rows[0]["count"]}
        for key in rows[0]:
            values = [r[key] for r in rows if r[key] is not None]
            all_there = statistics(values) if len(values) == len(rows) else {}
            row |= {key: all_there.get("median"), **{f"{key}_{q}": all_there.get(q) for q in ("median", "q1", "q3")}}
        row["count"] = rows[0]["count"]
        formed.append(row)
    large = [r for r in cost if r["count"] >= 100]
    slope = float(np.polyfit(np.log([r["count"] for r in large]), np.log([r["step_ms"] for r in large]), 1)[0])
    outcome = Outcome(values={"cost": cost, "formation_time": formed, "cost_slope": slope})
    outcome.tables.append(
        Table("scale_cost", "CPU time of one control step, one thread",
              (Column("count", "N", 0), Column("neighbours", "neighbours, mean", 1),
               Column("step_ms", "law, hold, trigger and list, median (ms)"), Column("step_mean_ms", "mean (ms)"),
               Column("filter_ms", "safety filter besides, median (ms)"), Column("rebuilds", "list rebuilds", 0)),
              cost, "Median of 200 steps; relative motion 0.35 m/s; rebuilds of the list are inside the step.")
    )  # fmt: skip
    outcome.tables.append(
        Table("scale_formation", "Time until the RMS formation error stays below 0.1 m",
              (Column("count", "N", 0), Column("flown_formed_s", "flown law (s)", 2),
               Column("flown_error_end_m", "error at 20 s (m)", 4),
               Column("flown_messages_per_agent_s", "messages per agent and s"),
               Column("intent_formed_s", "published intent (s)", 2),
               Column("intent_error_end_m", "error at 20 s (m)", 4),
               Column("intent_messages_per_agent_s", "messages per agent and s")),
              formed, "Neighbours within 7.6 m only; – is not formed within 20 s.")
    )  # fmt: skip
    last = cost[-1]
    outcome.findings += [
        f"N = {last['count']}: {last['step_ms']:.1f} ms CPU a step (median of 200, list rebuilds included, mean "
        f"{last['step_mean_ms']:.1f} ms, {last['neighbours']:.0f} neighbours) against a bar of {BAR_MS:.0f} "
        "ms; the safety "
        f"filter costs {last['filter_ms']:.1f} ms more.",
        f"From 100 agents on, cost grows as N^{slope:.2f}.",
        f"Formed within {_time_text(formed, 'flown')} (flown law) and {_time_text(formed, 'intent')} "
        "(published intent) at "
        f"every N; 20 s after the start the flown law's error has grown from {formed[0]['flown_error_end_m']:.4f} m at "
        f"N = {formed[0]['count']} to {formed[-1]['flown_error_end_m']:.3f} m at N = {formed[-1]['count']}, "
        "intent's to "
        f"{formed[-1]['intent_error_end_m']:.3f} m: with few neighbours, errors between far parts die out slowly.",
    ]
    fig, axes = panels(1, 2, 7.4, 3.2)
    ax = axes[0, 0]
    n = np.array([r["count"] for r in cost], dtype=float)
    for key, label, (colour, marker) in (
        ("step_ms", "law, hold, trigger, list", FAMILY[0]), ("filter_ms", "safety filter", FAMILY[1])
    ):  # fmt: skip
        middle, bars = quartiles(cost, key)
        ax.errorbar(n, middle, bars, fmt=marker + "-", ms=4, capsize=1.5, color=colour, label=label)
    ax.plot(n[n >= 100], last["step_ms"] * (n[n >= 100] / n[-1]) ** slope, "--", color=RED, label=f"N^{slope:.2f}")
    ax.axhline(BAR_MS, color=GREY, ls=":", lw=1, label=f"{BAR_MS:.0f} ms wanted")
    ax.set(xscale="log", yscale="log", xlabel="N", ylabel="CPU time of a step (ms)", title="cost")
    ax.legend(fontsize=7)
    ax = axes[0, 1]
    for law, label, (colour, marker) in (("flown", "flown law", FAMILY[0]), ("intent", "published intent", FAMILY[2])):
        shown = [r for r in formed if r[f"{law}_formed_s"] is not None]
        middle, bars = quartiles(shown, f"{law}_formed_s")
        ax.errorbar([r["count"] for r in shown], middle, bars, fmt=marker + "-", ms=4, capsize=1.5, color=colour,
                    label=label)  # fmt: skip
    ax.set_xscale("log")
    ax.set(xlabel="N", ylabel="time to form (s)", title="formation, neighbours within 7.6 m", ylim=(0, None))
    ax.legend(fontsize=7)
    outcome.figures.append(
        Figure(
            "scale",
            "Cost of a step and time to form against the number of agents: median and interquartile range over seeds.",
            fig,
        )
    )
    return outcome


def _time_text(formed: Sequence[Record], law: str) -> str:
    times = [r[f"{law}_formed_s"] for r in formed]
    return "– (not always formed)" if None in times else f"{max(times):.1f} s"
