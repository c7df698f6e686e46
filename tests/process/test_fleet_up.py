"""Whole fleets as a user starts them: real processes, MAVLink over UDP, peers over Zenoh."""

from __future__ import annotations

import itertools
import json
import os
import random
import resource
import signal
import socket
import struct
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from math import nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
import zenoh
from fleet_process import (
    SETTLED,
    Fleet,
    Process,
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
    status_json,
    truth,
    wait_status,
)
from pymavlink.dialects.v20 import development as dialect

from companion.__main__ import main as companion_main
from companion.core.events import KillCause
from companion.core.failsafe import Failsafe
from companion.core.frames import Ned
from companion.core.values import PeerMessage, PeerSample, Phase
from companion.io.recording import read_recording
from companion.io.replay import replay_file
from companion.io.zenoh.configuration import (
    PLANS_HZ,
    REQUESTS_HZ,
    SessionSettings,
    scouting_port,
    zenoh_configuration,
)
from companion.operator.client import Operator
from companion.wire.operator import Status
from companion.wire.peer import encode_state
from companion.wire.px4 import Px4Mode
from sim.__main__ import main as fleet_main
from sim.launch.summary.recorded import recorded_flight
from sim.report.series import series_of

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]

FOR_EVER = "velocity:0.5:0:3600"
EDITED = Failsafe.CONFIGURATION.value
ON_GROUND = 1
STALL_MS = 300.0
LOOPBACK = "127.0.0.1"


def datagrams(system_id: int) -> list[bytes]:
    """What a companion may be sent by somebody who is not its autopilot, or by a broken one."""
    mine = dialect.MAVLink(None, srcSystem=system_id, srcComponent=1)
    other = dialect.MAVLink(None, srcSystem=222, srcComponent=1)
    heartbeat = dialect.MAVLink_heartbeat_message(2, 12, 81, 0, 3, 3)
    position = dialect.MAVLink_local_position_ned_message(1000, nan, 0.0, 0.0, 0.0, 0.0, 0.0)
    infinite = dialect.MAVLink_local_position_ned_message(1000, 0.0, 0.0, 0.0, float("inf"), 0.0, 0.0)
    noise = random.Random(7)
    whole = heartbeat.pack(mine)
    return [
        *(noise.randbytes(n) for n in (1, 9, 40, 280, 2000)),
        b"",
        b"\xfd" + noise.randbytes(30),
        whole[:11],
        whole[:-1],
        whole[:-2] + b"\0\0",
        heartbeat.pack(other),
        position.pack(mine),
        infinite.pack(mine),
    ]


