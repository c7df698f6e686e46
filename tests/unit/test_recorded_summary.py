"""`fleet summary` on recordings: one vehicle's alone, several take-offs, and what is none of one flight."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from companion.core.events import PhaseChanged
from companion.core.values import Phase
from companion.errors import CompanionError, ConfigError
from companion.io.recording import read_recording
from sim.launch.summary.recorded import one_of, recorded_flight, recordings_of, takeoffs_ns
from sim.launch.summary.summarise import summarise

GOLDEN = Path(__file__).resolve().parents[1] / "golden" / "px4_flight.mcap"


def test_one_vehicles_recording_is_summed_up_and_the_others_are_named() -> None:
    flight, missing = recorded_flight([GOLDEN])
    (vehicle,) = flight.config.vehicles
    assert vehicle.id not in missing
    assert missing
    assert flight.takeoff_ns == takeoffs_ns(flight)[0]
    figures = summarise(flight)
    assert figures["judged_by"] == "the vehicles' own estimates"
    assert figures["formed_after_s"] > 0.0
    assert figures["believed"]["slot_error_rms_m"] < 1.0
    assert figures["failsafes"] == []


def test_a_folder_stands_for_its_recordings_and_a_file_that_is_named_twice_counts_once(tmp_path: Path) -> None:
    shutil.copy(GOLDEN, tmp_path / "b.mcap")
    shutil.copy(GOLDEN, tmp_path / "a.mcap")
    (tmp_path / "notes.txt").write_text("no recording")
    a, b = tmp_path / "a.mcap", tmp_path / "b.mcap"
    assert recordings_of([tmp_path, a]) == [a, b]


def wrong(folder: Path) -> dict[str, tuple[list[str], str]]:
    (folder / "empty").mkdir()
    (folder / "text.mcap").write_text("no recording")
    cut = folder / "cut.mcap"
    cut.write_bytes(GOLDEN.read_bytes()[:4000])
    return {
        "an empty folder": ([str(folder / "empty")], "no recording (*.mcap) is in this folder"),
        "no file": ([str(folder / "none.mcap")], "none.mcap: cannot be read: No such file or directory"),
        "another file": ([str(folder / "text.mcap")], "text.mcap: is no MCAP file"),
        "a flight that was not": ([str(GOLDEN), "--flight", "7"], "--flight must be 1 to 1: so many take-offs are"),
    }


@pytest.mark.parametrize("name", ["an empty folder", "no file", "another file", "a flight that was not"])
def test_what_is_no_flight_ends_with_a_sentence_and_status_2(name: str, tmp_path: Path) -> None:
    words, said = wrong(tmp_path)[name]
    done = subprocess.run(
        [sys.executable, "-P", "-m", "sim", "summary", *words], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("fleet: ")
    assert said in done.stderr
    assert "Traceback" not in done.stderr


def test_recordings_of_two_fleets_are_refused_with_the_keys_that_differ(tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    content = GOLDEN.read_bytes()
    assert content.count(b"altitude_m = ") == 1
    at = content.index(b"altitude_m = ") + len(b"altitude_m = ")
    other.write_bytes(content[:at] + b"7" + content[at + 1 :])
    with pytest.raises(
        CompanionError, match=r"other\.mcap: is of another fleet file than .*: formation\.altitude_m differ"
    ):
        recorded_flight([GOLDEN, other])


def test_a_copy_of_a_recording_counts_nothing_twice(tmp_path: Path) -> None:
    shutil.copy(GOLDEN, tmp_path / "copy.mcap")
    with pytest.raises(
        CompanionError, match=r"copy\.mcap: is of the same companion's life as .*px4_flight\.mcap: give one"
    ):
        recorded_flight([GOLDEN, tmp_path])


@pytest.mark.parametrize(("hours", "fits"), [(23.9, True), (24.1, False), (1e6, False)])
def test_a_flight_longer_than_a_day_is_refused_before_it_fills_the_computer(hours: float, fits: bool) -> None:
    flight, _ = recorded_flight([GOLDEN])
    ((vehicle, ticks),) = flight.ticks.items()
    ticks["fleet_ns"][-1] = flight.takeoff_ns + round(hours * 3600e9)
    if fits:
        assert len(one_of(flight, None, set()).ticks[vehicle]) == len(ticks)
    else:
        with pytest.raises(
            ConfigError, match=r"the flight would last \d+ hours, may last 24: a clock was set in between"
        ):
            one_of(flight, None, set())


def test_a_companion_whose_recording_ends_open_in_the_air_was_lost_in_flight(tmp_path: Path) -> None:
    whole, _ = recorded_flight([GOLDEN])
    assert whole.lost == frozenset()
    moving = next(ns for ns, _, e in whole.events if isinstance(e, PhaseChanged) and e.after is Phase.MOVING)
    entries = list(read_recording(GOLDEN).entries)
    share = sum(e.instant.fleet_ns <= moving + 10**9 for e in entries) / len(entries)
    killed = tmp_path / "killed.mcap"
    killed.write_bytes(GOLDEN.read_bytes()[: round(share * GOLDEN.stat().st_size)])
    flight, _ = recorded_flight([killed])
    assert flight.lost == {1}
    assert summarise(flight)["passed"] is False
