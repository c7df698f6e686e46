"""PX4's answers to MAVLink commands, as its versions were seen to give them (`tests/wire/answers.py`, held on PX4 too).

Sans-I/O: one table, one function per command.
"""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

os.environ["MAVLINK20"] = "1"
from pymavlink.dialects.v20 import development as mavlink

from companion.vehicle.autopilot.px4_versions import Px4Version
from sim.autopilot.commander import Commander, Result
from sim.autopilot.modes import AUTO_MAIN_MODE, MAIN_MODES, MODE_OF_CUSTOM, Mode
from sim.autopilot.navigator import Navigator
from sim.autopilot.telemetry import Telemetry

FORCE_MAGIC = 21196.0
"""param2 of MAV_CMD_COMPONENT_ARM_DISARM that overrides the checks"""
CUSTOM_MODE_FLAG = 1
PROTOCOL_VERSION = 300
"""a message that pymavlink does not have, and nobody reads: it is not sent"""


@dataclass(frozen=True, slots=True)
class CommandRequest:
    """COMMAND_LONG or COMMAND_INT, decoded."""

    command: int
    params: tuple[float, float, float, float]
    """param1 to param4"""
    latitude_deg: float
    """param5 as a latitude, NaN when not given"""
    longitude_deg: float
    """param6 as a longitude"""
    param7: float
    """param7, an AMSL altitude (m) where the command has a place"""


class CommandTarget(Protocol):
    """What commands act on: the autopilot."""

    now_ns: int
    commander: Commander
    navigator: Navigator
    telemetry: Telemetry
    version: Px4Version

    def send_now(self, message_id: int) -> bool:
        """Sends one message of a kind; False: not available."""

    def set_interval_us(self, message_id: int, interval_us: float) -> bool:
        """Changes a stream's interval; False: no such stream."""

    def report_interval(self, message_id: int) -> None:
        """Sends MESSAGE_INTERVAL."""

    def change_mode(self, mode: Mode) -> Result:
        """A user's mode change."""

    def order_reboot(self) -> None:
        """Restarts from the beginning, once the answer has left."""


def _arm_disarm(target: CommandTarget, request: CommandRequest) -> Result:
    force = request.params[1] == FORCE_MAGIC
    if request.params[0] == 1.0:
        return target.commander.arm(target.now_ns, force=force)
    if request.params[0] == 0.0:
        return target.commander.disarm(force=force)
    return Result.UNSUPPORTED


def _set_mode(target: CommandTarget, request: CommandRequest) -> Result:
    base, main, sub = (_integer(value) for value in request.params[:3])
    return set_mode(target, base, main, sub)


def set_mode(target: CommandTarget, base: int, main: int, sub: int) -> Result:
    """MAV_CMD_DO_SET_MODE and SET_MODE."""
    if not base & CUSTOM_MODE_FLAG or main not in MAIN_MODES:
        # Of versions that accept it nothing changes.
        return Result.TEMPORARILY_REJECTED if target.version.strict_commands else Result.ACCEPTED
    mode = MODE_OF_CUSTOM.get(main << 16 | (sub if main == AUTO_MAIN_MODE else 0) << 24)
    if mode is None or mode is Mode.DESCEND:
        return Result.TEMPORARILY_REJECTED
    return target.change_mode(mode)


def _take_off(target: CommandTarget, request: CommandRequest) -> Result:
    altitude = request.param7
    yaw = math.radians(request.params[3]) if math.isfinite(request.params[3]) else math.nan
    down = math.nan
    if math.isfinite(altitude):
        down = target.telemetry.projection.origin.altitude_amsl_m - altitude
    target.navigator.take_off_to(down, yaw)
    return target.change_mode(Mode.TAKEOFF)


def _land(target: CommandTarget, _: CommandRequest) -> Result:
    return target.change_mode(Mode.LAND)


def _return(target: CommandTarget, _: CommandRequest) -> Result:
    return target.change_mode(Mode.RTL)


def _reposition(target: CommandTarget, request: CommandRequest) -> Result:
    result = target.change_mode(Mode.LOITER)
    if result is not Result.ACCEPTED:
        return result
    telemetry = target.telemetry
    north = east = down = math.nan
    if math.isfinite(request.latitude_deg) and math.isfinite(request.longitude_deg):
        north, east = telemetry.projection.to_local(request.latitude_deg, request.longitude_deg)
    if math.isfinite(request.param7):
        down = telemetry.projection.origin.altitude_amsl_m - request.param7
    yaw = request.params[3]
    target.navigator.go_to(north, east, down, yaw if math.isfinite(yaw) else math.nan)
    return Result.ACCEPTED


