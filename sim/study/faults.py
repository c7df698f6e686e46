"""Loss, delay, failures, noise, lag and gusts, alone and together; distances; what each safeguard is worth."""

from collections.abc import Sequence

import numpy as np

from sim.study.common import (
    Column,
    Config,
    Figure,
    Outcome,
    Record,
    Table,
    measured,
    over_seeds,
    proportion_interval,
    proportion_text,
)
from sim.study.figures import BLUE, FAMILY, RED, SKY, panels, quartiles
from sim.swarm.setup import Setup, setup_from
from sim.swarm.swarm import Run, run

TITLE = "Faults and safeguards"
KEYS = ("fewer_percent", "f_m", "formation_rmse_m", "minimum_distance_m", "peak_command_m_s2", "bound_worst_ratio")
CLOSE_M = 0.5


def _ablated(config: Config) -> dict[str, Setup]:
    last = list(config.cases().values())[-1]
    return {"with everything": last, **config.on(last, "ablation")}


def _meeting(setup: Setup, seed: int) -> Run:
    """Two vehicles whose plans lead them through each other at 2 m/s each; a few centimetres between their lines."""
    rng = np.random.default_rng([seed, 77])
    steps = round(setup.duration_s / setup.dt_s) + 1
    table = np.zeros((steps, 2, 9))
    half = 2.0 * setup.duration_s / 2
    for i, sign in enumerate((1.0, -1.0)):
        table[:, i, 0] = sign * (-half + 2.0 * setup.dt_s * np.arange(steps))
        table[:, i, 1] = rng.uniform(-0.05, 0.05)
        table[:, i, 3] = 2.0 * sign
    return run(setup, seed, reference=table, start=(table[0, :, :3].copy(), table[0, :, 3:6].copy()))


def piece(config: Config, seed: int) -> Record:
    """Every fault, ablation and meeting under one seed."""

    def kept(setup: Setup) -> Record:
        record = measured(run(setup, seed), 30.0 if setup.scrambled or setup.start_ball_m > 1 else 8.0)
        return {k: record[k] for k in KEYS}

    intent = config.values["intent"]
    return {
        "flown": {name: kept(setup) for name, setup in config.cases().items()},
        "intent": {name: kept(setup_from(intent, "$.intent", setup)) for name, setup in config.cases().items()},
        "ablation": {name: kept(setup) for name, setup in _ablated(config).items()},
        "meeting": {
            name: _meeting(setup, seed).measures["minimum_distance_m"]
            for name, setup in config.on(config.one("headon"), "meetings").items()
        },
    }


