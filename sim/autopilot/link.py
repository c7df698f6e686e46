"""What leaves the stand-in PX4, and when: sequence numbers, stream intervals, a slow or mute link. Sans-I/O."""

import math
import os
import struct
from collections import deque
from typing import Any

os.environ["MAVLINK20"] = "1"
from pymavlink.dialects.v20 import development as mavlink

from sim.autopilot.packing import Fields, frame, packed
from sim.autopilot.streams import ON_REQUEST, STREAMS
from sim.autopilot.telemetry import Telemetry

FIRST_MESSAGE_NS = 1_600_000_000
"""first HEARTBEAT after boot, as measured"""
SLOW_LINK_BUFFER_NS = 500_000_000
"""a slow link holds this much; what does not fit is dropped"""
COMPONENT_ID = 1
"""MAV_COMP_ID_AUTOPILOT1"""


class Link:
    """Packs messages, one a datagram, and hands them out in order."""

    def __init__(self, system_id: int) -> None:
        self.mav = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=COMPONENT_ID)
        self.mav.robust_parsing = True
        self.now_ns = 0
        """time since boot, kept by the autopilot"""
        self.muted = False
        self.deaf = False
        """what arrives is lost"""
        self.bytes_per_s = math.inf
        self._waiting: deque[tuple[int, bytes]] = deque()
        self._free_ns = 0

    def send(self, message: Any) -> None:
        """Packs one message; it leaves at the next `take`, or later where the link is slow."""
        fields = type(message) is Fields
        self._enqueue(frame(message.kind, message.values, self.mav) if fields else packed(message, self.mav))

    def send_payload(self, message_id: int, crc_extra: int, payload: bytes) -> None:
        """The same for a message that pymavlink does not know."""
        payload = payload.rstrip(b"\0") or b"\0"
        header = struct.pack("<BBBBBB", len(payload), 0, 0, self.mav.seq, self.mav.srcSystem, self.mav.srcComponent)
        body = header + message_id.to_bytes(3, "little") + payload
        checksum = mavlink.x25crc(body + bytes([crc_extra])).crc
        self._enqueue(b"\xfd" + body + struct.pack("<H", checksum))

    def _enqueue(self, packet: bytes) -> None:
        self.mav.seq = (self.mav.seq + 1) & 0xFF
        if self.muted:
            return
        leaves_ns = self.now_ns
        if self.bytes_per_s < math.inf:
            self._free_ns = max(self._free_ns, self.now_ns)
            if self._free_ns - self.now_ns > SLOW_LINK_BUFFER_NS:
                return
            self._free_ns += round(len(packet) / self.bytes_per_s * 1e9)
            leaves_ns = self._free_ns
        elif self._waiting:
            leaves_ns = max(leaves_ns, self._waiting[-1][0])
        self._waiting.append((leaves_ns, packet))

    def take(self) -> list[bytes]:
        """What leaves by now."""
        sent = []
        while self._waiting and self._waiting[0][0] <= self.now_ns:
            sent.append(self._waiting.popleft()[1])
        return sent

    def next_departure_ns(self) -> int | None:
        """When the first waiting packet leaves."""
        return self._waiting[0][0] if self._waiting else None

    def put_back(self, packets: list[bytes]) -> None:
        """Lets packets of before a restart leave first."""
        self._waiting.extendleft((0, packet) for packet in reversed(packets))

    def forget(self) -> None:
        """Drops what waits."""
        self._waiting.clear()


class StreamSchedule:
    """Intervals of the streams and when each is due next; all in nanoseconds since boot."""

    def __init__(self, link: Link, telemetry: Telemetry) -> None:
        self._link = link
        self._telemetry = telemetry
        self._intervals_ns = {message: round(1e9 / rate) for message, (rate, _) in STREAMS.items()}
        self._due_ns = dict.fromkeys(STREAMS, FIRST_MESSAGE_NS)
        self.next_due_ns = FIRST_MESSAGE_NS
        self.muted = False
        """what falls due is left out"""

    def send_due(self, now_ns: int) -> None:
        """Sends what is due."""
        next_due_ns = now_ns + 1_000_000_000
        for message_id, due_ns in self._due_ns.items():
            again_ns = due_ns
            if due_ns <= now_ns:
                message = None if self.muted else STREAMS[message_id][1](self._telemetry)
                if message is not None:
                    self._link.send(message)
                # A stream asked to be faster than the grid comes once a step.
                again_ns = max(due_ns + self._intervals_ns[message_id], now_ns + 1)
                self._due_ns[message_id] = again_ns
            next_due_ns = min(next_due_ns, again_ns)
        self.next_due_ns = next_due_ns

    def send_one(self, message_id: int) -> bool:
        """Sends one message of a kind at once; False: not available."""
        if message_id in STREAMS:
            message = STREAMS[message_id][1](self._telemetry)
        elif message_id in ON_REQUEST:
            message = ON_REQUEST[message_id](self._telemetry)
        else:
            return False
        if message is None:
            return False
        self._link.send(message)
        return True

    def set_interval_us(self, message_id: int, interval_us: float, now_ns: int) -> bool:
        """SET_MESSAGE_INTERVAL: -1 switches a stream off, 0 restores its default; False: no such stream."""
        if message_id not in STREAMS or not math.isfinite(interval_us):
            return False
        if interval_us < 0.0:
            self._due_ns.pop(message_id, None)
            self._intervals_ns.pop(message_id, None)
            return True
        default_ns = round(1e9 / STREAMS[message_id][0])
        self._intervals_ns[message_id] = default_ns if interval_us == 0.0 else round(interval_us * 1000.0)
        self._due_ns[message_id] = max(now_ns + 1, FIRST_MESSAGE_NS)
        self.next_due_ns = min(self.next_due_ns, self._due_ns[message_id])
        return True

    def interval_us(self, message_id: int) -> int:
        """A stream's interval; -1 off, 0 not available."""
        if message_id not in STREAMS:
            return 0
        return self._intervals_ns[message_id] // 1000 if message_id in self._intervals_ns else -1
