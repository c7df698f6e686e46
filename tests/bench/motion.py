"""What it costs to examine the worst motions that the limits allow, ten vehicles: CPU, medians of several runs.

    python -m tests.bench.motion

Motions are drawn from families that made the examination look most often: up to a hundred legs and turns along the edge
of a fence, a formation that changes all the while and turns with them; the shipped cylinder, and a polygon of as many
notches. Of each fence those with most looks are timed: the examination alone, and a datagram's way through an agent,
read, examined and refused or kept.
"""

import random
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import cos, pi, sin
from pathlib import Path
from typing import Any, NamedTuple

import typer

from companion.config import FleetConfig, load
from companion.core.frames import Ned
from companion.core.trajectory.fleet import FleetTrajectory
from companion.core.trajectory.legs import GotoLeg, Leg, TurnLeg, VelocityLeg
from companion.core.trajectory.slots import SlotChange
from companion.core.trajectory.successors import with_legs
from companion.core.trajectory_check import LEGS_MAX, examine
from companion.core.values import Instant
from companion.vehicle.agent import Agent
from companion.wire.peer import encode_motion

FILE = Path(__file__).resolve().parents[2] / "fleet.toml"
START_NS = 1_790_000_000_000_000_000
VEHICLES = 10
EDGE_M, NOTCH_M, NOTCHES = 200.0, 12.0, 60
DRAWN, TIMED, RUNS = 300, 4, 5
BAR_MS = 20.0
"""of CPU, for the worst"""


class Case(NamedTuple):
    """A motion, and what came of its examination."""

    motion: FleetTrajectory
    looks: float
    outcome: str


def fenced(fence: dict[str, Any]) -> FleetConfig:
    """The shipped fleet inside another fence."""

    def change(tables: dict[str, Any]) -> None:
        tables["vehicle"] = tables["vehicle"][:VEHICLES]
        height = {k: tables["fence"][k] for k in ("floor_m", "ceiling_m", "margin_m", "vertical_margin_m")}
        tables["fence"] = {**height, **fence}

    return load(FILE, change)


def notched() -> list[list[float]]:
    """A ring of corners, every other one further in."""
    corners = []
    for k in range(2 * NOTCHES):
        r, angle = EDGE_M - NOTCH_M * (k % 2), pi * k / NOTCHES
        corners.append([round(r * cos(angle), 2), round(r * sin(angle), 2)])
    return corners


FENCES: dict[str, dict[str, Any]] = {
    "cylinder": {"radius_m": EDGE_M},
    f"polygon of {2 * NOTCHES} corners": {"polygon_m": notched()},
}


def drawn(r: random.Random, before: FleetTrajectory) -> FleetTrajectory:
    """A motion of some family, with a place near the edge to begin at."""
    edge = r.choice([100.0, 150.0, 170.0, 180.0, 184.0, 188.0, 195.0])
    follows, changes = r.random() < 0.7, r.random() < 0.7
    family = r.choice(["goto", "turns", "sides", "mixed"])
    legs: list[Leg] = []
    for k in range(r.choice([1, 2, 5, 10, 20, 40, LEGS_MAX])):
        angle = 0.03 * k + r.uniform(0.0, 0.03)
        goto = GotoLeg(Ned(edge * cos(angle), edge * sin(angle), -10.0), r.choice([20.0, 60.0, 300.0]))
        turn = TurnLeg(r.choice([0.01, 0.1, -0.1, 0.3]), r.choice([0.5, 1.0, pi, 600.0]))
        side = VelocityLeg(Ned(0.0, r.choice([-1.0, 1.0]) * r.choice([0.2, 1.0, 2.9]), 0.0), r.choice([0.5, 5.0, 60.0]))
        of_family: dict[str, Leg] = {"goto": goto, "turns": turn, "sides": side}
        legs.append(of_family[family] if family in of_family else r.choice(list(of_family.values())))
    slots = {i: SlotChange(c.after, c.before) for i, c in before.slots.items()} if changes else before.slots
    motion = with_legs(before, at_ns=START_NS + 3 * 10**9, issuer=0, legs=tuple(legs))
    return replace(
        motion, centre_ned_m=Ned(edge, 0.0, -10.0), heading_follows_turns=follows, slots=slots,
        blend_start_ns=motion.start_ns, blend_s=r.choice([8.0, 60.0, 600.0, 80_000.0]) if changes else 0.0,
    )  # fmt: skip


def worst(config: FleetConfig) -> list[Case]:
    """Those of many with most looks, most first."""
    first = config.first_motion
    before = replace(config.motion_into("v", first, START_NS - 60 * 10**9, 0), revision=1)
    held = replace(before, blend_s=0.0, slots={i: SlotChange(c.after, c.after) for i, c in before.slots.items()})
    r, cases = random.Random(7), []
    for _ in range(DRAWN):
        motion = drawn(r, r.choice([before, held]))
        fault, looks = examine(motion, config.motion_limits, before)
        cases.append(Case(motion, looks, "may be flown" if fault is None else str(fault.kind)))
    return sorted(cases, key=lambda c: -c.looks)[:TIMED]


def cpu_ms(work: Callable[[], Callable[[], Any]]) -> float:
    """Median CPU of one run; `work` prepares each."""
    took = []
    for _ in range(RUNS):
        run = work()
        begun = time.thread_time_ns()
        run()
        took.append((time.thread_time_ns() - begun) * 1e-6)
    return statistics.median(took)


def received(config: FleetConfig, payload: bytes) -> Callable[[], None]:
    """A new agent that is about to receive a peer's motion."""
    agent, now = Agent(config, 1, boot_id=1), Instant(50_000_000_000, START_NS)
    return lambda: agent.receive_peer("fleet/2/plan", payload, now)


def alone(config: FleetConfig, motion: FleetTrajectory) -> Callable[[], object]:
    """The motion about to be examined, as a new object: one keeps what was once computed of its legs."""
    new = replace(motion)
    return lambda: examine(new, config.motion_limits)


def main() -> None:
    """Time the worst of each fence."""
    most = 0.0
    for name, fence in FENCES.items():
        config = fenced(fence)
        for motion, looks, outcome in worst(config):
            payload = encode_motion(replace(motion, revision=2))
            examined_ms = cpu_ms(partial(alone, config, motion))
            received_ms = cpu_ms(partial(received, config, payload))
            most = max(most, examined_ms, received_ms)
            typer.echo(
                f"{name:24} {len(motion.legs):3} legs {len(payload):6} B {looks:6.0f} looks {examined_ms:6.1f} ms, "
                f"{received_ms:6.1f} ms in an agent: {outcome}"
            )
    typer.echo(f"worst: {most:.1f} ms of CPU, wanted {BAR_MS:g}; medians of {RUNS}")


if __name__ == "__main__":
    main()
