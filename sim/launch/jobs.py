"""What the server's forked processes do: the functions behind `companion run`, `fleet stub` and the empty loop.

A job travels as JSON and runs without a command line: to parse one costs a process 5 MB of its own.
"""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import ClassVar

from companion.config import FleetConfig
from companion.config.file import parse_text, read_text
from companion.io.process import fly_vehicle
from sim.autopilot.stub_fleet import check_stub_links, stub_settings
from sim.autopilot.stubs import run_stubs
from sim.launch.reference_loop import run_reference_loop

LIFELINE = 0
"""standard input of every job: its end means that the launcher is gone"""
STUBS_GRACE_S = 1.3
"""stubs stay this long, so that landing commands still arrive"""


@dataclass(slots=True)
class FleetFiles:
    """Reads the fleet's file; the same text is validated once: by the server, for all that it forks."""

    _read: dict[Path, tuple[str, FleetConfig]] = field(default_factory=dict)

    def read(self, path: Path) -> tuple[str, FleetConfig]:
        """Text and configuration; ConfigError as `load`."""
        text = read_text(path)
        if path not in self._read or self._read[path][0] != text:
            self._read[path] = text, parse_text(text, path)
        return self._read[path]


@dataclass(frozen=True, slots=True)
class CompanionJob:
    """One vehicle's companion."""

    program: ClassVar[str] = "companion"
    vehicle: int
    fleet: str
    """path of its file"""
    record: str | None = None

    @property
    def title(self) -> list[str]:
        """The command that does the same."""
        record = [] if self.record is None else ["--record", self.record]
        return ["companion", "run", "--vehicle", str(self.vehicle), "--fleet", self.fleet, *record, "--launched"]

    def run(self, files: FleetFiles) -> int:
        """Until the vehicle is landed; exit status."""
        file = Path(self.fleet)
        text, config = files.read(file)
        record = None if self.record is None else Path(self.record)
        return fly_vehicle(config, self.vehicle, file, text, record=record, stop_fd=LIFELINE)


@dataclass(frozen=True, slots=True)
class StubsJob:
    """The stand-in autopilots of a whole fleet."""

    program: ClassVar[str] = "fleet"
    fleet: str
    """path of its file"""
    seed: int = 0
    truth: str | None = None
    ground: bool = False

    @property
    def title(self) -> list[str]:
        """The command that does the same."""
        truth = [] if self.truth is None else ["--truth", self.truth]
        ground = ["--gcs"] if self.ground else []
        return ["fleet", "stub", "--fleet", self.fleet, "--seed", str(self.seed), *truth, *ground, "--launched"]

    def run(self, files: FleetFiles) -> int:
        """Until the launcher is gone."""
        _, config = files.read(Path(self.fleet))
        check_stub_links(config)
        truth = None if self.truth is None else Path(self.truth)
        run_stubs(
            stub_settings(
                config,
                seed=self.seed,
                truth_path=truth,
                stop_fd=LIFELINE,
                grace_s=STUBS_GRACE_S,
                ground=self.ground,
                folder=Path(self.fleet).parent,
            )
        )
        return 0


@dataclass(frozen=True, slots=True)
class ReferenceJob:
    """The empty 50 Hz loop that a flight's lateness is compared with."""

    program: ClassVar[str] = "fleet"
    fleet: ClassVar[None] = None
    out: str

    @property
    def title(self) -> list[str]:
        """As `ps` shows it."""
        return ["fleet", "reference loop", self.out]

    def run(self, files: FleetFiles) -> int:  # noqa: ARG002
        """Until the launcher is gone."""
        run_reference_loop(Path(self.out), LIFELINE)
        return 0


Job = CompanionJob | StubsJob | ReferenceJob
_KINDS: dict[str, type[Job]] = {kind.__name__: kind for kind in (CompanionJob, StubsJob, ReferenceJob)}


def encode(job: Job, niceness: int) -> bytes:
    """For the server's socket."""
    return json.dumps([type(job).__name__, niceness, asdict(job)]).encode()


def decode(message: bytes) -> tuple[Job, int]:
    """A job and its niceness."""
    kind, niceness, fields = json.loads(message)
    return _KINDS[kind](**fields), niceness
