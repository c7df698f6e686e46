"""What is judged of a campaign's flight, whoever flew it: distances, fence, failsafes; and the tables."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from companion.core.events import Event, FailsafeActed, PhaseChanged
from companion.core.safety.filter import COLLISION_DISTANCE_M as COLLISION_M
from companion.core.values import Phase
from companion.wire.mavlink import ON_GROUND
from companion.wire.px4 import Px4Mode
from sim.study.campaign_faults import ESTIMATE_FAULTS, FALLS, Drawn, Flight, explained
from sim.study.common import Column, Outcome, Record, Table, proportion_text


@dataclass(frozen=True, slots=True)
class Seen:
    """What there was to see of a flight; times in seconds after the take-off command."""

    ids: list[int]
    seconds: npt.NDArray[Any]
    """(T,)"""
    rows: npt.NDArray[Any]
    """(T, N): position_ned_m in truth, NaN where nobody knows; landed_state, custom_mode"""
    events: Sequence[tuple[float, int, Event]]
    """(s, vehicle, what it told)"""

    @property
    def failsafes(self) -> list[tuple[float, int, FailsafeActed]]:
        """Every failsafe that a vehicle acted on."""
        return [(s, i, e) for s, i, e in self.events if isinstance(e, FailsafeActed)]


def judged(seen: Seen, faults: Sequence[Drawn], flight: Flight) -> Record:
    """All that does not depend on who flew it."""
    told = [(round(s, 3), i, e.failsafe) for s, i, e in seen.failsafes]
    phases = {e.after for _, _, e in seen.events if isinstance(e, PhaseChanged)}
    return {
        "faults": [[round(f.at_s, 3), f.vehicle_id, f.kind, f.duration_s, f.magnitude] for f in faults],
        **_distances(seen, faults),
        **_breach(seen, faults, flight),
        "unexplained": [(s, i, what.value) for s, i, what in told if not explained((s, i, what), faults)],
        "failsafes": [(s, i, what.value) for s, i, what in told],
        "formed": Phase.FORMED in phases,
        "flew_the_plan": Phase.MOVING in phases,
    }


def _since(ids: Sequence[int], faults: Sequence[Drawn], kinds: frozenset[str]) -> Any:
    """When each vehicle had its first fault of some kinds (s after the command); infinite without one."""
    since = np.full(len(ids), np.inf)
    for f in faults:
        if f.kind in kinds:
            k = ids.index(f.vehicle_id)
            since[k] = min(since[k], f.at_s)
    return since


def _distances(seen: Seen, faults: Sequence[Drawn]) -> Record:
    """Least true distances with at least one of the pair in the air: of all, and of those who could know."""
    p, ids, seconds = seen.rows["position_ned_m"], seen.ids, seen.seconds
    a, b = np.triu_indices(len(ids), 1)
    distance = np.linalg.norm(p[:, a] - p[:, b], axis=2)
    flying = seen.rows["landed_state"] != ON_GROUND
    distance[~(flying[:, a] | flying[:, b]) | np.isnan(distance)] = np.inf
    blind = seconds[:, None] >= _since(ids, faults, ESTIMATE_FAULTS)[None, :]
    known = np.where(blind[:, a] | blind[:, b], np.inf, distance)
    at, pair = np.unravel_index(int(known.argmin()), known.shape)
    return {
        "minimum_distance_m": float(known.min()),
        "minimum_of": [round(float(seconds[at]), 2), ids[a[pair]], ids[b[pair]]],
        "minimum_with_the_blind_m": float(distance.min()),
    }


def _breach(seen: Seen, faults: Sequence[Drawn], flight: Flight) -> Record:
    """The farthest that a vehicle on our setpoints, or on the last of them, was beyond the fence (m); negative inside.

    The floor is for vehicles in formation: OFFBOARD begins above it and ends before a landing. Not of one that falls.
    """
    p = seen.rows["position_ned_m"]
    level, height = np.hypot(p[:, :, 0], p[:, :, 1]), -p[:, :, 2]
    beyond = np.max([level - flight.fence_radius_m, height - flight.fence_ceiling_m, flight.fence_floor_m - height], 0)
    ours = (seen.rows["custom_mode"] == Px4Mode.OFFBOARD) & (seen.rows["landed_state"] != ON_GROUND)
    knew = seen.seconds[:, None] < _since(seen.ids, faults, ESTIMATE_FAULTS | FALLS)[None, :]
    return {"beyond_fence_m": float(np.where(ours & knew & ~np.isnan(beyond), beyond, -np.inf).max())}


def tables_of(flight: Flight, how: str, pieces: Sequence[Record], seeds: Sequence[int]) -> Outcome:
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
        Table("campaign", f"{n} flights of {flight.vehicles} vehicles", (
            Column("what", "what"), Column("flights", "flights"),
        ), rows, f"{how}; the faults are drawn by the seed.")
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
