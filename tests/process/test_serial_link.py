"""A companion on a serial line: bytes in any portions, a slow line, a line that is pulled out."""

import os
import select
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from fleet_process import SETTLED, all_in, make_fleet, operator_of, run, started, wait_status
from pymavlink.dialects.v20 import development as dialect
from stub_process import QUICK

from companion.core.frames import Ned
from companion.errors import CompanionError
from companion.io.link import SERIAL_UNSENT_MOST, SerialLink
from companion.vehicle.autopilot.px4_versions import OLDEST, fleet_parameters
from companion.wire.mavlink_frames import FrameSplitter
from sim.autopilot.autopilot import Autopilot
from sim.autopilot.disturbances import GustParameters, NoiseParameters

pytestmark = pytest.mark.process
BAUD = 921600
PORTION = 37
"""bytes written at a time: no multiple of any frame"""


@contextmanager
def line() -> Iterator[tuple[int, str]]:
    """The autopilot's end of a serial line, and the device at the companion's."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    try:
        yield ours, os.ttyname(theirs)
    finally:
        os.close(ours)
        os.close(theirs)


def frame(k: int = 0) -> bytes:
    sender: Any = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    return bytes(dialect.MAVLink_local_position_ned_message(k, 1.0, 2.0, 3.0, 0.5, 0.25, 0.125).pack(sender))


def received(link: SerialLink, count: int) -> list[bytes]:
    """The next frames; fails when they do not come."""
    found: list[bytes] = []
    while len(found) < count:
        ready, _, _ = select.select([link], [], [], 10.0)
        assert ready, f"{len(found)} of {count} frames"
        found += [data for data, _, _ in link.receive()]
    return found


def test_frames_come_whole_and_in_order_from_bytes_in_any_portions() -> None:
    sent = [frame(k) for k in range(50)]
    with line() as (ours, device):
        link = SerialLink(device, BAUD)
        stream = b"".join(sent)
        found: list[bytes] = []
        for begin in range(0, len(stream), PORTION):
            os.write(ours, stream[begin : begin + PORTION])
            while select.select([link], [], [], 0)[0]:
                found += [data for data, _, _ in link.receive()]
        found += received(link, len(sent) - len(found))
        assert found == sent
        link.close()


def test_what_a_slow_line_has_no_room_for_is_dropped_in_whole_frames() -> None:
    with line() as (ours, device):
        link = SerialLink(device, BAUD)
        sent = [frame(k) for k in range(3000)]
        for one in sent:
            link.send(one)
        assert link.send_failures > 0
        splitter, got = FrameSplitter(), []
        while select.select([ours], [], [], 0.2)[0]:
            got += splitter.split(os.read(ours, 4096))
            if len(got) == 10:
                link.send(frame(9999))  # what has waited goes first
        assert splitter.dropped == 0
        assert set(got) <= {*sent, frame(9999)}
        assert len(got) >= len(sent) - link.send_failures - SERIAL_UNSENT_MOST // len(sent[0]) - 2
        link.close()


def test_a_line_that_was_pulled_out_is_opened_again(tmp_path: Path) -> None:
    device = tmp_path / "tty"
    with line() as (_, first):
        device.symlink_to(first)
        link = SerialLink(str(device), BAUD)
    assert select.select([link], [], [], 5.0)[0]
    assert link.receive() == []
    link.send(frame())
    assert link.send_failures == 1
    with line() as (ours, second):
        device.unlink()
        device.symlink_to(second)
        deadline_s = time.monotonic() + 10.0
        while not select.select([ours], [], [], 0)[0]:
            assert time.monotonic() < deadline_s
            link.send(frame())
        os.write(ours, frame(7))
        assert received(link, 1) == [frame(7)]
        link.close()


def test_a_line_has_one_owner_until_it_is_closed() -> None:
    with line() as (ours, device):
        link = SerialLink(device, BAUD)
        os.write(ours, frame(1))
        with pytest.raises(CompanionError, match=f"cannot open serial line {device}: another process has it"):
            SerialLink(device, BAUD)
        assert received(link, 1) == [frame(1)], "nothing was taken from its owner"
        link.close()
        SerialLink(device, BAUD).close()


def test_a_line_that_was_pulled_out_is_free_and_owned_again_when_reopened(tmp_path: Path) -> None:
    device = tmp_path / "tty"
    with line() as (_, first):
        device.symlink_to(first)
        link = SerialLink(str(device), BAUD)
    assert link.receive() == []
    with line() as (ours, second):
        device.unlink()
        device.symlink_to(second)
        SerialLink(second, BAUD).close()
        deadline_s = time.monotonic() + 10.0
        while not select.select([ours], [], [], 0)[0]:
            assert time.monotonic() < deadline_s
            link.send(frame())
        with pytest.raises(CompanionError, match="another process has it"):
            SerialLink(second, BAUD)
        link.close()


@pytest.mark.parametrize(("device", "baud", "why"), [("/dev/null", BAUD, "cannot open"), ("/nowhere", BAUD, "No such"),
                                                     ("/dev/null", 12345, "12345 baud is not one of")])  # fmt: skip
def test_what_is_no_serial_line_is_refused_with_the_reason(device: str, baud: int, why: str) -> None:
    with pytest.raises(CompanionError, match=why):
        SerialLink(device, baud)


def serve(autopilot: Autopilot, ours: int, over: threading.Event) -> None:
    """A stand-in autopilot at its end of the line, in real time."""
    splitter, waiting = FrameSplitter(), b""
    while not over.is_set():
        wait_s = max(autopilot.next_deadline_ns() - time.monotonic_ns(), 0) * 1e-9
        if select.select([ours], [], [], min(wait_s, 0.05))[0]:
            for one in splitter.split(os.read(ours, 4096)):
                autopilot.receive(one, time.monotonic_ns())
        waiting += b"".join(autopilot.advance(time.monotonic_ns()))
        while waiting and select.select([], [ours], [], 0)[1]:
            waiting = waiting[os.write(ours, waiting[:PORTION]) :]


def test_a_vehicle_flies_over_a_serial_line(tmp_path: Path) -> None:
    with line() as (ours, device):
        fleet = make_fleet(
            tmp_path, 1, vehicle=[{"id": 1, "mavlink": f"serial://{device}:{BAUD}"}],
            preflight={"offboard_loss_limit_s": dict(QUICK)["COM_OF_LOSS_T"]},
        )  # fmt: skip
        now_ns = time.monotonic_ns()
        autopilot = Autopilot(
            system_id=1, boot_ns=now_ns, utc_offset_ns=time.time_ns() - now_ns, fleet_origin=fleet.config.origin,
            home_ned_m=Ned(0.0, 0.0, 0.0), gust=GustParameters(sigma_m_s2=0.0),
            noise=NoiseParameters(position_sigma_m=0.0, velocity_sigma_m_s=0.0),
            parameters={**fleet_parameters(OLDEST), **dict(QUICK)},
        )  # fmt: skip
        over = threading.Event()
        thread = threading.Thread(target=serve, args=(autopilot, ours, over))
        thread.start()
        try:
            with (
                started("companion", "run", "--vehicle", "1", "--fleet", str(fleet.file), folder=tmp_path) as companion,
                operator_of(fleet) as operator,
            ):
                wait_status(operator, lambda said: 1 in said and said[1].ready == [])
                assert operator.take_off().all_accepted
                said = wait_status(operator, all_in([1], *SETTLED))
                assert said[1].rejected.get("malformed", 0) == 0
                arguments = ("companion", "check", "--json", "--seconds", "1", "--vehicle", "1", "--fleet")
                busy = run(*arguments, str(fleet.file), folder=tmp_path)
                assert f"{device}: another process has it (is a companion running?)" in busy.stdout
                assert not wait_status(operator, lambda said: 1 in said)[1].failsafes
                assert operator.land().all_accepted
                wait_status(operator, all_in([1], "landed"))
                companion.popen.terminate()
                assert companion.wait() == 0
        finally:
            over.set()
            thread.join()
