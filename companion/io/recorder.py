"""The flight recorder: writes what `companion.io.recording` reads.

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
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Final, NamedTuple, Self

from mcap.data_stream import RecordBuilder
from mcap.records import Channel, DataEnd, Footer, Header, Metadata, MetadataIndex, Statistics

from companion.core.values import Instant
from companion.io.recording import LOSS, MAGIC, MESSAGE_FIELDS, MESSAGE_OPCODE, METADATA, SEQUENCE_MASK

QUEUE_CAPACITY: Final = 32_768
"""entries waiting for the disk: about a minute's worth"""
BATCH_ENTRIES: Final = 64
"""packed at a time: about 0.1 ms of the interpreter's lock"""
WRITE_INTERVAL_S: Final = 0.25
SYNCHRONISE_INTERVAL_S: Final = 1.0
CLOSE_TIMEOUT_S: Final = 5.0
_PROFILE: Final = "starling-fleet"
_MESSAGE: Final = struct.Struct("<BQHIqq")
"""opcode, length of what follows, channel, sequence, log_time, publish_time; then the body"""


class _Pending(NamedTuple):
    """One call of `Recorder.record`, on its way to the disk."""

    sequence: int
    channel: str
    instant: Instant
    body: bytes


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
            builder.write(MAGIC)
            Header(_PROFILE, "").write(builder)
            self._add_metadata(builder, METADATA, metadata)
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
            length = MESSAGE_FIELDS.size + len(body)
            monotonic_ns, fleet_ns = now
            parts.append(pack(MESSAGE_OPCODE, length, channel, sequence & SEQUENCE_MASK, fleet_ns, monotonic_ns))
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
            self._add_metadata(builder, LOSS, {"entries": str(self.lost)})
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
        builder.write(MAGIC)
        try:
            self._write(head + builder.end())
        except OSError as error:
            self._fail(error)


def _channel_record(channel: int, name: str) -> bytes:
    builder = RecordBuilder()
    Channel(id=channel, topic=name, message_encoding=_PROFILE, metadata={}, schema_id=0).write(builder)
    data: bytes = builder.end()
    return data
