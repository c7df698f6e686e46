"""What a fleet does whose companion, operator or launcher ends it: real processes that are killed in flight."""

from __future__ import annotations

import json
import os
import resource
import signal
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from fleet_process import (
    SETTLED,
    Fleet,
    all_in,
    child,
    children,
    eventually,
    flight_folder,
    gone,
    make_fleet,
    minimum_distance_m,
    operator_of,
    ports_free,
    run,
    started,
    truth,
    wait_status,
)
from strangers import failsafes, rejected

from companion.core.events import KillCause
from companion.core.failsafe import Failsafe
from companion.io.recording import read_recording
from companion.wire.operator import Status
from companion.wire.px4 import Px4Mode

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]
FOR_EVER = "velocity:0.5:0:3600"
EDITED = Failsafe.CONFIGURATION.value
ON_GROUND = 1


# -- one companion is killed, another one's disk is full, and Ctrl-C lands the rest -----------------------------------


@dataclass(slots=True)
class Loss:
    """A flight that loses a companion."""

    fleet: Fleet
    killed_ns: int = 0
    exit_status: int = -1
    out: str = ""
    err: str = ""
    folder: Path = Path()
    others: dict[int, Status] = field(default_factory=dict)
    """what the others said after the lost vehicle had landed"""

    @property
    def summary(self) -> dict[str, Any]:
        summary: dict[str, Any] = json.loads((self.folder / "summary.json").read_text())
        return summary


@pytest.fixture(scope="module")
def loss(tmp_path_factory: pytest.TempPathFactory) -> Loss:
    """Formed and moving; the companions' server and companion 2 die, companion 3 can write no more, the file is edited,
    the launcher is interrupted."""
    fleet = make_fleet(tmp_path_factory.mktemp("loss"), 4)
    loss = Loss(fleet)
    out = fleet.folder / "flights"
    arguments = ("sim", "up", "--fleet", str(fleet.file), "--out", str(out), "--plan", FOR_EVER)
    with started(*arguments, folder=fleet.folder, name="up") as up, operator_of(fleet) as operator:
        wait_status(operator, all_in(fleet.ids, *SETTLED, revision=2))
        loss.folder = flight_folder(out)
        resource.prlimit(child(up.popen.pid, "run --vehicle 3 "), resource.RLIMIT_FSIZE, (0, 0))
        os.kill(child(up.popen.pid, "companions' server"), signal.SIGKILL)
        os.kill(child(up.popen.pid, "run --vehicle 2 "), signal.SIGKILL)
        loss.killed_ns = time.time_ns()
        with (loss.folder / "fleet.toml").open("a") as file:
            file.write("# edited in flight\n")
        assert eventually(lambda: truth(loss.folder / "truth.bin", 2)["armed"][-1] == 0)
        loss.others = wait_status(
            operator,
            lambda said: sorted(said) == [1, 3, 4] and all(rejected(s, EDITED) for s in said.values()),
        )
        up.signal(signal.SIGINT)
        loss.exit_status = up.wait()
        loss.out, loss.err = up.out, up.err
    return loss


def test_the_lost_vehicles_autopilot_lands_it_by_its_own_failsafe(loss: Loss) -> None:
    track = truth(loss.folder / "truth.bin", 2)
    after = track[track["time_unix_ns"] > loss.killed_ns]
    landing = after[after["custom_mode"] == Px4Mode.AUTO_LAND]
    assert (landing["time_unix_ns"][0] - loss.killed_ns) * 1e-9 < 3.0
    assert after["landed_state"][-1] == ON_GROUND


def test_the_others_fly_on_and_keep_their_distance(loss: Loss) -> None:
    assert sorted(loss.others) == [1, 3, 4]
    for status in loss.others.values():
        assert status.phase in SETTLED
        assert failsafes(status.failsafes) == []
    assert minimum_distance_m(loss.folder / "truth.bin") >= 1.2


def test_a_lost_companion_fails_the_flight_and_is_named(loss: Loss) -> None:
    assert loss.exit_status == 1
    assert loss.summary["lost"] == [2]
    assert loss.summary["passed"] is False
    assert "companions lost" in loss.out
    assert "ended: companion 2, status -9 (SIGKILL)" in loss.err
    assert loss.summary["exit_status"] == {"1": 0, "2": -signal.SIGKILL, "3": 0, "4": 0}


def test_the_recordings_alone_name_the_lost_companion_too(loss: Loss, tmp_path: Path) -> None:
    done = run("sim", "summary", str(loss.folder), "--json", folder=tmp_path)
    assert done.returncode == 1, done.stderr
    read = json.loads(done.stdout)
    # Companion 3 flew on and could write no more: its recording alone does not tell that.
    assert (loss.summary["lost"], read["lost"]) == ([2], [2, 3])
    assert read["passed"] is False


