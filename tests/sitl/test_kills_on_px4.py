"""Vehicles whose motors stop in flight on real PX4: by the operator's word, and because their PX4 dies."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

from fleet_process import child, eventually, run
from px4_fleet import Flying, flying, sitl_fleet

from companion.core.events import KillCause

FOR_EVER = {"then": "land", "legs": [{"kind": "velocity", "north_m_s": 1.0, "duration_s": 600.0}]}
AFTER_KILL_S = 40.0
"""from the last vehicle's kill to the launcher's end, the fall and all processes' ends included"""
AFTER_LANDING_S = 25.0
"""from the last vehicle's landing to the launcher's end: its look around, and the time that it leaves PX4"""
STATUS = "PX4 ended with status -9"


Property = Callable[[str, object], None]
"""pytest's record_property: the figures go into --junitxml"""


def px4_of(flight: Flying, vehicle_id: int) -> int:
    """Id of a vehicle's own PX4 process."""
    instance = flight.fleet.config.by_id(vehicle_id).instance
    return child(child(flight.up.popen.pid, "sim sitl"), f"px4 -i {instance} ")


def test_a_fleet_killed_by_its_operator_in_flight_falls_and_the_flight_fails(
    tmp_path: Path, build: Path, record_property: Property
) -> None:
    with flying(sitl_fleet(tmp_path, 2, plan=FOR_EVER), build, shown=True) as flight:
        flight.wait("formed")
        began_ns, began_s = time.time_ns(), time.monotonic()
        answer = run("sim", "kill", "--yes", "--fleet", str(flight.fleet.file), folder=tmp_path)
        assert answer.returncode == 0, answer.stderr
        assert flight.up.wait(AFTER_KILL_S) == 1
        record_property("the launcher's end after the kill (s)", time.monotonic() - began_s)
        rows = {i: flight.truth(i) for i in flight.fleet.ids}
    for r in rows.values():
        after = r[r["time_unix_ns"] > began_ns]
        assert after["velocity_ned_m_s"][:, 2].max() > 5.0, "it fell"
        assert not after["armed"][-1]
        record_property("fastest fall (m/s)", after["velocity_ned_m_s"][:, 2].max())
    summary = flight.summary
    assert summary["killed"] == {str(i): KillCause.COMMAND.value for i in flight.fleet.ids}
    assert summary["passed"] is False
    (kill,) = (c for c in summary["commands"] if c["verb"] == "kill")
    assert kill["accepted"] == flight.fleet.ids
    assert f"vehicle 1: {KillCause.COMMAND.value}" in flight.up.err
    assert f"vehicle 1: {KillCause.COMMAND.value}" in flight.up.out


def test_a_px4_that_dies_in_flight_is_told_on_the_screen_and_in_the_summary_and_blocks_nobody(
    tmp_path: Path, build: Path, record_property: Property
) -> None:
    """Two fly on until they are told to land; the launcher then waits for nobody else."""
    with flying(sitl_fleet(tmp_path, 3, plan=FOR_EVER), build, shown=True) as flight:
        flight.wait("formed")
        os.kill(px4_of(flight, 2), signal.SIGKILL)
        killed_s = time.monotonic()
        assert eventually(lambda: f"vehicle 2: {STATUS}" in flight.up.err, 10.0), flight.up.err
        record_property("on the screen after (s)", time.monotonic() - killed_s)
        time.sleep(5.0)
        said = flight.operator.status()
        for i in (1, 3):
            status = said[i]
            assert status is not None
            assert status.phase in ("formed", "moving", "holding")
        flight.up.signal(signal.SIGINT)
        assert eventually(lambda: not any(flight.truth(i)["armed"][-1] for i in (1, 3)), 60.0)
        landed_s = time.monotonic()
        assert flight.up.wait(AFTER_LANDING_S) == 1
        record_property("the launcher's end after the last landing (s)", time.monotonic() - landed_s)
    summary = flight.summary
    assert summary["autopilots_lost"] == {"2": STATUS}
    assert f"vehicle 2: {STATUS}" in flight.up.out
    assert summary["passed"] is False
    assert summary["landed"]["1"]
    assert summary["landed"]["3"]
    assert "autopilots lost" in [c["what"] for c in summary["criteria"] if not c["met"]]
    assert summary["minimum_distance_m"] > 2.5


def test_the_launcher_ends_soon_when_the_only_px4_dies(tmp_path: Path, build: Path, record_property: Property) -> None:
    with flying(sitl_fleet(tmp_path, 1, plan=FOR_EVER), build, shown=True) as flight:
        flight.wait("formed")
        os.kill(px4_of(flight, 1), signal.SIGKILL)
        killed_s = time.monotonic()
        assert flight.up.wait(AFTER_LANDING_S) == 1
        record_property("the launcher's end after PX4's death (s)", time.monotonic() - killed_s)
    summary = flight.summary
    assert summary["autopilots_lost"] == {"1": STATUS}
    assert summary["passed"] is False
    assert f"vehicle 1: {STATUS}" in flight.up.out
