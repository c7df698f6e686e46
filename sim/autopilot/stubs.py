"""Process host of stand-in autopilots: N vehicles on UDP sockets of the loopback interface, and a recorder of truth.

Autopilot i sends from its port to its companion's port from boot on, whoever is there, as PX4 does; it never sends
elsewhere (measured: a client on any other port gets nothing).
"""

import errno
import json
import logging
import math
import os
import selectors
import signal
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from companion.core.frames import Geodetic, Ned
from companion.errors import CompanionError
from companion.terminal import tell
from companion.vehicle.autopilot.px4_versions import OLDEST
from sim.autopilot.autopilot import NO_OFFSET, Autopilot
from sim.autopilot.disturbances import GustParameters, NoiseParameters
from sim.autopilot.dynamics_parameters import DynamicsParameters
from sim.autopilot.faults import decode_order
from sim.autopilot.ground import GroundLink
from sim.autopilot.truth import TruthState

log = logging.getLogger(__name__)
TRUTH_DTYPE = np.dtype(
    [
        ("time_unix_ns", "<i8"),
        ("vehicle_id", "<u2"),
        ("armed", "u1"),
        ("landed_state", "u1"),
        ("custom_mode", "<u4"),
        ("position_ned_m", "<f8", (3,)),
        ("velocity_ned_m_s", "<f4", (3,)),
        ("setpoint_gap_max_s", "<f4"),
        ("attitude_rate_rad_s", "<f4"),
    ]
)
"""one record of the truth file: UTC, the vehicle, MAV_LANDED_STATE, PX4's custom_mode, true motion in the fleet frame,
longest time without a set-point while OFFBOARD flew. The file is these records and nothing else: np.fromfile reads it.
"""
_TRUTH_RECORD = struct.Struct("<qHBBI3d3fff")
"""the same record, packed one at a time: some ten times faster than numpy on single rows"""
TRUTH_INTERVAL_NS = 20_000_000
FLUSH_INTERVAL_NS = 500_000_000
STALL_NS = 200_000_000
"""a host that is this late has stalled"""
RESUME_NS = 20_000_000
RECEIVE_BUFFER_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class StubVehicleSettings:
    """One stand-in autopilot."""

    vehicle_id: int
    """1..250, as in fleet.toml"""
    system_id: int
    """MAVLink system id, 1..255"""
    autopilot_port: int
    """UDP port it binds on 127.0.0.1"""
    companion_port: int
    """UDP port on 127.0.0.1 it sends to"""
    home_ned_m: Ned
    """true position at start, fleet frame"""
    ekf_origin_offset_m: Ned = NO_OFFSET
    """where its estimator's origin lies relative to home, fleet frame"""
    yaw_rad: float = 0.0
    """heading at start"""
    instance: int = 0
    """place in the fleet's file: its ground station's link and its viewer's port follow it"""
    booted_before_ns: int = 0
    """how much earlier than its host it booted: autopilots' streams are not in step with each other"""
    parameters: tuple[tuple[str, float | int], ...] = ()
    """PX4 parameters that differ from the default"""
    px4: str = OLDEST.name
    """which version it plays"""
    signing_key: bytes | None = None
    """by which it demands signed MAVLink"""


@dataclass(frozen=True, slots=True)
class StubFleetSettings:
    """All stand-in autopilots of one process."""

    vehicles: tuple[StubVehicleSettings, ...]
    fleet_origin: Geodetic
    dynamics: DynamicsParameters = field(default_factory=DynamicsParameters)
    gust: GustParameters = field(default_factory=GustParameters)
    noise: NoiseParameters = field(default_factory=NoiseParameters)
    seed: int = 0
    truth_path: Path | None = None
    """file of TRUTH_DTYPE records, appended to; None: not recorded"""
    stop_fd: int | None = None
    """a file descriptor whose end of file means that the launcher is gone; None: nobody to watch"""
    grace_s: float = 0.0
    """after a signal or the launcher's end the vehicles stay this long, so that a landing command still arrives"""
    ground: bool = False
    """whether the vehicles also speak to a ground station and PX4's viewer (`sim.autopilot.ground`)"""


def truth_record(vehicle_id: int, state: TruthState, time_unix_ns: int) -> bytes:
    """One record of TRUTH_DTYPE."""
    return _TRUTH_RECORD.pack(
        time_unix_ns,
        vehicle_id,
        state.armed,
        state.landed_state,
        state.custom_mode,
        *state.position_ned_m,
        *state.velocity_ned_m_s,
        state.setpoint_gap_max_s,
        math.nan,  # a point mass has no attitude rate to speak of
    )


