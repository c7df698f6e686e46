"""A link to PX4 that is slow one way: what companions send waits, what PX4 sends does not."""

import select
import socket
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field

from companion.config import FleetConfig
from companion.config.endpoints import autopilot_port, companion_port, udp_endpoint

HOST = "127.0.0.1"


@dataclass(frozen=True, slots=True)
class _Way:
    """One vehicle's two sockets, and whom each speaks to."""

    to_px4: socket.socket
    """bound where PX4 sends to by its own scripts, so that its companion may listen elsewhere"""
    px4: tuple[str, int]
    to_companion: socket.socket
    companion: tuple[str, int]


@dataclass(slots=True)
class SlowLink:
    """Passes datagrams, in their order, those of companions `delay_s` after they came."""

    delay_s: float
    ways: Sequence[_Way]
    held_s: list[float] = field(default_factory=list)
    """how long each of the companions' datagrams was really held"""
    _waiting: deque[tuple[float, _Way, bytes]] = field(default_factory=deque)
    """came at (monotonic s), by which way, datagram"""

    def run(self, ended: threading.Event) -> None:
        from_px4 = {w.to_px4: w for w in self.ways}
        from_companion = {w.to_companion: w for w in self.ways}
        while not ended.is_set():
            left_s = self._waiting[0][0] + self.delay_s - time.monotonic() if self._waiting else 0.1
            for s in select.select([*from_px4, *from_companion], [], [], max(left_s, 0.0))[0]:
                for datagram in _datagrams(s):
                    if (way := from_px4.get(s)) is not None:
                        way.to_companion.sendto(datagram, way.companion)
                    else:
                        self._waiting.append((time.monotonic(), from_companion[s], datagram))
            while self._waiting and time.monotonic() >= self._waiting[0][0] + self.delay_s:
                came_s, way, datagram = self._waiting.popleft()
                way.to_px4.sendto(datagram, way.px4)
                self.held_s.append(time.monotonic() - came_s)


def _datagrams(s: socket.socket) -> Iterator[bytes]:
    """What waits; an answer that a port was closed is none."""
    while True:
        try:
            yield s.recv(2048)
        except BlockingIOError:
            return
        except ConnectionError:
            continue


@contextmanager
def slow_link(config: FleetConfig, delay_s: float) -> Iterator[SlowLink]:
    """Between PX4's own ports and those that the fleet's file names, which must be others."""
    with ExitStack() as stack:

        def bound(port: int) -> socket.socket:
            s = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            s.bind((HOST, port))
            s.setblocking(False)
            return s

        ways = []
        for v in config.vehicles:
            companion = udp_endpoint(v.mavlink)
            assert companion is not None
            assert companion[1] != companion_port(v.instance), "the companion listens where the relay must"
            ways.append(
                _Way(bound(companion_port(v.instance)), (HOST, autopilot_port(v.instance)), bound(0), companion)
            )
        link, ended = SlowLink(delay_s, ways), threading.Event()
        thread = threading.Thread(target=link.run, args=(ended,), name="slow link", daemon=True)
        thread.start()
        try:
            yield link
        finally:
            ended.set()
            thread.join()
