"""A threat passes through ten real agents without a shared motion: they open, and re-form when it has gone."""

import json
from typing import Any

import numpy as np
import pytest
from flights import distances, failsafes, truth, until, wait
from test_leaderless import aloft, formation_error_m, free_fleet, mean_velocity, now_s, operator_of

from companion.core.values import Phase
from companion.errors import RefusedError
from companion.wire.operator import Scare
from companion.wire.px4 import Px4Mode
from sim.lockstep.lockstep import Lockstep

pytestmark = pytest.mark.timeout(900)
"""a flight is simulated within a test, on whatever machine"""


def fleeing(ls: Lockstep) -> set[int]:
    return {i for i, v in ls.vehicles.items() if v.agent.status(ls.now).flees}


def threat(ls: Lockstep, **changed: Any) -> Scare:
    """It comes from the west and flies 5 m/s through the middle of the fleet."""
    north, east, _ = np.mean(list(ls.positions().values()), axis=0)
    values = {
        "begins_ns": ls.now.fleet_ns, "north_m": float(north), "east_m": float(east) - 25.0, "east_m_s": 5.0,
        "radius_m": 6.0, "lasts_s": 12.0,
    }  # fmt: skip
    return Scare(**{**values, **changed})


def test_a_threat_that_flies_through_ten_is_fled_and_leaves_them_as_they_were() -> None:
    ls = aloft(free_fleet(10), 3)
    wait(ls, 2.0)
    operator, begun_s = operator_of(ls), now_s(ls)
    assert operator.scare(threat(ls), ls.now.fleet_ns).all_accepted
    fled: set[int] = set()
    for _ in range(24):
        wait(ls, 0.5)
        fled |= fleeing(ls)
    assert 2 <= len(fled) <= 9
    until(ls, 10.0, lambda: not fleeing(ls))
    assert formation_error_m(ls, begun_s) >= 0.7
    wait(ls, 20.0)
    assert formation_error_m(ls, now_s(ls) - 2.0) <= 0.3
    assert np.abs(mean_velocity(ls)).max() <= 0.1
    t = truth(ls, begun_s)
    assert distances(t).min() >= 1.2
    assert np.linalg.norm(t.velocity_ned_m_s[:, :, :2], axis=2).max() <= ls.config.limits.speed_max_m_s
    assert set(np.unique(t.mode)) == {int(Px4Mode.OFFBOARD)}
    assert failsafes(ls) == []


def test_a_silly_threat_is_refused_with_a_sentence_and_a_hostile_one_chases_nobody_out_of_the_fence() -> None:
    ls = aloft(free_fleet(4, fence_m=20.0))
    operator, begun_s = operator_of(ls), now_s(ls)
    for bad, said in (
        (b'{"verb":"scare"}', "scare needs a threat"),
        (b'{"verb":"scare","threat":{"begins_ns":1,"north_m":1e999}}', "threat.north_m must be within"),
        (b'{"verb":"scare","threat":{"begins_ns":1,"north_m":NaN,"east_m":0}}', "threat.north_m must be within"),
        (
            b'{"verb":"scare","threat":{"begins_ns":1,"north_m":0.0,"east_m":0.0,"radius_m":5.0,"lasts_s":5.0}}',
            "must not be over",
        ),
    ):
        answers = [json.loads(a) for a in ls.command(bad).values()]
        assert not any(a["accepted"] for a in answers)
        assert all(said in a["reason"] for a in answers), answers
    north, east, _ = np.mean(list(ls.positions().values()), axis=0)
    big = threat(
        ls, north_m=float(north) - 3.0, east_m=float(east) - 3.0, north_m_s=0.5, east_m_s=0.5, radius_m=50.0,
        lasts_s=40.0,
    )  # fmt: skip
    assert operator.scare(big, ls.now.fleet_ns).all_accepted
    wait(ls, 20.0)
    assert fleeing(ls)
    t = truth(ls, begun_s)
    assert np.hypot(t.position_ned_m[:, :, 0], t.position_ned_m[:, :, 1]).max() <= 20.0
    assert np.linalg.norm(t.velocity_ned_m_s[:, :, :2], axis=2).max() <= ls.config.limits.speed_max_m_s
    assert distances(t).min() >= 0.5
    assert operator.hold(lambda: ls.now.fleet_ns).all_accepted
    until(ls, 40.0, lambda: ls.all_in(Phase.HOLDING))
    assert not fleeing(ls)
    with pytest.raises(RefusedError, match="only a free one flees"):
        operator.scare(threat(ls), ls.now.fleet_ns)
    assert failsafes(ls) == []
