"""Wrong command lines, as people type them: each ends with a sentence that says what is allowed, and no traceback."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import companion.__main__
import sim.__main__

ROOT = Path(__file__).resolve().parents[2]
SIX = str(ROOT / "examples" / "six-quads-mesh" / "fleet.toml")
GOLDEN = str(ROOT / "tests" / "golden" / "px4_flight.mcap")
FLEET, COMPANION = sim.__main__.main, companion.__main__.main

WRONG: dict[str, tuple[Callable[[], None], int, str]] = {
    # fleet up
    "up --vehicles 0": (FLEET, 2, "greater than or equal to 1"),
    "up --vehicles three": (FLEET, 2, "Input should be a valid integer"),
    "up --seed -1": (FLEET, 2, "greater than or equal to 0"),
    "up --for 0": (FLEET, 2, "greater than or equal to 1"),
    "up --fleet none.toml": (FLEET, 2, "none.toml: cannot be read: No such file or directory"),
    "up --fleet .": (FLEET, 2, ".: cannot be read: Is a directory"),
    f"up --fleet {SIX}": (FLEET, 2, "one computer has one of it: start `companion run --vehicle ID`"),
    f"up --fleet {SIX} --rehearse --autopilot external": (FLEET, 2, "vehicles that run already are no rehearsal"),
    f"stub --fleet {SIX}": (FLEET, 2, "vehicles 1, 2, 3, 4, 5, 6 have one line"),
    "status --watch --json": (FLEET, 2, "status needs --watch or --json, got both"),
    "compare x.mcap": (FLEET, 2, "compare needs two flights or more, got 1"),
    "up --formation zigzag": (FLEET, 2, "$.formation.shape must be one of v, line, column, circle"),
    "up --plan velocity:1:0": (FLEET, 2, "--plan: leg 'velocity:1:0' must be hold:S, velocity:N:E:S, turn:DEG_S[:DEG]"),
    "up --plan velocity:1:0:x": (FLEET, 2, "must have numbers after its kind"),
    "up --plan fly:1": (FLEET, 2, "leg 'fly:1' must be one of hold:S"),
    "up --plan velocity:9:0:20": (FLEET, 2, "speed must be <= 3 m/s (3/4 of $.limits.speed_max_m_s), got 9"),
    "up --plan velocity:1:0:900": (FLEET, 2, "must stay inside the fence by its margin"),
    "up --autopilot ardupilot": (FLEET, 2, "--autopilot must be stub, px4 or external, got 'ardupilot'"),
    "up --px4 .": (FLEET, 2, "--px4 needs --autopilot px4, got --autopilot stub"),
    "up --autopilot px4 --px4 /tmp": (FLEET, 2, "--px4 /tmp: is no PX4 build folder (needs bin/px4 and etc/)"),
    "up --parameter MPC_XY_VEL_MAX=3": (FLEET, 2, "--parameter is for the instances of --autopilot px4"),
    "up --autopilot px4 --parameter A": (FLEET, 2, "NAME=VALUE"),
    "up --logs": (FLEET, 2, "--logs is for the instances of --autopilot px4"),
    "up --autopilot external --gcs": (FLEET, 2, "--gcs is for --autopilot stub"),
    "up --scenario none.toml": (FLEET, 2, "none.toml: cannot be read: No such file or directory"),
    "up --first-instance 500": (FLEET, 2, "200"),
    "up --colour red": (FLEET, 2, "No such option: --colour"),
    # the operator's verbs
    "flyy": (FLEET, 2, "No such command 'flyy'"),
    "land --vehicle 99": (FLEET, 2, "vehicle 99 is not an enabled vehicle of this fleet; there are 1, 2, 3"),
    "form": (FLEET, 2, "Missing argument 'shape'"),
    "form zigzag": (FLEET, 2, "must be one of v, line, column"),
    "move": (FLEET, 2, "move needs exactly one of --velocity, --turn, --goto, --free, got none"),
    "move --velocity 1 0 0 --free": (FLEET, 2, "got --velocity and --free"),
    "move --velocity 1 0": (FLEET, 2, "requires 3 arguments"),
    "move --altitude 5 --velocity 1 0 0": (FLEET, 2, "move --altitude belongs to --goto, got it with --velocity"),
    "move --turn 0 90": (FLEET, 2, "the rate must not be 0 deg/s, got 0; to stop the formation, use hold"),
    "move --goto 1 1 --vehicle 2": (FLEET, 2, "with --vehicle nobody shares one"),
    "scare --at 20000 0": (FLEET, 2, "scare --at: each number must be within 10000 m, got 20000 0"),
    "scare --at 1 1 --radius 900": (FLEET, 2, "less than or equal to 50"),
    "kill": (FLEET, 1, "kill was not confirmed: type kill when it asks, or give --yes"),
    # faults, laws, studies, recordings, files
    "fault 3 nothing": (FLEET, 2, "fault must be one of gps_lost"),
    "fault 3 wind --wind 900 0": (FLEET, 2, "at most 30 m/s"),
    "law check flock": (FLEET, 2, "$.law.kind must be one of starling, paper, intent, got 'flock'"),
    "study nothing": (FLEET, 2, "there is no study 'nothing'; known are example1"),
    "study table3 --seeds x": (FLEET, 2, "--seeds must look like 0..19 or 0,3,5, got 'x'"),
    "study all --setup mine.toml": (FLEET, 2, "--setup belongs to one study: name it instead of all"),
    "study table3 --setup none.toml": (FLEET, 2, "none.toml: cannot be read: No such file or directory"),
    f"study table3 --setup {SIX}": (FLEET, 2, "is no set-up of the study table3: $.base is missing"),
    "study table3 --autopilot px4": (FLEET, 2, "--autopilot px4 is for the campaign alone, got the study 'table3'"),
    "summary none.mcap": (FLEET, 2, "none.mcap: cannot be read: No such file or directory"),
    "summary .": (FLEET, 2, ".: no recording (*.mcap) is in this folder"),
    f"report {SIX}": (FLEET, 2, "fleet.toml: is no MCAP file"),
    f"report {GOLDEN} --flight 7": (FLEET, 2, "--flight must be 1 to 1: so many take-offs are recorded, got 7"),
    f"report {GOLDEN} --out none/page.html": (FLEET, 1, "cannot write none/page.html: No such file or directory"),
    "check none.toml": (FLEET, 2, "none.toml: cannot be read: No such file or directory"),
    "init --network mesh": (FLEET, 2, "--network must be laptop or field, got 'mesh'"),
    "init --line x": (FLEET, 2, "--line belongs to --network field, got it with laptop"),
    # companion
    "run": (COMPANION, 2, "Missing option '--vehicle'"),
    "run --vehicle 99 --fleet {file}": (COMPANION, 2, "vehicle 99 is not an enabled vehicle of this fleet"),
    "run --vehicle 251": (COMPANION, 2, "less than or equal to 250"),
    "run --vehicle 1": (COMPANION, 2, "fleet.toml: cannot be read: No such file or directory"),
    "replay none.mcap": (COMPANION, 2, "none.mcap: cannot be read: No such file or directory"),
    f"replay {SIX}": (COMPANION, 2, "fleet.toml: is no MCAP file"),
    "px4-params --px4 1.15 x.params --fleet {file}": (
        COMPANION,
        2,
        "must be one of 1.16, 1.17, 1.18, main, got '1.15'",
    ),
    "px4-params --px4 1.18 none/x.params --fleet {file}": (COMPANION, 1, "cannot write none/x.params: No such file"),
    "signing make none/x.key": (COMPANION, 1, "cannot write none/x.key: No such file or directory"),
    "signing give --vehicle 1 --fleet {file}": (COMPANION, 2, "vehicle 1 names no signing_key in "),
}


@pytest.mark.parametrize("words", WRONG)
def test_a_wrong_command_line_ends_with_what_is_allowed(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command, exit_status, said = WRONG[words]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(sys, "argv", ["fleet", *words.format(file=ROOT / "fleet.toml").split()])
    monkeypatch.setattr("builtins.input", lambda _: "")
    with pytest.raises(SystemExit) as ended:
        command()
    err = capsys.readouterr().err
    assert ended.value.code == exit_status, err
    assert said in " ".join(err.split())
    assert "Traceback" not in err
    assert list(tmp_path.iterdir()) == []
