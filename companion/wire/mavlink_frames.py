"""MAVLink frames: where each begins and ends, its checksum, and the message inside. No I/O and no message's meaning.

    MAVLink 2   FD length flags flags sequence system component id id id  payload  checksum (2)  [signature (13)]
    MAVLink 1   FE length sequence system component id                    payload  checksum (2)

The checksum (CRC-16/MCRF4XX) covers all from the length on and, unsent, a byte of the message's own (CRC_EXTRA).
MAVLink 2 leaves out zeros at a payload's end. https://mavlink.io/en/guide/serialization.html
"""

import struct
from typing import NamedTuple

from fastcrc.crc16 import mcrf4xx

MARK_2, MARK_1 = 0xFD, 0xFE
HEAD_2, HEAD_1 = 10, 6
"""bytes before the payload"""
CHECKSUM_BYTES = 2
SIGNATURE_BYTES = 13
SIGNED = 1
"""the one incompatibility flag that there is; a frame with others must be dropped"""
_HEAD = struct.Struct("<BBBBBBBHB")
_CHECKSUM = struct.Struct("<H")


class Layout(NamedTuple):
    """How one message lies in a payload."""

    message_id: int
    extra: bytes
    """CRC_EXTRA"""
    fields: struct.Struct
    """in the wire's order: by falling size, extensions behind"""

    @property
    def key(self) -> bytes:
        """The message id as it lies in a MAVLink 2 frame."""
        return self.message_id.to_bytes(3, "little")

    def unpack(self, payload: bytes) -> tuple[object, ...]:
        """The fields' values: zeros that were left out are put back, what is beyond them is unknown extensions."""
        size = self.fields.size
        return self.fields.unpack(payload if len(payload) == size else payload[:size].ljust(size, b"\0"))

    def pack(self, values: tuple[object, ...], sequence: int, system_id: int, component_id: int) -> bytes:
        """One unsigned MAVLink 2 frame."""
        payload = self.fields.pack(*values).rstrip(b"\0") or b"\0"
        low, high = self.message_id & 0xFFFF, self.message_id >> 16
        frame = _HEAD.pack(MARK_2, len(payload), 0, 0, sequence, system_id, component_id, low, high) + payload
        return frame + _CHECKSUM.pack(mcrf4xx(frame[1:] + self.extra))


def is_one_frame(datagram: bytes) -> bool:
    """Whether a datagram is one unsigned MAVLink 2 frame and nothing else, by its head and length."""
    size = len(datagram)
    return size >= 12 and datagram[0] == MARK_2 and datagram[2] == 0 and size == 12 + datagram[1]


def checksum_fits(frame: bytes, end: int, extra: bytes) -> bool:
    """Whether the checksum behind a frame's payload, which ends at `end`, is right."""
    return mcrf4xx(frame[1:end] + extra) == frame[end] | frame[end + 1] << 8


def frame_length(buffer: bytes | bytearray, begin: int) -> int | None:
    """Length of the frame that begins there, as far as its head tells: 0 for none, None where the head is cut off."""
    if len(buffer) - begin < 3:
        return None
    match buffer[begin]:
        case 0xFD if buffer[begin + 2] <= SIGNED:
            return HEAD_2 + buffer[begin + 1] + CHECKSUM_BYTES + SIGNATURE_BYTES * buffer[begin + 2]
        case 0xFE:
            return HEAD_1 + buffer[begin + 1] + CHECKSUM_BYTES
    return 0


def frames_of(datagram: bytes) -> tuple[list[bytes], bool]:
    """The frames in a datagram, and whether it holds nothing else; what is cut off at its end does not go on in the
    next."""
    frames, clean, begin = [], bool(datagram), 0
    while begin < len(datagram):
        length = frame_length(datagram, begin)
        if length and begin + length <= len(datagram):
            frames.append(datagram[begin : begin + length])
            begin += length
        else:
            clean = False
            marks = (datagram.find(MARK_2, begin + 1), datagram.find(MARK_1, begin + 1))
            begin = min((m for m in marks if m >= 0), default=len(datagram))
    return frames, clean


class FrameSplitter:
    """Cuts a byte stream (a serial line) into frames, each as it would be a datagram; noise between them is dropped.

    A frame counts once it is whole and another, or nothing yet, follows it; its checksum is `MavlinkCodec`'s to check.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.dropped = 0
        """bytes that belonged to no frame"""

    def split(self, data: bytes) -> list[bytes]:
        """The frames that are whole by now; what has begun waits for the next bytes."""
        self._buffer += data
        buffer, begin = self._buffer, 0
        frames = []
        while (length := frame_length(buffer, begin)) is not None:
            end = begin + length
            if length == 0 or (end < len(buffer) and buffer[end] not in (MARK_2, MARK_1)):
                begin += 1
                self.dropped += 1
            elif end <= len(buffer):
                frames.append(bytes(buffer[begin:end]))
                begin = end
            else:
                break
        del buffer[:begin]
        return frames
