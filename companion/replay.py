"""Replay: the agent on recorded inputs, its outputs compared with the recorded ones."""

import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from companion.agent import Agent
from companion.border import Border
from companion.config import parse
from companion.core.failsafe import Failsafe
from companion.core.values import Instant
from companion.errors import CompanionError
from companion.io.recorder import Entry, read_recording

OUTPUTS = ("output/mavlink", "output/peer")


@dataclass(frozen=True, slots=True)
class ReplayResult:
    """How a replay went."""

    inputs: int
    outputs: int
    difference: str | None
    """the first one, or None"""
    ticks: int = 0
    """control ticks among the inputs, as the recording counts them"""

    @property
    def same(self) -> bool:
        """Whether every output was the recorded one."""
        return self.difference is None

    def sentence(self) -> str:
        """For people."""
        head = f"{self.inputs} inputs, {self.outputs} outputs compared byte for byte"
        return f"{head}: the same" if self.same else f"{head}: first difference: {self.difference}"


def replay_file(path: Path) -> ReplayResult:
    """Replay one recording; CompanionError if the file is none."""
    try:
        recording = read_recording(path)
    except OSError as error:
        raise CompanionError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        facts = recording.metadata
        config = parse(tomllib.loads(facts["config"]), path.name)
        agent = Agent(config, int(facts["vehicle_id"]), int(facts["boot_id"]))
    except KeyError as missing:
        raise CompanionError(f"{path}: is no companion's recording: {missing} is missing") from None
    except ValueError as error:
        raise CompanionError(f"{path}: is no companion's recording: {error}") from None
    return replay(agent, recording.entries, recording.complete)


def replay(agent: Agent, entries: Iterable[Entry], complete: bool = True) -> ReplayResult:
    """Feed an agent recorded inputs; stops at the first output that differs.

    Of a recording that is not complete (its process was killed) the last outputs may be missing.
    """
    border = Border(agent)
    expected: list[tuple[str, bytes]] = []
    inputs = outputs = ticks = 0
    for entry in entries:
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
        expected = list(INPUTS[entry.channel](border, entry.body, entry.instant))
    if expected and complete:
        channel, body = expected[0]
        return ReplayResult(inputs, outputs, f"at the end: replayed {channel} {body.hex()}, recorded nothing", ticks)
    return ReplayResult(inputs, outputs, None, ticks)


def _at(entry: Entry) -> str:
    return f"monotonic {entry.instant.monotonic_ns * 1e-9:.6f} s"


def _advance(border: Border, _: bytes, now: Instant) -> Iterator[tuple[str, bytes]]:
    out = border.advance(now)
    for datagram in out.mavlink:
        yield "output/mavlink", datagram
    for topic, payload in out.peers:
        yield "output/peer", topic.encode() + b"\0" + payload


def _mavlink(border: Border, body: bytes, now: Instant) -> Iterator[tuple[str, bytes]]:
    border.receive_mavlink(body, now)
    return iter(())


def _peer(border: Border, body: bytes, now: Instant) -> Iterator[tuple[str, bytes]]:
    key, _, payload = body.partition(b"\0")
    border.receive_peer(key.decode(), payload, now)
    return iter(())


def _presence(border: Border, body: bytes, now: Instant) -> Iterator[tuple[str, bytes]]:
    border.receive_presence(body[0], bool(body[1]), now)
    return iter(())


def _command(border: Border, body: bytes, now: Instant) -> Iterator[tuple[str, bytes]]:
    border.receive_command(body, now)
    return iter(())


def _stop(border: Border, _: bytes, now: Instant) -> Iterator[tuple[str, bytes]]:
    border.stop(now)
    return iter(())


def _notice(border: Border, body: bytes, now: Instant) -> Iterator[tuple[str, bytes]]:
    border.notice(Failsafe[body.decode()], now)
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
