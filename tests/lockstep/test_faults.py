"""Flights in which something fails: a companion, the network, a pilot's patience."""

import json
from functools import cache
from typing import Any

import numpy as np
import pytest
from flights import (
    InLockstep,
    check_setpoint,
    distances,
    errors,
    failsafes,
    first,
    fleet,
    last,
    launch,
    set_parameter,
    straight,
    truth,
    until,
    until_formed,
    until_landed,
    wait,
)

from companion.config import FleetConfig
from companion.core.frames import Ned
from companion.core.trajectory.legs import VelocityLeg
from companion.core.trajectory.successors import with_legs
from companion.core.values import Instant, Phase
from companion.errors import RefusedError
from companion.operator.client import Operator, turn_leg, velocity_leg
from companion.wire.peer import encode_motion
from companion.wire.px4 import Px4Mode
from sim.autopilot.faults import Fault, FaultKind
from sim.lockstep.lockstep import Lockstep
from sim.lockstep.network import NetworkParameters
from sim.study.broken_law import BrokenLaw

pytestmark = pytest.mark.timeout(600)
"""a flight is simulated within a test, on whatever machine"""

CLEARANCE_M = 1.2


def leader(ls: Lockstep) -> int:
    """The vehicle in the foremost slot: the others fly over its place."""
    slots = ls.vehicles[1].agent.history.newest.slots
    return max(slots, key=lambda i: slots[i].after.north)


def held(ls: Lockstep) -> set[bytes]:
    return {encode_motion(v.agent.history.newest) for v in ls.vehicles.values() if v.alive}


# -- a companion is killed -------------------------------------------------------------------------------------------


class Killed:
    """A flight at 1 m/s whose foremost companion is killed; its autopilot lands it, or stops it where it is."""

    def __init__(self, shape: str, altitude_m: float, plan_s: float, spacing_m: float, stops: bool) -> None:
        def spaced(tables: dict[str, Any]) -> None:
            tables["formation"]["spacing_m"] = spacing_m

        config = fleet(5, altitude_m=altitude_m, shape=shape, legs=straight(plan_s), change=spaced)
        self.ls = launch(config, seed=2)
        until_formed(self.ls)
        until(self.ls, 10.0, lambda: self.ls.all_in(Phase.MOVING))
        wait(self.ls, 6.0)
        self.killed = leader(self.ls)
        if stops:
            set_parameter(self.ls, self.killed, "COM_OBL_RC_ACT", 5)
        self.stops = stops
        self.killed_s = self.ls.now_ns * 1e-9
        self.ls.kill(self.killed)
        self.others = [i for i in self.ls.vehicles if i != self.killed]
        until_landed(self.ls, 90.0)


FLIGHTS = {
    "v": ("v", 3.0, 20.0, 4.0, False),
    "column of 3 m": ("column", 6.0, 30.0, 3.0, False),
    "column of 3 m, stopped": ("column", 6.0, 30.0, 3.0, True),
}


@cache
def flown(name: str) -> Killed:
    return Killed(*FLIGHTS[name])


@pytest.fixture(params=FLIGHTS)
def killed(request: pytest.FixtureRequest) -> Killed:
    """Each flown once, in whatever order the tests come."""
    return flown(request.param)


def test_the_lost_vehicles_own_autopilot_lands_it_or_stops_it(killed: Killed) -> None:
    t = truth(killed.ls, killed.killed_s)
    k = t.column(killed.killed)
    if killed.stops:
        assert t.mode[-1, k] == Px4Mode.AUTO_LOITER
        assert np.linalg.norm(t.velocity_ned_m_s[-1, k]) < 0.5
        assert t.position_ned_m[-1, k, 2] < -5.0
    else:
        assert Px4Mode.AUTO_LAND in t.mode[:, k]
        assert not t.armed[-1, k]
        assert abs(t.position_ned_m[-1, k, 2]) < 0.3


def test_the_others_keep_apart_from_each_other_and_from_the_lost_one(killed: Killed) -> None:
    t = truth(killed.ls, killed.killed_s)
    assert distances(t, killed.others).min() >= CLEARANCE_M
    k = t.column(killed.killed)
    aloft = t.position_ned_m[:, k, 2] < -1.0
    assert aloft.any()
    p = t.position_ned_m[aloft]
    gaps = [np.linalg.norm(p[:, t.column(i)] - p[:, k], axis=1).min() for i in killed.others]
    assert min(gaps) >= CLEARANCE_M


