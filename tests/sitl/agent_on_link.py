"""One agent in this process, on a real autopilot's UDP link: a test sees what the autopilot says as it comes."""

import select
import socket
import time
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import development as dialect

from companion.config import FleetConfig
from companion.core.values import Instant
from companion.vehicle.agent import Agent


class AgentOnLink:
    """A vehicle's agent, driven in real time over its link."""

    def __init__(self, config: FleetConfig, companion_port: int, autopilot_port: int) -> None:
        self.agent = Agent(config, config.vehicles[0].id, boot_id=1)
        self.notes: list[str] = []
        self._to = ("127.0.0.1", autopilot_port)
        self._parser: Any = dialect.MAVLink(None)
        self._parser.robust_parsing = True
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", companion_port))
        self._socket.setblocking(False)

    def close(self) -> None:
        self._socket.close()

    @property
    def now(self) -> Instant:
        return Instant(time.monotonic_ns(), time.time_ns())

    def run(self, seconds: float, until: Callable[[Any], bool] = lambda _: False) -> bool:
        """Let it fly for so long, or until a message of the autopilot's is as wanted; whether one was."""
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            due_s = (self.agent.next_deadline_ns() - time.monotonic_ns()) * 1e-9
            found = False
            if select.select([self._socket], [], [], min(max(due_s, 0.0), left_s))[0]:
                datagram = self._socket.recv(65535)
                self.agent.receive_mavlink(datagram, self.now)
                found = any(until(m) for m in self._parser.parse_buffer(bytearray(datagram)) or ())
            if self.agent.next_deadline_ns() <= time.monotonic_ns():
                out = self.agent.advance(self.now)
                self.notes += out.notes
                for datagram in out.mavlink:
                    self._socket.sendto(datagram, self._to)
            if found:
                return True
        return False

    def run_while(self, condition: Callable[[], bool], at_most_s: float) -> None:
        end_s = time.monotonic() + at_most_s
        while condition():
            assert time.monotonic() < end_s, (self.agent.operator.unready(self.now), self.notes)
            self.run(0.05)
