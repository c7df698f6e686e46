"""The fence in lockstep: what an operator may ask for, and a broken law that presses against it."""

import json
from typing import Any

import numpy as np
import pytest
from flights import fleet, launch, truth, until, until_formed, wait

from companion.core.frames import Ned
from companion.core.trajectory.fleet import FleetTrajectory
from companion.core.trajectory.legs import GotoLeg, VelocityLeg
from companion.core.trajectory.successors import with_legs
from companion.core.values import ZERO, Phase
from companion.wire.peer import encode_motion
from sim.lockstep.lockstep import Lockstep
from sim.lockstep.network import NetworkParameters
from sim.study.broken_law import BrokenLaw

RADIUS_M = 30.0
CEILING_M = 8.0


def fenced(count: int, *, fence: bool = True, lag_s: float = 0.15, automatic: bool = True) -> Lockstep:
    def change(tables: dict[str, Any]) -> None:
        if fence:
            tables["fence"] = {"radius_m": RADIUS_M, "floor_m": 2.0, "ceiling_m": CEILING_M}
        tables["stub"].update(lag_s=lag_s)
        tables["plan"].update(automatic=automatic, then="stay")

    return launch(fleet(count, change=change), network=NetworkParameters(delay_s=0.1))


def send(ls: Lockstep, motion: FleetTrajectory) -> list[dict[str, Any]]:
    command = json.dumps({"verb": "motion", "motion": json.loads(encode_motion(motion))}).encode()
    return [json.loads(a) for a in ls.command(command).values()]


def newest(ls: Lockstep) -> FleetTrajectory:
    return ls.vehicles[1].agent.history.newest


def moved(ls: Lockstep, leg: VelocityLeg | GotoLeg) -> FleetTrajectory:
    return with_legs(newest(ls), at_ns=ls.now.fleet_ns + 10**9, issuer=0, legs=(leg,))


@pytest.mark.parametrize("fence", [True, False])
def test_a_broken_law_at_the_speed_limit_stays_inside_and_without_the_fence_it_leaves(fence: bool) -> None:
    """Truth, with PX4's loops, 0.3 s of lag, noise and gusts."""
    ls = fenced(1, fence=fence, lag_s=0.3, automatic=False)
    until(ls, 30.0, lambda: ls.all_in(Phase.WAITING))
    agent = ls.vehicles[1].agent
    broken = agent.law = BrokenLaw(agent.law)
    start_s = ls.now_ns * 1e-9
    broken.velocity_ned_m_s = Ned(4.0, 0.0, 0.0)
    wait(ls, 20.0)
    p = truth(ls, start_s).position_ned_m[:, 0]
    farthest = float(np.hypot(p[:, 0], p[:, 1]).max())
    if fence:
        assert RADIUS_M - 3.5 < farthest < RADIUS_M - 0.5
        assert agent.status(ls.now).limited["fence"] > 100
    else:
        assert farthest > RADIUS_M + 20.0


def test_a_motion_that_leads_outside_is_refused_by_every_vehicle_with_the_reason() -> None:
    ls = fenced(3)
    until_formed(ls)
    answers = send(ls, moved(ls, GotoLeg(Ned(RADIUS_M, 0.0, -3.0), 60.0)))
    assert len(answers) == 3
    for answer in answers:
        assert answer["accepted"] is False
        assert answer["reason"].startswith("it leads outside the fence, its leg 0 takes vehicle ")
        assert answer["reason"].endswith(" m beyond the fence's margin")
    assert all(v.agent.rejected["plan: it leads outside the fence"] == 1 for v in ls.vehicles.values())
    assert all(a["accepted"] for a in send(ls, moved(ls, GotoLeg(Ned(10.0, 0.0, -3.0), 60.0))))


def test_a_move_for_ever_ends_at_the_fence_one_up_is_refused_and_a_hold_never_is() -> None:
    ls = fenced(3)
    until_formed(ls)
    start_s = ls.now_ns * 1e-9
    for answer in send(ls, moved(ls, VelocityLeg(Ned(1.5, 0.0, -0.5), 0.0))):
        assert "climbs or sinks for ever" in answer["reason"]
    assert all(a["accepted"] for a in send(ls, moved(ls, VelocityLeg(Ned(1.5, 0.0, 0.0), 0.0))))
    wait(ls, 40.0)
    t = truth(ls, start_s)
    assert float(np.hypot(t.position_ned_m[..., 0], t.position_ned_m[..., 1]).max()) < RADIUS_M
    assert newest(ls).state_at(ls.now.fleet_ns).centre.position.north > RADIUS_M + 10.0
    assert ls.vehicles[1].agent.status(ls.now).limited["fence"] > 100
    assert all(a["accepted"] for a in send(ls, moved(ls, VelocityLeg(ZERO, 0.0))))
    assert all(a["accepted"] for a in send(ls, moved(ls, GotoLeg(Ned(0.0, 0.0, -3.0), 60.0))))
