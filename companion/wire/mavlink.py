"""MAVLink 2 datagrams <-> values, for one vehicle's link. No I/O; what cannot be read is counted.

The companion speaks with the vehicle's own system id and component 191 (onboard computer). Values stay in the
autopilot's local NED frame here; `agent` shifts them to the fleet frame.
"""

import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from math import inf, isfinite, nan
from operator import attrgetter
from typing import Any

os.environ.setdefault("MAVLINK20", "1")
from pymavlink.dialects.v20 import development as mavlink

from companion.core.counts import Counts
from companion.core.frames import Geodetic, Ned

dialect = mavlink
"""pymavlink's generated messages: `development`, since `common` lacks CURRENT_MODE"""
COMPANION_COMPONENT_ID = 191
AUTOPILOT_COMPONENT_ID = 1
AUTOPILOT_PX4 = 12
MULTICOPTERS = frozenset({2, 3, 4, 13, 14, 15, 29})
"""MAV_TYPE: quadrotor, coaxial, helicopter, hexarotor, octorotor, tricopter, dodecarotor"""
PLAUSIBLE_MAX = 1e6
"""no position (m) or velocity (m/s) is larger than this: float32 holds far more, and squares of it overflow later"""
REJECTED = ("malformed", "foreign system", "not finite", "out of range", "heartbeat of no autopilot")
"""what a link counts"""
SETPOINT_TYPE_MASK = 0x903
"""ignore x, y, az and yaw rate: velocity and acceleration on the level, altitude by position, climb rate, yaw"""


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


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """HEARTBEAT (0) of the autopilot."""

    autopilot: int
    vehicle_type: int
    armed: bool
    custom_mode: int
    system_status: int


@dataclass(frozen=True, slots=True)
class LocalPosition:
    """LOCAL_POSITION_NED (32)."""

    boot_ms: int
    position_local_ned_m: Ned
    velocity_ned_m_s: Ned


@dataclass(frozen=True, slots=True)
class GlobalOrigin:
    """GPS_GLOBAL_ORIGIN (49): where the local frame's origin lies."""

    origin: Geodetic


@dataclass(frozen=True, slots=True)
class CurrentMode:
    """CURRENT_MODE (436)."""

    custom_mode: int
    intended_custom_mode: int


@dataclass(frozen=True, slots=True)
class LandedState:
    """EXTENDED_SYS_STATE (245): 1 on ground, 2 in air, 3 taking off, 4 landing."""

    state: int


@dataclass(frozen=True, slots=True)
class EstimatorHealth:
    """ESTIMATOR_STATUS (230)."""

    flags: int
    horizontal_accuracy_m: float
    """infinite where none is told"""
    vertical_accuracy_m: float


@dataclass(frozen=True, slots=True)
class SystemHealth:
    """SYS_STATUS (1)."""

    sensors_health: int
    battery_percent: int
    """-1: unknown"""


@dataclass(frozen=True, slots=True)
class CommandAnswer:
    """COMMAND_ACK (77) to a command of ours."""

    command: int
    result: int


@dataclass(frozen=True, slots=True)
class ParameterValue:
    """PARAM_VALUE (22)."""

    name: str
    value: float | int


@dataclass(frozen=True, slots=True)
class TimeAnswer:
    """TIMESYNC (111) in answer to a request of ours."""

    asked_ns: int
    """our time in the request, mirrored"""


@dataclass(frozen=True, slots=True)
class SystemTime:
    """SYSTEM_TIME (2) of an autopilot that knows UTC."""

    unix_us: int


@dataclass(frozen=True, slots=True)
class HomePosition:
    """HOME_POSITION (242)."""

    altitude_amsl_m: float


Event = (
    Heartbeat | LocalPosition | GlobalOrigin | CurrentMode | LandedState | EstimatorHealth | SystemHealth
    | CommandAnswer | ParameterValue | TimeAnswer | SystemTime | HomePosition
)  # fmt: skip

_HEADER = struct.Struct("<BBBBBBHB")
"""a MAVLink 2 frame's head after its mark: length, flags, flags, sequence, system, component, message id"""
_CHECKSUM = struct.Struct("<H")


