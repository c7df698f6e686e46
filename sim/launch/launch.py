"""A whole fleet on one machine: stubs and companions as processes, from take-off to the summary."""

import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any

import numpy as np
import tomli_w

from companion.config import FleetConfig
from companion.config.file import parse
from companion.errors import CompanionError, RefusedError
from companion.io.network import operator_link
from companion.operator.client import Answers, Operator, PreflightError
from sim.autopilot.stubs import TRUTH_DTYPE
from sim.launch.faults import ScheduledFault, order_fault
from sim.launch.reference_loop import read_reference_loop
from sim.launch.sitl import read_ended
from sim.launch.summary import Flight, summarise

READY_TIMEOUT_S = 30.0
READY_TIMEOUT_PER_VEHICLE_S = 3.0
LANDING_TIMEOUT_S = 90.0
POLL_S = 1.0
TAKE_OFF_GRACE_S = 15.0
"""a vehicle that is still on the ground by then has given its take-off up"""
UNHEARD_S = 15.0
"""an autopilot silent for so long will not tell of its landing any more"""
END_TIMEOUT_S = 5.0
CROWD = 15
CROWD_NICENESS = 10
"""more companions than CROWD want more than two processors: they get less, each its share, and not the one process that
simulates all autopilots, without which nobody flies"""
AUTOPILOTS_GRACE_S = 12.0
LIBRARIES = ("starling-fleet", "pymavlink", "eclipse-zenoh", "numpy", "scipy", "pydantic", "mcap")


@dataclass(frozen=True, slots=True)
class FlightOptions:
    """One flight of `fleet up`."""

    folder: Path
    seed: int = 0
    duration_s: float | None = None
    """from the take-off command to landing; None: until the plan lands, or for ever"""
    px4: Path | None = None
    """PX4's build folder: fly SITL instances instead of stubs"""
    parameters: tuple[str, ...] = ()
    """of the SITL instances, NAME=VALUE each, beyond the launcher's own"""
    external: bool = False
    """fly autopilots that run already"""
    ground: bool = False
    """show the stubs to a ground station and PX4's viewer"""
    faults: tuple[ScheduledFault, ...] = ()
    """what the stubs suffer, and when after the take-off command"""


@dataclass(slots=True)
class Progress:
    """What the live table shows."""

    elapsed_s: float
    doing: str
    vehicles: Mapping[int, Mapping[str, Any] | None]
    ended: Mapping[int, int]
    """vehicle -> exit status of its companion, where it has ended"""
    autopilots_ended: Mapping[int, str] = field(default_factory=dict)
    """vehicle -> how its autopilot has ended"""


@dataclass(slots=True)
class _Child:
    name: str
    process: subprocess.Popen[bytes]
    log: IO[bytes]


@dataclass(slots=True)
class FleetProcesses:
    """The children. Each ends by itself when its standard input closes, so none outlives this process."""

    folder: Path
    stack: ExitStack = field(default_factory=ExitStack)
    children: dict[str, _Child] = field(default_factory=dict)

    def start(self, name: str, *arguments: str) -> subprocess.Popen[bytes]:
        """Start a command of a package with its output in NAME.log; -P: the user's folder holds no modules for it."""
        log = self.stack.enter_context((self.folder / f"{name}.log").open("wb"))
        # SITL instances take longer to end than a watched process may.
        watched = () if "sitl" in arguments else ("sim.launch.child",)
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", *watched, *arguments], stdin=subprocess.PIPE, stdout=log,
            stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        self.children[name] = _Child(name, process, log)
        return process

    def exit_status(self, name: str) -> int | None:
        """Exit status of a child that has ended, else None."""
        return self.children[name].process.poll()

    def why_ended(self, name: str, when: str) -> str:
        """What to say of a child that has ended: its exit status and the last lines that it printed."""
        lines = (self.folder / f"{name}.log").read_text(errors="replace").strip().splitlines()
        return "\n".join((f"{name} ended {when} with status {self.exit_status(name)}:", *lines[-5:]))

    def end(self, names: list[str], timeout_s: float) -> None:
        """SIGTERM to each, and SIGKILL to whoever is still there after the timeout."""
        for name in names:
            process = self.children[name].process
            if process.poll() is None:
                process.terminate()
        deadline = time.monotonic() + timeout_s
        for name in names:
            child = self.children[name]
            try:
                child.process.wait(max(deadline - time.monotonic(), 0.01))
            except subprocess.TimeoutExpired:
                child.process.kill()
                child.process.wait()
            if child.process.stdin is not None:
                child.process.stdin.close()

    def close(self) -> None:
        """End whatever still runs."""
        self.end(list(self.children), END_TIMEOUT_S)
        self.stack.close()


