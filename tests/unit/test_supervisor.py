"""The supervisor on an autopilot that is no PX4: from phase to phase, by verbs, and by the table of failsafes."""

from collections.abc import Callable

import pytest
from toy_autopilot import CONFIG, STABLE, ToyAutopilot, at, fleet

from companion.config import FleetConfig
from companion.core.events import (
    FailsafeActed,
    FailsafeNoted,
    KillCause,
    KillCommanded,
    Killed,
    NoWayBack,
    PhaseChanged,
)
from companion.core.failsafe import HEARTBEAT_S, TAKE_OFF_S, Action, Failsafe
from companion.core.frames import Ned
from companion.core.values import FILTERED_PHASES, FLYING_PHASES, ZERO, Instant, Phase, VehicleState
from companion.vehicle.agent import Agent
from companion.vehicle.autopilot.port import HOLD, LAND, OFFBOARD, TAKE_OFF, Estimate, Verb
from companion.vehicle.supervisor import Supervisor

PERIOD_S = 0.02
CLIMB_M_S = 2.0


class Led:
    """A vehicle that is led: its autopilot does at once what it is asked."""

    def __init__(self, config: FleetConfig = CONFIG) -> None:
        agent = Agent(config, 1, 7)
        pad = agent.history.reference(1, at(0.0).fleet_ns).position_ned_m._replace(down=0.0)
        self.autopilot = ToyAutopilot(position_ned_m=pad)
        self.filter_restarts = 0
        self.supervisor = Supervisor(config, self.autopilot, agent.history, agent.peers, self.restart_filter)
        self.history = agent.history
        self.seconds = 100.0

    def restart_filter(self) -> None:
        self.filter_restarts += 1

    @property
    def now(self) -> Instant:
        return at(self.seconds)

    @property
    def phase(self) -> Phase:
        return self.supervisor.phase

    @property
    def went(self) -> list[Phase]:
        """The phases it went through."""
        return [e.after for e in self.supervisor.events if isinstance(e, PhaseChanged)]

    @property
    def acted(self) -> list[Failsafe]:
        return [e.failsafe for e in self.supervisor.events if isinstance(e, FailsafeActed)]

    def tick(self, lives: bool = True) -> None:
        self.seconds += PERIOD_S
        ap = self.autopilot
        if lives:
            ap.lives(self.now)
            self.supervisor.position_came()
        state = self.supervisor.state(self.now)
        self.supervisor.watch(self.now, state is not None)
        if state is not None:
            ego = VehicleState(self.now.fleet_ns, *state)
            reference = self.supervisor.follow(self.history.reference(1, self.now.fleet_ns), ego, self.now)
            self.supervisor.settle(ego, reference, self.now)
        self.fly()

    def fly(self) -> None:
        """What the vehicle does until the next tick: climb to its slot, or be on the ground."""
        ap = self.autopilot
        slot = self.history.reference(1, self.now.fleet_ns).position_ned_m
        if ap.mode == TAKE_OFF and ap.armed:
            down_m = ap.position_ned_m.down - CLIMB_M_S * PERIOD_S
            ap.on_ground = False
            ap.position_ned_m = slot._replace(down=down_m)
            ap.mode = HOLD if down_m <= slot.down else TAKE_OFF
        ap.on_ground = ap.on_ground or ap.mode == LAND

    def run(self, seconds: float, until: Callable[[], bool] | None = None, lives: bool = True) -> bool:
        for _ in range(round(seconds / PERIOD_S)):
            self.tick(lives)
            if until is not None and until():
                return True
        return until is None


def airborne(config: FleetConfig = CONFIG) -> Led:
    """One that waits over its pad for the others."""
    one = Led(config)
    one.tick()
    assert one.supervisor.take_off(one.now) is None
    assert one.run(9.0, lambda: one.phase is Phase.WAITING)
    return one


def test_another_autopilot_than_px4_is_led_from_the_ground_into_offboard_and_down_by_verbs() -> None:
    one = airborne()
    assert one.autopilot.asked == [Verb.ARM, Verb.TAKE_OFF, Verb.ENGAGE]
    assert one.autopilot.altitude_amsl_m == CONFIG.origin.altitude_amsl_m + CONFIG.formation.altitude_m
    assert one.supervisor.steers
    assert one.supervisor.land(one.now) is None
    assert one.run(1.0, lambda: one.autopilot.mode == LAND)
    one.autopilot.armed = False
    one.tick()
    assert one.went == [Phase.PREFLIGHT, Phase.ARMED, Phase.CLIMBING, Phase.WAITING, Phase.LANDING, Phase.LANDED]
    assert not one.supervisor.steers
    assert one.supervisor.stopped
    assert one.acted == []


def test_the_safety_filter_starts_anew_before_the_stream_and_when_the_autopilot_follows() -> None:
    assert airborne().filter_restarts == 2


