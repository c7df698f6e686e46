"""The stub's streams against a recorded flight of a real PX4 1.16: types, rates, ranges, and one truth behind them.

tests/golden/px4_streams.json comes from `python tests/golden/make_px4_golden.py RECORDINGS`: of every message type in
the recording how often it came (per second of the autopilot's own clock) and the range of every field. The stub flies
the same 62 s here: idle, arm, take-off to 5 m, 5 m north by offboard velocity, land, disarm.
"""

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from autopilot_flight import UTC_OFFSET_NS, Flight, mavlink

from companion.core.frames import Geodetic, Ned, geodetic_to_ned, ned_to_geodetic
from sim.autopilot.disturbances import GustParameters, NoiseParameters
from sim.autopilot.dynamics_parameters import DynamicsParameters
from sim.autopilot.modes import Mode
from sim.autopilot.streams import STREAMS
from sim.autopilot.telemetry import Projection, to_body

RECORDED = json.loads((Path(__file__).parents[1] / "golden" / "px4_streams.json").read_text())
RECORDING_BEGINS_S = 13.24
"""time since boot of the first recorded message"""
DURATION_S = RECORDED["duration_s"]

ABSENT = {
    "CURRENT_EVENT_SEQUENCE": "asks for events to be sent again, which the stub does not do",
    "COMMAND_LONG": "commands to a gimbal that is not there",
    "LINK_NODE_STATUS": "statistics of PX4's own link",
    "OPEN_DRONE_ID_LOCATION": "remote identification, for transponders",
    "OPEN_DRONE_ID_SYSTEM": "remote identification, for transponders",
    "SCALED_PRESSURE": "HIGHRES_IMU has the pressure",
    "TIME_ESTIMATE_TO_TARGET": "there are no missions",
}
"""recorded types that the stub does not send, and why"""
FLOWN_DIFFERENTLY = {"COMMAND_ACK", "EVENT"}
"""answers and incidents, not streams"""
EVENT_TYPE = "UNKNOWN_410"
"""EVENT, which pymavlink does not know"""
CLOCKS = {"time_boot_ms", "time_usec", "time_unix_usec", "ts1", "seq", "timestamp"}
"""fields that tell the time"""
LOOSE = {
    # Values that depend on the wind, the noise and the path of that one flight: at each end the range may be wider by
    # this much and a quarter of its width.
    "vx": 0.6, "vy": 0.6, "vz": 1.0, "x": 1.5, "y": 1.5, "z": 1.0,
    "roll": 0.1, "pitch": 0.1, "yaw": 0.3, "q2": 0.05, "q3": 0.05, "q4": 0.15,
    "rollspeed": 0.8, "pitchspeed": 0.8, "yawspeed": 0.3, "xgyro": 0.8, "ygyro": 0.8, "zgyro": 0.3,
    "body_roll_rate": 0.8, "body_pitch_rate": 0.8, "body_yaw_rate": 0.3,
    "xacc": 1.0, "yacc": 1.0, "zacc": 1.0, "afx": 1.5, "afy": 1.5, "afz": 3.0, "yaw_rate": 0.3,
    "xmag": 0.1, "ymag": 0.1, "zmag": 0.1,
    "lat": 100, "lon": 150, "lat_int": 100, "lon_int": 150, "latitude": 100, "longitude": 150,
    "alt": 1500, "relative_alt": 1000, "altitude": 1500, "alt_ellipsoid": 1500,
    "altitude_amsl": 1.0, "altitude_monotonic": 1.5, "altitude_local": 1.0, "altitude_relative": 1.0,
    "altitude_terrain": 1.0, "bottom_clearance": 0.5, "pressure_alt": 2.5, "abs_pressure": 40.0,
    "groundspeed": 0.5, "climb": 0.5, "vel": 60, "current_distance": 50, "throttle": 15, "thrust": 0.2,
    "servo1_raw": 150, "servo2_raw": 150, "servo3_raw": 150, "servo4_raw": 150,
    "voltage_battery": 50, "battery_remaining": 3, "pos_horiz_ratio": 0.05, "vel_ratio": 0.1,
    "vibration_y": 0.1, "vibration_z": 1.0, "vibration_x": 1e-8,
}  # fmt: skip
UNLIKE_THE_RECORDING = {
    ("ALTITUDE", "altitude_monotonic"): "the stub has no barometer drift: all altitudes are one",
    ("ODOMETRY", "reset_counter"): "counts from boot; how it steps is checked below",
    ("HIGHRES_IMU", "fields_updated"): "always the inertial sensors",
    ("SYS_STATUS", "onboard_control_sensors_present"): "a sensor drops out in the recording after landing",
    ("SYS_STATUS", "onboard_control_sensors_enabled"): "likewise",
    ("POSITION_TARGET_GLOBAL_INT", "alt"): "of the take-off; the stub reports the reference on its way",
    ("POSITION_TARGET_LOCAL_NED", "type_mask"): "checked by itself below",
}


