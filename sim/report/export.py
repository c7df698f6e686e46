"""Recordings as tables for spreadsheets and pandas, and what a recording holds."""

import csv
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from companion.core.events import sentence
from companion.errors import CompanionError, ConfigError
from companion.io.recording import read_recording
from companion.io.records import TickRecord
from companion.wire.events import KINDS
from sim.launch.summary.flight import Flight

KIND_OF = {event: kind for kind, event in KINDS.items()}
TABLES = ("ticks.csv", "messages.csv", "events.csv")


def write_tables(flight: Flight, folder: Path) -> list[Path]:
    """Write a flight's ticks, messages and events as CSV into a folder, which is made; returns the files.

    Times: `time_s` since take-off, `fleet_ns` UTC. Positions and velocities are each vehicle's own belief, fleet frame
    (NED). Overwrites nothing: ConfigError if a file is there. CompanionError if one cannot be written.
    """
    paths = [folder / name for name in TABLES]
    if there := [str(path) for path in paths if path.exists()]:
        raise ConfigError(f"{', '.join(there)} is there already: name another folder with --out")
    head = ("vehicle", "time_s", "fleet_ns")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write(paths[0], (*head, *TickRecord._fields), _ticks(flight))
        _write(
            paths[1], (*head, "topic", "bytes"),
            ((p.vehicle_id, _since(flight, p.time_ns), p.time_ns, p.topic, p.size) for p in flight.puts),
        )  # fmt: skip
        _write(
            paths[2], (*head, "kind", "text"),
            ((i, _since(flight, ns), ns, KIND_OF[type(e)], sentence(e)) for ns, i, e in flight.events),
        )  # fmt: skip
    except OSError as error:
        raise CompanionError(f"cannot write to {folder}: {error.strerror}") from error
    return paths


def _since(flight: Flight, time_ns: int) -> str:
    return f"{(time_ns - flight.takeoff_ns) * 1e-9:.6f}"


def _ticks(flight: Flight) -> Iterable[Sequence[Any]]:
    for i, rows in sorted(flight.ticks.items()):
        for row in rows.tolist():
            fleet_ns, *rest = row
            yield i, _since(flight, fleet_ns), fleet_ns, *rest


def _write(path: Path, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    with path.open("x", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(head)
        out.writerows(rows)


def info(path: Path) -> list[tuple[str, str]]:
    """What a recording holds, as rows; RecordingError if it is none."""
    recording = read_recording(path)
    facts = recording.metadata
    channels: Counter[str] = Counter()
    first = last = None
    for entry in recording.entries:
        channels[entry.channel] += 1
        first = first or entry
        last = entry
    seconds = 0.0 if first is None or last is None else (last.instant.monotonic_ns - first.instant.monotonic_ns) * 1e-9
    gaps = list(recording.gaps())
    return [
        ("file", str(path)),
        ("vehicle", facts.get("vehicle_id", "not told")),
        ("software", facts.get("version", "not told")),
        ("begins (UTC ns)", "-" if first is None else str(first.instant.fleet_ns)),
        ("lasts", f"{seconds:.1f} s"),
        ("closed", "yes" if recording.complete else "no: its process was killed, or the file is cut short"),
        ("missing", "nothing" if not gaps else "; ".join(gap.sentence() for gap in gaps[:5])),
        *((f"  {name}", str(count)) for name, count in sorted(channels.items())),
    ]
