"""Everything that is known of one flight, read from its companions' recordings."""

import struct
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from companion.config import FleetConfig
from companion.core.events import Event, MotionAdopted
from companion.core.trajectory.fleet import FleetTrajectory
from companion.core.trajectory.history import TrajectoryHistory
from companion.errors import WireError
from companion.io.recording import Entry, RecordingError, read_recording
from companion.io.records import TickRecord, TrafficRecord, split_peer_body
from companion.wire import operator as protocol
from companion.wire.events import decode_event
from companion.wire.peer import encode_motion

Array = npt.NDArray[Any]
GAPS_TOLD_MOST = 5
CENTROID_M, CENTROID_GPS_M = 0.5, 1.0
"""limits of the centroid's error: an estimator with a GPS of its own is off by more, as PX4's is in SITL"""
_FORMATS = {int: "i8", float: "f8", bool: "?"}
TICK_ROWS = np.dtype(
    [("fleet_ns", "i8"), *((name, _FORMATS[kind]) for name, kind in TickRecord.__annotations__.items())]
)
"""a tick's time and the fields of TickRecord"""
TRAFFIC_ROWS = np.dtype([("fleet_ns", "i8"), ("packets_sent", "i8"), ("bytes_sent", "i8")])
POSITION = ("north_m", "east_m", "down_m")
VELOCITY = ("north_m_s", "east_m_s", "down_m_s")
"""fields of TICK_ROWS, by axis"""


@dataclass(frozen=True, slots=True)
class Put:
    """One message of a vehicle to its peers."""

    time_ns: int
    vehicle_id: int
    topic: str
    size: int


@dataclass(slots=True)
class Command:
    """One command of an operator, and what the vehicles answered."""

    time_ns: int
    """when the first vehicle had it"""
    order: protocol.Command
    accepted: list[int] = field(default_factory=list)
    refused: dict[int, str] = field(default_factory=dict)
    """vehicle -> why"""
    unanswered: list[int] = field(default_factory=list)
    """whoever had it and ended before its answer"""


