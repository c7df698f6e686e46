"""The stub's answers to commands: the table that was measured on PX4 1.16, row by row."""

import math

import pytest
from autopilot_flight import Flight, mavlink

from companion.core.frames import ned_to_geodetic
from sim.autopilot.modes import Mode

ACCEPTED, REJECTED, DENIED, UNSUPPORTED, FAILED = 0, 1, 2, 3, 4
SET_MODE = mavlink.MAV_CMD_DO_SET_MODE
NAN = math.nan


@pytest.fixture
def landed() -> Flight:
    flight = Flight()
    flight.run(5.0)
    return flight


@pytest.fixture
def flying() -> Flight:
    flight = Flight()
    flight.take_off()
    return flight


def test_arming_before_the_vehicle_is_ready_is_temporarily_rejected() -> None:
    flight = Flight()
    flight.run_until(3.9)
    assert flight.arm() == REJECTED
    flight.run_until(4.1)
    assert flight.arm() == ACCEPTED


def test_arming_in_offboard_without_a_stream_is_temporarily_rejected(landed: Flight) -> None:
    assert landed.set_mode(Mode.OFFBOARD) == ACCEPTED
    assert landed.arm() == REJECTED
    landed.stream(landed.setpoint(), 0.2)
    assert landed.arm() == ACCEPTED


def test_arming_what_is_armed_and_disarming_what_is_disarmed_is_accepted(landed: Flight) -> None:
    assert landed.disarm() == ACCEPTED
    assert landed.arm() == ACCEPTED
    assert landed.arm() == ACCEPTED
    assert landed.armed
    assert landed.disarm() == ACCEPTED
    assert not landed.armed


def test_disarming_in_flight_is_temporarily_rejected_unless_forced(flying: Flight) -> None:
    assert flying.disarm() == REJECTED
    assert flying.armed
    assert flying.disarm(force=True) == ACCEPTED
    assert not flying.armed
    flying.run(1.5)
    assert flying.position.down == 0.0  # it dropped


@pytest.mark.parametrize(
    ("command", "mode"),
    [
        (mavlink.MAV_CMD_NAV_TAKEOFF, Mode.TAKEOFF),
        (mavlink.MAV_CMD_NAV_LAND, Mode.LAND),
        (mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH, Mode.RTL),
    ],
)
def test_take_off_land_and_return_are_accepted_while_disarmed_and_change_the_mode(
    landed: Flight, command: int, mode: Mode
) -> None:
    assert landed.command(command, 0, 0, 0, NAN, 0, 0, NAN) == ACCEPTED
    assert landed.mode is mode
    assert not landed.armed


def test_take_off_without_an_altitude_climbs_2_5_m(landed: Flight) -> None:
    assert landed.arm() == ACCEPTED
    assert landed.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, NAN, NAN, NAN, NAN) == ACCEPTED
    landed.run(15.0)
    assert landed.mode is Mode.LOITER
    assert landed.position.down == pytest.approx(-2.5, abs=0.1)


def test_manual_mode_without_a_pilot_is_accepted_on_the_ground_and_rejected_in_flight(
    landed: Flight, flying: Flight
) -> None:
    for mode in (Mode.POSCTL, Mode.ALTCTL, Mode.STABILIZED, Mode.MANUAL, Mode.ACRO):
        assert landed.set_mode(mode) == ACCEPTED
        assert landed.mode is mode
        assert flying.set_mode(mode) == REJECTED
        assert flying.mode is Mode.LOITER


def test_mission_mode_without_a_mission_is_rejected_in_flight(flying: Flight) -> None:
    assert flying.set_mode(Mode.MISSION) == REJECTED
    assert flying.command(mavlink.MAV_CMD_MISSION_START) == REJECTED


def test_modes_that_do_not_exist_change_nothing(flying: Flight) -> None:
    unknown_sub_mode, unknown_main_mode, no_custom_flag = (1, 4, 99), (1, 77, 0), (0, 6, 0)
    assert flying.command(SET_MODE, *unknown_sub_mode) == REJECTED
    assert flying.command(SET_MODE, *unknown_main_mode) == ACCEPTED
    assert flying.command(SET_MODE, *no_custom_flag) == ACCEPTED
    assert flying.mode is Mode.LOITER


def test_unknown_command_is_unsupported(landed: Flight) -> None:
    assert landed.command(31999) == UNSUPPORTED


