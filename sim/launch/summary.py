"""What a flight was like: one account for stubs, PX4 and lockstep, from true states and from what was sent.

Errors are computed from the vehicles' true motion (the stubs' or the simulator's), not from what companions believed;
what they believed stands beside it, and is judged where nobody knows the truth (vehicles in the field).
"""

import json
import struct
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from companion.config import FleetConfig
from companion.core.counts import Refusal
from companion.core.events import Event, FailsafeActed, Killed, MotionAdopted, PhaseChanged
from companion.core.monitor import algebraic_connectivity, centroid_error_m, formation_error_m, velocity_error_m_s
from companion.core.trajectory import FleetTrajectory, TrajectoryHistory
from companion.core.values import FLYING_PHASES, Phase
from companion.errors import WireError
from companion.io.recorder import Entry, RecordingError, read_recording
from companion.io.records import TickRecord, TrafficRecord
from companion.vehicle.orders import Order, read_order
from companion.wire.events import decode_event
from companion.wire.mavlink import Px4Mode
from companion.wire.peer import encode_motion

Array = npt.NDArray[Any]
SETTLING_S = 3.0
"""left out of the steady part after forming and after a change of formation"""
WINDOW_S = 10.0
ON_GROUND = 1
ALOFT_M = 0.3
"""a vehicle so far above the lowest place where it was is in the air, whatever its land detector says: PX4 takes what
is disarmed for landed"""
TOUCHDOWN_HEIGHT_M = 0.5
TOUCHDOWN_MAX_M_S = 2.0
"""nobody comes down faster than this over the last TOUCHDOWN_HEIGHT_M: PX4 lands at 0.7 m/s, and a fall from 0.2 m ends
at this"""
SETPOINT_GAP_MAX_S = 0.5
"""half of the COM_OF_LOSS_T of 1.0 s after which the autopilot's failsafe acts"""
COMMANDS_TOLD_MOST = 1000
GAPS_TOLD_MOST = 5
LEFT_FORMATION = frozenset({Phase.IDLE, Phase.RETURNING, Phase.LANDING, Phase.LANDED, Phase.RELEASED})
"""phases with which the steady part ends"""
REFERENCE_HZ = 20.0
BELIEVED_STEP_NS = 100_000_000
BELIEVED = ("formation_error_rms_m", "velocity_error_rms_m_s", "centroid_error_rms_m", "altitude_error_max_m")


@dataclass(frozen=True, slots=True)
class Put:
    """One message of a vehicle to its peers."""

    time_ns: int
    vehicle_id: int
    topic: str
    size: int


@dataclass(slots=True)
class Command:
    """One command of an operator, and what the vehicles answered."""

    time_ns: int
    """when the first vehicle had it"""
    order: Order
    accepted: list[int] = field(default_factory=list)
    refused: dict[int, str] = field(default_factory=dict)
    """vehicle -> why"""
    unanswered: list[int] = field(default_factory=list)
    """whoever had it and ended before its answer"""


