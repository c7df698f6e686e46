"""What the stub says of its state: mode, health, battery, estimator, clocks, home, version. Sans-I/O."""

import os
from typing import Any

os.environ["MAVLINK20"] = "1"
from pymavlink.dialects.v20 import development as mavlink

from sim.autopilot.modes import STANDARD_MODE, base_mode
from sim.autopilot.packing import Fields
from sim.autopilot.setpoint import NAN
from sim.autopilot.telemetry import Telemetry, quaternion

SENSORS_PRESENT = 0x0300402F
SENSORS_ENABLED = 0x0301402F
"""bit masks of MAV_SYS_STATUS_SENSOR as recorded: the prearm bit (1 << 28) shows in the health mask alone"""
SENSORS_HEALTHY = 0x0320C83F
PREARM_CHECK = 1 << 28
GPS_SENSOR = 1 << 5
NO_VOLTAGE = 65535
RELEASE = 255
"""FIRMWARE_VERSION_TYPE"""
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


def timesync(s: Telemetry) -> Any:
    return mavlink.MAVLink_timesync_message(0, s.now_ns)


def extended_sys_state(s: Telemetry) -> Any:
    return Fields(mavlink.MAVLink_extended_sys_state_message, (0, s.commander.landed_state))


def _millivolts(s: Telemetry) -> int:
    # Four cells: 16.2 V full, 15.3 V at half, as recorded.
    return round(14400.0 + 1800.0 * s.battery_fraction)


def sys_status(s: Telemetry) -> Any:
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


def heartbeat(s: Telemetry) -> Any:
    commander = s.commander
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR,
        mavlink.MAV_AUTOPILOT_PX4,
        base_mode(commander.mode, armed=commander.armed, offboard_controlled=commander.setpoint_seen),
        commander.mode.custom_mode,
        int(commander.system_status(s.now_ns)),
        3,
    )


def estimator_status(s: Telemetry) -> Any:
    flags = 0x1 | 0x4 | 0x20 | 0x40
    if s.commander.position_valid:
        flags |= 0x2 | 0x8 | 0x10 | 0x100 | 0x200
    if not s.commander.armed:
        flags |= 0x80  # at rest
    accuracy = 0.3 + 0.5 * s.gps_lost_for_s
    return mavlink.MAVLink_estimator_status_message(
        s.now_ns // 1000, flags, 0.12, 0.05, 0.02, 0.08, 0.006, NAN, accuracy, 0.3
    )


def system_time(s: Telemetry) -> Any:
    return mavlink.MAVLink_system_time_message((s.utc_at_boot_ns + s.now_ns) // 1000, s.now_ns // 1_000_000)


def ping(s: Telemetry) -> Any:
    s.ping_sequence += 1
    return mavlink.MAVLink_ping_message(s.now_ns // 1000, s.ping_sequence, 0, 0)


def home_position(s: Telemetry) -> Any:
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


def battery_status(s: Telemetry) -> Any:
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


def current_mode(s: Telemetry) -> Any:
    mode, user_mode = s.commander.mode, s.commander.user_mode
    values = (mode.custom_mode, user_mode.custom_mode, STANDARD_MODE.get(mode, 0))
    return Fields(mavlink.MAVLink_current_mode_message, values)


def vibration(s: Telemetry) -> Any:
    shake = 0.1 if s.commander.motors_run else 0.011
    return mavlink.MAVLink_vibration_message(s.now_ns // 1000, 1e-10, shake, 10.0 * shake, 0, 0, 0)


def mission_current(_: Telemetry) -> Any:
    return mavlink.MAVLink_mission_current_message(0, 65535, 0, 0)


def gps_global_origin(s: Telemetry) -> Any:
    origin = s.projection.origin
    return mavlink.MAVLink_gps_global_origin_message(
        round(origin.latitude_deg * 1e7),
        round(origin.longitude_deg * 1e7),
        round(origin.altitude_amsl_m * 1000.0),
        s.now_ns // 1000,
    )


def autopilot_version(s: Telemetry) -> Any:
    major, minor = s.parameters.version.number
    software = major << 24 | minor << 16 | RELEASE
    return mavlink.MAVLink_autopilot_version_message(
        CAPABILITIES,
        software,
        0,
        software,
        1,
        [0] * 8,
        [0] * 8,
        [0] * 8,
        0,
        0,
        s.system_id,
        [*s.system_id.to_bytes(8, "little"), *([0] * 10)],
    )