def test_ctrl_c_lands_the_fleet_and_still_writes_the_summary(loss: Loss) -> None:
    assert all(loss.summary["landed"].values())
    assert failsafes(loss.summary["failsafes"]) == []
    for i in (1, 3, 4):
        assert truth(loss.folder / "truth.bin", i)["custom_mode"].tolist().count(Px4Mode.AUTO_LAND) > 0


def test_a_companion_that_can_write_no_more_flies_on(loss: Loss) -> None:
    assert loss.others[3].recorder_lost > 0
    assert loss.others[3].phase in SETTLED
    assert {i: rejected(s, Failsafe.DISK_FULL.value) for i, s in loss.others.items()} == {1: 0, 3: 1, 4: 0}


def test_a_file_edited_in_flight_is_noted_once_and_changes_nothing(loss: Loss) -> None:
    for i in (1, 3, 4):
        assert rejected(loss.others[i], EDITED) == 1
        assert loss.others[i].phase in SETTLED
        notes = read_recording(loss.folder / f"vehicle-{i}.mcap").entries
        told = [e.body for e in notes if e.channel == "note" and EDITED.encode() in e.body]
        assert len(told) == (i != 3), "vehicle 3 can write no more"


def test_without_a_terminal_progress_is_a_line_now_and_then(loss: Loss) -> None:
    lines = loss.err.splitlines()
    assert any("flying: 4 climbing" in line for line in lines)
    assert any("s  landing" in line for line in lines)
    assert "\x1b" not in loss.err
    assert len(lines) < 40
    assert "minimum distance" in loss.out


# -- the operator kills -----------------------------------------------------------------------------------------------


def test_a_fleet_that_its_operator_kills_in_flight_falls_is_shown_as_killed_and_fails(tmp_path: Path) -> None:
    fleet = make_fleet(tmp_path, 2)
    out = tmp_path / "flights"
    arguments = ("sim", "up", "--json", "--fleet", str(fleet.file), "--out", str(out), "--plan", FOR_EVER)
    with started(*arguments, folder=tmp_path, name="up") as up:
        with operator_of(fleet) as operator:
            wait_status(operator, all_in(fleet.ids, "waiting", *SETTLED))
        killed = run("sim", "kill", "--yes", "--fleet", str(fleet.file), folder=tmp_path)
        assert killed.returncode == 0, killed.stderr
        assert up.wait(30.0) == 1
    summary = json.loads(up.out)
    assert summary["passed"] is False
    assert summary["killed"] == {str(i): KillCause.COMMAND.value for i in fleet.ids}
    assert [c["met"] for c in summary["criteria"] if c["what"] == "vehicles killed"] == [False]
    (command,) = (c for c in summary["commands"] if c["verb"] == "kill")
    assert (command["accepted"], command["refused"], command["unanswered"]) == (fleet.ids, {}, [])
    for i in fleet.ids:
        track = truth(flight_folder(out) / "truth.bin", i)
        assert track["armed"][-1] == 0
        assert track["velocity_ned_m_s"][:, 2].max() > 2.0


# -- the launcher itself dies ----------------------------------------------------------------------------------------


def still_there(pids: list[int]) -> list[int]:
    return [pid for pid in pids if not gone(pid)]


def test_no_child_outlives_a_launcher_killed_in_flight_and_the_vehicles_are_landing(tmp_path: Path) -> None:
    fleet = make_fleet(tmp_path, 2)
    out = tmp_path / "flights"
    with started("sim", "up", "--fleet", str(fleet.file), "--out", str(out), folder=tmp_path) as up:
        with operator_of(fleet) as operator:
            wait_status(operator, all_in(fleet.ids, "waiting", "forming"))
        pids = list(children(up.popen.pid).values())
        assert len(pids) == 3 + len(fleet.ids)
        up.signal(signal.SIGKILL)
        assert eventually(lambda: not still_there(pids), 2.0), still_there(pids)
    assert ports_free(fleet)
    for i in fleet.ids:
        assert truth(flight_folder(out) / "truth.bin", i)["custom_mode"][-1] == Px4Mode.AUTO_LAND
        assert (flight_folder(out) / f"companion-{i}.log").read_text().count("-> landing") == 1


def test_no_child_outlives_a_launcher_killed_while_they_start(tmp_path: Path) -> None:
    fleet = make_fleet(tmp_path, 1)
    with started("sim", "up", "--fleet", str(fleet.file), "--out", str(tmp_path / "o"), folder=tmp_path) as up:
        assert eventually(lambda: len(children(up.popen.pid)) == 3 + len(fleet.ids))
        pids = list(children(up.popen.pid).values())
        up.signal(signal.SIGKILL)
        up.wait()
        # A process that has not begun to run Python yet watches nothing yet either.
        assert eventually(lambda: not still_there(pids), 4.0), still_there(pids)
    assert ports_free(fleet)
