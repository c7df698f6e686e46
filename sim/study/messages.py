"""What the messages of a whole flight are for: the shipped fleet.toml in lockstep, counted by cause, with near mode,
without it and at a fixed 20 Hz."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from companion.config import FleetConfig, load
from companion.core.values import Phase
from companion.errors import ConfigError
from companion.vehicle.publisher import CAUSES
from sim.lockstep.lockstep import Lockstep
from sim.lockstep.network import NetworkParameters
from sim.measures import minimum_distance_m
from sim.study.common import FLYING_CODE, Column, Config, Outcome, Record, Table, table_of
from sim.study.never_near import NeverNear

TITLE = "Messages of the shipped fleet's flight, by cause"
FLEET = Path(__file__).parents[2] / "fleet.toml"
SOURCES = (*FLYING_CODE, FLEET)
REFERENCE_HZ = 20.0
BAR_PERCENT = 99.0
"""fewer messages than the reference while the plan is flown, with near mode"""
READY_S = 20.0
FLIGHT_S = 240.0


@dataclass(frozen=True, slots=True)
class Fleet:
    """What is changed of the shipped fleet."""

    vehicles: int
    """the first of them"""
    spacing_m: float
    loss: float
    delay_s: float


@dataclass(frozen=True, slots=True)
class Case:
    """One way to speak."""

    name: str
    near: bool
    periodic: bool
    """every 50 ms instead of the shipped trigger"""


def _config(fleet: Fleet, case: Case) -> FleetConfig:
    def change(tables: dict[str, Any]) -> None:
        tables["vehicle"] = tables["vehicle"][: fleet.vehicles]
        tables["formation"]["spacing_m"] = fleet.spacing_m
        if case.periodic:
            tables["trigger"].update(kind="periodic", period_s=1.0 / REFERENCE_HZ)

    return load(FLEET, change)


def _count(ls: Lockstep) -> Counter[str]:
    total: Counter[str] = Counter()
    for v in ls.vehicles.values():
        total.update(v.agent.publisher.sent_because)
    return total


def fly(fleet: Fleet, case: Case, seed: int) -> Record:
    """One flight from take-off until all have landed: messages by cause, all and while the plan is flown."""
    ls = Lockstep(
        _config(fleet, case), seed=seed, network=NetworkParameters(delay_s=fleet.delay_s, loss=fleet.loss)
    )  # fmt: skip
    if not case.near:
        for v in ls.vehicles.values():
            v.agent.publisher.near = NeverNear(v.agent.publisher.near.rate)
    ls.run_until_ready(READY_S)
    before, began_ns = _count(ls), ls.now_ns
    ls.command(b'{"verb":"takeoff"}')
    marks = []
    for phases in ((Phase.MOVING,), (Phase.LANDING, Phase.LANDED), (Phase.LANDED,)):
        ls.run_until(began_ns * 1e-9 + FLIGHT_S, lambda p=phases: ls.all_in(*p))  # type: ignore[misc]
        if not ls.all_in(*phases):
            raise ConfigError(f"messages: {FLIGHT_S:g} s after take-off not all are {phases[-1].name}: {ls.phases()}")
        marks.append((ls.now_ns, _count(ls)))
    (moving_ns, moving), (landing_ns, landing), (ended_ns, ended) = marks
    rows = ls.truth().reshape(-1, len(ls.vehicles))
    flown = rows["position_ned_m"][(rows["landed_state"] == 2).all(axis=1)]
    seconds = (landing_ns - moving_ns) * 1e-9
    steady = {c: landing[c] - moving[c] for c in CAUSES}
    return {
        "whole": {c: ended[c] - before[c] for c in CAUSES},
        "steady": steady,
        "whole_percent": _fewer(sum((ended - before).values()), (ended_ns - began_ns) * 1e-9, len(ls.vehicles)),
        "steady_percent": _fewer(sum(steady.values()), seconds, len(ls.vehicles)),
        "least_m": min((minimum_distance_m(p) for p in flown), default=float("nan")),
        "looks": ls.near_bound.looks,
        "exceeded": ls.near_bound.exceeded,
        "worst": ls.near_bound.worst,
    }


def _fewer(messages: int, seconds: float, vehicles: int) -> float:
    return 100.0 * (1.0 - messages / (REFERENCE_HZ * seconds * vehicles))


def piece(config: Config, seed: int) -> Record:
    """Every case under one seed."""
    fleet = table_of(config, "fleet", Fleet)
    return {"cases": [fly(fleet, Case(**c), seed) for c in config.values["case"]]}


def finish(config: Config, pieces: Sequence[Record], seeds: Sequence[int]) -> Outcome:
    """Messages of a flight by cause, for each case."""
    outcome = Outcome()
    rows: list[Record] = []
    for k, given in enumerate(config.values["case"]):
        mine = [p["cases"][k] for p in pieces]
        for part in ("whole", "steady"):
            rows.append({
                "case": given["name"], "part": {"whole": "take-off to landing", "steady": "plan"}[part],
                **{c: float(np.mean([m[part][c] for m in mine])) for c in CAUSES},
                "percent": float(np.mean([m[f"{part}_percent"] for m in mine])),
                "least_m": min(m["least_m"] for m in mine),
                "exceeded": f"{sum(m['exceeded'] for m in mine)} of {sum(m['looks'] for m in mine)}",
            })  # fmt: skip
            if given["near"] and not given["periodic"] and part == "steady" and not rows[-1]["percent"] >= BAR_PERCENT:
                outcome.broken = f"{rows[-1]['percent']:.2f} % fewer messages than 20 Hz, must be {BAR_PERCENT:g} %"
    outcome.tables.append(
        Table(
            "messages_table", TITLE, (
                Column("case", "case"), Column("part", "part of the flight"), *(Column(c, c, 1) for c in CAUSES),
                Column("percent", "fewer than 20 Hz (%)", 2), Column("least_m", "least distance (m)", 2),
                Column("exceeded", "near peers beyond their bound"),
            ),
            rows, f"State messages of all vehicles, mean of {len(seeds)} flights; the other columns of all flights.",
        )
    )  # fmt: skip
    outcome.values["rows"] = rows
    return outcome
