"""A vehicle refuses by itself to take off when its own checks fail; a restarted companion does nothing by itself."""

import json
from typing import Any

import pytest
from flights import fleet, launch, parse, set_parameter, until, until_formed, wait

from companion.core.values import Instant, Phase
from companion.wire.px4 import Px4Mode
from sim.autopilot.faults import Fault, FaultKind
from sim.lockstep.lockstep import Lockstep

SETPOINT, COMMAND, PARAMETER_READ, TIMESYNC, HEARTBEAT = 84, 76, 20, 111, 0
STREAM_RATES, REQUEST_MESSAGE = 511, 512


def take_off(ls: Lockstep, i: int) -> str | None:
    """The vehicle's reason to refuse."""
    reason: str | None = json.loads(ls.command(b'{"verb":"takeoff"}')[i])["reason"]
    return reason


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("COM_OBL_RC_ACT", 0, "COM_OBL_RC_ACT is 0, must be 4 or 5"),
        ("COM_RC_OVERRIDE", 1, "COM_RC_OVERRIDE is 1, must have bit 1"),
        ("COM_RCL_EXCEPT", 0, "COM_RCL_EXCEPT is 0, must have bit 2"),
        ("COM_OF_LOSS_T", 2.0, "COM_OF_LOSS_T is 2, must be <= 1 s"),
        ("MPC_Z_VEL_MAX_DN", 0.5, "MPC_Z_VEL_MAX_DN is 0.5, must be >= 1 m/s"),
    ],
)
def test_a_vehicle_whose_autopilot_has_an_unfit_parameter_refuses_whoever_asks(
    name: str, value: float | int, says: str
) -> None:
    ls = Lockstep(fleet(1))
    ls.run_until(6.0)
    set_parameter(ls, 1, name, value)
    # What a ground station sets later is noticed too, since parameters are read anew.
    ls.run_until(13.0)
    reason = take_off(ls, 1)
    assert reason is not None
    assert reason.startswith(says)
    ls.run_until(16.0)
    assert ls.vehicles[1].agent.phase is Phase.IDLE
    assert not ls.vehicles[1].autopilot.truth().armed
    set_parameter(ls, 1, name, {"COM_OBL_RC_ACT": 4, "COM_RC_OVERRIDE": 3, "COM_RCL_EXCEPT": 4}.get(name, 1.0))
    ls.run_until(23.0)
    assert take_off(ls, 1) is None


def of_1_18(tables: dict[str, Any]) -> None:
    tables["stub"]["px4"] = "1.18"


def test_a_vehicle_on_px4_1_18_takes_off_and_its_sticks_must_end_offboard() -> None:
    ls = Lockstep(fleet(1, change=of_1_18))
    ls.run_until(6.0)
    assert ls.vehicles[1].agent.operator.unready(ls.now) == []
    set_parameter(ls, 1, "MAN_OVERRIDE_SPD", -1.0)
    ls.run_until(13.0)
    refusal = "MAN_OVERRIDE_SPD is -1, must be >= 0 (sticks moved that fast): a pilot's sticks would not end OFFBOARD"
    assert take_off(ls, 1) == refusal
    set_parameter(ls, 1, "MAN_OVERRIDE_SPD", 1.0)
    ls.run_until(20.0)
    assert take_off(ls, 1) is None
    until_formed(ls)


def test_a_low_battery_and_a_slow_link_are_named_together() -> None:
    ls = Lockstep(fleet(1))
    ls.run_until(6.0)
    assert ls.vehicles[1].agent.operator.unready(ls.now) == []
    ls.vehicles[1].autopilot.inject(Fault(FaultKind.LOW_BATTERY, 0.2))
    ls.run_until(8.0)
    assert take_off(ls, 1) == "battery at 20 %, must have 30 %"
    ls.vehicles[1].autopilot.inject(Fault(FaultKind.SLOW_LINK, 600.0))
    ls.run_until(11.9)
    reasons = ls.vehicles[1].agent.operator.unready(ls.now)
    assert "battery at 20 %, must have 30 %" in reasons
    assert "autopilot does not answer TIMESYNC" in reasons
    assert any(r.startswith("no heartbeat for") for r in reasons)
    ls.run_until(14.0)
    reasons = ls.vehicles[1].agent.operator.unready(ls.now)
    assert "battery unknown, must have 30 %" in reasons, "what was told more than 5 s ago"
    assert "estimator not ready (flags 0x0, needs 0x17)" in reasons