def test_the_others_find_their_formation_again_and_land(killed: Killed) -> None:
    ls = killed.ls
    landing_s = min(first(ls, "moving -> landing", i) for i in killed.others)
    t = truth(ls, landing_s - 4.0, landing_s)
    formation, _ = errors(ls, t, killed.others)
    assert np.sqrt(np.square(formation).mean()) <= 0.2
    assert {ls.phases()[i] for i in killed.others} == {Phase.LANDED}
    assert failsafes(ls) == []


def test_a_companion_that_starts_anew_is_told_the_plan_and_disturbs_nobody(killed: Killed) -> None:
    ls = killed.ls
    ls.restart(killed.killed)
    agent = ls.vehicles[killed.killed].agent
    assert agent.history.newest.revision == 0
    wait(ls, 3.0)
    assert len(held(ls)) == 1
    assert agent.history.newest.revision > 1
    assert agent.phase is Phase.IDLE
    assert all(ls.vehicles[i].agent.peers.phases()[killed.killed] is Phase.IDLE for i in killed.others)


# -- a pilot takes over, the rest are cut off ------------------------------------------------------------------------


class TakenOver:
    """Three vehicles: the pilot takes one, later the other two lose each other."""

    def __init__(self) -> None:
        def brief(tables: dict[str, Any]) -> None:
            tables["trigger"]["t_max_s"] = 2.0
            tables["peers"]["isolated_flight_s"] = 3.0

        self.setpoints: dict[int, list[float]] = {1: [], 2: [], 3: []}
        config = fleet(3, legs=straight(60.0), change=brief)
        self.ls = launch(config, seed=4, record=self.record)
        until_formed(self.ls)
        wait(self.ls, 4.0)
        self.taken_s = self.ls.now_ns * 1e-9
        self.ls.vehicles[2].autopilot.inject(Fault(FaultKind.PILOT_TAKEOVER))
        wait(self.ls, 3.0)
        self.answers = {i: json.loads(a) for i, a in self.ls.command(b'{"verb":"takeoff"}').items()}
        self.land_answer = json.loads(self.ls.command(b'{"verb":"land"}', 2)[2])
        wait(self.ls, 5.0)
        self.cut_s = self.ls.now_ns * 1e-9
        self.ls.partition({1}, {2}, {3})
        until(self.ls, 40.0, lambda: {self.ls.phases()[i] for i in (1, 3)} == {Phase.LANDED})

    def record(self, i: int, channel: str, now: Instant, body: bytes) -> None:
        if channel == "output/mavlink" and body[7:10] == b"\x54\x00\x00":
            self.setpoints[i].append(now.monotonic_ns * 1e-9)


@pytest.fixture(scope="module")
def taken() -> TakenOver:
    return TakenOver()


def test_after_the_pilots_takeover_the_stream_stops_at_once_and_for_good(taken: TakenOver) -> None:
    assert taken.setpoints[2][-1] <= taken.taken_s + 0.2
    assert taken.ls.vehicles[2].agent.phase is Phase.RELEASED
    t = truth(taken.ls, taken.taken_s + 0.1)
    assert set(t.mode[:, t.column(2)].tolist()) == {int(Px4Mode.POSCTL)}


def test_nothing_but_heartbeats_is_said_to_an_autopilot_that_the_pilot_has(taken: TakenOver) -> None:
    # What the companion asked for before is withdrawn too: the mode stays the pilot's, and commands are refused.
    assert taken.answers[2]["reason"] == "the pilot has the vehicle"
    assert taken.land_answer["accepted"] is False
    assert [note for i, note in failsafes(taken.ls) if i == 2] == [
        "failsafe: OFFBOARD left by the pilot: POSCTL: hand over"
    ]


def test_the_others_hold_their_formation_without_the_one_that_was_taken(taken: TakenOver) -> None:
    t = truth(taken.ls, taken.taken_s, taken.cut_s)
    assert distances(t).min() >= CLEARANCE_M
    formation, _ = errors(taken.ls, t, [1, 3])
    assert np.sqrt(np.square(formation).mean()) <= 0.2


