"""Which reading of the paper gives which figure: own state, hold, E_i, separation; and the braking of Eq. (2)."""

from collections.abc import Sequence

import numpy as np

from sim.study.common import Column, Config, Figure, Outcome, Record, Table, over_seeds, proportion_text
from sim.study.figures import CYCLE, panels
from sim.study.paper import at, per_axis_rms_m
from sim.swarm.setup import Setup
from sim.swarm.swarm import Run, run

TITLE = "Readings: what the paper's equations can mean"
GROUPS = {
    "own": "Whose state the own one is (Example 1)",
    "holds": "What is held between messages (Example 1)",
    "mode": "What E_i of Eq. (5) is (Example 1)",
    "separation": "What phi_s does (a V tighter than r0)",
}
KEYS = (
    "interval_mean_s", "interval_median_s", "messages", "speed_5s_m_s", "speed_15s_m_s", "speed_end_m_s", "error_end_m",
    "minimum_distance_m", "dynamic_percent", "peak_command_m_s2",
)  # fmt: skip


def _cases(config: Config, group: str) -> dict[str, Setup]:
    return config.on(config.one("tight") if group == "separation" else config.base, group)


def _record(flown: Run) -> Record:
    gaps = flown.intervals_s()
    speed = np.linalg.norm(flown.velocity_m_s.mean(axis=1), axis=1)
    modes = flown.steps_dynamic + flown.steps_fixed
    return {
        "interval_mean_s": float(gaps.mean()) if gaps.size else 0.0,
        "interval_median_s": float(np.median(gaps)) if gaps.size else 0.0,
        "messages": flown.messages,
        "speed_5s_m_s": at(flown, speed, 5.0),
        "speed_15s_m_s": at(flown, speed, 15.0),
        "speed_end_m_s": float(speed[-1]),
        "error_end_m": float(per_axis_rms_m(flown)[-1]),
        "minimum_distance_m": flown.measures["minimum_distance_m"],
        "dynamic_percent": 100.0 * flown.steps_dynamic / max(modes, 1),
        "peak_command_m_s2": flown.measures["peak_command_m_s2"],
    }


def piece(config: Config, seed: int) -> Record:
    """Every reading under one seed."""
    return {
        group: {name: _record(run(setup, seed)) for name, setup in _cases(config, group).items()} for group in GROUPS
    }


def finish(config: Config, pieces: Sequence[Record], seeds: Sequence[int]) -> Outcome:
    """One table for each ambiguity, and the curve of the braking."""
    outcome = Outcome()
    for group, title in GROUPS.items():
        rows = []
        for name in pieces[0][group]:
            records = [p[group][name] for p in pieces]
            close = sum(r["minimum_distance_m"] < 0.3 for r in records)
            rows.append({"reading": name, **over_seeds(records, KEYS), "below": proportion_text(close, len(records))})
        outcome.tables.append(
            Table(
                f"readings_{group}", title,
                (Column("reading", "reading"), Column("interval_mean_s", "interval mean (s)", 4),
                 Column("interval_median_s", "median (s)"), Column("messages", "messages", 0),
                 Column("speed_5s_m_s", "mean speed at 5 s (m/s)"), Column("speed_15s_m_s", "15 s (m/s)"),
                 Column("speed_end_m_s", "end (m/s)"), Column("error_end_m", "error per axis at the end (m)"),
                 Column("dynamic_percent", "time in dynamic mode (%)", 1),
                 Column("minimum_distance_m", "minimum distance, mean (m)"),
                 Column("below", "seeds closer than 0.3 m"), Column("peak_command_m_s2", "peak |u| (m/s²)", 1)),
                rows,
            )
        )  # fmt: skip
        outcome.values[group] = rows
    own = {r["reading"].split(":")[0]: r for r in outcome.values["own"]}
    delta, gamma, eta = config.base.delta_f, config.base.gamma_s2, config.base.eta
    outcome.findings += [
        f"Eq. (2) with zero-order hold brakes: 0.8 m/s become {own['V0']['speed_5s_m_s']:.2f} after 5 s and "
        f"{own['V0']['speed_15s_m_s']:.3f} after 15 s, since held neighbours always lag and cohesion pulls "
        "back by about "
        "k_c n sqrt(delta)/2.",
        f"V1b keeps its speed ({own['V1b']['speed_end_m_s']:.2f} m/s) only while every receiver holds exactly the "
        f"sender's copy: with 10 % loss {own['V1b, 10 % loss']['speed_end_m_s']:.2f}, with 50 ms of delay "
        f"{own['V1b, 50 ms delay']['speed_end_m_s']:.2f} m/s are left at the end.",
        f"The dynamic mode needs delta_f (1 + 1/gamma) > eta² to be reached; here {delta * (1 + 1 / gamma):.2f} < "
        f"{eta * eta:.2f}: as printed it never is, but at steps in which one period overshoots the threshold.",
        "Only the repulsive reading A leaves a formation with spacings beyond r0 unbiased; not cut, phi_s draws the V "
        "together; with the printed sign vehicles fall into each other.",
    ]
    fig, axes = panels(1, 2, 7.2, 3.6, sharey=True)
    for k, (name, setup) in enumerate(_cases(config, "own").items()):
        flight = run(setup, seeds[0])
        axes[0, 0].plot(flight.time_s, np.linalg.norm(flight.velocity_m_s.mean(axis=1), axis=1), color=CYCLE[k],
                        label=name.split(":")[0], ls=("-", "--", "-.", ":")[k % 4],
                        lw=2.4 if name.startswith(("V0", "V1:")) else 1.2)  # fmt: skip
    for k, (name, setup) in enumerate(_cases(config, "holds").items()):
        flight = run(setup, seeds[0])
        axes[0, 1].plot(flight.time_s, np.linalg.norm(flight.velocity_m_s.mean(axis=1), axis=1), color=CYCLE[k],
                        ls=("-", "--", "-.", ":")[k % 4], label=name.split("(")[0].split(",")[0])  # fmt: skip
    axes[0, 0].set(xlabel="time (s)", ylabel="mean speed (m/s)", title="whose state, zero-order hold", ylim=(0, 1.0))
    axes[0, 1].set(xlabel="time (s)", title="what is held, own state true")
    for ax in axes.flat:
        ax.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2)
    outcome.figures.append(
        Figure(
            "readings_braking", f"Mean speed under each reading of Eq. (2), seed {seeds[0]}: 0.8 m/s at the start.", fig
        )
    )
    return outcome
