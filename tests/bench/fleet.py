"""A crowd of companions on one machine: how long until all are up, what each takes, how late their loops are.

    python -m tests.bench.fleet start              # fifty companions against stubs
    python -m tests.bench.fleet start --alone      # each in an interpreter of its own, as `companion run` starts it
    python -m tests.bench.fleet fly                # thirty at 50 Hz, from take-off to landing, beside an empty loop

Uses the ports of the shipped fleet.toml and a fleet name of its own.
"""

import json
import os
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import mean
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import tomli_w
import typer

from companion.config import FleetConfig, load
from companion.io.network import operator_link
from sim.launch.jobs import CompanionJob, StubsJob
from sim.launch.launch import CROWD, CROWD_NICENESS
from sim.launch.processes import FleetProcesses, Forked

ROOT = Path(__file__).resolve().parents[2]
CONTROL_RATE_HZ = 50
CROWD_RATE_HZ = 20.0
"""of the fifty that are started: as `fleet up` has them"""
TIMEOUT_S = 120.0
SETTLE_S = 3.0
"""after the last is up: what each takes is read then"""
app = typer.Typer(add_completion=False, help=__doc__)


def write_fleet(folder: Path, vehicles: int, **limits: Any) -> Path:
    """The shipped file with so many vehicles under a name of its own."""
    tables = tomllib.loads((ROOT / "fleet.toml").read_text(encoding="utf-8"))
    tables["fleet"]["name"] = f"bench-{os.getpid()}"
    tables["vehicle"] = [{"id": i + 1} for i in range(vehicles)]
    tables.setdefault("limits", {}).update(limits)
    file = folder / "fleet.toml"
    file.write_text(tomli_w.dumps(tables), encoding="utf-8")
    return file


def pss_mb(pid: int) -> tuple[float, float]:
    """Proportional share and private dirty pages of a process (MB)."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]
    kilobytes = {line.split(":")[0]: int(line.split()[1]) for line in lines}
    return kilobytes["Pss"] / 1024, kilobytes["Private_Dirty"] / 1024


def cpu_s(pid: int) -> float:
    """Processor time so far."""
    stat = Path(f"/proc/{pid}/stat").read_text()
    fields = stat[stat.rindex(")") + 2 :].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def niceness(config: FleetConfig) -> int:
    """As the launcher's."""
    return CROWD_NICENESS if len(config.vehicles) > CROWD else 0


def start_forked(config: FleetConfig, file: Path, processes: FleetProcesses) -> None:
    """As `fleet up` does."""
    processes.fork("stubs", StubsJob(str(file)))
    for v in config.vehicles:
        processes.fork(f"companion-{v.id}", CompanionJob(v.id, str(file)), niceness(config))


def start_alone(config: FleetConfig, file: Path, processes: FleetProcesses) -> None:
    """Each with imports of its own."""
    processes.spawn("stubs", "sim", "stub", "--fleet", str(file), "--launched")
    for v in config.vehicles:
        job = CompanionJob(v.id, str(file))
        processes.spawn(f"companion-{v.id}", *job.title)


@contextmanager
def processes_in(folder: Path) -> Iterator[FleetProcesses]:
    """Started and ended."""
    processes = FleetProcesses(folder)
    try:
        processes.open()
        yield processes
    finally:
        processes.close()


@app.command()
def start(
    vehicles: Annotated[int, typer.Option(min=1, max=250)] = 50,
    alone: Annotated[bool, typer.Option("--alone", help="Without the server that forks.")] = False,
) -> None:
    """Start companions against stubs: seconds until each is seen and answers, memory and CPU of each."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        file = write_fleet(folder, vehicles, control_rate_hz=CROWD_RATE_HZ)
        config = load(file)
        ids = [v.id for v in config.vehicles]
        began_s = time.monotonic()
        with processes_in(folder) as processes:
            (start_alone if alone else start_forked)(config, file, processes)
            started_s = time.monotonic() - began_s
            with operator_link(config) as link:
                alive = link.wait_alive(ids, TIMEOUT_S)
                seen_s = time.monotonic() - began_s
                answers = link.ask(ids, "status", b"", TIMEOUT_S, 1.0)
                up_s = time.monotonic() - began_s
            time.sleep(SETTLE_S)
            pids = []
            for i in ids:
                child = processes.children[f"companion-{i}"]
                assert isinstance(child, Forked | subprocess.Popen)
                pids.append(child.pid)
            memory = [pss_mb(pid) for pid in pids]
            cpu = [cpu_s(pid) for pid in pids]
        answered = sum(bool(a) for a in answers.values())
        typer.echo(json.dumps({
            "vehicles": vehicles, "seen": len(alive), "answered": answered, "forked_after_s": round(started_s, 2),
            "all_seen_after_s": round(seen_s, 2), "all_up_after_s": round(up_s, 2),
            "pss_mb_mean": round(mean(p for p, _ in memory), 1), "pss_mb_max": round(max(p for p, _ in memory), 1),
            "private_dirty_mb_mean": round(mean(d for _, d in memory), 1), "cpu_s_mean": round(mean(cpu), 3),
            "load": os.getloadavg()[0],
        }, indent=2))  # fmt: skip


@app.command()
def fly(
    vehicles: Annotated[int, typer.Option(min=1, max=250)] = 30,
    rate: Annotated[float, typer.Option(min=20, max=50, help="Control rate (Hz).")] = CONTROL_RATE_HZ,
    seconds: Annotated[float, typer.Option(min=10, help="From take-off to the landing command.")] = 80.0,
) -> None:
    """Fly them by `fleet up`: lateness of their loops beside an empty one's."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        file = write_fleet(folder, vehicles, control_rate_hz=rate)
        command = ("up", "--fleet", str(file), "--for", str(seconds), "--out", str(folder / "flights"), "--json")
        done = subprocess.run(
            [sys.executable, "-P", "-m", "sim", *command], cwd=folder, stdout=subprocess.PIPE, text=True, check=False
        )
        summary = json.loads(done.stdout)
    keys = (
        "passed", "vehicles", "control_rate_hz", "formed_after_s", "minimum_distance_m", "setpoint_rate_hz",
        "setpoint_gap_max_s", "loop_lateness_ms", "latency_ms", "reference_lateness_ms", "cpu_per_tick_ms", "failsafes",
        "lost", "missing",
    )  # fmt: skip
    unmet = [c for c in summary["criteria"] if not c["met"]]
    typer.echo(json.dumps({k: summary[k] for k in keys} | {"unmet": unmet, "load": os.getloadavg()[0]}, indent=2))


if __name__ == "__main__":
    app()