def test_a_vehicle_that_hears_nobody_lands_though_they_are_still_said_to_be_there(taken: TakenOver) -> None:
    limits = taken.ls.config.peer_limits
    for i in (1, 3):
        alone_s = first(taken.ls, "nobody's states heard: leave formation", i) - taken.cut_s
        assert limits.isolated_flight_s < alone_s < limits.stale_after_s + limits.isolated_flight_s + 0.5
    assert distances(truth(taken.ls, taken.cut_s)).min() >= CLEARANCE_M


# -- the network is bad, and falls apart -----------------------------------------------------------------------------


class BadNetwork:
    """Four vehicles with 30 % loss and 100 ms of delay; for a while two and two do not hear each other."""

    def __init__(self) -> None:
        def brief(tables: dict[str, Any]) -> None:
            tables["trigger"]["t_max_s"] = 3.0

            tables["plan"]["then"] = "stay"

        self.config = fleet(4, change=brief)
        self.ls = ls = launch(self.config, seed=5, network=NetworkParameters(delay_s=0.1, jitter_s=0.02, loss=0.3))
        until_formed(ls)
        # Two operators at once, each heard by one vehicle.
        now = ls.vehicles[1].agent.history.newest
        self.orders = []
        for k, i in enumerate((1, 4)):
            leg = VelocityLeg(Ned(1.0, 0.1 * k, 0.0), 0.0)
            motion = with_legs(now, at_ns=ls.now.fleet_ns + 2_000_000_000 + k, issuer=0, legs=(leg,))
            self.orders.append(motion.order)
            command = json.dumps({"verb": "motion", "motion": json.loads(encode_motion(motion))}).encode()
            assert json.loads(ls.command(command, i)[i])["accepted"]
        wait(ls, 3.0)
        self.agreed = {v.agent.history.newest.order for v in ls.vehicles.values()}
        wait(ls, 5.0)
        self.cut_s = ls.now_ns * 1e-9
        ls.partition({1, 2}, {3, 4})
        wait(ls, 8.0)
        self.healed_s = ls.now_ns * 1e-9
        ls.partition()
        wait(ls, 8.0)
        self.end_s = ls.now_ns * 1e-9
        ls.command(b'{"verb":"land"}')
        until_landed(ls)


@pytest.fixture(scope="module")
def bad() -> BadNetwork:
    return BadNetwork()


def test_motions_that_cross_each_other_end_in_the_larger_everywhere(bad: BadNetwork) -> None:
    assert bad.agreed == {max(bad.orders)}
    assert len(held(bad.ls)) == 1


def test_under_loss_and_delay_the_formation_stands_and_nobody_comes_close(bad: BadNetwork) -> None:
    t = truth(bad.ls, last(bad.ls, "-> formed") + 3.0, bad.cut_s)
    formation, centroid = errors(bad.ls, t, t.ids)
    assert np.sqrt(np.square(formation).mean()) <= 0.2
    assert np.sqrt(np.square(centroid).mean()) <= 0.5
    assert distances(truth(bad.ls, 3.0)).min() >= CLEARANCE_M


def test_two_halves_that_do_not_hear_each_other_fly_on_and_are_one_formation_afterwards(bad: BadNetwork) -> None:
    ls = bad.ls
    t = truth(ls, bad.healed_s + 5.0, bad.end_s)
    formation, _ = errors(ls, t, t.ids)
    assert len(t.times_ns) > 100
    assert np.sqrt(np.square(formation).mean()) <= 0.2
    assert failsafes(ls) == []


# -- the operator ----------------------------------------------------------------------------------------------------


