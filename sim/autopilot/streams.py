"""The messages a PX4 sends by itself on its offboard link, their rates, and what they say. Sans-I/O.

Every message is built from the one `Telemetry`, so that all of them tell of one estimate.
"""

import math
import os
from collections.abc import Callable
from typing import Any, NamedTuple

os.environ["MAVLINK20"] = "1"
# CURRENT_MODE (436) is not in the `common` dialect of pymavlink 2.4; `development` includes all of `common`.
from pymavlink.dialects.v20 import development as mavlink

from sim.autopilot.dynamics import NAN
from sim.autopilot.modes import STANDARD_MODE, Mode, base_mode
from sim.autopilot.telemetry import Telemetry, quaternion, to_body

SENSORS_PRESENT = 0x0300402F
SENSORS_ENABLED = 0x0301402F
"""bit masks of MAV_SYS_STATUS_SENSOR as recorded: the prearm bit (1 << 28) shows in the health mask alone"""
SENSORS_HEALTHY = 0x0320C83F
PREARM_CHECK = 1 << 28
GPS_SENSOR = 1 << 5
NO_VOLTAGE = 65535
FLIGHT_SOFTWARE_VERSION = 1 << 24 | 16 << 16 | 0 << 8 | 255
"""AUTOPILOT_VERSION.flight_sw_version: 1.16.0, release"""
CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_RALLY
)
"""AUTOPILOT_VERSION.capabilities; no FTP"""
POSITION_IGNORED = 0x7
VELOCITY_IGNORED = 0x38
NAN_COVARIANCE = [NAN] * 21


class Fields(NamedTuple):
    """A message that a companion has sent many times a second, without pymavlink's object around its values."""

    kind: Any
    """its class in pymavlink"""
    values: tuple[Any, ...]
    """of its fields in the wire's order"""


STANDARD_PRESSURE_HPA = 1013.25


def _clip16(value: float) -> int:
    return min(max(round(value), -32768), 32767)


def _attitude(s: Telemetry) -> Any:
    return mavlink.MAVLink_attitude_message(
        s.boot_ms,
        s.roll_rad,
        s.pitch_rad,
        s.yaw_rad,
        s.roll_rate_rad_s,
        s.pitch_rate_rad_s,
        s.yaw_rate_rad_s,
    )


def _attitude_quaternion(s: Telemetry) -> Any:
    return mavlink.MAVLink_attitude_quaternion_message(
        s.boot_ms,
        *s.quaternion(),
        s.roll_rate_rad_s,
        s.pitch_rate_rad_s,
        s.yaw_rate_rad_s,
        [0.0, 0.0, 0.0, 0.0],
    )


def _global_position_int(s: Telemetry) -> Any:
    if not s.commander.position_valid:
        return None
    latitude, longitude = s.degrees_e7(s.north_m, s.east_m)
    home_down = s.home_local_ned_m.down if s.home_local_ned_m is not None else 0.0
    heading = round(math.degrees(s.yaw_rad) * 100.0) % 36000
    return mavlink.MAVLink_global_position_int_message(
        s.boot_ms,
        latitude,
        longitude,
        round(s.altitude_amsl_m * 1000.0),
        round((home_down - s.down_m) * 1000.0),
        _clip16(s.velocity_north_m_s * 100.0),
        _clip16(s.velocity_east_m_s * 100.0),
        _clip16(s.velocity_down_m_s * 100.0),
        heading,
    )


def _local_position_ned(s: Telemetry) -> Any:
    return Fields(
        mavlink.MAVLink_local_position_ned_message,
        (
            s.boot_ms,
            s.north_m,
            s.east_m,
            s.down_m,
            s.velocity_north_m_s,
            s.velocity_east_m_s,
            s.velocity_down_m_s,
        ),
    )


def _odometry(s: Telemetry) -> Any:
    pose = list(NAN_COVARIANCE)
    pose[0] = pose[6] = 0.044
    pose[11] = 0.095
    pose[15] = pose[18] = pose[20] = 0.0003
    velocity = list(NAN_COVARIANCE)
    velocity[0] = velocity[6] = 0.01
    velocity[11] = 0.008
    return mavlink.MAVLink_odometry_message(
        s.time_ns // 1000,
        mavlink.MAV_FRAME_LOCAL_NED,
        mavlink.MAV_FRAME_LOCAL_NED,
        s.north_m,
        s.east_m,
        s.down_m,
        s.quaternion(),
        s.velocity_north_m_s,
        s.velocity_east_m_s,
        s.velocity_down_m_s,
        s.roll_rate_rad_s,
        s.pitch_rate_rad_s,
        s.yaw_rate_rad_s,
        pose,
        velocity,
        s.reset_counter,
        mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT,
        0,
    )


