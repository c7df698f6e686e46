"""Parameters, missions, files, time and ping as PX4 answers them; and what a hostile link may send."""

import struct
from typing import Any

import pytest
from autopilot_flight import Flight, mavlink
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.vehicle.autopilot.px4_versions import OLDEST
from sim.autopilot.autopilot import STEP_NS
from sim.autopilot.modes import Mode
from sim.autopilot.parameters import ParameterTable, defaults

INT32, REAL32 = mavlink.MAV_PARAM_TYPE_INT32, mavlink.MAV_PARAM_TYPE_REAL32


NAMES = sorted(defaults(OLDEST))


@pytest.fixture
def flight() -> Flight:
    flight = Flight()
    flight.run(5.0)
    return flight


def as_float(value: int) -> float:
    return float(struct.unpack("<f", struct.pack("<i", value))[0])


def as_int(value: float) -> int:
    return int(struct.unpack("<i", struct.pack("<f", value))[0])


def read(flight: Flight, name: str) -> list[Any]:
    since_s = flight.now_s
    flight.send(mavlink.MAVLink_param_request_read_message(1, 1, name.encode(), -1))
    flight.run(0.02)
    return flight.of("PARAM_VALUE", since_s)


def write(flight: Flight, name: str, value: float, kind: int) -> list[Any]:
    since_s = flight.now_s
    flight.send(mavlink.MAVLink_param_set_message(1, 1, name.encode(), value, kind))
    flight.run(0.02)
    return flight.of("PARAM_VALUE", since_s)


# Parameters


def test_list_begins_with_the_hash_and_has_every_parameter_once_in_order(flight: Flight) -> None:
    flight.send(mavlink.MAVLink_param_request_list_message(1, 1))
    flight.run(2.0)
    values = flight.of("PARAM_VALUE")
    assert (values[0].param_id, values[0].param_index, values[0].param_type) == ("_HASH_CHECK", 65535, 5)
    assert [message.param_id for message in values[1:]] == NAMES
    assert [message.param_index for message in values[1:]] == list(range(len(NAMES)))
    assert {message.param_count for message in values} == {len(NAMES)}


def test_int32_is_carried_bytewise_and_float_as_it_is(flight: Flight) -> None:
    (autostart,) = read(flight, "SYS_AUTOSTART")
    assert (autostart.param_type, as_int(autostart.param_value)) == (INT32, 10040)
    (loss,) = read(flight, "COM_OF_LOSS_T")
    assert (loss.param_type, loss.param_value) == (REAL32, 1.0)


def test_negative_int32_survives_the_float_that_carries_it(flight: Flight) -> None:
    (mode,) = read(flight, "COM_FLTMODE1")
    assert as_int(mode.param_value) == -1


def test_parameter_is_read_by_index_too(flight: Flight) -> None:
    index = NAMES.index("MAV_SYS_ID")
    flight.send(mavlink.MAVLink_param_request_read_message(1, 1, b"", index))
    flight.run(0.02)
    assert flight.last("PARAM_VALUE").param_id == "MAV_SYS_ID"
    assert as_int(flight.last("PARAM_VALUE").param_value) == 1


def test_change_is_echoed_twice_and_the_same_value_once(flight: Flight) -> None:
    assert [m.param_value for m in write(flight, "MPC_XY_VEL_MAX", 8.0, REAL32)] == [8.0, 8.0]
    assert [m.param_value for m in write(flight, "MPC_XY_VEL_MAX", 8.0, REAL32)] == [8.0]
    assert [as_int(m.param_value) for m in write(flight, "COM_OBL_RC_ACT", as_float(5), INT32)] == [5, 5]


@pytest.mark.parametrize(
    ("name", "value", "kind"),
    [("NO_SUCH_PARAM", 1.0, REAL32), ("COM_OBL_RC_ACT", 5.0, REAL32), ("COM_OF_LOSS_T", as_float(2), INT32)],
)
def test_unknown_name_or_wrong_type_gets_no_answer_and_changes_nothing(
    flight: Flight, name: str, value: float, kind: int
) -> None:
    assert write(flight, name, value, kind) == []
    assert flight.autopilot.rejected["parameter"] == 1
    assert flight.autopilot.parameters.integer("COM_OBL_RC_ACT") == 0
    assert flight.autopilot.parameters.number("COM_OF_LOSS_T") == 1.0