class Operated:
    """Four vehicles that turn for ever and change their formation meanwhile, then stop, go somewhere and land."""

    def __init__(self) -> None:
        def change(tables: dict[str, Any]) -> None:
            tables["plan"].update(heading="track", then="stay")

        self.config: FleetConfig = fleet(4, change=change)
        self.marks: dict[str, float] = {}
        self.setpoints = 0
        self.ls = launch(self.config, seed=6, record=self.record)
        self.operator = Operator(self.config, InLockstep(self.ls))
        until_formed(self.ls)
        fleet_ns = self.ls.now.fleet_ns
        assert self.operator.move(velocity_leg(1.0, 0.0, 0.0), fleet_ns).all_accepted
        wait(self.ls, 6.0)
        self.act("turn")
        assert self.operator.move(turn_leg(10.0, None), self.ls.now.fleet_ns).all_accepted
        wait(self.ls, 6.0)
        self.act("form")
        assert self.operator.form("line", self.ls.now.fleet_ns).all_accepted
        wait(self.ls, 14.0)
        self.act("hold")
        assert self.operator.hold(lambda: self.ls.now.fleet_ns).all_accepted
        wait(self.ls, 8.0)
        self.act("land")
        self.status = self.operator.status()
        assert self.operator.land().all_accepted
        until_landed(self.ls)

    def act(self, name: str) -> None:
        self.marks[name] = self.ls.now_ns * 1e-9

    def record(self, i: int, channel: str, now: Instant, body: bytes) -> None:
        if channel == "output/mavlink":
            self.setpoints += check_setpoint(body, self.config)


@pytest.fixture(scope="module")
def operated() -> Operated:
    return Operated()


def test_the_formation_turns_with_its_course_and_changes_its_shape_in_the_turn(operated: Operated) -> None:
    ls, marks = operated.ls, operated.marks
    for begin, end in ((marks["turn"] + 5.0, marks["form"]), (marks["hold"] - 3.0, marks["hold"])):
        t = truth(ls, begin, end)
        formation, centroid = errors(ls, t, t.ids)
        assert np.sqrt(np.square(formation).mean()) <= 0.2
        assert np.sqrt(np.square(centroid).mean()) <= 0.5
    assert distances(truth(ls, 3.0)).min() >= CLEARANCE_M
    assert failsafes(ls) == []
    assert operated.setpoints > 4 * 1000


def test_hold_brings_the_formation_to_rest(operated: Operated) -> None:
    t = truth(operated.ls, operated.marks["land"] - 1.0, operated.marks["land"])
    assert np.linalg.norm(t.velocity_ned_m_s.mean(axis=(0, 1))) < 0.1


def test_status_tells_of_every_vehicle_where_it_is_in_the_flight(operated: Operated) -> None:
    for i, told in operated.status.items():
        assert told is not None
        assert (told.vehicle, told.phase, told.mode, told.shape) == (i, "holding", "OFFBOARD", "line")
        assert told.neighbours == 3
        assert told.ready == []


def test_a_motion_faster_than_the_limits_is_refused_by_every_vehicle(operated: Operated) -> None:
    ls = operated.ls
    with pytest.raises(RefusedError, match=r"its leg 0 flies at 5.00 m/s, may 3 m/s"):
        operated.operator.move(velocity_leg(5.0, 0.0, 0.0), ls.now.fleet_ns)
    newest = ls.vehicles[1].agent.history.newest
    fast = with_legs(newest, at_ns=ls.now.fleet_ns + 10**9, issuer=0, legs=(velocity_leg(5.0, 0.0, 0.0),))
    command = json.dumps({"verb": "motion", "revision": 99, "issuer": "x", "motion": json.loads(encode_motion(fast))})
    for answer in ls.command(command.encode()).values():
        assert json.loads(answer)["reason"] == "its leg 0 flies at 5.00 m/s, may 3 m/s"


# -- the link to the own autopilot -----------------------------------------------------------------------------------


def test_a_vehicle_whose_autopilot_fell_silent_is_released_and_its_peers_know_and_keep_away() -> None:
    ls = launch(fleet(3, legs=straight(25.0)), seed=4)
    until_formed(ls)
    wait(ls, 6.0)
    ls.vehicles[2].autopilot.inject(Fault(FaultKind.MUTE))
    muted_s = ls.now_ns * 1e-9
    until(ls, 3.0, lambda: ls.phases()[2] is Phase.RELEASED)
    assert 1.4 <= ls.now_ns * 1e-9 - muted_s <= 2.0
    wait(ls, 0.5)
    for i in (1, 3):
        assert ls.vehicles[i].agent.peers.phases()[2] is Phase.RELEASED
    assert (2, "failsafe: own position lost: hand over") in failsafes(ls)
    until(ls, 60.0, lambda: all(ls.phases()[i] is Phase.LANDED for i in (1, 3)))
    assert not ls.vehicles[2].autopilot.truth().armed, "its autopilot landed by itself"
    assert distances(truth(ls, muted_s)).min() > CLEARANCE_M


