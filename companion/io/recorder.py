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
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import IO, Final, Self

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Footer, Header, Metadata, MetadataIndex, Statistics

from companion.core.values import Instant
from companion.errors import CompanionError

__all__ = ["Entry", "Recorder", "Recording", "RecordingError", "read_recording"]

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

_Pending = tuple[int, str, Instant, bytes]


class RecordingError(CompanionError):
    """A file that is not a recording."""


class Recorder:
    """Writes one flight to one new file.

    The constructor raises OSError when the file exists or cannot be written. After that nothing raises: a full disk
    shows in `failure` and `lost`, and recording goes on when there is room again.
    """

    def __init__(
        self,
        path: Path,
        metadata: Mapping[str, str],
        *,
        queue_capacity: int = QUEUE_CAPACITY,
        synchronise_interval_s: float = SYNCHRONISE_INTERVAL_S,
    ) -> None:
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
            self._queue.append((sequence, channel, now, body))

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
        for name, count in Counter(name for _, name, _, _ in batch).items():
            channel = self._channels[name]
            counts[channel] = counts.get(channel, 0) + count
        first, last = batch[0][2].fleet_ns, batch[-1][2].fleet_ns  # fleet time does not go back
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
                written += os.pwrite(self._fd, view[written:], self._size + written)
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self._size)
            raise
        self._size += written

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
        DataEnd(0).write(builder)
        summary_start = self._size + builder.count
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
            self._write(builder.end())
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
    sequence: int = 0
    """number of the call modulo 2^32"""


class Recording:
    """A recording on disk, whole or cut short by a killed process."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.metadata: Mapping[str, str] = self._read_metadata()
        """what the recorder was given"""

    @property
    def entries(self) -> Iterator[Entry]:
        """All entries in the order of the calls, from the beginning each time."""
        names: dict[int, str] = {}
        unpack, begin = _MESSAGE_FIELDS.unpack_from, _MESSAGE_FIELDS.size
        with self._path.open("rb") as file:
            for opcode, content in _records(file):
                if opcode == _MESSAGE_OPCODE:
                    channel, sequence, fleet_ns, monotonic_ns = unpack(content)
                    yield Entry(names[channel], Instant(monotonic_ns, fleet_ns), content[begin:], sequence)
                elif opcode == Opcode.CHANNEL:
                    record = Channel.read(ReadDataStream(BytesIO(content)))
                    names[record.id] = record.topic
                elif opcode == Opcode.CHUNK:
                    raise RecordingError(f"{self._path}: has chunks, so another tool has rewritten it")
                elif opcode == Opcode.DATA_END:
                    return

    def missing(self) -> int:
        """How many entries were lost between the first and the last that are there; reads the file."""
        missing = 0
        expected = 0
        for entry in self.entries:
            missing += (entry.sequence - expected) & _SEQUENCE_MASK
            expected = entry.sequence + 1
        return missing

    @property
    def complete(self) -> bool:
        """Whether the recorder was closed; False after a kill."""
        with self._path.open("rb") as file:
            file.seek(0, os.SEEK_END)
            if file.tell() < 2 * len(_MAGIC):
                return False
            file.seek(-len(_MAGIC), os.SEEK_END)
            return file.read() == _MAGIC

    def _read_metadata(self) -> Mapping[str, str]:
        with self._path.open("rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise RecordingError(f"{self._path}: is no MCAP file")
            for opcode, content in _records(file):
                if opcode == Opcode.METADATA:
                    record = Metadata.read(ReadDataStream(BytesIO(content)))
                    if record.name == _METADATA:
                        return dict(record.metadata)
                elif opcode != Opcode.HEADER:
                    break
        raise RecordingError(f"{self._path}: is no recording of a companion: its metadata are missing")


def read_recording(path: Path) -> Recording:
    """Open a recording.

    Raises RecordingError when the file is something else, OSError when it cannot be read.
    """
    return Recording(path)


def _records(file: IO[bytes]) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of each whole record; a torn one ends the reading."""
    file.seek(len(_MAGIC))
    while len(head := file.read(_RECORD_HEAD.size)) == _RECORD_HEAD.size:
        opcode, length = _RECORD_HEAD.unpack(head)
        content = file.read(min(length, _RECORD_MAX_BYTES))
        if len(content) < length:
            return
        yield opcode, content
