"""A vehicle's companion computer looked over, as rows like preflight's: link, autopilot, clock, network, disk.

Made for the bench: it flies nothing, asks the autopilot for what a companion asks for on the ground, and needs the
vehicle's link for itself.
"""

import ctypes
import os
import select
import shutil
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from urllib.parse import urlsplit

from companion.config import FleetConfig
from companion.config.derived import Vehicle
from companion.errors import CompanionError
from companion.io.clock import FleetClock
from companion.io.link import Link
from companion.io.network import operator_link
from companion.io.signed_link import open_link
from companion.vehicle.autopilot.adapters import open_autopilot
from companion.vehicle.autopilot.port import AutopilotPort
from companion.vehicle.preflight import own_checks
from companion.wire.operator import Check, tidy

FREE_LEAST_GB = 1.0
"""a recording takes 25 MB for half an hour; nobody deletes the old ones"""
WRITE_LEAST_MB_S = 2.0
"""a companion records 14 kB/s; a card this slow is at its end"""
WRITE_BYTES = 8 << 20
TIME_ERROR = 5
"""adjtimex: the clock is not synchronised"""


class _Timex(ctypes.Structure):
    """struct timex, as far as it is read; the kernel writes 208 bytes."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror_us", ctypes.c_long),
        ("esterror_us", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_char * 256),
    )


def hardware_checks(
    config: FleetConfig, vehicle: Vehicle, seconds: float, folder: Path, key_file: Path | None = None
) -> Iterator[Check]:
    """Every row, as it is known; the autopilot is listened to for `seconds`, over a link signed by that key."""
    yield from _autopilot(config, vehicle, seconds, key_file)
    yield clock_check(kernel_clock())
    yield from _network(config, vehicle)
    yield from disk_checks(folder)


def _autopilot(config: FleetConfig, vehicle: Vehicle, seconds: float, key_file: Path | None) -> Iterator[Check]:
    try:
        link = open_link(vehicle, key_file)
    except CompanionError as error:
        yield Check("link", vehicle.mavlink, "opens", False, f"{error} (is a companion running?)")
        return
    try:
        yield Check("link", vehicle.mavlink, "opens", True, "")
        autopilot = open_autopilot(config, vehicle)
        clock = FleetClock()
        received = listen(link, autopilot, clock, seconds)
        yield Check("bytes", received, "> 0", received > 0, f"nothing came on {vehicle.mavlink} in {seconds:g} s")
        damaged = autopilot.rejected.get("malformed", 0)
        yield Check("damaged frames", damaged, "= 0", damaged == 0, f"{damaged} frames came damaged: baud rate, cable?")
        if key_file is not None:
            yield signing_check(link.refused)
        yield from own_checks(autopilot.facts(clock.now()), config, vehicle)
    finally:
        link.close()


def signing_check(refused: Mapping[str, int]) -> Check:
    """Whether both ends sign by one key."""
    wrong = {why: count for why, count in refused.items() if count}
    told = ", ".join(f"{count} {why}" for why, count in wrong.items())
    says = f"frames that are not believed: {told}. Has the autopilot another key, or none (`companion signing give`)?"
    return Check("signing", told or "all believed", "all believed", not wrong, says)


def listen(link: Link, autopilot: AutopilotPort, clock: FleetClock, seconds: float) -> int:
    """Hear and ask the autopilot for a while; how many bytes came."""
    received = 0
    end_ns = time.monotonic_ns() + round(seconds * 1e9)
    while (now_ns := time.monotonic_ns()) < end_ns:
        until_ns = min(autopilot.next_deadline_ns(), end_ns)
        ready, _, _ = select.select([link], [], [], max(until_ns - now_ns, 0) * 1e-9)
        for datagram, received_ns, address in link.receive() if ready else ():
            received += len(datagram)
            if link.admits(address, received_ns) and autopilot.receive(datagram, clock.at(received_ns)).autopilot:
                link.confirm(address, received_ns)
        for datagram in autopilot.due(clock.now()):
            link.send(datagram)
    return received


def kernel_clock() -> tuple[bool, float] | None:
    """Whether the kernel's clock is synchronised, and its largest error (s); None where it does not say."""
    state = _Timex()
    try:
        result = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(state))
    except (OSError, AttributeError):
        return None
    return None if result < 0 else (result != TIME_ERROR, state.maxerror_us * 1e-6)


