"""OFFBOARD as PX4 1.16 does it: entry, loss, every failsafe, return, what is accepted and what is dropped."""

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from autopilot_flight import (
    ACCELERATION_AND_YAW,
    POSITION_AND_YAW,
    VELOCITY_ACCELERATION_AND_YAW,
    VELOCITY_AND_YAW,
    Flight,
    mavlink,
)

from companion.core.frames import Ned
from sim.autopilot.dynamics_parameters import DynamicsParameters
from sim.autopilot.modes import Mode, OffboardLossAction
from sim.autopilot.offboard import decode_setpoint

GOLDEN = Path(__file__).parents[1] / "golden"
sys.path.insert(0, str(GOLDEN))
from make_px4_golden import response  # noqa: E402

STEPS = json.loads((GOLDEN / "px4_steps.json").read_text())
NAN = math.nan
BODY = mavlink.MAV_FRAME_BODY_NED


@pytest.fixture
def flying() -> Flight:
    flight = Flight()
    flight.take_off()
    return flight


def flying_with(**parameters: float | int) -> Flight:
    flight = Flight(parameters=parameters)
    flight.take_off()
    return flight


def heartbeat(flight: Flight) -> tuple[int, int, int]:
    flight.run(1.0)
    message = flight.last("HEARTBEAT")
    return message.base_mode, message.custom_mode >> 16 & 0xFF, message.system_status


# Entry


def test_without_a_stream_offboard_is_accepted_on_the_ground_but_not_ready() -> None:
    flight = Flight()
    flight.run(5.0)
    assert flight.set_mode(Mode.OFFBOARD) == 0
    assert heartbeat(flight) == (1, 6, 0)
    flight.stream(flight.setpoint(), 1.5)
    assert flight.last("HEARTBEAT").base_mode == 17
    assert flight.last("HEARTBEAT").system_status == 3


def test_without_a_stream_offboard_is_rejected_in_flight(flying: Flight) -> None:
    assert flying.set_mode(Mode.OFFBOARD) == 1
    assert flying.mode is Mode.LOITER


def test_one_setpoint_younger_than_a_second_is_enough(flying: Flight) -> None:
    flying.send(flying.setpoint())
    flying.run(0.9)
    assert flying.set_mode(Mode.OFFBOARD) == 0
    assert flying.mode is Mode.OFFBOARD


def test_armed_offboard_heartbeat_says_145_and_active(flying: Flight) -> None:
    flying.go_offboard()
    flying.stream(flying.setpoint(), 1.1)
    message = flying.last("HEARTBEAT")
    assert (message.base_mode, message.custom_mode, message.system_status) == (145, 393216, 4)


def test_setpoints_sent_before_the_mode_change_are_not_flown(flying: Flight) -> None:
    flying.stream(flying.setpoint(vx=3.0), 0.5)
    assert flying.set_mode(Mode.OFFBOARD) == 0
    flying.run(0.5)
    assert flying.velocity.north == pytest.approx(0.0, abs=0.05)


# Loss


def test_failsafe_comes_1_0_to_1_1_s_after_the_last_valid_setpoint(flying: Flight) -> None:
    flying.go_offboard()
    last_s = flying.now_s
    flying.run_while(lambda: flying.mode is Mode.OFFBOARD, 2.0)
    assert 1.0 <= flying.now_s - last_s <= 1.1


@pytest.mark.parametrize(("rate_hz", "holds"), [(1.2, True), (0.8, False)])
def test_a_stream_of_1_2_hz_holds_offboard_and_one_of_0_8_hz_flaps(rate_hz: float, holds: bool) -> None:
    flight = flying_with()
    flight.go_offboard()
    modes = set()
    for _ in flight.ticks(6.0, 50.0):
        if round(flight.now_s * 50.0) % round(50.0 / rate_hz) == 0:
            flight.send(flight.setpoint())
        modes.add(flight.mode)
    assert modes == ({Mode.OFFBOARD} if holds else {Mode.OFFBOARD, Mode.POSCTL})