def test_a_hold_without_end_after_the_companions_death_is_refused() -> None:
    ls = Lockstep(fleet(1))
    ls.run_until(6.0)
    set_parameter(ls, 1, "COM_OBL_RC_ACT", 5)
    ls.run_until(13.0)
    assert (take_off(ls, 1) or "").startswith("COM_LOW_BAT_ACT is 0, must be 2 or 3: with COM_OBL_RC_ACT 5")
    set_parameter(ls, 1, "COM_LOW_BAT_ACT", 3)
    ls.run_until(20.0)
    assert take_off(ls, 1) is None


def test_in_flight_nothing_of_preflight_is_asked() -> None:
    kinds: list[tuple[float, int]] = []

    def record(i: int, channel: str, now: Instant, body: bytes) -> None:
        if channel == "output/mavlink":
            kinds.append((now.monotonic_ns * 1e-9, int.from_bytes(body[7:10], "little")))

    ls = launch(fleet(1), record=record)
    until(ls, 20.0, lambda: ls.all_in(Phase.CLIMBING))
    wait(ls, 1.5)
    begin = ls.now_ns * 1e-9
    until_formed(ls)
    wait(ls, 5.0)
    assert {kind for s, kind in kinds if s > begin}.isdisjoint({PARAMETER_READ, TIMESYNC})
    assert ls.vehicles[1].agent.operator.unready(ls.now) == []


@pytest.mark.parametrize("when", ["climbing", "formed"])
def test_a_companion_that_starts_while_its_vehicle_flies_sends_nothing_that_moves_it(when: str) -> None:
    sent: list[Any] = []

    def record(i: int, channel: str, now: Instant, body: bytes) -> None:
        if channel == "output/mavlink" and recording:
            sent.append(parse(body))

    recording = False
    ls = launch(fleet(1, altitude_m=10.0), record=record)
    if when == "formed":
        until_formed(ls)
    else:
        until(ls, 20.0, lambda: ls.positions()[1].down < -3.0)
    ls.kill(1)
    wait(ls, 0.3)
    recording = True
    ls.restart(1)
    wait(ls, 3.0)
    agent = ls.vehicles[1].agent
    assert agent.phase is Phase.IDLE
    assert agent.autopilot.armed
    assert {m.get_msgId() for m in sent} <= {HEARTBEAT, COMMAND}
    assert {m.command for m in sent if m.get_msgId() == COMMAND} <= {STREAM_RATES, REQUEST_MESSAGE}
    assert "armed by somebody else" in agent.operator.unready(ls.now)
    assert "armed by somebody else" in (take_off(ls, 1) or "")
    assert "armed by somebody else" in {c.message for c in agent.operator.checks(ls.now) if not c.passed}
    # In OFFBOARD the autopilot's own failsafe has landed it by its parameter; AUTO.TAKEOFF goes on without us.
    wanted = {"formed": {Px4Mode.AUTO_LAND}, "climbing": {Px4Mode.AUTO_TAKEOFF, Px4Mode.AUTO_LOITER}}[when]
    assert ls.vehicles[1].autopilot.truth().custom_mode in wanted
    wait(ls, 10.0)
    assert SETPOINT not in {m.get_msgId() for m in sent}
    assert agent.phase is Phase.IDLE


def test_accounts_of_a_lockstep_fleet_are_of_one_mind() -> None:
    ls = Lockstep(fleet(3))
    ls.run_until(6.0)
    accounts = [v.agent.operator.preflight_report(ls.now) for v in ls.vehicles.values()]
    assert len({a.configuration for a in accounts}) == 1
    assert len({a.assignment for a in accounts}) == 1
    assert all(c.passed for a in accounts for c in a.checks)
    assert all(a.position_ned_m is not None and a.origin_ned_m is not None for a in accounts)