def clock_check(kernel: tuple[bool, float] | None) -> Check:
    """Whether the clock follows NTP or PTP; unknown is said and no fault.

    The kernel's largest error is shown only: beside systemd-timesyncd it grows to a second between two polls.
    """
    limit = "synchronised"
    if kernel is None:
        return Check("system clock", "unknown", limit, True, "")
    synchronised, error_s = kernel
    value = f"yes, to {error_s:.3f} s" if synchronised else "no"
    return Check("system clock", value, limit, synchronised, "the system's clock is not synchronised (chrony, PTP)")


def _network(config: FleetConfig, vehicle: Vehicle) -> Iterator[Check]:
    if vehicle.zenoh is not None:
        fault = _listening_fault(vehicle.zenoh)
        yield Check(
            "own endpoint", vehicle.zenoh, "an address of this computer", fault is None,
            f"cannot listen on {vehicle.zenoh}: {fault}",
        )  # fmt: skip
    try:
        with operator_link(config) as link:
            others = {v.id for v in config.vehicles} - {vehicle.id}
            seen = sorted(link.wait_alive(others, 2.0))
    except CompanionError as error:
        yield Check("zenoh session", None, "opens", False, str(error))
        return
    yield Check("zenoh session", "open", "opens", True, "")
    yield Check("peers seen", ", ".join(str(i) for i in seen) or "none", "any: they may not be there yet", True, "")


def _listening_fault(endpoint: str) -> str | None:
    """Why nothing can listen there; in use is no fault, since a companion may run."""
    parts = urlsplit(endpoint.replace("/", "://", 1))
    kind = socket.SOCK_DGRAM if parts.scheme in ("udp", "quic") else socket.SOCK_STREAM
    host = parts.hostname or ""
    try:
        family, _, _, _, address = socket.getaddrinfo(host, 0, type=kind)[0]
        with socket.socket(family, kind) as s:
            s.bind(address)
    except OSError as error:
        return error.strerror or str(error)
    return None


def disk_checks(folder: Path) -> Iterator[Check]:
    """Room and speed where recordings go."""
    try:
        free = shutil.disk_usage(folder).free / 1e9
        speed = write_speed_mb_s(folder)
    except OSError as error:
        yield Check("recording folder", str(folder), "can be written", False, f"{folder}: {error.strerror}")
        return
    yield Check("recording folder", str(folder), "can be written", True, "")
    yield Check(
        "disk space", tidy(free), f">= {FREE_LEAST_GB:g} GB", free >= FREE_LEAST_GB,
        f"{free:.2f} GB are free in {folder}, must be {FREE_LEAST_GB:g} GB",
    )  # fmt: skip
    yield Check(
        "disk speed", tidy(speed), f">= {WRITE_LEAST_MB_S:g} MB/s", speed >= WRITE_LEAST_MB_S,
        f"{folder} is written at {speed:.1f} MB/s, must be at {WRITE_LEAST_MB_S:g} MB/s",
    )  # fmt: skip


def write_speed_mb_s(folder: Path, clock: Callable[[], float] = time.monotonic) -> float:
    """How fast some megabytes reach the disk."""
    path = folder / f".write-test-{os.getpid()}"
    fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    try:
        began_s = clock()
        block = os.urandom(1 << 16)
        for _ in range(WRITE_BYTES // len(block)):
            os.write(fd, block)
        os.fsync(fd)
        return WRITE_BYTES / 1e6 / max(clock() - began_s, 1e-6)
    finally:
        os.close(fd)
        path.unlink()