@pytest.fixture(scope="module")
def flight() -> Flight:
    """The recorded flight, flown by the stub; the companion listens from the time the recording began."""
    flight = Flight(
        dynamics=DynamicsParameters(drag_per_s=1.0),
        gust=GustParameters(sigma_m_s2=0.3),
        noise=NoiseParameters(),
        quiet=False,
    )
    flight.run_until(RECORDING_BEGINS_S)
    begin_s = flight.now_s
    flight.run_until(begin_s + 5.0)
    assert flight.arm() == 0
    flight.run_until(begin_s + 6.0)
    altitude = flight.autopilot.telemetry.altitude_amsl_m + 5.0
    assert flight.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, math.nan, 0, 0, altitude) == 0
    flight.run_until(begin_s + 20.3)
    flight.go_offboard(flight.setpoint(0xC07))
    flight.stream(flight.setpoint(0xC07), 2.5)
    flight.stream(flight.setpoint(0xC07, vx=1.0), 6.0)
    flight.stream(flight.setpoint(0xC07), 4.8)
    assert flight.command(mavlink.MAV_CMD_NAV_LAND, 0, 0, 0, math.nan) == 0
    flight.run_until(begin_s + DURATION_S)
    flight.received = [(time_s, message) for time_s, message in flight.received if time_s >= begin_s]
    return flight


@pytest.fixture(scope="module")
def by_type(flight: Flight) -> dict[str, list[Any]]:
    collected: dict[str, list[Any]] = {}
    for _, message in flight.received:
        name = "EVENT" if message.get_type() == EVENT_TYPE else message.get_type()
        collected.setdefault(name, []).append(message)
    return collected


def test_stub_sends_every_recorded_type_but_those_listed_with_a_reason(by_type: dict[str, list[Any]]) -> None:
    assert set(RECORDED["types"]) - set(by_type) == set(ABSENT)
    assert set(by_type) <= set(RECORDED["types"])


@pytest.mark.parametrize("name", sorted(set(RECORDED["types"]) - set(ABSENT) - FLOWN_DIFFERENTLY))
def test_rate_is_the_recorded_one(by_type: dict[str, list[Any]], name: str) -> None:
    recorded = RECORDED["types"][name]
    if name == "POSITION_TARGET_GLOBAL_INT":
        # Only in automatic modes, which the two flights did not spend equally long in.
        assert len(by_type[name]) == pytest.approx(recorded["count"], rel=0.25)
    else:
        assert len(by_type[name]) / DURATION_S == pytest.approx(recorded["rate_hz"], rel=0.01, abs=1.5 / DURATION_S)


def test_all_streams_together_are_the_measured_407_messages_a_second(flight: Flight) -> None:
    assert len(flight.received) / DURATION_S == pytest.approx(407.0, rel=0.02)


NEWER_THAN_THE_DIALECT = {
    ("MISSION_CURRENT", "mission_id"),
    ("MISSION_CURRENT", "fence_id"),
    ("MISSION_CURRENT", "rally_points_id"),
    ("TIMESYNC", "target_system"),
    ("TIMESYNC", "target_component"),
}
"""extension fields that pymavlink 2.4 does not know"""
FIELDS = [
    (name, field)
    for name, entry in sorted(RECORDED["types"].items())
    if name not in ABSENT and name not in FLOWN_DIFFERENTLY
    for field in entry["fields"]
    if field not in CLOCKS and (name, field) not in UNLIKE_THE_RECORDING and (name, field) not in NEWER_THAN_THE_DIALECT
]