def test_a_mode_that_nobody_asked_for_hands_over_and_nothing_more_is_asked() -> None:
    for by_itself, failsafe in ((False, Failsafe.PILOT), (True, Failsafe.AUTOPILOT)):
        one = airborne()
        one.autopilot.mode, one.autopilot.acts_by_itself = STABLE, by_itself
        one.run(2.0)
        assert one.phase is Phase.RELEASED
        assert one.acted == [failsafe]
        assert one.supervisor.failsafes == [f"{failsafe.value}: STABLE: hand over"]
        assert one.autopilot.asked == []
        assert not one.supervisor.steers


@pytest.mark.parametrize("phase", [Phase.ARMED, Phase.CLIMBING, Phase.WAITING, Phase.LANDING])
def test_a_heartbeat_that_is_lost_in_any_phase_hands_over(phase: Phase) -> None:
    one = Led()
    one.tick()
    one.autopilot.obedient = phase is not Phase.ARMED
    one.supervisor.take_off(one.now)
    one.autopilot.armed = True
    if phase is Phase.LANDING:
        one.run(9.0, lambda: one.phase is Phase.WAITING)
        one.autopilot.obedient = False
        one.supervisor.land(one.now)
    assert one.phase is phase or one.run(9.0, lambda: one.phase is phase)
    began_s = one.seconds
    for _ in range(200):
        one.seconds += PERIOD_S
        one.autopilot.position_ns = one.now.monotonic_ns
        one.supervisor.watch(one.now, positioned=True)
        if one.phase is Phase.RELEASED:
            break
        one.autopilot.mode = {Phase.CLIMBING: TAKE_OFF, Phase.WAITING: OFFBOARD}.get(one.phase, one.autopilot.mode)
    assert one.phase is Phase.RELEASED
    assert Failsafe.HEARTBEAT in one.acted
    assert one.seconds - began_s == pytest.approx(HEARTBEAT_S, abs=0.1)


def test_an_autopilot_that_does_not_arm_ends_the_take_off_on_the_ground() -> None:
    one = Led()
    one.tick()
    one.autopilot.obedient = False
    one.supervisor.take_off(one.now)
    began_s = one.seconds
    assert one.run(20.0, lambda: one.phase is Phase.IDLE)
    assert one.seconds - began_s == pytest.approx(TAKE_OFF_S, abs=0.1)
    assert one.acted == [Failsafe.NOT_ARMED]
    assert set(one.autopilot.asked) == {Verb.ARM}


def test_what_the_configuration_chose_of_a_rows_ways_is_done() -> None:
    lands = airborne(fleet(peers={"missing": "land", "wait_s": 6.0}))
    assert lands.run(8.0, lambda: lands.phase is Phase.LANDING)
    goes_on = airborne(fleet(peers={"missing": "continue", "wait_s": 6.0}))
    goes_on.run(8.0)
    assert (goes_on.phase, goes_on.supervisor.flight.forms_without) == (Phase.WAITING, True)
    assert lands.acted == goes_on.acted == [Failsafe.MISSING]
    (event,) = (e for e in goes_on.supervisor.events if isinstance(e, FailsafeActed))
    assert event.action is Action.CONTINUE


def test_an_uncertain_position_lands_and_one_that_ends_hands_over() -> None:
    one = airborne()
    one.autopilot.sure = Estimate(7, 7, 9.0)
    assert one.run(3.0, lambda: one.phase is Phase.LANDING)
    assert one.acted == [Failsafe.COVARIANCE]
    other = airborne()
    assert other.run(3.0, lambda: other.phase is Phase.RELEASED, lives=False)
    assert other.acted == [Failsafe.POSITION_LOST]
    assert FailsafeNoted(Failsafe.POSITION_STALE, "no setpoints") in other.supervisor.events


def test_a_position_that_jumps_makes_it_stand_and_its_origin_is_asked_for_again() -> None:
    one = airborne()
    restarts, p = one.filter_restarts, one.autopilot.position_ned_m
    one.autopilot.position_ned_m = Ned(p.north + 2.0, p.east, p.down)
    one.tick()
    assert one.phase is Phase.DETACHED
    assert one.supervisor.detached
    assert one.acted == [Failsafe.POSITION_JUMPED]
    assert one.autopilot.origin_doubted == 1
    assert one.filter_restarts == restarts + 1
    assert one.supervisor.counts[Failsafe.POSITION_JUMPED.value] == 1


def test_a_killed_vehicle_is_known_to_be_and_refuses_other_commands_meanwhile() -> None:
    one = airborne()
    one.autopilot.obedient = False
    assert one.supervisor.kill(one.now) is None
    assert one.phase is Phase.RELEASED
    assert KillCommanded() in one.supervisor.events
    assert one.supervisor.take_off(one.now) == one.supervisor.resume(one.now) == "it is being killed"
    assert not one.supervisor.stopped
    one.autopilot.armed = False
    one.run(1.0)
    assert one.supervisor.killed is KillCause.COMMAND
    assert one.phase is Phase.LANDED
    assert one.supervisor.stopped


