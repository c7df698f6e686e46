"""What a report draws: motion, errors, distances and messages of one flight over time."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from companion.core.trajectory.history import TrajectoryHistory
from companion.io.transport import STATE_TOPIC
from sim.launch.summary.believed import motion_of, times_of
from sim.launch.summary.flight import POSITION, Flight
from sim.launch.summary.steady import connectivity_at
from sim.launch.summary.truth import truth_of
from sim.measures import centroid_error_m, formation_error_m

Floats = npt.NDArray[np.float64]
CLOSEST_PAIRS = 3
HEARTBEAT_SHARE = 0.8
"""of the longest silence: whoever speaks after so much of it speaks since it is over (it has up to 20 % of jitter)"""
CONNECTIVITY_POINTS = 120


@dataclass(frozen=True, slots=True)
class Pair:
    """Two vehicles' distance over time."""

    ids: tuple[int, int]
    distance_m: Floats
    """shape (T,); NaN where one of them is not known"""

    @property
    def least_m(self) -> float:
        """The smallest; infinite where it never was known."""
        known = self.distance_m[np.isfinite(self.distance_m)]
        return float(known.min()) if len(known) else float("inf")


@dataclass(frozen=True, slots=True)
class Series:
    """Everything over `times_s` (shape (T,), seconds since take-off); positions NED in the fleet frame."""

    ids: list[int]
    true: bool
    """whether the motion is a simulator's truth; else the vehicles' own estimates"""
    times_s: Floats
    position_m: Floats
    """shape (T, N, 3)"""
    slots_m: Floats
    """wanted places, shape (T, N, 3)"""
    formation_error_m: Floats
    """RMS over the vehicles, about the centroid, shape (T,)"""
    centroid_error_m: Floats
    closest: list[Pair]
    """the pairs that came closest after take-off, closest first"""
    nearest_m: Floats
    """smallest distance of any pair, shape (T,)"""
    lambda2_s: Floats
    lambda2: Floats
    """algebraic connectivity of the graph in use, and its times"""
    messages_s: dict[int, Floats]
    """vehicle -> when it told its state"""
    after_silence: dict[int, npt.NDArray[np.bool_]]
    """vehicle -> which of them came since the longest silence was over"""
    lateness: dict[int, tuple[Floats, Floats]]
    """vehicle -> times of its control ticks and how late each was (ms)"""


def series_of(flight: Flight) -> Series:
    """The series of a flight at ten times a second, while every companion ticks that flew to the end; where none did,
    of all that flew."""
    ids = flight.staying or [i for i, rows in sorted(flight.ticks.items()) if len(rows)]
    history = flight.history()
    times = times_of(flight, ids)
    truth = truth_of(flight.truth, ids)
    known = len(truth.times_ns) > 0
    if known:
        inside = (times >= truth.times_ns[0]) & (times <= truth.times_ns[-1])
        times = times[inside]
        position = np.full((len(times), len(ids), 3), np.nan)
        for k, axis in np.ndindex(len(ids), 3):
            position[:, k, axis] = np.interp(times, truth.times_ns, truth.position_ned_m[:, k, axis])
    else:
        position = motion_of(flight, ids, times, POSITION)
    slots = _slots(history, ids, times)
    pairs = [
        Pair((a, b), np.linalg.norm(position[:, j] - position[:, k], axis=1))
        for (j, a), (k, b) in combinations(enumerate(ids), 2)
    ]
    sampled = range(0, len(times), max(len(times) // CONNECTIVITY_POINTS, 1))
    silence_s = flight.config.trigger.t_max_s
    spoke = {
        i: _since(flight, [p.time_ns for p in flight.puts if p.vehicle_id == i and p.topic == STATE_TOPIC]) for i in ids
    }
    return Series(
        ids=ids,
        true=known,
        times_s=_since(flight, times),
        position_m=position,
        slots_m=slots,
        formation_error_m=np.array(
            [np.sqrt(np.square(formation_error_m(p, s)).mean()) for p, s in zip(position, slots, strict=True)]
        ),
        centroid_error_m=np.array([centroid_error_m(p, s) for p, s in zip(position, slots, strict=True)]),
        closest=sorted(pairs, key=lambda pair: pair.least_m)[:CLOSEST_PAIRS],
        nearest_m=np.fmin.reduce([p.distance_m for p in pairs]) if pairs else np.zeros(0),
        lambda2_s=_since(flight, times[list(sampled)]),
        lambda2=np.array(
            [
                connectivity_at(flight.config, history.at(int(times[k])), ids, position[k])
                if np.isfinite(position[k]).all()
                else np.nan
                for k in sampled
            ],
            float,
        ),
        messages_s=spoke,
        after_silence={i: np.diff(t, prepend=-np.inf) >= HEARTBEAT_SHARE * silence_s for i, t in spoke.items()},
        lateness={
            i: (_since(flight, rows["fleet_ns"]), rows["lateness_ns"] * 1e-6)
            for i, rows in flight.ticks.items()
            if len(rows)
        },
    )  # fmt: skip


def _since(flight: Flight, times_ns: npt.ArrayLike) -> Floats:
    since: Floats = (np.asarray(times_ns, np.int64) - flight.takeoff_ns).astype(np.float64) * 1e-9
    return since


def _slots(history: TrajectoryHistory, ids: list[int], times: npt.NDArray[np.int64]) -> Floats:
    """Where the motions that were flown want the vehicles."""
    wanted = np.zeros((len(times), len(ids), 3))
    for k, t in enumerate(times):
        motion = history.at(int(t))
        state = motion.state_at(int(t))
        wanted[k] = [state.slot(motion.slots[i]).position_ned_m for i in ids]
    return wanted
