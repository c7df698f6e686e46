"""A fleet as a user starts it, under an operator's commands and strangers' garbage: real processes, UDP and Zenoh."""

from __future__ import annotations

import json
import random
import signal
import struct
import subprocess
import time
import tomllib
from dataclasses import dataclass, field
from math import nan
from pathlib import Path

import numpy as np
import pytest
import tomli_w
import zenoh
from fleet_process import (
    SETTLED,
    Fleet,
    all_in,
    eventually,
    flight_folder,
    make_fleet,
    operator_of,
    run,
    started,
    status_json,
    wait_status,
)
from strangers import datagrams, failsafes, rejected, send

from companion.core.frames import Ned
from companion.core.values import PeerMessage, PeerSample, Phase
from companion.io.replay import replay_file
from companion.io.zenoh.configuration import (
    PLANS_HZ,
    REQUESTS_HZ,
    SessionSettings,
    zenoh_configuration,
)
from companion.wire.operator import Status
from companion.wire.peer import encode_state
from sim.launch.summary.recorded import recorded_flight
from sim.report.series import series_of

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]
FOR_EVER = "velocity:0.5:0:3600"
STALL_MS = 300.0


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