@cache
def _layout(kind: Any) -> tuple[int, int, struct.Struct, bytes]:
    """Of a message class: the id's low and high part, the packer of its fields, the checksum's extra byte."""
    return kind.id & 0xFFFF, kind.id >> 16, kind.unpacker, bytes((kind.crc_extra,))


@cache
def _fields(kind: Any) -> Callable[[Any], tuple[Any, ...]] | None:
    """A message's fields in the wire's order; None for a class with arrays, which pymavlink packs by itself."""
    names = kind.ordered_fieldnames
    return attrgetter(*names) if len(names) > 1 and not any(kind.array_lengths) else None


def frame(kind: Any, values: tuple[Any, ...], link: Any) -> bytes:
    """One MAVLink 2 frame of a message class from its fields' values in the wire's order.

    The same bytes as from pymavlink's `message.pack(link)`, for a fifth of its cost: what comes many times a second is
    packed here. Like that it leaves the link's sequence number as it is.
    """
    low, high, packer, extra = _layout(kind)
    payload = packer.pack(*values).rstrip(b"\0") or b"\0"
    body = _HEADER.pack(len(payload), 0, 0, link.seq, link.srcSystem, link.srcComponent, low, high) + payload
    return b"\xfd" + body + _CHECKSUM.pack(mavlink.x25crc(body + extra).crc)


def packed(message: Any, link: Any) -> bytes:
    """The same of one of pymavlink's messages."""
    kind: Any = type(message)
    fields = _fields(kind)
    return bytes(message.pack(link)) if fields is None else frame(kind, fields(message), link)


def unpacked(kind: Any, datagram: bytes) -> tuple[Any, ...] | None:
    """The values of a frame's fields in the wire's order; None where the checksum is wrong.

    That the datagram is one whole, unsigned MAVLink 2 frame of this message class is the caller's to have seen.
    """
    _, _, packer, extra = _layout(kind)
    (checksum,) = _CHECKSUM.unpack_from(datagram, len(datagram) - 2)
    if mavlink.x25crc(datagram[1:-2] + extra).crc != checksum:
        return None
    # Zeros at the end are left out on the wire; what follows the known fields is an extension.
    return packer.unpack(datagram[10:-2].ljust(packer.size, b"\0")[: packer.size])


def whole_frame(datagram: bytes) -> int:
    """The message id of a datagram that is one whole, unsigned MAVLink 2 frame by its head and length; else -1."""
    if len(datagram) < 12 or datagram[0] != 0xFD or datagram[2] != 0 or len(datagram) != 12 + datagram[1]:
        return -1
    return datagram[7] | datagram[8] << 8 | datagram[9] << 16


_READ = frozenset({0, 1, 2, 22, 32, 49, 77, 111, 230, 242, 245, 436})
UTC_KNOWN_US = 1_577_836_800_000_000
"""2020: an autopilot's UTC before that is none"""
ORIGIN_MESSAGE_ID = 49
REQUEST_MESSAGE = mavlink.MAV_CMD_REQUEST_MESSAGE
POSITION_MESSAGE_ID = 32
_OFTEN = {
    kind.id: kind
    for kind in (
        mavlink.MAVLink_local_position_ned_message,
        mavlink.MAVLink_current_mode_message,
        mavlink.MAVLink_extended_sys_state_message,
    )
}
"""message classes that come many times a second: decoded without pymavlink's objects"""
POSITION_RATE_HZ = 50.0
STREAMS_HZ = {POSITION_MESSAGE_ID: POSITION_RATE_HZ, 436: 20.0, 245: 5.0, 230: 1.0, 1: 1.0, 2: 1.0, 242: 0.5}
"""what the companion asks for with SET_MESSAGE_INTERVAL"""
STREAMS_OFF = (30, 31, 33, 105, 331, 111, 141, 132, 83, 85, 36, 74, 24, 87)
"""what a companion's link carries by default and nobody here reads"""


