"""The own loop of real PX4 instances, from their sensors over a companion back to their motors, has room for delay."""

import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from fleet_process import make_fleet
from px4_fleet import ALTITUDE_M, Flying, flying
from slow_link import slow_link

from sim.measures import formation_error_m

COUNT = 3
SLOW_S = 0.060
STABLE_M = 0.4
"""a tenth of the spacing; a loop that swings passes it within seconds"""
WANDER_M = 0.15
"""formation error that the simulated estimators' wander alone makes in a flight of five; one of 15 s may have less"""
SETTLING_S, WINDOW_S = 5.0, 15.0
STEP_NS = 40_000_000
"""the simulator tells its truth at 25 Hz"""
PLAN = {"then": "land", "legs": [{"kind": "velocity", "north_m_s": 1.0, "duration_s": 600.0}]}

Property = Callable[[str, object], None]
"""pytest's record_property: the figures go into --junitxml"""


@dataclass(frozen=True, slots=True)
class Margin:
    """What a flight was like in truth over its steady window."""

    formation_m: float
    """formation error about the centroid, RMS over time and vehicles"""
    velocity_m_s: float
    """velocity against the mean velocity, RMS, level"""
    attitude_rate_deg_s: float
    """roll and pitch rate together, RMS"""
    held_ms: tuple[float, float]
    """how long what companions sent was held: median, 99th percentile"""


def measured(flight: Flying, begin_ns: int, held_s: list[float]) -> Margin:
    """Between `begin_ns` and WINDOW_S later (UTC, ns), after the flight's end."""
    history = flight.history()
    times = np.arange(begin_ns, begin_ns + round(WINDOW_S * 1e9), STEP_NS)
    tracks = {i: flight.truth(i) for i in flight.fleet.ids}

    def motion(name: str) -> np.ndarray:
        axes = [
            [np.interp(times, t["time_unix_ns"], t[name][:, k].astype(float)) for k in range(3)]
            for t in tracks.values()
        ]
        return np.array(axes).transpose(2, 0, 1)

    p, v = motion("position_ned_m"), motion("velocity_ned_m_s")
    formation = []
    for time_ns, places in zip(times, p, strict=True):
        planned = history.at(int(time_ns))
        moment = planned.state_at(int(time_ns))
        slots = np.array([moment.slot(planned.slots[i]).position_ned_m for i in tracks])
        formation.append(np.square(formation_error_m(places, slots)).mean())
    relative = v[:, :, :2] - v[:, :, :2].mean(axis=1, keepdims=True)
    rates = np.concatenate(
        [
            t["attitude_rate_rad_s"][(t["time_unix_ns"] >= times[0]) & (t["time_unix_ns"] <= times[-1])]
            for t in tracks.values()
        ]
    )
    return Margin(
        float(np.sqrt(np.mean(formation))),
        float(np.sqrt(np.square(relative).sum(axis=2).mean())),
        float(np.degrees(np.sqrt(np.square(rates.astype(float)).mean()))),
        (1e3 * float(np.percentile(held_s, 50)), 1e3 * float(np.percentile(held_s, 99))),
    )


def flown(folder: Path, build: Path, delay_s: float) -> Margin:
    """Three vehicles in a V at 1 m/s, of whose companions all that they send comes `delay_s` later."""
    folder.mkdir()
    fleet = make_fleet(folder, COUNT, formation={"shape": "v", "altitude_m": ALTITUDE_M}, plan=PLAN)
    how = ("--autopilot", "px4", "--px4", str(build))
    with slow_link(fleet.config, delay_s) as link, flying(fleet, build, *how) as flight:
        flight.wait("moving")
        time.sleep(SETTLING_S)
        begin_ns = time.time_ns()
        time.sleep(WINDOW_S)
        said = {i: s for i, s in flight.operator.status().items() if s is not None}
        assert {i: s.phase for i, s in said.items()} == dict.fromkeys(fleet.ids, "moving")
        flight.up.signal(signal.SIGINT)
        flight.up.wait(120.0)
        return measured(flight, begin_ns, link.held_s)


def test_60_ms_more_in_the_own_loop_of_px4_stay_stable(tmp_path: Path, build: Path, record_property: Property) -> None:
    prompt = flown(tmp_path / "prompt", build, 0.0)
    slow = flown(tmp_path / "slow", build, SLOW_S)
    record_property("no more delay", prompt)
    record_property("60 ms more", slow)
    assert slow.held_ms[0] >= 1e3 * SLOW_S
    assert slow.formation_m <= STABLE_M
    assert slow.formation_m <= 2.0 * max(prompt.formation_m, WANDER_M)
    assert slow.velocity_m_s <= 2.0 * prompt.velocity_m_s