def _highres_imu(s: Telemetry) -> Any:
    x, y, z = to_body(s.specific_force_ned_m_s2, s.roll_rad, s.pitch_rad, s.yaw_rad)
    mx, my, mz = to_body((0.21, 0.01, 0.43), s.roll_rad, s.pitch_rad, s.yaw_rad)
    altitude = s.altitude_amsl_m
    return mavlink.MAVLink_highres_imu_message(
        s.time_ns // 1000,
        x,
        y,
        z,
        s.roll_rate_rad_s,
        s.pitch_rate_rad_s,
        s.yaw_rate_rad_s,
        mx,
        my,
        mz,
        STANDARD_PRESSURE_HPA * 100.0 * (1.0 - 2.25577e-5 * altitude) ** 5.25588,
        0.0,
        altitude,
        15.0,
        63,
        0,
    )


def _timesync(s: Telemetry) -> Any:
    return mavlink.MAVLink_timesync_message(0, s.now_ns)


def _altitude(s: Telemetry) -> Any:
    home_down = s.home_local_ned_m.down if s.home_local_ned_m is not None else 0.0
    return mavlink.MAVLink_altitude_message(
        s.time_ns // 1000,
        s.altitude_amsl_m,
        s.altitude_amsl_m,
        -s.down_m,
        home_down - s.down_m,
        -s.down_m - s.height_m,
        s.height_m,
    )


def _distance_sensor(s: Telemetry) -> Any:
    return mavlink.MAVLink_distance_sensor_message(
        s.boot_ms,
        0,
        10000,
        min(round(s.height_m * 100.0), 10000),
        mavlink.MAV_DISTANCE_SENSOR_LASER,
        0,
        mavlink.MAV_SENSOR_ROTATION_PITCH_270,
        0,
    )


def _attitude_target(s: Telemetry) -> Any:
    return mavlink.MAVLink_attitude_target_message(
        s.now_ns // 1_000_000,
        0,
        s.quaternion(),
        s.roll_rate_rad_s,
        s.pitch_rate_rad_s,
        s.yaw_rate_rad_s,
        s.thrust_fraction(),
    )


def _position_target_local_ned(s: Telemetry) -> Any:
    setpoint = s.setpoint
    boot_ms = s.now_ns // 1_000_000
    if setpoint is None:
        return mavlink.MAVLink_position_target_local_ned_message(
            boot_ms,
            mavlink.MAV_FRAME_LOCAL_NED,
            POSITION_IGNORED | VELOCITY_IGNORED,
            NAN,
            NAN,
            NAN,
            NAN,
            NAN,
            NAN,
            0.0,
            0.0,
            100.0,
            s.yaw_rad,
            0.0,
        )
    vehicle = s.vehicle
    velocity = (
        vehicle.command_velocity_north_m_s,
        vehicle.command_velocity_east_m_s,
        vehicle.command_velocity_down_m_s,
    )
    position = (setpoint.north_m, setpoint.east_m, setpoint.down_m)
    mask = 0
    for bit, value in enumerate((*position, *velocity)):
        mask |= (1 << bit) if math.isnan(value) else 0
    return mavlink.MAVLink_position_target_local_ned_message(
        boot_ms,
        mavlink.MAV_FRAME_LOCAL_NED,
        mask,
        *position,
        *velocity,
        vehicle.command_north_m_s2,
        vehicle.command_east_m_s2,
        vehicle.command_down_m_s2,
        s.yaw_rad if math.isnan(setpoint.yaw_rad) else setpoint.yaw_rad,
        vehicle.yaw_rate_rad_s,
    )


def _position_target_global_int(s: Telemetry) -> Any:
    """Only while an automatic mode flies to somewhere, as recorded."""
    setpoint = s.setpoint
    if setpoint is None or not s.commander.armed or not s.commander.mode.is_auto:
        return None
    north = s.north_m if math.isnan(setpoint.north_m) else setpoint.north_m
    east = s.east_m if math.isnan(setpoint.east_m) else setpoint.east_m
    latitude, longitude = s.degrees_e7(north, east)
    vehicle = s.vehicle
    landing = s.commander.mode is Mode.LAND or math.isnan(setpoint.down_m)
    altitude = 0.0 if landing else s.projection.origin.altitude_amsl_m - setpoint.down_m
    return mavlink.MAVLink_position_target_global_int_message(
        s.now_ns // 1_000_000,
        mavlink.MAV_FRAME_GLOBAL_INT,
        0,
        latitude,
        longitude,
        altitude,
        vehicle.command_velocity_north_m_s,
        vehicle.command_velocity_east_m_s,
        vehicle.command_velocity_down_m_s,
        vehicle.command_north_m_s2,
        vehicle.command_east_m_s2,
        vehicle.command_down_m_s2,
        s.yaw_rad if math.isnan(setpoint.yaw_rad) else setpoint.yaw_rad,
        vehicle.yaw_rate_rad_s,
    )


