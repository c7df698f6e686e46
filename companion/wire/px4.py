"""PX4 as it shows in MAVLink: its modes, the commands that it is given, the streams that it is asked for."""

import struct
from enum import IntEnum
from math import nan
from typing import NamedTuple

AUTOPILOT_PX4 = 12
"""MAV_AUTOPILOT"""
MULTICOPTERS = frozenset({2, 3, 4, 13, 14, 15, 29})
"""MAV_TYPE: quadrotor, coaxial, helicopter, hexarotor, octorotor, tricopter, dodecarotor"""
PARAMETER_INT32, PARAMETER_REAL32 = 6, 9
"""MAV_PARAM_TYPE"""
ORIGIN_MESSAGE_ID, VERSION_MESSAGE_ID = 49, 148
POSITION_MESSAGE_ID = 32
STREAMS_HZ = {436: 20.0, 245: 5.0, 230: 1.0, 1: 1.0, 2: 1.0, 242: 0.5}
"""what the companion asks for with SET_MESSAGE_INTERVAL, beside the positions"""
STREAMS_OFF = (30, 31, 33, 105, 331, 111, 141, 132, 83, 85, 36, 74, 24, 87)
"""what a companion's link carries by default and nobody here reads"""
NAV_TAKEOFF, DO_SET_MODE, COMPONENT_ARM_DISARM, SET_MESSAGE_INTERVAL, REQUEST_MESSAGE = 22, 176, 400, 511, 512
"""MAV_CMD"""
CUSTOM_MODE_ENABLED = 1
"""MAV_MODE_FLAG"""
FORCE = 21196.0
"""param2 of COMPONENT_ARM_DISARM by which motors stop in flight too"""


def streams_hz(position_rate_hz: float) -> dict[int, float]:
    """Every message whose rate a companion sets; 0: off."""
    return {POSITION_MESSAGE_ID: position_rate_hz, **STREAMS_HZ, **dict.fromkeys(STREAMS_OFF, 0.0)}


class Px4Mode(IntEnum):
    """PX4's main modes and AUTO sub-modes as custom_mode (main << 16 | sub << 24)."""

    MANUAL = 1 << 16
    ALTCTL = 2 << 16
    POSCTL = 3 << 16
    AUTO_READY = 4 << 16 | 1 << 24
    AUTO_TAKEOFF = 4 << 16 | 2 << 24
    AUTO_LOITER = 4 << 16 | 3 << 24
    AUTO_MISSION = 4 << 16 | 4 << 24
    AUTO_RTL = 4 << 16 | 5 << 24
    AUTO_LAND = 4 << 16 | 6 << 24
    AUTO_DESCEND = 4 << 16 | 20 << 24
    """a landing without a position, of versions that have it as a mode of its own"""
    ACRO = 5 << 16
    OFFBOARD = 6 << 16
    STABILIZED = 7 << 16
    TERMINATION = 10 << 16


def mode_name(custom_mode: int) -> str:
    """The mode's name, or its number."""
    try:
        return Px4Mode(custom_mode).name
    except ValueError:
        return f"{custom_mode:#x}"


FIRMWARE_TYPES = {0: "dev", 64: "alpha", 128: "beta", 192: "rc", 255: ""}
"""FIRMWARE_VERSION_TYPE; 255: a release"""


class Software(NamedTuple):
    """What AUTOPILOT_VERSION (148) tells of the flight software."""

    major: int
    minor: int
    patch: int
    kind: int
    """FIRMWARE_VERSION_TYPE"""
    git: str
    """first digits of the build's commit; empty where none is told"""

    @property
    def number(self) -> tuple[int, int]:
        """Without the patch, which changes no behaviour."""
        return self.major, self.minor

    def __str__(self) -> str:
        kind = FIRMWARE_TYPES.get(self.kind, f"type {self.kind}")
        number = "-".join(x for x in (f"{self.major}.{self.minor}.{self.patch}", kind) if x)
        return f"{number} ({self.git})" if self.git else number


def software(flight_sw_version: int, flight_custom_version: bytes) -> Software:
    """From AUTOPILOT_VERSION's fields; PX4 has the commit's first eight bytes there, the last of them first."""
    major, minor, patch, kind = flight_sw_version.to_bytes(4, "big")
    git = flight_custom_version[::-1].hex()[:10] if any(flight_custom_version) else ""
    return Software(major, minor, patch, kind, git)


def parameter_value(raw: bytes, kind: int) -> float | int:
    """Value of a PARAM_VALUE from its four bytes: PX4 puts an INT32 bytewise into the float."""
    value: float | int = struct.unpack("<i" if kind == PARAMETER_INT32 else "<f", raw)[0]
    return value


def arm_parameters(arm: bool) -> tuple[int, float]:
    """Command and parameter of MAV_CMD_COMPONENT_ARM_DISARM."""
    return COMPONENT_ARM_DISARM, 1.0 if arm else 0.0


def kill_parameters() -> tuple[int, float, float]:
    """Command and parameters that disarm at once, wherever the vehicle is."""
    return COMPONENT_ARM_DISARM, 0.0, FORCE


def mode_parameters(mode: Px4Mode) -> tuple[int, float, float, float]:
    """Command and parameters of MAV_CMD_DO_SET_MODE for a PX4 mode."""
    main, sub = (mode >> 16) & 0xFF, (mode >> 24) & 0xFF
    return DO_SET_MODE, float(CUSTOM_MODE_ENABLED), float(main), float(sub)


def takeoff_parameters(altitude_amsl_m: float) -> tuple[int, float, float, float, float, float, float, float]:
    """Command and parameters of MAV_CMD_NAV_TAKEOFF: straight up, heading as it is."""
    return NAV_TAKEOFF, nan, 0.0, 0.0, nan, nan, nan, altitude_amsl_m


def interval_parameters(message_id: int, rate_hz: float) -> tuple[int, float, float]:
    """Command and parameters of MAV_CMD_SET_MESSAGE_INTERVAL; a rate of 0 turns the stream off."""
    return SET_MESSAGE_INTERVAL, float(message_id), 1e6 / rate_hz if rate_hz > 0 else -1.0


def request_message_parameters(message_id: int) -> tuple[int, float]:
    """Command and parameter of MAV_CMD_REQUEST_MESSAGE."""
    return REQUEST_MESSAGE, float(message_id)
