"""MAVLink datagrams <-> values, for one vehicle's link. No I/O; what cannot be read is counted.

The companion speaks with the vehicle's own system id and component 191 (onboard computer). Values stay in the
autopilot's local NED frame here; the autopilot's client shifts them to the fleet frame.

The dozen messages that a companion reads and the five that it sends are `struct` layouts: pymavlink's generated dialect
costs 90 MB of disk, 7 MB of memory and ten times the time for each message. Tests hold every layout against it.
"""

import struct
from collections.abc import Callable, Sequence
from math import inf, isfinite
from typing import Any, NamedTuple

from companion.core.counts import Counts
from companion.core.frames import Geodetic, Ned
from companion.wire.mavlink_frames import (
    HEAD_1,
    HEAD_2,
    MARK_2,
    Layout,
    checksum_fits,
    frames_of,
    is_one_frame,
)
from companion.wire.px4 import PARAMETER_INT32, PARAMETER_REAL32, Software, parameter_value, software

COMPANION_COMPONENT_ID = 191
AUTOPILOT_COMPONENT_ID = 1
ONBOARD_CONTROLLER = 18
"""MAV_TYPE"""
NO_AUTOPILOT = 8
"""MAV_AUTOPILOT_INVALID"""
ARMED = 128
"""bit of HEARTBEAT.base_mode"""
ON_GROUND = 1
"""MAV_LANDED_STATE; 0 is unknown"""
PLAUSIBLE_MAX = 1e6
"""no position (m) or velocity (m/s) is larger than this: float32 holds far more, and squares of it overflow later"""
UTC_KNOWN_US = 1_577_836_800_000_000
"""2020: an autopilot's UTC before that is none"""
REJECTED = ("malformed", "foreign system", "not finite", "out of range", "heartbeat of no autopilot")
"""what a link counts"""
SETPOINT_TYPE_MASK = 0x903
"""ignore x, y, az and yaw rate: velocity and acceleration on the level, altitude by position, climb rate, yaw"""
LOCAL_NED = 1
"""MAV_FRAME"""


class Heartbeat(NamedTuple):
    """HEARTBEAT (0) of the autopilot."""

    autopilot: int
    vehicle_type: int
    armed: bool
    custom_mode: int


class LocalPosition(NamedTuple):
    """LOCAL_POSITION_NED (32)."""

    boot_ms: int
    position_local_ned_m: Ned
    velocity_ned_m_s: Ned


class GlobalOrigin(NamedTuple):
    """GPS_GLOBAL_ORIGIN (49): where the local frame's origin lies."""

    origin: Geodetic


class CurrentMode(NamedTuple):
    """CURRENT_MODE (436)."""

    custom_mode: int
    intended_custom_mode: int


class LandedState(NamedTuple):
    """EXTENDED_SYS_STATE (245): 0 unknown, ON_GROUND, 2 in air, 3 taking off, 4 landing."""

    state: int


class EstimatorHealth(NamedTuple):
    """ESTIMATOR_STATUS (230)."""

    flags: int
    horizontal_accuracy_m: float
    """infinite where none is told"""


class SystemHealth(NamedTuple):
    """SYS_STATUS (1)."""

    sensors_health: int
    battery_percent: int
    """-1: unknown"""


class CommandAnswer(NamedTuple):
    """COMMAND_ACK (77) to a command of ours."""

    command: int
    result: int


class ParameterValue(NamedTuple):
    """PARAM_VALUE (22)."""

    name: str
    value: float | int


class ParameterError(NamedTuple):
    """PARAM_ERROR (345), since PX4 v1.18: a parameter of that name is not there, or is not told."""

    name: str


class TimeAnswer(NamedTuple):
    """TIMESYNC (111) in answer to a request of ours."""

    asked_ns: int
    """our time in the request, mirrored"""


class SystemTime(NamedTuple):
    """SYSTEM_TIME (2) of an autopilot that knows UTC."""

    unix_us: int