@dataclass(slots=True)
class Flight:
    """Everything that is known of one flight. Times are fleet time (UTC, ns)."""

    config: FleetConfig
    seed: int
    truth: Array
    """TRUTH_DTYPE records; none where nobody knows"""
    takeoff_ns: int
    centroid_limit_m: float = 0.5
    """how far the centroid may be from the plan, in truth: an estimator with a GPS of its own is off by more"""
    disarmed: Mapping[int, bool] = field(default_factory=dict)
    """vehicle -> whether its companion said so last; asked where there is no truth"""
    commands: dict[bytes, Command] = field(default_factory=dict)
    """payload -> command; the same bytes again are a retry"""
    commands_unread: int = 0
    """what came as a command and was none"""
    puts: list[Put] = field(default_factory=list)
    events: list[tuple[int, int, Event]] = field(default_factory=list)
    """(time, vehicle, what happened)"""
    ticks: dict[int, Array] = field(default_factory=dict)
    """vehicle -> rows of fleet ns and the fields of TickRecord"""
    traffic: dict[int, Array] = field(default_factory=dict)
    """vehicle -> rows of (fleet ns, bytes sent)"""
    rejected: Counter[str] = field(default_factory=Counter)
    lost: frozenset[int] = frozenset()
    """vehicles whose companion ended in flight"""
    autopilots_lost: Mapping[int, str] = field(default_factory=dict)
    """vehicle -> how its autopilot ended in flight"""
    reference_lateness_ns: Array | None = None
    versions: Mapping[str, str] = field(default_factory=dict)
    unrecorded: dict[int, str] = field(default_factory=dict)
    """vehicle -> what its recording lacks"""

    def read_file(self, vehicle_id: int, path: Path) -> None:
        """Take one companion's recording as far as it is there; what it lacks is told in the summary."""
        try:
            recording = read_recording(path)
            self.read(vehicle_id, recording.entries)
            gaps = list(recording.gaps())
        except RecordingError as error:
            self.unrecorded[vehicle_id] = str(error)
        else:
            if gaps:
                self.unrecorded[vehicle_id] = "; ".join(gap.sentence() for gap in gaps[:GAPS_TOLD_MOST])

    def read(self, vehicle_id: int, entries: Iterable[Entry]) -> None:
        """Take one companion's recording; RecordingError for an entry that cannot be read, all before it is taken."""
        ticks: list[tuple[float, ...]] = []
        traffic: list[tuple[float, ...]] = []
        asked: Command | None = None
        try:
            for entry in entries:
                asked = self._read(vehicle_id, entry, asked, ticks, traffic)
        finally:
            self.ticks[vehicle_id] = np.array(ticks, dtype=float).reshape(-1, 13)
            self.traffic[vehicle_id] = np.array(traffic, dtype=float).reshape(-1, 2)

    def _read(
        self, vehicle_id: int, entry: Entry, asked: Command | None, ticks: list[tuple[float, ...]],
        traffic: list[tuple[float, ...]],
    ) -> Command | None:  # fmt: skip
        """Take one entry; returns the command whose answer comes next."""
        now = entry.instant.fleet_ns
        try:
            match entry.channel:
                case "tick":
                    ticks.append((now, *TickRecord.unpack(entry.body)))
                case "traffic":
                    traffic.append((now, *TrafficRecord.unpack(entry.body)))
                case "event":
                    self.events.append((now, vehicle_id, decode_event(entry.body)))
                case "output/peer":
                    topic, _, payload = entry.body.partition(b"\0")
                    self.puts.append(Put(now, vehicle_id, topic.decode(), len(payload)))
                case "input/command":
                    return self._command(now, vehicle_id, entry.body)
                case "output/answer" if asked is not None:
                    _answer(asked, vehicle_id, entry.body)
        except (struct.error, ValueError, KeyError, TypeError, WireError) as error:
            where = f"vehicle {vehicle_id}'s recording"
            raise RecordingError(where, f"entry {entry.sequence} ({entry.channel}) cannot be read: {error}") from None
        return None

    def _command(self, time_ns: int, vehicle_id: int, payload: bytes) -> Command | None:
        order = read_order(payload, vehicle_id)
        if isinstance(order, Refusal):
            self.commands_unread += 1
            return None
        command = self.commands.setdefault(payload, Command(time_ns, order))
        command.time_ns = min(command.time_ns, time_ns)
        if vehicle_id not in (*command.accepted, *command.refused, *command.unanswered):
            command.unanswered.append(vehicle_id)
        return command

    @property
    def staying(self) -> list[int]:
        """Vehicles whose companions flew to the end."""
        return [v.id for v in self.config.vehicles if v.id not in self.lost]

    def history(self) -> TrajectoryHistory:
        """The motions that most of the vehicles flew by, one of each revision.

        Most, of those whose companions flew to the end: what one vehicle adopted and the others refused is no motion of
        the formation. Of two of one revision that most adopted, the one that wins with every vehicle.
        """
        adopted: dict[bytes, tuple[FleetTrajectory, set[int]]] = {}
        for _, i, event in self.events:
            if isinstance(event, MotionAdopted) and i in self.staying:
                adopted.setdefault(encode_motion(event.motion), (event.motion, set()))[1].add(i)
        best: dict[int, FleetTrajectory] = {0: self.config.first_motion}
        for motion, by in sorted(adopted.values(), key=lambda flown: flown[0].order):
            if 2 * len(by) > len(self.staying):
                best[motion.revision] = motion
        return TrajectoryHistory([best[r] for r in sorted(best)])


