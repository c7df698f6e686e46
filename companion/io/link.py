"""The link to the autopilot: a UDP socket with the kernel's time of reception, or a serial line.

MAVLink without signing says who speaks by a number that anybody may write. So the first address that has spoken as the
own autopilot is kept until it falls silent: nobody else is listened to or answered meanwhile.
"""

import errno
import fcntl
import os
import socket
import struct
import termios
import time
from collections.abc import Mapping
from types import MappingProxyType
from typing import Protocol

from companion.config.derived import Vehicle
from companion.config.endpoints import serial_endpoint, udp_endpoint
from companion.errors import CompanionError
from companion.io.clock import realtime_to_monotonic
from companion.wire.mavlink_frames import FrameSplitter

SO_TIMESTAMPNS = 35
"""asm-generic/socket.h; Python's socket module does not name it"""
_TIMESPEC = struct.Struct("@qq")
ADDRESS_LIMIT_NS = 3_000_000_000
"""an autopilot's address silent for so long may be taken over by another"""
RECEIVE_MOST = 256
"""datagrams taken at a time, so that a flood cannot keep the loop from its setpoints"""

REOPEN_INTERVAL_NS = 1_000_000_000
SERIAL_READ_MOST = 4096
SERIAL_UNSENT_MOST = 1024
"""bytes that may wait for a slow line: about 15 setpoints, a third of a second of them"""

Address = tuple[str, int]


def received_unix_ns(ancillary: list[tuple[int, int, bytes]]) -> int:
    """When the kernel got a datagram (UTC, ns), from what recvmsg tells on a socket with SO_TIMESTAMPNS."""
    stamp = next(body for _, kind, body in ancillary if kind == SO_TIMESTAMPNS)
    seconds, nanoseconds = _TIMESPEC.unpack(stamp[: _TIMESPEC.size])
    return int(seconds * 1_000_000_000 + nanoseconds)


class Link(Protocol):
    """What the loop needs of a link."""

    @property
    def foreign_datagrams(self) -> int:
        """Datagrams from elsewhere while the autopilot's address was known."""

    @property
    def send_failures(self) -> int:
        """What could not be sent."""

    @property
    def refused(self) -> Mapping[str, int]:
        """Frames that were not believed, by reason: of a link that is signed."""

    @property
    def fault(self) -> str:
        """What an operator should know of it; mostly empty."""

    def fileno(self) -> int:
        """For select."""

    def receive(self) -> list[tuple[bytes, int, Address]]:
        """The frames waiting, with the time at which each came (monotonic ns) and where from."""

    def admits(self, address: Address, received_ns: int) -> bool:
        """Whether what came from there may be the autopilot's."""

    def confirm(self, address: Address, received_ns: int) -> None:
        """An admitted frame from there was the own autopilot's heartbeat or position."""

    def send(self, datagram: bytes) -> None:
        """Send to the autopilot."""

    def close(self) -> None:
        """Release the port."""


def open_bare_link(vehicle: Vehicle) -> Link:
    """The link of a vehicle's `mavlink` URL; CompanionError names the vehicle when it cannot be opened."""
    udp, serial = udp_endpoint(vehicle.mavlink), serial_endpoint(vehicle.mavlink)
    try:
        if udp is not None:
            return UdpLink(*udp)
        assert serial is not None  # the configuration admits no third kind
        return SerialLink(*serial)
    except CompanionError as error:
        raise CompanionError(f"vehicle {vehicle.id}: {error}") from error


class _Bare:
    """What links have that sign nothing."""

    refused: Mapping[str, int] = MappingProxyType({})
    fault = ""


class UdpLink(_Bare):
    """Bound to the companion's port; speaks with the one address that has proved to be the autopilot's."""

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._socket.setblocking(False)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            why = "it is in use" if error.errno == errno.EADDRINUSE else error.strerror
            raise CompanionError(f"cannot listen on UDP {host}:{port}: {why}") from error
        self._autopilot: Address | None = None
        self._heard_ns = 0
        self.foreign_datagrams = 0
        """datagrams from elsewhere while the autopilot's address was known"""
        self.send_failures = 0

    def fileno(self) -> int:
        """For select."""
        return self._socket.fileno()

    def receive(self) -> list[tuple[bytes, int, Address]]:
        """The datagrams waiting, with the time at which the kernel got each (monotonic ns) and where it came from."""
        found: list[tuple[bytes, int, Address]] = []
        for _ in range(RECEIVE_MOST):
            try:
                data, ancillary, _, address = self._socket.recvmsg(2048, 64)
            except BlockingIOError:
                break
            except ConnectionError:
                continue  # the autopilot's port was closed when we last sent
            found.append((data, realtime_to_monotonic(received_unix_ns(ancillary)), address))
        return found

    def admits(self, address: Address, received_ns: int) -> bool:
        """Whether a datagram from there may be the autopilot's; strangers are counted."""
        known = self._autopilot is not None and received_ns - self._heard_ns < ADDRESS_LIMIT_NS
        if known and address != self._autopilot:
            self.foreign_datagrams += 1
            return False
        return True

    def confirm(self, address: Address, received_ns: int) -> None:
        """An admitted datagram from there was the own autopilot's heartbeat or position."""
        self._autopilot = address
        self._heard_ns = received_ns

    def send(self, datagram: bytes) -> None:
        """Send to the autopilot; before it has spoken there is nobody to send to."""
        if self._autopilot is None:
            return
        try:
            self._socket.sendto(datagram, self._autopilot)
        except OSError:
            self.send_failures += 1

    def close(self) -> None:
        """Release the port."""
        self._socket.close()


