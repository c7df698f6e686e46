"""The host of the stand-in autopilots: ports, truth, signals, and the end of its launcher."""

import json
import os
import signal
import socket
import time
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as mavlink
from stub_process import fleet, launched, listening, running, wait_until_bound

from companion.errors import CompanionError
from sim.autopilot.faults import Fault, FaultKind, encode_order
from sim.autopilot.stubs import TRUTH_DTYPE, run_stubs

pytestmark = pytest.mark.process


def receive(companion: socket.socket) -> list[mavlink.MAVLink_message]:
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True
    return list(parser.parse_buffer(companion.recv(2048)) or ())


def test_autopilot_talks_to_its_companions_port_alone_and_the_truth_is_recorded_at_50_hz(tmp_path: Path) -> None:
    settings = fleet(2, truth_path=tmp_path / "flight" / "truth.bin")
    vehicle = settings.vehicles[0]
    before_ns = time.time_ns()
    with listening(vehicle.companion_port) as companion, running(settings) as process:
        datagram, source = companion.recvfrom(2048)
        assert source == ("127.0.0.1", vehicle.autopilot_port)
        assert datagram[0] == 0xFD
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as elsewhere:
            elsewhere.bind(("127.0.0.1", 0))
            sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
            command = mavlink.MAVLink_command_long_message(1, 1, 31999, 0, 0, 0, 0, 0, 0, 0, 0)
            elsewhere.sendto(command.pack(sender), ("127.0.0.1", vehicle.autopilot_port))
            while not any(message.get_type() == "COMMAND_ACK" for message in receive(companion)):
                pass
            elsewhere.setblocking(False)
            with pytest.raises(BlockingIOError):
                elsewhere.recv(2048)
        process.terminate()
        process.join(5.0)
        assert process.exitcode == 0
    rows = np.fromfile(tmp_path / "flight" / "truth.bin", TRUTH_DTYPE)
    assert set(rows["vehicle_id"]) == {1, 2}
    assert np.all(rows["position_ned_m"][rows["vehicle_id"] == 2] == [0.0, 3.0, 0.0])
    times_ns = rows["time_unix_ns"][rows["vehicle_id"] == 1]
    assert times_ns[0] >= before_ns
    assert len(times_ns) == pytest.approx((times_ns[-1] - times_ns[0]) / 20e6, rel=0.1)
    assert np.all(np.diff(times_ns) > 0)


def test_busy_port_is_named_with_its_vehicle() -> None:
    settings = fleet(2)
    port = settings.vehicles[1].autopilot_port
    with listening(port), pytest.raises(CompanionError, match=f"vehicle 2: UDP port {port} of its autopilot is in use"):
        run_stubs(settings)


def test_ctrl_c_ends_the_stubs_cleanly_after_the_grace() -> None:
    settings = fleet(1, grace_s=0.5)
    with running(settings) as process:
        wait_until_bound(settings.vehicles[0].autopilot_port)
        assert process.pid is not None
        asked_s = time.monotonic()
        os.kill(process.pid, signal.SIGINT)
        process.join(5.0)
        assert process.exitcode == 0
        assert 0.45 <= time.monotonic() - asked_s < 2.5


def test_a_fault_is_ordered_by_a_datagram_and_acknowledged() -> None:
    settings = fleet(2)
    address = ("127.0.0.1", settings.vehicles[1].autopilot_port)
    with (
        listening(settings.vehicles[1].companion_port) as companion,
        launched(settings),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as outside,
    ):
        outside.settimeout(5.0)
        assert receive(companion)
        outside.sendto(b"{nonsense", address)
        assert json.loads(outside.recv(4096))["refused"]
        outside.sendto(encode_order(1, Fault(FaultKind.LOW_BATTERY)), address)
        assert json.loads(outside.recv(4096))["refused"] == "this is vehicle 2, not 1"
        outside.sendto(encode_order(2, Fault(FaultKind.LOW_BATTERY, magnitude=0.2)), address)
        assert json.loads(outside.recv(4096))["refused"] is None
        end_s = time.monotonic() + 10.0
        while time.monotonic() < end_s:
            reports = [m for m in receive(companion) if m.get_type() == "SYS_STATUS"]
            if reports and reports[0].battery_remaining == 20:
                return
        raise AssertionError("the fault was not carried out")


def test_launchers_end_is_noticed_by_its_pipe() -> None:
    settings = fleet(1)
    with launched(settings) as process:
        wait_until_bound(settings.vehicles[0].autopilot_port)
        assert process.poll() is None
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(5.0) == 0
