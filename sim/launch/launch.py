"""A whole fleet on one machine: stubs and companions as processes, from take-off to the summary."""

import json
import signal
import time
from collections import Counter
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w

from companion.about import versions
from companion.config import FleetConfig
from companion.config.file import parse
from companion.errors import CompanionError, RefusedError
from companion.io.network import operator_link
from companion.io.signing_key import make_key
from companion.operator.client import Operator
from companion.operator.flying import noted
from sim.autopilot.faults import FaultKind
from sim.autopilot.stubs import TRUTH_DTYPE
from sim.launch.faults import CompanionFault, CompanionFaultKind, ScheduledFault
from sim.launch.jobs import CompanionJob, ReferenceJob, StubsJob
from sim.launch.processes import END_TIMEOUT_S, FleetProcesses
from sim.launch.reference_loop import read_reference_loop
from sim.launch.summary.flight import CENTROID_GPS_M, CENTROID_M, Flight
from sim.launch.summary.summarise import summarise
from sim.launch.watch import LANDING_TIMEOUT_S, MissingError, Progress, Watch

READY_TIMEOUT_S = 30.0
READY_TIMEOUT_PER_VEHICLE_S = 3.0
CROWD = 15
CROWD_NICENESS = 10
"""more companions than CROWD want more than two processors: they get less, each its share, and not the one process that
simulates all autopilots, without which nobody flies"""
AUTOPILOTS_GRACE_S = 12.0


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
    """what autopilots and companions suffer, and when after the take-off command"""
    allow_missing: bool = False
    """fly without the vehicles that do not come"""
    logs: bool = False
    """keep the SITL instances' flight logs"""
    landing_s: float = LANDING_TIMEOUT_S
    """after the operator's landing command nobody is waited for any longer"""


class Flown(NamedTuple):
    """A flight that has ended."""

    flight: Flight
    summary: dict[str, Any]
    """as `summary.json` holds it"""


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
    tables: dict[str, Any],
    options: FlightOptions,
    show: Callable[[Progress], None],
    interrupted: Callable[[], bool],
    tell: Callable[[str], None],
) -> Flown:
    """Fly a fleet from take-off to landing; the summary also lies in the flight's folder.

    `tables` is fleet.toml with its overrides. Raises CompanionError when the fleet does not come up.
    """
    processes = FleetProcesses(options.folder)
    launch = _Launch(options, processes, show, interrupted, tell)
    try:
        processes.open()
        with noted(tables["fleet"]["name"], launch.file):
            return launch.fly(tables)
    finally:
        processes.close()