class _TruthRecorder:
    """Appends every vehicle's true state at 50 Hz."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("ab")
        self._flushed_ns = 0

    def write(self, vehicles: list[tuple[int, Autopilot]], utc_offset_ns: int, now_ns: int) -> None:
        records = []
        for vehicle_id, autopilot in vehicles:
            state = autopilot.truth()
            records.append(truth_record(vehicle_id, state, state.time_ns + utc_offset_ns))
        # A full disk ends the record, not the flight.
        with suppress(OSError):
            self._file.write(b"".join(records))
            if now_ns - self._flushed_ns >= FLUSH_INTERVAL_NS:
                self._flushed_ns = now_ns
                self._file.flush()

    def close(self) -> None:
        with suppress(OSError):
            self._file.close()


class _Link:
    """One vehicle's socket."""

    def __init__(self, settings: StubVehicleSettings, autopilot: Autopilot) -> None:
        self.settings = settings
        self.autopilot = autopilot
        self.socket = _bind(settings)
        self.remote = ("127.0.0.1", settings.companion_port)
        self.ground: GroundLink | None = None

    def keep_up(self, now_ns: int) -> None:
        """After a stall the streams go on from the present; a backlog would take the time that is lacking already."""
        if now_ns - self.autopilot.next_deadline_ns() > STALL_NS:
            self.autopilot.skip(now_ns - RESUME_NS)

    def receive_all(self) -> None:
        self.keep_up(time.monotonic_ns())
        while True:
            try:
                datagram, sender = self.socket.recvfrom(65535)
            except BlockingIOError:
                return
            except ConnectionRefusedError:
                continue  # an earlier datagram found nobody listening
            if datagram.startswith(b"{"):
                self._carry_out(datagram, sender)
            else:
                self.autopilot.receive(datagram, time.monotonic_ns())

    def _carry_out(self, order: bytes, sender: tuple[str, int]) -> None:
        """A fault ordered from outside (`sim.launch.faults`): do it, and say so."""
        refused = None
        try:
            vehicle_id, fault = decode_order(order)
            if vehicle_id != self.settings.vehicle_id:
                raise ValueError(f"this is vehicle {self.settings.vehicle_id}, not {vehicle_id}")
            self.autopilot.inject(fault)
        except (ValueError, TypeError) as error:
            refused = str(error)
        with suppress(OSError):
            self.socket.sendto(json.dumps({"refused": refused}).encode(), sender)

    def send_all(self, now_ns: int) -> None:
        for datagram in self.autopilot.advance(now_ns):
            # A full buffer or nobody listening loses the datagram, as UDP may.
            with suppress(BlockingIOError, ConnectionRefusedError):
                self.socket.sendto(datagram, self.remote)
            if self.ground is not None:
                self.ground.answers(datagram)
        if self.ground is not None:
            self.ground.send_due(now_ns)


def _bind(settings: StubVehicleSettings) -> socket.socket:
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        link.setblocking(False)
        link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        link.bind(("127.0.0.1", settings.autopilot_port))
    except OSError as error:
        link.close()
        reason = "is in use" if error.errno == errno.EADDRINUSE else f"cannot be bound ({error.strerror})"
        raise CompanionError(
            f"vehicle {settings.vehicle_id}: UDP port {settings.autopilot_port} of its autopilot {reason}"
        ) from error
    return link


def build_autopilot(
    settings: StubFleetSettings, vehicle: StubVehicleSettings, boot_ns: int, utc_offset_ns: int
) -> Autopilot:
    """The stand-in of one vehicle as the settings describe it."""
    return Autopilot(
        system_id=vehicle.system_id,
        boot_ns=boot_ns - vehicle.booted_before_ns,
        utc_offset_ns=utc_offset_ns,
        fleet_origin=settings.fleet_origin,
        home_ned_m=vehicle.home_ned_m,
        ekf_origin_offset_m=vehicle.ekf_origin_offset_m,
        dynamics=settings.dynamics,
        gust=settings.gust,
        noise=settings.noise,
        parameters=dict(vehicle.parameters),
        px4=vehicle.px4,
        signing_key=vehicle.signing_key,
        yaw_rad=vehicle.yaw_rad,
        seed=settings.seed,
    )


