"""A recording's inputs under other settings: what another law, trigger or limit would have said.

Both agents see what the recorded vehicle saw: it flew by its own settings, and follows none of the other's setpoints.
So this compares decisions, tick by tick, and predicts no flight.
"""

from collections import Counter
from dataclasses import dataclass, field
from math import dist, sqrt
from pathlib import Path
from typing import Any, NamedTuple

from companion.config.file import load
from companion.core.events import FailsafeActed
from companion.errors import ConfigError
from companion.io.recording import Recording, read_recording
from companion.io.replay import INPUTS, feed, made_from, recorded_agent
from companion.vehicle.agent import Agent
from companion.vehicle.guard import Guard
from companion.wire.mavlink import SET_POSITION_TARGET_LOCAL_NED
from companion.wire.mavlink_frames import HEAD_2

VELOCITY, ACCELERATION = slice(4, 7), slice(7, 9)
"""fields of SET_POSITION_TARGET_LOCAL_NED"""


class Setpoint(NamedTuple):
    """What an agent asked for at one tick, and what for."""

    velocity_ned_m_s: tuple[float, ...]
    acceleration_ne_m_s2: tuple[float, ...]
    aim: tuple[object, ...]
    """its phase and its motion: agents with different ones do not differ by their law"""


@dataclass(slots=True)
class Account:
    """What one agent decided on a recording's inputs."""

    messages: Counter[str] = field(default_factory=Counter)
    """state messages by cause"""
    setpoints: dict[int, Setpoint] = field(default_factory=dict)
    """by monotonic time (ns)"""
    failsafes: list[str] = field(default_factory=list)
    raised: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True, slots=True)
class Compared:
    """The recorded settings' decisions beside the other's."""

    own: Account
    other: Account
    seconds: float
    keys: list[str]
    """in which the two files differ"""

    def differences(self) -> dict[str, float | int]:
        """Of the setpoints at ticks at which both were in one phase of one motion: how many, RMS and largest
        difference."""
        mine, theirs = self.own.setpoints, self.other.setpoints
        pairs = [(mine[t], theirs[t]) for t in sorted(mine.keys() & theirs.keys()) if mine[t].aim == theirs[t].aim]
        velocity = [dist(a.velocity_ned_m_s, b.velocity_ned_m_s) for a, b in pairs]
        acceleration = [dist(a.acceleration_ne_m_s2, b.acceleration_ne_m_s2) for a, b in pairs]
        return {
            "setpoints_alike": len(pairs),
            "setpoints_own": len(self.own.setpoints),
            "setpoints_other": len(self.other.setpoints),
            "velocity_rms_m_s": _rms(velocity),
            "velocity_max_m_s": max(velocity, default=0.0),
            "acceleration_rms_m_s2": _rms(acceleration),
            "acceleration_max_m_s2": max(acceleration, default=0.0),
        }

    def sentences(self) -> list[str]:
        """For people."""
        d = self.differences()
        said = [
            f"differs in {', '.join(self.keys) or 'nothing that vehicles must agree on'}",
            f"state messages in {self.seconds:.1f} s: {_counted(self.own.messages)} as recorded, "
            f"{_counted(self.other.messages)} with the other file",
            f"setpoints: {d['setpoints_own']} and {d['setpoints_other']}; in the {d['setpoints_alike']} ticks with "
            f"both in one phase of one motion velocity differs by {d['velocity_rms_m_s']:.3f} m/s RMS, "
            f"{d['velocity_max_m_s']:.3f} at most, acceleration by {d['acceleration_rms_m_s2']:.3f} m/s^2 RMS, "
            f"{d['acceleration_max_m_s2']:.3f} at most",
            f"failsafes: {'; '.join(self.own.failsafes) or 'none'} as recorded, "
            f"{'; '.join(self.other.failsafes) or 'none'} with the other file",
        ]
        if self.other.raised:
            said.append(f"the other file's agent raised {_counted(self.other.raised)}")
        return said

    def as_json(self) -> dict[str, Any]:
        """The same for programs, as JSON has it."""
        sides = {
            name: {"messages": dict(a.messages), "failsafes": a.failsafes, "raised": dict(a.raised)}
            for name, a in (("recorded", self.own), ("other", self.other))
        }
        return {"keys": self.keys, "seconds": self.seconds, **sides, "setpoints": self.differences()}


def _rms(values: list[float]) -> float:
    return sqrt(sum(x * x for x in values) / len(values)) if values else 0.0


def _counted(counts: Counter[str]) -> str:
    each = ", ".join(f"{name} {n}" for name, n in counts.most_common() if n)
    return f"{sum(counts.values())} ({each})" if each else "0"


def replay_with(path: Path, other_file: Path) -> Compared:
    """Run the recorded agent and one made from another file on a recording's inputs.

    RecordingError for a file that is no recording; ConfigError for a file that is none, or that lacks the vehicle.
    """
    recording = read_recording(path)
    recording.verify()
    config, vehicle_id, boot_id = made_from(recording)
    other = load(other_file)
    if vehicle_id not in [v.id for v in other.vehicles]:
        raise ConfigError(f"{other_file}: has no enabled vehicle {vehicle_id}, which {path} is the recording of")
    agents = [recorded_agent(recording), Agent(other, vehicle_id, boot_id)]
    (own, others), seconds = _run(recording, agents)
    return Compared(own, others, seconds, config.differing(other.shared_digests))


def _run(recording: Recording, agents: list[Agent]) -> tuple[list[Account], float]:
    guards = [Guard(agent) for agent in agents]
    accounts = [Account() for _ in agents]
    begin = end = None
    for entry in recording.entries:
        begin = entry.instant.monotonic_ns if begin is None else begin
        end = entry.instant.monotonic_ns
        if entry.channel not in INPUTS:
            continue
        for guard, account in zip(guards, accounts, strict=True):
            if entry.channel != "advance":
                feed(guard, entry, recording.path)
                continue
            out = guard.advance(entry.instant)
            for frame in out.mavlink:
                _take(account, guard.agent, entry.instant.monotonic_ns, frame)
            account.failsafes += [e.sentence for e in out.events if isinstance(e, FailsafeActed)]
    for guard, account in zip(guards, accounts, strict=True):
        account.messages += guard.agent.publisher.sent_because
        account.raised += guard.raised
    return accounts, 0.0 if begin is None or end is None else (end - begin) * 1e-9


def _take(account: Account, agent: Agent, monotonic_ns: int, frame: bytes) -> None:
    """Keep a setpoint; frames of other kinds are none."""
    layout = SET_POSITION_TARGET_LOCAL_NED
    if int.from_bytes(frame[7:HEAD_2], "little") != layout.message_id:
        return
    values = layout.unpack(frame[HEAD_2 : HEAD_2 + frame[1]])
    numbers = [float(x) for x in values if isinstance(x, int | float)]
    motion = agent.history.newest
    aim = (agent.phase, motion.revision, motion.start_ns, motion.issuer)
    account.setpoints[monotonic_ns] = Setpoint(tuple(numbers[VELOCITY]), tuple(numbers[ACCELERATION]), aim)
