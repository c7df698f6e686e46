"""Recordings that a full disk, a power cut or a bad card has damaged: each reader says what is wrong, and where."""

import errno
import itertools
import os
import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from flights import DEFAULT, READY_S, Tape, launch

from companion.config import FleetConfig
from companion.config.file import parse, read_tables
from companion.core.values import Instant
from companion.io.recorder import Recorder
from companion.io.recording import RecordingError, read_recording
from companion.io.replay import ReplayResult, replay_file
from sim.autopilot.stubs import TRUTH_DTYPE
from sim.launch.summary.flight import Flight

FILES = 320
FILES_LONG = 5000


@dataclass(frozen=True)
class Recorded:
    """A short flight's recording: whole, and as a killed process leaves it (without the end and its checksum)."""

    config: FleetConfig
    tape: Tape
    metadata: dict[str, str]
    whole: bytes
    killed: bytes


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    tables = read_tables(DEFAULT, None)
    tables["vehicle"] = tables["vehicle"][:2]
    config = parse(tables, "fleet.toml")
    tape = Tape(keep=frozenset({1}))
    ls = launch(config, record=tape)
    ls.run_until(READY_S + 5.0)
    metadata = {"config": tomli_w.dumps(tables), "vehicle_id": "1", "boot_id": str(ls.vehicles[1].agent.boot_id)}
    path = tmp_path_factory.mktemp("recorded") / "vehicle-1.mcap"
    write(path, tape, metadata)
    whole = path.read_bytes()
    assert replay_file(path).same
    return Recorded(config, tape, metadata, whole, whole[: whole.rindex(b"output/mavlink") - 500])


def write(path: Path, tape: Tape, metadata: dict[str, str], full: Callable[[int], bool] = lambda _: False) -> int:
    """Record the tape on a disk that is `full` at some of its writes, counted from 0; returns how many were lost."""
    calls = itertools.count(-1)  # the head is written first

    def disk(fd: int, data: memoryview, at: int) -> int:
        if full(next(calls)):
            raise OSError(errno.ENOSPC, "No space left on device")
        return os.pwrite(fd, data, at)

    with Recorder(path, metadata, queue_capacity=10**6, write=disk) as recorder:
        for e in tape.entries[1]:
            recorder.record(e.channel, e.instant, e.body)
    return recorder.lost


def damage(data: bytes, rng: random.Random) -> bytes:
    """Cut off, bits turned, blocks zeroed, lost or repeated."""
    damaged = bytearray(data)
    at = rng.randrange(len(damaged))
    size = min(rng.choice([1, 8, 512, 4096]), len(damaged) - at)
    match rng.randrange(6):
        case 0:
            del damaged[at:]
        case 1 | 2:
            for _ in range(rng.choice([1, 1, 3, 30])):
                damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        case 3:
            damaged[at : at + size] = bytes(size)
        case 4:
            del damaged[at : at + size]
        case 5:
            damaged[at:at] = damaged[at : at + size]
    return bytes(damaged)


def read_by_all(path: Path, config: FleetConfig) -> ReplayResult | None:
    """What each reader makes of a file; None where it is refused."""
    Flight(config, 0, np.zeros(0, TRUTH_DTYPE), 0).read_files(1, [path])
    try:
        return replay_file(path)
    except RecordingError as error:
        said = str(error)
    assert said.startswith(f"{path}: ")
    return None


def check_damaged(recorded: Recorded, path: Path, seeds: range) -> None:
    said = {"refused": 0, "difference": 0, "missing": 0, "same": 0}
    for seed in seeds:
        rng = random.Random(seed)
        path.write_bytes(damage(rng.choice([recorded.whole, recorded.killed]), rng))
        result = read_by_all(path, recorded.config)
        if result is None:
            said["refused"] += 1
        else:
            said["same" if result.same else "difference" if result.difference else "missing"] += 1
    assert min(said["refused"], said["same"], said["difference"] + said["missing"]) > 0, said


@pytest.mark.timeout(600)
def test_no_damaged_file_is_more_than_a_recording_error_a_difference_or_what_is_missing(
    recorded: Recorded, tmp_path: Path
) -> None:
    check_damaged(recorded, tmp_path / "damaged.mcap", range(FILES))


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_no_damaged_file_of_thousands_is_more_than_that(recorded: Recorded, tmp_path: Path) -> None:
    check_damaged(recorded, tmp_path / "damaged.mcap", range(1000, 1000 + FILES_LONG))


@pytest.mark.parametrize("full", [range(1), range(5, 6), range(5, 9)], ids=["at the beginning", "once", "for a while"])
def test_entries_that_a_full_disk_took_are_told_as_missing_and_not_as_a_difference(
    recorded: Recorded, tmp_path: Path, full: range
) -> None:
    path = tmp_path / "full.mcap"
    lost = write(path, recorded.tape, recorded.metadata, lambda n: n in full)
    there = {e.sequence for e in read_recording(path).entries}
    first = next(n for n in range(len(there) + 1) if n not in there)
    then = "at the beginning"
    if first > 0:
        then = f"after monotonic {recorded.tape.entries[1][first - 1].instant.monotonic_ns * 1e-9:.6f} s"
    result = replay_file(path)
    assert (result.difference, result.same, lost > 0) == (None, False, True)
    assert f"the same; {lost} entries are missing {then}, so nothing behind them can be compared" in result.sentence()
    flight = Flight(recorded.config, 0, np.zeros(0, TRUTH_DTYPE), 0)
    flight.read_files(1, [path])
    assert flight.unrecorded == {1: f"{lost} entries are missing {then}"}


def test_entries_missing_at_the_end_are_told_too(recorded: Recorded, tmp_path: Path) -> None:
    path = tmp_path / "full.mcap"
    batches = itertools.count()
    write(path, recorded.tape, recorded.metadata, lambda _: next(batches) < 0)
    last = next(batches) - 3  # but the head's and the end's
    lost = write(tmp_path / "end.mcap", recorded.tape, recorded.metadata, lambda n: n == last)
    result = replay_file(tmp_path / "end.mcap")
    assert result.gap is not None
    assert 0 < lost == result.gap.entries
    assert result.difference is None


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("config", "[fleet", "is no companion's recording"),
        ("config", "[fleet]\nname = 3", "is no companion's recording"),
        ("vehicle_id", "9", "vehicle 9"),
        ("vehicle_id", "one", "is no companion's recording"),
        ("boot_id", str(1 << 40), "boot id"),
    ],
)
def test_a_recording_of_which_no_agent_can_be_made_says_so(
    recorded: Recorded, tmp_path: Path, key: str, value: str, said: str
) -> None:
    path = tmp_path / "odd.mcap"
    with Recorder(path, recorded.metadata | {key: value}) as recorder:
        recorder.record("advance", Instant(1, 1), b"")
    with pytest.raises(RecordingError, match=said):
        replay_file(path)


@pytest.mark.parametrize(
    ("channel", "body"),
    [("input/presence", b""), ("input/notice", b"NOTHING"), ("input/peer", b"\xff\0"), ("input/notice", b"\xff")],
)
def test_an_entry_that_no_agent_takes_is_a_difference_with_its_place(
    recorded: Recorded, tmp_path: Path, channel: str, body: bytes
) -> None:
    path = tmp_path / "odd.mcap"
    with Recorder(path, recorded.metadata) as recorder:
        recorder.record(channel, Instant(1_500_000_000, 1), body)
    assert f"monotonic 1.500000 s: recorded {channel}" in replay_file(path).sentence()
