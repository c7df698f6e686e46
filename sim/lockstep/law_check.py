"""What a law, ours or another package's, must show before it is flown: `fleet law check NAME`.

Random states, the same ones twice, the time of a call, and two real agents in lockstep that the law itself sends
head-on at each other, since each is told the other's slot. All of it is with what flies; the form of our own that the
swarm compiles must give the same commands.
"""

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import dist, hypot, isfinite
from random import Random
from time import perf_counter
from typing import Any

from companion.config import FleetConfig
from companion.config.file import parse
from companion.core.frames import Ned
from companion.core.law.base import Law, Wanted
from companion.core.law.starling import StarlingLaw
from companion.core.safety.filter import COLLISION_DISTANCE_M
from companion.core.trajectory.fleet import Reference
from companion.core.values import Neighbour, VehicleState
from companion.vehicle.guest import LAW_RAISED
from sim.lockstep.lockstep import Lockstep
from sim.lockstep.network import NetworkParameters
from sim.lockstep.wrapped_law import WrappedLaw

STATES = 3000
SEEDS = (1, 2, 3)
CALL_MAX_US = 1000.0
"""of one call with fifteen neighbours: a twentieth of the control period at 50 Hz"""
SAME = 1e-9
"""compiled commands differ by no more than this part of what is summed"""
APART_M, ALTITUDE_M, MEETING_S = 12.0, 6.0, 15.0
LAG_S, DELAY_S = 0.3, 0.1


@dataclass(frozen=True, slots=True)
class Row:
    """One thing that must hold."""

    name: str
    value: str
    limit: str
    passed: bool


Scene = tuple[VehicleState, Reference, tuple[Neighbour, ...], bool]


def check(kind: str, values: Mapping[str, Any] | None = None) -> Iterator[Row]:
    """Every row for a kind of law, with these parameters or its own defaults. ConfigError if there is no such kind."""
    config = two_vehicles({**(values or {}), "kind": kind})
    fields = config.law.law(config.r0_m).fields
    scenes = [_scene(Random(f"{kind}/{k}"), len(fields)) for k in range(STATES)]
    first, failure = _answers(config, scenes)
    yield Row("calls that raised", failure or "none", "none", not failure)
    if failure:
        return
    numbers = [(*w.acceleration_ned_m_s2, *w.residual_ned_m, *told) for w, told in first]
    wrong = sum(not all(map(isfinite, n)) for n in numbers)
    yield Row("states without a finite answer", f"{wrong} of {STATES}", "0", wrong == 0)
    largest = max(hypot(*w.acceleration_ned_m_s2[:2]) for w, _ in first)
    most, within = config.law.a_max_m_s2, largest <= config.law.a_max_m_s2 * (1 + 1e-9)
    yield Row("largest acceleration (m/s^2)", f"{largest:.3f}", f"<= {most:g} (a_max_m_s2)", within)
    odd = sum(len(told) != len(fields) for _, told in first)
    yield Row("messages with other fields", f"{odd} of {STATES}", f"0 ({', '.join(fields) or 'none'})", odd == 0)
    again, _ = _answers(config, scenes)
    differ = sum(_bits(a) != _bits(b) for a, b in zip(first, again, strict=True))
    yield Row("states with other bits the second time", f"{differ} of {STATES}", "0", differ == 0)
    yield _timed(config, len(fields))
    yield _compiled(config, scenes)
    for seed in SEEDS:
        least_m, raised = head_on(config, seed)
        value = f"{least_m:.2f}" + (f", raised {raised} times" if raised else "")
        kept = least_m >= COLLISION_DISTANCE_M and not raised
        yield Row(f"head-on, least distance, seed {seed} (m)", value, f">= {COLLISION_DISTANCE_M:g}", kept)


def two_vehicles(law: Mapping[str, Any], **limits: Any) -> FleetConfig:
    """Two vehicles 12 m apart."""
    half = 0.5 * APART_M
    return parse(
        {
            "fleet": {"name": "law-check", "frame": "local"},
            "formation": {"altitude_m": ALTITUDE_M},
            "plan": {"automatic": False},
            "law": dict(law),
            "limits": limits,
            "stub": {"lag_s": LAG_S, "origin_scatter_m": 0.0},
            "vehicle": [{"id": 1, "pad_m": [-half, 0.0]}, {"id": 2, "pad_m": [half, 0.2]}],
        },
        "law check",
    )


def _scene(random: Random, fields: int) -> Scene:
    """A state of a vehicle and of up to fifteen neighbours: together, far apart, on one spot, lost, or of no moment."""

    def ned(scale: float) -> Ned:
        return Ned(*(random.gauss(0.0, scale) for _ in range(3)))

    scale = random.choice((0.0, 0.3, 3.0, 50.0))
    around = []
    for k in range(random.choice((0, 1, 2, 15))):
        lost = random.random() < 0.2
        formed = not lost and random.random() < 0.8
        told = tuple(random.gauss(0.0, 2.0) for _ in range(fields)) if random.random() < 0.9 else ()
        around.append(
            Neighbour(
                k + 2, ned(scale), ned(2.0), ned(4.0), random.uniform(0.0, 20.0), formed, formed, 0.5,
                ned(scale) if lost else None, ned(1.0), ned(0.3), told,
            )
        )  # fmt: skip
    ego = VehicleState(random.randrange(10**12), ned(scale), ned(2.0))
    reference = Reference(ned(scale), ned(1.0), ned(0.5), random.uniform(-3.0, 3.0))
    return ego, reference, tuple(around), random.random() < 0.1