class FrameSplitter:
    """Cuts a byte stream (a serial line) into frames, each as it would be a datagram; noise between them is dropped.

    A frame counts once it is whole and another, or nothing yet, follows it; its checksum is `MavlinkCodec`'s to check.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.dropped = 0
        """bytes that belonged to no frame"""

    def split(self, data: bytes) -> list[bytes]:
        """The frames that are whole by now; what has begun waits for the next bytes."""
        self._buffer += data
        buffer, begin = self._buffer, 0
        frames = []
        while (length := _frame_length(buffer, begin)) is not None:
            end = begin + length
            if length == 0 or (end < len(buffer) and buffer[end] not in _FRAME_STARTS):
                begin += 1
                self.dropped += 1
            elif end <= len(buffer):
                frames.append(bytes(buffer[begin:end]))
                begin = end
            else:
                break
        del buffer[:begin]
        return frames


_FRAME_STARTS = (0xFD, 0xFE)
"""MAVLink 2, and 1, which PX4 speaks on a serial line until it has heard 2"""


def _frame_length(buffer: bytearray, begin: int) -> int | None:
    """Length of the frame that begins there, as far as its head tells: 0 for none, None where the head is cut off."""
    if len(buffer) - begin < 3:
        return None
    match buffer[begin]:
        case 0xFD if buffer[begin + 2] < 2:
            return 12 + buffer[begin + 1] + 13 * buffer[begin + 2]
        case 0xFE:
            return 8 + buffer[begin + 1]
    return 0


class MavlinkCodec:
    """Codec of one vehicle's link: decodes what its autopilot says, encodes what the companion says."""

    def __init__(self, system_id: int) -> None:
        self.system_id = system_id
        self.rejected = Counts(REJECTED)
        self.not_read = 0
        self.foreign_system_id: int | None = None
        """of the autopilot that was last heard on this link under another system id"""
        self.foreign_heard = 0
        """messages of such autopilots so far"""
        self._out: Any = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=COMPANION_COMPONENT_ID)
        self._in: Any = mavlink.MAVLink(None)
        self._in.robust_parsing = True

    def decode(self, datagram: bytes) -> list[Event]:
        """The events in a datagram; damage and strangers are counted by kind."""
        kind = _OFTEN.get(whole_frame(datagram))
        if kind is not None:
            event = self._often(kind, datagram)
            return [] if event is None else [event]
        if len(datagram) >= 10 and datagram[0] == 0xFD:
            # Most of a link's traffic is not for us; the header tells at a hundredth of a decoding's cost.
            message_id = datagram[7] | datagram[8] << 8 | datagram[9] << 16
            whole = datagram[2] < 2 and len(datagram) == 12 + datagram[1] + 13 * datagram[2]
            if whole and message_id not in _READ:
                self.not_read += 1
                return []
            if whole:
                try:
                    event = self._event(self._in.decode(bytearray(datagram)))
                except mavlink.MAVError:
                    self.rejected["malformed"] += 1
                    return []
                return [] if event is None else [event]
        errors = self._in.total_receive_errors
        messages = self._in.parse_buffer(datagram) or []
        if self._in.total_receive_errors > errors or not messages or self._in.buf_len() > 0:
            self.rejected["malformed"] += 1
            # What is cut off at a datagram's end does not go on in the next.
            self._in.buf.clear()
            self._in.buf_index = 0
        events = []
        for message in messages:
            event = self._event(message)
            if event is not None:
                events.append(event)
        return events

    def _often(self, kind: Any, datagram: bytes) -> Event | None:
        values = unpacked(kind, datagram)
        if values is None:
            self.rejected["malformed"] += 1
            return None
        if datagram[5] != self.system_id or datagram[6] != AUTOPILOT_COMPONENT_ID:
            self.rejected["foreign system"] += 1
            return None
        if kind is mavlink.MAVLink_local_position_ned_message:
            return self._local_position(*values)
        if kind is mavlink.MAVLink_current_mode_message:
            return CurrentMode(values[0], values[1])
        return LandedState(values[1])

    def _local_position(
        self, boot_ms: int, x: float, y: float, z: float, vx: float, vy: float, vz: float
    ) -> LocalPosition | None:
        numbers = (x, y, z, vx, vy, vz)
        if not all(-PLAUSIBLE_MAX <= x <= PLAUSIBLE_MAX for x in numbers):
            self.rejected["not finite" if not all(map(isfinite, numbers)) else "out of range"] += 1
            return None
        return LocalPosition(boot_ms, Ned(x, y, z), Ned(vx, vy, vz))

    def _event(self, message: Any) -> Event | None:
        if isinstance(message, mavlink.MAVLink_bad_data):
            return None
        if message.get_srcSystem() != self.system_id or message.get_srcComponent() != AUTOPILOT_COMPONENT_ID:
            self.rejected["foreign system"] += 1
            if _is_autopilot(message):
                self.foreign_system_id = message.get_srcSystem()
                self.foreign_heard += 1
            return None
        match message:
            case mavlink.MAVLink_local_position_ned_message():
                return self._local_position(
                    message.time_boot_ms, message.x, message.y, message.z, message.vx, message.vy, message.vz
                )
            case mavlink.MAVLink_heartbeat_message():
                if message.autopilot == mavlink.MAV_AUTOPILOT_INVALID:
                    # A camera or a ground station with the autopilot's ids: it would disarm the vehicle in our eyes.
                    self.rejected["heartbeat of no autopilot"] += 1
                    return None
                return Heartbeat(
                    message.autopilot, message.type, bool(message.base_mode & 128), message.custom_mode,
                    message.system_status,
                )  # fmt: skip
            case mavlink.MAVLink_current_mode_message():
                return CurrentMode(message.custom_mode, message.intended_custom_mode)
            case mavlink.MAVLink_extended_sys_state_message():
                return LandedState(message.landed_state)
            case mavlink.MAVLink_gps_global_origin_message():
                unset = message.latitude == 0 and message.longitude == 0
                if unset or abs(message.latitude) > 900_000_000 or abs(message.longitude) > 1_800_000_000:
                    self.rejected["out of range"] += 1
                    return None
                return GlobalOrigin(
                    Geodetic(message.latitude * 1e-7, message.longitude * 1e-7, message.altitude * 1e-3)
                )
            case mavlink.MAVLink_estimator_status_message():
                accuracy = (message.pos_horiz_accuracy, message.pos_vert_accuracy)
                # No estimate is exact: what is not above 0 was never filled in.
                return EstimatorHealth(message.flags, *(x if 0.0 < x < inf else inf for x in accuracy))
            case mavlink.MAVLink_sys_status_message():
                charge = message.battery_remaining if 0 <= message.battery_remaining <= 100 else -1
                return SystemHealth(message.onboard_control_sensors_health, charge)
            case mavlink.MAVLink_command_ack_message():
                if message.target_component not in (0, COMPANION_COMPONENT_ID):
                    return None
                return CommandAnswer(message.command, message.result)
            case mavlink.MAVLink_param_value_message():
                if message.param_type not in (mavlink.MAV_PARAM_TYPE_INT32, mavlink.MAV_PARAM_TYPE_REAL32):
                    return None  # `_HASH_CHECK`
                value = parameter_value(message)
                if not isfinite(value):
                    self.rejected["not finite"] += 1
                    return None
                return ParameterValue(message.param_id.rstrip("\x00"), value)
            case mavlink.MAVLink_timesync_message():
                return TimeAnswer(message.ts1) if message.tc1 != 0 else None
            case mavlink.MAVLink_system_time_message():
                return SystemTime(message.time_unix_usec) if message.time_unix_usec > UTC_KNOWN_US else None
            case mavlink.MAVLink_home_position_message():
                return HomePosition(message.altitude * 1e-3)
        self.not_read += 1
        return None

    def heartbeat(self) -> bytes:
        """HEARTBEAT of an onboard controller."""
        return self._pack(
            mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3
            )
        )

    def setpoint(
        self, boot_ms: int, position_down_m: float, velocity_ned_m_s: Ned, acceleration_ne_m_s2: tuple[float, float],
        yaw_rad: float,
    ) -> bytes:  # fmt: skip
        """SET_POSITION_TARGET_LOCAL_NED (84) in the autopilot's local frame, mask 0x903."""
        v, (a_north, a_east) = velocity_ned_m_s, acceleration_ne_m_s2
        values = (
            boot_ms & 0xFFFFFFFF, 0.0, 0.0, position_down_m, v.north, v.east, v.down, a_north, a_east, 0.0, yaw_rad,
            0.0, SETPOINT_TYPE_MASK, self.system_id, AUTOPILOT_COMPONENT_ID, mavlink.MAV_FRAME_LOCAL_NED,
        )  # fmt: skip
        return self._numbered(frame(mavlink.MAVLink_set_position_target_local_ned_message, values, self._out))

    def command(self, command: int, *parameters: float) -> bytes:
        """COMMAND_LONG (76); parameters left out are 0."""
        values = [*parameters, *([0.0] * (7 - len(parameters)))]
        return self._pack(
            mavlink.MAVLink_command_long_message(self.system_id, AUTOPILOT_COMPONENT_ID, command, 0, *values)
        )

    def read_parameter(self, name: str) -> bytes:
        """PARAM_REQUEST_READ (20) by name."""
        return self._pack(
            mavlink.MAVLink_param_request_read_message(self.system_id, AUTOPILOT_COMPONENT_ID, name.encode(), -1)
        )

    def time_request(self, now_ns: int) -> bytes:
        """TIMESYNC (111): the autopilot mirrors our time."""
        return self._pack(mavlink.MAVLink_timesync_message(0, now_ns))

    def _pack(self, message: Any) -> bytes:
        return self._numbered(packed(message, self._out))

    def _numbered(self, data: bytes) -> bytes:
        # Gaps in the sequence are how the other side counts losses.
        self._out.seq = (self._out.seq + 1) % 256
        return data