def send(port: int, messages: list[bytes]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind((LOOPBACK, 0))
        for message in messages:
            s.sendto(message, (LOOPBACK, port))


def failsafes(said: list[str]) -> list[str]:
    """All but what a machine that stalls for half a second does to a vehicle; that is not what is tested here."""
    return [what for what in said if "own position stale" not in what]


def rejected(status: Status, kind: str) -> int:
    return status.rejected.get(kind, 0)


# -- one flight with everything that an operator and a stranger may do -----------------------------------------------


@dataclass(slots=True)
class Flown:
    """A flight of four under commands and under garbage."""

    fleet: Fleet
    exit_status: int = -1
    out: str = ""
    err: str = ""
    folder: Path = Path()
    verbs: dict[str, subprocess.CompletedProcess[str]] = field(default_factory=dict)
    seen: dict[str, dict[int, Status]] = field(default_factory=dict)
    """what the vehicles said: before, and after each verb"""
    after_garbage: dict[int, Status | None] = field(default_factory=dict)
    unnamed: subprocess.CompletedProcess[str] = field(default_factory=lambda: subprocess.CompletedProcess([], -1))
    """`status` without --fleet, from another folder whose file has no more than the fleet's name"""
    watched: tuple[int, str, str] = (-1, "", "")
    """exit status and outputs of `status --watch`, ended by Ctrl-C"""
    status_of_five: tuple[int, dict[int, Status | None]] = (-1, {})

    def say(self, verb: str, *arguments: str) -> None:
        self.verbs[verb] = run("sim", verb, *arguments, "--fleet", str(self.fleet.file), folder=self.fleet.folder)


def put_garbage(fleet: Fleet) -> None:
    """Peers' payloads that no vehicle may take, through a session of the fleet's own namespace."""
    settings = SessionSettings(fleet.config.fleet.name, None, scouting_port=fleet.config.peers.scouting_port)

    def state(vehicle_id: int, ahead_s: float = 0.0) -> bytes:
        at_ns = time.time_ns() + round(ahead_s * 1e9)
        sample = PeerSample(vehicle_id, at_ns, Ned(1.0, 2.0, -3.0), Ned(0.0, 0.0, 0.0), 1, Phase.FORMED)
        return encode_state(PeerMessage(77, 1, 0, 0, sample, ()))

    sound = state(4)
    not_a_number = bytearray(sound)
    struct.pack_into("<f", not_a_number, len(sound) - 24, nan)
    puts = [
        ("fleet/4/state", b"\x09" + sound[1:]),
        ("fleet/4/state", sound[:-5]),
        ("fleet/4/state", b""),
        ("fleet/4/state", sound + b"\0"),
        ("fleet/4/state", bytes(not_a_number)),
        ("fleet/4/state", state(3)),
        ("fleet/4/state", state(4, ahead_s=30.0)),
        ("fleet/99/state", state(99)),
        ("fleet/4/plan", b"{}"),
        ("fleet/4/plan", b"[" * 60_000),
        ("fleet/4/plan", random.Random(8).randbytes(500)),
        ("fleet/4/other", b"?"),
        ("fleet/abc/state", sound),
    ]
    session = zenoh.open(zenoh_configuration(settings))
    try:
        token = session.liveliness().declare_token("fleet/99/alive")
        assert eventually(lambda: len(session.info.peers_zid()) >= len(fleet.ids))
        # Twice: the first of a session may go before it knows all who listen.
        for key, payload in puts * 2:
            session.put(key, payload)
            time.sleep(2.0 / PLANS_HZ)  # more often they are left out
        for command in (b"[" * 60_000, b"{", b"\xff\xfe", b'{"verb": 3}', b'{"verb": "motion", "motion": {"a": NaN}}'):
            time.sleep(2.0 / REQUESTS_HZ)
            answers = session.get("fleet/1/command", payload=command, timeout=5.0)
            assert [json.loads(a.ok.payload.to_bytes())["accepted"] for a in answers if a.ok] == [False]
        token.undeclare()  # type: ignore[no-untyped-call]
    finally:
        session.close()  # type: ignore[no-untyped-call]


def five(fleet: Fleet) -> Path:
    """An operator's file that has one vehicle too many."""
    tables = tomllib.loads(fleet.file.read_text())
    tables["vehicle"].append({"id": 5, "mavlink": f"udp://127.0.0.1:{fleet.port + 4}"})
    file = fleet.folder / "five.toml"
    file.write_text(tomli_w.dumps(tables))
    return file


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Up, formed, a line, garbage, moved, held, landed; everything that was seen on the way."""
    fleet = make_fleet(tmp_path_factory.mktemp("flown"), 4)
    flown = Flown(fleet)
    out = fleet.folder / "flights"
    arguments = ("sim", "up", "--json", "--fleet", str(fleet.file), "--out", str(out), "--plan", FOR_EVER)
    with started(*arguments, folder=fleet.folder, name="up") as up, operator_of(fleet) as operator:
        flown.seen["formed"] = wait_status(operator, all_in(fleet.ids, *SETTLED, revision=2))
        flown.say("form", "line")
        flown.seen["form"] = wait_status(operator, all_in(fleet.ids, *SETTLED, revision=3))
        send(fleet.port, datagrams(1) * 3)
        put_garbage(fleet)
        _, flown.after_garbage = status_json(fleet)
        flown.say("move", "--velocity", "0", "0.5", "0")
        flown.seen["move"] = wait_status(operator, lambda said: True)
        flown.say("hold")
        flown.seen["hold"] = wait_status(operator, lambda said: True)
        flown.status_of_five = status_json(fleet, five(fleet))
        elsewhere = fleet.folder / "elsewhere"
        elsewhere.mkdir()
        (elsewhere / "fleet.toml").write_text(f'[fleet]\nname = "{fleet.config.fleet.name}"\n')
        flown.unnamed = run("sim", "status", folder=elsewhere)
        with started("sim", "status", "--watch", folder=elsewhere, name="watch") as watching:
            assert eventually(lambda: watching.out.count("\n") >= 2, 30.0)
            watching.signal(signal.SIGINT)
            flown.watched = (watching.wait(), watching.out, watching.err)
        flown.say("land")
        flown.exit_status = up.wait()
        flown.out, flown.err = up.out, up.err
    flown.folder = flight_folder(out)
    return flown


def test_a_flight_meets_its_criteria_and_says_so_by_its_exit_status(flown: Flown) -> None:
    summary = json.loads(flown.out)
    if summary["reference_lateness_ms"]["max"] > STALL_MS:
        pytest.skip(f"this machine stalled for {summary['reference_lateness_ms']['max']:.0f} ms: no flight to judge")
    assert [c for c in summary["criteria"] if not c["met"]] == []
    assert summary["passed"] is True
    assert flown.exit_status == 0, flown.err
    assert summary["vehicles"] == 4
    assert 0 < summary["formed_after_s"] <= 60
    assert summary["minimum_distance_m"] >= 1.2
    assert 0 < summary["steady"]["formation_error_rms_m"] <= 0.2
    assert 0 < summary["steady"]["velocity_error_rms_m_s"] <= 0.3
    assert summary["failsafes"] == []
    assert summary["lost"] == []


def test_every_companion_of_a_flight_ends_well(flown: Flown) -> None:
    summary = json.loads(flown.out)
    assert summary["exit_status"] == {str(i): 0 for i in flown.fleet.ids}


def test_the_summary_alone_is_on_standard_output_and_lies_in_the_flights_folder(flown: Flown) -> None:
    assert len(flown.out.splitlines()) == 1
    assert json.loads(flown.out) == json.loads((flown.folder / "summary.json").read_text())
    assert flown.err == ""


def test_the_summary_has_every_promised_figure(flown: Flown) -> None:
    summary = json.loads(flown.out)
    numbers = (
        "vehicles", "formed_after_s", "minimum_distance_m", "steady.formation_error_rms_m",
        "steady.velocity_error_rms_m_s", "steady.messages_per_vehicle_hz", "steady.reduction_vs_20hz_percent",
        "steady.centroid_error_rms_m", "steady.payload_bytes_per_vehicle_s", "steady.wire_bytes_per_vehicle_s",
        "steady.packets_per_vehicle_hz", "steady.packets_reduction_vs_20hz_percent",
        "loop_lateness_ms.p50", "loop_lateness_ms.p99", "latency_ms.p50", "latency_ms.p99", "reference_lateness_ms.p99",
        "setpoint_gap_max_s", "seed",
    )  # fmt: skip
    for path in numbers:
        value = summary
        for part in path.split("."):
            value = value[part]
        assert isinstance(value, (int, float)), path
    assert isinstance(summary["rejected"], dict)
    assert {"python", "starling-fleet", "eclipse-zenoh", "pymavlink"} <= set(summary["versions"])


def test_the_summary_has_every_operators_command_with_its_issuer_and_answers(flown: Flown) -> None:
    summary = json.loads(flown.out)
    commands = summary["commands"]
    assert [c["verb"] for c in commands] == ["takeoff", "motion", "motion", "motion", "land"]
    for c in commands:
        assert (c["accepted"], c["refused"], c["unanswered"]) == (flown.fleet.ids, {}, [])
        assert c["issuer"].startswith("operator-")
    assert len({c["id"] for c in commands}) == 5
    assert summary["commands_left_out"] == 5  # garbage that vehicle 1 got
    assert summary["killed"] == summary["unrecorded"] == summary["autopilots_lost"] == {}


def test_the_recordings_alone_give_the_same_summary(flown: Flown, tmp_path: Path) -> None:
    told = json.loads(flown.out)
    done = run("sim", "summary", str(flown.folder), "--json", folder=tmp_path)
    read = json.loads(done.stdout)
    assert done.returncode == flown.exit_status, done.stderr
    assert (read["passed"], read["judged_by"], read["vehicles"]) == (told["passed"], "truth", 4)
    # It counts from when the first vehicle had the take-off command, the launcher from when it asked.
    later_s = (read["takeoff_ns"] - told["takeoff_ns"]) * 1e-9
    assert 0.0 <= later_s < 5.0
    assert read["formed_after_s"] == pytest.approx(told["formed_after_s"] - later_s, abs=1e-3)
    for key in ("formation_error_rms_m", "centroid_error_rms_m", "messages_per_vehicle_hz"):
        assert read["steady"][key] == pytest.approx(told["steady"][key], rel=0.02)
    assert [c["id"] for c in read["commands"]] == [c["id"] for c in told["commands"]]
    assert read["rejected"] is None


def test_a_flights_page_draws_what_the_summary_says(flown: Flown, tmp_path: Path) -> None:
    done = run("sim", "report", str(flown.folder), "--out", str(tmp_path / "page.html"), folder=tmp_path)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "page.html").read_text()
    told = json.loads(flown.out)
    assert ("passed" if told["passed"] else "not passed") in page
    assert page.count("<svg") == page.count("<figure>") == 8
    flight, _ = recorded_flight([flown.folder])
    series = series_of(flight)
    assert series.true
    assert series.closest[0].least_m == pytest.approx(told["minimum_distance_m"], abs=0.1)
    a, b = series.closest[0].ids
    assert f"{a} and {b}: {series.closest[0].least_m:.2f} m at least" in page
    sent = sum(len(times) for times in series.messages_s.values())
    assert sent == sum(p.topic == "state" for p in flight.puts) > 4
    began_s = (flight.takeoff_ns - told["takeoff_ns"]) * 1e-9
    steady = series.times_s > told["formed_after_s"] - began_s + 3.0
    assert np.nanmedian(series.formation_error_m[steady]) < 0.3


def test_two_of_four_recordings_without_the_truth_are_judged_by_their_own_estimates(
    flown: Flown, tmp_path: Path
) -> None:
    told = json.loads(flown.out)
    done = run("sim", "summary", *(str(flown.folder / f"vehicle-{i}.mcap") for i in (1, 3)), "--json", folder=tmp_path)
    assert done.returncode in (0, 1), done.stderr
    read = json.loads(done.stdout)
    assert (read["judged_by"], read["vehicles"]) == ("the vehicles' own estimates", 2)
    assert sorted(read["missing"]) == ["2", "4"]
    assert read["landed"] == {"1": True, "3": True}
    assert read["formed_after_s"] == pytest.approx(told["formed_after_s"], abs=5.0)
    assert 0.0 < read["believed"]["formation_error_rms_m"] < 2.0 * told["believed"]["formation_error_rms_m"] + 0.1
    assert read["steady"]["formation_error_rms_m"] is None


def test_every_companions_decisions_replay_byte_for_byte(flown: Flown) -> None:
    for i in flown.fleet.ids[1:]:
        result = replay_file(flown.folder / f"vehicle-{i}.mcap")
        assert result.difference is None
        assert result.outputs > 500
    done = run("companion", "replay", str(flown.folder / "vehicle-1.mcap"), folder=flown.fleet.folder)
    assert (done.returncode, "the same" in done.stdout) == (0, True), done.stdout + done.stderr


def test_every_verb_is_acknowledged_by_every_vehicle(flown: Flown) -> None:
    for verb, done in flown.verbs.items():
        assert done.returncode == 0, done.stdout + done.stderr
        assert f"{verb}" in done.stdout
        assert "accepted by 4" in done.stdout


def test_verbs_show_in_the_next_status(flown: Flown) -> None:
    revisions = [{s.revision for s in flown.seen[step].values()} for step in ("formed", "form", "move", "hold")]
    assert revisions == [{2}, {3}, {4}, {5}]
    assert {s.shape for s in flown.seen["formed"].values()} == {"v"}
    assert {s.shape for s in flown.seen["hold"].values()} == {"line"}
    (leg,) = flown.seen["move"][1].motion["legs"]
    assert leg["velocity_ned_m_s"] == [0.0, 0.5, 0.0]
    assert flown.seen["hold"][1].motion["legs"][0]["velocity_ned_m_s"] == [0.0, 0.0, 0.0]


def test_a_verb_without_a_file_reaches_the_flight_of_the_name_that_its_folders_file_has(flown: Flown) -> None:
    assert flown.unnamed.returncode == 0, flown.unnamed.stderr
    first_words = [line.split()[0] for line in flown.unnamed.stdout.splitlines() if line.strip()]
    assert [word for word in first_words if word.isdigit()] == ["1", "2", "3", "4"]


def test_a_watched_fleet_is_told_line_by_line_without_a_terminal_until_ctrl_c(flown: Flown) -> None:
    exit_status, out, err = flown.watched
    assert (exit_status, err) == (0, "")
    name = flown.fleet.config.fleet.name
    assert all(name in line and "4 holding" in line and "nearest pair" in line for line in out.splitlines())
    times_s = [float(line.split()[0]) for line in out.splitlines()]
    assert times_s[1] - times_s[0] >= 4.0


def test_a_vehicle_that_is_not_there_is_named_as_silent(flown: Flown) -> None:
    exit_status, said = flown.status_of_five
    assert exit_status == 1
    assert [i for i, s in said.items() if s is None] == [5]


def test_a_stranger_on_the_autopilots_port_is_counted_and_moves_nothing(flown: Flown) -> None:
    status = flown.after_garbage[1]
    assert status is not None
    assert rejected(status, "mavlink: another address than the autopilot's") == 3 * len(datagrams(1))
    assert status.phase in SETTLED
    assert status.mode == "OFFBOARD"


def test_garbage_from_peers_is_counted_by_kind_and_moves_nothing(flown: Flown) -> None:
    for i in (1, 2, 3):
        status = flown.after_garbage[i]
        assert status is not None
        assert status.phase in SETTLED
        assert failsafes(status.failsafes) == []
        for kind, count in {
            "state: version": 2,
            "state: length": 2,
            "state: not finite": 1,
            "state: id is not the key's": 1,
            "from the future": 1,
            "foreign id": 2,
            "plan: motion": 3,
            "peer: malformed": 1,
        }.items():
            assert rejected(status, kind) >= count, (i, kind, status.rejected)
    first, last = flown.after_garbage[1], flown.after_garbage[4]
    assert first is not None
    assert rejected(first, "command: malformed") >= 3
    assert last is not None
    assert rejected(last, "own id heard from another") >= 5


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


# -- companions one by one -------------------------------------------------------------------------------------------


@dataclass(slots=True)
class Single:
    """Three vehicles whose processes the test starts and ends itself, beside a fleet of another name."""

    fleet: Fleet
    truth: Path
    before_autopilot: dict[int, Status] = field(default_factory=dict)
    waiting: dict[int, Status] = field(default_factory=dict)
    """two companions there, the third vehicle's not; another fleet has a vehicle 3"""
    refused: subprocess.CompletedProcess[str] | None = None
    other: dict[int, Status] = field(default_factory=dict)
    """what the other fleet's vehicle 3 said meanwhile"""
    busy: subprocess.CompletedProcess[str] | None = None
    flying: dict[int, Status] = field(default_factory=dict)
    restarted: dict[int, Status] = field(default_factory=dict)
    """after vehicle 3's companion was killed and started again"""
    terminated_status: int = -1
    terminated_after_s: float = 0.0
    mode_after_termination: int = 0
    ended: list[int] = field(default_factory=list)
    stub_status: int = -1
    stub_err: str = ""


class Companions:
    """Starts companions of one fleet and keeps them until the end."""

    def __init__(self, stack: ExitStack, fleet: Fleet) -> None:
        self._stack, self._fleet = stack, fleet
        self._numbers = itertools.count()

    def start(self, vehicle_id: int) -> Process:
        arguments = ("companion", "run", "--vehicle", str(vehicle_id), "--fleet", str(self._fleet.file))
        name = f"companion-{vehicle_id}-{next(self._numbers)}"
        return self._stack.enter_context(started(*arguments, folder=self._fleet.folder, name=name))


def ready_but_for(said: dict[int, Status], ids: list[int], reasons: list[str]) -> bool:
    return all(i in said and said[i].ready == reasons for i in ids)


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Single]:
    """Late, restarted and terminated companions on one stub process."""
    folder = tmp_path_factory.mktemp("single")
    port = scouting_port(f"test-{os.getpid()}")
    plan = {"legs": [{"kind": "velocity", "north_m_s": 0.5, "duration_s": 3600.0}]}
    fleet = make_fleet(folder, 3, scouting=port, plan=plan)
    foreign = make_fleet(folder, 3, scouting=port)
    single = Single(fleet, folder / "truth.bin")
    with ExitStack() as stack:
        mine, theirs = Companions(stack, fleet), Companions(stack, foreign)
        operator = stack.enter_context(operator_of(fleet))
        first, second = mine.start(1), mine.start(2)
        theirs.start(3)
        wait_status(operator, lambda said: sorted(said) == [1, 2])
        send(fleet.port, datagrams(1))
        single.before_autopilot = wait_status(
            operator, lambda said: 1 in said and sum(said[1].rejected.values()) >= len(datagrams(1)) - 1
        )
        stub = stack.enter_context(
            started("sim", "stub", "--fleet", str(fleet.file), "--truth", str(single.truth), folder=folder, name="stub")
        )
        stack.enter_context(started("sim", "stub", "--fleet", str(foreign.file), folder=folder, name="foreign"))
        with operator_of(foreign) as other:
            single.other = wait_status(other, lambda said: ready_but_for(said, [3], ["not heard: vehicle 1, 2"]))
        single.waiting = wait_status(operator, lambda said: ready_but_for(said, [1, 2], ["not heard: vehicle 3"]))
        single.refused = run("sim", "takeoff", "--fleet", str(fleet.file), folder=folder)
        third = mine.start(3)
        single.busy = run("companion", "run", "--vehicle", "1", "--fleet", str(fleet.file), folder=folder)
        wait_status(operator, lambda said: ready_but_for(said, [1, 2, 3], []))
        assert operator.take_off().all_accepted
        single.flying = wait_status(operator, all_in(fleet.ids, *SETTLED, revision=2))
        third.signal(signal.SIGKILL)
        third.wait()
        again = mine.start(3)
        single.restarted = wait_status(
            operator, lambda said: len(said) == 3 and said[3].revision == 2 and not said[3].armed
        )
        before = time.monotonic()
        second.signal(signal.SIGTERM)
        single.terminated_status = second.wait()
        single.terminated_after_s = time.monotonic() - before
        assert eventually(lambda: truth(single.truth, 2)["custom_mode"][-1] == Px4Mode.AUTO_LAND, 2.0)
        _land(operator, single, first)
        single.ended = [_end(p) for p in (first, again)]
        stub.signal(signal.SIGINT)
        single.stub_status = stub.wait()
        single.stub_err = stub.err
        yield single


