"""Fault campaign: whole flights of ten real agents in lockstep, one to three faults each, drawn by the seed."""

import json
import sys
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from companion.config import FleetConfig
from companion.config.file import parse
from companion.core.events import FailsafeActed, PhaseChanged
from companion.core.failsafe import Failsafe
from companion.core.safety.filter import COLLISION_DISTANCE_M as COLLISION_M
from companion.core.values import FLYING_PHASES, Instant, Phase
from companion.errors import ConfigError
from companion.wire.mavlink import ON_GROUND
from companion.wire.px4 import Px4Mode
from sim.autopilot.faults import Fault, FaultKind
from sim.lockstep.clockwork import Vehicle
from sim.lockstep.lockstep import Lockstep
from sim.lockstep.network import NetworkParameters
from sim.study.attacks import PLANS, STATES, forged_plan, forged_state
from sim.study.common import FLYING_CODE, Column, Config, Outcome, Record, Table, load_config, proportion_text, table_of

TITLE = "Fault campaign: flights with one to three faults each"
SOURCES = FLYING_CODE
READY_S = 60.0
ESTIMATE_FAULTS = frozenset({"gps_lost", "position_frozen", "estimator_reset", "noise"})
"""after these a vehicle does not know where it is, and nobody can: distance and fence are not judged for it"""
HANDED_OVER = frozenset({Px4Mode.AUTO_LOITER, Px4Mode.POSCTL})
"""the autopilot's hold, and the pilot's: who flies in them without a companion is in somebody's hands"""
_F = Failsafe
OF_THE_FLEET = frozenset({_F.MISSING, _F.ALONE, _F.DEAF, _F.ALONE_FOR_LONG, _F.DETACHED_FOR_LONG})
"""failsafes that a fault of another, or of the network, explains"""
_NO_POSITION = {_F.POSITION_LOST, _F.POSITION_JUMPED, _F.AUTOPILOT, _F.NOT_ARMED, _F.NO_TAKE_OFF}
"""no position, then one elsewhere; without setpoints the autopilot acts too"""
EXPLAINED: dict[str, frozenset[Failsafe]] = {
    kind: OF_THE_FLEET | own
    for kind, own in {
        "gps_lost": _NO_POSITION | {_F.POSITION_JUMPS, _F.COVARIANCE},
        "position_frozen": _NO_POSITION | {_F.PILOT},
        "estimator_reset": {_F.POSITION_JUMPED},
        "noise": {_F.POSITION_JUMPED, _F.POSITION_JUMPS},
        "low_battery": {_F.BATTERY_LOW, _F.BATTERY_CRITICAL, _F.NOT_ARMED},
        "reboot": _NO_POSITION | {_F.HEARTBEAT},
        "mute": _NO_POSITION | {_F.HEARTBEAT},
        "pilot_takeover": {_F.PILOT, _F.NOT_ARMED},
        "pilot_sticks": {_F.PILOT, _F.NOT_ARMED},
        "rc_kill": {_F.POSITION_JUMPED, _F.NOT_ARMED},
        "slow_link": _NO_POSITION | {_F.HEARTBEAT},
        "killed": set(),
        "restarted": set(),
        "stalled": {_F.AUTOPILOT},
        "partition": set(),
        "states_lost": set(),
        "restarted_without_line": set(),
        "second_companion": set(),
        "forged_plan": set(),
        "forged_digest": set(),
    }.items()
}
"""fault -> the failsafes of the same vehicle that it explains, from when it comes on. Who falls strikes the ground; who
hovers where its frozen position is not believes that a pilot ended its climb."""
NETWORK_KINDS = frozenset({"partition"})
"""of the network as a whole, and of no vehicle"""
FORGED_EVERY_S = 0.5
"""a lie is told again and again"""
FALLS = frozenset({"rc_kill", "reboot"})
"""the motors stop"""


