"""Whole fleets of real PX4 instances, from the command line."""

import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fleet_process import child, children, eventually, gone, run
from px4_fleet import DISTANCE_MIN_M, PATIENCE_S, flying, judged, sitl_fleet

from companion.core.frames import Ned, ned_to_geodetic
from companion.io.recording import read_recording
from companion.wire.px4 import Px4Mode
from sim.launch.px4_instance import Px4Instance

PLAN = {
    "then": "land",
    "legs": [
        {"kind": "velocity", "north_m_s": 1.0, "duration_s": 22.0},
        {"kind": "turn", "rate_deg_s": 6.0, "angle_deg": 90.0},
        {"kind": "velocity", "east_m_s": 1.0, "duration_s": 10.0},
        {"kind": "hold", "duration_s": 3.0},
    ],
}
FOR_EVER = {"then": "land", "legs": [{"kind": "velocity", "north_m_s": 1.0, "duration_s": 600.0}]}
SHORT = {"then": "land", "legs": [{"kind": "velocity", "north_m_s": 1.0, "duration_s": 5.0}]}
OFFBOARD_LOSS_TO_ACTION_S = 1.5
SETPOINTS_END_S = 0.2


Property = Callable[[str, object], None]
"""pytest's record_property: the figures go into --junitxml"""


def test_three_vehicles_form_a_v_turn_become_a_line_and_land_within_the_criteria(
    tmp_path: Path, build: Path, record_property: Property
) -> None:
    with flying(sitl_fleet(tmp_path, 3, plan=PLAN), build) as flight:
        flight.wait("formed")
        flight.wait_speed(1, 0.8)
        answer = run("sim", "form", "line", "--fleet", str(flight.fleet.file), folder=tmp_path)
        assert answer.returncode == 0, answer.stderr
        flight.wait("forming")
        flight.wait("formed")
        assert flight.up.wait(200.0) == 0, flight.up.out + flight.up.err
    summary: dict[str, Any] = json.loads(flight.up.out)
    steady = judged(summary, record_property)
    assert summary["believed"]["formation_error_rms_m"] <= 0.15
    assert steady["centroid_error_rms_m"] <= 1.0
    assert steady["attitude_rate_rms_deg_s"] <= 20.0
    assert steady["reduction_vs_20hz_percent"] >= 98.5  # short, and a change of formation among it


def test_a_killed_companions_vehicle_lands_within_1_5_s_and_the_others_keep_their_distance(
    tmp_path: Path, build: Path, record_property: Property
) -> None:
    with flying(sitl_fleet(tmp_path, 3, plan=FOR_EVER), build) as flight:
        flight.wait("formed")
        flight.wait_speed(2, 0.9)
        victim = child(flight.up.popen.pid, "run --vehicle 2 ")
        killed_ns = time.time_ns()
        os.kill(victim, signal.SIGKILL)
        left_ns, mode = flight.left_offboard_ns(2, killed_ns)
        record_property("left OFFBOARD after (s)", (left_ns - killed_ns) * 1e-9)
        assert mode == int(Px4Mode.AUTO_LAND)  # COM_OBL_RC_ACT 4
        assert (left_ns - killed_ns) * 1e-9 <= OFFBOARD_LOSS_TO_ACTION_S
        assert eventually(lambda: not flight.truth(2)["armed"][-1], 60.0)
        status = flight.operator.status()
        for i in (1, 3):
            said = status[i]
            assert said is not None
            assert said.phase in ("formed", "moving", "holding")
        nearest_m = flight.minimum_distance_m([1, 2, 3], killed_ns)
        record_property("minimum distance (m)", nearest_m)
        assert nearest_m >= DISTANCE_MIN_M
        flight.up.signal(signal.SIGINT)
        flight.up.wait(120.0)


def test_a_pilots_mode_change_ends_the_setpoints_at_once_and_for_good(
    tmp_path: Path, build: Path, record_property: Property
) -> None:
    """Vehicle 2's pilot holds, then lands; vehicle 3's lands, after which PX4 falls back to OFFBOARD by itself."""
    with flying(sitl_fleet(tmp_path, 3, plan=FOR_EVER), build) as flight:
        flight.wait("formed")
        flight.wait_speed(2, 0.9)
        taken_ns = {2: flight.pilot(2, Px4Mode.AUTO_LOITER), 3: flight.pilot(3, Px4Mode.AUTO_LAND)}
        flight.wait("released", 2)
        time.sleep(5.0)  # long enough to see that it stays so
        said = flight.operator.status()[2]
        assert said is not None
        assert (said.phase, said.mode) == ("released", "AUTO_LOITER")
        flight.pilot(2, Px4Mode.AUTO_LAND)
        flight.wait("landed", 2, 3)
        assert eventually(lambda: flight.truth(3)["custom_mode"][-1] == int(Px4Mode.OFFBOARD), 20.0)  # the fall-back
        time.sleep(3.0)
        said = flight.operator.status()[3]
        assert said is not None
        assert (said.phase, said.armed) == ("landed", False)
        flight.up.signal(signal.SIGINT)
        flight.up.wait(120.0)
        for i, since_ns in taken_ns.items():
            last_s = (flight.setpoints_ns(i)[-1] - since_ns) * 1e-9
            record_property(f"vehicle {i}: last setpoint after the command (s)", last_s)
            assert last_s <= SETPOINTS_END_S, f"vehicle {i}: last setpoint {last_s:.3f} s after the pilot's command"


