"""`fleet doctor`: this machine looked over before a fleet flies on it, as rows like preflight's. It starts nothing."""

import os
import socket
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version

from companion.config import FleetConfig
from companion.config.endpoints import udp_endpoint
from companion.errors import CompanionError
from companion.io.check import clock_check, kernel_clock
from companion.wire.operator import Check
from sim.autopilot.stub_fleet import stub_port
from sim.launch.px4_build import HOW_TO_GET, build_version, find_build

PYTHON_LEAST = (3, 11)
FLIGHT = ("numpy", "pydantic", "typer", "fastcrc", "eclipse-zenoh")
SIMULATION = ("pymavlink", "rich", "mcap", "matplotlib")
STUDIES = ("numba", "scipy")
MODULES = {"eclipse-zenoh": "zenoh"}
VEHICLES_PER_CORE = 8
GROUND_PORT = 14550


def doctor_checks(config: FleetConfig) -> Iterator[Check]:
    """Every row: Python, libraries, ports of this fleet, multicast, clock, processors, PX4."""
    here = sys.version_info[:2]
    least = ".".join(map(str, PYTHON_LEAST))
    yield Check(
        "Python", sys.version.split()[0], f">= {least}", here >= PYTHON_LEAST, f"Python is older than {least}", True
    )
    yield _libraries("flight", FLIGHT, "pip install -c constraints.txt .", needed=True)
    yield _libraries("simulation", SIMULATION, "pip install -c constraints.txt '.[sim]'", needed=True)
    yield _libraries("studies", STUDIES, "pip install -c constraints.txt '.[study]'", needed=False)
    yield from _ports(config)
    yield _multicast()
    clock = clock_check(kernel_clock())
    # Vehicles of one machine share its clock: only those of several computers need NTP.
    yield replace(clock, passed=True, warns=not clock.passed, limit="synchronised, for vehicles elsewhere")
    cores, most = len(os.sched_getaffinity(0)), VEHICLES_PER_CORE * len(os.sched_getaffinity(0))
    many = len(config.vehicles) > most
    says = f"{len(config.vehicles)} vehicles on {cores} processors: `fleet up` controls them at 20 Hz instead of 50"
    yield Check("processors", cores, f"{VEHICLES_PER_CORE} vehicles each", True, says if many else "", warns=many)
    yield _px4()


def _libraries(what: str, names: tuple[str, ...], cure: str, *, needed: bool) -> Check:
    there, gone = [], []
    for name in names:
        try:
            import_module(MODULES.get(name, name))
            there.append(f"{name} {version(name)}")
        except (ImportError, PackageNotFoundError):
            gone.append(name)
    says = f"{', '.join(gone)} cannot be imported: `{cure}`"
    passed = not gone or not needed
    return Check(
        f"libraries: {what}", ", ".join(there) or None, "importable", passed, says, warns=bool(gone) and passed
    )


def _ports(config: FleetConfig) -> Iterator[Check]:
    taken = []
    for v in config.vehicles:
        endpoint = udp_endpoint(v.mavlink)
        for port in (endpoint[1], stub_port(v)) if endpoint is not None else ():
            if not _free(port):
                taken.append(f"{port} (vehicle {v.id})")
    says = (
        f"UDP ports taken: {', '.join(taken[:6])}. Does another fleet, stub or PX4 run? `ss -lunp` tells whose they are"
    )
    yield Check("ports", len(taken), "= 0 taken", not taken, says)
    gcs = _free(GROUND_PORT)
    yield Check("ground station's port", "free" if gcs else "taken", "any: it is QGroundControl's", True, "")


def _free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        try:
            s.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


def _multicast() -> Check:
    """Companions of one machine find each other by multicast on the loopback interface."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
            s.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
            s.sendto(b"", ("224.0.0.224", 7446))
    except OSError as error:
        says = f"multicast on the loopback interface: {error.strerror}; `ip link set lo multicast on`"
        return Check("multicast", "none", "on the loopback interface", False, says)
    return Check("multicast", "sends", "on the loopback interface", True, "")


def _px4() -> Check:
    """For `--autopilot px4` alone, so none is no fault."""
    try:
        build = find_build(None)
    except CompanionError:
        return Check("PX4", None, "for --autopilot px4", True, f"no PX4 is found. {HOW_TO_GET}", warns=True)
    return Check(
        "PX4", f"{build} (like v{'.'.join(map(str, build_version(build).number))})", "for --autopilot px4", True, ""
    )