@dataclass(frozen=True, slots=True)
class Flight:
    """What is the same in every flight."""

    vehicles: int
    altitude_m: float
    seconds: float
    faults_from_s: float
    faults_to_s: float
    most_faults: int
    kinds: tuple[str, ...]
    """that are drawn; none named: all"""
    operator_s: float
    """after the take-off command: an operator lands who flies still, in flights with a forged plan"""
    loss: float
    delay_s: float
    fence_radius_m: float
    fence_floor_m: float
    fence_ceiling_m: float


@dataclass(frozen=True, slots=True)
class Drawn:
    """One fault of one flight."""

    at_s: float
    """after the take-off command"""
    vehicle_id: int
    """0: the network"""
    kind: str
    duration_s: float
    magnitude: float | str | None = None
    """how much; or in which way, where a kind has several"""


def flight_of(config: Config) -> Flight:
    """The set-up's flight; a missing or unknown key is refused, and a kind that there is not."""
    flight = table_of(config, "flight", Flight)
    if unknown := sorted(set(flight.kinds) - set(EXPLAINED)):
        raise ConfigError(
            f"{config.name}.toml: $.flight.kinds: there is no {', '.join(unknown)}; known are {', '.join(EXPLAINED)}"
        )
    return flight


def drawn_faults(flight: Flight, seed: int) -> list[Drawn]:
    """The faults of a seed, in the order of their times.

    Every fault draws from a stream of its own, and its kind is the one whose own number is largest: another kind
    changes those faults alone that become of it, and in which order the kinds are written changes nothing.
    """
    faults = []
    for k in range(Random(f"campaign/{seed}").randint(1, flight.most_faults)):
        kind = max(sorted(flight.kinds or EXPLAINED), key=lambda kind: Random(f"campaign/{seed}/{k}/{kind}").random())
        random = Random(f"campaign/{seed}/{k}")
        at_s = random.uniform(flight.faults_from_s, flight.faults_to_s)
        i = random.randint(1, flight.vehicles)
        duration_s = random.choice((0.7, 3.0, 10.0, 1000.0))
        faults.append(Drawn(at_s, 0 if kind in NETWORK_KINDS else i, kind, duration_s, _magnitude(kind, random)))
    return sorted(faults, key=lambda f: f.at_s)


def _magnitude(kind: str, random: Random) -> float | str | None:
    match kind:
        case "noise":
            return random.uniform(0.2, 1.0)
        case "low_battery":
            return random.choice((0.05, 0.15))
        case "states_lost":
            return random.choice(("by one: states", "by one: states and plans", "by all: states"))
        case "second_companion":
            return random.choice(("on its line", "on another's line"))
        case "forged_plan":
            return random.choice(tuple(PLANS))
        case "forged_digest":
            return random.choice(tuple(STATES))
    return None


def _fleet(flight: Flight, missing: str) -> FleetConfig:
    return parse(
        {
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
        },
        "campaign.toml",
    )


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
    failsafes = [(round(s - began_s, 3), i, what) for s, i, what in _failsafes(ls)]
    return {
        "faults": [[round(f.at_s, 3), f.vehicle_id, f.kind, f.duration_s, f.magnitude] for f in faults],
        **_distances(ls, faults, began_s),
        **_breach(ls, faults, flight, began_s),
        "raised": raised,
        "operator_landed": landed,
        "stuck": [] if raised else _stuck(ls),
        "left_in_hold": [i for i, v in ls.vehicles.items() if _orphan(v)],
        "unexplained": [(s, i, what.value) for s, i, what in failsafes if not _explained((s, i, what), faults)],
        "failsafes": [(s, i, what.value) for s, i, what in failsafes],
        "formed": any(isinstance(e, PhaseChanged) and e.after is Phase.FORMED for _, _, e in ls.events),
        "flew_the_plan": any(isinstance(e, PhaseChanged) and e.after is Phase.MOVING for _, _, e in ls.events),
        "ended_after_s": ls.now_ns * 1e-9 - began_s,
    }


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


