"""What passes a vehicle's MAVLink link passes here, or is lost: between a PX4 in SITL and its companion."""

import socket
from collections.abc import Iterator

HOST = "127.0.0.1"


class LinkRelay:
    """PX4 speaks to `px4`, a socket of a port of its own; the companion hears from `companion` and answers it."""

    def __init__(self, autopilot_port: int, companion_port: int) -> None:
        self.cut = False
        """whatever comes is lost, either way"""
        self.px4, self.companion = _bound(), _bound()
        self.port: int = self.px4.getsockname()[1]
        """where PX4 is to send to"""
        self._to_px4, self._to_companion = (HOST, autopilot_port), (HOST, companion_port)

    @property
    def sockets(self) -> tuple[socket.socket, socket.socket]:
        """To be watched; whichever has something is handed to `serve`."""
        return self.px4, self.companion

    def serve(self, ready: socket.socket) -> None:
        """Pass on all that waits at one end."""
        other, to = (self.companion, self._to_companion) if ready is self.px4 else (self.px4, self._to_px4)
        for datagram in _datagrams(ready):
            if not self.cut:
                other.sendto(datagram, to)

    def close(self) -> None:
        """Nothing passes any more."""
        self.px4.close()
        self.companion.close()


def _bound() -> socket.socket:
    s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    s.bind((HOST, 0))
    s.setblocking(False)
    return s


def _datagrams(s: socket.socket) -> Iterator[bytes]:
    """What waits; word that a port is nobody's is none."""
    while True:
        try:
            yield s.recv(2048)
        except BlockingIOError:
            return
        except ConnectionError:
            continue
