"""Signed MAVLink as PX4 has it since v1.18: what it believes, what it signs, how it is given a key. Sans-I/O."""

import os
from typing import Any

os.environ["MAVLINK20"] = "1"
from pymavlink.dialects.v20 import development as mavlink

from companion.wire.mavlink_frames import MARK_2, frames_of
from companion.wire.signing import ALLOWED_UNSIGNED, SigningClock, Verifier, signed
from sim.autopilot.events import EVENT_CRC_EXTRA

BLANK = bytes(32)


class Signing:
    """A stub's keys. PX4's time of signing does not follow wall time: it counts on from its key's, or what it heard."""

    def __init__(self, key: bytes | None, ticks: int = 0) -> None:
        self._key: bytes | None = None
        self.rejected: dict[str, int] = {}
        """frames that were not believed, by reason"""
        if key is not None:
            self._take(key, ticks)

    @property
    def active(self) -> bool:
        """Whether signatures are demanded and made."""
        return self._key is not None

    def _take(self, key: bytes, ticks: int) -> None:
        self._key = key
        self._clock = SigningClock(lambda: 0, ticks)
        self._verifier = Verifier(key, self._clock)

    def admitted(self, datagram: bytes) -> bytes:
        """What of a datagram is believed."""
        if self._key is None:
            return datagram
        return b"".join(frame for frame in frames_of(datagram)[0] if self._admits(frame))

    def _admits(self, frame: bytes) -> bool:
        why = self._verifier.judge(frame)
        if why is None:
            return True
        message_id = int.from_bytes(frame[7:10], "little") if frame[0] == MARK_2 else frame[5]
        if message_id in ALLOWED_UNSIGNED:
            return True
        self.rejected[why.value] = self.rejected.get(why.value, 0) + 1
        return False

    def set_up(self, message: Any, armed: bool) -> str:
        """SETUP_SIGNING that was believed; why it is not taken: never while armed, nor a blank one unsigned."""
        key, ticks = bytes(message.secret_key), message.initial_timestamp
        if armed:
            return "signing while armed"
        if key == BLANK and ticks == 0:
            if self._key is not None and not message.get_header().incompat_flags & 1:
                return "blank key unsigned"
            self._key = None
            return ""
        self._take(key, ticks)
        return ""

    def sign(self, packet: bytes, link_id: int) -> bytes:
        """A packed frame as it leaves on a link."""
        if self._key is None:
            return packet
        kind = mavlink.mavlink_map.get(int.from_bytes(packet[7:10], "little"))
        extra = bytes((EVENT_CRC_EXTRA,)) if kind is None else bytes((kind.crc_extra,))
        return signed(self._key, packet, extra, link_id, self._clock.next())
