"""PX4's parameters of a fleet as a file that QGroundControl loads: what a vehicle is set to before its first flight."""

from collections.abc import Iterator

from companion.config import FleetConfig
from companion.vehicle.autopilot.px4_versions import Px4Version, fleet_parameters
from companion.wire.px4 import PARAMETER_INT32, PARAMETER_REAL32

HARDWARE: dict[str, tuple[float | int, str]] = {
    "COM_OF_LOSS_T": (1.0, "how long after the last setpoint the failsafe acts (s)"),
    "COM_LOW_BAT_ACT": (3, "a critical battery returns, one in an emergency lands"),
    "GF_ACTION": (2, "a crossed geofence of PX4's own holds"),
    "NAV_DLL_ACT": (0, "a ground station may come and go"),
    "COM_DISARM_LAND": (2.0, "disarms so long after touch-down (s)"),
    "MAV_1_CONFIG": (102, "the companion's line is TELEM 2"),
    "MAV_1_MODE": (2, "onboard"),
    "SER_TEL2_BAUD": (921600, "its baud rate"),
}
"""beside what every fleet sets: value and reason"""
REASONS = {
    "COM_OBL_RC_ACT": "setpoints that end have it land",
    "NAV_RCL_ACT": "lost RC",
    "COM_RCL_EXCEPT": "OFFBOARD and RC",
}
WITH_PILOT: dict[str, float | int] = {"NAV_RCL_ACT": 2, "COM_RCL_EXCEPT": 0}
"""preflight.require_rc: a lost transmitter returns, in OFFBOARD too"""


def hardware_parameters(config: FleetConfig, version: Px4Version) -> dict[str, float | int]:
    """What preflight of this fleet wants on that version, and the companion's line."""
    pilots = WITH_PILOT if config.preflight.require_rc else {}
    values = {**fleet_parameters(version), **pilots, **{name: value for name, (value, _) in HARDWARE.items()}}
    values["COM_OF_LOSS_T"] = min(config.preflight.offboard_loss_limit_s, 1.0)
    return values


def params_file(config: FleetConfig, version: Px4Version) -> Iterator[str]:
    """Its lines: vehicle, component, name, value and MAV_PARAM_TYPE, with the reasons as comments."""
    number = ".".join(map(str, version.number))
    yield f"# PX4 v{number} in the fleet {config.fleet.name!r}: parameters beside your airframe's own"
    yield f"# A pilot ends OFFBOARD: he {version.sticks_way}."
    yield "# Vehicle-Id\tComponent-Id\tName\tValue\tType"
    reasons = {**REASONS, **{name: why for name, (_, why) in HARDWARE.items()}, version.sticks: "sticks end OFFBOARD"}
    for name, value in hardware_parameters(config, version).items():
        kind = PARAMETER_INT32 if isinstance(value, int) else PARAMETER_REAL32
        yield f"# {name}: {reasons[name]}"
        yield f"1\t1\t{name}\t{value:.18g}\t{kind}" if isinstance(value, float) else f"1\t1\t{name}\t{value}\t{kind}"
