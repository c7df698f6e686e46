"""Flight recordings as they are read, whole or damaged; `companion.io.mcap_records` has their form.

What flies writes recordings and reads none: this module needs the `mcap` package (extra `replay`), by whose reading of
channels and metadata what the companion packs itself is understood.
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO, Final, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Metadata

from companion.core.values import Instant
from companion.errors import CompanionError
from companion.io.mcap_records import (
    LOSS,
    MAGIC,
    MESSAGE_FIELDS,
    MESSAGE_OPCODE,
    METADATA,
    RECORD_HEAD,
    SEQUENCE_MASK,
)

_RECORD_MAX_BYTES: Final = 1 << 28
_AMONG_ENTRIES: Final = frozenset({Opcode.HEADER, Opcode.METADATA, Opcode.SCHEMA, Opcode.ATTACHMENT})
_Record = TypeVar("_Record")


class RecordingError(CompanionError):
    """A file that is no recording, or a damaged one: says which, where in it, and why."""

    exit_status = 2

    def __init__(self, path: Path | str, why: str, offset: int | None = None) -> None:
        super().__init__(f"{path}: {why}" if offset is None else f"{path}: at byte {offset}: {why}")


@dataclass(frozen=True, slots=True)
class Entry:
    """One call of `Recorder.record`."""

    channel: str
    instant: Instant
    body: bytes
    sequence: int | None = None
    """number of the call modulo 2^32, where it is known: a gap is a loss"""


@dataclass(frozen=True, slots=True)
class Gap:
    """Entries that a recording has lost between two that it has, or behind the last one."""

    entries: int
    after: Instant | None
    """time of the last entry before them; None: they were the first"""

    def sentence(self) -> str:
        """For people."""
        what = f"{self.entries} {'entry is' if self.entries == 1 else 'entries are'} missing"
        return f"{what} {'at the beginning' if self.after is None else f'after monotonic {_seconds(self.after)} s'}"


def gap_between(before: Entry | None, after: Entry) -> Gap | None:
    """What was lost between two entries that follow each other (None: the beginning)."""
    if after.sequence is None or (before is not None and before.sequence is None):
        return None
    expected = 0 if before is None or before.sequence is None else before.sequence + 1
    lost = (after.sequence - expected) & SEQUENCE_MASK
    return Gap(lost, None if before is None else before.instant) if lost else None


def _seconds(now: Instant) -> str:
    return f"{now.monotonic_ns * 1e-9:.6f}"


class Recording:
    """A recording on disk, whole or cut short by a killed process.

    Whatever reads from it raises RecordingError, and nothing else, where the file is damaged or cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.complete = self._is_complete()
        """whether the recorder was closed; False after a kill"""
        self.metadata: Mapping[str, str] = self._read_metadata()
        """what the recorder was given"""

    @property
    def entries(self) -> Iterator[Entry]:
        """All entries in the order of the calls, from the beginning each time."""
        names: dict[int, str] = {}
        unpack, begin = MESSAGE_FIELDS.unpack_from, MESSAGE_FIELDS.size
        for offset, opcode, content in self._records():
            if opcode == MESSAGE_OPCODE:
                if len(content) < begin:
                    raise RecordingError(self.path, "a message without its head", offset)
                channel, sequence, fleet_ns, monotonic_ns = unpack(content)
                if channel not in names:
                    raise RecordingError(self.path, f"a message on channel {channel}, which is not declared", offset)
                yield Entry(names[channel], Instant(monotonic_ns, fleet_ns), content[begin:], sequence)
            elif opcode == Opcode.CHANNEL:
                record = self._parsed(Channel, content, offset)
                names[record.id] = record.topic
            elif opcode == Opcode.CHUNK:
                raise RecordingError(self.path, "has chunks, so another tool has rewritten it", offset)
            elif opcode == Opcode.DATA_END:
                return
            elif opcode not in _AMONG_ENTRIES:
                raise RecordingError(self.path, f"a record of kind {opcode:#x} among the entries", offset)

    def verify(self) -> None:
        """Read the whole file, and compare its checksum where it has one (a killed process leaves none)."""
        for _ in self.entries:
            pass
        with self._opened() as file:
            for offset, opcode, content in self._records():
                if opcode == Opcode.DATA_END:
                    wanted = self._parsed(DataEnd, content, offset).data_section_crc
                    file.seek(0)
                    if wanted != 0 and zlib.crc32(file.read(offset)) != wanted:
                        raise RecordingError(self.path, "is damaged: its content is not that of its checksum")
                    return
        if self.complete:
            raise RecordingError(self.path, "is damaged: its end is there, and the end of its entries is not")

    def gaps(self) -> Iterator[Gap]:
        """What was lost, as far as the entries that are there and the recorder's own count tell; reads the file."""
        before: Entry | None = None
        lost = 0
        for entry in self.entries:
            gap = gap_between(before, entry)
            if gap is not None:
                lost += gap.entries
                yield gap
            before = entry
        if (behind := self._lost_entries() - lost) > 0:
            yield Gap(behind, None if before is None else before.instant)

    def missing(self) -> int:
        """How many entries were lost; reads the file."""
        return sum(gap.entries for gap in self.gaps())

    def _lost_entries(self) -> int:
        """What the recorder has counted, 0 where it could not tell."""
        for offset, opcode, content in self._records():
            if opcode == Opcode.METADATA:
                record = self._parsed(Metadata, content, offset)
                if record.name == LOSS:
                    told = record.metadata.get("entries", "")
                    if not (told.isascii() and told.isdigit() and len(told) < 20):
                        raise RecordingError(self.path, f"a loss of {told!r:.40} entries", offset)
                    return int(told)
        return 0

    def _is_complete(self) -> bool:
        with self._opened() as file:
            if file.seek(0, os.SEEK_END) < 2 * len(MAGIC):
                return False
            file.seek(-len(MAGIC), os.SEEK_END)
            return file.read() == MAGIC

    def _read_metadata(self) -> Mapping[str, str]:
        for offset, opcode, content in self._records():
            if opcode == Opcode.METADATA:
                record = self._parsed(Metadata, content, offset)
                if record.name == METADATA:
                    return dict(record.metadata)
            elif opcode != Opcode.HEADER:
                break
        raise RecordingError(self.path, "is no recording of a companion: its metadata are missing")

    @contextlib.contextmanager
    def _opened(self) -> Iterator[IO[bytes]]:
        try:
            with self.path.open("rb") as file:
                yield file
        except OSError as error:
            raise RecordingError(self.path, f"cannot be read: {error.strerror}") from error

    def _records(self) -> Iterator[tuple[int, int, bytes]]:
        """Place, opcode and content of each whole record up to the summary; a torn one ends the reading, unless the
        file's own end stands behind it."""
        with self._opened() as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise RecordingError(self.path, "is no MCAP file")
            while True:
                offset = file.tell()
                head = file.read(RECORD_HEAD.size)
                if len(head) < RECORD_HEAD.size:
                    break
                opcode, length = RECORD_HEAD.unpack(head)
                if length > _RECORD_MAX_BYTES:
                    raise RecordingError(self.path, f"a record of {length} bytes", offset)
                content = file.read(length)
                if len(content) < length:
                    break
                yield offset, opcode, content
                if opcode == Opcode.DATA_END:
                    return
            if self.complete:
                raise RecordingError(self.path, f"a record reaches beyond the file's end ({file.tell()})", offset)

    def _parsed(self, kind: type[_Record], content: bytes, offset: int) -> _Record:
        try:
            record: _Record = kind.read(ReadDataStream(BytesIO(content)))  # type: ignore[attr-defined]
        except (ValueError, struct.error, EndOfFile, McapError, MemoryError, OverflowError) as error:
            raise RecordingError(self.path, f"a {kind.__name__.lower()} that cannot be read: {error}", offset) from None
        return record


def read_recording(path: Path) -> Recording:
    """Open a recording; RecordingError when the file is something else, or cannot be read."""
    return Recording(path)
