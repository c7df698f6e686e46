"""What cannot be started ends with a sentence and its exit status, before anything flies."""

from __future__ import annotations

import socket
import sys
from pathlib import Path

import pytest
from fleet_process import (
    make_fleet,
    run,
    status_json,
)

from companion.__main__ import main as companion_main
from sim.__main__ import main as fleet_main

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]
LOOPBACK = "127.0.0.1"


# -- wrong usage -----------------------------------------------------------------------------------------------------


WRONG = {
    "an unknown vehicle": (("companion", "run", "--vehicle", "9", "--fleet", "{fleet}"), "vehicle 9 is not an enabled"),
    "no file": (("companion", "run", "--vehicle", "1", "--fleet", "nowhere.toml"), "nowhere.toml: cannot be read"),
    "a bad file": (("companion", "run", "--vehicle", "1", "--fleet", "{bad}"), "$.fleet.colour is not a known key"),
    "a replay of nothing": (("companion", "replay", "nowhere.mcap"), "nowhere.mcap: cannot be read"),
    "a replay of something else": (("companion", "replay", "{fleet}"), "is no MCAP file"),
    "a bad file for a flight": (("fleet", "up", "--fleet", "{bad}"), "$.fleet.colour is not a known key"),
    "an unknown leg": (
        ("fleet", "up", "--fleet", "{fleet}", "--plan", "loop:3"),
        "--plan: leg 'loop:3' must be one of",
    ),
    "a stub on a serial line": (("fleet", "stub", "--fleet", "{serial}"), "speaks to udp://127.0.0.1:PORT only"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_usage_ends_with_a_sentence_and_status_2(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments, words = WRONG[case]
    fleet = make_fleet(tmp_path, 1)
    bad, serial = tmp_path / "bad.toml", tmp_path / "serial.toml"
    bad.write_text(fleet.file.read_text().replace("[fleet]", '[fleet]\ncolour = "red"'))
    serial.write_text(fleet.file.read_text().replace(f"udp://127.0.0.1:{fleet.port}", "serial:///dev/ttyS0:921600"))
    names = {"{fleet}": str(fleet.file), "{bad}": str(bad), "{serial}": str(serial)}
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [names.get(a, a) for a in arguments])
    with pytest.raises(SystemExit) as ended:
        (companion_main if arguments[0] == "companion" else fleet_main)()
    said = capsys.readouterr()
    assert ended.value.code == 2
    assert words in said.err
    assert said.out == ""


def test_a_recording_that_cannot_be_opened_ends_with_a_sentence_and_status_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = make_fleet(tmp_path, 1).file
    monkeypatch.chdir(tmp_path)
    arguments = ["companion", "run", "--vehicle", "1", "--fleet", str(file), "--record", "no/way.mcap"]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit) as ended:
        companion_main()
    assert ended.value.code == 1
    assert "--record no/way.mcap: cannot be written" in capsys.readouterr().err


def test_a_companion_with_a_bad_file_ends_with_a_sentence_and_no_traceback(tmp_path: Path) -> None:
    done = run("companion", "run", "--vehicle", "1", "--fleet", "nowhere.toml", folder=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "companion: nowhere.toml: cannot be read: No such file or directory\n"


def test_a_port_in_use_ends_the_launcher_with_a_sentence_that_names_it(tmp_path: Path) -> None:
    fleet = make_fleet(tmp_path, 1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind((LOOPBACK, fleet.port + 40))
        done = run("sim", "up", "--fleet", str(fleet.file), "--out", str(tmp_path / "o"), folder=tmp_path)
    assert done.returncode == 1
    assert f"vehicle 1: UDP port {fleet.port + 40} of its autopilot is in use" in done.stderr
    assert "Traceback" not in done.stderr


def test_nobody_up_is_said_by_the_operators_verbs(tmp_path: Path) -> None:
    fleet = make_fleet(tmp_path, 1)
    assert status_json(fleet) == (1, {1: None})
    done = run("sim", "hold", "--fleet", str(fleet.file), folder=tmp_path)
    assert done.returncode == 1
    assert "no vehicle answers" in done.stderr