@pytest.mark.parametrize(("name", "field"), FIELDS)
def test_field_stays_within_its_recorded_range(by_type: dict[str, list[Any]], name: str, field: str) -> None:
    recorded = RECORDED["types"][name]["fields"][field]
    values = [getattr(message, field) for message in by_type[name]]
    finite = [value for value in values if not math.isnan(value)]
    if len(finite) < len(values):
        assert recorded.get("may_be_nan"), "the recording has no NaN here"
    if field in LOOSE:
        slack = LOOSE[field] + 0.25 * (recorded["max"] - recorded["min"])
    elif "values" in recorded:
        assert set(finite) <= set(recorded["values"])
        return
    else:
        slack = 0.25 * (recorded["max"] - recorded["min"]) + 1e-6
    assert min(finite) >= recorded["min"] - slack
    assert max(finite) <= recorded["max"] + slack


@pytest.mark.parametrize(
    ("name", "field"),
    [
        ("HEARTBEAT", "base_mode"),
        ("HEARTBEAT", "custom_mode"),
        ("HEARTBEAT", "system_status"),
        ("EXTENDED_SYS_STATE", "landed_state"),
        ("CURRENT_MODE", "custom_mode"),
        ("CURRENT_MODE", "standard_mode"),
        ("POSITION_TARGET_LOCAL_NED", "type_mask"),
        ("SYS_STATUS", "onboard_control_sensors_health"),
    ],
)
def test_states_are_those_recorded_all_of_them(by_type: dict[str, list[Any]], name: str, field: str) -> None:
    recorded = set(RECORDED["types"][name]["fields"][field]["values"])
    if name == "SYS_STATUS":
        recorded.discard(52480031)  # a sensor that drops out after landing
    assert {getattr(message, field) for message in by_type[name]} == recorded


def test_events_mark_the_turns_of_the_flight_with_a_valid_checksum(flight: Flight) -> None:
    turns = []
    for packet in flight.datagrams:
        if int.from_bytes(packet[7:10], "little") == 410:
            event_crc_extra = 160
            checksum = mavlink.x25crc(packet[1:-2] + bytes([event_crc_extra])).crc
            assert packet[-2:] == struct.pack("<H", checksum)
            turns.append(struct.unpack_from("<I", packet, 10)[0])
    assert turns == [26266355, 21054825, 20099806, 26622124, 32794487]  # armed, off, landing, landed, disarmed


# Times


def test_time_stamps_are_on_px4s_grids(by_type: dict[str, list[Any]]) -> None:
    assert all(message.time_boot_ms % 8 == 0 for message in by_type["LOCAL_POSITION_NED"])
    assert all(message.time_boot_ms % 4 == 0 for message in by_type["POSITION_TARGET_LOCAL_NED"])
    gaps = set(np.diff([message.time_boot_ms for message in by_type["ATTITUDE"]]))
    assert gaps <= {8, 16}


def test_system_time_is_utc_and_boot_time_together(by_type: dict[str, list[Any]]) -> None:
    for message in by_type["SYSTEM_TIME"]:
        assert message.time_unix_usec * 1000 - message.time_boot_ms * 1_000_000 == UTC_OFFSET_NS


def test_heartbeat_is_strictly_1_hz(flight: Flight) -> None:
    times = [time_s for time_s, message in flight.received if message.get_type() == "HEARTBEAT"]
    assert np.diff(times) == pytest.approx(1.0, abs=0.005)


def test_sequence_numbers_count_every_message_of_the_link(flight: Flight) -> None:
    numbers = [datagram[4] for datagram in flight.datagrams]
    assert set(np.diff(numbers) % 256) == {1}


# One truth behind all of them


