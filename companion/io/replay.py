"""Replay: the agent on recorded inputs, its outputs compared with the recorded ones."""

import json
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from companion.config import FleetConfig
from companion.config.file import parse
from companion.core.failsafe import Failsafe
from companion.core.values import Instant
from companion.errors import CompanionError
from companion.io.recording import Entry, Gap, Recording, RecordingError, gap_between, read_recording
from companion.io.records import peer_body, split_peer_body
from companion.vehicle.agent import Agent
from companion.vehicle.guard import Guard

ANSWER = "output/answer"
OUTPUTS = ("output/mavlink", "output/peer", ANSWER)
BOOT_IDS = range(1 << 32)


@dataclass(frozen=True, slots=True)
class ReplayResult:
    """How a replay went."""

    inputs: int
    outputs: int
    difference: str | None
    """the first one, or None"""
    ticks: int = 0
    """control ticks among the inputs, as the recording counts them"""
    gap: Gap | None = None
    """where the recording has lost entries: nothing behind it can be compared"""
    cut: bool = False
    """whether the recording was not closed: its process was killed, or the file is not whole"""

    @property
    def same(self) -> bool:
        """Whether every output was the recorded one, and none is missing."""
        return self.difference is None and self.gap is None

    def sentence(self) -> str:
        """For people."""
        head = f"{self.inputs} inputs, {self.outputs} outputs compared byte for byte"
        if self.gap is not None:
            return f"{head}: the same; {self.gap.sentence()}, so nothing behind them can be compared"
        whole = "; the recording was not closed: its process was killed, or the file is cut short" if self.cut else ""
        return f"{head}: the same{whole}" if self.same else f"{head}: first difference: {self.difference}"


def replay_file(path: Path) -> ReplayResult:
    """Replay one recording; RecordingError if the file is none, or is damaged."""
    recording = read_recording(path)
    recording.verify()
    agent = recorded_agent(recording)
    result = replace(replay(agent, recording.entries, recording.complete), cut=not recording.complete)
    if result.same and (behind := list(recording.gaps())):
        return replace(result, gap=behind[-1])
    return result


def made_from(recording: Recording) -> tuple[FleetConfig, int, int]:
    """The configuration, vehicle id and boot id of the recorded agent; RecordingError if the recording lacks them."""
    facts, path = recording.metadata, recording.path
    try:
        config = parse(tomllib.loads(facts["config"]), str(path))
        vehicle_id, boot_id = int(facts["vehicle_id"]), int(facts["boot_id"])
        config.by_id(vehicle_id)
        if boot_id not in BOOT_IDS:
            raise ValueError(f"boot id {boot_id}")
    except KeyError as missing:
        raise RecordingError(path, f"is no companion's recording: {missing} is missing") from None
    except (ValueError, RecursionError, CompanionError) as error:
        raise RecordingError(path, f"is no companion's recording: {error}") from None
    return config, vehicle_id, boot_id


def recorded_agent(recording: Recording) -> Agent:
    """An agent made from what the recorded one was made from."""
    config, vehicle_id, boot_id = made_from(recording)
    flown, here = recording.metadata.get("foreign", "[]"), json.dumps([o._asdict() for o in config.foreign])
    try:
        same = json.loads(flown) == json.loads(here)
    except (ValueError, RecursionError) as error:
        raise RecordingError(recording.path, f"is no companion's recording: {error}") from None
    if not same:
        raise RecordingError(
            recording.path, f"is no companion's recording: it was flown with {flown}, and installed is {here}"
        )
    return Agent(config, vehicle_id, boot_id)


