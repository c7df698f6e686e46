"""`fleet doctor`: what is at fault on this machine is named with its cure, and nothing is started."""

import json
import socket
from pathlib import Path

import pytest
from typer.testing import CliRunner

from companion.config import load
from companion.wire.operator import Check
from sim.__main__ import app
from sim.launch import doctor
from sim.launch.doctor import doctor_checks

FILE = Path(__file__).resolve().parents[2] / "fleet.toml"


def rows(port: int = 33_000) -> dict[str, Check]:
    def change(tables: dict[str, object]) -> None:
        tables["vehicle"] = [{"id": 1, "mavlink": f"udp://127.0.0.1:{port}"}]

    return {row.name: row for row in doctor_checks(load(FILE, change))}


def test_a_machine_that_runs_these_tests_is_fit_but_for_what_it_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    found = rows()
    for name in ("Python", "libraries: flight", "libraries: simulation", "multicast"):
        assert found[name].passed, found[name]
    monkeypatch.setattr(doctor, "SIMULATION", ("pymavlink", "no-such-library"))
    assert rows()["libraries: simulation"].message.startswith("no-such-library cannot be imported: `pip install")
    monkeypatch.setattr(doctor, "PYTHON_LEAST", (4, 0))
    assert not rows()["Python"].passed


def test_a_port_that_somebody_has_is_named_with_its_vehicle() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        port = int(s.getsockname()[1])
        found = rows(port)
    assert not found["ports"].passed
    assert f"{port} (vehicle 1)" in found["ports"].message


def test_a_px4_that_is_not_there_is_no_fault_and_where_to_get_one_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PX4_BUILD", raising=False)
    monkeypatch.setattr("sim.launch.px4_build.PLACES", ())
    row = rows()["PX4"]
    assert row.passed
    assert row.warns
    assert "docs.px4.io" in row.message
    build = tmp_path / "px4"
    (build / "bin").mkdir(parents=True)
    (build / "etc").mkdir()
    (build / "bin" / "px4").write_bytes(b"\0COM_RC_OVERRIDE\0\0SDLOG_MODE\0")
    monkeypatch.setenv("PX4_BUILD", str(build))
    assert rows()["PX4"].value == f"{build} (like v1.16)"


def test_the_verb_ends_by_its_rows() -> None:
    done = CliRunner().invoke(app, ["doctor", "--fleet", str(FILE), "--json"])
    told = json.loads(done.stdout)
    assert {c["name"] for c in told["checks"]} >= {"Python", "ports", "PX4", "system clock"}
    assert done.exit_code == (0 if told["fit"] else 1)