def paired(by_type: dict[str, list[Any]], first: str, second: str) -> list[tuple[Any, Any]]:
    def stamp(message: Any) -> int:
        return int(message.time_boot_ms if hasattr(message, "time_boot_ms") else message.time_usec // 1000)

    seconds = {stamp(message): message for message in by_type[second]}
    pairs = [(message, seconds[stamp(message)]) for message in by_type[first] if stamp(message) in seconds]
    assert len(pairs) > 100
    return pairs


def test_local_and_global_position_are_one_estimate(by_type: dict[str, list[Any]], flight: Flight) -> None:
    origin = flight.autopilot.telemetry.projection.origin
    for local, globe in paired(by_type, "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT"):
        point = Geodetic(globe.lat / 1e7, globe.lon / 1e7, globe.alt / 1e3)
        assert geodetic_to_ned(point, origin) == pytest.approx((local.x, local.y, local.z), abs=0.01)
        assert (globe.vx, globe.vy, globe.vz) == pytest.approx(
            (local.vx * 100, local.vy * 100, local.vz * 100), abs=0.51
        )


def test_odometry_is_local_position_with_the_attitude(by_type: dict[str, list[Any]]) -> None:
    for odometry, local in paired(by_type, "ODOMETRY", "LOCAL_POSITION_NED"):
        assert (odometry.x, odometry.y, odometry.z) == (local.x, local.y, local.z)
        assert (odometry.vx, odometry.vy, odometry.vz) == (local.vx, local.vy, local.vz)
        assert math.hypot(*odometry.q) == pytest.approx(1.0, abs=1e-6)


def test_quaternion_and_angles_are_one_attitude(by_type: dict[str, list[Any]]) -> None:
    for turned, angles in paired(by_type, "ATTITUDE_QUATERNION", "ATTITUDE"):
        down = to_body((0.0, 0.0, 1.0), angles.roll, angles.pitch, angles.yaw)
        w, x, y, z = turned.q1, turned.q2, turned.q3, turned.q4
        rotated = (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
        assert rotated == pytest.approx(down, abs=1e-5)


def test_attitude_is_that_of_the_acceleration_flown() -> None:
    """A multicopter's thrust is along its own vertical: along its other axes it feels nothing but drag."""
    flight = Flight(dynamics=DynamicsParameters(drag_per_s=1.0), quiet=False)
    flight.take_off()
    flight.go_offboard()
    since_s = flight.now_s
    flight.stream(flight.setpoint(vx=1.5, vy=-1.0, vz=-0.5, yaw=0.7), 4.0)
    attitudes = {message.time_boot_ms: message for message in flight.of("ATTITUDE", since_s)}
    velocities = {message.time_boot_ms: message for message in flight.of("LOCAL_POSITION_NED", since_s)}
    tilt = max(math.hypot(message.roll, message.pitch) for message in attitudes.values())
    assert tilt > 0.2
    compared = 0
    for imu in flight.of("HIGHRES_IMU", since_s):
        attitude, local = attitudes.get(imu.time_usec // 1000), velocities.get(imu.time_usec // 1000)
        if attitude is not None and local is not None:
            angles = attitude.roll, attitude.pitch, attitude.yaw
            forward, right, _ = to_body((-local.vx, -local.vy, -local.vz), *angles)
            assert (imu.xacc, imu.yacc) == pytest.approx((forward, right), abs=0.03)
            compared += 1
    assert compared > 20


def test_position_target_says_what_flies(by_type: dict[str, list[Any]]) -> None:
    cruising = [m for m in by_type["POSITION_TARGET_LOCAL_NED"] if m.type_mask == 7 and m.vx == 1.0]
    assert len(cruising) == pytest.approx(60, abs=2)
    idle = [m for m in by_type["POSITION_TARGET_LOCAL_NED"] if m.type_mask == 63]
    assert all(m.afz == 100.0 and math.isnan(m.x) for m in idle)


def test_battery_drains_while_armed_to_half_and_is_full_again_when_disarmed(by_type: dict[str, list[Any]]) -> None:
    remaining = [message.battery_remaining for message in by_type["SYS_STATUS"]]
    assert remaining[0] == remaining[-1] == 100
    assert min(remaining) == 50
    assert by_type["BATTERY_STATUS"][0].voltages[0] == 16200


def test_reset_counter_steps_once_in_the_climb_with_a_few_centimetres(by_type: dict[str, list[Any]]) -> None:
    counters = [message.reset_counter for message in by_type["ODOMETRY"]]
    (step,) = np.flatnonzero(np.diff(counters))
    before, after = by_type["ODOMETRY"][step], by_type["ODOMETRY"][step + 1]
    assert -2.5 < after.z < -1.0
    assert abs(after.z - before.z - before.vz / 30.0) < 0.15


# After boot


def test_first_heartbeat_comes_1_6_s_after_boot_and_the_origin_once_at_1_8_s() -> None:
    flight = Flight(quiet=False, boot_s=100.0)
    flight.run_until(106.0)
    assert next(t for t, m in flight.received if m.get_type() == "HEARTBEAT") == pytest.approx(101.6)
    origins = [t for t, m in flight.received if m.get_type() == "GPS_GLOBAL_ORIGIN"]
    assert origins == pytest.approx([101.8])
    assert next(t for t, m in flight.received if m.get_type() == "HOME_POSITION") == pytest.approx(103.6, abs=2.0)
    assert [m.system_status for m in flight.of("HEARTBEAT")] == [0, 0, 0, 3, 3]


def test_origin_reported_is_home_plus_the_offset_and_positions_are_relative_to_it() -> None:
    home, offset = Ned(20.0, -8.0, -1.0), Ned(1.5, 2.5, 0.75)
    flight = Flight(home_ned_m=home, ekf_origin_offset_m=offset, quiet=False)
    flight.run(5.0)
    message = flight.last("GPS_GLOBAL_ORIGIN")
    origin = Geodetic(message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3)
    expected = ned_to_geodetic(
        Ned(home.north + offset.north, home.east + offset.east, home.down + offset.down), flight_origin()
    )
    assert geodetic_to_ned(origin, expected) == pytest.approx((0.0, 0.0, 0.0), abs=0.01)
    local = flight.last("LOCAL_POSITION_NED")
    assert (local.x, local.y, local.z) == pytest.approx((-1.5, -2.5, -0.75))
    assert flight.position == home


def flight_origin() -> Geodetic:
    from autopilot_flight import ORIGIN

    return ORIGIN


@pytest.mark.parametrize("latitude_deg", [-60.0, 0.0, 47.4, 70.0])
def test_projection_agrees_with_the_exact_one_within_2_cm_at_500_m(latitude_deg: float) -> None:
    origin = Geodetic(latitude_deg, 8.5, 400.0)
    projection = Projection(origin)
    for north, east in ((500.0, 0.0), (0.0, -500.0), (350.0, 350.0), (-20.0, 480.0)):
        exact = ned_to_geodetic(Ned(north, east, 0.0), origin)
        latitude, longitude = projection.to_degrees(north, east)
        there = geodetic_to_ned(Geodetic(latitude, longitude, 400.0), exact)
        assert math.hypot(there.north, there.east) < 0.02
        assert projection.to_local(latitude, longitude) == pytest.approx((north, east), abs=1e-3)


# Determinism


def busy_flight(seed: int) -> list[bytes]:
    flight = Flight(gust=GustParameters(), noise=NoiseParameters(), quiet=False, seed=seed)
    flight.take_off()
    flight.go_offboard()
    flight.stream(flight.setpoint(vx=1.0), 2.0)
    return flight.datagrams


def test_same_seed_and_calls_give_the_same_bytes_and_another_seed_does_not() -> None:
    first = busy_flight(5)
    assert first == busy_flight(5)
    assert first != busy_flight(6)


def test_bytes_do_not_depend_on_how_often_advance_is_called() -> None:
    def sent(calls_s: float) -> list[bytes]:
        flight = Flight(gust=GustParameters(), noise=NoiseParameters(), quiet=False)
        packets = []
        for tick in range(1, round(6.0 / calls_s) + 1):
            packets += flight.autopilot.advance(round(tick * calls_s * 1e9))
        return packets

    assert sent(0.004) == sent(0.05) == sent(6.0)


def test_every_stream_of_the_table_is_packed_from_the_first_moment_on() -> None:
    flight = Flight(quiet=False)
    for _, build in STREAMS.values():
        message = build(flight.autopilot.telemetry)
        if message is not None:
            flight.autopilot.link.send(message)
            assert flight.autopilot.link.take()


def test_mode_shows_in_heartbeat_up_to_a_second_late() -> None:
    flight = Flight()
    flight.take_off()
    flight.run_while(lambda: len(flight.of("HEARTBEAT", flight.now_s - 0.02)) == 0, 2.0)
    flight.set_mode(Mode.LAND)
    assert flight.last("HEARTBEAT").custom_mode == Mode.LOITER.custom_mode
    flight.run(1.0)
    assert flight.last("HEARTBEAT").custom_mode == Mode.LAND.custom_mode
