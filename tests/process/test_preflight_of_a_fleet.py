"""Preflight as an operator asks for it: real stubs, companions and Zenoh, with one fault of each kind."""

from __future__ import annotations

import json
import signal
import socket
import struct
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from fleet_process import STUB_PORT_OFFSET, Fleet, eventually, make_fleet, operator_of, run, started, truth, wait_status
from pymavlink.dialects.v20 import development as dialect

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]

HOVER = {"legs": [], "then": "land"}


def set_parameter(fleet: Fleet, vehicle_id: int, name: str, value: int) -> None:
    """What a ground station may do."""
    mav = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    wire_value = struct.unpack("<f", struct.pack("<i", value))[0]
    message = dialect.MAVLink_param_set_message(vehicle_id, 1, name.encode(), wire_value, 6)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.sendto(message.pack(mav), ("127.0.0.1", fleet.port + STUB_PORT_OFFSET + vehicle_id - 1))


def preflight(fleet: Fleet) -> tuple[int, dict[str, Any]]:
    """`fleet preflight --json`: exit status and report."""
    done = run("sim", "preflight", "--json", "--fleet", str(fleet.file), folder=fleet.folder)
    assert done.stdout, done.stderr
    return done.returncode, json.loads(done.stdout)


@dataclass(slots=True)
class Looked:
    """What preflight said of a fleet full of faults, and of the same fleet put right."""

    fleet: Fleet
    status: int = -1
    report: dict[str, Any] = field(default_factory=dict)
    refused: subprocess.CompletedProcess[str] | None = None
    armed: bool = False
    explained: subprocess.CompletedProcess[str] | None = None
    fit_status: int = -1
    fit_report: dict[str, Any] = field(default_factory=dict)


@pytest.fixture(scope="module")
def looked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Looked]:
    folder = tmp_path_factory.mktemp("preflight")
    fleet = make_fleet(folder, 4, plan=HOVER)
    other_file = folder / "other.toml"
    tables = {**_tables(fleet), "formation": {"shape": "line", "altitude_m": 2.0}}
    other_file.write_text(tomli_w.dumps(tables))
    looked = Looked(fleet)

    def companion(vehicle_id: int, file: Path, name: str) -> Any:
        arguments = ("companion", "run", "--vehicle", str(vehicle_id), "--fleet", str(file))
        return stack.enter_context(started(*arguments, folder=folder, name=name))

    with ExitStack() as stack:
        truth_file = folder / "truth.bin"
        stack.enter_context(
            started("sim", "stub", "--fleet", str(fleet.file), "--truth", str(truth_file), folder=folder, name="stub")
        )
        companion(1, fleet.file, "one")
        companion(2, fleet.file, "two")
        strange = companion(3, other_file, "strange")
        operator = stack.enter_context(operator_of(fleet))
        wait_status(
            operator,
            lambda said: sorted(said) == [1, 2, 3] and all(s.ready == ["not heard: vehicle 4"] for s in said.values()),
        )
        set_parameter(fleet, 1, "COM_OBL_RC_ACT", 0)
        run("sim", "fault", "2", "low_battery", "--magnitude", "0.12", "--fleet", str(fleet.file), folder=folder)
        wait_status(operator, lambda said: bool(said[1].unfit) and bool(said[2].unfit))
        looked.status, looked.report = preflight(fleet)
        looked.refused = run("sim", "takeoff", "--fleet", str(fleet.file), folder=folder)
        looked.armed = any(truth(truth_file, i)["armed"].any() for i in fleet.ids)

        set_parameter(fleet, 1, "COM_OBL_RC_ACT", 4)
        run("sim", "fault", "2", "low_battery", "--for", "0", "--fleet", str(fleet.file), folder=folder)
        strange.signal(signal.SIGTERM)
        strange.wait()
        companion(3, fleet.file, "three")
        companion(4, fleet.file, "four")
        wait_status(operator, lambda said: len(said) == 4 and all(not s.ready for s in said.values()))
        looked.explained = run("sim", "preflight", "--explain", "--fleet", str(fleet.file), folder=folder)

        def comes_right() -> bool:
            looked.fit_status, looked.fit_report = preflight(fleet)
            return looked.fit_status == 0

        eventually(comes_right, 60.0)
        yield looked


def _tables(fleet: Fleet) -> dict[str, Any]:
    tables: dict[str, Any] = fleet.config.model_dump(
        mode="json", exclude_none=True, include={"fleet", "plan", "peers", "vehicle"}
    )
    return tables


def test_every_vehicle_and_value_at_fault_is_named_at_once(looked: Looked) -> None:
    assert looked.status == 1
    assert looked.report["fit"] is False
    faults = looked.report["faults"]
    assert "not heard: vehicle 4" in faults
    assert any(f.startswith("vehicle 1: COM_OBL_RC_ACT is 0, must be 4 or 5: ") for f in faults)
    assert "vehicle 2: battery at 12 %, must have 30 %" in faults
    says = "vehicle 3: its fleet.toml differs from the operator's in formation.shape (hash "
    assert any(f.startswith(says) for f in faults)
    assert any(f.startswith("vehicle 3: assigns the slots otherwise") for f in faults)
    assert {f.split(":")[0] for f in faults} <= {"not heard", *(f"vehicle {i}" for i in (1, 2, 3))}


def test_nobody_takes_off_meanwhile(looked: Looked) -> None:
    assert looked.refused is not None
    assert looked.refused.returncode == 1
    assert "vehicle 2: battery at 12 %, must have 30 %" in looked.refused.stderr
    assert not looked.armed


def test_a_fleet_put_right_is_fit(looked: Looked) -> None:
    assert looked.fit_report["faults"] == []
    assert looked.fit_status == 0
    rows = {(c["vehicle"], c["name"]): c for c in looked.fit_report["checks"]}
    for i in looked.fleet.ids:
        assert rows[i, "COM_OBL_RC_ACT"]["value"] == 4
        assert 0.0 < rows[i, "link round trip"]["value"] < 0.25
        assert abs(rows[i, "clock"]["value"]) < 0.1, "one machine has one clock"
        assert rows[i, "position rate"]["value"] > 10.0


def test_explaining_shows_every_check_with_value_and_limit(looked: Looked) -> None:
    assert looked.explained is not None
    text = looked.explained.stdout
    for name in (
        "COM_OF_LOSS_T",
        "battery",
        "link round trip",
        "ways to the slots",
        "configuration",
        "start positions",
    ):
        assert name in text
    assert ">= 30 %" in text


def test_fleet_up_refuses_what_waiting_does_not_heal(tmp_path: Path) -> None:
    fleet = make_fleet(tmp_path, 2, plan=HOVER, preflight={"offboard_loss_limit_s": 0.5})
    done = run("sim", "up", "--fleet", str(fleet.file), "--out", "flights", "--json", folder=tmp_path)
    assert done.returncode == 1
    assert done.stdout == ""
    for i in fleet.ids:
        assert f"vehicle {i}: COM_OF_LOSS_T is 1, must be <= 0.5 s and > 0: the autopilot acts too late" in done.stderr