class SerialLink(_Bare):
    """A serial line, raw, eight bits and no parity. One that is pulled out is opened anew when it is there again.

    It has one owner: two that read it would each hear a part of what is said. The lock ends with the process, as
    TIOCEXCL would not while anybody else holds the line open.
    Bytes carry no time of reception, so a frame's is when it was read; whoever is at the other end of the wire is the
    autopilot.
    """

    def __init__(self, device: str, baud: int) -> None:
        self.device = device
        speed = getattr(termios, f"B{baud}", None)
        if speed is None:
            known = sorted(int(n[1:]) for n in dir(termios) if n[:1] == "B" and n[1:].isdigit() and n != "B0")
            raise CompanionError(f"serial line {device}: {baud} baud is not one of {', '.join(map(str, known))}")
        self._speed: int = speed
        self.foreign_datagrams = 0
        self.send_failures = 0
        """frames not sent: the line was gone, or slower than what was to be sent"""
        self._unsent = b""
        self._splitter = FrameSplitter()
        self._reopen_ns = 0
        # While the line is gone, select waits on something that never has anything to say.
        self._nothing, self._never = os.pipe()
        try:
            self._fd: int | None = self._open()
        except (OSError, termios.error) as error:
            os.close(self._nothing)
            os.close(self._never)
            raise CompanionError(f"cannot open serial line {device}: {error.args[-1]}") from error

    def _open(self) -> int:
        fd = os.open(self.device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            self._own(fd)
            control = termios.tcgetattr(fd)[6]
            control[termios.VMIN], control[termios.VTIME] = 1, 0
            flags = termios.CS8 | termios.CREAD | termios.CLOCAL
            termios.tcsetattr(fd, termios.TCSANOW, [0, 0, flags, 0, self._speed, self._speed, control])
            termios.tcflush(fd, termios.TCIOFLUSH)
        except (OSError, termios.error):
            os.close(fd)
            raise
        return fd

    @staticmethod
    def _own(fd: int) -> None:
        """Before the line is touched: its owner is listening."""
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise OSError(errno.EBUSY, "another process has it") from error

    def fileno(self) -> int:
        """For select."""
        return self._nothing if self._fd is None else self._fd

    def receive(self) -> list[tuple[bytes, int, Address]]:
        """The frames that are whole by now."""
        if self._fd is None:
            return []
        try:
            data = os.read(self._fd, SERIAL_READ_MOST)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if not data:
            self._lose()
            return []
        now_ns = time.monotonic_ns()
        return [(frame, now_ns, (self.device, 0)) for frame in self._splitter.split(data)]

    def admits(self, address: Address, received_ns: int) -> bool:  # noqa: ARG002
        """A line has one other end."""
        return True

    def confirm(self, address: Address, received_ns: int) -> None:
        """A line has one other end."""

    def send(self, datagram: bytes) -> None:
        """Send all of it, what is left over before the next; a frame for which there is no room is dropped whole."""
        if self._fd is None and not self._reopened():
            self.send_failures += 1
            return
        if len(self._unsent) > SERIAL_UNSENT_MOST:
            self.send_failures += 1
        else:
            self._unsent += datagram
        assert self._fd is not None
        try:
            self._unsent = self._unsent[os.write(self._fd, self._unsent) :]
        except BlockingIOError:
            return
        except OSError:
            self.send_failures += 1
            self._lose()

    def _lose(self) -> None:
        if self._fd is not None:
            os.close(self._fd)
        self._fd = None
        self._unsent = b""
        self._splitter = FrameSplitter()
        self._reopen_ns = time.monotonic_ns() + REOPEN_INTERVAL_NS

    def _reopened(self) -> bool:
        now_ns = time.monotonic_ns()
        if now_ns < self._reopen_ns:
            return False
        try:
            self._fd = self._open()
        except (OSError, termios.error):
            self._reopen_ns = now_ns + REOPEN_INTERVAL_NS
            return False
        return True

    def close(self) -> None:
        """Release the line."""
        for fd in (self._fd, self._nothing, self._never):
            if fd is not None:
                os.close(fd)
        self._fd = None