class HomePosition(NamedTuple):
    """HOME_POSITION (242)."""

    altitude_amsl_m: float


Event = (
    Heartbeat | LocalPosition | GlobalOrigin | CurrentMode | LandedState | EstimatorHealth | SystemHealth
    | CommandAnswer | ParameterValue | ParameterError | TimeAnswer | SystemTime | HomePosition | Software
)  # fmt: skip


def _layout(message_id: int, extra: int, fields: str) -> Layout:
    return Layout(message_id, bytes((extra,)), struct.Struct(fields))


# Fields as in MAVLink's message set `common` (CURRENT_MODE: `development`), extensions as far as they are read.
HEARTBEAT = _layout(0, 50, "<IBBBBB")
SYS_STATUS = _layout(1, 124, "<IIIHHhHHHHHHb")
SYSTEM_TIME = _layout(2, 137, "<QI")
PARAM_REQUEST_READ = _layout(20, 214, "<hBB16s")
PARAM_VALUE = _layout(22, 220, "<4sHH16sB")
LOCAL_POSITION_NED = _layout(32, 185, "<Iffffff")
GPS_GLOBAL_ORIGIN = _layout(49, 39, "<iii")
COMMAND_LONG = _layout(76, 152, "<fffffffHBBB")
COMMAND_ACK = _layout(77, 143, "<HBBiBB")
SET_POSITION_TARGET_LOCAL_NED = _layout(84, 143, "<IfffffffffffHBBB")
TIMESYNC = _layout(111, 34, "<qq")
AUTOPILOT_VERSION = _layout(148, 178, "<QQIIIIHH8s")
ESTIMATOR_STATUS = _layout(230, 163, "<QffffffffH")
HOME_POSITION = _layout(242, 104, "<iii")
EXTENDED_SYS_STATE = _layout(245, 130, "<BB")
PARAM_ERROR = _layout(345, 209, "<hBB16sB")
CURRENT_MODE = _layout(436, 193, "<II")
SETUP_SIGNING = _layout(256, 71, "<QBB32s")
SENT = (HEARTBEAT, PARAM_REQUEST_READ, COMMAND_LONG, SET_POSITION_TARGET_LOCAL_NED, TIMESYNC, SETUP_SIGNING)
"""what a companion says"""
READ = (
    LOCAL_POSITION_NED, CURRENT_MODE, EXTENDED_SYS_STATE, HEARTBEAT, GPS_GLOBAL_ORIGIN, ESTIMATOR_STATUS, SYS_STATUS,
    COMMAND_ACK, PARAM_VALUE, PARAM_ERROR, TIMESYNC, SYSTEM_TIME, HOME_POSITION, AUTOPILOT_VERSION,
)  # fmt: skip
"""what it hears"""


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
        self._sequence = 0
        self._autopilot = bytes((system_id, AUTOPILOT_COMPONENT_ID))
        self._readers: dict[bytes, tuple[Layout, Callable[..., Event | None]]] = {
            layout.key: (layout, read)
            for layout, read in (
                (LOCAL_POSITION_NED, self._local_position),
                (CURRENT_MODE, CurrentMode),
                (EXTENDED_SYS_STATE, _landed_state),
                (HEARTBEAT, self._heartbeat),
                (GPS_GLOBAL_ORIGIN, self._global_origin),
                (ESTIMATOR_STATUS, _estimator_status),
                (SYS_STATUS, _system_status),
                (COMMAND_ACK, _command_answer),
                (PARAM_VALUE, self._parameter),
                (PARAM_ERROR, _parameter_error),
                (TIMESYNC, _time_answer),
                (SYSTEM_TIME, _system_time),
                (HOME_POSITION, _home_position),
                (AUTOPILOT_VERSION, _autopilot_version),
            )
        }

    # -- what it hears ----------------------------------------------------------------------------------------------

    def decode(self, datagram: bytes) -> list[Event]:
        """The events in a datagram; damage and strangers are counted by kind."""
        frames, malformed = [datagram], False
        if not is_one_frame(datagram):
            frames, clean = frames_of(datagram)
            malformed = not clean
        events = []
        for frame in frames:
            begin = HEAD_2 if frame[0] == MARK_2 else HEAD_1
            key = frame[7:10] if begin == HEAD_2 else frame[5:6] + b"\0\0"
            reader = self._readers.get(key)
            if reader is None:
                self.not_read += 1  # most of a link's traffic: not even its checksum is looked at
                continue
            layout, read = reader
            end = begin + frame[1]
            if not checksum_fits(frame, end, layout.extra):
                malformed = True
                continue
            values = layout.unpack(frame[begin:end])
            source = frame[5:7] if begin == HEAD_2 else frame[3:5]
            if source != self._autopilot:
                self._foreign(source, layout, values)
                continue
            event = read(*values)
            if event is not None:
                events.append(event)
        if malformed:
            self.rejected["malformed"] += 1
        return events

    def _foreign(self, source: bytes, layout: Layout, values: Sequence[Any]) -> None:
        self.rejected["foreign system"] += 1
        if layout is HEARTBEAT and source[1] == AUTOPILOT_COMPONENT_ID and values[2] != NO_AUTOPILOT:
            self.foreign_system_id = source[0]
            self.foreign_heard += 1

    def _local_position(
        self, boot_ms: int, x: float, y: float, z: float, vx: float, vy: float, vz: float
    ) -> LocalPosition | None:
        most = PLAUSIBLE_MAX
        if (
            -most <= x <= most and -most <= y <= most and -most <= z <= most
            and -most <= vx <= most and -most <= vy <= most and -most <= vz <= most
        ):  # fmt: skip
            return LocalPosition(boot_ms, Ned(x, y, z), Ned(vx, vy, vz))
        self.rejected["out of range" if all(map(isfinite, (x, y, z, vx, vy, vz))) else "not finite"] += 1
        return None

    def _heartbeat(
        self, custom_mode: int, vehicle_type: int, autopilot: int, base_mode: int, _status: int, _version: int
    ) -> Heartbeat | None:
        if autopilot == NO_AUTOPILOT:
            # A camera or a ground station with the autopilot's ids: it would disarm the vehicle in our eyes.
            self.rejected["heartbeat of no autopilot"] += 1
            return None
        return Heartbeat(autopilot, vehicle_type, bool(base_mode & ARMED), custom_mode)

    def _global_origin(self, latitude: int, longitude: int, altitude: int) -> GlobalOrigin | None:
        unset = latitude == 0 and longitude == 0
        if unset or abs(latitude) > 900_000_000 or abs(longitude) > 1_800_000_000:
            self.rejected["out of range"] += 1
            return None
        return GlobalOrigin(Geodetic(latitude * 1e-7, longitude * 1e-7, altitude * 1e-3))

    def _parameter(self, raw: bytes, _count: int, _index: int, name: bytes, kind: int) -> ParameterValue | None:
        if kind not in (PARAMETER_INT32, PARAMETER_REAL32):
            return None  # `_HASH_CHECK`
        value = parameter_value(raw, kind)
        if not isfinite(value):
            self.rejected["not finite"] += 1
            return None
        return ParameterValue(_text(name), value)

    # -- what it says -----------------------------------------------------------------------------------------------

    def heartbeat(self) -> bytes:
        """HEARTBEAT of an onboard controller."""
        return self._pack(HEARTBEAT, 0, ONBOARD_CONTROLLER, NO_AUTOPILOT, 0, 4, 3)

    def setpoint(
        self, boot_ms: int, position_down_m: float, velocity_ned_m_s: Ned, acceleration_ne_m_s2: tuple[float, float],
        yaw_rad: float,
    ) -> bytes:  # fmt: skip
        """SET_POSITION_TARGET_LOCAL_NED (84) in the autopilot's local frame, mask 0x903."""
        v, (a_north, a_east) = velocity_ned_m_s, acceleration_ne_m_s2
        return self._pack(
            SET_POSITION_TARGET_LOCAL_NED,
            boot_ms & 0xFFFFFFFF, 0.0, 0.0, position_down_m, v.north, v.east, v.down, a_north, a_east, 0.0, yaw_rad,
            0.0, SETPOINT_TYPE_MASK, self.system_id, AUTOPILOT_COMPONENT_ID, LOCAL_NED,
        )  # fmt: skip

    def command(self, command: int, *parameters: float) -> bytes:
        """COMMAND_LONG (76); parameters left out are 0."""
        values = [*parameters, *([0.0] * (7 - len(parameters)))]
        return self._pack(COMMAND_LONG, *values, command, self.system_id, AUTOPILOT_COMPONENT_ID, 0)

    def set_up_signing(self, key: bytes, ticks: int) -> bytes:
        """SETUP_SIGNING: the autopilot is to sign by this key, and to believe nothing older than the time stamp."""
        return self._pack(SETUP_SIGNING, ticks, self.system_id, AUTOPILOT_COMPONENT_ID, key)

    def read_parameter(self, name: str) -> bytes:
        """PARAM_REQUEST_READ (20) by name."""
        return self._pack(PARAM_REQUEST_READ, -1, self.system_id, AUTOPILOT_COMPONENT_ID, name.encode())

    def time_request(self, now_ns: int) -> bytes:
        """TIMESYNC (111): the autopilot mirrors our time."""
        return self._pack(TIMESYNC, 0, now_ns)

    def _pack(self, layout: Layout, *values: float | bytes) -> bytes:
        frame = layout.pack(values, self._sequence, self.system_id, COMPANION_COMPONENT_ID)
        # Gaps in the sequence are how the other side counts losses.
        self._sequence = (self._sequence + 1) % 256
        return frame


