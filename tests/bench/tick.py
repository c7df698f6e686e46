"""One control tick with fifteen neighbours, from the position's datagram to the setpoint's, hot: median of a flight.

    python -m tests.bench.tick                     # this tree
    python -m tests.bench.tick --against ../other  # beside another tree, in rounds that take turns

Sixteen vehicles fly in lockstep once, in this tree; what reached one of them is kept. Each tree then meets that flight
again in a process of its own, as fast as it can, and each tick in formation is timed: `receive_mavlink` with the
position and `advance` after it. The trees' outputs are compared too.
"""

import importlib
import os
import pickle
import statistics
import subprocess
import sys
import time
import tomllib
from hashlib import blake2b
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import typer

ROOT = Path(__file__).resolve().parents[2]
VEHICLES, VEHICLE = 16, 1
FLIGHT_S = 40.0
"""after the take-off command: the climb, the wait, and some 25 s in formation"""
READY_S = 15.0
ROUNDS = 7
POSITION_ID, SETPOINT_ID = b"\x20\0\0", b"\x54\0\0"


class Met(NamedTuple):
    """What a tree made of the flight."""

    microseconds: float
    """median of a tick"""
    ticks: int
    digest: str
    """of every output"""


def tables() -> dict[str, Any]:
    """The fleet.toml that the tree ships, with sixteen vehicles: another tree may know other keys."""
    shipped = Path(importlib.import_module("companion").__path__[0]).parent / "fleet.toml"
    read = tomllib.loads(shipped.read_text(encoding="utf-8"))
    read["vehicle"] = [{"id": i} for i in range(1, VEHICLES + 1)]
    read["formation"]["altitude_m"] = 3.0
    return read


def fleet() -> Any:
    """That fleet as the tree that is imported reads it; trees differ in where they have the reader."""
    config = importlib.import_module("companion.config")
    reader = config if hasattr(config, "parse") else importlib.import_module("companion.config.file")
    return reader.parse(tables(), "tick")


def flight() -> list[tuple[str, int, int, bytes]]:
    """What one vehicle met: (channel, monotonic ns, fleet ns, body)."""
    from sim.lockstep.lockstep import Lockstep

    met: list[tuple[str, int, int, bytes]] = []

    def record(i: int, channel: str, now: Any, body: bytes) -> None:
        if i == VEHICLE and not channel.startswith("output/"):
            met.append((channel, now.monotonic_ns, now.fleet_ns, body))

    ls = Lockstep(fleet(), seed=1, record=record)
    ls.run_until(READY_S, lambda: not any(v.agent.operator.unready(ls.now) for v in ls.vehicles.values()))
    ls.command(b'{"verb":"takeoff"}')
    ls.run_until(ls.now_ns * 1e-9 + FLIGHT_S)
    boot_id = ls.vehicles[VEHICLE].agent.boot_id
    return [("boot", boot_id, 0, b""), *met]


def meet(tape: Path) -> Met:
    """The recorded flight, met by the agent that this process imports."""
    from companion.core.values import FORMATION_PHASES, Instant
    from companion.vehicle.agent import Agent

    (_, boot_id, _, _), *entries = pickle.loads(tape.read_bytes())
    agent = Agent(fleet(), VEHICLE, boot_id)
    digest = blake2b(digest_size=12)
    took: list[int] = []
    received_ns = 0
    for channel, monotonic_ns, fleet_ns, body in entries:
        now = Instant(monotonic_ns, fleet_ns)
        match channel:
            case "input/mavlink":
                begun = time.perf_counter_ns()
                agent.receive_mavlink(body, now)
                if body[7:10] == POSITION_ID:
                    received_ns = time.perf_counter_ns() - begun
            case "input/peer":
                key, _, payload = body.partition(b"\0")
                agent.receive_peer(key.decode(), payload, now)
            case "input/presence":
                agent.receive_presence(body[0], bool(body[1]), now)
            case "input/command":
                agent.receive_command(body, now)
            case "advance":
                begun = time.perf_counter_ns()
                out = agent.advance(now)
                needed = time.perf_counter_ns() - begun
                for datagram in out.mavlink:
                    digest.update(datagram)
                for _, payload in out.peers:
                    digest.update(payload)
                steered = any(d[7:10] == SETPOINT_ID for d in out.mavlink)
                if steered and received_ns and agent.phase in FORMATION_PHASES:
                    took.append(received_ns + needed)
                received_ns = 0
    return Met(statistics.median(took) * 1e-3, len(took), digest.hexdigest())


def met_by(tree: Path, tape: Path) -> Met:
    """The same in a process that imports the companion of a tree."""
    environment = {**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, "-P", __file__, "--meet", str(tape)],
        cwd=tree,
        env=environment,
        stdout=subprocess.PIPE,
        check=True,
    )
    return Met(*pickle.loads(done.stdout))


def main(against: Path | None) -> None:
    """Time the tick, alone or beside another tree's."""
    trees = [ROOT] if against is None else [ROOT, against.resolve()]
    with TemporaryDirectory() as folder:
        tape = Path(folder) / "flight.pickle"
        tape.write_bytes(pickle.dumps(flight()))
        rounds = [[met_by(tree, tape) for tree in trees] for _ in range(ROUNDS)]
    for tree, met in zip(trees, zip(*rounds, strict=True), strict=True):
        median = statistics.median(m.microseconds for m in met)
        typer.echo(f"{median:7.1f} us a tick, {VEHICLES - 1} neighbours, {met[0].ticks} ticks, {ROUNDS} rounds: {tree}")
    if against is not None:
        ratio = statistics.median(ours.microseconds / theirs.microseconds for ours, theirs in rounds)
        same = "the same bytes" if len({m.digest for r in rounds for m in r}) == 1 else "OTHER BYTES"
        typer.echo(f"{ratio:7.3f} of the other tree's; {same}")


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["--meet", tape_path]:
            sys.stdout.buffer.write(pickle.dumps(tuple(meet(Path(tape_path)))))
        case ["--against", other]:
            main(Path(other))
        case []:
            main(None)
        case _:
            sys.exit(__doc__)
