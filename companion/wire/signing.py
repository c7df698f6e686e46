"""MAVLink 2 message signing: a frame's signature made, and looked at. Pure; https://mavlink.io/en/guide/message_signing.html

    frame = head (10)  payload  checksum (2)  link id (1)  time stamp (6)  signature (6)

The signature is the first six bytes of SHA-256 over key, head, payload, checksum, link id and time stamp. Times count
10 us since 2015. A signature is verified before anything is learned from its time stamp: pymavlink 2.4 learns first, so
that one forged frame from the future shuts out the genuine stream.
"""

import struct
from collections.abc import Callable
from enum import StrEnum
from hashlib import sha256
from hmac import compare_digest

from fastcrc.crc16 import mcrf4xx

from companion.wire.mavlink_frames import CHECKSUM_BYTES, HEAD_2, MARK_2, SIGNATURE_BYTES, SIGNED, Layout

KEY_BYTES = 32
STAMPED_BYTES = 7
"""link id and time stamp"""
EPOCH_UNIX_NS = 1_420_070_400_000_000_000
"""2015-01-01"""
TICK_NS = 10_000
TICKS_PER_S = 100_000
NEW_STREAM_LIMIT_S = 60
"""a stream that was not heard before may begin so much behind our time (MAVLINK_SIGNING_TIMESTAMP_LIMIT)"""
AHEAD_LIMIT_S = 60
"""a companion believes no frame that is dated farther ahead: preflight holds clocks to seconds"""
STREAMS_MOST = 16
"""systems and links that one end listens to, as PX4's MAVLINK_MAX_SIGNING_STREAMS"""
ALLOWED_UNSIGNED = frozenset({0, 109, 246, 247})
"""HEARTBEAT, RADIO_STATUS, ADSB_VEHICLE and COLLISION: what PX4 takes from anybody"""


class Refused(StrEnum):
    """Why a frame is not believed."""

    UNSIGNED = "unsigned"
    WRONG_SIGNATURE = "wrong signature"
    REPLAYED = "replayed"
    """not newer than the last of its stream"""
    TOO_OLD = "signed too long ago"
    """the first of a stream"""
    AHEAD = "dated ahead"
    STREAMS = "too many streams"


def ticks_at(unix_ns: int) -> int:
    """A time stamp's number at a time (UTC)."""
    return max(unix_ns - EPOCH_UNIX_NS, 0) // TICK_NS


class SigningClock:
    """The time that one end signs by: wall time, never the same twice, never back, never behind what it believed."""

    def __init__(self, wall_ns: Callable[[], int], not_before: int = 0) -> None:
        self._wall_ns = wall_ns
        self.last = not_before
        """the last number given, or heard from whom it believes"""

    def now(self) -> int:
        """The present number, which nobody need have been given."""
        return max(self.last, ticks_at(self._wall_ns()))

    def next(self) -> int:
        """A number of its own for one frame."""
        self.last = max(self.last + 1, ticks_at(self._wall_ns()))
        return self.last

    def heard(self, ticks: int) -> None:
        """A frame that is believed carries this number: ours are later."""
        self.last = max(self.last, ticks)


def signature(key: bytes, stamped: bytes) -> bytes:
    """Six bytes for a frame up to its time stamp."""
    return sha256(key + stamped).digest()[:6]


def signed(key: bytes, frame: bytes, extra: bytes, link_id: int, ticks: int) -> bytes:
    """An unsigned MAVLink 2 frame, signed; `extra`: CRC_EXTRA of its message, since the head changes."""
    head = frame[:2] + bytes((SIGNED,)) + frame[3:-CHECKSUM_BYTES]
    checksum = mcrf4xx(head[1:] + extra)
    stamped = head + struct.pack("<HB", checksum, link_id) + ticks.to_bytes(6, "little")
    return stamped + signature(key, stamped)


class Verifier:
    """What one end believes of what it hears."""

    def __init__(self, key: bytes, clock: SigningClock, ahead_limit_s: float | None = None) -> None:
        """`ahead_limit_s`: frames dated farther ahead are refused; None: none is, as PX4 does."""
        self._key = key
        self._clock = clock
        self._ahead = None if ahead_limit_s is None else round(ahead_limit_s * TICKS_PER_S)
        self._last: dict[bytes, int] = {}
        """stream -> time stamp of its last frame"""

    def judge(self, frame: bytes) -> Refused | None:
        """Whether one whole frame is believed (None), or why not; its checksum is looked at elsewhere."""
        if not (frame[0] == MARK_2 and frame[2] & SIGNED and len(frame) > HEAD_2 + SIGNATURE_BYTES):
            return Refused.UNSIGNED
        if not compare_digest(signature(self._key, frame[:-6]), frame[-6:]):
            return Refused.WRONG_SIGNATURE
        ticks = int.from_bytes(frame[-12:-6], "little")
        stream = frame[5:7] + frame[-13:-12]
        last = self._last.get(stream)
        if last is None:
            if len(self._last) >= STREAMS_MOST:
                return Refused.STREAMS
            if ticks + NEW_STREAM_LIMIT_S * TICKS_PER_S < self._clock.now():
                return Refused.TOO_OLD
        elif ticks <= last:
            return Refused.REPLAYED
        if self._ahead is not None and ticks > self._clock.now() + self._ahead:
            return Refused.AHEAD
        self._last[stream] = ticks
        self._clock.heard(ticks)
        return None


def extras_of(*layouts: Layout) -> dict[bytes, bytes]:
    """Message id as it lies in a frame -> CRC_EXTRA."""
    return {layout.key: layout.extra for layout in layouts}