def test_loss_time_follows_its_parameter() -> None:
    flight = flying_with(COM_OF_LOSS_T=0.4)
    flight.go_offboard()
    last_s = flight.now_s
    flight.run_while(lambda: flight.mode is Mode.OFFBOARD, 2.0)
    assert 0.4 <= flight.now_s - last_s <= 0.5


@pytest.mark.parametrize(
    ("action", "mode"),
    [
        (OffboardLossAction.POSITION, Mode.POSCTL),
        (OffboardLossAction.ALTITUDE, Mode.ALTCTL),
        (OffboardLossAction.STABILIZED, Mode.STABILIZED),
        (OffboardLossAction.RETURN, Mode.RTL),
        (OffboardLossAction.LAND, Mode.LAND),
        (OffboardLossAction.HOLD, Mode.LOITER),
        (OffboardLossAction.TERMINATE, Mode.TERMINATION),
    ],
)
def test_each_loss_action_flies_its_mode_and_shows_a_failsafe(action: OffboardLossAction, mode: Mode) -> None:
    flight = flying_with(COM_OBL_RC_ACT=int(action))
    flight.go_offboard()
    since_s = flight.now_s
    flight.run(3.2)
    assert flight.mode is mode
    assert flight.last("HEARTBEAT").system_status == (8 if mode is Mode.TERMINATION else 5)
    current = flight.of("CURRENT_MODE", since_s)[-1]
    assert current.custom_mode == mode.custom_mode
    assert current.intended_custom_mode == Mode.OFFBOARD.custom_mode


def test_loss_action_disarm_stops_the_motors() -> None:
    flight = flying_with(COM_OBL_RC_ACT=int(OffboardLossAction.DISARM))
    flight.go_offboard()
    flight.run(1.2)
    assert not flight.armed
    flight.run(1.5)
    assert flight.position.down == 0.0


def test_position_mode_without_a_pilot_sinks_at_0_7_m_s_to_the_ground(flying: Flight) -> None:
    flying.go_offboard()
    flying.run(4.0)
    assert flying.mode is Mode.POSCTL
    assert flying.velocity.down == pytest.approx(0.7, abs=0.05)
    flying.run_while(lambda: flying.armed, 30.0)
    assert flying.position.down == 0.0


def test_hold_and_land_and_return_do_what_they_say() -> None:
    for action in (OffboardLossAction.HOLD, OffboardLossAction.LAND, OffboardLossAction.RETURN):
        flight = flying_with(COM_OBL_RC_ACT=int(action), RTL_RETURN_ALT=8.0, RTL_MIN_DIST=1.0)
        flight.go_offboard(flight.setpoint(vx=2.0))
        flight.stream(flight.setpoint(vx=2.0), 4.0)
        lost = flight.position
        flight.run(40.0)
        if action is OffboardLossAction.HOLD:
            assert flight.armed
            assert flight.position.down == pytest.approx(lost.down, abs=0.3)
            assert 0.5 < flight.position.north - lost.north < 4.0
        else:
            assert not flight.armed
            away = flight.position.north - (0.0 if action is OffboardLossAction.RETURN else lost.north)
            assert abs(away) < (0.3 if action is OffboardLossAction.RETURN else 4.0)


@pytest.mark.parametrize(
    "action",
    [OffboardLossAction.POSITION, OffboardLossAction.RETURN, OffboardLossAction.LAND, OffboardLossAction.HOLD],
)
def test_resuming_the_stream_returns_to_offboard_by_itself(action: OffboardLossAction) -> None:
    flight = flying_with(COM_OBL_RC_ACT=int(action))
    flight.go_offboard()
    flight.run(2.0)
    assert flight.mode is not Mode.OFFBOARD
    flight.stream(flight.setpoint(vx=1.0), 2.0)
    assert flight.mode is Mode.OFFBOARD
    assert heartbeat(flight)[2] == 4
    assert flight.velocity.north > 0.7