def _answer(command: Command, vehicle_id: int, body: bytes) -> None:
    """Keep a vehicle's first answer: a retry gets the same."""
    if vehicle_id not in command.unanswered:
        return
    command.unanswered.remove(vehicle_id)
    said = json.loads(body)
    if said["accepted"]:
        command.accepted.append(vehicle_id)
    else:
        command.refused[vehicle_id] = said["reason"]


@dataclass(frozen=True, slots=True)
class _Truth:
    """Truth over (time, vehicle); where a vehicle's record has not begun or has ended its numbers are NaN."""

    times_ns: Array
    position_ned_m: Array
    velocity_ned_m_s: Array
    mode: Array
    known: npt.NDArray[np.bool_]
    aloft: npt.NDArray[np.bool_]
    flies: npt.NDArray[np.bool_]
    """armed, and aloft by its land detector"""
    down: dict[int, bool]
    """vehicle -> whether it was on the ground and disarmed when its record ended"""
    gap_max_s: float | None
    """longest time without a setpoint in OFFBOARD, of any vehicle; None where the simulator does not tell"""
    touchdown_m_s: float | None
    """largest downward speed just above the ground"""


def summarise(flight: Flight) -> dict[str, Any]:
    """The flight's figures, as summary.json holds them."""
    config = flight.config
    ids = [v.id for v in config.vehicles]
    staying = flight.staying
    truth = _truth(flight.truth, ids)
    times = truth.times_ns
    formed_ns = _formed_ns(flight, staying)
    history = flight.history()
    columns = [ids.index(i) for i in staying]
    known = len(times) > 0
    if known:
        follows = truth.flies & (truth.mode == Px4Mode.OFFBOARD)
        steady = _steady(flight, history, times, formed_ns) & follows[:, columns].all(axis=1)
        seconds = float(steady.sum()) * _step_s(times)
        window = (int(times[steady][0]), int(times[steady][-1])) if steady.any() else (0, 0)
    else:
        grid = _believed_times(flight, ids)
        inside = grid[_steady(flight, history, grid, formed_ns)]
        steady = np.zeros(0, bool)
        seconds = len(inside) * BELIEVED_STEP_NS * 1e-9
        window = (int(inside[0]), int(inside[-1])) if len(inside) else (0, 0)
    figures = _errors(
        history, staying, times[steady], truth.position_ned_m[steady][:, columns],
        truth.velocity_ned_m_s[steady][:, columns],
    )  # fmt: skip
    puts = [p for p in flight.puts if window[0] <= p.time_ns <= window[1] and p.vehicle_id in staying]
    rate = len(puts) / max(len(staying), 1) / seconds if seconds else None
    minimum, minimum_at_s = _minimum_distance(flight.takeoff_ns, truth)
    ticks = [t for i, t in flight.ticks.items() if len(t)]
    believed = _believed(flight, history, staying, formed_ns, window)
    in_window = [t[(t[:, 0] >= window[0]) & (t[:, 0] <= window[1])] for t in ticks]
    every = np.concatenate(in_window) if in_window else np.zeros((0, 13))
    driven = every[every[:, 2] >= 0.0] if len(every) else every
    ended = truth.down if known else {i: flight.disarmed.get(i, False) for i in ids}
    gap = truth.gap_max_s if truth.gap_max_s is not None else _sent_gap_max_s(flight)
    commands = sorted(flight.commands.values(), key=lambda c: (c.time_ns, c.order.id))
    summary: dict[str, Any] = {
        "vehicles": len(ids),
        "judged_by": "truth" if known else "the vehicles' own estimates",
        "formed_after_s": None if formed_ns is None else _round((formed_ns - flight.takeoff_ns) * 1e-9),
        "minimum_distance_m": minimum,
        "minimum_distance_at_s": minimum_at_s,
        "steady": {
            "seconds": _round(seconds),
            **figures,
            "messages_per_vehicle_hz": _round(rate, 5),
            "reduction_vs_20hz_percent": None if rate is None else _round(100.0 * (1.0 - rate / REFERENCE_HZ), 3),
            "payload_bytes_per_vehicle_s": _round(_per_vehicle(sum(p.size for p in puts), staying, seconds)),
            "wire_bytes_per_vehicle_s": _wire_bytes(flight, staying, window),
            "attitude_rate_rms_deg_s": _attitude_rate(flight.truth, window),
        },
        "believed": {
            **{k: believed[k] for k in BELIEVED},
            "slot_error_rms_m": _round(_rms(every[:, 4])) if len(every) else None,
            "minimum_distance_m": _believed_minimum_m(flight, ids),
            "nearest_neighbour_m": _round(float(every[:, 5].min())) if len(every) else None,
        },
        "setpoint_rate_hz": _round(_per_vehicle(float(every[:, 6].sum()), ids, seconds)) if len(every) else None,
        "setpoint_gap_max_s": _round(gap),
        "loop_lateness_ms": _percentiles(every[:, 1]),
        "latency_ms": _percentiles(driven[:, 2]),
        "reference_lateness_ms": _percentiles(flight.reference_lateness_ns),
        "cpu_per_tick_ms": _cpu_per_tick(in_window),
        "landed": ended,
        "touchdown_max_m_s": _round(truth.touchdown_m_s),
        "killed": {i: e.cause.value for _, i, e in flight.events if isinstance(e, Killed)},
        "unrecorded": dict(flight.unrecorded),
        "lost": sorted(flight.lost),
        "autopilots_lost": dict(flight.autopilots_lost),
        "failsafes": [f"vehicle {i}: {e.sentence}" for _, i, e in flight.events if isinstance(e, FailsafeActed)],
        "commands": [_told(c, flight.takeoff_ns) for c in commands[:COMMANDS_TOLD_MOST]],
        "commands_left_out": flight.commands_unread + max(len(commands) - COMMANDS_TOLD_MOST, 0),
        "rejected": dict(flight.rejected),
        "control_rate_hz": config.limits.control_rate_hz,
        "seed": flight.seed,
        "versions": dict(flight.versions),
    }
    summary["criteria"] = _criteria(summary, config, flight.centroid_limit_m)
    return {"passed": all(c["met"] for c in summary["criteria"]), **summary}