def test_request_of_a_message_that_is_not_available_is_denied(landed: Flight) -> None:
    assert landed.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION) == DENIED


@pytest.mark.parametrize(
    "name", ["GPS_GLOBAL_ORIGIN", "AUTOPILOT_VERSION", "HOME_POSITION", "LOCAL_POSITION_NED", "ESTIMATOR_STATUS"]
)
def test_requested_message_comes_once(landed: Flight, name: str) -> None:
    since_s = landed.now_s
    message_id = getattr(mavlink, f"MAVLINK_MSG_ID_{name}")
    assert landed.command(mavlink.MAV_CMD_REQUEST_MESSAGE, message_id) == ACCEPTED
    landed.run(0.1)
    assert len(landed.of(name, since_s)) == 1


def test_interval_of_an_unknown_message_fails(landed: Flight) -> None:
    assert landed.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 9999, 20_000) == FAILED


@pytest.mark.parametrize(("interval_us", "rate_hz"), [(20_000, 50), (100_000, 10), (0, 30), (-1, 0)])
def test_message_interval_changes_the_rate(landed: Flight, interval_us: float, rate_hz: int) -> None:
    message_id = mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED
    assert landed.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, interval_us) == ACCEPTED
    since_s = landed.now_s
    landed.run(4.0)
    assert len(landed.of("LOCAL_POSITION_NED", since_s)) == pytest.approx(4 * rate_hz, abs=1)
    assert landed.command(mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, message_id) == ACCEPTED
    expected = -1 if rate_hz == 0 else 1e6 / rate_hz
    assert landed.last("MESSAGE_INTERVAL").interval_us == pytest.approx(expected, abs=1)


def test_reposition_in_offboard_holds_at_the_place_given(flying: Flight) -> None:
    flying.go_offboard()
    origin = flying.autopilot.telemetry.projection.origin
    there = ned_to_geodetic(flying.position._replace(north=6.0, east=-3.0, down=-7.0), origin)
    flying.send(
        mavlink.MAVLink_command_int_message(
            1,
            1,
            0,
            mavlink.MAV_CMD_DO_REPOSITION,
            0,
            0,
            -1,
            1,
            0,
            NAN,
            round(there.latitude_deg * 1e7),
            round(there.longitude_deg * 1e7),
            there.altitude_amsl_m,
        )
    )
    flying.run(0.02)
    assert flying.last("COMMAND_ACK").result == ACCEPTED
    assert flying.mode is Mode.LOITER
    flying.run(20.0)
    assert flying.position == pytest.approx((6.0, -3.0, -7.0), abs=0.1)


@pytest.mark.parametrize("target", [(2, 1), (1, 2), (7, 0)])
def test_command_to_somebody_else_gets_no_answer(landed: Flight, target: tuple[int, int]) -> None:
    assert landed.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1, target=target) is None
    assert not landed.armed


def test_command_to_component_0_is_answered(landed: Flight) -> None:
    assert landed.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1, target=(1, 0)) == ACCEPTED


def test_acknowledgement_comes_within_20_ms_to_the_sender(landed: Flight) -> None:
    landed.run(0.0013)
    sent_s = landed.now_s
    landed.send(
        mavlink.MAVLink_command_long_message(1, 1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0),
        system=250,
        component=190,
    )
    landed.run(0.02)
    time_s, answer = next((t, m) for t, m in landed.received if m.get_type() == "COMMAND_ACK")
    assert 0.0 <= time_s - sent_s <= 0.02
    assert (answer.target_system, answer.target_component) == (250, 190)


def test_termination_stops_the_motors_and_is_never_left(flying: Flight) -> None:
    assert flying.command(mavlink.MAV_CMD_DO_FLIGHTTERMINATION, 1) == ACCEPTED
    flying.run(1.2)
    assert flying.last("HEARTBEAT").system_status == 8
    assert flying.last("HEARTBEAT").custom_mode >> 16 & 0xFF == 10
    assert flying.set_mode(Mode.LOITER) == REJECTED
    flying.run(2.0)
    assert flying.position.down == 0.0


def test_reboot_is_refused_in_flight_and_restarts_the_clock_on_the_ground(landed: Flight, flying: Flight) -> None:
    assert flying.command(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == REJECTED
    assert landed.command(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == ACCEPTED
    since_s = landed.now_s
    landed.run(3.0)
    assert landed.of("HEARTBEAT", since_s)
    assert landed.of("SYSTEM_TIME", since_s)[0].time_boot_ms < 2000