def test_a_users_own_choice_is_kept_when_the_stream_resumes(flying: Flight) -> None:
    flying.go_offboard()
    assert flying.set_mode(Mode.LOITER) == 0
    flying.stream(flying.setpoint(vx=1.0), 2.0)
    assert flying.mode is Mode.LOITER
    assert abs(flying.velocity.north) < 0.1


# Masks and frames


@pytest.mark.parametrize(
    ("mask", "fields", "reason"),
    [
        (POSITION_AND_YAW, {"x": NAN, "y": NAN, "z": NAN}, "setpoint_empty"),
        (VELOCITY_AND_YAW, {"vx": NAN, "vy": NAN, "vz": NAN}, "setpoint_empty"),
        (0x9FF, {}, "setpoint_empty"),
        (ACCELERATION_AND_YAW | 1 << 9, {"afx": 1.0}, "setpoint_force"),
    ],
)
def test_setpoints_that_px4_drops_do_not_keep_offboard_alive(
    flying: Flight, mask: int, fields: dict[str, float], reason: str
) -> None:
    flying.go_offboard()
    flying.stream(flying.setpoint(mask, **fields), 1.3)
    assert flying.mode is Mode.POSCTL
    assert flying.autopilot.rejected[reason] == 65


def test_only_frames_1_and_8_are_taken(flying: Flight) -> None:
    taken = [f for f in range(22) if decode_setpoint(flying.setpoint(VELOCITY_AND_YAW, f), 0.0)[0] is not None]
    assert taken == [1, 8]
    flying.go_offboard()
    flying.stream(flying.setpoint(VELOCITY_AND_YAW, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT), 1.3)
    assert flying.mode is Mode.POSCTL


def test_one_velocity_axis_nan_stays_offboard_and_stands_still(flying: Flight) -> None:
    flying.go_offboard()
    flying.stream(flying.setpoint(vx=2.0, vy=NAN, vz=0.0), 4.0)
    assert flying.mode is Mode.OFFBOARD
    assert flying.velocity == pytest.approx((0.0, 0.0, 0.0), abs=0.05)


def test_body_frame_is_turned_by_the_heading(flying: Flight) -> None:
    flying.go_offboard()
    east = math.pi / 2.0
    flying.stream(flying.setpoint(yaw=east), 5.0)
    flying.stream(flying.setpoint(VELOCITY_AND_YAW, BODY, vx=1.0, yaw=east), 6.0)
    assert flying.velocity.east == pytest.approx(1.0, abs=0.1)
    assert abs(flying.velocity.north) < 0.1


@pytest.mark.parametrize(
    ("mask", "fields", "velocity"),
    [
        (VELOCITY_AND_YAW, {"vx": 1.0, "vy": -1.0}, (1.0, -1.0, 0.0)),
        (0xC07, {"vx": 1.0, "vz": -0.5}, (1.0, 0.0, -0.5)),
        (0xDC7, {"vx": 1.0, "vz": -0.5}, (1.0, 0.0, -0.5)),
        (VELOCITY_ACCELERATION_AND_YAW, {"vy": 2.0}, (0.0, 2.0, 0.0)),
        (0x903, {"vx": 1.0, "z": -5.0}, (1.0, 0.0, 0.0)),
        (VELOCITY_AND_YAW, {"vx": 20.0}, (12.0, 0.0, 0.0)),
        (VELOCITY_AND_YAW, {"vz": -9.0}, (0.0, 0.0, -3.0)),
    ],
)
def test_masks_select_what_is_flown(
    flying: Flight, mask: int, fields: dict[str, float], velocity: tuple[float, float, float]
) -> None:
    flying.go_offboard()
    flying.stream(flying.setpoint(mask, **fields), 12.0)
    assert flying.velocity == pytest.approx(velocity, abs=0.12)


def test_position_setpoint_is_reached_and_held_in_the_local_frame() -> None:
    flight = Flight(home_ned_m=Ned(10.0, -4.0, 0.0), ekf_origin_offset_m=Ned(2.0, 3.0, 0.5))
    flight.autopilot.set_interval_us(mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 20_000)
    flight.take_off()
    target = flight.setpoint(POSITION_AND_YAW, x=3.0, y=-2.0, z=-6.0, yaw=0.5)
    flight.go_offboard(target)
    flight.stream(target, 15.0)
    local = flight.last("LOCAL_POSITION_NED")
    assert (local.x, local.y, local.z) == pytest.approx((3.0, -2.0, -6.0), abs=0.05)
    assert flight.position == pytest.approx((15.0, -3.0, -5.5), abs=0.05)


