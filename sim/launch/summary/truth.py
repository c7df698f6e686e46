"""The true motion of the vehicles, as the stubs or the simulator tell it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from companion.wire.mavlink import ON_GROUND
from sim.launch.summary.flight import Array
from sim.launch.summary.numbers import rms, rounded

ALOFT_M = 0.3
"""a vehicle so far above the lowest place where it was is in the air, whatever its land detector says: PX4 takes what
is disarmed for landed"""
TOUCHDOWN_HEIGHT_M = 0.5


@dataclass(frozen=True, slots=True)
class Truth:
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


def truth_of(records: Array, ids: Sequence[int]) -> Truth:
    """Truth as arrays over (time, vehicle): at the times of the vehicle that was recorded longest, and of the others
    before and after it, so that nobody's end hides what the rest does.

    Simulators tell their vehicles' states at times of their own: motion is interpolated, the rest is the latest.
    """
    rows = {i: records[records["vehicle_id"] == i] for i in ids} if len(records) else {}
    rows = {i: mine[np.argsort(mine["time_unix_ns"], kind="stable")] for i, mine in rows.items() if len(mine) > 1}
    if not rows:
        none = np.zeros((0, len(ids)))
        never = none.astype(bool)
        return Truth(
            np.zeros(0), np.zeros((0, len(ids), 3)), np.zeros((0, len(ids), 3)), none, *(never,) * 3, {}, None, None
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
    return Truth(
        times, position, velocity, mode, known, aloft, detected & (armed != 0),
        {i: i in rows and bool(rows[i]["armed"][-1] == 0 and rows[i]["landed_state"][-1] == ON_GROUND) for i in ids},
        max(gaps) if np.isfinite(gaps).all() else None,
        max(touchdown_m_s(mine) for mine in rows.values()),
    )  # fmt: skip


def touchdown_m_s(mine: Array) -> float:
    """Largest downward speed within TOUCHDOWN_HEIGHT_M of the lowest place of one vehicle's record."""
    down = mine["position_ned_m"][:, 2].astype(float)
    low = down > down.max() - TOUCHDOWN_HEIGHT_M
    return max(float(mine["velocity_ned_m_s"][low, 2].max()), 0.0)


def minimum_distance(takeoff_ns: int, truth: Truth) -> tuple[float | None, float | None]:
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
    return rounded(best), rounded(best_at)


def attitude_rate_deg_s(truth: Array, window: tuple[int, int]) -> float | None:
    """RMS of roll and pitch rate together (deg/s); None where the simulator does not tell."""
    inside = truth[(truth["time_unix_ns"] >= window[0]) & (truth["time_unix_ns"] <= window[1])]
    rates = inside["attitude_rate_rad_s"].astype(float)
    return rounded(float(np.degrees(rms(rates)))) if len(rates) and np.isfinite(rates).all() else None
