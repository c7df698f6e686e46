"""The link to the autopilot: a UDP socket with the kernel's time of reception.

MAVLink without signing says who speaks by a number that anybody may write. So the first address that has spoken as the
own autopilot is kept until it falls silent: nobody else is listened to or answered meanwhile.
"""

import errno
import socket
import struct

from companion.errors import CompanionError
from companion.io.clock import realtime_to_monotonic

SO_TIMESTAMPNS = 35
"""asm-generic/socket.h; Python's socket module does not name it"""
_TIMESPEC = struct.Struct("@qq")
ADDRESS_LIMIT_NS = 3_000_000_000
"""an autopilot's address silent for so long may be taken over by another"""
RECEIVE_MOST = 256
"""datagrams taken at a time, so that a flood cannot keep the loop from its setpoints"""

Address = tuple[str, int]


class UdpLink:
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
        self.strangers = 0
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
            stamp = next((body for level, kind, body in ancillary if kind == SO_TIMESTAMPNS), None)
            assert stamp is not None
            seconds, nanoseconds = _TIMESPEC.unpack(stamp[: _TIMESPEC.size])
            found.append((data, realtime_to_monotonic(seconds * 1_000_000_000 + nanoseconds), address))
        return found

    def admits(self, address: Address, received_ns: int) -> bool:
        """Whether a datagram from there may be the autopilot's; strangers are counted."""
        known = self._autopilot is not None and received_ns - self._heard_ns < ADDRESS_LIMIT_NS
        if known and address != self._autopilot:
            self.strangers += 1
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
