"""Flights in lockstep for the tests: how they are set up, and what is true of them afterwards."""

import json
import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pymavlink.dialects.v20 import development as dialect

from companion.config import FleetConfig, load
from companion.core.trajectory.history import TrajectoryHistory
from companion.core.values import Instant, Phase
from companion.io.recording import Entry
from companion.wire.operator import encode
from sim.lockstep.clockwork import UTC_AT_START_NS
from sim.lockstep.lockstep import Lockstep
from sim.lockstep.network import NetworkParameters

DEFAULT = Path(__file__).resolve().parents[2] / "fleet.toml"
READY_S = 3.0
"""after this every autopilot is ready"""
Array = npt.NDArray[Any]


def fleet(
    count: int,
    *,
    altitude_m: float = 3.0,
    legs: Sequence[dict[str, object]] = (),
    shape: str = "v",
    change: Callable[[dict[str, Any]], None] | None = None,
) -> FleetConfig:
    """The default fleet.toml with fewer vehicles, low, on a short plan."""

    def edit(tables: dict[str, Any]) -> None:
        del tables["fence"]  # long plans, high take-offs; who tests the fence sets one
        tables["vehicle"] = tables["vehicle"][:count]
        tables["formation"].update(altitude_m=altitude_m, shape=shape)
        tables["plan"]["legs"] = list(legs)
        if change is not None:
            change(tables)

    return load(DEFAULT, edit)


def straight(seconds: float, speed_m_s: float = 1.0) -> list[dict[str, object]]:
    return [{"kind": "velocity", "north_m_s": speed_m_s, "duration_s": seconds}]


@dataclass
class Tape:
    """What went in and out of the agents: a digest of everything, the entries of some."""

    keep: frozenset[int] = frozenset()
    entries: dict[int, list[Entry]] = field(default_factory=dict)
    digest: Any = field(default_factory=lambda: blake2b(digest_size=16))
    setpoints: int = 0
    _parsers: dict[int, Any] = field(default_factory=dict)

    def __call__(self, i: int, channel: str, now: Instant, body: bytes) -> None:
        self.digest.update(f"{i} {channel} {now.monotonic_ns} {now.fleet_ns} {len(body)} ".encode() + body)
        if i in self.keep:
            self.entries.setdefault(i, []).append(Entry(channel, now, body))


def launch(
    config: FleetConfig,
    seed: int = 1,
    network: NetworkParameters | None = None,
    record: Callable[[int, str, Instant, bytes], None] | None = None,
) -> Lockstep:
    """A fleet that has just accepted its take-off."""
    ls = Lockstep(config, seed=seed, network=network or NetworkParameters(), record=record)
    ls.run_until(READY_S)
    ls.run_until_ready(READY_S + 10.0)
    answers = [json.loads(a) for a in ls.command(b'{"verb":"takeoff"}').values()]
    assert all(a["accepted"] for a in answers), answers
    return ls


def until(ls: Lockstep, limit_s: float, done: Callable[[], bool]) -> None:
    """Let time pass until something is so; it must be within `limit_s` from now."""
    ls.run_until(ls.now_ns * 1e-9 + limit_s, done)
    assert done(), (ls.phases(), [n for n in ls.notes if "failsafe" in n[2]])


def wait(ls: Lockstep, seconds: float) -> None:
    ls.run_until(ls.now_ns * 1e-9 + seconds)


def until_formed(ls: Lockstep, limit_s: float = 60.0) -> None:
    until(ls, limit_s, lambda: ls.all_in(Phase.FORMED))


def until_landed(ls: Lockstep, limit_s: float = 60.0) -> None:
    until(ls, limit_s, lambda: ls.all_in(Phase.LANDED))


@dataclass(frozen=True)
class Truth:
    """True motion over time: times shape (t,), the rest (t, vehicle, ...)."""

    times_ns: Array
    ids: list[int]
    position_ned_m: Array
    velocity_ned_m_s: Array
    armed: Array
    landed_state: Array
    mode: Array

    def column(self, i: int) -> int:
        return self.ids.index(i)


def truth(ls: Lockstep, from_s: float = 0.0, to_s: float = 1e9) -> Truth:
    ids = list(ls.vehicles)
    rows = ls.truth().reshape(-1, len(ids))
    seconds = (rows["time_unix_ns"][:, 0] - UTC_AT_START_NS) * 1e-9
    rows = rows[(seconds >= from_s) & (seconds < to_s)]
    return Truth(
        rows["time_unix_ns"][:, 0], ids, rows["position_ned_m"], rows["velocity_ned_m_s"], rows["armed"],
        rows["landed_state"], rows["custom_mode"],
    )  # fmt: skip


