"""The flight recorder: writes what `companion.io.recording` reads.

`record` only appends to a deque. A writer thread packs small batches and writes between them, which gives the
interpreter's lock back: the control thread never waits for more than one batch's packing. A message is packed with one
`struct` call, in a third of the time of the `mcap` package's writer.

Messages are not gathered in chunks, and each write ends with a whole message: of a killed process everything that was
written is readable, which is all but the last quarter of a second. The file is synchronised with the disk each second,
so that a power cut takes little more. A closed file has a summary with channels and statistics.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
import zlib
from collections import Counter, deque
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Final, NamedTuple, Self

from companion.core.values import Instant
from companion.io import mcap_records as mcap
from companion.io.mcap_records import (
    LOSS,
    MAGIC,
    MESSAGE_FIELDS,
    MESSAGE_HEAD,
    MESSAGE_OPCODE,
    METADATA,
    SEQUENCE_MASK,
)

QUEUE_CAPACITY: Final = 32_768
"""entries waiting for the disk: about a minute's worth"""
BATCH_ENTRIES: Final = 64
"""packed at a time: about 0.1 ms of the interpreter's lock"""
WRITE_INTERVAL_S: Final = 0.25
SYNCHRONISE_INTERVAL_S: Final = 1.0
CLOSE_TIMEOUT_S: Final = 5.0
_PROFILE: Final = "starling-fleet"


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
        self._counts: dict[int, int] = {}
        """messages of each channel"""
        self._first_ns = self._last_ns = 0
        """log_time of the first and of the last of them"""
        self._metadata: list[bytes] = []
        """where metadata stand: for the summary"""
        self._size = 0
        self._checksum = 0
        """CRC-32 of what is written"""
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        try:
            head = MAGIC + mcap.header(_PROFILE, "")
            self._write(head + self._indexed(len(head), METADATA, metadata))
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
        pack = MESSAGE_HEAD.pack
        parts: list[bytes] = []
        fresh: list[str] = []
        for sequence, name, now, body in batch:
            channel = channels.get(name)
            if channel is None:
                channel = channels[name] = len(channels) + 1
                fresh.append(name)
                parts.append(mcap.channel(channel, name, _PROFILE))
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
        # Fleet time does not go back.
        if not self._counts:
            self._first_ns = max(0, batch[0].instant.fleet_ns)
        self._last_ns = max(0, batch[-1].instant.fleet_ns)
        for name, count in Counter(entry.channel for entry in batch).items():
            channel = self._channels[name]
            self._counts[channel] = self._counts.get(channel, 0) + count

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

    def _indexed(self, before: int, name: str, values: Mapping[str, str]) -> bytes:
        """The metadata's record, `before` bytes behind what is written, as the summary will name it."""
        record = mcap.metadata(name, values)
        self._metadata.append(mcap.metadata_index(self._size + before, len(record), name))
        return record

    def _finish(self) -> None:
        """Loss if any, end of data, summary, footer."""
        loss = self._indexed(0, LOSS, {"entries": str(self.lost)}) if self.lost else b""
        end = loss + mcap.data_end(zlib.crc32(loss, self._checksum))
        channels = [mcap.channel(channel, name, _PROFILE) for name, channel in self._channels.items()]
        counted = mcap.statistics(
            self._counts, self._first_ns, self._last_ns, channels=len(channels), metadata=len(self._metadata)
        )
        summary = b"".join((*channels, counted, *self._metadata))
        try:
            self._write(end + summary + mcap.footer(self._size + len(end)) + MAGIC)
        except OSError as error:
            self._fail(error)
