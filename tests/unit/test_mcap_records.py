"""What the recorder packs itself is what the MCAP specification's own package packs, byte for byte."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap import records as theirs
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import make_reader

from companion.io import mcap_records as ours

U16, U32, U64 = (st.integers(0, (1 << bits) - 1) for bits in (16, 32, 64))
INT64 = st.integers(-(1 << 63), (1 << 63) - 1)
TEXT = st.text(max_size=40)
TEXTS = st.dictionaries(TEXT, TEXT, max_size=6)
COUNTS = st.dictionaries(U16, st.integers(0, 1 << 48), max_size=6)


def packed(record: theirs.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()
    return data


@given(profile=TEXT, library=TEXT)
def test_a_header_is_theirs(profile: str, library: str) -> None:
    assert ours.header(profile, library) == packed(theirs.Header(profile, library))


@given(number=U16, topic=TEXT, encoding=TEXT)
def test_a_channel_is_theirs(number: int, topic: str, encoding: str) -> None:
    assert ours.channel(number, topic, encoding) == packed(theirs.Channel(number, topic, encoding, {}, 0))


@given(channel=U16, sequence=U32, log_time=U64, publish_time=U64, body=st.binary(max_size=40))
def test_a_message_is_theirs(channel: int, sequence: int, log_time: int, publish_time: int, body: bytes) -> None:
    """Times above what int64 holds stand for the negative ones of the same bits."""
    log_ns, publish_ns = (t - (1 << 64) if t >= 1 << 63 else t for t in (log_time, publish_time))
    length = ours.MESSAGE_FIELDS.size + len(body)
    head = ours.MESSAGE_HEAD.pack(ours.MESSAGE_OPCODE, length, channel, sequence, log_ns, publish_ns)
    assert head + body == packed(theirs.Message(channel, log_time, body, publish_time, sequence))


@given(name=TEXT, values=TEXTS)
def test_metadata_are_theirs(name: str, values: dict[str, str]) -> None:
    assert ours.metadata(name, values) == packed(theirs.Metadata(name, values))


@given(offset=U64, length=U64, name=TEXT)
def test_where_metadata_stand_is_theirs(offset: int, length: int, name: str) -> None:
    assert ours.metadata_index(offset, length, name) == packed(theirs.MetadataIndex(offset, length, name))


@given(counts=COUNTS, first_ns=U64, last_ns=U64, channels=U32, metadata=U32)
def test_statistics_are_theirs(
    counts: dict[int, int], first_ns: int, last_ns: int, channels: int, metadata: int
) -> None:
    together = sum(counts.values())
    wanted = theirs.Statistics(0, channels, counts, 0, together, last_ns, first_ns, metadata, 0)
    assert ours.statistics(counts, first_ns, last_ns, channels=channels, metadata=metadata) == packed(wanted)


@given(checksum=U32, summary_start=U64)
def test_the_ends_of_entries_and_file_are_theirs(checksum: int, summary_start: int) -> None:
    assert ours.data_end(checksum) == packed(theirs.DataEnd(checksum))
    assert ours.footer(summary_start) == packed(theirs.Footer(summary_start, 0, 0))


def test_a_messages_kind_is_theirs() -> None:
    assert ours.MESSAGE_OPCODE == Opcode.MESSAGE


@pytest.mark.process
def test_what_flies_records_without_the_package(tmp_path: Path) -> None:
    """All that a companion is made of is there without it, and what it writes is an MCAP file to the package."""
    code = """
import sys
from pathlib import Path
for name in ("mcap", "zstandard", "lz4"):
    sys.modules[name] = None
import companion.io.check, companion.io.process, companion.io.zenoh.vehicle, companion.operator.verbs
from companion.core.values import Instant
from companion.io.recorder import Recorder
with Recorder(Path(sys.argv[1]), {"config": "c"}) as recorder:
    for n in range(3):
        recorder.record("advance", Instant(n, n), b"%d" % n)
"""
    path = tmp_path / "a.mcap"
    subprocess.run([sys.executable, "-c", code, str(path)], check=True, timeout=60)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert [m.data for _, _, m in reader.iter_messages()] == [b"0", b"1", b"2"]
        assert [m.metadata for m in reader.iter_metadata()] == [{"config": "c"}]
