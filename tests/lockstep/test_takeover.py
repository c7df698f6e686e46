"""One vehicle, a companion and a pilot: whoever takes the vehicle has it, and a refusal is no reason to insist."""

import json
from typing import Any

import pytest
from flights import failsafes, first, fleet, launch, until, until_formed, wait
from pymavlink.dialects.v20 import development as dialect

from companion.core.values import Instant, Phase
from companion.wire.px4 import Px4Mode, arm_parameters, mode_parameters, takeoff_parameters
from sim.autopilot.faults import Fault, FaultKind
from sim.lockstep.lockstep import Lockstep

GROUND_STATION: Any = dialect.MAVLink(None, srcSystem=255, srcComponent=190)


def orders(ls: Lockstep, command: int, *parameters: float) -> None:
    """A command from the pilot's ground station."""
    message = dialect.MAVLink_command_long_message(1, 1, command, 0, *parameters, *[0.0] * (7 - len(parameters)))
    ls.vehicles[1].autopilot.receive(bytes(message.pack(GROUND_STATION)), ls.now_ns)


def switches(ls: Lockstep, mode: Px4Mode) -> None:
    """The pilot at the flight mode switch."""
    if mode is Px4Mode.POSCTL:
        ls.vehicles[1].autopilot.inject(Fault(FaultKind.PILOT_TAKEOVER))
    else:
        orders(ls, *mode_parameters(mode))


def phase(ls: Lockstep) -> Phase:
    return ls.vehicles[1].agent.phase


def mode(ls: Lockstep) -> int:
    return ls.vehicles[1].autopilot.truth().custom_mode


class Sent:
    """What the companion says to its autopilot, by message id and time."""

    def __init__(self) -> None:
        self.rows: list[tuple[float, int]] = []

    def __call__(self, i: int, channel: str, now: Instant, body: bytes) -> None:
        if channel == "output/mavlink":
            self.rows.append((now.monotonic_ns * 1e-9, int.from_bytes(body[7:10], "little")))

    def after(self, seconds: float) -> set[int]:
        return {message_id for s, message_id in self.rows if s > seconds}


def climbing(record: Sent, to_altitude_m: float) -> Lockstep:
    ls = launch(fleet(1, altitude_m=10.0), record=record)
    until(ls, 15.0, lambda: ls.positions()[1].down < -to_altitude_m)
    assert phase(ls) is Phase.CLIMBING
    return ls


def must_be_the_pilots(ls: Lockstep, sent: Sent, wanted: int) -> None:
    taken_s = ls.now_ns * 1e-9
    wait(ls, 5.0)
    assert phase(ls) is Phase.RELEASED
    assert mode(ls) == wanted
    assert sent.after(taken_s + 0.2) <= {0}, "nothing but heartbeats"
    assert any("OFFBOARD left by the pilot" in note for _, note in failsafes(ls))


@pytest.mark.parametrize("wanted", [Px4Mode.POSCTL, Px4Mode.AUTO_LOITER, Px4Mode.AUTO_RTL, Px4Mode.AUTO_LAND])
def test_a_pilot_may_stop_the_climb_with_any_mode(wanted: Px4Mode) -> None:
    sent = Sent()
    ls = climbing(sent, 3.0)
    switches(ls, wanted)
    must_be_the_pilots(ls, sent, wanted)


@pytest.mark.parametrize("wanted", [Px4Mode.POSCTL, Px4Mode.AUTO_LOITER, Px4Mode.AUTO_RTL, Px4Mode.AUTO_LAND])
def test_a_pilot_may_take_a_vehicle_out_of_the_formation_with_any_mode(wanted: Px4Mode) -> None:
    sent = Sent()
    ls = launch(fleet(1), record=sent)
    until_formed(ls)
    switches(ls, wanted)
    must_be_the_pilots(ls, sent, wanted)


@pytest.mark.parametrize("wanted", [Px4Mode.POSCTL, Px4Mode.AUTO_LOITER])
def test_a_pilot_may_stop_the_landing(wanted: Px4Mode) -> None:
    sent = Sent()
    ls = launch(fleet(1), record=sent)
    until_formed(ls)
    ls.command(b'{"verb":"land"}')
    wait(ls, 1.0)
    assert mode(ls) == Px4Mode.AUTO_LAND
    switches(ls, wanted)
    must_be_the_pilots(ls, sent, wanted)


def test_a_landing_commanded_as_the_pilot_takes_over_does_not_take_the_vehicle_back() -> None:
    sent = Sent()
    ls = launch(fleet(1), record=sent)
    until_formed(ls)
    switches(ls, Px4Mode.POSCTL)
    agent = ls.vehicles[1].agent
    told = dialect.MAVLink_current_mode_message(0, int(Px4Mode.POSCTL), 0)
    agent.receive_mavlink(bytes(told.pack(dialect.MAVLink(None, srcSystem=1, srcComponent=1))), ls.now)
    ls.command(b'{"verb":"land"}')
    must_be_the_pilots(ls, sent, Px4Mode.POSCTL)


def test_the_pilots_vehicle_takes_commands_again_only_after_it_was_disarmed() -> None:
    ls = launch(fleet(1))
    until_formed(ls)
    switches(ls, Px4Mode.AUTO_LAND)
    wait(ls, 2.0)
    assert phase(ls) is Phase.RELEASED
    answer = json.loads(ls.command(b'{"verb":"takeoff"}')[1])
    assert (answer["accepted"], answer["reason"]) == (False, "the pilot has the vehicle")
    until(ls, 30.0, lambda: phase(ls) is Phase.LANDED)
    wait(ls, 2.0)
    assert json.loads(ls.command(b'{"verb":"takeoff"}')[1])["accepted"]


