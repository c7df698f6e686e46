"""Flight without a plan, in lockstep with real agents: `python -m tests.bench.leaderless turn`, `hover` or `planned`.

`turn`: ten vehicles of the shipped file fly 1 m/s north by what their neighbours tell; those informed turn 90 degrees
in 6 s. How long until the mean velocity, over a second, is and stays within 0.1 m/s of their wish, with which messages;
gusts alone move it by some 0.03 m/s. `--speaks` takes a null model in the trigger's place: `heartbeats` alone, or a
period in seconds. `hover`: nobody is informed. `planned`: the same ten with a plan, to compare with. `--law` takes
another law.
"""

from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import typer

from companion.config import FleetConfig, load
from companion.core.monitor import PeerMotion
from companion.core.trigger.base import Situation
from companion.core.trigger.periodic import PeriodicTrigger
from companion.core.values import Phase
from sim.lockstep.bound_count import BoundCount
from sim.lockstep.clockwork import UTC_AT_START_NS
from sim.lockstep.lockstep import Lockstep

ROOT = Path(__file__).resolve().parents[2]
STRAIGHT_S, AFTER_S = 25.0, 40.0
LEGS = (
    {"kind": "velocity", "north_m_s": 1.0, "duration_s": STRAIGHT_S},
    {"kind": "turn", "rate_deg_s": 30.0, "angle_deg": 90.0},
    {"kind": "velocity", "east_m_s": 1.0, "duration_s": 200.0},
)
WITHIN_M_S, MEAN_S = 0.1, 1.0
PLANNED_S = 15.0
PLANNED = (
    {"kind": "velocity", "north_m_s": 1.0, "duration_s": PLANNED_S},
    {"kind": "turn", "rate_deg_s": 6.0, "angle_deg": 90.0},
    {"kind": "velocity", "east_m_s": 1.0, "duration_s": 200.0},
)
Array = npt.NDArray[Any]
Law = Annotated[str, typer.Option(help="law.kind")]
Vehicles = Annotated[int, typer.Option(help="the first so many of the file")]
app = typer.Typer(no_args_is_help=True, add_completion=False, help=__doc__)


class Silent:
    """Never fires: heartbeats alone are left."""

    waits = True
    cause = "none"

    def fires(self, now: Situation) -> bool:
        """Never."""
        return False

    def error_bound_m(self, motion: PeerMotion) -> float:
        """Not asked for: the safety radius stays the configuration's."""
        raise NotImplementedError


class Figures(NamedTuple):
    """Of a part of a flight."""

    seconds: Array
    mean_velocity: Array
    """of all vehicles, on the level, by row (m/s)"""
    formation_error_m: float
    least_distance_m: float
    fewer_percent: float
    """messages than at 20 Hz"""
    prediction_error_m: float
    """the worst, of a vehicle by another"""
    exceeded: int
    """how many predictions were farther off than their bound"""


def flown_free(informed: list[int], seed: int, speaks: str, law: str, vehicles: int) -> tuple[Lockstep, float]:
    """A fleet that has just begun to fly free, and when it did (s)."""
    plan = {"kind": "none", "informed": informed, "legs": list(LEGS) if informed else []}
    ls = moving(plan, seed, speaks, law, vehicles)
    free_ns = ls.vehicles[1].agent.history.newest.free_from_ns
    assert free_ns is not None, "the fleet has not come to fly free"
    return ls, (free_ns - UTC_AT_START_NS) * 1e-9


def moving(plan: dict[str, Any], seed: int, speaks: str, law: str, vehicles: int) -> Lockstep:
    """A fleet that has formed and begins to move; what it was wrong by before is forgotten."""

    def change(tables: dict[str, Any]) -> None:
        del tables["fence"]
        tables["plan"] = plan
        tables["law"]["kind"] = law
        tables["vehicle"] = tables["vehicle"][:vehicles]

    config: FleetConfig = load(ROOT / "fleet.toml", change)
    ls = Lockstep(config, seed=seed)
    if speaks != "trigger":
        for vehicle in ls.vehicles.values():
            vehicle.agent.publisher.trigger = Silent() if speaks == "heartbeats" else PeriodicTrigger(float(speaks))
    ls.run_until(3.0)
    ls.run_until_ready(60.0)
    ls.command(b'{"verb":"takeoff"}')
    ls.run_until(200.0, lambda: ls.all_in(Phase.MOVING))
    ls.bound = BoundCount()
    return ls


