"""`fleet summary` on recordings: one vehicle's alone, several take-offs, and what is none of one flight."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from companion.errors import CompanionError
from sim.launch.summary.recorded import recorded_flight, recordings_of, takeoffs_ns
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
