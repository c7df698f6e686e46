"""PX4's parameters that matter to a fleet, and how MAVLink carries them. Pure.

PARAM_VALUE has one float field. PX4 sends an INT32's four bytes in it ("bytewise"), not its value.
"""

import math
import struct
from collections.abc import Mapping

from companion.vehicle.autopilot.px4_versions import OLDEST, Px4Version
from sim.autopilot.dynamics_parameters import LoopGains

TYPE_INT32 = 6
"""MAV_PARAM_TYPE_INT32"""
TYPE_REAL32 = 9
"""MAV_PARAM_TYPE_REAL32"""
TYPE_UINT32 = 5
"""MAV_PARAM_TYPE_UINT32: only `_HASH_CHECK` has it"""
HASH_NAME = "_HASH_CHECK"
HASH_INDEX = 65535

DEFAULTS: dict[str, float | int] = {
    "BAT1_N_CELLS": 4,
    "BAT_CRIT_THR": 0.07,
    "BAT_EMERGEN_THR": 0.05,
    "BAT_LOW_THR": 0.15,
    "CAL_ACC0_ID": 1310988,
    "CAL_GYRO0_ID": 1310988,
    "CAL_MAG0_ID": 197388,
    "CBRK_FLIGHTTERM": 121212,
    "CBRK_SUPPLY_CHK": 0,
    "CBRK_USB_CHK": 197848,
    "COM_ARM_WO_GPS": 1,
    "COM_DISARM_LAND": 2.0,
    "COM_DISARM_PRFLT": 10.0,
    "COM_DL_LOSS_T": 10,
    "COM_FAIL_ACT_T": 5.0,
    "COM_FLTMODE1": -1,
    "COM_LOW_BAT_ACT": 0,
    "COM_OBL_RC_ACT": 0,
    "COM_OF_LOSS_T": 1.0,
    "COM_RCL_EXCEPT": 0,
    "COM_RC_IN_MODE": 3,
    "COM_RC_LOSS_T": 0.5,
    "COM_SPOOLUP_TIME": 1.0,
    "EKF2_ACC_NOISE": 0.35,
    "EKF2_EN": 1,
    "EKF2_GYR_NOISE": 0.015,
    "GF_ACTION": 2,
    "GF_MAX_HOR_DIST": 0.0,
    "GF_MAX_VER_DIST": 0.0,
    "LNDMC_TRIG_TIME": 1.0,
    "MAV_0_CONFIG": 0,
    "MAV_COMP_ID": 1,
    "MAV_SYS_ID": 1,
    "MAV_TYPE": 2,
    "MIS_TAKEOFF_ALT": 2.5,
    "MPC_ACC_DOWN_MAX": 3.0,
    "MPC_ACC_HOR": 3.0,
    "MPC_ACC_UP_MAX": 4.0,
    "MPC_LAND_ALT3": 1.0,
    "MPC_LAND_CRWL": 0.3,
    "MPC_LAND_SPEED": 0.7,
    "MPC_THR_HOVER": 0.5,
    "MPC_TILTMAX_AIR": 45.0,
    "MPC_TKO_RAMP_T": 3.0,
    "MPC_TKO_SPEED": 1.5,
    "MPC_XY_CRUISE": 5.0,
    "MPC_XY_P": 0.95,
    "MPC_XY_VEL_D_ACC": 0.2,
    "MPC_XY_VEL_I_ACC": 0.4,
    "MPC_XY_VEL_MAX": 12.0,
    "MPC_XY_VEL_P_ACC": 1.8,
    "MPC_Z_P": 1.0,
    "MPC_Z_VEL_D_ACC": 0.0,
    "MPC_Z_VEL_I_ACC": 2.0,
    "MPC_Z_VEL_MAX_DN": 1.5,
    "MPC_Z_VEL_MAX_UP": 3.0,
    "MPC_Z_VEL_P_ACC": 4.0,
    "NAV_DLL_ACT": 0,
    "NAV_MC_ALT_RAD": 0.8,
    "NAV_RCL_ACT": 2,
    "RTL_DESCEND_ALT": 30.0,
    "RTL_MIN_DIST": 10.0,
    "RTL_RETURN_ALT": 60.0,
    "RTL_TYPE": 0,
    "SDLOG_MODE": 0,
    "SYS_AUTOCONFIG": 0,
    "SYS_AUTOSTART": 10040,
    "SYS_HAS_BARO": 1,
    "SYS_HAS_GPS": 1,
    "SYS_HAS_MAG": 1,
}
"""name to default in all versions; an int is INT32, a float is FLOAT"""
OF_SOME: dict[str, float | int] = {"COM_RC_OVERRIDE": 1, "MAN_OVERRIDE_SPD": 1.0, "SDLOG_BACKEND": 3}
"""those that a version may not have"""