@dataclass(slots=True)
class _Launch:
    """One flight of `fleet up`, from its processes to its summary."""

    options: FlightOptions
    processes: FleetProcesses
    show: Callable[[Progress], None]
    interrupted: Callable[[], bool]
    tell: Callable[[str], None]
    starts: dict[int, int] = field(default_factory=dict)
    """vehicle -> how often its companion was started, where more than once"""
    _niceness: int = 0

    @property
    def file(self) -> Path:
        """The flight's own fleet.toml."""
        return self.options.folder / "fleet.toml"

    @property
    def _truth(self) -> Path:
        return self.options.folder / "truth.bin"

    @property
    def _ready(self) -> Path | None:
        """A file that the SITL instances' host makes once their parameters are set."""
        return None if self.options.px4 is None else self.options.folder / "autopilots.ready"

    def fly(self, tables: dict[str, Any]) -> Flown:
        """Everything but the end of the processes, which is the caller's whatever happens."""
        began_s = time.monotonic()
        config = self._write_configuration(tables)
        self._start_autopilots()
        missing: dict[int, str] = {}
        while True:
            ids = [v.id for v in config.vehicles]
            since_s = time.monotonic()
            self._start_companions(ids)
            with operator_link(config) as link:
                watch = Watch(
                    Operator(config, link), self.processes, ids, self.show, began_s, since_s, self._ready,
                    allow_missing=self.options.allow_missing, tell=self.tell, harm=self._harm,
                    landing_s=self.options.landing_s,
                )  # fmt: skip
                try:
                    answers = watch.take_off(READY_TIMEOUT_S + READY_TIMEOUT_PER_VEHICLE_S * len(ids), self.interrupted)
                except MissingError as error:
                    missing |= error.vehicles
                    self.tell(f"{error}; flying without")
                    config = self._leave_out(tables, ids, missing)
                    continue
                if not answers.all_accepted:
                    gone = (self.processes.why_ended(f"companion-{i}", "at take-off") for i in watch.ended())
                    raise RefusedError("\n".join((answers.sentence("take-off"), *gone)))
                for note in answers.notes:
                    self.tell(note)
                lost = watch.fly(self.options.duration_s, self.options.faults, self.interrupted)
                autopilots_lost = {i: how for i, how in watch.autopilots_ended().items() if i in ids}
            self._end(ids)
            return self._sum_up(config, watch, lost, autopilots_lost, missing)

    def _write_configuration(self, tables: dict[str, Any]) -> FleetConfig:
        config = parse(tables, "fleet.toml")
        if config.stub.signing and self.options.px4 is None and not self.options.external:
            self._make_keys(tables, config)
            config = parse(tables, "fleet.toml")
        _write(self.file, tomli_w.dumps(_without_none(tables)))
        return config

    def _make_keys(self, tables: dict[str, Any], config: FleetConfig) -> None:
        """In the flight's folder, for the vehicles that name none."""
        for v in config.vehicles:
            row = next(row for row in tables["vehicle"] if row["id"] == v.id)
            if row.get("signing_key") is None:
                row["signing_key"] = f"vehicle-{v.id}.key"
                make_key(self.options.folder / row["signing_key"])

    def _start_autopilots(self) -> None:
        options, file = self.options, str(self.file)
        self.processes.fork("reference", ReferenceJob(str(options.folder / "reference.bin")))
        if options.px4 is not None:
            more = [word for p in options.parameters for word in ("--parameter", p)]
            self.processes.spawn(
                "autopilots", "sim", "sitl", "--fleet", file, "--px4", str(options.px4), "--truth", str(self._truth),
                "--ready", str(self._ready), *more, *(["--logs"] if options.logs else []), *self._relays(),
            )  # fmt: skip
        elif not options.external:
            self.processes.fork("autopilots", StubsJob(file, options.seed, str(self._truth), options.ground))

    def _relays(self) -> list[str]:
        """Options for the vehicles whose link a scenario cuts."""
        cut = {f.vehicle_id for f in self.options.faults if f.fault.kind is FaultKind.LINK_LOST}
        return [word for i in sorted(cut) for word in ("--relay", str(i))]

    def _start_companions(self, ids: list[int]) -> None:
        for i in ids:
            if self.interrupted():
                raise CompanionError("interrupted before take-off")
            job = CompanionJob(i, str(self.file), str(self._recording(i)))
            self._niceness = CROWD_NICENESS if len(ids) > CROWD else 0
            self.processes.fork(f"companion-{i}", job, self._niceness)

    def _recording(self, vehicle_id: int, start: int = 1) -> Path:
        """A companion that starts anew records into a file of its own."""
        return self.options.folder / f"vehicle-{vehicle_id}{'' if start == 1 else f'-{start}'}.mcap"

    def _recordings(self, vehicle_id: int) -> list[Path]:
        return [self._recording(vehicle_id, k) for k in range(1, self.starts.get(vehicle_id, 1) + 1)]

    def _harm(self, vehicle_id: int, fault: CompanionFault) -> None:
        name = f"companion-{vehicle_id}"
        if fault.kind is CompanionFaultKind.STOPPED:
            self.processes.stop(name, fault.duration_s)
            return
        self.processes.end([name], 0.0, signal.SIGKILL)
        if fault.kind is CompanionFaultKind.RESTARTED:
            start = self.starts[vehicle_id] = self.starts.get(vehicle_id, 1) + 1
            job = CompanionJob(vehicle_id, str(self.file), str(self._recording(vehicle_id, start)))
            self.processes.fork(name, job, self._niceness)

    def _leave_out(self, tables: dict[str, Any], ids: list[int], missing: Mapping[int, str]) -> FleetConfig:
        """End the companions, which wait for the missing, and write the file of those who are there."""
        if not set(ids) - missing.keys():
            raise MissingError(missing)
        names = [f"companion-{i}" for i in ids]
        self.processes.end(names, END_TIMEOUT_S)
        for i, name in zip(ids, names, strict=True):
            del self.processes.children[name]
            self._recording(i).unlink(missing_ok=True)
        fewer = deepcopy(tables)
        for vehicle in fewer["vehicle"]:
            if vehicle["id"] in missing:
                vehicle["enabled"] = False
        return self._write_configuration(fewer)

    def _end(self, ids: list[int]) -> None:
        self.processes.end([f"companion-{i}" for i in ids], END_TIMEOUT_S)
        self.processes.end([n for n in ("autopilots", "reference") if n in self.processes.children], AUTOPILOTS_GRACE_S)

    def _sum_up(
        self,
        config: FleetConfig,
        watch: Watch,
        lost: frozenset[int],
        autopilots_lost: Mapping[int, str],
        missing: Mapping[int, str],
    ) -> Flown:
        options = self.options
        flight = Flight(
            config=config,
            seed=options.seed,
            truth=np.fromfile(self._truth, TRUTH_DTYPE) if self._truth.exists() else np.zeros(0, TRUTH_DTYPE),
            takeoff_ns=watch.asked_ns,
            centroid_limit_m=CENTROID_M if options.px4 is None else CENTROID_GPS_M,
            lost=lost,
            autopilots_lost=autopilots_lost,
            disarmed={i: not said.armed for i, said in watch.said.items()},
            versions=versions(),
        )
        for i in watch.ids:
            flight.read_files(i, self._recordings(i))
            flight.rejected += Counter(watch.said[i].rejected if i in watch.said else {})
        rows = read_reference_loop(options.folder / "reference.bin")
        flight.reference_lateness_ns = rows[rows[:, 0] >= watch.asked_ns, 1].astype(float)
        summary = {
            **summarise(flight),
            "missing": dict(missing),
            "exit_status": {i: self.processes.exit_status(f"companion-{i}") for i in watch.ids},
            "takeoff_ns": watch.asked_ns,
            "faults_refused": watch.refused,
            "folder": str(options.folder),
            "flight_logs": {i: _flight_logs(options.folder / f"px4-{i}") for i in watch.ids} if options.logs else {},
        }
        _write(options.folder / "summary.json", json.dumps(summary, indent=2) + "\n")
        return Flown(flight, summary)


def _flight_logs(folder: Path) -> list[str]:
    """Where a PX4 has written its logs (ULog), oldest first."""
    return [str(path) for path in sorted(folder.rglob("*.ulg"))]


def _without_none(tables: Any) -> Any:
    if isinstance(tables, dict):
        return {k: _without_none(v) for k, v in tables.items() if v is not None}
    return [_without_none(v) for v in tables] if isinstance(tables, list) else tables


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise CompanionError(f"cannot write {path}: {error.strerror}") from error
