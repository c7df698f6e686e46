"""The published-intent law, flown by real agents in lockstep: with a plan and without, replayed, and with one lost."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from flights import Tape, distances, errors, failsafes, fleet, launch, straight, truth, until, wait
from peer_faults import Liar

from companion.core.law.intent import FAR_M
from companion.core.values import ZERO, Phase
from companion.io.replay import replay
from companion.vehicle.agent import Agent
from sim.lockstep.lockstep import Lockstep
from sim.lockstep.network import NetworkParameters

pytestmark = pytest.mark.timeout(900)
"""a flight is simulated within a test, on whatever machine"""
COUNT = 5


@dataclass
class Flown:
    """A flight up to the end of its legs."""

    ls: Lockstep
    tape: Tape
    moving_s: float


def flown(plan: dict[str, Any], seconds: float, count: int = COUNT, loss: float = 0.2) -> Flown:
    def change(tables: dict[str, Any]) -> None:
        tables["law"]["kind"] = "intent"
        tables["plan"] = plan

    tape = Tape(frozenset({2}))
    ls = launch(fleet(count, change=change), 1, NetworkParameters(loss=loss, delay_s=0.03), tape)
    until(ls, 60.0, lambda: ls.all_in(Phase.MOVING) or ls.all_in(Phase.HOLDING))
    moving_s = ls.now_ns * 1e-9
    wait(ls, seconds)
    return Flown(ls, tape, moving_s)


@pytest.fixture(scope="module")
def planned() -> Flown:
    """Straight on for 3 s, then a turn; a fifth of the messages is lost."""
    legs = [*straight(3.0), {"kind": "turn", "rate_deg_s": 15.0, "angle_deg": 90.0}]
    return flown({"legs": legs, "then": "stay"}, 9.0)


@pytest.fixture(scope="module")
def free() -> Flown:
    """Two know where to go, and nobody has a place."""
    return flown({"kind": "none", "informed": [2, 4], "legs": straight(60.0)}, 14.0)


def test_with_a_plan_five_keep_shape_place_and_distance(planned: Flown) -> None:
    t = truth(planned.ls, planned.moving_s)
    formation, centroid = errors(planned.ls, t, planned.ls.vehicles)
    assert np.sqrt(np.square(formation).mean()) <= 0.2
    assert centroid.max() <= 0.6
    assert distances(t).min() >= 2.5
    assert failsafes(planned.ls) == []


def test_their_intended_places_agree_about_the_plans(planned: Flown) -> None:
    ls = planned.ls
    anchors = []
    for i, v in ls.vehicles.items():
        r = v.agent.history.reference(i, ls.now.fleet_ns).position_ned_m
        north, east, *_ = v.agent.law.tell()
        anchors.append((north - r.north, east - r.east))
    assert np.ptp(anchors, axis=0).max() <= 0.05
    assert np.abs(anchors).max() <= 0.35


def test_without_a_plan_they_follow_the_two_that_know_and_keep_their_shape(free: Flown) -> None:
    t = truth(free.ls, free.ls.now_ns * 1e-9 - 2.0)
    assert t.velocity_ned_m_s[:, :, :2].mean(axis=(0, 1)) == pytest.approx([1.0, 0.0], abs=0.12)
    motion = free.ls.vehicles[2].agent.history.newest
    slots = np.array([motion.reference(i, motion.blend_end_ns).position_ned_m for i in t.ids])
    e = t.position_ned_m - slots
    e = e - e.mean(axis=1, keepdims=True)
    assert np.sqrt(np.square(e).sum(axis=2).mean()) <= 0.3
    assert distances(truth(free.ls, free.moving_s)).min() >= 2.0
    assert failsafes(free.ls) == []


@pytest.mark.parametrize("flight", ["planned", "free"])
def test_such_a_flight_replays_byte_for_byte(flight: str, request: pytest.FixtureRequest) -> None:
    one: Flown = request.getfixturevalue(flight)
    agent = Agent(one.ls.config, 2, one.ls.vehicles[2].agent.boot_id)
    result = replay(agent, iter(one.tape.entries[2]))
    assert result.same, result.sentence()


def test_the_others_keep_clear_of_one_whose_companion_ends() -> None:
    ls = flown({"legs": straight(60.0)}, 3.0, 3).ls
    ls.kill(3)
    begin_s = ls.now_ns * 1e-9
    wait(ls, 8.0)
    assert all(ls.phases()[i] in (Phase.MOVING, Phase.HOLDING) for i in ls.vehicles if i != 3)
    assert distances(truth(ls, begin_s)).min() >= 1.0


@pytest.mark.parametrize(("off_m", "draws_m"), [(1e5, 0.4), (3.0, 1.7)])
def test_who_lies_about_its_intended_place_draws_nobody_off_the_plan_for_ever(off_m: float, draws_m: float) -> None:
    """A place that it cannot intend is not heeded; one that it may draws the others until the plan holds them."""
    liar = Liar(flight=flown({"legs": [{"kind": "hold", "duration_s": 200.0}], "then": "stay"}, 2.0, loss=0.0).ls)
    ls, liar.sequence = liar.ls, 1 << 20
    begun_s, slots = liar.since_s, ls.positions()
    for _ in range(160):
        told = (ls.positions()[2].north + off_m, ls.positions()[2].east, 0.0, 0.0)
        liar.says(liar.beside(2, 0.0, 0.0, velocity_ned_m_s=ZERO, told=told), ls.vehicles[2].agent.boot_id)
        wait(ls, 0.25)
    drawn = [p.north - slots[i].north for i, p in ls.positions().items()]
    assert max(map(abs, drawn)) <= draws_m
    assert off_m > FAR_M or min(drawn) >= 0.5, "nobody believed a word"
    assert distances(truth(ls, begun_s)).min() >= 1.2
    assert failsafes(ls) == []