def _land(operator: Operator, single: Single, first: Process) -> None:
    operator.land()
    wait_status(operator, lambda said: said[1].phase == "landed")
    assert first.popen.poll() is None


def _end(process: Process) -> int:
    process.signal(signal.SIGTERM)
    return process.wait()


def test_what_no_autopilot_may_say_is_counted_by_kind_before_there_is_one(single: Single) -> None:
    status = single.before_autopilot[1]
    assert "no heartbeat from the autopilot" in status.ready
    assert rejected(status, "not finite") == 2
    assert rejected(status, "foreign system") >= 1
    assert rejected(status, "malformed") >= 8
    assert rejected(status, "mavlink: another address than the autopilot's") == 0


def test_fleets_of_different_names_do_not_hear_each_other_on_one_scouting_port(single: Single) -> None:
    assert single.waiting[1].ready == ["not heard: vehicle 3"]
    assert 3 not in single.waiting
    assert single.other[3].phase == "idle"
    assert single.other[3].neighbours == 0
    assert single.other[3].rejected.keys().isdisjoint({"own id", "foreign id", "peer: under our own id"})


def test_take_off_is_refused_while_a_vehicle_is_missing(single: Single) -> None:
    assert single.refused is not None
    assert single.refused.returncode == 1
    assert "vehicle 1: not heard: vehicle 3" in single.refused.stderr
    assert "\n  not heard: vehicle 3\n" in single.refused.stderr


