"""`companion check` on a computer whose autopilot is a stub."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from fleet_process import make_fleet, operator_of, run, started, wait_status

from companion.vehicle.preflight import PARAMETERS

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]


def rows_of(text: str) -> dict[str, dict[str, Any]]:
    return {row["name"]: row for row in json.loads(text)["checks"]}


def test_a_computer_is_looked_over_with_its_autopilot_and_its_peers(tmp_path: Path) -> None:
    fleet = make_fleet(tmp_path, 2)
    check = ("companion", "check", "--json", "--fleet", str(fleet.file), "--vehicle")
    with (
        started("sim", "stub", "--fleet", str(fleet.file), folder=tmp_path, name="stub"),
        started("companion", "run", "--vehicle", "2", "--fleet", str(fleet.file), folder=tmp_path, name="companion"),
        operator_of(fleet) as operator,
    ):
        wait_status(operator, lambda said: 2 in said and said[2].ready == ["not heard: vehicle 1"])
        done = run(*check, "1", "--seconds", "8", folder=tmp_path)
        busy = run(*check, "2", "--seconds", "1", folder=tmp_path)
    rows = rows_of(done.stdout)
    faults = {name for name, row in rows.items() if not row["passed"]}
    assert faults <= {"system clock"}, done.stdout
    assert done.returncode == (1 if faults else 0)
    assert set(PARAMETERS) - {"MAN_OVERRIDE_SPD"} <= set(rows)  # which this version of the stub has not
    assert rows["bytes"]["value"] > 1000
    assert rows["peers seen"]["value"] == "2"
    assert rows["zenoh session"]["passed"]
    assert rows["disk speed"]["value"] > 0
    assert busy.returncode == 1
    assert "it is in use (is a companion running?)" in rows_of(busy.stdout)["link"]["message"]


def test_without_an_autopilot_the_rows_say_what_is_missing(tmp_path: Path) -> None:
    fleet = make_fleet(tmp_path, 1)
    arguments = ("companion", "check", "--vehicle", "1", "--seconds", "1", "--fleet", str(fleet.file))
    done = run(*arguments, folder=tmp_path)
    assert done.returncode == 1
    assert "no heartbeat from the autopilot" in done.stdout
    assert f"nothing came on udp://127.0.0.1:{fleet.port} in 1 s" in done.stdout