def _landed_state(_vtol_state: int, landed_state: int) -> LandedState:
    return LandedState(landed_state)


def _estimator_status(_time_us: int, *fields: Any) -> EstimatorHealth:
    *_ratios, horizontal_m, _vertical_m, flags = fields
    # No estimate is exact: what is not above 0 was never filled in.
    return EstimatorHealth(flags, horizontal_m if 0.0 < horizontal_m < inf else inf)


def _system_status(_present: int, _enabled: int, health: int, *fields: int) -> SystemHealth:
    charge = fields[-1]
    return SystemHealth(health, charge if 0 <= charge <= 100 else -1)


def _parameter_error(_index: int, _system: int, component: int, name: bytes, error: int) -> ParameterError | None:
    ours = component in (0, COMPANION_COMPONENT_ID)
    return ParameterError(_text(name)) if ours and error else None


def _autopilot_version(
    _capabilities: int, _uid: int, flight_sw: int, _middleware: int, _os: int, _board: int, _vendor: int, _product: int,
    flight_custom: bytes,
) -> Software:  # fmt: skip
    return software(flight_sw, flight_custom)


def _text(name: bytes) -> str:
    return name.split(b"\0", 1)[0].decode("ascii", errors="replace")


def _command_answer(
    command: int, result: int, _progress: int, _result2: int, _system: int, component: int
) -> CommandAnswer | None:
    return CommandAnswer(command, result) if component in (0, COMPANION_COMPONENT_ID) else None


def _time_answer(answered_ns: int, asked_ns: int) -> TimeAnswer | None:
    return TimeAnswer(asked_ns) if answered_ns != 0 else None


def _system_time(unix_us: int, _boot_ms: int) -> SystemTime | None:
    return SystemTime(unix_us) if unix_us > UTC_KNOWN_US else None


def _home_position(_latitude: int, _longitude: int, altitude_mm: int) -> HomePosition:
    return HomePosition(altitude_mm * 1e-3)
