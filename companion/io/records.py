"""Bodies of recorded entries: what the loop itself records (each tick's figures, the traffic), and peers' messages."""

import struct
from typing import NamedTuple, Self

TICK = struct.Struct("<qqqff?6f")
TRAFFIC = struct.Struct("<qq")


class TickRecord(NamedTuple):
    """Body of the "tick" channel. Positions and velocities are the vehicle's own belief, fleet frame (NED)."""

    lateness_ns: int
    """how long after its deadline, or after the position that it follows from, the setpoint was sent"""
    latency_ns: int
    """sensor to setpoint; -1 for a timer's tick"""
    cpu_ns: int
    """of the loop's thread so far"""
    position_error_m: float
    nearest_m: float
    """to the nearest neighbour"""
    steered: bool
    """whether a setpoint was sent"""
    north_m: float
    east_m: float
    down_m: float
    north_m_s: float
    east_m_s: float
    down_m_s: float

    def pack(self) -> bytes:
        """As recorded."""
        return TICK.pack(*self)

    @classmethod
    def unpack(cls, body: bytes) -> Self:
        """From a recording; struct.error if it is none."""
        return cls(*TICK.unpack(body))


class TrafficRecord(NamedTuple):
    """Body of the "traffic" channel, each second."""

    packets_sent: int
    """by this companion's network connections so far"""
    bytes_sent: int
    """the same, headers included"""

    def pack(self) -> bytes:
        """As recorded."""
        return TRAFFIC.pack(*self)

    @classmethod
    def unpack(cls, body: bytes) -> Self:
        """From a recording; struct.error if it is none."""
        return cls(*TRAFFIC.unpack(body))


def peer_body(name: str, payload: bytes) -> bytes:
    """Body of the "input/peer" channel (`name`: the key) and of "output/peer" (its topic)."""
    return name.encode() + b"\0" + payload


def split_peer_body(body: bytes) -> tuple[str, bytes]:
    """Name and payload from a recording; UnicodeDecodeError if it is none."""
    name, _, payload = body.partition(b"\0")
    return name.decode(), payload
