"""A scenario harms companions' processes and the air that stubs fly in, and the flight's record tells of it."""

import json
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from fleet_process import flight_folder, make_fleet, run

from companion.io.recording import read_recording

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]
PLAN = {"then": "land", "legs": [{"kind": "velocity", "north_m_s": 1.0, "duration_s": 60.0}]}
SCENARIO = """
[[fault]]
at_s = 6.0
vehicle = 1
kind = "wind"
wind_ned_m_s = [0.0, 2.0, 0.0]
duration_s = 4.0
[[fault]]
at_s = 8.0
vehicle = 1
kind = "gps_stuck"
[[fault]]
at_s = 12.0
vehicle = 1
kind = "companion_stopped"
duration_s = 0.6
[[fault]]
at_s = 14.0
vehicle = 2
kind = "companion_restarted"
[[fault]]
at_s = 16.0
vehicle = 3
kind = "companion_killed"
"""


def test_companions_are_stopped_started_anew_and_killed_at_their_times(tmp_path: Path) -> None:
    fleet = make_fleet(tmp_path, 3, plan=PLAN)
    scenario = tmp_path / "scenario.toml"
    scenario.write_text(SCENARIO)
    done = run(
        "sim", "up", "--fleet", str(fleet.file), "--out", str(tmp_path / "flights"), "--scenario", str(scenario),
        "--for", "24", "--json", folder=tmp_path,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr  # a companion was lost: no flight that passed
    summary: dict[str, Any] = json.loads(done.stdout)
    assert summary["lost"] == [3]
    assert summary["exit_status"]["3"] == -9
    assert summary["exit_status"]["2"] == 0
    assert summary["minimum_distance_m"] > 1.2
    (refused,) = summary["faults_refused"]
    assert re.search(r"gps_stuck at 8 s: .*a stub does not play it", refused)
    assert refused in done.stderr
    folder = flight_folder(tmp_path / "flights")
    assert "companion_" not in (folder / "autopilots.log").read_text()
    again = read_recording(folder / "vehicle-2-2.mcap")
    assert any(e.channel == "input/mavlink" for e in again.entries)
    first = read_recording(folder / "vehicle-1.mcap").entries
    ticks_ns = [e.instant.monotonic_ns for e in first if e.channel == "tick"]
    assert max(b - a for a, b in pairwise(ticks_ns)) > 500_000_000, "vehicle 1's stood still"
