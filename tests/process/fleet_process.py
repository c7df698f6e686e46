"""Fleets of real processes for tests: names and ports of their own, every process ended by its own id."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import tomli_w

from companion.config import FleetConfig, load
from companion.io.network import operator_link
from companion.io.zenoh.configuration import scouting_port
from companion.operator.client import Operator
from companion.wire.operator import Status, decode
from sim.autopilot.stubs import TRUTH_DTYPE

PORTS = range(26_000, 32_000, 100)
"""clear of PX4's, of the fleets' scouting and of the ephemeral ones"""
WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
"""two lanes of tests look for free ports at one time: each has every other block"""
PATIENCE_S = 120.0
"""how long a test waits for what must come; far above what it takes on an idle machine"""
STUB_PORT_OFFSET = 40
ALTITUDE_M = 2.0
_numbers = itertools.count()


@dataclass(frozen=True, slots=True)
class Fleet:
    """A fleet.toml with ports and a name that no other fleet on this machine has."""

    file: Path
    config: FleetConfig
    port: int
    """the first companion's; the others' follow"""

    @property
    def folder(self) -> Path:
        return self.file.parent

    @property
    def ids(self) -> list[int]:
        return [v.id for v in self.config.vehicles]


def _free(ports: list[int]) -> bool:
    for port in ports:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
            try:
                s.bind(("127.0.0.1", port))
            except OSError:
                return False
    return True


def make_fleet(folder: Path, count: int, *, name: str | None = None, scouting: int | None = None, **more: Any) -> Fleet:
    """A low and quick fleet of `count` vehicles in `folder`; `more` are further tables of its file."""
    number = next(_numbers)
    ours = PORTS[WORKER % 2 :: 2]
    blocks = [ours[(os.getpid() * 7 + number * 13 + k) % len(ours)] for k in range(len(ours))]
    port = next(b for b in blocks if _free([b + k + way for k in range(count) for way in (0, STUB_PORT_OFFSET)]))
    name = name or f"test-{os.getpid()}-{number}"
    tables: dict[str, Any] = {
        "fleet": {
            "name": name,
            "origin": {"latitude_deg": 47.397742, "longitude_deg": 8.545594, "altitude_amsl_m": 488.0},
        },
        "formation": {"shape": "v", "altitude_m": ALTITUDE_M},
        "peers": {"scouting_port": scouting_port(name) if scouting is None else scouting},
        "vehicle": [{"id": k + 1, "mavlink": f"udp://127.0.0.1:{port + k}"} for k in range(count)],
        **more,
    }
    file = folder / f"{name}.toml"
    file.write_text(tomli_w.dumps(tables))
    return Fleet(file, load(file), port)


@contextmanager
def started(*arguments: str, folder: Path, name: str = "process", stdin: int | None = None) -> Iterator[Process]:
    """`python -m ...` with its outputs in files; killed at the end if it still runs."""
    out, err = folder / f"{name}.out", folder / f"{name}.err"
    with out.open("wb") as stdout, err.open("wb") as stderr:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", *arguments], cwd=folder, stdout=stdout, stderr=stderr,
            stdin=subprocess.DEVNULL if stdin is None else stdin,
        )  # fmt: skip
        try:
            yield Process(process, out, err)
        finally:
            if process.poll() is None:
                process.kill()
            process.wait()
            if process.stdin is not None:
                process.stdin.close()


@dataclass(frozen=True, slots=True)
class Process:
    """One process that a test has started."""

    popen: subprocess.Popen[bytes]
    out_file: Path
    err_file: Path

    def signal(self, number: signal.Signals) -> None:
        self.popen.send_signal(number)

    def wait(self, timeout_s: float = PATIENCE_S) -> int:
        """Its exit status."""
        return self.popen.wait(timeout_s)

    @property
    def out(self) -> str:
        return self.out_file.read_text()

    @property
    def err(self) -> str:
        return self.err_file.read_text()


def run(*arguments: str, folder: Path, timeout_s: float = PATIENCE_S) -> subprocess.CompletedProcess[str]:
    """A command to its end."""
    return subprocess.run(
        [sys.executable, "-P", "-m", *arguments], cwd=folder, capture_output=True, text=True, timeout=timeout_s,
        check=False, stdin=subprocess.DEVNULL,
    )  # fmt: skip


@contextmanager
def operator_of(fleet: Fleet) -> Iterator[Operator]:
    """An operator in this process, for waiting; what is tested goes through the command line."""
    with operator_link(fleet.config) as link:
        yield Operator(fleet.config, link)


def wait_status(
    operator: Operator, enough: Callable[[dict[int, Status]], bool], timeout_s: float = PATIENCE_S
) -> dict[int, Status]:
    """Ask until what the vehicles say is enough; fails with their last words when the time is up."""
    deadline_s = time.monotonic() + timeout_s
    while True:
        said = {i: s for i, s in operator.status().items() if s is not None}
        if enough(said):
            return said
        assert time.monotonic() < deadline_s, {i: _essence(s) for i, s in said.items()}
        time.sleep(0.1)


def _essence(status: Status) -> dict[str, Any]:
    return {k: getattr(status, k) for k in ("phase", "mode", "ready", "revision", "shape", "failsafes", "rejected")}


SETTLED = ("formed", "moving", "holding")
"""phases of a vehicle that has taken its slot"""


def all_in(ids: list[int], *phases: str, revision: int = 0) -> Callable[[dict[int, Status]], bool]:
    """Whether all of these vehicles are in one of the phases, under a motion of at least that revision."""
    return lambda said: all(i in said and said[i].phase in phases and said[i].revision >= revision for i in ids)


def eventually(condition: Callable[[], bool], timeout_s: float = PATIENCE_S) -> bool:
    """Whether it comes true."""
    deadline_s = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < deadline_s:
        time.sleep(0.02)
    return condition()


def children(pid: int) -> dict[str, int]:
    """Command line -> id of a process's children."""
    found = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                stat = (entry / "stat").read_text()
                if int(stat[stat.rindex(")") + 2 :].split()[1]) == pid:
                    found[(entry / "cmdline").read_text().replace("\0", " ").strip()] = int(entry.name)
    return found


