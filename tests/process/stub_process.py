"""Starts stand-in autopilots in a process of their own, on ports that are free at the moment."""

import dataclasses
import multiprocessing
import pickle
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from pathlib import Path

from companion.core.frames import Geodetic, Ned
from sim.autopilot.stubs import StubFleetSettings, StubVehicleSettings, run_stubs

QUICK = (
    ("COM_SPOOLUP_TIME", 0.2),
    ("MPC_TKO_RAMP_T", 0.5),
    ("MPC_TKO_SPEED", 2.5),
    ("MPC_LAND_SPEED", 1.4),
    ("MPC_LAND_CRWL", 1.0),
    ("LNDMC_TRIG_TIME", 0.3),
    ("COM_DISARM_LAND", 0.3),
    ("COM_OF_LOSS_T", 5.0),
)
"""parameters of a vehicle in a hurry, on a machine that may stall"""


def free_ports(count: int) -> list[int]:
    """UDP ports of the loopback interface that nobody has."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    for s in sockets:
        s.bind(("127.0.0.1", 0))
    ports = [int(s.getsockname()[1]) for s in sockets]
    for s in sockets:
        s.close()
    return ports


def fleet(
    count: int,
    *,
    parameters: tuple[tuple[str, float | int], ...] = QUICK,
    truth_path: Path | None = None,
    grace_s: float = 0.0,
) -> StubFleetSettings:
    """Vehicles 1..count, three metres apart, every origin elsewhere."""
    ports = free_ports(2 * count)
    vehicles = tuple(
        StubVehicleSettings(
            vehicle_id=i + 1,
            system_id=i + 1,
            autopilot_port=ports[2 * i],
            companion_port=ports[2 * i + 1],
            home_ned_m=Ned(0.0, 3.0 * i, 0.0),
            ekf_origin_offset_m=Ned(1.0 + i, -2.0, 0.3),
            parameters=parameters,
        )
        for i in range(count)
    )
    origin = Geodetic(47.3977, 8.5456, 488.0)
    return StubFleetSettings(vehicles=vehicles, fleet_origin=origin, truth_path=truth_path, grace_s=grace_s)


@contextmanager
def running(settings: StubFleetSettings) -> Iterator[BaseProcess]:
    """The stubs in a child process, ended with SIGTERM."""
    process = multiprocessing.get_context("spawn").Process(target=run_stubs, args=(settings,))
    process.start()
    try:
        yield process
    finally:
        if process.is_alive():
            process.terminate()
        process.join(10.0)
        if process.is_alive():
            process.kill()
            process.join()


def wait_until_bound(port: int, at_most_s: float = 20.0) -> None:
    """Returns once somebody has the port."""
    end_s = time.monotonic() + at_most_s
    while time.monotonic() < end_s:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                return
        time.sleep(0.02)
    raise TimeoutError(f"nobody has bound port {port}")


@contextmanager
def listening(port: int) -> Iterator[socket.socket]:
    """A companion's socket."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as companion:
        companion.settimeout(10.0)
        companion.bind(("127.0.0.1", port))
        yield companion


@contextmanager
def launched(settings: StubFleetSettings) -> Iterator[subprocess.Popen[bytes]]:
    """The stubs as a launcher's child, whose standard input is the pipe to it."""
    code = (
        "import pickle, sys; from sim.autopilot.stubs import run_stubs; "
        "run_stubs(pickle.loads(bytes.fromhex(sys.argv[1])))"
    )
    settings = dataclasses.replace(settings, stop_fd=0)
    process = subprocess.Popen([sys.executable, "-c", code, pickle.dumps(settings).hex()], stdin=subprocess.PIPE)
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        assert process.stdin is not None
        process.stdin.close()
