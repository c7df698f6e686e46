"""A recording's inputs under other settings: with its own nothing differs, and what differs is told by its kind."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from companion.errors import ConfigError
from companion.io.recording import RecordingError, read_recording
from companion.io.what_if import Compared, replay_with

GOLDEN = Path(__file__).resolve().parents[1] / "golden" / "px4_flight.mcap"
FLOWN = read_recording(GOLDEN).metadata["config"]


def compared(folder: Path, more: str = "", old: str = "", new: str = "") -> Compared:
    other = folder / "other.toml"
    assert old in FLOWN
    other.write_text(f"{FLOWN.replace(old, new) if old else FLOWN}\n{more}\n")
    return replay_with(GOLDEN, other)


def test_with_its_own_settings_nothing_differs(tmp_path: Path) -> None:
    same = compared(tmp_path)
    recorded = [e for e in read_recording(GOLDEN).entries if e.channel == "output/peer" and b"state" in e.body[:20]]
    assert same.keys == []
    assert same.own.messages == same.other.messages
    assert sum(same.own.messages.values()) == len(recorded)
    d = same.differences()
    assert d["setpoints_alike"] == d["setpoints_own"] == d["setpoints_other"] > 1000
    assert d["velocity_max_m_s"] == d["acceleration_max_m_s2"] == 0.0


def test_another_law_differs_in_its_setpoints_alone(tmp_path: Path) -> None:
    law = compared(tmp_path, "[law]\nk_s = 1.0\nk_c = 2.0")
    d = law.differences()
    assert law.keys == ["law.k_c", "law.k_s"]
    assert law.own.messages == law.other.messages
    assert d["setpoints_alike"] == d["setpoints_own"]
    assert 0.0 < d["acceleration_rms_m_s2"] < d["acceleration_max_m_s2"] < 10.0


def test_a_tighter_trigger_would_have_said_more(tmp_path: Path) -> None:
    tight = compared(tmp_path, "[trigger]\nepsilon_m = 0.05")
    wide = compared(tmp_path, "[trigger]\nepsilon_m = 1.0")
    assert tight.other.messages["triggered"] > tight.own.messages["triggered"] > wide.other.messages["triggered"]


def test_ticks_of_different_motions_are_not_compared(tmp_path: Path) -> None:
    plan = compared(tmp_path, old="north_m_s = 1.0", new="north_m_s = 0.5")
    d = plan.differences()
    assert 0 < d["setpoints_alike"] <= d["setpoints_own"]
    assert "plan.legs" in plan.keys


def test_what_cannot_be_compared_is_refused(tmp_path: Path) -> None:
    other = tmp_path / "other.toml"
    other.write_text(FLOWN.replace("{ id = 1 },", "{ id = 9 },"))
    with pytest.raises(
        ConfigError, match=r"other.toml: has no enabled vehicle 1, which .*px4_flight.mcap is the record"
    ):
        replay_with(GOLDEN, other)
    cut = tmp_path / "text.mcap"
    cut.write_text("no recording")
    with pytest.raises(RecordingError, match=r"text.mcap: is no MCAP file"):
        replay_with(cut, other)


def test_the_command_tells_it_to_people_and_to_programs(tmp_path: Path) -> None:
    other = tmp_path / "other.toml"
    other.write_text(f"{FLOWN}\n[law]\nk_c = 2.0\n")

    def replay(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-P", "-m", "companion", "replay", str(GOLDEN), *words], capture_output=True, text=True,
            check=False,
        )  # fmt: skip

    told = replay("--config", str(other))
    assert (told.returncode, told.stderr) == (0, "")
    assert told.stdout.startswith("differs in law.k_c\nstate messages in 50.2 s: ")
    said = json.loads(replay("--config", str(other), "--json").stdout)
    assert said["keys"] == ["law.k_c"]
    assert said["recorded"] == said["other"]
    assert said["setpoints"]["acceleration_max_m_s2"] > 0.0
    assert "replay --json belongs to --config FILE" in replay("--json").stderr
