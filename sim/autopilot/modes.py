"""PX4's flight modes as MAVLink shows them: custom_mode, base_mode, what each mode needs. Pure tables."""

from enum import Enum, IntEnum

AUTO_MAIN_MODE = 4
MANUAL_MAIN_MODES = frozenset({1, 2, 3, 5, 7})


class Mode(Enum):
    """PX4's flight modes: main mode and sub-mode, which custom_mode packs as main << 16 | sub << 24."""

    MANUAL = (1, 0)
    ALTCTL = (2, 0)
    POSCTL = (3, 0)
    TAKEOFF = (4, 2)
    LOITER = (4, 3)
    MISSION = (4, 4)
    RTL = (4, 5)
    LAND = (4, 6)
    DESCEND = (4, 20)
    """a landing without a position, of versions that have it as a mode of its own; nobody can choose it"""
    ACRO = (5, 0)
    OFFBOARD = (6, 0)
    STABILIZED = (7, 0)
    TERMINATION = (10, 0)

    def __init__(self, main: int, sub: int) -> None:
        # Plain attributes: they are asked for at every step of every vehicle.
        self.custom_mode = main << 16 | sub << 24
        """HEARTBEAT.custom_mode of this mode"""
        self.is_manual = main in MANUAL_MAIN_MODES
        """needs a pilot's sticks"""
        self.is_auto = main == AUTO_MAIN_MODE
        """flown by the autopilot alone"""
        self.is_landing = (main, sub) in ((4, 6), (4, 20))
        """down to the ground and no farther"""


MODE_OF_CUSTOM = {mode.custom_mode: mode for mode in Mode}
MAIN_MODES = frozenset(mode.value[0] for mode in Mode)

NOT_ARMABLE_MODES = frozenset({Mode.LAND, Mode.DESCEND, Mode.RTL, Mode.TERMINATION})
"""modes that prevent arming (PX4's mode_req_prevent_arming); when disarmed PX4 falls back to the last choice that is
none of these"""

STANDARD_MODE = {Mode.LAND: 7, Mode.TAKEOFF: 8}
"""CURRENT_MODE.standard_mode as recorded (MAV_STANDARD_MODE_LAND, _TAKEOFF); 0 for the others"""


def base_mode(mode: Mode, *, armed: bool, offboard_controlled: bool) -> int:
    """HEARTBEAT.base_mode: as measured, 81 manual, 29 auto, 17 offboard (1 before any set-point), 128 when armed."""
    if mode.is_manual:
        bits = 81
    elif mode.is_auto:
        bits = 29
    elif mode is Mode.OFFBOARD:
        bits = 17 if offboard_controlled else 1
    else:
        bits = 1
    return bits | (128 if armed else 0)


class LandedState(IntEnum):
    """EXTENDED_SYS_STATE.landed_state."""

    UNDEFINED = 0
    ON_GROUND = 1
    IN_AIR = 2
    TAKEOFF = 3
    LANDING = 4


class SystemStatus(IntEnum):
    """HEARTBEAT.system_status as PX4 uses it."""

    NOT_READY = 0
    STANDBY = 3
    ACTIVE = 4
    FAILSAFE = 5
    TERMINATED = 8


class OffboardLossAction(IntEnum):
    """COM_OBL_RC_ACT: what happens when offboard set-points stop."""

    POSITION = 0
    ALTITUDE = 1
    STABILIZED = 2
    RETURN = 3
    LAND = 4
    HOLD = 5
    TERMINATE = 6
    DISARM = 7


MODE_OF_LOSS_ACTION = {
    OffboardLossAction.POSITION: Mode.POSCTL,
    OffboardLossAction.ALTITUDE: Mode.ALTCTL,
    OffboardLossAction.STABILIZED: Mode.STABILIZED,
    OffboardLossAction.RETURN: Mode.RTL,
    OffboardLossAction.LAND: Mode.LAND,
    OffboardLossAction.HOLD: Mode.LOITER,
    OffboardLossAction.TERMINATE: Mode.TERMINATION,
}
"""DISARM has no mode: the motors stop"""
