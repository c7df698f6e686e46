"""A vehicle that does not come: named, waited for, or flown without."""

from __future__ import annotations

import json
import signal
import time
import tomllib
from pathlib import Path

import pytest
import tomli_w
from fleet_process import Fleet, eventually, flight_folder, gone, make_fleet, ports_free, started, truth

from companion.config import load

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]


def without_third(fleet: Fleet) -> Path:
    """The file of whoever runs two autopilots of the three."""
    tables = tomllib.loads(fleet.file.read_text())
    tables["vehicle"][2]["enabled"] = False
    file = fleet.folder / "two.toml"
    file.write_text(tomli_w.dumps(tables))
    return file


def test_who_does_not_come_is_named_within_fifteen_seconds(tmp_path: Path) -> None:
    fleet = make_fleet(tmp_path, 3)
    out = tmp_path / "flights"
    arguments = ("up", "--fleet", str(fleet.file), "--out", str(out), "--autopilot", "external", "--json")
    with (
        started("sim", "stub", "--fleet", str(without_third(fleet)), folder=tmp_path, name="stub"),
        started("sim", *arguments, folder=tmp_path, name="up") as up,
    ):
        assert eventually(lambda: list(out.glob("*/companion-3.log")) != [])
        began_s = time.monotonic()
        line = "vehicle 3 has not come: its autopilot is not heard (--allow-missing flies without)\n"
        assert eventually(lambda: up.err.count(line) == 1, 15.0 - (time.monotonic() - began_s)), up.err
        up.signal(signal.SIGINT)
        assert up.wait() == 1
        assert "interrupted before take-off" in up.err


def test_a_fleet_flies_without_who_does_not_come_and_says_so(tmp_path: Path) -> None:
    fleet = make_fleet(tmp_path, 3, plan={"legs": [{"kind": "hold", "duration_s": 8.0}], "then": "land"})
    out = tmp_path / "flights"
    arguments = (
        "up", "--fleet", str(fleet.file), "--out", str(out), "--autopilot", "external", "--allow-missing", "--json",
    )  # fmt: skip
    with (
        started("sim", "stub", "--fleet", str(without_third(fleet)), folder=tmp_path, name="stub") as stub,
        started("sim", *arguments, folder=tmp_path, name="up") as up,
    ):
        assert up.wait() == 0, up.err
        assert stub.popen.poll() is None
    assert up.err == "vehicle 3 has not come: its autopilot is not heard; flying without\n"
    summary = json.loads(up.out)
    assert summary["passed"], summary["criteria"]
    assert summary["missing"] == {"3": "its autopilot is not heard"}
    assert summary["exit_status"] == {"1": 0, "2": 0}
    assert summary["unrecorded"] == {}
    assert [v.id for v in load(flight_folder(out) / "fleet.toml").vehicles] == [1, 2]
    assert ports_free(fleet)


def test_a_companion_that_cannot_start_is_flown_without(tmp_path: Path) -> None:
    """Somebody else has its port; the stub of that vehicle stays on the ground."""
    fleet = make_fleet(tmp_path, 3, plan={"legs": [{"kind": "hold", "duration_s": 3.0}], "then": "land"})
    out = tmp_path / "flights"
    arguments = ("up", "--fleet", str(fleet.file), "--out", str(out), "--allow-missing", "--json")
    with started("companion", "run", "--vehicle", "2", "--fleet", str(other_name(fleet)), folder=tmp_path) as other:
        assert eventually(lambda: not ports_free(fleet))
        with started("sim", *arguments, folder=tmp_path, name="up") as up:
            up.wait()
        assert not gone(other.popen.pid)
    assert f"cannot listen on UDP 127.0.0.1:{fleet.port + 1}: it is in use" in up.err
    summary = json.loads(up.out)
    assert list(summary["missing"]) == ["2"]
    assert summary["landed"] == {"1": True, "3": True}
    assert truth(flight_folder(out) / "truth.bin", 2)["armed"].sum() == 0


def other_name(fleet: Fleet) -> Path:
    """The same ports under another fleet's name."""
    tables = tomllib.loads(fleet.file.read_text())
    tables["fleet"]["name"] += "-other"
    file = fleet.folder / "other.toml"
    file.write_text(tomli_w.dumps(tables))
    return file
