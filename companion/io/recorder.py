"""The flight recorder: every input and output of an agent in the order of the calls, as an MCAP file.

One entry is one MCAP message:

    channel        topic; by convention `input/...`, `output/...`, `advance`, and notes of the loop such as `tick`
    log_time       fleet_ns of the entry's Instant (ns since 1970)
    publish_time   monotonic_ns of the entry's Instant (ns); both times are two's complement, so that any int64 returns
    sequence       counts every call of `record` modulo 2^32, lost ones too: a gap is a loss, however the process ended
    data           the body, verbatim: a MAVLink frame, a peer's payload behind its key, ...

What the agent was made from (configuration, vehicle id, boot id, versions, seed) is the metadata record `recording`
ahead of the first message. Order is the order in the file; times may be equal and are not what a reader sorts by.

Messages are not gathered in chunks, and each write ends with a whole message: of a killed process everything that was
written is readable, which is all but the last quarter of a second. The file is synchronised with the disk each second,
so that a power cut takes little more. A closed file has a summary with channels and statistics.

`record` only appends to a deque. A writer thread packs small batches and writes between them, which gives the
interpreter's lock back: the control thread never waits for more than one batch's packing. Messages are packed here with
one `struct` call, in a third of the time of the library's writer, and read back alike.
"""

from __future__ import annotations

import contextlib
import os
import struct
import threading
import time
import zlib
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import IO, Final, NamedTuple, Self, TypeVar

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Footer, Header, Metadata, MetadataIndex, Statistics

from companion.core.values import Instant
from companion.errors import CompanionError

__all__ = ["Entry", "Gap", "Recorder", "Recording", "RecordingError", "gap_between", "read_recording"]

QUEUE_CAPACITY: Final = 32_768
"""entries waiting for the disk: about a minute's worth"""
BATCH_ENTRIES: Final = 64
"""packed at a time: about 0.1 ms of the interpreter's lock"""
WRITE_INTERVAL_S: Final = 0.25
SYNCHRONISE_INTERVAL_S: Final = 1.0
CLOSE_TIMEOUT_S: Final = 5.0

_MAGIC: Final = b"\x89MCAP0\r\n"
_PROFILE: Final = "starling-fleet"
_METADATA: Final = "recording"
_LOSS: Final = "loss"
_MESSAGE: Final = struct.Struct("<BQHIqq")
"""opcode, length of what follows, channel, sequence, log_time, publish_time; then the body"""
_RECORD_HEAD: Final = struct.Struct("<BQ")
_MESSAGE_FIELDS: Final = struct.Struct("<HIqq")
_MESSAGE_OPCODE: Final = int(Opcode.MESSAGE)
_RECORD_MAX_BYTES: Final = 1 << 28
_SEQUENCE_MASK: Final = 0xFFFF_FFFF

_AMONG_ENTRIES: Final = frozenset({Opcode.HEADER, Opcode.METADATA, Opcode.SCHEMA, Opcode.ATTACHMENT})
_Record = TypeVar("_Record")


class _Pending(NamedTuple):
    """One call of `Recorder.record`, on its way to the disk."""

    sequence: int
    channel: str
    instant: Instant
    body: bytes


class RecordingError(CompanionError):
    """A file that is no recording, or a damaged one: says which, where in it, and why."""

    exit_status = 2

    def __init__(self, path: Path | str, why: str, offset: int | None = None) -> None:
        super().__init__(f"{path}: {why}" if offset is None else f"{path}: at byte {offset}: {why}")


