"""Example 1: fifteen UAVs in a spiral; the figures 2 to 5 of the paper and the inter-event times."""

from collections.abc import Sequence

import numpy as np

from sim.study.common import Column, Config, Figure, Outcome, Record, Table, statistics
from sim.study.figures import BLUE, GREY, RED, panels, snapshots, trajectories_3d
from sim.study.paper import at, error_curves, example_record, first_run, per_axis_rms_m
from sim.swarm.swarm import run

TITLE = "Example 1: fifteen UAVs in a spiral"
TIMES_S = (0.0, 5.0, 10.0, 15.0)


def piece(config: Config, seed: int) -> Record:
    """The example under the reading named, under the literal one, and the flown law on the same work."""
    cases = {"V1b": config.base, "V0 (literal)": config.one("literal"), "flown": config.one("flown")}
    return {name: example_record(run(setup, seed), TIMES_S) for name, setup in cases.items()}


def finish(config: Config, pieces: Sequence[Record], seeds: Sequence[int]) -> Outcome:
    """Tables and figures."""
    published = config.published
    rows: list[Record] = []
    for name in pieces[0]:
        records = [p[name] for p in pieces]
        rows.append(
            {
                "case": name,
                "interval_mean_s": statistics([r["interval_mean_s"] for r in records])["mean"],
                "interval_mean_sd": statistics([r["interval_mean_s"] for r in records])["sd"],
                "interval_median_s": statistics([r["interval_median_s"] for r in records])["median"],
                "error_start_m": statistics([r["errors_m"][0] for r in records])["mean"],
                "error_end_m": statistics([r["errors_m"][-1] for r in records])["mean"],
                "speed_15s_m_s": statistics([r["speed_m_s"][-1] for r in records])["mean"],
                "messages": statistics([r["messages"] for r in records])["mean"],
                "formation_rmse_m": statistics([r["formation_rmse_m"] for r in records])["mean"],
            }
        )
    rows.append(
        {"case": "published", **{k: published[k] for k in ("interval_mean_s", "interval_median_s", "error_start_m")}}
    )
    outcome = Outcome()
    outcome.tables.append(
        Table(
            "example1_table", TITLE,
            (Column("case", "reading"), Column("interval_mean_s", "interval mean (s)", 4),
             Column("interval_mean_sd", "± over seeds", 4), Column("interval_median_s", "interval median (s)", 4),
             Column("error_start_m", "error at 0 s (m)"), Column("error_end_m", "error at 15 s (m)", 4),
             Column("speed_15s_m_s", "mean speed at 15 s (m/s)"), Column("messages", "messages", 0),
             Column("formation_rmse_m", "absolute formation RMSE (m)")),
            rows,
            "Errors are RMS per axis about the centroid; the absolute RMSE is against the plan, in three dimensions.",
        )
    )  # fmt: skip
    ours = rows[0]
    outcome.values["interval"] = {"reading": "V1b", **{k: ours[k] for k in ("interval_mean_s", "interval_median_s")},
                                  "published": {k: published[k]
                                                for k in ("interval_mean_s", "interval_median_s")}}  # fmt: skip
    outcome.findings += [
        f"Under V1b the inter-event time is {ours['interval_mean_s']:.4f} s (mean) and "
        f"{ours['interval_median_s']:.3f} s "
        f"(median), against {published['interval_mean_s']} and {published['interval_median_s']}: it is "
        "sqrt(delta_f)/0.8 m/s = 0.177 s, rounded up to the step, and says nothing about adaptation.",
        f"Read literally (own state true) the swarm brakes: {rows[1]['speed_15s_m_s']:.3f} m/s are left after 15 s of "
        "the 0.8 it started with.",
        f"The flown law needs {rows[2]['messages']:.0f} messages where the paper's rule needs {ours['messages']:.0f}.",
    ]
    flown = first_run(config.base, seeds[0])
    slots = flown.reference[:, :, :3] + (flown.position_m - flown.reference[:, :, :3]).mean(axis=1, keepdims=True)
    outcome.figures.append(
        Figure("example1_trajectories", "Paths of the fifteen UAVs (as Fig. 2).",
               trajectories_3d(flown.position_m, slots[-1], "Example 1, reading V1b"))
    )  # fmt: skip
    errors = per_axis_rms_m(flown)
    index = [round(t / flown.setup.dt_s) for t in TIMES_S]
    outcome.figures.append(
        Figure("example1_snapshots", "Plan views with the neighbour graph at 8 m and the error per axis (as Fig. 3).",
               snapshots(TIMES_S, [flown.position_m[k] for k in index], [slots[k] for k in index],
                         config.base.range_m, [f"error {at(flown, errors, t):.3f} m" for t in TIMES_S]))
    )  # fmt: skip
    curves, rate = error_curves(flown, "Example 1: convergence under V1b")
    outcome.values["convergence_rate_per_s"] = rate
    outcome.figures.append(Figure("example1_errors", "Formation, velocity and total error (as Fig. 4).", curves))
    gaps = flown.intervals_s()
    fig, axes = panels(1, 1, 7.2, 3.0)
    ax = axes[0, 0]
    ax.hist(gaps, bins=np.arange(0.005, 0.405, 0.01), color=BLUE)
    ax.axvline(gaps.mean(), color=GREY, label=f"mean {gaps.mean():.4f} s")
    ax.axvline(
        published["interval_mean_s"], color=RED, ls="--", label=f"published mean {published['interval_mean_s']} s"
    )
    ax.axvline(
        published["interval_median_s"], color=RED, ls=":", label=f"published median {published['interval_median_s']} s"
    )
    ax.set(xlabel="time between two messages of one UAV (s)", ylabel="count", title="Example 1: inter-event times")
    ax.legend()
    outcome.figures.append(
        Figure("example1_intervals", "Inter-event times with the published values (as Fig. 5).", fig)
    )
    return outcome