def defaults(version: Px4Version) -> dict[str, float | int]:
    """The parameters of a version."""
    own = {name: OF_SOME[name] for name in (version.sticks, version.logging[0]) if name in OF_SOME}
    gain = version.roll_pitch_gain_per_s
    return {**DEFAULTS, **own, "MC_ROLL_P": gain, "MC_PITCH_P": gain}


def _as_float32(value: float) -> float:
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


class ParameterTable:
    """The parameters of one vehicle, sorted by name; indices are positions in that order."""

    def __init__(self, overrides: Mapping[str, float | int], version: Px4Version = OLDEST) -> None:
        self.version = version
        own = defaults(version)
        self._values = {name: _as_float32(v) if isinstance(v, float) else v for name, v in own.items()}
        for name, value in overrides.items():
            if name not in self._values:
                raise ValueError(f"PX4 parameter {name!r} is not known to the stub, got {value!r}")
            is_float = isinstance(own[name], float)
            if not is_float and not isinstance(value, int):
                raise ValueError(f"PX4 parameter {name} is an INT32, got {value!r}")
            self._values[name] = _as_float32(float(value)) if is_float else value
        self.names = tuple(sorted(self._values))
        self._indices = {name: index for index, name in enumerate(self.names)}

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, name: str) -> float | int:
        return self._values[name]

    def number(self, name: str) -> float:
        """Value of any parameter as a float."""
        return self._values[name]

    def integer(self, name: str) -> int:
        """Value of an INT32 parameter."""
        value = self._values[name]
        if not isinstance(value, int):
            raise TypeError(f"{name} is a FLOAT")
        return value

    def index(self, name: str) -> int:
        """Position of a parameter in the list."""
        return self._indices[name]

    def wire_type(self, name: str) -> int:
        """MAV_PARAM_TYPE of a parameter."""
        return TYPE_INT32 if isinstance(self._values[name], int) else TYPE_REAL32

    def wire_value(self, name: str) -> float:
        """The float that carries the value in PARAM_VALUE."""
        value = self._values[name]
        if isinstance(value, int):
            return float(struct.unpack("<f", struct.pack("<i", value))[0])
        return value

    def set_from_wire(self, name: str, wire_value: float, wire_type: int) -> bool | None:
        """Applies a PARAM_SET; True: changed, False: the value it already had, None: refused."""
        if name not in self._values or wire_type != self.wire_type(name):
            return None
        value: float | int
        if wire_type == TYPE_INT32:
            value = int(struct.unpack("<i", struct.pack("<f", wire_value))[0])
        elif not math.isfinite(wire_value):
            return None
        else:
            value = _as_float32(wire_value)
        if value == self._values[name]:
            return False
        self._values[name] = value
        return True

    def hash_check(self) -> float:
        """The float that carries `_HASH_CHECK`: a checksum of names and values, so that a client can use its cache."""
        checksum = 0
        for name in self.names:
            data = name.encode() + struct.pack("<f", self.wire_value(name))
            for byte in data:
                checksum = (checksum * 31 + byte) & 0x3FFFFFFF  # kept below the NaN patterns of a float
        return float(struct.unpack("<f", struct.pack("<I", checksum))[0])


def loop_gains(parameters: ParameterTable) -> LoopGains:
    """The position controller's constants as the parameters say."""
    number = parameters.number
    return LoopGains(
        position_horizontal_per_s=number("MPC_XY_P"),
        position_vertical_per_s=number("MPC_Z_P"),
        velocity_horizontal_p=number("MPC_XY_VEL_P_ACC"),
        velocity_horizontal_i=number("MPC_XY_VEL_I_ACC"),
        velocity_horizontal_d=number("MPC_XY_VEL_D_ACC"),
        velocity_vertical_p=number("MPC_Z_VEL_P_ACC"),
        velocity_vertical_i=number("MPC_Z_VEL_I_ACC"),
        velocity_vertical_d=number("MPC_Z_VEL_D_ACC"),
        speed_max_horizontal_m_s=number("MPC_XY_VEL_MAX"),
        speed_max_up_m_s=number("MPC_Z_VEL_MAX_UP"),
        speed_max_down_m_s=number("MPC_Z_VEL_MAX_DN"),
        tilt_max_rad=math.radians(number("MPC_TILTMAX_AIR")),
    )