def _failsafes(ls: Lockstep) -> list[tuple[float, int, Failsafe]]:
    """Every failsafe that a vehicle told of: when (s), whose, which."""
    since_ns = ls.now.fleet_ns - ls.now_ns
    return [((t - since_ns) * 1e-9, i, e.failsafe) for t, i, e in ls.events if isinstance(e, FailsafeActed)]


def _explained(told: tuple[float, int, Failsafe], faults: Sequence[Drawn]) -> bool:
    """Whether a fault that came before it explains a failsafe."""
    at_s, i, failsafe = told
    before = [f for f in faults if f.at_s <= at_s]
    return any(failsafe in (EXPLAINED[f.kind] if f.vehicle_id == i else OF_THE_FLEET) for f in before)


def _rows(ls: Lockstep, began_s: float) -> tuple[Any, Any]:
    rows = ls.truth().reshape(-1, len(ls.vehicles))
    seconds = (rows["time_unix_ns"][:, 0] - (ls.now.fleet_ns - ls.now_ns)) * 1e-9 - began_s
    return rows[seconds >= 0.0], seconds[seconds >= 0.0]


def _since(ids: Sequence[int], faults: Sequence[Drawn], kinds: frozenset[str]) -> Any:
    """When each vehicle had its first fault of some kinds (s after the command); infinite without one."""
    since = np.full(len(ids), np.inf)
    for f in faults:
        if f.kind in kinds:
            k = ids.index(f.vehicle_id)
            since[k] = min(since[k], f.at_s)
    return since


def _distances(ls: Lockstep, faults: Sequence[Drawn], began_s: float) -> Record:
    """Least true distances with at least one of the pair in the air: of all, and of those who could know."""
    rows, seconds = _rows(ls, began_s)
    p, ids = rows["position_ned_m"], list(ls.vehicles)
    a, b = np.triu_indices(len(ids), 1)
    distance = np.linalg.norm(p[:, a] - p[:, b], axis=2)
    flying = rows["landed_state"] != ON_GROUND
    distance[~(flying[:, a] | flying[:, b])] = np.inf
    blind = seconds[:, None] >= _since(ids, faults, ESTIMATE_FAULTS)[None, :]
    known = np.where(blind[:, a] | blind[:, b], np.inf, distance)
    at, pair = np.unravel_index(int(known.argmin()), known.shape)
    return {
        "minimum_distance_m": float(known.min()),
        "minimum_of": [round(float(seconds[at]), 2), ids[a[pair]], ids[b[pair]]],
        "minimum_with_the_blind_m": float(distance.min()),
    }


def _breach(ls: Lockstep, faults: Sequence[Drawn], flight: Flight, began_s: float) -> Record:
    """The farthest that a vehicle on our setpoints, or on the last of them, was beyond the fence (m); negative inside.

    The floor is for vehicles in formation: OFFBOARD begins above it and ends before a landing. Not of one that falls.
    """
    rows, seconds = _rows(ls, began_s)
    p = rows["position_ned_m"]
    level, height = np.hypot(p[:, :, 0], p[:, :, 1]), -p[:, :, 2]
    beyond = np.max([level - flight.fence_radius_m, height - flight.fence_ceiling_m, flight.fence_floor_m - height], 0)
    ours = (rows["custom_mode"] == Px4Mode.OFFBOARD) & (rows["landed_state"] != ON_GROUND)
    judged = ours & (seconds[:, None] < _since(list(ls.vehicles), faults, ESTIMATE_FAULTS | FALLS)[None, :])
    return {"beyond_fence_m": float(np.where(judged, beyond, -np.inf).max())}


def piece(config: Config, seed: int) -> Record:
    """One seed's flight."""
    return fly(flight_of(config), seed)