def test_acceleration_alone_has_no_velocity_feedback(flying: Flight) -> None:
    flying.go_offboard()
    flying.stream(flying.setpoint(VELOCITY_AND_YAW, vx=1.0), 8.0)
    flying.stream(flying.setpoint(ACCELERATION_AND_YAW), 3.0)
    assert flying.mode is Mode.OFFBOARD
    assert flying.velocity.north > 0.5


def test_setpoint_for_another_vehicle_is_ignored(flying: Flight) -> None:
    flying.go_offboard()
    foreign = flying.setpoint()
    foreign.target_system = 9
    flying.stream(foreign, 1.3)
    assert flying.mode is Mode.POSCTL


# Step responses, as reported


@pytest.mark.parametrize("name", ["vel N 1 m/s", "vel N 3 m/s", "acc N 1.0 m/s2", "acc N 2.0 m/s2", "vel 20"])
def test_reported_velocity_answers_a_step_as_the_recorded_one_did(name: str) -> None:
    """Low drag on both sides; here without any estimator error. See tests/unit/test_dynamics.py for all the others."""
    recorded = next(row for row in STEPS if row["name"] == name)
    flight = Flight(dynamics=DynamicsParameters(drag_per_s=recorded["drag_per_s"]))
    flight.autopilot.set_interval_us(mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 20_000)
    flight.take_off(10.0)
    flight.go_offboard(flight.setpoint())
    flight.stream(flight.setpoint(), 3.0)
    value = float(name.split()[2]) if len(name.split()) > 2 else 20.0
    if name.startswith("acc"):
        step = flight.setpoint(0x83B, z=-10.0, afx=value)
    else:
        step = flight.setpoint(vx=value)
    begin_s = flight.now_s
    flight.stream(step, recorded["duration_s"])
    reports = [(t - begin_s, m.vx) for t, m in flight.received if t > begin_s and m.get_type() == "LOCAL_POSITION_NED"]
    times_s, speeds = np.array(reports).T
    own = response(times_s, speeds)
    assert own["t63_s"] == pytest.approx(recorded["response"]["t63_s"], rel=0.2)
    assert own["t90_s"] == pytest.approx(recorded["response"]["t90_s"], rel=0.2)
    assert own["final"] == pytest.approx(recorded["response"]["final"], rel=0.1)


# What is counted


def test_truth_counts_setpoints_and_the_longest_silence(flying: Flight) -> None:
    flying.go_offboard()
    before = flying.autopilot.truth().setpoint_count
    flying.stream(flying.setpoint(), 1.0)
    assert flying.autopilot.truth().setpoint_count == before + 50
    assert flying.autopilot.truth().setpoint_gap_max_s <= 0.024
    flying.run(0.3)
    flying.stream(flying.setpoint(), 0.5)
    assert flying.autopilot.truth().setpoint_gap_max_s == pytest.approx(0.32, abs=0.01)


# Take-off and landing by set-points


def test_offboard_velocity_takes_off_and_lands_without_landing_state_4() -> None:
    flight = Flight()
    flight.run(4.5)
    up, down = flight.setpoint(vz=-1.0), flight.setpoint(vz=0.7)
    flight.stream(up, 0.2)
    assert flight.set_mode(Mode.OFFBOARD) == 0
    flight.send(up)
    assert flight.arm() == 0
    flight.stream(up, 8.0)
    assert flight.position.down < -2.0
    flight.stream(down, 15.0)
    assert not flight.armed
    states = [message.landed_state for message in flight.of("EXTENDED_SYS_STATE")]
    assert 4 not in states
    assert [s for i, s in enumerate(states) if i == 0 or states[i - 1] != s] == [1, 2, 1]