@pytest.mark.parametrize(
    ("name", "value", "kind", "error"),
    [("NO_SUCH_PARAM", 1.0, REAL32, 1), ("COM_OBL_RC_ACT", 5.0, REAL32, 7), ("COM_OF_LOSS_T", as_float(2), INT32, 7)],
)
def test_of_versions_that_say_it_a_wrong_setting_is_answered_by_an_error(
    name: str, value: float, kind: int, error: int
) -> None:
    flight = Flight(px4="1.18")
    flight.run(5.0)
    assert write(flight, name, value, kind) == []
    (said,) = flight.of("PARAM_ERROR")
    assert (said.param_id, said.error) == (name, error)


def test_unknown_parameter_is_not_answered(flight: Flight) -> None:
    assert read(flight, "NO_SUCH_PARAM") == []
    assert flight.of("PARAM_ERROR") == []


def test_since_1_18_an_unknown_parameter_is_answered_by_an_error() -> None:
    flight = Flight(px4="1.18")
    flight.run(5.0)
    assert read(flight, "NO_SUCH_PARAM") == []
    (error,) = flight.of("PARAM_ERROR")
    assert (error.param_id, error.error) == ("NO_SUCH_PARAM", mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST)


def test_hash_changes_with_a_value(flight: Flight) -> None:
    before = read(flight, "_HASH_CHECK")[0].param_value
    write(flight, "MPC_XY_VEL_MAX", 8.0, REAL32)
    assert read(flight, "_HASH_CHECK")[0].param_value != before


def test_overrides_of_what_px4_does_not_know_are_refused() -> None:
    with pytest.raises(ValueError, match="'COM_NONSENSE' is not known"):
        ParameterTable({"COM_NONSENSE": 1})
    with pytest.raises(ValueError, match="COM_OBL_RC_ACT is an INT32"):
        ParameterTable({"COM_OBL_RC_ACT": 4.0})


# Parameters act


def test_velocity_limits_follow_their_parameters_at_once() -> None:
    flight = Flight()
    flight.take_off(20.0)
    write(flight, "MPC_XY_VEL_MAX", 2.0, REAL32)
    write(flight, "MPC_Z_VEL_MAX_UP", 0.5, REAL32)
    write(flight, "MPC_Z_VEL_MAX_DN", 0.4, REAL32)
    flight.go_offboard()
    flight.stream(flight.setpoint(vx=9.0, vz=-9.0), 8.0)
    assert flight.velocity.north == pytest.approx(2.0, abs=0.1)
    assert flight.velocity.down == pytest.approx(-0.5, abs=0.05)
    flight.stream(flight.setpoint(vz=9.0), 8.0)
    assert flight.velocity.down == pytest.approx(0.4, abs=0.05)


def test_take_off_altitude_and_landing_speed_follow_their_parameters() -> None:
    flight = Flight(parameters={"MIS_TAKEOFF_ALT": 6.0, "MPC_LAND_SPEED": 1.2, "MPC_TKO_SPEED": 2.5})
    flight.run(4.5)
    flight.arm()
    flight.set_mode(Mode.TAKEOFF)
    flight.run(14.0)
    assert flight.position.down == pytest.approx(-6.0, abs=0.2)
    flight.set_mode(Mode.LAND)
    flight.run(2.5)
    assert flight.velocity.down == pytest.approx(1.2, abs=0.1)


def test_disarm_delays_follow_their_parameters() -> None:
    flight = Flight(parameters={"COM_DISARM_PRFLT": 3.0})
    flight.run(4.5)
    flight.arm()
    flight.run(2.9)
    assert flight.armed
    flight.run(0.2)
    assert not flight.armed


def test_system_id_parameter_acts_after_a_reboot(flight: Flight) -> None:
    write(flight, "MAV_SYS_ID", as_float(42), INT32)
    flight.run(1.0)
    assert flight.last("HEARTBEAT").get_srcSystem() == 1
    flight.command(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1)
    flight.run(3.0)
    assert flight.last("HEARTBEAT").get_srcSystem() == 42


