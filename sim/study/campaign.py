"""Fault campaign: whole flights of ten real agents in lockstep, one to three faults each, drawn by the seed."""

import json
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

from companion.config import FleetConfig
from companion.config.file import parse
from companion.core.values import FLYING_PHASES, Instant, Phase
from companion.wire.mavlink import ON_GROUND
from sim.autopilot.faults import Fault, FaultKind
from sim.lockstep.clockwork import Vehicle
from sim.lockstep.lockstep import Lockstep
from sim.lockstep.network import NetworkParameters
from sim.study.attacks import forged_plan, forged_state
from sim.study.campaign_faults import HANDED_OVER, Drawn, Flight, drawn_faults, flight_of
from sim.study.campaign_judge import Seen, judged, tables_of
from sim.study.common import FLYING_CODE, Config, Outcome, Record, load_config

TITLE = "Fault campaign: flights with one to three faults each"
SOURCES = FLYING_CODE
READY_S = 60.0
FORGED_EVERY_S = 0.5
"""a lie is told again and again"""


def _fleet(flight: Flight, missing: str) -> FleetConfig:
    return parse(campaign_tables(flight, missing), "campaign.toml")


def campaign_tables(flight: Flight, missing: str) -> dict[str, Any]:
    """The fleet's file."""
    return {
        "fleet": {
            "name": "campaign",
            "origin": {"latitude_deg": 47.397742, "longitude_deg": 8.545594, "altitude_amsl_m": 488.0},
        },
        "formation": {"altitude_m": flight.altitude_m},
        "plan": {
            "then": "land",
            "legs": [
                {"kind": "velocity", "north_m_s": 1.0, "duration_s": 6.0},
                {"kind": "turn", "rate_deg_s": 9.0, "angle_deg": 45.0},
                {"kind": "hold", "duration_s": 1.0},
            ],
        },
        "limits": {"control_rate_hz": 25.0},
        "peers": {"wait_s": 25.0, "missing": missing},
        "fence": {
            "radius_m": flight.fence_radius_m,
            "floor_m": flight.fence_floor_m,
            "ceiling_m": flight.fence_ceiling_m,
        },
        "vehicle": [{"id": i} for i in range(1, flight.vehicles + 1)],
    }


@dataclass(frozen=True, slots=True)
class _Ear:
    """Who listens on the network: the last state that each vehicle told."""

    heard: dict[int, bytes]

    def listen(self, i: int, channel: str, _: Instant, body: bytes) -> None:
        """To every input and output of every agent; only states that are sent are kept."""
        if channel == "output/peer" and body.startswith(b"state\0"):
            self.heard[i] = body[6:]


def _moments(fault: Drawn, end_s: float) -> list[tuple[float, str, Drawn]]:
    """When something is done of a fault: it begins, is told again where it is a lie, and is healed."""
    ends_s = fault.at_s + fault.duration_s
    moments = [(fault.at_s, "begin", fault)]
    if fault.kind == "forged_digest":
        times = int((min(ends_s, end_s) - fault.at_s) / FORGED_EVERY_S)
        moments += [(fault.at_s + k * FORGED_EVERY_S, "begin", fault) for k in range(1, times + 1)]
    if fault.kind in ("partition", "states_lost", "second_companion"):
        moments.append((ends_s, "heal", fault))
    return moments


def _heal(ls: Lockstep, fault: Drawn, faults: Sequence[Drawn], at_s: float) -> None:
    match fault.kind:
        case "partition":
            ls.partition()
        case "second_companion":
            ls.remove_twin(fault.vehicle_id)
        case "states_lost":
            ls.restore_topics()
            for other in faults:
                if other.kind == "states_lost" and other.at_s <= at_s < other.at_s + other.duration_s:
                    _lose_states(ls, other)


def _lose_states(ls: Lockstep, fault: Drawn) -> None:
    way = str(fault.magnitude)
    receivers = (fault.vehicle_id,) if way.startswith("by one") else ()
    ls.drop_topic("state", *receivers)
    if way.endswith("plans"):
        ls.drop_topic("plan", *receivers)


def _inject(ls: Lockstep, fault: Drawn, random: Random, ear: _Ear) -> None:
    i = fault.vehicle_id
    match fault.kind:
        case "states_lost":
            _lose_states(ls, fault)
        case "restarted_without_line":
            if ls.vehicles[i].alive:
                ls.kill(i)
                ls.restart(i, line_dead_s=fault.duration_s)
        case "second_companion":
            others = [j for j in ls.vehicles if j != i]
            ls.add_twin(i, line_of=random.choice(others) if fault.magnitude == "on another's line" else None)
        case "forged_plan":
            newest = max((v.agent.history.newest for v in ls.vehicles.values()), key=lambda motion: motion.order)
            payload = forged_plan(str(fault.magnitude), newest, i, ls.now.fleet_ns, random)
            ls.inject_peer(f"fleet/{i}/plan", payload)
        case "forged_digest":
            lie = forged_state(str(fault.magnitude), ear.heard, i, ls.now.fleet_ns, random)
            if lie is not None:
                ls.inject_peer(f"fleet/{i}/state", lie)
        case "killed":
            if ls.vehicles[i].alive:
                ls.kill(i)
        case "restarted":
            if ls.vehicles[i].alive:
                ls.kill(i)
                ls.restart(i)
        case "stalled":
            ls.stall(i, min(fault.duration_s, 3.0))
        case "partition":
            ids = list(ls.vehicles)
            random.shuffle(ids)
            cut = random.randint(1, len(ids) - 1)
            ls.partition(ids[:cut], ids[cut:])
        case kind:
            assert not isinstance(fault.magnitude, str)
            ls.vehicles[i].autopilot.inject(Fault(FaultKind(kind), fault.magnitude, fault.duration_s))