def flight_folder(root: Path) -> Path:
    """A new folder for a flight, named by UTC."""
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    for suffix in ("", *(f"-{k}" for k in range(2, 100))):
        folder = root / f"{stamp}{suffix}"
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise CompanionError(f"cannot make the flight's folder {folder}: {error.strerror}") from error
        return folder
    raise CompanionError(f"cannot make a new folder in {root}")


def fly(
    tables: dict[str, Any], options: FlightOptions, show: Callable[[Progress], None], interrupted: Callable[[], bool]
) -> dict[str, Any]:
    """Fly a fleet of stubs from take-off to landing; returns the summary, which also lies in the flight's folder.

    `tables` is fleet.toml with its overrides. Raises CompanionError when the fleet does not come up.
    """
    config = parse(tables, "fleet.toml")
    folder = options.folder
    _write(folder / "fleet.toml", tomli_w.dumps(_without_none(tables)))
    processes = FleetProcesses(folder)
    try:
        return _fly(config, options, processes, show, interrupted)
    finally:
        processes.close()


def _without_none(tables: Any) -> Any:
    if isinstance(tables, dict):
        return {k: _without_none(v) for k, v in tables.items() if v is not None}
    return [_without_none(v) for v in tables] if isinstance(tables, list) else tables


def _fly(
    config: FleetConfig,
    options: FlightOptions,
    processes: FleetProcesses,
    show: Callable[[Progress], None],
    interrupted: Callable[[], bool],
) -> dict[str, Any]:
    folder = options.folder
    file = str(folder / "fleet.toml")
    began = time.monotonic()
    ids = [v.id for v in config.vehicles]
    processes.start("reference", "sim", "reference-loop", "--out", str(folder / "reference.bin"))
    truth = folder / "truth.bin"
    ready = folder / "autopilots.ready" if options.px4 is not None else None
    if options.px4 is not None:
        more = [word for p in options.parameters for word in ("--parameter", p)]
        processes.start(
            "autopilots", "sim", "sitl", "--fleet", file, "--px4", str(options.px4), "--truth", str(truth),
            "--ready", str(ready), *more,
        )  # fmt: skip
    elif not options.external:
        processes.start(
            "autopilots", "sim", "stub", "--fleet", file, "--seed", str(options.seed), "--truth", str(truth),
            "--launched", *(["--gcs"] if options.ground else []),
        )  # fmt: skip
    for i in ids:
        process = processes.start(
            f"companion-{i}", "companion", "run", "--vehicle", str(i), "--fleet", file, "--record",
            str(folder / f"vehicle-{i}.mcap"), "--launched",
        )  # fmt: skip
        if len(ids) > CROWD:
            _lower_priority(process.pid)
        _wait_imported(processes, folder, ids, lambda: show(_starting(began, ids)), interrupted)
    with operator_link(config) as link:
        operator = Operator(config, link)
        watch = Watch(operator, processes, ids, show, began, ready=ready)
        answers = watch.take_off(READY_TIMEOUT_S + READY_TIMEOUT_PER_VEHICLE_S * len(ids), interrupted)
        takeoff_ns = watch.asked_ns
        if not answers.all_accepted:
            raise RefusedError(answers.sentence("take-off"))
        lost = watch.fly(options.duration_s, options.faults, interrupted)
        final, autopilots_lost = watch.said, watch.autopilots_ended()
    processes.end([f"companion-{i}" for i in ids], END_TIMEOUT_S)
    processes.end([n for n in ("autopilots", "reference") if n in processes.children], AUTOPILOTS_GRACE_S)
    flight = Flight(
        config=config,
        seed=options.seed,
        truth=np.fromfile(truth, TRUTH_DTYPE) if truth.exists() else np.zeros(0, TRUTH_DTYPE),
        takeoff_ns=takeoff_ns,
        centroid_limit_m=0.5 if options.px4 is None else 1.0,
        lost=lost,
        autopilots_lost=autopilots_lost,
        disarmed={i: not said["armed"] for i, said in final.items()},
        versions={"python": sys.version.split()[0], **{name: version(name) for name in LIBRARIES}},
    )
    for i in ids:
        flight.read_file(i, folder / f"vehicle-{i}.mcap")
        said = final.get(i)
        flight.rejected += Counter(said["rejected"] if said else {})
    rows = read_reference_loop(folder / "reference.bin")
    flight.reference_lateness_ns = rows[rows[:, 0] >= takeoff_ns, 1].astype(float)
    summary = {
        **summarise(flight),
        "exit_status": {i: processes.exit_status(f"companion-{i}") for i in ids},
        "folder": str(folder),
    }
    _write(folder / "summary.json", json.dumps(summary, indent=2) + "\n")
    return summary


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise CompanionError(f"cannot write {path}: {error.strerror}") from error