def figures(ls: Lockstep, from_s: float, to_s: float) -> Figures:
    """By the vehicles' true motion."""
    ids = list(ls.vehicles)
    rows = ls.truth().reshape(-1, len(ids))
    s = (rows["time_unix_ns"][:, 0] - UTC_AT_START_NS) * 1e-9
    part = (s >= from_s) & (s < to_s)
    p, v = (rows[part][x].astype(float) for x in ("position_ned_m", "velocity_ned_m_s"))
    motion = ls.vehicles[ids[0]].agent.history.newest
    slots = np.array([motion.reference(i, motion.blend_end_ns).position_ned_m for i in ids])
    e = p - slots
    e -= e.mean(axis=1, keepdims=True)
    a, b = np.triu_indices(len(ids), 1)
    sent = sum(m.topic == "state" and from_s <= m.time_ns * 1e-9 < to_s for m in ls.sent)
    return Figures(
        s[part],
        v[:, :, :2].mean(axis=1),
        float(np.sqrt(np.square(e).sum(axis=2).mean())),
        float(np.linalg.norm(p[:, a] - p[:, b], axis=2).min()),
        100.0 * (1.0 - sent / (len(ids) * 20.0 * (to_s - from_s))),
        ls.bound.error_max_m,
        ls.bound.exceeded,
    )


def told(f: Figures) -> str:
    """What every flight is judged by."""
    return (
        f"F {f.formation_error_m:.3f} m, least distance {f.least_distance_m:.2f} m, "
        f"{f.fewer_percent:.2f} % fewer messages than at 20 Hz, worst prediction error {f.prediction_error_m:.2f} m "
        f"({f.exceeded} beyond their bound)"
    )


@app.command()
def turn(
    seed: Annotated[int, typer.Option(help="of noise and gusts")] = 200,
    informed: Annotated[str, typer.Option(help="ids, with commas")] = "3,7",
    speaks: Annotated[str, typer.Option(help="trigger, heartbeats, or a period in seconds")] = "trigger",
    law: Law = "starling",
    vehicles: Vehicles = 10,
) -> None:
    """Those informed turn; the others follow by what they are told."""
    ids = [int(i) for i in informed.split(",")]
    ls, free_s = flown_free(ids, seed, speaks, law, vehicles)
    turn_s = free_s + STRAIGHT_S
    ls.run_until(turn_s + AFTER_S)
    f = figures(ls, turn_s, turn_s + AFTER_S)
    wish = ls.vehicles[ids[0]].agent.agreement.wish
    assert wish is not None
    wanted = np.array([wish.at(round(t * 1e9) + UTC_AT_START_NS)[0][:2] for t in f.seconds])
    count = round(MEAN_S / (f.seconds[1] - f.seconds[0]))
    kernel = np.ones(count) / count
    off_m_s = np.stack([np.convolve(v, kernel, mode="valid") for v in (f.mean_velocity - wanted).T])
    ends_s = f.seconds[count - 1 :]
    beyond = np.flatnonzero(np.linalg.norm(off_m_s, axis=0) > WITHIN_M_S)
    after = f"{ends_s[beyond[-1]] - turn_s:.1f} s" if len(beyond) and beyond[-1] < len(ends_s) - count else "not"
    typer.echo(
        f"{law}, {vehicles} vehicles, seed {seed}, informed {informed}, {speaks}: "
        f"mean velocity within {WITHIN_M_S} m/s after {after}, {told(f)}"
    )


@app.command()
def hover(
    seed: Annotated[int, typer.Option(help="of noise and gusts")] = 200,
    seconds: Annotated[float, typer.Option(help="of flight")] = 300.0,
    law: Law = "starling",
    vehicles: Vehicles = 10,
) -> None:
    """Nobody is informed: how far the mean velocity drifts."""
    ls, free_s = flown_free([], seed, "trigger", law, vehicles)
    ls.run_until(free_s + seconds)
    f = figures(ls, free_s + 3.0, free_s + seconds)
    drift = float(np.linalg.norm(f.mean_velocity.mean(axis=0)))
    typer.echo(f"{law}, {vehicles} vehicles, seed {seed}, {seconds:g} s: mean velocity {drift:.4f} m/s, {told(f)}")


@app.command()
def planned(
    seed: Annotated[int, typer.Option(help="of noise and gusts")] = 200,
    speaks: Annotated[str, typer.Option(help="trigger, heartbeats, or a period in seconds")] = "trigger",
    law: Law = "starling",
    vehicles: Vehicles = 10,
) -> None:
    """All share a plan: straight on, and a turn of 90 degrees in 15 s."""
    ls = moving({"legs": list(PLANNED)}, seed, speaks, law, vehicles)
    begin_s = (ls.vehicles[1].agent.history.newest.legs_start_ns - UTC_AT_START_NS) * 1e-9
    turn_s, end_s = begin_s + PLANNED_S, begin_s + PLANNED_S + 20.0
    ls.run_until(end_s)
    for name, from_s, to_s in (("straight", begin_s + 1.0, turn_s), ("turn and 5 s on", turn_s, end_s)):
        typer.echo(
            f"{law}, {vehicles} vehicles, seed {seed}, {speaks}, planned, {name}: {told(figures(ls, from_s, to_s))}"
        )


if __name__ == "__main__":
    app()