def _told(command: Command, takeoff_ns: int) -> dict[str, Any]:
    order = command.order
    return {
        "at_s": _round((command.time_ns - takeoff_ns) * 1e-9),
        "verb": order.verb,
        "id": order.id,
        "issuer": order.issuer,
        "accepted": sorted(command.accepted),
        "refused": dict(sorted(command.refused.items())),
        "unanswered": sorted(command.unanswered),
    }


def _truth(records: Array, ids: Sequence[int]) -> _Truth:
    """Truth as arrays over (time, vehicle): at the times of the vehicle that was recorded longest, and of the others
    before and after it, so that nobody's end hides what the rest does.

    Simulators tell their vehicles' states at times of their own: motion is interpolated, the rest is the latest.
    """
    rows = {i: records[records["vehicle_id"] == i] for i in ids} if len(records) else {}
    rows = {i: mine[np.argsort(mine["time_unix_ns"], kind="stable")] for i, mine in rows.items() if len(mine) > 1}
    if not rows:
        none = np.zeros((0, len(ids)))
        never = none.astype(bool)
        return _Truth(
            none[:, 0], np.zeros((0, len(ids), 3)), np.zeros((0, len(ids), 3)), none, *(never,) * 3, {}, None, None
        )
    times = max(rows.values(), key=lambda mine: mine["time_unix_ns"][-1] - mine["time_unix_ns"][0])["time_unix_ns"]
    for mine in rows.values():
        own = mine["time_unix_ns"]
        times = np.concatenate([own[own < times[0]], times, own[own > times[-1]]])
    shape = (len(times), len(ids))
    position, velocity = (np.full((*shape, 3), np.nan) for _ in range(2))
    mode, armed, landed = (np.zeros(shape, np.int64) for _ in range(3))
    motion: tuple[tuple[Array, str], ...] = ((position, "position_ned_m"), (velocity, "velocity_ned_m_s"))
    state: tuple[tuple[Array, str], ...] = ((mode, "custom_mode"), (armed, "armed"), (landed, "landed_state"))
    known = np.zeros(shape, bool)
    for k, i in enumerate(ids):
        if (mine := rows.get(i)) is None:
            continue
        own = mine["time_unix_ns"]
        inside = known[:, k] = (times >= own[0]) & (times <= own[-1])
        for values, name in motion:
            for axis in range(3):
                values[inside, k, axis] = np.interp(times[inside], own, mine[name][:, axis].astype(float))
        latest = mine[np.searchsorted(own, times[inside], side="right") - 1]
        for values, name in state:
            values[inside, k] = latest[name]
    with np.errstate(invalid="ignore"):
        height = np.nanmax(np.where(known, position[:, :, 2], -np.inf), axis=0) - position[:, :, 2]
        detected = known & (landed != ON_GROUND)
        aloft = detected | (known & (height > ALOFT_M))
    gaps = [float(mine["setpoint_gap_max_s"].max()) for mine in rows.values()]
    return _Truth(
        times, position, velocity, mode, known, aloft, detected & (armed != 0),
        {i: i in rows and bool(rows[i]["armed"][-1] == 0 and rows[i]["landed_state"][-1] == ON_GROUND) for i in ids},
        max(gaps) if np.isfinite(gaps).all() else None,
        max(_touchdown_m_s(mine) for mine in rows.values()),
    )  # fmt: skip