def test_a_vehicle_whose_autopilot_falls_silent_in_the_climb_is_released_and_not_awaited_for_ever() -> None:
    ls = launch(fleet(2), seed=4)
    until(ls, 10.0, lambda: ls.phases()[2] is Phase.CLIMBING)
    ls.vehicles[2].autopilot.inject(Fault(FaultKind.MUTE))
    until(ls, 4.5, lambda: ls.phases()[2] is Phase.RELEASED)
    assert (2, "failsafe: autopilot's heartbeat lost: hand over") in failsafes(ls)


def test_another_take_off_after_the_plan_has_landed_is_refused_with_the_reason() -> None:
    ls = launch(fleet(2, legs=straight(2.0)), seed=5)
    until_formed(ls)
    until_landed(ls)
    for answer in ls.command(b'{"verb":"takeoff"}').values():
        said = json.loads(answer)
        assert not said["accepted"]
        assert said["reason"] == "the plan is over: restart the companions for another flight"


# -- in the climb, in the landing, and a slot that cannot be reached ---------------------------------------------------


def test_a_landing_from_the_climb_ends_as_a_landing_whatever_mode_the_autopilot_falls_back_to() -> None:
    ls = launch(fleet(1), seed=4)
    until(ls, 10.0, lambda: ls.phases()[1] is Phase.CLIMBING)
    ls.vehicles[1].autopilot.inject(Fault(FaultKind.LOW_BATTERY, 0.05))
    until_landed(ls)
    wait(ls, 3.0)
    assert failsafes(ls) == [(1, "failsafe: battery critical: 5 %: land")]
    assert not any("released" in note for _, _, note in ls.notes)
    modes = truth(ls).mode[:, 0]
    assert Px4Mode.AUTO_LAND in modes
    assert modes[-1] == Px4Mode.AUTO_TAKEOFF


@pytest.mark.parametrize(("altitude_m", "seconds"), [(1.5, 1.2), (1.7, 0.7), (2.0, 0.7)])
def test_positions_frozen_at_the_climbs_end_make_nobody_believe_in_a_pilot(altitude_m: float, seconds: float) -> None:
    # Its autopilot ends the take-off in LOITER where the companion, by its last position, is far below.
    ls = launch(fleet(2), seed=4)
    until(ls, 20.0, lambda: ls.positions()[1].down < -altitude_m)
    assert ls.phases()[1] is Phase.CLIMBING
    ls.vehicles[1].autopilot.inject(Fault(FaultKind.POSITION_FROZEN, duration_s=seconds))
    until(ls, 5.0, lambda: ls.phases()[1] is not Phase.CLIMBING)
    assert ls.phases()[1] in (Phase.WAITING, Phase.DETACHED)
    assert not any("OFFBOARD left" in note for _, note in failsafes(ls))


@pytest.mark.parametrize("stopped", [(3,), (1, 2, 3)])
def test_the_plan_begins_although_a_slot_cannot_be_reached(stopped: tuple[int, ...]) -> None:
    def brief(tables: dict[str, Any]) -> None:
        tables["peers"]["wait_s"] = 6.0

    ls = launch(fleet(3, legs=straight(4.0), change=brief), seed=4)
    for i in stopped:
        agent = ls.vehicles[i].agent
        agent.law = BrokenLaw(agent.law, Ned(0.0, 0.0, 0.0))
    until(ls, 20.0, lambda: any(v.agent.history.newest.revision == 1 for v in ls.vehicles.values()))
    formed = ls.vehicles[1].agent.history.newest
    until(ls, 40.0, lambda: any(v.agent.history.newest.legs for v in ls.vehicles.values()))
    assert ls.now.fleet_ns > formed.blend_end_ns + 6_000_000_000
    assert all(ls.phases()[i] is Phase.FORMING for i in stopped)
    until_landed(ls)