def child(pid: int, words: str) -> int:
    """Id of the one child whose command line has these words."""
    (found,) = (number for line, number in children(pid).items() if words in f"{line} ")
    return found


def gone(pid: int) -> bool:
    """Whether a process has ended, be it as somebody's zombie."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return True
    return stat[stat.rindex(")") + 2] == "Z"


def ports_free(fleet: Fleet) -> bool:
    """Whether nobody holds a port of that fleet's companions and stubs."""
    return _free([fleet.port + k + way for k in range(len(fleet.ids)) for way in (0, STUB_PORT_OFFSET)])


def truth(file: Path, vehicle_id: int) -> npt.NDArray[Any]:
    """What a vehicle has really done so far."""
    rows: npt.NDArray[Any] = np.fromfile(file, TRUTH_DTYPE)
    return np.asarray(rows[rows["vehicle_id"] == vehicle_id])


def minimum_distance_m(file: Path) -> float:
    """Smallest distance of any two vehicles at any time (m)."""
    rows = np.fromfile(file, TRUTH_DTYPE)
    ids = np.unique(rows["vehicle_id"])
    tracks = [rows[rows["vehicle_id"] == i]["position_ned_m"] for i in ids]
    length = min(len(t) for t in tracks)
    return min(
        float(np.linalg.norm(a[:length] - b[:length], axis=1).min()) for a, b in itertools.combinations(tracks, 2)
    )


def status_json(fleet: Fleet, file: Path | None = None) -> tuple[int, dict[int, Status | None]]:
    """`fleet status --json`: its exit status and what it printed."""
    done = run("sim", "status", "--json", "--fleet", str(file or fleet.file), folder=fleet.folder)
    assert done.stdout, done.stderr
    said = json.loads(done.stdout)
    return done.returncode, {int(i): s and decode(Status, json.dumps(s).encode()) for i, s in said.items()}


def flight_folder(out: Path) -> Path:
    """The one flight's folder that `fleet up` has made."""
    (folder,) = out.iterdir()
    return folder