def _lower_priority(pid: int) -> None:
    os.setpriority(os.PRIO_PROCESS, pid, CROWD_NICENESS)
    # Where the kernel groups processes by session, niceness counts within a group only, and each group has its own.
    with suppress(OSError):
        Path(f"/proc/{pid}/autogroup").write_text(str(CROWD_NICENESS))


def _starting(began: float, ids: list[int]) -> Progress:
    return Progress(time.monotonic() - began, "starting", dict.fromkeys(ids), {})


def _wait_imported(
    processes: FleetProcesses, folder: Path, ids: list[int], show: Callable[[], None], interrupted: Callable[[], bool]
) -> None:
    """Wait until fewer companions are starting than there are processors, plus one; a recording's file says who has.

    A start costs more than a second of processor time. Thirty at once would keep the autopilots from their rates, and
    every companion from its peers, for as long as all of them take.
    """
    most = (os.cpu_count() or 1) + 1
    while True:
        if interrupted():
            raise CompanionError("interrupted before take-off")
        begun = [i for i in ids if f"companion-{i}" in processes.children]
        if any(processes.exit_status(f"companion-{i}") is not None for i in begun):
            return
        if sum(not (folder / f"vehicle-{i}.mcap").exists() for i in begun) < most:
            return
        show()
        time.sleep(0.1)


