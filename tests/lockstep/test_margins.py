"""The own loop, from a vehicle's sensors over its companion back to its motors, has room for delay."""

import numpy as np
from flights import errors, failsafes, fleet, straight, truth, until_formed, wait

from sim.lockstep.lockstep import Lockstep

SLOW_S = 0.060


def flown(command_delay_s: float, lag_s: float) -> tuple[float, float]:
    """Formation error and velocity error (RMS, m and m/s, in truth) of four vehicles at 1 m/s in gusts."""

    def change(tables: dict[str, dict[str, object]]) -> None:
        tables["stub"]["lag_s"] = lag_s

    ls = Lockstep(fleet(4, legs=straight(30.0), change=change), seed=3, command_delay_s=command_delay_s)
    ls.run_until_ready(20.0)
    ls.command(b'{"verb":"takeoff"}')
    until_formed(ls)
    wait(ls, 20.0)
    t = truth(ls, ls.now_ns * 1e-9 - 15.0)
    formation, _ = errors(ls, t, t.ids)
    v = t.velocity_ned_m_s[:, :, :2]
    relative = v - v.mean(axis=1, keepdims=True)
    assert failsafes(ls) == []
    return float(np.sqrt(np.square(formation).mean())), float(np.sqrt(np.square(relative).sum(axis=2).mean()))


def test_60_ms_more_in_the_own_loop_stay_stable() -> None:
    formation_m, velocity_m_s = flown(0.0, lag_s=0.3)
    slow_formation_m, slow_velocity_m_s = flown(SLOW_S, lag_s=0.3)
    assert slow_formation_m <= 0.2
    assert slow_velocity_m_s <= 2.0 * velocity_m_s
    assert slow_formation_m <= 2.0 * formation_m