# -- the way back, and what lies on the ground -------------------------------------------------------------------------


def test_nobody_lands_on_one_that_has_landed_beside_its_pad() -> None:
    def back(tables: dict[str, Any]) -> None:
        tables["plan"]["then"] = "return"

    ls = launch(fleet(5, altitude_m=5.0, shape="circle", legs=straight(5.0), change=back))
    until_formed(ls)
    place = ls.positions()[4]
    pad = ls.config.by_id(3)
    assert np.hypot(place.north - pad.pad_north_m, place.east - pad.pad_east_m) < 0.5, "under it is 3's pad"
    ls.vehicles[4].autopilot.inject(Fault(FaultKind.LOW_BATTERY, 0.05))
    until_landed(ls, 120.0)
    assert first(ls, "landed", 4) < first(ls, "returning -> landing", 3)
    t = truth(ls, first(ls, "forming -> formed"))
    assert distances(t).min() >= 1.0


def test_a_return_for_a_low_battery_outlives_a_motion_that_was_asked_for_at_the_same_time() -> None:
    def stay(tables: dict[str, Any]) -> None:
        tables["plan"]["then"] = "stay"

    ls = launch(fleet(2, legs=straight(3.0), change=stay))
    until_formed(ls)
    until(ls, 20.0, lambda: ls.all_in(Phase.MOVING))
    agent = ls.vehicles[2].agent
    before = agent.history.newest
    ls.vehicles[2].autopilot.inject(Fault(FaultKind.LOW_BATTERY, 0.2))
    until(ls, 20.0, lambda: agent.history.newest.returns)
    returning = agent.history.newest
    asked = with_legs(before, at_ns=returning.start_ns - 10**9, issuer=0, legs=(VelocityLeg(Ned(1.0, 0.0, 0.0), 0.0),))
    assert asked.revision == returning.revision
    command = json.dumps({"verb": "motion", "motion": json.loads(encode_motion(asked))}).encode()
    assert all(json.loads(a)["accepted"] for a in ls.command(command).values())
    until(ls, 10.0, lambda: agent.history.newest.returns and agent.history.newest.revision > returning.revision)
    # What is asked for afterwards, and so in its knowledge, is flown.
    newest = agent.history.newest
    later = with_legs(newest, at_ns=ls.now.fleet_ns + 10**9, issuer=0, legs=(VelocityLeg(Ned(0.5, 0.0, 0.0), 0.0),))
    command = json.dumps({"verb": "motion", "motion": json.loads(encode_motion(later))}).encode()
    assert all(json.loads(a)["accepted"] for a in ls.command(command).values())
    wait(ls, 8.0)
    assert agent.history.newest.order == later.order


def test_a_vehicle_whose_way_back_would_leave_the_fence_lands_and_the_others_stay() -> None:
    def notch(tables: dict[str, Any]) -> None:
        edge = [[-8, -9], [26, -9], [26, 30], [-8, 30], [-8, 14], [9, 14], [9, 9], [-8, 9]]
        tables["fence"] = {"polygon_m": edge, "floor_m": 1.0, "ceiling_m": 30.0, "margin_m": 1.0}
        tables["plan"].update(then="stay", legs=[
            {"kind": "goto", "north_m": north, "east_m": east, "speed_m_s": 2.0}
            for north, east in ((18.0, 0.0), (18.0, 22.0), (0.0, 22.0))
        ])  # fmt: skip

    ls = launch(fleet(2, altitude_m=5.0, change=notch))
    until_formed(ls)
    until(ls, 100.0, lambda: ls.all_in(Phase.HOLDING))
    ls.vehicles[2].autopilot.inject(Fault(FaultKind.LOW_BATTERY, 0.2))
    until(ls, 20.0, lambda: ls.phases()[2] is Phase.LANDING)
    assert any("no way back to the pads: it leads outside the fence" in note for _, i, note in ls.notes if i == 2)
    until(ls, 30.0, lambda: ls.phases()[2] is Phase.LANDED)
    assert ls.phases()[1] is Phase.HOLDING
    assert ls.vehicles[1].agent.rejected["plan: it leads outside the fence"] == 0
