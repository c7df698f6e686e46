"""What systemd is told of this process (sd_notify): that it runs, that its control loop turns, that it ends.

The protocol is a datagram of `NAME=VALUE` lines to the socket that NOTIFY_SOCKET names; without that variable nothing
is sent. No library: those there are wrap these lines, or need systemd's headers to build.
"""

import os
import socket
from collections.abc import Mapping
from contextlib import suppress


class Notifier:
    """Tells the service manager, if there is one; never blocks and never raises for it."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        name = environment.get("NOTIFY_SOCKET", "")
        # "@" stands for the zero byte of Linux' abstract names.
        self._address = "\0" + name[1:] if name.startswith("@") else name
        self._socket: socket.socket | None = None
        if name.startswith(("/", "@")):
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)
        period = environment.get("WATCHDOG_USEC", "")
        meant = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        limit_ns = int(period) * 1000 if period.isdecimal() and meant else 0
        self._period_ns = limit_ns // 3
        """how often the watchdog is fed: twice may be lost"""
        self._next_ns = 0

    def ready(self) -> None:
        """The loop runs."""
        self._send("READY=1")

    def loop_turned(self, now_ns: int) -> None:
        """The agent was advanced and what it wants was sent; to be called from there and nowhere else."""
        if self._period_ns > 0 and now_ns >= self._next_ns:
            self._next_ns = now_ns + self._period_ns
            self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """The process is about to end."""
        self._send("STOPPING=1")

    def _send(self, text: str) -> None:
        if self._socket is not None:
            with suppress(OSError):
                self._socket.sendto(text.encode(), self._address)

    def close(self) -> None:
        """Release the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