class Recorder:
    """Writes one flight to one new file.

    `write` puts bytes at a place of a file, as os.pwrite does. The constructor raises OSError when the file exists or
    cannot be written. After that nothing raises: a full disk shows in `failure` and `lost`, and recording goes on when
    there is room again.
    """

    def __init__(
        self,
        path: Path,
        metadata: Mapping[str, str],
        *,
        queue_capacity: int = QUEUE_CAPACITY,
        synchronise_interval_s: float = SYNCHRONISE_INTERVAL_S,
        write: Callable[[int, memoryview, int], int] = os.pwrite,
    ) -> None:
        self._pwrite = write
        self._queue: deque[_Pending] = deque()
        self._capacity = queue_capacity
        self._synchronise_interval_s = synchronise_interval_s
        self._sequence = 0
        self._refused = 0
        self._unwritten = 0
        self._failure: str | None = None
        self._closed = False
        self._stop = threading.Event()
        self._channels: dict[str, int] = {}
        self._statistics = Statistics(0, 0, {}, 0, 0, 0, 0, 0, 0)
        self._metadata_indexes: list[MetadataIndex] = []
        self._size = 0
        self._checksum = 0
        """CRC-32 of what is written"""
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        try:
            builder = RecordBuilder()
            builder.write(_MAGIC)
            Header(_PROFILE, "").write(builder)
            self._add_metadata(builder, _METADATA, metadata)
            self._write(builder.end())
        except BaseException:
            os.close(self._fd)
            raise
        # Daemonic: whoever forgets to close loses the last entries, not the ability to exit.
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def record(self, channel: str, now: Instant, body: bytes) -> None:
        """Take one entry; to be called from one thread."""
        sequence = self._sequence
        self._sequence = sequence + 1
        if self._closed or len(self._queue) >= self._capacity:
            self._refused += 1
        else:
            self._queue.append(_Pending(sequence, channel, now, body))

    @property
    def lost(self) -> int:
        """Entries that did not reach the file: the queue was full, or writing failed."""
        return self._refused + self._unwritten

    @property
    def failure(self) -> str | None:
        """The first error of the operating system while writing, for one line in a log; None so far."""
        return self._failure

    def close(self) -> None:
        """Write what is waiting and the summary, within five seconds; may be called again."""
        self._closed = True
        self._stop.set()
        self._thread.join(CLOSE_TIMEOUT_S)

    def _run(self) -> None:
        next_synchronisation_s = time.monotonic() + self._synchronise_interval_s
        try:
            while not self._stop.wait(WRITE_INTERVAL_S):
                self._write_waiting()
                if time.monotonic() >= next_synchronisation_s:
                    next_synchronisation_s = time.monotonic() + self._synchronise_interval_s
                    self._synchronise()
            self._write_waiting()
            self._finish()
            self._synchronise()
        finally:
            os.close(self._fd)

    def _write_waiting(self) -> None:
        # Not "until empty": what is appended meanwhile waits for the next round.
        waiting = len(self._queue)
        while waiting > 0:
            count = min(waiting, BATCH_ENTRIES)
            self._write_batch([self._queue.popleft() for _ in range(count)])
            waiting -= count

    def _write_batch(self, batch: list[_Pending]) -> None:
        channels = self._channels
        pack = _MESSAGE.pack
        parts: list[bytes] = []
        fresh: list[str] = []
        for sequence, name, now, body in batch:
            channel = channels.get(name)
            if channel is None:
                channel = channels[name] = len(channels) + 1
                fresh.append(name)
                parts.append(_channel_record(channel, name))
            length = _MESSAGE_FIELDS.size + len(body)
            monotonic_ns, fleet_ns = now
            parts.append(pack(_MESSAGE_OPCODE, length, channel, sequence & _SEQUENCE_MASK, fleet_ns, monotonic_ns))
            parts.append(body)
        try:
            self._write(b"".join(parts))
        except OSError as error:
            self._fail(error)
            self._unwritten += len(batch)
            for name in fresh:
                del channels[name]
        else:
            self._count(batch)

    def _count(self, batch: list[_Pending]) -> None:
        statistics = self._statistics
        counts = statistics.channel_message_counts
        for name, count in Counter(entry.channel for entry in batch).items():
            channel = self._channels[name]
            counts[channel] = counts.get(channel, 0) + count
        first, last = batch[0].instant.fleet_ns, batch[-1].instant.fleet_ns  # fleet time does not go back
        if statistics.message_count == 0:
            statistics.message_start_time = max(0, first)
        statistics.message_end_time = max(0, last)
        statistics.message_count += len(batch)

    def _write(self, data: bytes) -> None:
        """All of it behind what is there, or nothing."""
        view = memoryview(data)
        written = 0
        try:
            while written < len(view):
                written += self._pwrite(self._fd, view[written:], self._size + written)
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self._size)
            raise
        self._size += written
        self._checksum = zlib.crc32(data, self._checksum)

    def _synchronise(self) -> None:
        try:
            os.fsync(self._fd)
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        if self._failure is None:
            self._failure = str(error)

    def _add_metadata(self, builder: RecordBuilder, name: str, values: Mapping[str, str]) -> None:
        before = builder.count
        Metadata(name, dict(values)).write(builder)
        self._metadata_indexes.append(MetadataIndex(self._size + before, builder.count - before, name))

    def _finish(self) -> None:
        """Loss if any, end of data, summary, footer."""
        builder = RecordBuilder()
        if self.lost:
            self._add_metadata(builder, _LOSS, {"entries": str(self.lost)})
        head = builder.end()
        builder = RecordBuilder()
        # 0 stands for none.
        DataEnd(zlib.crc32(head, self._checksum)).write(builder)
        summary_start = self._size + len(head) + builder.count
        for name, channel in self._channels.items():
            builder.write(_channel_record(channel, name))
        self._statistics.channel_count = len(self._channels)
        self._statistics.metadata_count = len(self._metadata_indexes)
        self._statistics.write(builder)
        for index in self._metadata_indexes:
            index.write(builder)
        Footer(summary_start, 0, 0).write(builder)
        builder.write(_MAGIC)
        try:
            self._write(head + builder.end())
        except OSError as error:
            self._fail(error)


def _channel_record(channel: int, name: str) -> bytes:
    builder = RecordBuilder()
    Channel(id=channel, topic=name, message_encoding=_PROFILE, metadata={}, schema_id=0).write(builder)
    data: bytes = builder.end()
    return data


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
    lost = (after.sequence - expected) & _SEQUENCE_MASK
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
        unpack, begin = _MESSAGE_FIELDS.unpack_from, _MESSAGE_FIELDS.size
        for offset, opcode, content in self._records():
            if opcode == _MESSAGE_OPCODE:
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
                if record.name == _LOSS:
                    told = record.metadata.get("entries", "")
                    if not (told.isascii() and told.isdigit() and len(told) < 20):
                        raise RecordingError(self.path, f"a loss of {told!r:.40} entries", offset)
                    return int(told)
        return 0

    def _is_complete(self) -> bool:
        with self._opened() as file:
            if file.seek(0, os.SEEK_END) < 2 * len(_MAGIC):
                return False
            file.seek(-len(_MAGIC), os.SEEK_END)
            return file.read() == _MAGIC

    def _read_metadata(self) -> Mapping[str, str]:
        for offset, opcode, content in self._records():
            if opcode == Opcode.METADATA:
                record = self._parsed(Metadata, content, offset)
                if record.name == _METADATA:
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
            if file.read(len(_MAGIC)) != _MAGIC:
                raise RecordingError(self.path, "is no MCAP file")
            while True:
                offset = file.tell()
                head = file.read(_RECORD_HEAD.size)
                if len(head) < _RECORD_HEAD.size:
                    break
                opcode, length = _RECORD_HEAD.unpack(head)
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