def finish(config: Config, pieces: Sequence[Record], seeds: Sequence[int]) -> Outcome:  # noqa: ARG001
    """Tables of faults, ablation and meetings; distances as a figure."""
    outcome = Outcome()
    n = len(pieces)
    rows = []
    for name in pieces[0]["flown"]:
        row: Record = {"fault": name}
        for law in ("flown", "intent"):
            records = [p[law][name] for p in pieces]
            stats = over_seeds(records, KEYS)
            row |= {f"{law}_{k}": v for k, v in stats.items()}
            row[f"{law}_close"] = proportion_text(sum(r["minimum_distance_m"] < CLOSE_M for r in records), n)
        rows.append(row)
    columns = [Column("fault", "fault")]
    for law, label in (("flown", "flown law"), ("intent", "intent")):
        columns += [
            Column(f"{law}_f_m_median", f"{label}: F, median (m)"), Column(f"{law}_f_m_max", "worst seed"),
            Column(f"{law}_fewer_percent", "fewer messages (%)", 2),
            Column(f"{law}_minimum_distance_m_min", "least distance of all seeds (m)", 2),
            Column(f"{law}_close", f"seeds below {CLOSE_M} m"),
        ]  # fmt: skip
    outcome.tables.append(
        Table("faults_table", "Faults", tuple(columns), rows,
              "F after 8 s, after 30 s where starts are far from the slots. The failing vehicle is no part of F but of "
              "every distance.")
    )  # fmt: skip
    outcome.values["rows"] = rows
    ablation = []
    for name in pieces[0]["ablation"]:
        records = [p["ablation"][name] for p in pieces]
        close = sum(r["minimum_distance_m"] < CLOSE_M for r in records)
        ablation.append({"case": name, **over_seeds(records, KEYS), "close": proportion_text(close, n),
                         "close_share": close / n})  # fmt: skip
    outcome.values["ablation"] = ablation
    outcome.tables.append(
        Table(
            "faults_ablation", "Everything at once with exchanged slots: what each safeguard is worth",
            (Column("case", "case"), Column("close", f"seeds below {CLOSE_M} m"),
             Column("minimum_distance_m_min", "least distance (m)", 2),
             Column("minimum_distance_m_median", "median (m)", 2), Column("f_m_median", "F after 30 s, median (m)", 2),
             Column("fewer_percent", "fewer messages (%)", 2), Column("peak_command_m_s2_max", "peak |u| (m/s²)", 1)),
            ablation,
        )
    )  # fmt: skip
    meetings = []
    for name in pieces[0]["meeting"]:
        distances = [p["meeting"][name] for p in pieces]
        meetings.append(
            {
                "case": name, "median_m": float(np.median(distances)), "least_m": min(distances),
                "close": proportion_text(sum(d < CLOSE_M for d in distances), n),
            }
        )  # fmt: skip
    outcome.values["meetings"] = meetings
    outcome.tables.append(
        Table(
            "faults_meetings", "Head-on at 2 m/s each, lag 0.3 s: where safety ends",
            (Column("case", "exchange"), Column("median_m", "minimum distance, median (m)", 2),
             Column("least_m", "least of all seeds (m)", 2), Column("close", f"seeds below {CLOSE_M} m")),
            meetings,
        )
    )  # fmt: skip
    by = {r["fault"]: r for r in rows}
    crossing, exchanged = by["all of them, crossing starts"], by["all of them, slots exchanged"]
    stuck = exchanged["flown_f_m_median"] > 0.5
    ablated = {r["case"]: r for r in ablation}
    outcome.findings += [
        f"Everything at once from crossing starts: {crossing['flown_close']} seeds come below 0.5 m (least "
        f"{crossing['flown_minimum_distance_m_min']:.2f} m); F afterwards {crossing['flown_f_m_median']:.3f} m "
        "(median).",
        f"With every slot exchanged and kappa = 0: {exchanged['flown_close']}, least "
        f"{exchanged['flown_minimum_distance_m_min']:.2f} m; F after 30 s is "
        f"{exchanged['flown_f_m_median']:.2f} m (median) and "
        f"{exchanged['flown_f_m_max']:.2f} m (worst seed){': not all get past each other' if stuck else ''}, "
        "since gaps of "
        "2.1 m between slots are narrower than two safety radii. Assigning slots by squared distance avoids this case.",
        f"There, with kappa = 0.3 as flown: {ablated['kappa = 0.3, as flown']['close']} below 0.5 m. "
        "The residual raises the threshold by 0.1 m at most: when metres of residual raised it without a bound, "
        "predictions were off by more than the safety radius, and 9 of these 20 seeds came below.",
        "Messages under noise of 0.1 m and more rise above 1 %: the threshold is then near the sensors' own error.",
    ]
    fig, axes = panels(1, 2, 7.4, 5.4, sharey=True)
    y = np.arange(len(rows))[::-1]
    for law, label, look, shift in (
        ("flown", "flown law", FAMILY[0], 0.15), ("intent", "published intent", FAMILY[2], -0.15)
    ):  # fmt: skip
        for ax, key, worst in ((axes[0, 0], "f_m", "max"), (axes[0, 1], "minimum_distance_m", "min")):
            middle, bars = quartiles(rows, f"{law}_{key}")
            ax.errorbar(middle, y + shift, xerr=bars, fmt=look[1], ms=4, lw=1, capsize=1.5, color=look[0], label=label)
            ax.scatter([r[f"{law}_{key}_{worst}"] for r in rows], y + shift, marker="|", s=30, color=look[0],
                       label=f"{label}, worst seed")  # fmt: skip
    axes[0, 1].axvline(CLOSE_M, color=RED, ls="--", lw=1, label=f"{CLOSE_M} m: collision")
    axes[0, 0].set_yticks(y, [r["fault"] for r in rows])
    axes[0, 0].set(xscale="log", xlabel="F (m)", title="formation error")
    axes[0, 1].set(xlabel="minimum distance (m)", title="distance", xlim=(0, None))
    fig.legend(*axes[0, 1].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    outcome.figures.append(
        Figure("faults", "Median, interquartile range and worst of the seeds, of F and of the minimum distance.", fig)
    )
    fig, axes = panels(1, 1, 7.2, 3.4)
    ax = axes[0, 0]
    y = np.arange(len(ablation))[::-1]
    share = np.array([100 * r["close_share"] for r in ablation])
    ends = np.array([proportion_interval(round(r["close_share"] * n), n) for r in ablation]) * 100
    ax.barh(
        y, share, xerr=[share - ends[:, 0], ends[:, 1] - share], capsize=2,
        color=[SKY if r["case"] != "with everything" else BLUE for r in ablation],
    )  # fmt: skip
    ax.set_yticks(y, [r["case"] for r in ablation])
    ax.set(xlabel=f"seeds below {CLOSE_M} m (%)", title="exchanged slots, everything at once", xlim=(0, 100))
    outcome.figures.append(
        Figure(
            "faults_ablation",
            "Share of seeds with a distance below 0.5 m without each safeguard, with its 95 % "
            "interval; dark: with all of them.",
            fig,
        )
    )
    return outcome
