"""The form of a recording, as bytes: which MCAP records it has, and how each is packed.

One entry is one MCAP message:

    channel        topic; by convention `input/...`, `output/...`, `advance`, and notes of the loop such as `tick`
    log_time       fleet_ns of the entry's Instant (ns since 1970)
    publish_time   monotonic_ns of the entry's Instant (ns); both times are two's complement, so that any int64 returns
    sequence       counts every call of `record` modulo 2^32, lost ones too: a gap is a loss, however the process ended
    data           the body, verbatim: a MAVLink frame, a peer's payload behind its key, ...

What the agent was made from (configuration, vehicle id, boot id, versions, seed) is the metadata record `recording`
ahead of the first message. Order is the order in the file; times may be equal and are not what a reader sorts by.

The layouts are those of the MCAP specification (mcap.dev/spec): little-endian; a record is its opcode (one byte), the
length of its content (eight) and the content; texts and maps have their length in bytes (four) before them. The `mcap`
package writes the same bytes, and asks for two compressors of 29 MB to do so: what reads recordings uses it, what flies
does not.
"""

import struct
from collections.abc import Mapping
from typing import Final

MAGIC: Final = b"\x89MCAP0\r\n"
"""at both ends of a file"""
METADATA: Final = "recording"
"""name of the metadata that say what the agent was made from"""
LOSS: Final = "loss"
"""name of the metadata that say how many entries were lost"""
SEQUENCE_MASK: Final = 0xFFFF_FFFF

_HEADER: Final = 0x01
_FOOTER: Final = 0x02
_CHANNEL: Final = 0x04
MESSAGE_OPCODE: Final = 0x05
_STATISTICS: Final = 0x0B
_METADATA: Final = 0x0C
_METADATA_INDEX: Final = 0x0D
_DATA_END: Final = 0x0F

RECORD_HEAD: Final = struct.Struct("<BQ")
"""opcode, length of what follows"""
MESSAGE_FIELDS: Final = struct.Struct("<HIqq")
"""channel, sequence, log_time, publish_time; then the body"""
MESSAGE_HEAD: Final = struct.Struct("<BQHIqq")
"""both: what stands before a message's body"""
_LENGTH: Final = struct.Struct("<I")
_CHANNEL_IDS: Final = struct.Struct("<HH")
_COUNTS: Final = struct.Struct("<QHIIIIQQ")
_COUNT: Final = struct.Struct("<HQ")
_PLACE: Final = struct.Struct("<QQ")
_FOOTER_FIELDS: Final = struct.Struct("<QQI")
_CHECKSUM: Final = struct.Struct("<I")


def header(profile: str, library: str) -> bytes:
    """The first record: which conventions the file follows, and what wrote it."""
    return _record(_HEADER, _text(profile) + _text(library))


def channel(number: int, topic: str, encoding: str) -> bytes:
    """A channel, ahead of its first message; without schema and metadata."""
    return _record(_CHANNEL, _CHANNEL_IDS.pack(number, 0) + _text(topic) + _text(encoding) + _map({}))


def metadata(name: str, values: Mapping[str, str]) -> bytes:
    """Named texts."""
    return _record(_METADATA, _text(name) + _map(values))


def metadata_index(offset: int, length: int, name: str) -> bytes:
    """Where such a record stands in the file, and its length with its head."""
    return _record(_METADATA_INDEX, _PLACE.pack(offset, length) + _text(name))


def statistics(counts: Mapping[int, int], first_ns: int, last_ns: int, *, channels: int, metadata: int) -> bytes:
    """How many messages each channel has, and from when to when (log_time); no schemas, attachments or chunks."""
    each = b"".join(_COUNT.pack(*entry) for entry in counts.items())
    head = _COUNTS.pack(sum(counts.values()), 0, channels, 0, metadata, 0, first_ns, last_ns)
    return _record(_STATISTICS, head + _LENGTH.pack(len(each)) + each)


def data_end(checksum: int) -> bytes:
    """The end of the entries: CRC-32 of all before it; 0: none."""
    return _record(_DATA_END, _CHECKSUM.pack(checksum))


def footer(summary_start: int) -> bytes:
    """The last record: where the summary begins. It has neither an index of its own nor a checksum."""
    return _record(_FOOTER, _FOOTER_FIELDS.pack(summary_start, 0, 0))


def _record(opcode: int, content: bytes) -> bytes:
    return RECORD_HEAD.pack(opcode, len(content)) + content


def _text(said: str) -> bytes:
    encoded = said.encode()
    return _LENGTH.pack(len(encoded)) + encoded


def _map(values: Mapping[str, str]) -> bytes:
    pairs = b"".join(_text(key) + _text(value) for key, value in values.items())
    return _LENGTH.pack(len(pairs)) + pairs