def finish(config: Config, pieces: Sequence[Record], seeds: Sequence[int]) -> Outcome:
    """What happened in how many of the flights, with intervals; every flight in which something did, by its seed."""
    n = len(pieces)
    judged = {
        f"collisions (below {COLLISION_M} m, places known)": [p["minimum_distance_m"] < COLLISION_M for p in pieces],
        "fence breaches": [p["beyond_fence_m"] > 0.0 for p in pieces],
        "stuck flights": [bool(p["stuck"]) for p in pieces],
        "flights with an unexplained failsafe": [bool(p["unexplained"]) for p in pieces],
        "flights in which a message ended a companion": [bool(p["raised"]) for p in pieces],
    }
    blind = [p["minimum_with_the_blind_m"] < COLLISION_M for p in pieces]
    rows: list[Record] = [
        {"what": what, "flights": proportion_text(sum(came), n), "count": sum(came)} for what, came in judged.items()
    ]
    rows.append({
        "what": "below it with a vehicle that had lost its place (not judged)",
        "flights": proportion_text(sum(blind), n), "count": sum(blind),
    })  # fmt: skip
    held = [bool(p["left_in_hold"]) for p in pieces]
    rows.append({
        "what": "a vehicle ended in its autopilot's hold or with its pilot: taken over, mute, companion ended "
        "or started anew (not judged)",
        "flights": proportion_text(sum(held), n), "count": sum(held),
    })  # fmt: skip
    landed = [bool(p["operator_landed"]) for p in pieces]
    rows.append({
        "what": "an operator landed those whom a forged plan within all rules kept in the air (not judged)",
        "flights": proportion_text(sum(landed), n), "count": sum(landed),
    })  # fmt: skip
    rows += [
        {"what": what, "flights": proportion_text(sum(p[key] for p in pieces), n), "count": sum(p[key] for p in pieces)}
        for key, what in (("formed", "formed"), ("flew_the_plan", "flew the plan's legs (the others landed before)"))
    ]
    outcome = Outcome()
    outcome.tables.append(
        Table("campaign", f"{n} flights of {flight_of(config).vehicles} vehicles", (
            Column("what", "what"), Column("flights", "flights"),
        ), rows, "Real agents on stub autopilots in lockstep; the faults are drawn by the seed.")
    )  # fmt: skip
    bad = [
        {"seed": seed, "minimum_m": p["minimum_distance_m"], "faults": p["faults"], "stuck": p["stuck"],
         "unexplained": p["unexplained"], "beyond_fence_m": p["beyond_fence_m"], "minimum_of": p["minimum_of"],
         "raised": p["raised"]}
        for k, (seed, p) in enumerate(zip(seeds, pieces, strict=True))
        if any(came[k] for came in judged.values())
    ]  # fmt: skip
    kinds = Counter(kind for p in pieces for _, _, kind, _, _ in p["faults"])
    taken = Counter[str]()
    for p in pieces:
        taken.update(failsafe for _, _, failsafe in p["failsafes"])
    outcome.tables.append(
        Table("campaign_faults", "What was injected", (Column("kind", "fault"), Column("count", "times", 0)), [
            {"kind": kind, "count": count} for kind, count in kinds.most_common()
        ])
    )  # fmt: skip
    outcome.tables.append(
        Table("campaign_failsafes", "What the vehicles did", (
            Column("failsafe", "failsafe"), Column("count", "times", 0),
        ), [{"failsafe": name, "count": count} for name, count in taken.most_common()])
    )  # fmt: skip
    least = min(p["minimum_distance_m"] for p in pieces)
    outcome.findings.append(
        f"{len(bad)} of {n} flights broke a rule; "
        f"the least distance of vehicles that knew where they were is {least:.2f} m."
    )
    flights = [{"seed": seed, **p} for seed, p in zip(seeds, pieces, strict=True)]
    outcome.values |= {"rows": rows, "broken": bad, "least_m": least, "flights": flights}
    if bad:
        outcome.broken = f"{len(bad)} of {n} flights broke a rule, of seeds {', '.join(str(b['seed']) for b in bad)}"
    return outcome


if __name__ == "__main__":
    # One flight alone, with all that its vehicles told: python -m sim.study.campaign SEED
    for number in sys.argv[1:]:
        record = fly(flight_of(load_config("campaign")), int(number), tell=print)
        sys.stdout.write(f"{json.dumps(record, indent=1)}\n")
