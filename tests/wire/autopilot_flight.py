"""Drives one stand-in autopilot in virtual time, as a companion would: sends messages, keeps the answers."""

import math
import os
from collections.abc import Callable, Iterator
from typing import Any

os.environ["MAVLINK20"] = "1"
from pymavlink.dialects.v20 import development as mavlink

from companion.core.frames import Geodetic, Ned
from companion.vehicle.autopilot.px4_versions import OLDEST
from sim.autopilot.autopilot import Autopilot
from sim.autopilot.disturbances import GustParameters, NoiseParameters
from sim.autopilot.dynamics_parameters import DynamicsParameters
from sim.autopilot.modes import Mode

ORIGIN = Geodetic(47.3977415, 8.5455929, 489.69)
"""the recorded vehicle's own origin"""
HERE = Ned(0.0, 0.0, 0.0)
UTC_OFFSET_NS = 1_795_300_524_000_000_000
SECOND_NS = 1_000_000_000
CALM = GustParameters(sigma_m_s2=0.0)
EXACT = NoiseParameters(position_sigma_m=0.0, velocity_sigma_m_s=0.0)
COMPANION_COMPONENT = 191
WATCHED = (
    mavlink.MAVLINK_MSG_ID_HEARTBEAT,
    mavlink.MAVLINK_MSG_ID_CURRENT_MODE,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS,
)
VELOCITY_AND_YAW = 0x9C7
VELOCITY_ACCELERATION_AND_YAW = 0x807
VELOCITY = 0xDC7
POSITION_AND_YAW = 0x9F8
ACCELERATION_AND_YAW = 0x83F


