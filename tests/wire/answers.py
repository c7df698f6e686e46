"""What PX4 answers to commands, as one table for the stand-in and for the real one, of every version."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from autopilot_flight import mavlink

from companion.vehicle.autopilot.px4_versions import OLDEST, Px4Version
from sim.autopilot.modes import Mode

ACCEPTED, REJECTED, DENIED, UNSUPPORTED, FAILED = 0, 1, 2, 3, 4
NOBODY = None
NAN = math.nan
HEARTBEAT_S = 1.2
"""arming shows with the next heartbeat"""
DROP = 21196
"""MAV_CMD_COMPONENT_ARM_DISARM's second parameter: at once, in the air too"""


class Flyer(Protocol):
    """One autopilot under test, virtual or real (`autopilot_flight.Flight`)."""

    @property
    def mode(self) -> Mode: ...

    @property
    def armed(self) -> bool: ...

    def run(self, seconds: float) -> None: ...

    def run_while(self, condition: Callable[[], bool], at_most_s: float) -> None: ...

    def command(self, command: int, *params: float, target: tuple[int, int] = (1, 1)) -> int | None: ...

    def arm(self, *, force: bool = False) -> int | None: ...

    def disarm(self, *, force: bool = False) -> int | None: ...

    def set_mode(self, mode: Mode) -> int | None: ...

    def take_off(self) -> None: ...

    def setpoint(self) -> Any: ...

    def stream(self, message: Any, seconds: float) -> None: ...

    def go_offboard(self) -> None: ...


@dataclass(frozen=True, slots=True)
class Answer:
    """A command, in which state it comes, and what follows."""

    when: str
    """landed, armed, flying (in LOITER) or offboard; "landed, offboard": mode OFFBOARD without a stream"""
    what: str
    command: int
    params: tuple[float, ...]
    result: int | None
    """MAV_RESULT; None: no answer"""
    mode: Mode | None = None
    """afterwards; None: as before"""
    armed: bool | None = None
    """afterwards; None: as before"""
    target: tuple[int, int] = (1, 1)
    strict: int | None = None
    """where versions with `strict_commands` answer otherwise"""
    strict_armed: bool | None = None
    """likewise"""


