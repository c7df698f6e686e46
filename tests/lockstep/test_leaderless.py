"""Flights without a shared motion: real agents agree on where to go by what they tell each other."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from flights import (
    Array,
    InLockstep,
    Tape,
    distances,
    failsafes,
    fleet,
    launch,
    straight,
    truth,
    until,
    until_landed,
    wait,
)
from peer_faults import Liar

from companion.core.values import ZERO, CommonMotion, Phase
from companion.io.replay import replay
from companion.operator.client import Operator, turn_leg, velocity_leg
from companion.vehicle.agent import Agent
from companion.wire.peer import COMMON_MAX
from sim.lockstep.lockstep import Lockstep
from sim.lockstep.network import NetworkParameters

pytestmark = pytest.mark.timeout(600)
"""a flight is simulated within a test, on whatever machine"""
SETTLED = (Phase.FORMED, Phase.MOVING, Phase.HOLDING)


def free_fleet(count: int, fence_m: float | None = None, **plan: object) -> Any:
    def change(tables: dict[str, Any]) -> None:
        tables["plan"] = {"kind": "none", **plan}
        if fence_m is not None:
            tables["fence"] = {"radius_m": fence_m, "floor_m": 1.0, "ceiling_m": 20.0}

    return fleet(count, change=change)


def aloft(config: Any, seed: int = 1, network: NetworkParameters | None = None, record: Any = None) -> Lockstep:
    """A fleet that has formed and flies free."""
    ls = launch(config, seed, network, record)
    until(ls, 60.0, lambda: ls.all_in(Phase.MOVING))
    return ls


def operator_of(ls: Lockstep) -> Operator:
    return Operator(ls.config, InLockstep(ls))


def now_s(ls: Lockstep) -> float:
    return ls.now_ns * 1e-9


def mean_velocity(ls: Lockstep, seconds: float = 2.0) -> Array:
    """Of all vehicles over the last seconds, on the level."""
    t = truth(ls, now_s(ls) - seconds)
    return np.asarray(t.velocity_ned_m_s[:, :, :2].mean(axis=(0, 1)))


def formation_error_m(ls: Lockstep, from_s: float, ids: list[int] | None = None) -> float:
    """RMS over vehicles and time about the centroid."""
    t = truth(ls, from_s)
    chosen = ids or t.ids
    motion = ls.vehicles[chosen[0]].agent.history.newest
    moment = motion.state_at(max(motion.blend_end_ns, ls.now.fleet_ns))
    slots = np.array([moment.slot(motion.slots[i]).position_ned_m for i in chosen])
    e = t.position_ned_m[:, [t.column(i) for i in chosen]] - slots
    e = e - e.mean(axis=1, keepdims=True)
    return float(np.sqrt(np.square(e).sum(axis=2).mean()))


@dataclass
class Turned:
    """Six of whom two know the legs, with losses."""

    ls: Lockstep
    tape: Tape
    turn_s: float


@pytest.fixture(scope="module")
def six() -> Turned:
    """Looked at by several tests, so none of them flies it on."""
    return flown_six()


def flown_six() -> Turned:
    legs = [
        *straight(12.0), {"kind": "turn", "rate_deg_s": 30.0, "angle_deg": 90.0},
        {"kind": "velocity", "east_m_s": 1.0, "duration_s": 100.0},
    ]  # fmt: skip
    tape = Tape(frozenset({2, 3}))
    ls = aloft(free_fleet(6, informed=[2, 5], legs=legs), 11, NetworkParameters(loss=0.3, delay_s=0.05), tape)
    wait(ls, 12.0)
    turn_s = now_s(ls)
    wait(ls, 25.0)
    return Turned(ls, tape, turn_s)


def test_two_of_six_draw_the_others_round_a_turn_with_a_third_of_the_messages_lost(six: Turned) -> None:
    assert mean_velocity(six.ls) == pytest.approx([0.0, 1.0], abs=0.15)
    assert failsafes(six.ls) == []
    assert [i for i, v in six.ls.vehicles.items() if v.agent.agreement.wish is not None] == [2, 5]


def test_they_keep_shape_and_distance_meanwhile(six: Turned) -> None:
    assert formation_error_m(six.ls, six.turn_s) <= 0.3
    assert distances(truth(six.ls, six.turn_s)).min() >= 1.5


@pytest.mark.parametrize("vehicle", [2, 3])
def test_a_flight_without_a_shared_motion_replays_byte_for_byte(six: Turned, vehicle: int) -> None:
    agent = Agent(six.ls.config, vehicle, six.ls.vehicles[vehicle].agent.boot_id)
    result = replay(agent, iter(six.tape.entries[vehicle]))
    assert result.same, result.sentence()


def test_a_companion_that_is_started_anew_has_lost_its_wish_and_the_rest_flies_on() -> None:
    six = flown_six()
    ls = six.ls
    ls.kill(2)
    wait(ls, 3.0)
    others = [i for i in ls.vehicles if i != 2]
    assert all(ls.phases()[i] in SETTLED for i in others)
    ls.restart(2)
    wait(ls, 3.0)
    assert ls.vehicles[2].agent.agreement.wish is None
    assert not ls.vehicles[2].agent.status(ls.now).informed
    assert ls.vehicles[5].agent.status(ls.now).informed
    # Its pilot has not taken it over, so it may be steered again: it comes back to where the others are by now.
    ls.command(b'{"verb":"resume"}', 2)
    until(ls, 90.0, lambda: ls.phases()[2] is Phase.MOVING)
    wait(ls, 5.0)
    assert formation_error_m(ls, now_s(ls) - 2.0) <= 0.5
    assert distances(truth(ls, six.turn_s)).min() >= 1.0


def test_nobody_told_anything_stands_and_goes_where_the_operator_tells_some() -> None:
    ls = aloft(free_fleet(4))
    operator = operator_of(ls)
    wait(ls, 5.0)
    assert np.abs(mean_velocity(ls, 4.0)).max() <= 0.05
    assert operator.wish(velocity_leg(0.0, -1.0, 0.0), [1, 3]).all_accepted
    wait(ls, 12.0)
    assert mean_velocity(ls) == pytest.approx([0.0, -1.0], abs=0.12)
    assert operator.wish(turn_leg(30.0, 90.0), [1]).all_accepted
    assert operator.wish(None, [3]).all_accepted
    wait(ls, 20.0)
    assert mean_velocity(ls) == pytest.approx([1.0, 0.0], abs=0.15)
    hold_from(ls, operator)
    rtl_from(ls, operator)
    assert failsafes(ls) == []
    assert distances(truth(ls)).min() >= 1.5


def hold_from(ls: Lockstep, operator: Operator) -> None:
    """The operator's own motions start where the fleet is: nobody's slot jumps, nobody leaves the formation."""
    here = np.mean(list(ls.positions().values()), axis=0)
    assert operator.form("line", ls.now.fleet_ns).all_accepted
    assert ls.vehicles[2].agent.history.newest.free_from_ns is not None
    until(ls, 30.0, lambda: ls.all_in(Phase.MOVING) and ls.now.fleet_ns > newest_blend_end(ls))
    assert operator.hold(lambda: ls.now.fleet_ns).all_accepted
    until(ls, 20.0, lambda: ls.all_in(Phase.HOLDING))
    wait(ls, 5.0)
    assert ls.vehicles[2].agent.status(ls.now).centre is None
    assert np.abs(mean_velocity(ls)).max() <= 0.1
    gone = np.mean(list(ls.positions().values()), axis=0) - here
    assert gone[0] > 5.0
    refused = operator.wish(velocity_leg(1.0, 0.0, 0.0), [1])
    assert "motion that all share" in refused.refused[1]
    assert operator.free(ls.now.fleet_ns).all_accepted
    until(ls, 10.0, lambda: ls.all_in(Phase.MOVING))
    wait(ls, 3.0)
    assert np.abs(mean_velocity(ls)).max() <= 0.1
    assert not any("detached" in note for _, _, note in ls.notes)


def newest_blend_end(ls: Lockstep) -> int:
    return ls.vehicles[2].agent.history.newest.blend_end_ns


def rtl_from(ls: Lockstep, operator: Operator) -> None:
    assert operator.rtl(ls.now.fleet_ns).all_accepted
    until_landed(ls, 120.0)
    for i, p in ls.positions().items():
        pad = ls.config.by_id(i)
        assert np.hypot(p.north - pad.pad_north_m, p.east - pad.pad_east_m) <= 1.5


def test_a_fleet_that_is_drawn_against_the_fence_stays_inside_and_lands_on_command() -> None:
    ls = aloft(free_fleet(4, fence_m=25.0))
    operator = operator_of(ls)
    assert operator.wish(velocity_leg(1.5, 0.0, 0.0), [2]).all_accepted
    wait(ls, 45.0)
    t = truth(ls)
    assert np.hypot(t.position_ned_m[:, :, 0], t.position_ned_m[:, :, 1]).max() <= 25.0
    assert np.abs(mean_velocity(ls)).max() <= 0.15
    assert distances(truth(ls, 10.0)).min() >= 1.2
    assert operator.land().all_accepted
    until_landed(ls)


@pytest.mark.parametrize("lie", ["away", "to and fro", "unlike"])
def test_who_lies_about_the_common_velocity_draws_the_fleet_as_far_as_a_wish_does_and_no_further(lie: str) -> None:
    ls = aloft(free_fleet(5, fence_m=30.0))
    liar, operator = Liar(flight=ls), operator_of(ls)
    liar.sequence = 1 << 20
    for k in range(60):
        east_m_s = {"away": COMMON_MAX, "to and fro": COMMON_MAX * (-1) ** k, "unlike": -COMMON_MAX + k}[lie]
        rate_m_s2 = -east_m_s if lie == "unlike" else east_m_s
        said = CommonMotion(0.0, east_m_s, 0.0, rate_m_s2)
        liar.says(liar.beside(2, 0.0, 0.0, velocity_ned_m_s=ZERO, common=said), ls.vehicles[2].agent.boot_id)
        wait(ls, 0.25)
    t = truth(ls)
    level = np.linalg.norm(t.velocity_ned_m_s[:, :, :2], axis=2)
    assert np.hypot(t.position_ned_m[:, :, 0], t.position_ned_m[:, :, 1]).max() <= 30.0
    assert distances(truth(ls, now_s(ls) - 15.0)).min() >= 1.2
    assert level.max() > 0.5, "nobody believed a word"
    assert level.max() <= ls.config.limits.speed_max_m_s
    assert set(ls.phases().values()) <= {Phase.MOVING, Phase.DETACHED}
    assert operator.land().all_accepted
    until_landed(ls)


def test_a_vehicle_that_hears_nobody_stands_and_one_that_comes_back_finds_the_others() -> None:
    ls = aloft(free_fleet(4))
    assert operator_of(ls).wish(velocity_leg(0.5, 0.0, 0.0), [1]).all_accepted
    wait(ls, 12.0)
    ls.partition([4], [1, 2, 3])
    until(ls, 60.0, lambda: ls.phases()[4] is Phase.DETACHED)
    ls.partition()
    until(ls, 60.0, lambda: ls.phases()[4] is Phase.MOVING)
    wait(ls, 5.0)
    assert mean_velocity(ls) == pytest.approx([0.5, 0.0], abs=0.12)
    assert formation_error_m(ls, now_s(ls) - 2.0) <= 0.4