class Flight:
    """One autopilot and the clock it lives by. Boot is at `boot_s`; times are seconds of the host's clock."""

    def __init__(
        self,
        *,
        parameters: dict[str, float | int] | None = None,
        dynamics: DynamicsParameters | None = None,
        gust: GustParameters = CALM,
        noise: NoiseParameters = EXACT,
        home_ned_m: Ned = HERE,
        ekf_origin_offset_m: Ned = HERE,
        boot_s: float = 0.0,
        seed: int = 1,
        quiet: bool = True,
        px4: str = OLDEST.name,
        signing_key: bytes | None = None,
    ) -> None:
        self.boot_s = boot_s
        self.now_ns = round(boot_s * SECOND_NS)
        self.autopilot = Autopilot(
            system_id=1,
            boot_ns=self.now_ns,
            utc_offset_ns=UTC_OFFSET_NS,
            fleet_origin=ORIGIN,
            home_ned_m=home_ned_m,
            ekf_origin_offset_m=ekf_origin_offset_m,
            dynamics=dynamics,
            gust=gust,
            noise=noise,
            parameters=parameters,
            px4=px4,
            signing_key=signing_key,
            seed=seed,
        )
        self.received: list[tuple[float, Any]] = []
        """time (s) and message, in order of arrival"""
        self.datagrams: list[bytes] = []
        self._sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=COMPANION_COMPONENT)
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        if quiet:
            for message_id in list(mavlink.mavlink_map):
                if message_id not in WATCHED:
                    self.autopilot.set_interval_us(message_id, -1.0)

    @property
    def now_s(self) -> float:
        return self.now_ns / SECOND_NS

    def run(self, seconds: float) -> None:
        """Lets time pass."""
        self.run_until(self.now_s + seconds)

    def run_until(self, time_s: float) -> None:
        end_ns = round(time_s * SECOND_NS)
        while (deadline_ns := self.autopilot.next_deadline_ns()) <= end_ns:
            self.now_ns = max(deadline_ns, self.now_ns)
            self._take(self.autopilot.advance(self.now_ns))
        self.now_ns = end_ns
        self._take(self.autopilot.advance(end_ns))

    def run_while(self, condition: Callable[[], bool], at_most_s: float) -> None:
        """Lets time pass in steps of 20 ms while the condition holds; fails when it still does at the end."""
        end_s = self.now_s + at_most_s
        while condition():
            assert self.now_s < end_s, f"still so after {at_most_s} s"
            self.run(0.02)

    def _take(self, datagrams: list[bytes]) -> None:
        for datagram in datagrams:
            self.datagrams.append(datagram)
            messages = self._parser.parse_buffer(datagram)
            assert messages is not None
            assert len(messages) == 1, "one message a datagram"
            self.received.append((self.now_s, messages[0]))

    def send(self, message: Any, *, system: int = 1, component: int = COMPANION_COMPONENT) -> None:
        self._sender.srcSystem, self._sender.srcComponent = system, component
        self.autopilot.receive(message.pack(self._sender), self.now_ns)

    def of(self, name: str, since_s: float = 0.0) -> list[Any]:
        """Messages of a type that arrived since then."""
        return [message for time_s, message in self.received if time_s >= since_s and message.get_type() == name]

    def last(self, name: str) -> Any:
        return self.of(name)[-1]

    # Commands

    def command(self, command: int, *params: float, target: tuple[int, int] = (1, 1)) -> int | None:
        """COMMAND_LONG; the result of its acknowledgement, None when there is none within 20 ms."""
        values = [*params, *([0.0] * (7 - len(params)))]
        self.send(mavlink.MAVLink_command_long_message(*target, command, 0, *values))
        begun_s = self.now_s
        self.run(0.02)
        answers = [answer for answer in self.of("COMMAND_ACK", begun_s) if answer.command == command]
        if not answers:
            return None
        assert len(answers) == 1
        assert (answers[0].target_system, answers[0].target_component) == (1, COMPANION_COMPONENT)
        return int(answers[0].result)

    def arm(self, *, force: bool = False) -> int | None:
        return self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1, 21196 if force else 0)

    def disarm(self, *, force: bool = False) -> int | None:
        return self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 21196 if force else 0)

    def set_mode(self, mode: Mode) -> int | None:
        main, sub = mode.value
        return self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, main, sub)

    # Flight

    def take_off(self, height_m: float = 5.0) -> None:
        """From boot to hovering in LOITER."""
        self.run_until(max(self.now_s, self.boot_s + 4.2))
        assert self.arm() == 0
        altitude = self.autopilot.telemetry.altitude_amsl_m + height_m
        assert self.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, math.nan, 0, 0, altitude) == 0
        self.run_while(lambda: self.mode is Mode.TAKEOFF, 30.0)
        self.run(3.0)

    def setpoint(self, mask: int = VELOCITY_AND_YAW, frame: int = mavlink.MAV_FRAME_LOCAL_NED, **fields: float) -> Any:
        """SET_POSITION_TARGET_LOCAL_NED with the fields given, zero the others."""
        names = ("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate")
        return mavlink.MAVLink_set_position_target_local_ned_message(
            0, 1, 1, frame, mask, *(fields.get(name, 0.0) for name in names)
        )

    def stream(self, message: Any, seconds: float, rate_hz: float = 50.0) -> None:
        """Sends one set-point again and again; the last one at the end."""
        for _ in self.ticks(seconds, rate_hz):
            self.send(message)

    def ticks(self, seconds: float, rate_hz: float = 50.0) -> Iterator[float]:
        begin_s = self.now_s
        count = round(seconds * rate_hz)
        for tick in range(count):
            yield tick / rate_hz
            self.run_until(begin_s + (tick + 1) / rate_hz)

    def go_offboard(self, message: Any | None = None) -> None:
        """Into OFFBOARD with half a second of set-points before it."""
        message = message if message is not None else self.setpoint()
        self.stream(message, 0.5)
        self.send(message)
        assert self.set_mode(Mode.OFFBOARD) == 0
        self.send(message)

    @property
    def mode(self) -> Mode:
        return self.autopilot.commander.mode

    @property
    def armed(self) -> bool:
        return self.autopilot.truth().armed

    @property
    def position(self) -> Ned:
        return self.autopilot.truth().position_ned_m

    @property
    def velocity(self) -> Ned:
        return self.autopilot.truth().velocity_ned_m_s
