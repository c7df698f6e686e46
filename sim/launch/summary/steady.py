"""The part of a flight that its errors are taken over, and the errors: from the slots that the plan gives."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from companion.config import FleetConfig
from companion.core.events import PhaseChanged
from companion.core.neighbours.graph import among, connectivity, mutual_nearest
from companion.core.trajectory.fleet import FleetTrajectory
from companion.core.trajectory.history import TrajectoryHistory
from companion.core.values import Phase
from sim.launch.summary.flight import Array, Flight
from sim.launch.summary.numbers import rounded, step_s
from sim.measures import algebraic_connectivity, centroid_error_m, formation_error_m, velocity_error_m_s

SETTLING_S = 3.0
"""left out of the steady part after forming and after a change of formation"""
WINDOW_S = 10.0
HELD_S, SAMPLED_S = 2.0, 0.1
"""shape and place count once they have held for HELD_S; looked at so often"""
LEFT_FORMATION = frozenset({Phase.IDLE, Phase.RETURNING, Phase.LANDING, Phase.LANDED, Phase.RELEASED})
"""phases with which the steady part ends"""


def formed_ns(flight: Flight, staying: Sequence[int]) -> int | None:
    """When the last vehicle first reported that it had formed."""
    first: dict[int, int] = {}
    for time_ns, i, event in flight.events:
        if isinstance(event, PhaseChanged) and event.after is Phase.FORMED:
            first[i] = min(time_ns, first.get(i, time_ns))
    return max(first[i] for i in staying) if staying and all(i in first for i in staying) else None


def formed_apart(
    flight: Flight, history: TrajectoryHistory, ids: Sequence[int], times: Array, position: Array,
    limits: tuple[float, float],
) -> dict[str, float | None]:  # fmt: skip
    """When the formation had its shape, and when it was at its place (s after the take-off command), each for HELD_S.

    `position` over (time, vehicle, axis), of times at which all fly by setpoints; `limits`: of the formation's error
    about its centroid and of the centroid's own (m). A wind may carry off a formation whose shape stands. None: never.
    """
    begin = history.motions[1].blend_end_ns if len(history.motions) > 1 else None
    found: dict[str, float | None] = {"shape_formed_after_s": None, "place_taken_after_s": None}
    if begin is None or len(times) < 2:
        return found
    step = max(round(SAMPLED_S / max(step_s(times), 1e-3)), 1)
    sampled = [k for k in range(0, len(times), step) if times[k] >= begin]
    errors = []
    for k in sampled:
        motion = history.at(int(times[k]))
        if motion.free_at(int(times[k])):
            return found
        state = motion.state_at(int(times[k]))
        slots = np.array([state.slot(motion.slots[i]).position_ned_m for i in ids])
        shape_m = float(np.sqrt(np.square(formation_error_m(position[k], slots)).mean()))
        errors.append((shape_m, centroid_error_m(position[k], slots)))
    for (name, which), limit in zip((("shape_formed_after_s", 0), ("place_taken_after_s", 1)), limits, strict=True):
        since: int | None = None
        for k, error in zip(sampled, errors, strict=True):
            since = None if not error[which] <= limit else k if since is None else since
            if since is not None and (times[k] - times[since]) * 1e-9 >= HELD_S:
                found[name] = rounded((int(times[since]) - flight.takeoff_ns) * 1e-9)
                break
    return found


def steady_at(flight: Flight, history: TrajectoryHistory, times: Array, formed: int | None) -> npt.NDArray[np.bool_]:
    """Where all that stayed are formed and not changing their formation."""
    if formed is None or not len(times):
        return np.zeros(len(times), bool)
    steady = times >= formed + round(SETTLING_S * 1e9)
    left = [
        t
        for t, i, event in flight.events
        if isinstance(event, PhaseChanged) and event.after in LEFT_FORMATION and t > formed and i not in flight.lost
    ]
    if left:
        steady &= times < min(left)
    for motion in history.motions[1:]:
        if motion.blend_start_ns == motion.start_ns:
            steady &= (times < motion.start_ns) | (times > motion.blend_end_ns + round(SETTLING_S * 1e9))
    return np.asarray(steady, bool)


def errors_from_slots(
    config: FleetConfig, history: TrajectoryHistory, ids: Sequence[int], times: Array, position: Array, velocity: Array
) -> dict[str, Any]:
    """Errors of formation, velocity, centroid and altitude; positions and velocities over (time, vehicle, axis).

    Where no motion is shared the centroid has no place to be at: it counts where one is (None: never).
    """
    names = ("formation_error_rms_m", "velocity_error_rms_m_s", "centroid_error_rms_m")
    if not len(times):
        return {**dict.fromkeys(names), "altitude_error_max_m": None, "lambda2_min": None, "windows": []}
    formation, consensus, centroid, altitude = [], [], [], []
    for t, p, v in zip(times, position, velocity, strict=True):
        motion = history.at(int(t))
        state = motion.state_at(int(t))
        slots = [state.slot(motion.slots[i]) for i in ids]
        p_ref = np.array([s.position_ned_m for s in slots])
        v_ref = np.array([s.velocity_ned_m_s for s in slots])
        formation.append(np.square(formation_error_m(p, p_ref)).mean())
        consensus.append(np.square(velocity_error_m_s(v, v_ref)).mean())
        if not motion.free_at(int(t)):
            centroid.append(centroid_error_m(p, p_ref) ** 2)
        altitude.append(np.abs(p[:, 2] - p_ref[:, 2]).max())
    step = max(len(position) // 20, 1)
    windows = []
    start = int(times[0])
    for k in range(int((times[-1] - start) * 1e-9 / WINDOW_S) + 1):
        inside = (times >= start + k * WINDOW_S * 1e9) & (times < start + (k + 1) * WINDOW_S * 1e9)
        if inside.sum() > 1:
            windows.append(
                {
                    "from_s": k * WINDOW_S,
                    "formation_error_rms_m": rounded(float(np.sqrt(np.array(formation)[inside].mean()))),
                    "velocity_error_rms_m_s": rounded(float(np.sqrt(np.array(consensus)[inside].mean()))),
                }
            )
    return {
        **{
            n: rounded(float(np.sqrt(np.mean(x)))) if x else None
            for n, x in zip(names, (formation, consensus, centroid), strict=True)
        },
        "altitude_error_max_m": rounded(float(np.max(altitude))),
        "lambda2_min": rounded(
            min(
                connectivity_at(config, history.at(int(times[k])), ids, position[k]) for k in range(0, len(times), step)
            )
        ),
        "windows": windows,
    }


def connectivity_at(config: FleetConfig, motion: FleetTrajectory, ids: Sequence[int], position: Array) -> float:
    """lambda_2 of the graph in use: of who heeds whom, by places or by slots."""
    match config.neighbours:
        case "nearest":
            after = {i: change.after for i, change in motion.slots.items()}
            return connectivity(among(mutual_nearest(after, config.peers.nearest), set(ids))).lambda2
        case "all":
            return algebraic_connectivity(position, np.inf)
    return algebraic_connectivity(position, config.peers.range_m)
