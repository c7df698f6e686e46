"""The link to the autopilot: a UDP socket with the kernel's time of reception."""

import errno
import socket
import struct

from companion.errors import CompanionError
from companion.io.clock import realtime_to_monotonic

SO_TIMESTAMPNS = 35
"""asm-generic/socket.h; Python's socket module does not name it"""
_TIMESPEC = struct.Struct("@qq")


class UdpLink:
    """Bound to the companion's port; sends to wherever the autopilot last spoke from."""

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
        self._autopilot: tuple[str, int] | None = None
        self.send_failures = 0

    def fileno(self) -> int:
        """For select."""
        return self._socket.fileno()

    def receive(self) -> list[tuple[bytes, int]]:
        """Every datagram waiting, with the time at which the kernel got it (monotonic ns)."""
        found: list[tuple[bytes, int]] = []
        while True:
            try:
                data, ancillary, _, address = self._socket.recvmsg(2048, 64)
            except BlockingIOError:
                return found
            except ConnectionError:
                continue  # the autopilot's port was closed when we last sent
            self._autopilot = address
            stamp = next((body for level, kind, body in ancillary if kind == SO_TIMESTAMPNS), None)
            assert stamp is not None
            seconds, nanoseconds = _TIMESPEC.unpack(stamp[: _TIMESPEC.size])
            found.append((data, realtime_to_monotonic(seconds * 1_000_000_000 + nanoseconds)))

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