def test_nothing_is_left_when_the_launcher_is_killed(tmp_path: Path, build: Path) -> None:
    with flying(sitl_fleet(tmp_path, 2, plan=FOR_EVER), build) as flight:
        flight.wait("formed")
        own = children(flight.up.popen.pid)
        host = child(flight.up.popen.pid, "sim sitl")
        pids = [*own.values(), *children(host).values()]
        assert len(children(host)) == 2
        flight.up.popen.kill()
        assert eventually(lambda: all(gone(p) for p in pids), 15.0)


def test_no_instance_is_left_when_their_host_is_killed(tmp_path: Path, build: Path) -> None:
    with flying(sitl_fleet(tmp_path, 1, plan=FOR_EVER), build) as flight:
        flight.wait("idle")
        host = child(flight.up.popen.pid, "sim sitl")
        assert eventually(lambda: len(children(host)) == 1, PATIENCE_S)
        pids = list(children(host).values())
        os.kill(host, signal.SIGKILL)
        assert eventually(lambda: all(gone(p) for p in pids), 15.0)
        assert flight.up.wait(60.0) == 1
        assert "autopilots ended" in flight.up.err


def test_the_eleventh_instance_has_a_link_by_the_port_rule(tmp_path: Path, build: Path) -> None:
    fleet = sitl_fleet(tmp_path, 11, only=11, plan=SHORT)
    assert fleet.config.vehicles[0].mavlink == "udp://127.0.0.1:24550"
    with flying(fleet, build) as flight:
        assert flight.up.wait(200.0) == 0, flight.up.out + flight.up.err
    assert json.loads(flight.up.out)["passed"]


def test_a_parameter_that_px4_does_not_have_ends_the_start_with_its_name(tmp_path: Path, build: Path) -> None:
    how = ("--autopilot", "px4", "--px4", str(build), "--parameter", "NO_SUCH_THING=3")
    with flying(sitl_fleet(tmp_path, 1, plan=SHORT), build, *how) as flight:
        assert flight.up.wait(90.0) == 1
    assert "PX4 parameters not as set" in flight.up.err
    assert "NO_SUCH_THING" in flight.up.err
    rows = flight.truth(1)
    assert len(rows) > 0
    assert not rows["armed"].any(), "nobody took off meanwhile"
    channels = {e.channel for e in read_recording(flight.folder / "vehicle-1.mcap").entries}
    assert "input/command" not in channels


def test_external_autopilots_fly_and_are_judged_by_their_own_estimates(tmp_path: Path, build: Path) -> None:
    fleet = sitl_fleet(tmp_path, 2, plan=SHORT)
    instances = []
    try:
        for v in fleet.config.vehicles:
            home = ned_to_geodetic(Ned(v.pad_north_m, v.pad_east_m, 0.0), fleet.config.origin)
            parameters = {
                "COM_OBL_RC_ACT": 4, "COM_RC_OVERRIDE": 3, "MAN_OVERRIDE_SPD": 1.0, "COM_RC_IN_MODE": 4,
                "COM_RCL_EXCEPT": 4, "SDLOG_MODE": -1,
            }  # fmt: skip
            instances.append(Px4Instance(v.instance, home, build, tmp_path / f"px4-{v.id}", parameters))
        with flying(fleet, build, "--autopilot", "external") as flight:
            assert flight.up.wait(200.0) == 0, flight.up.out + flight.up.err
        summary: dict[str, Any] = json.loads(flight.up.out)
        assert summary["judged_by"] == "the vehicles' own estimates"
        assert summary["minimum_distance_m"] is None
        assert summary["steady"]["formation_error_rms_m"] is None
        assert summary["believed"]["formation_error_rms_m"] <= 0.15
        assert summary["believed"]["minimum_distance_m"] >= DISTANCE_MIN_M
        assert all(i.process.poll() is None for i in instances), "they were not ours to end"
    finally:
        for instance in instances:
            instance.end()