@contextmanager
def _stop_pipe() -> Iterator[int]:
    """A file descriptor that becomes readable on SIGTERM or SIGINT; the handlers are put back afterwards."""
    if threading.current_thread() is not threading.main_thread():
        reader, writer = os.pipe()
        try:
            yield reader
        finally:
            os.close(reader)
            os.close(writer)
        return
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    previous = {
        number: signal.signal(number, lambda *_: os.write(writer, b"x")) for number in (signal.SIGTERM, signal.SIGINT)
    }
    try:
        yield reader
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
        os.close(reader)
        os.close(writer)


def run_stubs(settings: StubFleetSettings) -> None:
    """Runs the vehicles until SIGTERM, SIGINT or the end of `stop_fd`, and the grace after it.

    Raises CompanionError that names vehicle and port when a port is taken. A second signal ends the grace.
    """
    boot_ns = time.monotonic_ns()
    utc_offset_ns = time.time_ns() - time.monotonic_ns()
    links: list[_Link] = []
    recorder = None
    try:
        for vehicle in settings.vehicles:
            links.append(_Link(vehicle, build_autopilot(settings, vehicle, boot_ns, utc_offset_ns)))
        if settings.truth_path is not None:
            recorder = _TruthRecorder(settings.truth_path)
        with _stop_pipe() as signal_fd, selectors.DefaultSelector() as selector:
            selector.register(signal_fd, selectors.EVENT_READ, None)
            if settings.stop_fd is not None:
                selector.register(settings.stop_fd, selectors.EVENT_READ, None)
            for index, link in enumerate(links):
                selector.register(link.socket, selectors.EVENT_READ, index)
                if settings.ground:
                    link.ground = GroundLink(link.settings.instance, link.autopilot, settings.fleet_origin)
                    selector.register(link.ground.socket, selectors.EVENT_READ, index)
            _serve(settings, links, selector, recorder, boot_ns, utc_offset_ns)
    finally:
        for link in links:
            if refused := link.autopilot.signing.rejected:
                told = ", ".join(f"{count} {why}" for why, count in sorted(refused.items()))
                tell(f"vehicle {link.settings.vehicle_id}: frames not believed: {told}")
            link.socket.close()
            if link.ground is not None:
                link.ground.socket.close()
        if recorder is not None:
            recorder.close()


def _serve(
    settings: StubFleetSettings,
    links: list[_Link],
    selector: selectors.BaseSelector,
    recorder: _TruthRecorder | None,
    boot_ns: int,
    utc_offset_ns: int,
) -> None:
    vehicles = [(link.settings.vehicle_id, link.autopilot) for link in links]
    deadlines = [link.autopilot.next_deadline_ns() for link in links]
    truth_due_ns = boot_ns + TRUTH_INTERVAL_NS
    end_ns: int | None = None
    while True:
        now_ns = time.monotonic_ns()
        if end_ns is not None and now_ns >= end_ns:
            return
        wake_ns = min(*deadlines, truth_due_ns)
        if end_ns is not None:
            wake_ns = min(wake_ns, end_ns)
        for key, _ in selector.select(max(wake_ns - now_ns, 0) / 1e9):
            if key.data is not None:
                links[key.data].receive_all()
                if (ground := links[key.data].ground) is not None:
                    ground.receive_all(time.monotonic_ns())
                deadlines[key.data] = links[key.data].autopilot.next_deadline_ns()
            elif not os.read(key.fd, 4096) or key.fd != settings.stop_fd:
                if key.fd == settings.stop_fd:
                    selector.unregister(key.fd)
                grace_ns = round(settings.grace_s * 1e9)
                asked_again = end_ns is not None and key.fd != settings.stop_fd
                end_ns = time.monotonic_ns() + (0 if asked_again else grace_ns)
        now_ns = time.monotonic_ns()
        for index, link in enumerate(links):
            if now_ns >= deadlines[index]:
                link.keep_up(now_ns)
                link.send_all(now_ns)
                deadlines[index] = link.autopilot.next_deadline_ns()
        if now_ns >= truth_due_ns:
            if recorder is not None:
                for link in links:
                    link.send_all(now_ns)
                recorder.write(vehicles, utc_offset_ns, now_ns)
            late = (now_ns - truth_due_ns) // TRUTH_INTERVAL_NS
            truth_due_ns += (late + 1) * TRUTH_INTERVAL_NS


__all__ = [
    "TRUTH_DTYPE",
    "StubFleetSettings",
    "StubVehicleSettings",
    "build_autopilot",
    "run_stubs",
]