def test_what_the_pilot_flies_by_hand_after_a_landing_is_neither_resumed_nor_said_to_land() -> None:
    ls = launch(fleet(1))
    until_formed(ls)
    ls.command(b'{"verb":"land"}')
    until(ls, 30.0, lambda: phase(ls) is Phase.LANDED)
    wait(ls, 3.0)
    switches(ls, Px4Mode.AUTO_LOITER)
    wait(ls, 0.2)
    orders(ls, *arm_parameters(True))
    wait(ls, 0.5)
    orders(ls, *takeoff_parameters(ls.config.origin.altitude_amsl_m + 3.0))
    wait(ls, 8.0)
    setpoints = ls.vehicles[1].agent.setpoints_sent
    resumed, landed = (json.loads(ls.command(json.dumps({"verb": v}).encode())[1]) for v in ("resume", "land"))
    assert resumed["reason"] == "it is landed: to resume is for the released, and for those found in the air"
    assert (landed["accepted"], landed["reason"]) == (False, "the pilot has the vehicle")
    wait(ls, 2.0)
    assert (phase(ls), mode(ls)) == (Phase.LANDED, Px4Mode.AUTO_LOITER)
    assert ls.vehicles[1].agent.setpoints_sent == setpoints


def test_the_pilot_keeps_his_mode_when_a_resume_is_called_off_before_it_began() -> None:
    ls = launch(fleet(1))
    until_formed(ls)
    switches(ls, Px4Mode.POSCTL)
    wait(ls, 1.0)
    assert json.loads(ls.command(b'{"verb":"resume"}')[1])["accepted"]
    wait(ls, 0.1)
    assert json.loads(ls.command(b'{"verb":"release"}')[1])["accepted"]
    wait(ls, 2.0)
    assert (phase(ls), mode(ls)) == (Phase.RELEASED, Px4Mode.POSCTL)


def test_a_vehicle_that_somebody_else_has_armed_is_not_taken_off() -> None:
    ls = Lockstep(fleet(1))
    ls.run_until(6.0)
    orders(ls, 400, 1.0)
    ls.run_until(7.5)
    assert ls.vehicles[1].autopilot.truth().armed
    answer = json.loads(ls.command(b'{"verb":"takeoff"}')[1])
    assert (answer["accepted"], answer["reason"]) == (False, "armed by somebody else")
    ls.run_until(9.0)
    assert phase(ls) is Phase.IDLE


def test_an_autopilot_that_does_not_arm_is_asked_a_few_times_and_then_left_alone() -> None:
    sent = Sent()
    ls = Lockstep(fleet(1), record=sent)
    ls.run_until(3.5)
    # In RTL PX4 does not arm.
    switches(ls, Px4Mode.AUTO_RTL)
    ls.run_until(4.0)
    assert json.loads(ls.command(b'{"verb":"takeoff"}')[1])["accepted"]
    ls.run_until(20.0)
    assert phase(ls) is Phase.IDLE
    assert [note for _, note in failsafes(ls)] == ["failsafe: autopilot does not arm: take-off given up: continue"]
    assert sum(s > 4.0 and message_id == 76 for s, message_id in sent.rows) <= 30
    # Nobody waits for the arming any more: a pilot who arms later does not see his vehicle take off.
    switches(ls, Px4Mode.AUTO_LOITER)
    orders(ls, 400, 1.0)
    ls.run_until(22.0)
    assert ls.vehicles[1].autopilot.truth().armed
    assert phase(ls) is Phase.IDLE
    assert mode(ls) != Px4Mode.AUTO_TAKEOFF


def test_landing_right_after_the_command_to_take_off_leaves_the_vehicle_on_the_ground() -> None:
    for delay_s in (0.0, 0.002, 0.05):
        ls = launch(fleet(1))
        wait(ls, delay_s)
        assert json.loads(ls.command(b'{"verb":"land"}')[1])["accepted"]
        wait(ls, 14.0)
        assert phase(ls) in (Phase.IDLE, Phase.LANDED), delay_s
        assert not ls.vehicles[1].autopilot.truth().armed
        assert ls.positions()[1].down > -0.5


def test_a_companion_that_is_asked_to_end_lands_first() -> None:
    ls = launch(fleet(1))
    until_formed(ls)
    agent = ls.vehicles[1].agent
    assert not agent.stopped
    agent.stop(ls.now)
    wait(ls, 1.0)
    assert agent.stopped
    assert mode(ls) == Px4Mode.AUTO_LAND
    ls.kill(1)
    wait(ls, 15.0)
    assert not ls.vehicles[1].autopilot.truth().armed


def test_a_vehicle_that_is_late_lands_when_the_others_do_not_come() -> None:
    def impatient(tables: dict[str, Any]) -> None:
        tables["peers"]["wait_s"] = 5.0

    ls = launch(fleet(2, change=impatient))
    ls.command(b'{"verb":"land"}', 2)
    until(ls, 30.0, lambda: phase(ls) is Phase.LANDING)
    assert first(ls, "the others never come", 1) - first(ls, "climbing -> waiting", 1) == pytest.approx(5.0, abs=0.1)