def _answers(config: FleetConfig, scenes: Sequence[Scene]) -> tuple[list[tuple[Wanted, tuple[float, ...]]], str]:
    """What a new law says to each scene, and what it raised, if it did."""
    law = config.law.law(config.r0_m)
    answers = []
    try:
        law.reset()
        for ego, reference, around, alone in scenes:
            wanted, residual = law.command(ego, reference, around, alone=alone)
            told = tuple(map(float, law.tell()))
            answers.append((Wanted(Ned(*map(float, wanted)), Ned(*map(float, residual))), told))
    except Exception as error:  # noqa: BLE001 - what a law of another package raises is anything
        return answers, f"{type(error).__name__}: {error}"
    return answers, ""


def _bits(answer: tuple[Wanted, tuple[float, ...]]) -> bytes:
    numbers = (*answer[0].acceleration_ned_m_s2, *answer[0].residual_ned_m, *answer[1])
    return struct.pack(f"<{len(numbers)}d", *numbers)


def _timed(config: FleetConfig, fields: int) -> Row:
    law, random = config.law.law(config.r0_m), Random(7)
    scenes = [s for s in (_scene(random, fields) for _ in range(1000)) if len(s[2]) == 15][:200]
    times = []
    for ego, reference, around, alone in scenes:
        begin = perf_counter()
        law.command(ego, reference, around, alone=alone)
        times.append(1e6 * (perf_counter() - begin))
    median = sorted(times)[len(times) // 2]
    return Row("a call with 15 neighbours (us)", f"{median:.0f}", f"<= {CALL_MAX_US:g}", median <= CALL_MAX_US)


def _compiled(config: FleetConfig, scenes: Sequence[Scene]) -> Row:
    """Plain against compiled; a law that keeps a state of its own is compared call by call as well."""
    name, limit = "compiled differs by (of what is summed)", f"<= {SAME:g}"
    plain = config.law.law(config.r0_m)
    other = compiled_form(config.law.law(config.r0_m))
    if other is None:
        return Row(name, "not offered", limit, True)
    worst = 0.0
    for ego, reference, around, alone in scenes:
        a = plain.command(ego, reference, around, alone=alone)
        b = other.command(ego, reference, around, alone=alone)
        pairs = [*zip(a.acceleration_ned_m_s2, b.acceleration_ned_m_s2, strict=True)]
        pairs += zip(a.residual_ned_m, b.residual_ned_m, strict=True)
        size = 1.0 + max(abs(x) for x, _ in pairs) + sum(dist(ego.position_ned_m, n.position_ned_m) for n in around)
        worst = max(worst, *(abs(x - y) / size for x, y in pairs))
    return Row(name, f"{worst:.1e}", limit, worst <= SAME)


def compiled_form(law: Law) -> Law | None:
    """A law as the swarm compiles it: ours, where what compiles them is installed."""
    if not isinstance(law, StarlingLaw):
        return None
    try:
        from sim.swarm.rows import CompiledLaw
    except ModuleNotFoundError:
        return None
    return CompiledLaw(law.gains)


@dataclass(slots=True)
class OthersSlot(WrappedLaw):
    """A law that is told another's slot for its own, once `begun`: it flies head-on by itself."""

    begun: bool = False

    def command(
        self, ego: VehicleState, reference: Reference, neighbours: Sequence[Neighbour], *, alone: bool
    ) -> Wanted:
        """See `Law`."""
        if not self.begun or not neighbours:
            return self.law.command(ego, reference, neighbours, alone=alone)
        p, d = reference.position_ned_m, neighbours[0].offset_ned_m
        there = reference._replace(position_ned_m=Ned(p.north - d.north, p.east - d.east, p.down - d.down))
        around = [n._replace(offset_ned_m=Ned(*(-x for x in n.offset_ned_m))) for n in neighbours]
        return self.law.command(ego, there, around, alone=alone)


def head_on(config: FleetConfig, seed: int) -> tuple[float, int]:
    """Two vehicles that wait, each told the other's slot: their least distance (m), and how often a law raised.

    They meet with 0.3 s of lag and 0.1 s of delay.
    """
    fleet = Lockstep(config, seed=seed, network=NetworkParameters(delay_s=DELAY_S))
    laws = []
    for v in fleet.vehicles.values():
        v.agent.law = OthersSlot(v.agent.law)
        laws.append(v.agent.law)
    fleet.take_off()
    begin_ns = fleet.now.fleet_ns
    for law in laws:
        law.begun = True
    fleet.run_until(fleet.now_ns * 1e-9 + MEETING_S)
    rows = fleet.truth().reshape(-1, 2)
    met = rows["position_ned_m"][rows["time_unix_ns"][:, 0] >= begin_ns]
    raised = sum(v.agent.rejected[LAW_RAISED] for v in fleet.vehicles.values())
    return min(dist(a, b) for a, b in met), raised