def fly(flight: Flight, seed: int, tell: Callable[[str], None] = lambda _: None) -> Record:
    """One flight from take-off to the end of the last vehicle's; what was seen of it.

    `tell` is given a line for everything that happened.
    """
    config = _fleet(flight, Random(f"campaign/{seed}/missing").choice(("land", "continue")))
    faults = drawn_faults(flight, seed)
    ear = _Ear({})
    lies = any(f.kind == "forged_digest" for f in faults)
    ls = Lockstep(
        config, seed=seed, network=NetworkParameters(delay_s=flight.delay_s, loss=flight.loss),
        record=ear.listen if lies else None,
    )  # fmt: skip
    ls.run_until_ready(READY_S)
    answers = {i: json.loads(a) for i, a in ls.command(b'{"verb":"takeoff"}').items()}
    if len(answers) < flight.vehicles or not all(a["accepted"] for a in answers.values()):
        raise RuntimeError(f"seed {seed}: the take-off is refused before any fault: {answers}")
    began_s = ls.now_ns * 1e-9
    raised, landed = "", False
    try:
        landed = _suffer(ls, flight, faults, began_s, Random(f"campaign/{seed}/parts"), ear)
    except Exception as error:  # noqa: BLE001 - whatever an agent raises ends its companion: that is what is looked for
        at = traceback.extract_tb(error.__traceback__)[-1]
        raised = f"{type(error).__name__}: {error} ({Path(at.filename).name}:{at.lineno})"
    for s, i, note in ls.notes:
        tell(f"{s - began_s:8.2f} s  vehicle {i}: {note}")
    return {
        **judged(_seen(ls, began_s), faults, flight),
        "raised": raised,
        "operator_landed": landed,
        "stuck": [] if raised else _stuck(ls),
        "left_in_hold": [i for i, v in ls.vehicles.items() if _orphan(v)],
        "ended_after_s": ls.now_ns * 1e-9 - began_s,
    }


def _seen(ls: Lockstep, began_s: float) -> Seen:
    since_ns = ls.now.fleet_ns - ls.now_ns
    rows = ls.truth().reshape(-1, len(ls.vehicles))
    seconds = (rows["time_unix_ns"][:, 0] - since_ns) * 1e-9 - began_s
    events = [((t - since_ns) * 1e-9 - began_s, i, e) for t, i, e in ls.events]
    return Seen(list(ls.vehicles), seconds[seconds >= 0.0], rows[seconds >= 0.0], events)


def _suffer(
    ls: Lockstep, flight: Flight, faults: Sequence[Drawn], began_s: float, random: Random, ear: _Ear
) -> bool:  # fmt: skip
    """Fly to the end with the faults at their times; returns whether it took an operator to bring everybody down.

    A forged plan that keeps all rules is flown, and it may have no end: whoever reads it on a screen commands to land.
    """
    moments = [moment for fault in faults for moment in _moments(fault, flight.seconds)]
    if any(f.kind == "forged_plan" for f in faults):
        moments.append((flight.operator_s, "land", faults[0]))
    landed = False
    for at_s, what, fault in sorted(moments, key=lambda m: m[0]):
        if at_s >= flight.seconds:
            break
        later = at_s > max(f.at_s for f in faults)
        ls.run_until(began_s + at_s, (lambda: not _stuck(ls)) if later else None)
        if later and not _stuck(ls):
            break  # all faults have come, and the flight is over
        match what:
            case "heal":
                _heal(ls, fault, faults, at_s)
            case "land":
                ls.command(b'{"verb":"land"}')
                landed = True
            case _:
                _inject(ls, fault, random, ear)
    ls.run_until(began_s + flight.seconds, lambda: not _stuck(ls))
    return landed


def _stuck(ls: Lockstep) -> list[list[Any]]:
    """Vehicles that are on their way still: on our setpoints, waiting to take off, or coming down by themselves.

    A companion that ends or starts anew in the climb leaves its vehicle in the autopilot's hold, one that is taken over
    in the pilot's: that is handed over, and counted.
    """
    stuck: list[list[Any]] = []
    for i, v in ls.vehicles.items():
        ours = v.alive and v.agent.phase in FLYING_PHASES | {Phase.PREFLIGHT}
        if ours or (_orphan(v) and v.autopilot.truth().custom_mode not in HANDED_OVER):
            stuck.append([i, v.agent.phase.name.lower() if v.alive else "companion ended"])
    return stuck


def _orphan(v: Vehicle) -> bool:
    """In the air and nobody's companion steers it: its own has ended, was started anew, or has given it away."""
    steered = v.alive and v.agent.phase in FLYING_PHASES
    return not steered and v.autopilot.truth().landed_state != ON_GROUND


def piece(config: Config, seed: int) -> Record:
    """One seed's flight."""
    return fly(flight_of(config), seed)


def finish(config: Config, pieces: Sequence[Record], seeds: Sequence[int]) -> Outcome:
    """What happened in how many of the flights, with intervals; every flight in which something did, by its seed."""
    return tables_of(flight_of(config), "Real agents on stub autopilots in lockstep", pieces, seeds)


if __name__ == "__main__":
    # One flight alone, with all that its vehicles told: python -m sim.study.campaign SEED
    for number in sys.argv[1:]:
        record = fly(flight_of(load_config("campaign")), int(number), tell=print)
        sys.stdout.write(f"{json.dumps(record, indent=1)}\n")