@dataclass(slots=True)
class Watch:
    """The launcher's eye on a flight: it asks once a second, shows, and notices who has gone."""

    operator: Operator
    processes: FleetProcesses
    ids: list[int]
    show: Callable[[Progress], None]
    began: float
    ready: Path | None = None
    """a file that is there once the autopilots have their parameters; None: nobody sets any here"""
    said: dict[int, dict[str, Any]] = field(default_factory=dict)
    """each vehicle's last account"""
    asked_ns: int = 0
    """when the take-off was last commanded (UTC)"""
    clock: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep

    def _look(self, doing: str) -> dict[int, dict[str, Any] | None]:
        answers = self.operator.status()
        self.said.update({i: s for i, s in answers.items() if s is not None})
        self.show(Progress(self.clock() - self.began, doing, answers, self.ended(), self.autopilots_ended()))
        return answers

    def ended(self) -> dict[int, int]:
        """Companions that have ended, with their exit status."""
        status = {i: self.processes.exit_status(f"companion-{i}") for i in self.ids}
        return {i: s for i, s in status.items() if s is not None}

    def autopilots_ended(self) -> dict[int, str]:
        """Autopilots whose own process has ended, and how."""
        return read_ended(self.processes.folder)

    def take_off(self, timeout_s: float, interrupted: Callable[[], bool]) -> Answers:
        """Wait until every vehicle is ready, look at the fleet as a whole, and take off.

        Raises PreflightError as soon as a fault shows that no waiting heals, and when the time is up.
        """
        deadline = self.clock() + timeout_s
        while True:
            self._until_ready(deadline, interrupted)
            self.asked_ns = time.time_ns()
            try:
                if self._parametrised:
                    return self.operator.take_off()
                if (report := self.operator.preflight()).permanent:
                    raise PreflightError(report)
            except PreflightError as error:
                if error.report.permanent or self.clock() > deadline:
                    raise
            # Whoever runs the autopilots says by itself, and a little later, which parameter it was.
            if not self._parametrised and self.clock() > deadline + AUTOPILOTS_GRACE_S:
                raise CompanionError("the autopilots' parameters were not read back as set in time; nobody took off")
            self.sleep(0.3)

    @property
    def _parametrised(self) -> bool:
        return self.ready is None or self.ready.exists()

    def _until_ready(self, deadline: float, interrupted: Callable[[], bool]) -> None:
        """Wait until every vehicle says that it may take off, or one that it cannot, or the time is up."""
        unfit_before = False
        while True:
            for name in self.processes.children:
                if self.processes.exit_status(name) is not None:
                    raise CompanionError(self.processes.why_ended(name, "before take-off"))
            for i, how in self.autopilots_ended().items():
                raise CompanionError(f"vehicle {i}: {how} before take-off")
            answers = self._look("starting")
            if self._parametrised and all(s is not None and not s["ready"] for s in answers.values()):
                return
            if interrupted():
                raise CompanionError("interrupted before take-off")
            # Once all speak, so that all are named; seen twice, since what comes in at the start has no order.
            unfit = all(s is not None for s in answers.values()) and any(s["unfit"] for s in answers.values() if s)
            if (unfit and unfit_before) or self.clock() > deadline:
                return
            unfit_before = unfit
            self.sleep(0.3)

    def fly(
        self, duration_s: float | None, faults: tuple[ScheduledFault, ...], interrupted: Callable[[], bool]
    ) -> frozenset[int]:
        """Watch until all have landed; returns the vehicles whose companion ended before."""
        start = self.clock()
        coming = list(faults)
        landing_since: float | None = None
        while True:
            answers = self._look("landing" if landing_since is not None else "flying")
            lost = frozenset(self.ended())
            gone = lost | frozenset(self.autopilots_ended())
            staying = [s for i, s in answers.items() if i not in gone and s is not None]
            if len(gone) == len(self.ids):
                return lost
            if "autopilots" in self.processes.children and self.processes.exit_status("autopilots") is not None:
                raise CompanionError(self.processes.why_ended("autopilots", "in flight"))
            tried = self.clock() - start > TAKE_OFF_GRACE_S
            down = ("landed", "released", "idle") if tried else ("landed", "released")
            done = [(s["phase"] in down and not s["armed"]) or _unheard(s) for s in staying]
            if staying and all(done) and len(staying) + len(gone) == len(self.ids):
                return lost
            while coming and self.clock() - start >= coming[0].at_s:
                order_fault(self.operator.config, coming[0].vehicle_id, coming[0].fault)
                coming.pop(0)
            over = duration_s is not None and self.clock() - start >= duration_s
            if landing_since is None and (over or interrupted()):
                landing_since = self.clock()
                self.operator.land()
            if landing_since is not None and self.clock() - landing_since > LANDING_TIMEOUT_S:
                return lost
            self.sleep(POLL_S)


def _unheard(status: Mapping[str, Any]) -> bool:
    """Whether a vehicle's autopilot has said nothing for so long that nobody need wait for it to land."""
    age_s = status.get("autopilot_age_s")
    return age_s is not None and age_s > UNHEARD_S