def _touchdown_m_s(mine: Array) -> float:
    """Largest downward speed within TOUCHDOWN_HEIGHT_M of the lowest place of one vehicle's record."""
    down = mine["position_ned_m"][:, 2].astype(float)
    low = down > down.max() - TOUCHDOWN_HEIGHT_M
    return max(float(mine["velocity_ned_m_s"][low, 2].max()), 0.0)


def _sent_gap_max_s(flight: Flight) -> float | None:
    """Longest time between two setpoints that companions sent while they steered; None if nobody did."""
    longest = 0.0
    for i, rows in flight.ticks.items():
        sent = rows[rows[:, 6] > 0.0, 0]
        ends = [
            t for t, k, e in flight.events if k == i and isinstance(e, PhaseChanged) and e.after not in FLYING_PHASES
        ]
        for k in np.argsort(-np.diff(sent)):
            before, after = sent[k], sent[k + 1]
            if not any(before <= t <= after for t in ends):
                longest = max(longest, float(after - before) * 1e-9)
                break
    return longest or None


def _formed_ns(flight: Flight, staying: Sequence[int]) -> int | None:
    """When the last vehicle first reported that it had formed."""
    first: dict[int, int] = {}
    for time_ns, i, event in flight.events:
        if isinstance(event, PhaseChanged) and event.after is Phase.FORMED:
            first[i] = min(time_ns, first.get(i, time_ns))
    return max(first[i] for i in staying) if staying and all(i in first for i in staying) else None


def _steady(flight: Flight, history: TrajectoryHistory, times: Array, formed_ns: int | None) -> npt.NDArray[np.bool_]:
    """Where all that stayed are formed and not changing their formation."""
    if formed_ns is None or not len(times):
        return np.zeros(len(times), bool)
    steady = times >= formed_ns + round(SETTLING_S * 1e9)
    left = [
        t
        for t, i, event in flight.events
        if isinstance(event, PhaseChanged) and event.after in LEFT_FORMATION and t > formed_ns and i not in flight.lost
    ]
    if left:
        steady &= times < min(left)
    for motion in history.motions[1:]:
        if motion.blend_start_ns == motion.start_ns:
            steady &= (times < motion.start_ns) | (times > motion.blend_end_ns + round(SETTLING_S * 1e9))
    return np.asarray(steady, bool)


