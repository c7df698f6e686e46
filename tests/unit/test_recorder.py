"""The flight recorder, and what reads it."""

from __future__ import annotations

import gc
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from companion.core.values import Instant
from companion.io.recorder import Recorder
from companion.io.recording import Entry, Recording, RecordingError, read_recording

METADATA = {"config": 'name = "größe"\n', "vehicle_id": "3", "boot_id": "77", "seed": ""}
NOW = Instant(monotonic_ns=5_000_000_000, fleet_ns=1_700_000_000_000_000_000)


def write(path: Path, entries: list[Entry]) -> Recording:
    with Recorder(path, METADATA) as recorder:
        for entry in entries:
            recorder.record(entry.channel, entry.instant, entry.body)
    assert (recorder.lost, recorder.failure) == (0, None)
    return read_recording(path)


def numbered(count: int) -> list[Entry]:
    channels = ("input/mavlink", "advance", "output/mavlink")
    return [Entry(channels[n % 3], Instant(n // 4, NOW.fleet_ns + n // 4), b"%d" % n, n) for n in range(count)]


def test_what_was_recorded_is_read_in_the_order_of_the_calls_though_times_are_equal(tmp_path: Path) -> None:
    entries = numbered(1000)
    recording = write(tmp_path / "a.mcap", entries)
    assert list(recording.entries) == entries
    assert list(recording.entries) == entries  # and again
    assert recording.metadata == METADATA
    assert recording.complete
    assert recording.missing() == 0
    recording.verify()


INT64 = st.integers(-(1 << 63), (1 << 63) - 1)
ENTRIES = st.lists(st.tuples(st.text(max_size=5), INT64, INT64, st.binary(max_size=20)), max_size=20)


@settings(max_examples=10, deadline=None)
@given(calls=ENTRIES)
def test_any_channel_any_instant_and_any_body_return_as_they_were(
    tmp_path_factory: pytest.TempPathFactory, calls: list[tuple[str, int, int, bytes]]
) -> None:
    entries = [Entry(channel, Instant(m, f), body, n) for n, (channel, m, f, body) in enumerate(calls)]
    assert list(write(tmp_path_factory.mktemp("any") / "a.mcap", entries).entries) == entries


def test_a_recording_is_an_mcap_file_to_others(tmp_path: Path) -> None:
    entries = numbered(30)
    write(tmp_path / "a.mcap", entries)
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        messages = [
            (channel.topic, message.log_time, message.publish_time, message.data, message.sequence)
            for _, channel, message in reader.iter_messages(log_time_order=False)
        ]
        assert messages == [
            (e.channel, e.instant.fleet_ns, e.instant.monotonic_ns, e.body, e.sequence) for e in entries
        ]
        assert [(record.name, record.metadata) for record in reader.iter_metadata()] == [("recording", METADATA)]
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 30
        assert summary.statistics.channel_message_counts == {1: 10, 2: 10, 3: 10}
        assert summary.statistics.message_start_time == entries[0].instant.fleet_ns
        assert summary.statistics.message_end_time == entries[-1].instant.fleet_ns


def test_a_recording_cut_anywhere_gives_every_whole_entry_before_the_cut(tmp_path: Path) -> None:
    entries = numbered(12)
    write(tmp_path / "a.mcap", entries)
    whole = (tmp_path / "a.mcap").read_bytes()
    first_message = whole.index(b"input/mavlink")
    cut_path = tmp_path / "cut.mcap"
    counts = []
    for cut in range(first_message, len(whole)):
        cut_path.write_bytes(whole[:cut])
        recording = read_recording(cut_path)
        read = list(recording.entries)
        assert read == entries[: len(read)]
        assert not recording.complete
        counts.append(len(read))
    assert counts == sorted(counts)
    assert set(counts) == set(range(13))


WRITER = """
import sys
from pathlib import Path
from companion.core.values import Instant
from companion.io.recorder import Recorder
recorder = Recorder(Path(sys.argv[1]), {"config": "c"})
"""
COUNTING = """
import time
for n in range(1_000_000):
    recorder.record("advance", Instant(n, n), b"%d" % n)
    time.sleep(0.001)
"""


@pytest.mark.process
def test_a_killed_process_leaves_a_readable_recording_of_all_that_was_flushed(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with subprocess.Popen([sys.executable, "-c", WRITER + COUNTING, str(path)]) as process:
        try:
            deadline_s = time.monotonic() + 20.0
            while not (path.exists() and path.stat().st_size > 20_000) and time.monotonic() < deadline_s:
                time.sleep(0.02)
        finally:
            process.send_signal(signal.SIGKILL)
    recording = read_recording(path)
    entries = list(recording.entries)
    assert len(entries) > 300
    assert entries == [Entry("advance", Instant(n, n), b"%d" % n, n) for n in range(len(entries))]
    assert recording.metadata == {"config": "c"}
    assert not recording.complete


@pytest.mark.process
def test_a_process_that_forgets_to_close_still_exits(tmp_path: Path) -> None:
    code = WRITER + 'recorder.record("advance", Instant(1, 1), b"")\nsys.exit(3)'
    assert (
        subprocess.run([sys.executable, "-c", code, str(tmp_path / "a.mcap")], check=False, timeout=20).returncode == 3
    )


@pytest.mark.process
def test_a_full_disk_is_counted_and_told_and_recording_goes_on_when_there_is_room_again(tmp_path: Path) -> None:
    """A limit on the size of files stands in for the disk; like a full disk it cuts a write in the middle."""
    code = (
        WRITER
        + """
import resource, time
def until(condition):
    deadline_s = time.monotonic() + 15
    while not condition() and time.monotonic() < deadline_s:
        time.sleep(0.01)
    assert condition()
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, resource.RLIM_INFINITY))
for n in range(50):
    recorder.record("advance", Instant(n, n), bytes(1000))
until(lambda: recorder.lost == 50)
assert "File too large" in recorder.failure, recorder.failure
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
for n in range(50, 60):
    recorder.record("advance", Instant(n, n), bytes(1000))
recorder.close()
assert recorder.lost == 50
"""
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "a.mcap")], check=True, timeout=40)
    recording = read_recording(tmp_path / "a.mcap")
    assert [entry.sequence for entry in recording.entries] == list(range(50, 60))
    assert [gap.sentence() for gap in recording.gaps()] == ["50 entries are missing at the beginning"]
    assert recording.missing() == 50
    assert recording.complete
    recording.verify()
    with (tmp_path / "a.mcap").open("rb") as file:
        assert {record.name: record.metadata for record in make_reader(file).iter_metadata()}["loss"] == {
            "entries": "50"
        }


def test_a_full_queue_refuses_and_counts_and_the_file_shows_the_gap(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap", METADATA, queue_capacity=10) as recorder:
        for n in range(1000):  # far faster than the writer thread wakes
            recorder.record("advance", NOW, b"%d" % n)
        assert recorder.lost == 990
    recording = read_recording(tmp_path / "a.mcap")
    assert [entry.body for entry in recording.entries] == [b"%d" % n for n in range(10)]
    assert [gap.sentence() for gap in recording.gaps()] == ["990 entries are missing after monotonic 5.000000 s"]


def test_entries_after_closing_are_counted_as_lost_and_closing_again_does_nothing(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "a.mcap", METADATA)
    recorder.record("advance", NOW, b"before")
    recorder.close()
    recorder.record("advance", NOW, b"after")
    recorder.close()
    assert recorder.lost == 1
    assert [entry.body for entry in read_recording(tmp_path / "a.mcap").entries] == [b"before"]


def test_a_recording_is_never_overwritten(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", numbered(1))
    with pytest.raises(FileExistsError):
        Recorder(tmp_path / "a.mcap", METADATA)


def test_a_recording_in_a_folder_that_does_not_exist_is_refused_at_once(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Recorder(tmp_path / "nowhere" / "a.mcap", METADATA)


@pytest.mark.parametrize(
    "content", [b"", b"\x89MCAP", b"name = 'fleet'\n" * 10, b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + bytes(99)]
)
def test_a_file_that_is_no_recording_is_refused_with_its_name(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "other").write_bytes(content)
    with pytest.raises(RecordingError, match="other"):
        read_recording(tmp_path / "other")


def test_every_bit_of_the_entries_is_under_the_checksum(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", numbered(12))
    whole = (tmp_path / "a.mcap").read_bytes()
    entries = range(whole.index(b"seed") + 8, whole.rindex(b"11") + 2)
    path = tmp_path / "b.mcap"
    for at in entries:
        damaged = bytearray(whole)
        damaged[at] ^= 1 << at % 8
        path.write_bytes(damaged)
        with pytest.raises(RecordingError, match=r"b\.mcap: "):
            read_recording(path).verify()
    assert len(entries) > 300


def test_a_file_that_cannot_be_read_is_a_recording_error_with_the_reason(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"nowhere\.mcap: cannot be read: No such file"):
        read_recording(tmp_path / "nowhere.mcap")
    with pytest.raises(RecordingError, match="cannot be read: Is a directory"):
        read_recording(tmp_path)


def test_a_recording_rewritten_in_chunks_is_refused_and_not_taken_for_empty(tmp_path: Path) -> None:
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start()
        writer.add_metadata("recording", METADATA)
        writer.add_message(writer.register_channel("advance", "", 0), 1, b"", 1)
        writer.finish()
    with pytest.raises(RecordingError, match="chunks"):
        list(read_recording(tmp_path / "a.mcap").entries)


def own_time_s(act: Callable[[], None]) -> float:
    """Least CPU time of this thread over five rounds of 5000 calls each (s): what others did to a round is left out."""
    rounds = []
    for _ in range(5):
        begin_s = time.thread_time()
        for _ in range(5000):
            act()
        rounds.append(time.thread_time() - begin_s)
    return min(rounds)


def test_recording_costs_the_control_thread_a_few_microseconds_a_call(tmp_path: Path) -> None:
    """The bar is 3 us; on whatever machine, it is less than what the mcap package's own writer takes."""
    body = bytes(60)
    gc.collect()
    gc.freeze()  # as the companion does: thousands of tests' garbage is not the recorder's
    try:
        with (tmp_path / "b.mcap").open("wb") as file:
            writer = Writer(file, use_chunking=False)
            writer.start()
            channel = writer.register_channel("input/mavlink", "", 0)
            theirs_s = own_time_s(lambda: writer.add_message(channel, NOW.fleet_ns, body, NOW.monotonic_ns))
        with Recorder(tmp_path / "a.mcap", METADATA) as recorder:
            ours_s = own_time_s(lambda: recorder.record("input/mavlink", NOW, body))
    finally:
        gc.unfreeze()
    assert ours_s < theirs_s
    assert recorder.lost == 0
