"""Recordings as tables: every row of a flight, with times since take-off; and what a recording holds."""

import csv
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from companion.core.events import sentence
from companion.errors import CompanionError, ConfigError
from companion.io.recording import RecordingError, read_recording
from companion.wire.events import KINDS
from sim.launch.summary.flight import Flight
from sim.launch.summary.recorded import recorded_flight
from sim.report.export import TABLES, info, write_tables

GOLDEN = Path(__file__).resolve().parents[1] / "golden" / "px4_flight.mcap"


@pytest.fixture(scope="module")
def flight() -> Flight:
    return recorded_flight([GOLDEN])[0]


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_every_tick_message_and_event_is_a_row(flight: Flight, tmp_path: Path) -> None:
    written = write_tables(flight, tmp_path / "new" / "tables")
    assert [path.name for path in written] == list(TABLES)
    ticks, messages, events = map(rows, written)
    ((vehicle, recorded),) = flight.ticks.items()
    assert {row["vehicle"] for row in ticks} == {str(vehicle)}
    assert [int(row["fleet_ns"]) for row in ticks] == recorded["fleet_ns"].tolist()
    assert np.allclose([float(row["north_m"]) for row in ticks], recorded["north_m"])
    assert [row["steered"] for row in ticks] == [str(x) for x in recorded["steered"].tolist()]
    since = [(int(row["fleet_ns"]) - flight.takeoff_ns) * 1e-9 for row in ticks]
    assert np.allclose([float(row["time_s"]) for row in ticks], since, atol=1e-6)
    assert [(row["topic"], int(row["bytes"])) for row in messages] == [(p.topic, p.size) for p in flight.puts]
    assert [row["text"] for row in events] == [sentence(e) for _, _, e in flight.events]
    assert {row["kind"] for row in events} <= KINDS.keys()


def test_nothing_is_overwritten(flight: Flight, tmp_path: Path) -> None:
    mine = tmp_path / TABLES[1]
    mine.write_text("mine")
    with pytest.raises(ConfigError, match=r"messages.csv is there already: name another folder with --out"):
        write_tables(flight, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [TABLES[1]]
    assert mine.read_text() == "mine"


def test_a_place_that_cannot_be_written_is_told(flight: Flight, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CompanionError, match=r"cannot write to .*file: (File exists|Not a directory)"):
        write_tables(flight, tmp_path / "file")


def test_a_recordings_entries_are_counted_by_channel() -> None:
    told = dict(info(GOLDEN))
    entries = list(read_recording(GOLDEN).entries)
    assert (told["vehicle"], told["closed"], told["missing"]) == ("1", "yes", "nothing")
    assert {k.strip(): int(v) for k, v in told.items() if k.startswith("  ")} == {
        name: sum(e.channel == name for e in entries) for name in {e.channel for e in entries}
    }
    lasted_s = (entries[-1].instant.monotonic_ns - entries[0].instant.monotonic_ns) * 1e-9
    assert told["lasts"] == f"{lasted_s:.1f} s"


@pytest.mark.parametrize("bytes_kept", [40_000, 300_000])
def test_a_recording_that_was_cut_short_says_so(bytes_kept: int, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(GOLDEN.read_bytes()[:bytes_kept])
    assert dict(info(cut))["closed"].startswith("no: its process was killed")
    (tmp_path / "text.mcap").write_text("no recording")
    with pytest.raises(RecordingError, match=r"text.mcap: is no MCAP file"):
        info(tmp_path / "text.mcap")


def test_flights_stand_side_by_side_and_one_alone_is_refused(tmp_path: Path) -> None:
    def compare(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-P", "-m", "sim", "compare", *words], cwd=tmp_path, capture_output=True, text=True,
            check=False, env={**os.environ, "COLUMNS": "200"},
        )  # fmt: skip

    done = compare(str(GOLDEN), str(GOLDEN))
    assert done.returncode == 0, done.stderr
    (formed,) = (line for line in done.stdout.splitlines() if line.startswith("formed after"))
    one, other = formed.removeprefix("formed after").replace(" s", "").split()
    assert float(one) == float(other) > 0.0
    done = compare(str(GOLDEN))
    assert (done.returncode, done.stderr) == (2, "fleet: compare needs two flights or more, got 1\n")