def distances(t: Truth, ids: Iterable[int] | None = None) -> Array:
    """Distance of every pair (t, pairs) of the vehicles named."""
    columns = [t.column(i) for i in (ids or t.ids)]
    p = t.position_ned_m[:, columns]
    a, b = np.triu_indices(len(columns), 1)
    return np.asarray(np.linalg.norm(p[:, a] - p[:, b], axis=2))


def errors(ls: Lockstep, t: Truth, ids: Iterable[int], history: TrajectoryHistory | None = None) -> tuple[Array, Array]:
    """Formation error about the centroid and the centroid's error against the plan (m), over time."""
    chosen = list(ids)
    columns = [t.column(i) for i in chosen]
    plan = history or ls.vehicles[chosen[0]].agent.history
    formation, centroid = [], []
    for time_ns, p in zip(t.times_ns, t.position_ned_m[:, columns], strict=True):
        motion = plan.at(int(time_ns))
        moment = motion.state_at(int(time_ns))
        e = p - np.array([moment.slot(motion.slots[i]).position_ned_m for i in chosen])
        formation.append(np.sqrt(np.square(e - e.mean(axis=0)).sum(axis=1).mean()))
        centroid.append(np.linalg.norm(e.mean(axis=0)))
    return np.array(formation), np.array(centroid)


def first(ls: Lockstep, text: str, i: int | None = None) -> float:
    """When a note with that text came first (s)."""
    return next(s for s, vehicle, note in ls.notes if text in note and i in (None, vehicle))


def last(ls: Lockstep, text: str) -> float:
    """When a note with that text came last (s)."""
    return max(s for s, _, note in ls.notes if text in note)


def failsafes(ls: Lockstep) -> list[tuple[int, str]]:
    return [(i, note) for _, i, note in ls.notes if note.startswith("failsafe")]


GROUND_STATION: Any = dialect.MAVLink(None, srcSystem=255, srcComponent=190)


def set_parameter(ls: Lockstep, i: int, name: str, value: float | int) -> None:
    """A ground station's PARAM_SET to one autopilot; an int as INT32."""
    whole = isinstance(value, int)
    wire_value = struct.unpack("<f", struct.pack("<i", value))[0] if whole else value
    message = dialect.MAVLink_param_set_message(i, 1, name.encode(), wire_value, 6 if whole else 9)
    ls.vehicles[i].autopilot.receive(bytes(message.pack(GROUND_STATION)), ls.now_ns)


def parse(datagram: bytes) -> Any:
    messages = dialect.MAVLink(None).parse_buffer(bytearray(datagram))
    assert messages is not None
    assert len(messages) == 1
    return messages[0]


def check_setpoint(datagram: bytes, config: FleetConfig) -> bool:
    """Whether a datagram is a setpoint; if so it must be finite and within the limits."""
    if datagram[7:10] != b"\x54\x00\x00":
        return False
    m = parse(datagram)
    limits = config.limits
    numbers = (m.x, m.y, m.z, m.vx, m.vy, m.vz, m.afx, m.afy, m.afz, m.yaw, m.yaw_rate)
    assert np.isfinite(numbers).all(), numbers
    assert np.hypot(m.afx, m.afy) <= limits.avoidance_acceleration_m_s2 * (1 + 1e-6), numbers
    assert -limits.climb_max_m_s * (1 + 1e-6) <= m.vz <= limits.descent_max_m_s * (1 + 1e-6), numbers
    return True


class InLockstep:
    """The operator's link into a fleet in lockstep."""

    def __init__(self, ls: Lockstep) -> None:
        self.ls = ls

    def ask(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, tuple[bytes, ...]]:
        if kind == "command":
            answers = self.ls.command(payload, *vehicle_ids)
        else:
            answers = {i: encode(v.agent.status(self.ls.now)) for i, v in self.ls.vehicles.items() if v.alive}
        return {i: (answers[i],) if i in answers else () for i in vehicle_ids}

    def wait(self, seconds: float) -> None:
        self.ls.run_until(self.ls.now_ns * 1e-9 + seconds)