def _servo_output_raw(s: Telemetry) -> Any:
    if not s.commander.armed:
        pulse = 900
    elif not s.commander.motors_run:
        pulse = 1000
    else:
        pulse = round(1000.0 + 1000.0 * s.thrust_fraction())
    return mavlink.MAVLink_servo_output_raw_message(
        s.now_ns // 1000 & 0xFFFFFFFF, 0, pulse, pulse, pulse, pulse, 900, 900, 900, 900, *([900] * 8)
    )


def _vfr_hud(s: Telemetry) -> Any:
    return mavlink.MAVLink_vfr_hud_message(
        0.0,
        math.hypot(s.velocity_north_m_s, s.velocity_east_m_s),
        round(math.degrees(s.yaw_rad)) % 360,
        round(100.0 * s.thrust_fraction()),
        s.altitude_amsl_m,
        -s.velocity_down_m_s,
    )


def _gps_raw_int(s: Telemetry) -> Any:
    if not s.gps_ok:
        return mavlink.MAVLink_gps_raw_int_message(
            s.now_ns // 1000, 0, 0, 0, 0, 9999, 9999, 0, 0, 0, 0, 100_000, 100_000, 10_000, 0, 0
        )
    latitude, longitude = s.degrees_e7(s.north_m, s.east_m)
    course = math.degrees(math.atan2(s.velocity_east_m_s, s.velocity_north_m_s))
    altitude = round(s.altitude_amsl_m * 1000.0)
    return mavlink.MAVLink_gps_raw_int_message(
        s.now_ns // 1000,
        3,
        latitude,
        longitude,
        altitude,
        70,
        110,
        round(100.0 * math.hypot(s.velocity_north_m_s, s.velocity_east_m_s)),
        round(course * 100.0) % 36000,
        10,
        altitude,
        900,
        1780,
        400,
        0,
        0,
    )


def _extended_sys_state(s: Telemetry) -> Any:
    return Fields(mavlink.MAVLink_extended_sys_state_message, (0, s.commander.landed_state))


def _millivolts(s: Telemetry) -> int:
    # Four cells: 16.2 V full, 15.3 V at half, as recorded.
    return round(14400.0 + 1800.0 * s.battery_fraction)


def _sys_status(s: Telemetry) -> Any:
    health = SENSORS_HEALTHY
    if s.commander.armed or s.commander.may_arm(s.now_ns):
        health |= PREARM_CHECK
    if not s.gps_ok:
        health &= ~GPS_SENSOR
    return mavlink.MAVLink_sys_status_message(
        SENSORS_PRESENT,
        SENSORS_ENABLED,
        health,
        135,
        _millivolts(s),
        -100,
        round(100.0 * s.battery_fraction),
        0,
        0,
        0,
        0,
        0,
        0,
        0,
        0,
        1,
    )


def _heartbeat(s: Telemetry) -> Any:
    commander = s.commander
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR,
        mavlink.MAV_AUTOPILOT_PX4,
        base_mode(commander.mode, armed=commander.armed, offboard_controlled=commander.setpoint_seen),
        commander.mode.custom_mode,
        int(commander.system_status(s.now_ns)),
        3,
    )


def _estimator_status(s: Telemetry) -> Any:
    flags = 0x1 | 0x4 | 0x20 | 0x40
    if s.commander.position_valid:
        flags |= 0x2 | 0x8 | 0x10 | 0x100 | 0x200
    if not s.commander.armed:
        flags |= 0x80  # at rest
    accuracy = 0.3 + 0.5 * s.gps_lost_for_s
    return mavlink.MAVLink_estimator_status_message(
        s.now_ns // 1000, flags, 0.12, 0.05, 0.02, 0.08, 0.006, NAN, accuracy, 0.3
    )


