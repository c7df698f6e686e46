"""The messages that a PX4 sends by itself on its offboard link, and their rates. Sans-I/O.

Every message is built from the one `Telemetry`, so that all of them tell of one estimate.
"""

import os
from collections.abc import Callable
from typing import Any

os.environ["MAVLINK20"] = "1"
# CURRENT_MODE (436) is not in the `common` dialect of pymavlink 2.4; `development` includes all of `common`.
from pymavlink.dialects.v20 import development as mavlink

from sim.autopilot import motion_messages as motion
from sim.autopilot import state_messages as state
from sim.autopilot.telemetry import Telemetry

Builder = Callable[[Telemetry], Any]

STREAMS: dict[int, tuple[float, Builder]] = {
    mavlink.MAVLINK_MSG_ID_ATTITUDE: (100.0, motion.attitude),
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: (50.0, motion.global_position_int),
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: (50.0, motion.attitude_quaternion),
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: (50.0, motion.highres_imu),
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: (30.0, motion.local_position_ned),
    mavlink.MAVLINK_MSG_ID_ODOMETRY: (30.0, motion.odometry),
    mavlink.MAVLINK_MSG_ID_TIMESYNC: (10.0, state.timesync),
    mavlink.MAVLINK_MSG_ID_ALTITUDE: (10.0, motion.altitude),
    mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR: (10.0, motion.distance_sensor),
    mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET: (10.0, motion.attitude_target),
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: (10.0, motion.position_target_local_ned),
    mavlink.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: (10.0, motion.servo_output_raw),
    mavlink.MAVLINK_MSG_ID_VFR_HUD: (10.0, motion.vfr_hud),
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: (8.0, motion.gps_raw_int),
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_GLOBAL_INT: (10.0, motion.position_target_global_int),
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: (5.0, state.extended_sys_state),
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: (5.0, state.sys_status),
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: (1.0, state.heartbeat),
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: (1.0, state.estimator_status),
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: (1.0, state.system_time),
    mavlink.MAVLINK_MSG_ID_PING: (1.0, state.ping),
    mavlink.MAVLINK_MSG_ID_MISSION_CURRENT: (1.0, state.mission_current),
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: (0.5, state.home_position),
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: (0.5, state.battery_status),
    mavlink.MAVLINK_MSG_ID_CURRENT_MODE: (0.5, state.current_mode),
    mavlink.MAVLINK_MSG_ID_VIBRATION: (0.5, state.vibration),
}
"""message id to (rate in Hz on the offboard link of PX4 1.16, builder); a builder returns None when there is nothing"""

ON_REQUEST: dict[int, Builder] = {
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: state.gps_global_origin,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: state.autopilot_version,
}
"""messages that come only when asked for (GPS_GLOBAL_ORIGIN also once after boot and when it changes)"""