def _request_message(target: CommandTarget, request: CommandRequest) -> Result:
    return Result.ACCEPTED if target.send_now(_integer(request.params[0])) else Result.DENIED


def _set_interval(target: CommandTarget, request: CommandRequest) -> Result:
    known = target.set_interval_us(_integer(request.params[0]), request.params[1])
    return Result.ACCEPTED if known else Result.FAILED


def _get_interval(target: CommandTarget, request: CommandRequest) -> Result:
    target.report_interval(_integer(request.params[0]))
    return Result.ACCEPTED


def _send_at_request(message_id: int) -> Callable[[CommandTarget, CommandRequest], Result]:
    """A command of its own for a message, which REQUEST_MESSAGE has taken the place of since."""

    def send(target: CommandTarget, _: CommandRequest) -> Result:
        if target.version.strict_commands:
            return Result.UNSUPPORTED
        target.send_now(message_id)
        return Result.ACCEPTED

    return send


def _reboot(target: CommandTarget, request: CommandRequest) -> Result:
    if target.commander.armed:
        return Result.TEMPORARILY_REJECTED
    if request.params[0] == 1.0:
        target.order_reboot()
    return Result.ACCEPTED


def _terminate(target: CommandTarget, request: CommandRequest) -> Result:
    if request.params[0] > 0.5:
        return target.change_mode(Mode.TERMINATION)
    return Result.ACCEPTED


def _accept(_: CommandTarget, __: CommandRequest) -> Result:
    return Result.ACCEPTED


def _start_mission(target: CommandTarget, _: CommandRequest) -> Result:
    del target
    return Result.TEMPORARILY_REJECTED


def _integer(value: float) -> int:
    return int(value) if math.isfinite(value) else -1


COMMANDS: dict[int, Callable[[CommandTarget, CommandRequest], Result]] = {
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: _arm_disarm,
    mavlink.MAV_CMD_DO_SET_MODE: _set_mode,
    mavlink.MAV_CMD_NAV_TAKEOFF: _take_off,
    mavlink.MAV_CMD_NAV_LAND: _land,
    mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: _return,
    mavlink.MAV_CMD_DO_REPOSITION: _reposition,
    mavlink.MAV_CMD_REQUEST_MESSAGE: _request_message,
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: _set_interval,
    mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: _get_interval,
    mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: _send_at_request(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION),
    mavlink.MAV_CMD_REQUEST_PROTOCOL_VERSION: _send_at_request(PROTOCOL_VERSION),
    mavlink.MAV_CMD_GET_HOME_POSITION: _send_at_request(mavlink.MAVLINK_MSG_ID_HOME_POSITION),
    mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: _reboot,
    mavlink.MAV_CMD_DO_FLIGHTTERMINATION: _terminate,
    mavlink.MAV_CMD_DO_CHANGE_SPEED: _accept,
    mavlink.MAV_CMD_MISSION_START: _start_mission,
}
"""every other command is answered UNSUPPORTED"""
USED_PARAMETERS: dict[int, frozenset[int]] = {
    mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: frozenset(),
    mavlink.MAV_CMD_NAV_LAND: frozenset({1, 2, 4, 5, 6, 7}),
    mavlink.MAV_CMD_NAV_TAKEOFF: frozenset({1, 4, 5, 6, 7}),
    mavlink.MAV_CMD_DO_SET_MODE: frozenset({1, 2, 3}),
    mavlink.MAV_CMD_DO_CHANGE_SPEED: frozenset({1, 2, 3}),
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: frozenset({1, 2}),
}
"""command -> the parameters (param1 to param7) that it has; a value in another is DENIED by versions that look"""


def answer(target: CommandTarget, request: CommandRequest) -> Result:
    """Carries out one command."""
    used = USED_PARAMETERS.get(request.command)
    if target.version.strict_commands and used is not None:
        values = (*request.params, request.latitude_deg, request.longitude_deg, request.param7)
        if any(value != 0.0 and not math.isnan(value) for k, value in enumerate(values, 1) if k not in used):
            return Result.DENIED
    handler = COMMANDS.get(request.command)
    return Result.UNSUPPORTED if handler is None else handler(target, request)
