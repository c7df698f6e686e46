"""Flights in which peers fall silent, start anew or lie; how near the vehicles come to each other by truth."""

from collections.abc import Sequence
from math import inf
from typing import Any

import numpy as np
from flights import distances, fleet, launch, set_parameter, truth, until, until_formed, wait

from companion.core.values import Phase
from companion.flight import ON_GROUND
from sim.lockstep import Lockstep

TURN: list[dict[str, object]] = [{"kind": "turn", "rate_deg_s": 6.0}]


def moving(
    count: int, shape: str, seed: int, legs: Sequence[dict[str, object]], spacing_m: float = 4.0, t_max_s: float = 10.0
) -> Lockstep:
    """A formation at 6 m that flies its legs, for 6 s so far."""

    def change(tables: dict[str, Any]) -> None:
        tables["formation"]["spacing_m"] = spacing_m
        tables["trigger"]["t_max_s"] = t_max_s
        if count > 5:
            tables["limits"]["control_rate_hz"] = 25.0

    ls = launch(fleet(count, altitude_m=6.0, shape=shape, legs=legs, change=change), seed=seed)
    until_formed(ls)
    until(ls, 10.0, lambda: ls.all_in(Phase.MOVING))
    wait(ls, 6.0)
    return ls


def states_lost(count: int, seed: int, shape: str = "v") -> tuple[float, Lockstep]:
    """Everybody's states are lost in a turn of 6 °/s while presence stays; the least distance from then on (m)."""
    ls = moving(count, shape, seed, [{"kind": "velocity", "north_m_s": 1.0, "duration_s": 4.0}, *TURN])
    wait(ls, 3.0 + seed % 9)
    since_s = ls.now_ns * 1e-9
    ls.drop_topic("state")
    ls.run_until(since_s + 90.0, lambda: ls.all_in(Phase.LANDED))
    return airborne_distance(ls, since_s), ls


def airborne_distance(ls: Lockstep, since_s: float, about: int | None = None) -> float:
    """The least distance of two vehicles of which one is in the air (m); with `about`, to that vehicle."""
    t = truth(ls, since_s)
    a, b = np.triu_indices(len(t.ids), 1)
    flying = t.landed_state != ON_GROUND
    either = flying[:, a] | flying[:, b]
    if about is not None:
        k = t.column(about)
        either = either & ((a == k) | (b == k))
    return float(np.where(either, distances(t), inf).min())


def restarted(shape: str, seed: int, line: bool, stops: bool = True) -> tuple[float, int, Lockstep]:
    """A companion is killed in flight and starts anew; the least distance to its vehicle (m), and its id.

    Its autopilot stops it in the others' way, or lands it.
    """
    ls = moving(
        5, shape, seed, [{"kind": "velocity", "north_m_s": 1.0, "duration_s": 40.0}], 3.0 if shape == "column" else 4.0
    )
    slots = ls.vehicles[1].agent.programme.newest.slots
    order = sorted(slots, key=lambda i: slots[i].after.north)
    i = order[-1 - seed % 2]
    if stops:
        set_parameter(ls, i, "COM_OBL_RC_ACT", 5)
    since_s = ls.now_ns * 1e-9
    ls.kill(i)
    wait(ls, 0.3 + 0.4 * (seed % 5))
    ls.restart(i, line_dead_s=0.0 if line else inf)
    ls.run_until(since_s + 100.0, lambda: all(p is Phase.LANDED for j, p in ls.phases().items() if j != i))
    return airborne_distance(ls, since_s, i), i, ls