@pytest.mark.parametrize("value", [0.0, -3.0, 1e30])
def test_no_value_of_a_parameter_stops_the_autopilot(value: float) -> None:
    flight = Flight()
    flight.take_off()
    flight.go_offboard()
    for name, default in defaults(OLDEST).items():
        if isinstance(default, float):
            write(flight, name, value, REAL32)
            flight.stream(flight.setpoint(vx=1.0, vz=-0.2), 0.1)
            flight.set_mode(Mode.LOITER)
            flight.run(0.1)
            write(flight, name, default, REAL32)
            flight.go_offboard()
    assert flight.last("HEARTBEAT")


def test_parameter_that_is_no_number_is_refused(flight: Flight) -> None:
    assert write(flight, "COM_OF_LOSS_T", float("nan"), REAL32) == []
    assert write(flight, "COM_OF_LOSS_T", float("inf"), REAL32) == []


# Missions, files, time


@pytest.mark.parametrize("mission_type", [0, 1, 2])
def test_mission_fence_and_rally_lists_are_empty(flight: Flight, mission_type: int) -> None:
    flight.send(mavlink.MAVLink_mission_request_list_message(1, 1, mission_type))
    flight.run(0.02)
    message = flight.last("MISSION_COUNT")
    assert (message.count, message.mission_type, message.target_component) == (0, mission_type, 191)


def test_clearing_is_acknowledged_and_uploading_refused(flight: Flight) -> None:
    flight.send(mavlink.MAVLink_mission_clear_all_message(1, 1, 0))
    flight.run(0.02)
    assert flight.last("MISSION_ACK").type == mavlink.MAV_MISSION_ACCEPTED
    flight.send(mavlink.MAVLink_mission_count_message(1, 1, 3, 0))
    flight.run(0.02)
    assert flight.last("MISSION_ACK").type == mavlink.MAV_MISSION_NO_SPACE


def test_file_transfer_is_refused_with_a_nak(flight: Flight) -> None:
    open_read_only = 4
    request = struct.pack("<HBBBBBBI", 7, 0, open_read_only, 5, 0, 0, 0, 0) + b"x.txt"
    flight.send(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, list(request.ljust(251, b"\0"))))
    flight.run(0.02)
    answer = flight.last("FILE_TRANSFER_PROTOCOL")
    sequence, _, opcode, size, answered = struct.unpack_from("<HBBBB", bytes(answer.payload))
    assert (sequence, opcode, size, answered) == (8, 129, 1, open_read_only)
    assert (answer.target_system, answer.target_component) == (1, 191)


def test_timesync_answers_with_its_boot_time_and_mirrors_ours(flight: Flight) -> None:
    flight.send(mavlink.MAVLink_timesync_message(0, 123_456_789))
    flight.run(0.02)
    answer = flight.last("TIMESYNC")
    assert answer.ts1 == 123_456_789
    assert abs(answer.tc1 - 5_000_000_000) <= STEP_NS
    before = len(flight.of("TIMESYNC"))
    flight.send(mavlink.MAVLink_timesync_message(5, 6))
    flight.run(0.02)
    assert len(flight.of("TIMESYNC")) == before  # an answer is not answered


def test_ping_is_mirrored_to_its_sender(flight: Flight) -> None:
    flight.send(mavlink.MAVLink_ping_message(987, 3, 0, 0))
    flight.run(0.02)
    answer = flight.last("PING")
    assert (answer.time_usec, answer.seq, answer.target_system, answer.target_component) == (987, 3, 1, 191)


# Whatever arrives


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=600))
def test_garbage_is_survived_and_a_good_message_still_understood(garbage: bytes) -> None:
    flight = Flight()
    flight.run(4.5)
    flight.autopilot.receive(garbage, flight.now_ns)
    flight.autopilot.receive(b"\0" * 300, flight.now_ns)
    assert flight.arm() == 0


def test_message_of_a_type_nobody_expects_is_ignored(flight: Flight) -> None:
    before = len(flight.received)
    flight.send(mavlink.MAVLink_attitude_message(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    flight.run(0.004)
    assert len(flight.received) == before
