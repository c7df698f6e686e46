"""What the stub says of its motion: place, velocity, attitude, measurements, where it is told to go. Sans-I/O.

Every message is built from the one `Telemetry`, so that all of them tell of one estimate.
"""

import math
import os
from typing import Any

os.environ["MAVLINK20"] = "1"
from pymavlink.dialects.v20 import development as mavlink

from sim.autopilot.packing import Fields
from sim.autopilot.setpoint import NAN
from sim.autopilot.telemetry import Telemetry, to_body

POSITION_IGNORED = 0x7
VELOCITY_IGNORED = 0x38
NAN_COVARIANCE = [NAN] * 21
STANDARD_PRESSURE_HPA = 1013.25


def _clip16(value: float) -> int:
    return min(max(round(value), -32768), 32767)


def attitude(s: Telemetry) -> Any:
    return mavlink.MAVLink_attitude_message(
        s.boot_ms,
        s.roll_rad,
        s.pitch_rad,
        s.yaw_rad,
        s.roll_rate_rad_s,
        s.pitch_rate_rad_s,
        s.yaw_rate_rad_s,
    )


def attitude_quaternion(s: Telemetry) -> Any:
    return mavlink.MAVLink_attitude_quaternion_message(
        s.boot_ms,
        *s.quaternion(),
        s.roll_rate_rad_s,
        s.pitch_rate_rad_s,
        s.yaw_rate_rad_s,
        [0.0, 0.0, 0.0, 0.0],
    )


def global_position_int(s: Telemetry) -> Any:
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


def local_position_ned(s: Telemetry) -> Any:
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


def odometry(s: Telemetry) -> Any:
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


def highres_imu(s: Telemetry) -> Any:
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


def altitude(s: Telemetry) -> Any:
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


def distance_sensor(s: Telemetry) -> Any:
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


def attitude_target(s: Telemetry) -> Any:
    return mavlink.MAVLink_attitude_target_message(
        s.now_ns // 1_000_000,
        0,
        s.quaternion(),
        s.roll_rate_rad_s,
        s.pitch_rate_rad_s,
        s.yaw_rate_rad_s,
        s.thrust_fraction(),
    )


def position_target_local_ned(s: Telemetry) -> Any:
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


def position_target_global_int(s: Telemetry) -> Any:
    """Only while an automatic mode flies to somewhere, as recorded."""
    setpoint = s.setpoint
    if setpoint is None or not s.commander.armed or not s.commander.mode.is_auto:
        return None
    north = s.north_m if math.isnan(setpoint.north_m) else setpoint.north_m
    east = s.east_m if math.isnan(setpoint.east_m) else setpoint.east_m
    latitude, longitude = s.degrees_e7(north, east)
    vehicle = s.vehicle
    landing = s.commander.mode.is_landing or math.isnan(setpoint.down_m)
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


def servo_output_raw(s: Telemetry) -> Any:
    if not s.commander.armed:
        pulse = 900
    elif not s.commander.motors_run:
        pulse = 1000
    else:
        pulse = round(1000.0 + 1000.0 * s.thrust_fraction())
    return mavlink.MAVLink_servo_output_raw_message(
        s.now_ns // 1000 & 0xFFFFFFFF, 0, pulse, pulse, pulse, pulse, 900, 900, 900, 900, *([900] * 8)
    )


def vfr_hud(s: Telemetry) -> Any:
    return mavlink.MAVLink_vfr_hud_message(
        0.0,
        math.hypot(s.velocity_north_m_s, s.velocity_east_m_s),
        round(math.degrees(s.yaw_rad)) % 360,
        round(100.0 * s.thrust_fraction()),
        s.altitude_amsl_m,
        -s.velocity_down_m_s,
    )


def gps_raw_int(s: Telemetry) -> Any:
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