def _errors(
    history: TrajectoryHistory, ids: Sequence[int], times: Array, position: Array, velocity: Array
) -> dict[str, Any]:
    names = ("formation_error_rms_m", "velocity_error_rms_m_s", "centroid_error_rms_m")
    if not len(times):
        return {**dict.fromkeys(names), "altitude_error_max_m": None, "lambda2_min": None, "windows": []}
    formation, consensus, centroid, altitude = [], [], [], []
    for t, p, v in zip(times, position, velocity, strict=True):
        motion = history.at(int(t))
        moment = motion.state_at(int(t))
        slots = [moment.slot(motion.slots[i]) for i in ids]
        p_ref = np.array([s.position_ned_m for s in slots])
        v_ref = np.array([s.velocity_ned_m_s for s in slots])
        formation.append(np.square(formation_error_m(p, p_ref)).mean())
        consensus.append(np.square(velocity_error_m_s(v, v_ref)).mean())
        centroid.append(centroid_error_m(p, p_ref) ** 2)
        altitude.append(np.abs(p[:, 2] - p_ref[:, 2]).max())
    windows = []
    start = int(times[0])
    for k in range(int((times[-1] - start) * 1e-9 / WINDOW_S) + 1):
        inside = (times >= start + k * WINDOW_S * 1e9) & (times < start + (k + 1) * WINDOW_S * 1e9)
        if inside.sum() > 1:
            windows.append(
                {
                    "from_s": k * WINDOW_S,
                    "formation_error_rms_m": _round(float(np.sqrt(np.array(formation)[inside].mean()))),
                    "velocity_error_rms_m_s": _round(float(np.sqrt(np.array(consensus)[inside].mean()))),
                }
            )
    return {
        **{n: _round(float(np.sqrt(np.mean(x)))) for n, x in zip(names, (formation, consensus, centroid), strict=True)},
        "altitude_error_max_m": _round(float(np.max(altitude))),
        "lambda2_min": _round(min(algebraic_connectivity(p, 100.0) for p in position[:: max(len(position) // 20, 1)])),
        "windows": windows,
    }


def _believed_times(flight: Flight, ids: Sequence[int]) -> Array:
    """Ten times a second while every companion has ticked since the take-off."""
    rows = [flight.ticks.get(i, np.zeros((0, 13))) for i in ids]
    if not rows or not all(len(r) for r in rows):
        return np.zeros(0, np.int64)
    begin = max(flight.takeoff_ns, *(int(r[0, 0]) for r in rows))
    return np.arange(begin, min(int(r[-1, 0]) for r in rows), BELIEVED_STEP_NS, dtype=np.int64)


def _believed_motion(flight: Flight, ids: Sequence[int], times: Array, first: int) -> Array:
    """Positions (first 7) or velocities (10) as the companions have them, over (time, vehicle, axis)."""
    if not len(times):
        return np.zeros((0, len(ids), 3))
    rows = [flight.ticks[i] for i in ids]
    return np.stack(
        [np.stack([np.interp(times, r[:, 0], r[:, first + k]) for k in range(3)], axis=1) for r in rows], axis=1
    )


def _believed(
    flight: Flight, history: TrajectoryHistory, ids: Sequence[int], formed_ns: int | None, window: tuple[int, int]
) -> dict[str, Any]:
    """The same errors as the companions' own estimates have them."""
    times = _believed_times(flight, ids)
    times = times[_steady(flight, history, times, formed_ns) & (times >= window[0]) & (times <= window[1])]
    motion = (_believed_motion(flight, ids, times, first) for first in (7, 10))
    return _errors(history, ids, times, *motion)


def _believed_minimum_m(flight: Flight, ids: Sequence[int]) -> float | None:
    """Smallest distance of any pair from the take-off on, by their own estimates."""
    p = _believed_motion(flight, ids, _believed_times(flight, ids), 7)
    i, j = np.triu_indices(len(ids), 1)
    distance = np.linalg.norm(p[:, i] - p[:, j], axis=2)
    return _round(float(distance.min())) if distance.size else None


def _attitude_rate(truth: Array, window: tuple[int, int]) -> float | None:
    """RMS of roll and pitch rate together (deg/s); None where the simulator does not tell."""
    inside = truth[(truth["time_unix_ns"] >= window[0]) & (truth["time_unix_ns"] <= window[1])]
    rates = inside["attitude_rate_rad_s"].astype(float)
    return _round(float(np.degrees(_rms(rates)))) if len(rates) and np.isfinite(rates).all() else None


def _minimum_distance(takeoff_ns: int, truth: _Truth) -> tuple[float | None, float | None]:
    """Smallest true distance of any pair of which one is in the air, and when (s after take-off)."""
    best, best_at = None, None
    times, position, aloft = truth.times_ns, truth.position_ned_m, truth.aloft
    i, j = np.triu_indices(position.shape[1], 1)
    for start in range(0, len(times), 500):
        part = slice(start, start + 500)
        distance = np.linalg.norm(position[part][:, i] - position[part][:, j], axis=2)
        judged = (aloft[part][:, i] | aloft[part][:, j]) & np.isfinite(distance)
        distance = np.where(judged & (times[part] >= takeoff_ns)[:, None], distance, np.inf)
        if distance.size and np.isfinite(distance.min()) and (best is None or distance.min() < best):
            best = float(distance.min())
            best_at = float(times[part][int(distance.min(axis=1).argmin())] - takeoff_ns) * 1e-9
    return _round(best), _round(best_at)


def _wire_bytes(flight: Flight, ids: Sequence[int], window: tuple[int, int]) -> float | None:
    """Bytes a vehicle a second, from the counters told each second: between two of them they are taken to rise evenly,
    so that a window shorter than their distance has a figure too."""
    rates = []
    for i in ids:
        rows = flight.traffic.get(i)
        if rows is not None and len(rows) > 1:
            begin, end = max(window[0], rows[0, 0]), min(window[1], rows[-1, 0])
            if end > begin:
                sent = np.interp([begin, end], rows[:, 0], rows[:, 1])
                rates.append((sent[1] - sent[0]) / ((end - begin) * 1e-9))
    return _round(float(np.mean(rates))) if rates else None


def _cpu_per_tick(rows: Sequence[Array]) -> float | None:
    """Mean over the vehicles of the whole process's CPU time per control tick (ms)."""
    costs = [(t[-1, 3] - t[0, 3]) / (len(t) - 1) * 1e-6 for t in rows if len(t) > 1]
    return _round(float(np.mean(costs))) if costs else None


def _percentiles(nanoseconds: Array | None) -> dict[str, float | None]:
    if nanoseconds is None or not len(nanoseconds):
        return {"p50": None, "p99": None, "max": None}
    p50, p99, most = np.percentile(nanoseconds * 1e-6, (50, 99, 100))
    return {"p50": _round(float(p50)), "p99": _round(float(p99)), "max": _round(float(most))}


def _per_vehicle(total: float, ids: Sequence[int], seconds: float) -> float | None:
    return total / len(ids) / seconds if ids and seconds else None


def _rms(values: Array) -> float:
    return float(np.sqrt(np.square(values).mean()))


def _step_s(times: Array) -> float:
    return float(np.median(np.diff(times))) * 1e-9 if len(times) > 1 else 0.0


def _round(value: float | None, digits: int = 4) -> float | None:
    return None if value is None else round(value, digits)


def _criteria(summary: Mapping[str, Any], config: FleetConfig, centroid_limit_m: float) -> list[dict[str, Any]]:
    """What a flight must meet to count as passed."""
    source = "steady" if summary["judged_by"] == "truth" else "believed"
    distance = "minimum_distance_m" if source == "steady" else "believed.minimum_distance_m"
    nearest = (summary if source == "steady" else summary["believed"])["minimum_distance_m"]
    spacing = config.formation.spacing_m
    rows: list[tuple[str, Any, str, float]] = [
        *([(distance, nearest, ">=", 0.3 * spacing)] if len(config.vehicles) > 1 else []),
        (f"{source}.formation_error_rms_m", summary[source]["formation_error_rms_m"], "<=", 0.075 * spacing),
        (f"{source}.centroid_error_rms_m", summary[source]["centroid_error_rms_m"], "<=", centroid_limit_m),
        ("setpoint_gap_max_s", summary["setpoint_gap_max_s"], "<=", SETPOINT_GAP_MAX_S),
        *([("touchdown_max_m_s", summary["touchdown_max_m_s"], "<=", TOUCHDOWN_MAX_M_S)] if source == "steady" else []),
        ("failsafes", len(summary["failsafes"]), "<=", 0),
        ("vehicles killed", len(summary["killed"]), "<=", 0),
        ("autopilots lost", len(summary["autopilots_lost"]), "<=", 0),
        ("vehicles not landed and disarmed", sum(not x for x in summary["landed"].values()), "<=", 0),
        ("recordings not whole", len(summary["unrecorded"]), "<=", 0),
        ("companions lost", len(summary["lost"]), "<=", 0),
    ]
    return [
        {
            "what": what,
            "value": value,
            "limit": f"{relation} {limit:g}",
            "met": value is not None and (value >= limit if relation == ">=" else value <= limit),
        }
        for what, value, relation, limit in rows
    ]
