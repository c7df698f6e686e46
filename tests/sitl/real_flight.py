"""Drives one real PX4 over its offboard link, as `autopilot_flight.Flight` drives the stand-in."""

import math
import select
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from autopilot_flight import COMPANION_COMPONENT, VELOCITY_AND_YAW, mavlink

from companion.core.frames import Geodetic
from sim.autopilot.modes import MODE_OF_CUSTOM, Mode
from sim.launch.px4_instance import Px4Instance

HOME = Geodetic(47.397742, 8.545594, 488.0)
COMPANION_PORT, AUTOPILOT_PORT = 14540, 14580
STANDBY, ARMED_FLAG = 3, 128
ANSWER_S = 1.0
"""PX4 answers within 20 ms; the rest is for a machine that does something else"""
ON_GROUND = 1


class RealFlight:
    """Instance 0, alone."""

    def __init__(self, build: Path, folder: Path, parameters: dict[str, float | int]) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", COMPANION_PORT))
        self._socket.setblocking(False)
        self.instance = Px4Instance(0, HOME, build, folder, parameters)
        self.received: list[tuple[float, Any]] = []
        self.custom_mode = 0
        self.armed = False
        self.status = 0
        self.landed_state = 0
        self._sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=COMPANION_COMPONENT)
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True

    def close(self) -> None:
        self.instance.end()
        self._socket.close()

    def boot(self) -> None:
        """Until it may be armed; in OFFBOARD without any setpoint since boot newer PX4's simulation stands still."""
        self.run_while(lambda: self.status != STANDBY, 60.0)
        self.stream(self.setpoint(), 1.0)
        self.stream_at(mavlink.MAVLINK_MSG_ID_CURRENT_MODE, 20.0)
        self.run_while(lambda: self.arm() != 0, 60.0)
        assert self.disarm() == 0

    def run(self, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            if select.select([self._socket], [], [], left_s)[0]:
                for message in self._parser.parse_buffer(self._socket.recv(2048)) or []:
                    self._take(message)

    def run_while(self, condition: Callable[[], bool], at_most_s: float) -> None:
        end_s = time.monotonic() + at_most_s
        while condition():
            assert time.monotonic() < end_s, f"still so after {at_most_s} s"
            self.run(0.05)

    def _take(self, message: Any) -> None:
        self.received.append((time.monotonic(), message))
        match message:
            case mavlink.MAVLink_heartbeat_message():
                self.armed = bool(message.base_mode & ARMED_FLAG)
                self.status = message.system_status
                self.custom_mode = message.custom_mode
            case mavlink.MAVLink_current_mode_message():
                self.custom_mode = message.custom_mode
            case mavlink.MAVLink_extended_sys_state_message():
                self.landed_state = message.landed_state

    def send(self, message: Any) -> None:
        self._socket.sendto(message.pack(self._sender), ("127.0.0.1", AUTOPILOT_PORT))
        self._sender.seq = (self._sender.seq + 1) % 256

    def command(self, command: int, *params: float, target: tuple[int, int] = (1, 1)) -> int | None:
        """COMMAND_LONG; the result of its acknowledgement, None when there is none."""
        values = [*params, *([0.0] * (7 - len(params)))]
        seen = len(self.received)
        self.send(mavlink.MAVLink_command_long_message(*target, command, 0, *values))
        end_s = time.monotonic() + ANSWER_S
        while time.monotonic() < end_s:
            self.run(0.02)
            for _, message in self.received[seen:]:
                if message.get_type() == "COMMAND_ACK" and message.command == command:
                    assert (message.target_system, message.target_component) == (1, COMPANION_COMPONENT)
                    return int(message.result)
        return None

    def version(self) -> tuple[int, int]:
        """PX4's, as it tells it."""
        seen = len(self.received)
        assert self.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION) == 0
        self.run(0.5)
        (told,) = (m for _, m in self.received[seen:] if m.get_type() == "AUTOPILOT_VERSION")
        return told.flight_sw_version >> 24, told.flight_sw_version >> 16 & 0xFF

    def stream_at(self, message_id: int, rate_hz: float) -> None:
        assert self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, 1e6 / rate_hz) == 0

    def _armed_is(self, wanted: bool) -> None:
        """The heartbeat tells it, once a second."""
        end_s = time.monotonic() + 2.5
        while self.armed != wanted and time.monotonic() < end_s:
            self.run(0.05)

    def arm(self, *, force: bool = False) -> int | None:
        result = self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1, 21196 if force else 0)
        if result == 0:
            self._armed_is(True)
        return result

    def disarm(self, *, force: bool = False) -> int | None:
        result = self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 21196 if force else 0)
        if result == 0:
            self._armed_is(False)
        return result

    def set_mode(self, mode: Mode) -> int | None:
        main, sub = mode.value
        return self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, main, sub)

    def take_off(self) -> None:
        """From the ground to hovering in LOITER."""
        assert self.arm() == 0
        height = HOME.altitude_amsl_m + 5.0
        assert self.command(mavlink.MAV_CMD_NAV_TAKEOFF, math.nan, 0, 0, math.nan, math.nan, math.nan, height) == 0
        self.run_while(lambda: self.mode is not Mode.TAKEOFF, 5.0)
        self.run_while(lambda: self.mode is Mode.TAKEOFF, 40.0)
        self.run(3.0)

    def setpoint(self) -> Any:
        """Zero velocity, heading north."""
        return mavlink.MAVLink_set_position_target_local_ned_message(
            0, 1, 1, mavlink.MAV_FRAME_LOCAL_NED, VELOCITY_AND_YAW, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0
        )

    def stream(self, message: Any, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            self.send(message)
            self.run(0.02)

    def go_offboard(self) -> None:
        self.stream(self.setpoint(), 0.5)
        assert self.set_mode(Mode.OFFBOARD) == 0
        self.stream(self.setpoint(), 0.2)

    @property
    def mode(self) -> Mode:
        """Sub-modes that the table does not name (AUTO.READY on the ground) count as LOITER."""
        return MODE_OF_CUSTOM.get(self.custom_mode, Mode.LOITER)