def _mode(mode: Mode) -> tuple[float, ...]:
    main, sub = mode.value
    return (1.0, float(main), float(sub))


ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
SET_MODE = mavlink.MAV_CMD_DO_SET_MODE
TAKE_OFF = (0, 0, 0, NAN, NAN, NAN, NAN)
MANUAL_MODES = (Mode.POSCTL, Mode.ALTCTL, Mode.STABILIZED, Mode.MANUAL, Mode.ACRO)
ON_THE_GROUND = (
    Answer("landed", "disarm when disarmed", ARM, (0,), ACCEPTED),
    Answer("landed", "arm", ARM, (1,), ACCEPTED, armed=True),
    Answer("armed", "arm when armed", ARM, (1,), ACCEPTED),
    Answer("landed, offboard", "arm in OFFBOARD without a stream", ARM, (1,), REJECTED),
    Answer("landed", "OFFBOARD without a stream", SET_MODE, _mode(Mode.OFFBOARD), ACCEPTED, Mode.OFFBOARD),
    Answer("landed", "take-off", mavlink.MAV_CMD_NAV_TAKEOFF, TAKE_OFF, ACCEPTED, Mode.TAKEOFF),
    Answer("landed", "land", mavlink.MAV_CMD_NAV_LAND, TAKE_OFF, ACCEPTED, Mode.LAND),
    Answer("landed", "return", mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH, (), ACCEPTED, Mode.RTL),
    *(Answer("landed", f"{m.name} without a pilot", SET_MODE, _mode(m), ACCEPTED, m) for m in MANUAL_MODES),
    Answer("landed", "an unknown command", 31999, (), UNSUPPORTED),
    Answer("landed", "request of a message that is not available", mavlink.MAV_CMD_REQUEST_MESSAGE,
           (mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION,), DENIED),
    Answer("landed", "request of GPS_GLOBAL_ORIGIN", mavlink.MAV_CMD_REQUEST_MESSAGE,
           (mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,), ACCEPTED),
    Answer("landed", "interval of a message", mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
           (mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 20_000), ACCEPTED),
    Answer("landed", "interval of a message that SITL does not have", mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
           (mavlink.MAVLINK_MSG_ID_UTM_GLOBAL_POSITION, -1), FAILED),
    Answer("landed", "interval of an unknown message", mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, (9999, 20_000), FAILED),
    Answer("landed", "arm, to another system", ARM, (1,), NOBODY, target=(2, 1)),
    Answer("landed", "arm, to another component", ARM, (1,), NOBODY, target=(1, 2)),
    Answer("landed", "arm, to any component", ARM, (1,), ACCEPTED, armed=True, target=(1, 0)),
    Answer("landed", "an unknown main mode", SET_MODE, (1, 77, 0), ACCEPTED, strict=REJECTED),
    Answer("landed", "a mode without the custom flag", SET_MODE, (0, 6, 0), ACCEPTED, strict=REJECTED),
    Answer("landed", "arm with a third parameter", ARM, (1, 0, 1), ACCEPTED, armed=True, strict=DENIED,
           strict_armed=False),
    Answer("landed", "a mode with a fourth parameter", SET_MODE, (*_mode(Mode.LOITER), 1), ACCEPTED, strict=DENIED),
    Answer("landed", "return with a parameter", mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH, (1,), ACCEPTED, Mode.RTL,
           strict=DENIED),
    *(Answer("landed", f"{name} by a command of its own", command, (1,), ACCEPTED, strict=UNSUPPORTED)
      for name, command in (("HOME_POSITION", mavlink.MAV_CMD_GET_HOME_POSITION),
                            ("PROTOCOL_VERSION", mavlink.MAV_CMD_REQUEST_PROTOCOL_VERSION),
                            ("AUTOPILOT_VERSION", mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES))),
    Answer("landed", "arm, to any system", ARM, (1,), NOBODY, target=(0, 1), strict=ACCEPTED, strict_armed=True),
    Answer("armed", "disarm", ARM, (0,), ACCEPTED, armed=False),
)  # fmt: skip
IN_THE_AIR = (
    Answer("flying", "disarm in flight", ARM, (0,), REJECTED),
    *(Answer("flying", f"{m.name} without a pilot", SET_MODE, _mode(m), REJECTED) for m in MANUAL_MODES),
    Answer("flying", "MISSION without a mission", SET_MODE, _mode(Mode.MISSION), REJECTED),
    Answer("flying", "an unknown AUTO sub-mode", SET_MODE, (1, 4, 99), REJECTED),
    Answer("flying", "an unknown main mode", SET_MODE, (1, 77, 0), ACCEPTED, strict=REJECTED),
    Answer("flying", "a mode without the custom flag", SET_MODE, (0, 6, 0), ACCEPTED,
           strict=REJECTED),
    Answer("flying", "OFFBOARD without a stream", SET_MODE, _mode(Mode.OFFBOARD), REJECTED),
    Answer("offboard", "reposition", mavlink.MAV_CMD_DO_REPOSITION, (-1, 1, 0, NAN, NAN, NAN, NAN), ACCEPTED,
           Mode.LOITER),
    Answer("flying", "forced disarm", ARM, (0, DROP), ACCEPTED, armed=False),
)  # fmt: skip


def prepare(flyer: Flyer, when: str) -> None:
    """Bring it into that state: on the ground one after the other, then in the air."""
    match when:
        case "landed" | "landed, offboard" | "armed":
            if flyer.armed:
                assert flyer.disarm() == ACCEPTED
            mode = Mode.OFFBOARD if when == "landed, offboard" else Mode.LOITER
            if flyer.mode is not mode:
                assert flyer.set_mode(mode) == ACCEPTED
            if when == "armed":
                assert flyer.arm() == ACCEPTED
        case "flying" | "offboard":
            if not flyer.armed:
                flyer.take_off()
            elif flyer.mode is not Mode.LOITER:
                assert flyer.set_mode(Mode.LOITER) == ACCEPTED
            if when == "offboard":
                flyer.go_offboard()
    flyer.run(0.3)


def mismatches(flyer: Flyer, row: Answer, version: Px4Version = OLDEST) -> list[str]:
    """What is otherwise than the table says of that version."""
    prepare(flyer, row.when)
    before = (flyer.mode, flyer.armed)
    result = flyer.command(row.command, *row.params, target=row.target)
    strict = version.strict_commands and row.strict is not None
    armed = row.strict_armed if strict else row.armed
    mode = None if strict else row.mode
    expected = (before[0] if mode is None else mode, before[1] if armed is None else armed)
    flyer.run(HEARTBEAT_S)
    found = (flyer.mode, flyer.armed)
    where = f"{row.when}: {row.what}"
    wrong = []
    promised = row.strict if strict else row.result
    if result != promised:
        wrong.append(f"{where}: result {result}, expected {promised}")
    if found != expected:
        wrong.append(f"{where}: afterwards {found}, expected {expected}")
    return wrong