@dataclass(slots=True)
class Flight:
    """Everything that is known of one flight. Times are fleet time (UTC, ns)."""

    config: FleetConfig
    seed: int
    truth: Array
    """TRUTH_DTYPE records; none where nobody knows"""
    takeoff_ns: int
    centroid_limit_m: float = CENTROID_M
    """how far the centroid may be from the plan, in truth"""
    disarmed: Mapping[int, bool] = field(default_factory=dict)
    """vehicle -> whether its companion said so last; asked where there is no truth"""
    commands: dict[bytes, Command] = field(default_factory=dict)
    """payload -> command; the same bytes again are a retry"""
    commands_unread: int = 0
    """what came as a command and was none"""
    puts: list[Put] = field(default_factory=list)
    events: list[tuple[int, int, Event]] = field(default_factory=list)
    """(time, vehicle, what happened)"""
    ticks: dict[int, Array] = field(default_factory=dict)
    """vehicle -> TICK_ROWS"""
    traffic: dict[int, Array] = field(default_factory=dict)
    """vehicle -> TRAFFIC_ROWS"""
    rejected: Counter[str] = field(default_factory=Counter)
    lost: frozenset[int] = frozenset()
    """vehicles whose companion ended in flight"""
    autopilots_lost: Mapping[int, str] = field(default_factory=dict)
    """vehicle -> how its autopilot ended in flight"""
    reference_lateness_ns: Array | None = None
    versions: Mapping[str, str] = field(default_factory=dict)
    unrecorded: dict[int, str] = field(default_factory=dict)
    """vehicle -> what its recording lacks"""

    def read_files(self, vehicle_id: int, paths: Sequence[Path]) -> None:
        """Take the recordings of one vehicle's companion, one for each of its starts, as far as they are there; what
        they lack is told in the summary."""
        ticks, traffic, lacking = [], [], []
        for path in paths:
            try:
                recording = read_recording(path)
                self.read(vehicle_id, recording.entries)
                lacking += [gap.sentence() for gap in recording.gaps()]
            except RecordingError as error:
                lacking.append(str(error))
            ticks.append(self.ticks.pop(vehicle_id, np.zeros(0, TICK_ROWS)))
            traffic.append(self.traffic.pop(vehicle_id, np.zeros(0, TRAFFIC_ROWS)))
        self.ticks[vehicle_id], self.traffic[vehicle_id] = np.concatenate(ticks), np.concatenate(traffic)
        if lacking:
            self.unrecorded[vehicle_id] = "; ".join(lacking[:GAPS_TOLD_MOST])

    def read(self, vehicle_id: int, entries: Iterable[Entry]) -> None:
        """Take one companion's recording; RecordingError for an entry that cannot be read, all before it is taken."""
        ticks: list[tuple[float, ...]] = []
        traffic: list[tuple[float, ...]] = []
        asked: Command | None = None
        try:
            for entry in entries:
                asked = self._read(vehicle_id, entry, asked, ticks, traffic)
        finally:
            self.ticks[vehicle_id] = np.array(ticks, TICK_ROWS)
            self.traffic[vehicle_id] = np.array(traffic, TRAFFIC_ROWS)

    def _read(
        self, vehicle_id: int, entry: Entry, asked: Command | None, ticks: list[tuple[float, ...]],
        traffic: list[tuple[float, ...]],
    ) -> Command | None:  # fmt: skip
        """Take one entry; returns the command whose answer comes next."""
        now = entry.instant.fleet_ns
        try:
            match entry.channel:
                case "tick":
                    ticks.append((now, *TickRecord.unpack(entry.body)))
                case "traffic":
                    traffic.append((now, *TrafficRecord.unpack(entry.body)))
                case "event":
                    self.events.append((now, vehicle_id, decode_event(entry.body)))
                case "output/peer":
                    topic, payload = split_peer_body(entry.body)
                    self.puts.append(Put(now, vehicle_id, topic, len(payload)))
                case "input/command":
                    return self._command(now, vehicle_id, entry.body)
                case "output/answer" if asked is not None:
                    _answer(asked, vehicle_id, entry.body)
        except (struct.error, ValueError, KeyError, TypeError, WireError) as error:
            where = f"vehicle {vehicle_id}'s recording"
            raise RecordingError(where, f"entry {entry.sequence} ({entry.channel}) cannot be read: {error}") from None
        return None

    def _command(self, time_ns: int, vehicle_id: int, payload: bytes) -> Command | None:
        try:
            order = protocol.decode_command(payload)
        except WireError:
            self.commands_unread += 1
            return None
        command = self.commands.setdefault(payload, Command(time_ns, order))
        command.time_ns = min(command.time_ns, time_ns)
        if vehicle_id not in (*command.accepted, *command.refused, *command.unanswered):
            command.unanswered.append(vehicle_id)
        return command

    @property
    def staying(self) -> list[int]:
        """Vehicles whose companions flew to the end."""
        return [v.id for v in self.config.vehicles if v.id not in self.lost]

    def history(self) -> TrajectoryHistory:
        """The motions that most of the vehicles flew by, one of each revision.

        Most, of those whose companions flew to the end: what one vehicle adopted and the others refused is no motion of
        the formation. Of two of one revision that most adopted, the one that wins with every vehicle.
        """
        adopted: dict[bytes, tuple[FleetTrajectory, set[int]]] = {}
        for _, i, event in self.events:
            if isinstance(event, MotionAdopted) and i in self.staying:
                adopted.setdefault(encode_motion(event.motion), (event.motion, set()))[1].add(i)
        best: dict[int, FleetTrajectory] = {0: self.config.first_motion}
        for motion, by in sorted(adopted.values(), key=lambda flown: flown[0].order):
            if 2 * len(by) > len(self.staying):
                best[motion.revision] = motion
        return TrajectoryHistory([best[r] for r in sorted(best)])


def _answer(command: Command, vehicle_id: int, body: bytes) -> None:
    """Keep a vehicle's first answer: a retry gets the same."""
    if vehicle_id not in command.unanswered:
        return
    command.unanswered.remove(vehicle_id)
    said = protocol.decode(protocol.Answer, body)
    if said.accepted:
        command.accepted.append(vehicle_id)
    else:
        command.refused[vehicle_id] = said.reason or ""