def replay(agent: Agent, entries: Iterable[Entry], complete: bool = True) -> ReplayResult:
    """Feed an agent recorded inputs; stops at the first output that differs, and where entries were lost.

    Of a recording that is not complete (its process was killed) the last outputs may be missing.
    """
    guard = Guard(agent)
    expected: list[tuple[str, bytes]] = []
    inputs = outputs = ticks = 0
    before: Entry | None = None
    for entry in entries:
        gap = gap_between(before, entry)
        if gap is not None:
            return ReplayResult(inputs, outputs, None, ticks, gap)
        before = entry
        if expected and expected[0][0] == ANSWER != entry.channel:
            expected.pop(0)  # recordings need not hold the answers
        if entry.channel in OUTPUTS:
            outputs += 1
            if not expected:
                return ReplayResult(inputs, outputs, f"{_at(entry)}: recorded {entry.channel}, replayed nothing")
            channel, body = expected.pop(0)
            if (channel, body) != (entry.channel, entry.body):
                return ReplayResult(
                    inputs, outputs, f"{_at(entry)}: recorded {entry.channel} {entry.body.hex()}, "
                    f"replayed {channel} {body.hex()}"
                )  # fmt: skip
            continue
        ticks += entry.channel == "tick"
        if entry.channel not in INPUTS:
            continue
        if expected:
            channel, body = expected[0]
            return ReplayResult(inputs, outputs, f"{_at(entry)}: replayed {channel} {body.hex()}, recorded nothing")
        inputs += 1
        try:
            expected = list(INPUTS[entry.channel](guard, entry.body, entry.instant))
        except Exception as error:  # noqa: BLE001 - an entry that is none: damaged, or of another version
            said = f"{type(error).__name__}: {error}"
            return ReplayResult(
                inputs, outputs, f"{_at(entry)}: recorded {entry.channel}, on which replay raises {said}"
            )
    expected = [e for e in expected if e[0] != ANSWER]
    if expected and complete:
        channel, body = expected[0]
        return ReplayResult(inputs, outputs, f"at the end: replayed {channel} {body.hex()}, recorded nothing", ticks)
    return ReplayResult(inputs, outputs, None, ticks)


def feed(guard: Guard, entry: Entry, path: Path) -> None:
    """Give an agent a recorded input; what it answers is dropped. RecordingError for a damaged entry of the file."""
    try:
        for _ in INPUTS[entry.channel](guard, entry.body, entry.instant):
            pass
    except Exception as error:
        said = f"{_at(entry)}: {entry.channel} cannot be read: {type(error).__name__}: {error}"
        raise RecordingError(path, said) from error


def _at(entry: Entry) -> str:
    return f"monotonic {entry.instant.monotonic_ns * 1e-9:.6f} s"


def _advance(guard: Guard, _: bytes, now: Instant) -> Iterator[tuple[str, bytes]]:
    out = guard.advance(now)
    for datagram in out.mavlink:
        yield "output/mavlink", datagram
    for topic, payload in out.peers:
        yield "output/peer", peer_body(topic, payload)


def _mavlink(guard: Guard, body: bytes, now: Instant) -> Iterator[tuple[str, bytes]]:
    guard.receive_mavlink(body, now)
    return iter(())


def _peer(guard: Guard, body: bytes, now: Instant) -> Iterator[tuple[str, bytes]]:
    guard.receive_peer(*split_peer_body(body), now)
    return iter(())


def _presence(guard: Guard, body: bytes, now: Instant) -> Iterator[tuple[str, bytes]]:
    guard.receive_presence(body[0], bool(body[1]), now)
    return iter(())


def _command(guard: Guard, body: bytes, now: Instant) -> Iterator[tuple[str, bytes]]:
    yield ANSWER, guard.receive_command(body, now)


def _stop(guard: Guard, _: bytes, now: Instant) -> Iterator[tuple[str, bytes]]:
    guard.stop(now)
    return iter(())


def _notice(guard: Guard, body: bytes, now: Instant) -> Iterator[tuple[str, bytes]]:
    guard.notice(Failsafe[body.decode()], now)
    return iter(())


INPUTS = {
    "advance": _advance,
    "input/mavlink": _mavlink,
    "input/peer": _peer,
    "input/presence": _presence,
    "input/command": _command,
    "input/stop": _stop,
    "input/notice": _notice,
}