def test_a_vehicle_that_falls_when_it_is_disarmed_was_killed_by_somebody() -> None:
    one = airborne()
    one.autopilot.velocity_ned_m_s = Ned(0.0, 0.0, 6.0)
    one.tick()
    one.autopilot.armed, one.autopilot.velocity_ned_m_s = False, ZERO
    one.run(0.5)
    assert one.supervisor.killed is KillCause.FELL
    assert Killed(KillCause.FELL) in one.supervisor.events


def test_a_released_vehicle_is_held_by_its_autopilot_and_steered_again_on_command() -> None:
    one = airborne()
    begun = one.supervisor.begun
    assert one.supervisor.release(one.now) is None
    one.run(2.0)
    assert (one.phase, one.autopilot.mode) == (Phase.RELEASED, HOLD)
    assert one.supervisor.resume(one.now) is None
    assert one.supervisor.steers
    assert one.supervisor.detached
    assert one.run(2.0, lambda: one.phase is Phase.DETACHED)
    assert one.supervisor.begun == begun + 1


@pytest.mark.parametrize(
    ("change", "reason"),
    [({"armed": False}, "it is not armed"), ({"on_ground": True}, "it is on the ground"),
     ({"on_ground": None}, "its autopilot does not tell whether it is in the air"),
     ({"position_ns": None}, "no position")],
)  # fmt: skip
def test_what_cannot_be_steered_is_not_resumed(change: dict[str, object], reason: str) -> None:
    one = airborne()
    one.supervisor.release(one.now)
    for name, value in change.items():
        setattr(one.autopilot, name, value)
    assert one.supervisor.resume(one.now) == reason
    assert not one.supervisor.steers


def test_a_way_home_that_cannot_be_flown_ends_here() -> None:
    one = airborne()
    one.supervisor.no_way_back("it leads outside the fence", one.now)
    assert one.phase is Phase.LANDING
    assert NoWayBack("it leads outside the fence") in one.supervisor.events


def test_setpoints_stream_in_no_phase_on_the_ground_and_in_every_filtered_one() -> None:
    one = Led()
    for phase in Phase:
        one.supervisor.flight.phase = phase
        if phase in FILTERED_PHASES:
            assert one.supervisor.steers
        elif phase not in FLYING_PHASES:
            assert not one.supervisor.steers


def jumps(one: Led) -> None:
    p = one.autopilot.position_ned_m
    one.autopilot.position_ned_m = Ned(p.north + 2.0, p.east, p.down)
    one.tick()


def test_a_jump_after_a_jump_is_acted_on_without_another_word_but_for_a_new_flight() -> None:
    one = airborne()
    jumps(one)
    jumps(one)
    assert one.supervisor.counts[Failsafe.POSITION_JUMPED.value] == 2
    assert one.acted == [Failsafe.POSITION_JUMPED]
    one.supervisor.release(one.now)
    one.supervisor.resume(one.now)
    assert one.run(1.0, lambda: one.phase is Phase.DETACHED)
    jumps(one)
    assert one.acted == [Failsafe.POSITION_JUMPED] * 2


def test_while_it_does_not_know_where_it_is_nothing_else_is_judged() -> None:
    one = airborne(fleet(peers={"missing": "land", "wait_s": 6.0}))
    one.run(5.0)
    one.autopilot.position_ned_m = one.autopilot.position_ned_m._replace(down=-30.0)
    jump_count = one.supervisor.flight.positions.jumps
    one.run(1.2, lives=False)
    one.supervisor.position_came()
    assert one.supervisor.flight.positions.jumps > jump_count
    one.supervisor.watch(one.now, positioned=False)
    assert one.acted == []
    one.tick()
    assert one.acted == [Failsafe.POSITION_JUMPED]


def test_the_fall_of_one_flight_is_none_of_the_next() -> None:
    one = airborne()
    one.autopilot.velocity_ned_m_s = Ned(0.0, 0.0, 6.0)
    one.tick()
    one.autopilot.armed, one.autopilot.velocity_ned_m_s = False, ZERO
    one.run(0.5)
    one.autopilot.on_ground, one.autopilot.mode = True, STABLE
    assert one.phase is Phase.LANDED
    one.supervisor.take_off(one.now)
    one.run(1.0)
    assert one.supervisor.killed is None


def test_a_take_off_that_its_pilot_disarms_leaves_no_take_off_mode_behind() -> None:
    one = Led()
    one.tick()
    one.supervisor.take_off(one.now)
    assert one.run(1.0, lambda: one.autopilot.mode == TAKE_OFF)
    one.autopilot.armed = False
    one.run(0.5)
    assert one.phase is Phase.IDLE
    assert one.autopilot.mode == HOLD


def test_what_has_happened_is_not_asked_for_again() -> None:
    one = airborne()
    assert {Verb.ARM, Verb.TAKE_OFF, Verb.ENGAGE} <= set(one.autopilot.withdrawn)