def test_a_companion_that_comes_late_flies_with_the_others(single: Single) -> None:
    assert {s.phase for s in single.flying.values()} <= set(SETTLED)
    assert len(single.flying) == 3


def test_a_second_companion_of_a_vehicle_says_which_port_is_in_use(single: Single) -> None:
    assert single.busy is not None
    assert single.busy.returncode == 1
    assert single.busy.stderr.strip() == (
        f"companion: vehicle 1: cannot listen on UDP 127.0.0.1:{single.fleet.port}: it is in use"
    )


def test_a_companion_restarted_in_flight_gets_the_plan_and_leaves_its_vehicle_to_the_autopilots_landing(
    single: Single,
) -> None:
    third = single.restarted[3]
    assert third.phase == "idle"
    assert third.revision == 2
    assert third.setpoints == 0
    track = truth(single.truth, 3)
    assert Px4Mode.AUTO_LAND in track["custom_mode"]
    assert track["landed_state"][-1] == ON_GROUND


def test_a_companion_restarted_in_flight_does_not_disturb_the_others(single: Single) -> None:
    for i in (1, 2):
        assert single.restarted[i].phase in SETTLED
        assert failsafes(single.restarted[i].failsafes) == []
    assert minimum_distance_m(single.truth) >= 1.2


def test_a_companion_that_is_terminated_in_flight_lands_its_vehicle_and_exits_well(single: Single) -> None:
    assert single.terminated_status == 0
    assert single.terminated_after_s < 4.5
    assert truth(single.truth, 2)["custom_mode"].tolist().count(Px4Mode.AUTO_LAND) > 0
    assert single.ended == [0, 0]


def test_stubs_alone_run_until_interrupted(single: Single) -> None:
    assert single.stub_status == 0
    assert f"vehicle 3: system id 3, speaks to udp://127.0.0.1:{single.fleet.port + 2}" in single.stub_err
    assert "Traceback" not in single.stub_err


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