def _is_autopilot(message: Any) -> bool:
    return (
        isinstance(message, mavlink.MAVLink_heartbeat_message)
        and message.get_srcComponent() == AUTOPILOT_COMPONENT_ID
        and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID
    )


def parameter_value(message: Any) -> float | int:
    """Value of a PARAM_VALUE: PX4 puts an INT32 bytewise into the float."""
    if message.param_type == mavlink.MAV_PARAM_TYPE_INT32:
        return int(struct.unpack("<i", struct.pack("<f", message.param_value))[0])
    return float(message.param_value)


def arm_parameters(arm: bool) -> tuple[int, float]:
    """Command and parameter of MAV_CMD_COMPONENT_ARM_DISARM."""
    return mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0 if arm else 0.0


FORCE = 21196.0
"""param2 of MAV_CMD_COMPONENT_ARM_DISARM by which motors stop in flight too"""


def kill_parameters() -> tuple[int, float, float]:
    """Command and parameters that disarm at once, wherever the vehicle is."""
    return mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.0, FORCE


def mode_parameters(mode: Px4Mode) -> tuple[int, float, float, float]:
    """Command and parameters of MAV_CMD_DO_SET_MODE for a PX4 mode."""
    main, sub = (mode >> 16) & 0xFF, (mode >> 24) & 0xFF
    return mavlink.MAV_CMD_DO_SET_MODE, float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED), float(main), float(sub)


def takeoff_parameters(altitude_amsl_m: float) -> tuple[int, float, float, float, float, float, float, float]:
    """Command and parameters of MAV_CMD_NAV_TAKEOFF: straight up, heading as it is."""
    return mavlink.MAV_CMD_NAV_TAKEOFF, nan, 0.0, 0.0, nan, nan, nan, altitude_amsl_m


def interval_parameters(message_id: int, rate_hz: float) -> tuple[int, float, float]:
    """Command and parameters of MAV_CMD_SET_MESSAGE_INTERVAL; a rate of 0 turns the stream off."""
    return mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, float(message_id), 1e6 / rate_hz if rate_hz > 0 else -1.0


def request_message_parameters(message_id: int) -> tuple[int, float]:
    """Command and parameter of MAV_CMD_REQUEST_MESSAGE."""
    return REQUEST_MESSAGE, float(message_id)