def _system_time(s: Telemetry) -> Any:
    return mavlink.MAVLink_system_time_message((s.utc_at_boot_ns + s.now_ns) // 1000, s.now_ns // 1_000_000)


def _ping(s: Telemetry) -> Any:
    s.ping_sequence += 1
    return mavlink.MAVLink_ping_message(s.now_ns // 1000, s.ping_sequence, 0, 0)


def _home_position(s: Telemetry) -> Any:
    home = s.home_local_ned_m
    if home is None:
        return None
    latitude, longitude = s.degrees_e7(home.north, home.east)
    return mavlink.MAVLink_home_position_message(
        latitude,
        longitude,
        round((s.projection.origin.altitude_amsl_m - home.down) * 1000.0),
        home.north,
        home.east,
        home.down,
        quaternion(0.0, 0.0, s.yaw_rad),
        0.0,
        0.0,
        0.0,
        s.home_time_ns // 1000,
    )


def _battery_status(s: Telemetry) -> Any:
    fraction = s.battery_fraction
    charge_state = mavlink.MAV_BATTERY_CHARGE_STATE_OK
    if fraction < s.parameters.number("BAT_EMERGEN_THR"):
        charge_state = mavlink.MAV_BATTERY_CHARGE_STATE_EMERGENCY
    elif fraction < s.parameters.number("BAT_CRIT_THR"):
        charge_state = mavlink.MAV_BATTERY_CHARGE_STATE_CRITICAL
    elif fraction < s.parameters.number("BAT_LOW_THR"):
        charge_state = mavlink.MAV_BATTERY_CHARGE_STATE_LOW
    return mavlink.MAVLink_battery_status_message(
        0,
        mavlink.MAV_BATTERY_FUNCTION_ALL,
        mavlink.MAV_BATTERY_TYPE_LIPO,
        32767,
        [_millivolts(s), *([NO_VOLTAGE] * 9)],
        -100,
        0,
        -1,
        round(100.0 * fraction),
        0,
        charge_state,
        [0, 0, 0, 0],
        0,
        0,
    )


def _current_mode(s: Telemetry) -> Any:
    mode, user_mode = s.commander.mode, s.commander.user_mode
    values = (mode.custom_mode, user_mode.custom_mode, STANDARD_MODE.get(mode, 0))
    return Fields(mavlink.MAVLink_current_mode_message, values)


def _vibration(s: Telemetry) -> Any:
    shake = 0.1 if s.commander.motors_run else 0.011
    return mavlink.MAVLink_vibration_message(s.now_ns // 1000, 1e-10, shake, 10.0 * shake, 0, 0, 0)


def _mission_current(_: Telemetry) -> Any:
    return mavlink.MAVLink_mission_current_message(0, 65535, 0, 0)


def _gps_global_origin(s: Telemetry) -> Any:
    origin = s.projection.origin
    return mavlink.MAVLink_gps_global_origin_message(
        round(origin.latitude_deg * 1e7),
        round(origin.longitude_deg * 1e7),
        round(origin.altitude_amsl_m * 1000.0),
        s.now_ns // 1000,
    )


def _autopilot_version(s: Telemetry) -> Any:
    return mavlink.MAVLink_autopilot_version_message(
        CAPABILITIES,
        FLIGHT_SOFTWARE_VERSION,
        0,
        FLIGHT_SOFTWARE_VERSION,
        1,
        [0] * 8,
        [0] * 8,
        [0] * 8,
        0,
        0,
        s.system_id,
        [*s.system_id.to_bytes(8, "little"), *([0] * 10)],
    )


Builder = Callable[[Telemetry], Any]

STREAMS: dict[int, tuple[float, Builder]] = {
    mavlink.MAVLINK_MSG_ID_ATTITUDE: (100.0, _attitude),
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: (50.0, _global_position_int),
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: (50.0, _attitude_quaternion),
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: (50.0, _highres_imu),
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: (30.0, _local_position_ned),
    mavlink.MAVLINK_MSG_ID_ODOMETRY: (30.0, _odometry),
    mavlink.MAVLINK_MSG_ID_TIMESYNC: (10.0, _timesync),
    mavlink.MAVLINK_MSG_ID_ALTITUDE: (10.0, _altitude),
    mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR: (10.0, _distance_sensor),
    mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET: (10.0, _attitude_target),
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: (10.0, _position_target_local_ned),
    mavlink.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: (10.0, _servo_output_raw),
    mavlink.MAVLINK_MSG_ID_VFR_HUD: (10.0, _vfr_hud),
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: (8.0, _gps_raw_int),
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_GLOBAL_INT: (10.0, _position_target_global_int),
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: (5.0, _extended_sys_state),
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: (5.0, _sys_status),
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: (1.0, _heartbeat),
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: (1.0, _estimator_status),
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: (1.0, _system_time),
    mavlink.MAVLINK_MSG_ID_PING: (1.0, _ping),
    mavlink.MAVLINK_MSG_ID_MISSION_CURRENT: (1.0, _mission_current),
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: (0.5, _home_position),
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: (0.5, _battery_status),
    mavlink.MAVLINK_MSG_ID_CURRENT_MODE: (0.5, _current_mode),
    mavlink.MAVLINK_MSG_ID_VIBRATION: (0.5, _vibration),
}
"""message id to (rate in Hz on the offboard link of PX4 1.16, builder); a builder returns None when there is nothing"""

ON_REQUEST: dict[int, Builder] = {
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: _gps_global_origin,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: _autopilot_version,
}
"""messages that come only when asked for (GPS_GLOBAL_ORIGIN also once after boot and when it changes)"""
