"""Real PX4 SITL instances (SIH quadrotor, headless) in the place of stubs: started, parametrised, watched, ended.

PX4 takes instance numbers: instance i has system id i + 1 and speaks to UDP 14540 + i; past ten it would send all to
14549, so those get another MAVLink link in its place by the port rule of `companion.config.endpoints`. The simulator's
truth comes as HIL_STATE_QUATERNION on 19410 + i, the state of arming and mode over a link that each instance is told to
open. The ground station's port, 14550, is left to a ground station.
"""

import os
import select
import signal
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from math import hypot
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import development as mavlink

from companion.config import FleetConfig
from companion.core.frames import Geodetic, geodetic_to_ned
from companion.errors import CompanionError
from companion.io.link import received_unix_ns
from companion.wire.mavlink_frames import HEAD_2
from companion.wire.px4 import parameter_value
from sim.autopilot.stubs import TRUTH_DTYPE
from sim.launch.ended import tell_ended
from sim.launch.sitl_faults import answer_orders
from sim.launch.sitl_vehicle import CURRENT_MODE, SitlVehicle, bind

STARTUP_TIMEOUT_S = 30.0
FLUSH_INTERVAL_NS = 500_000_000
ROUND_S = 0.5
"""between two requests for what has not come"""
STATE_MESSAGES = frozenset({0, 22, 30, 77, 245, CURRENT_MODE})
"""HEARTBEAT, PARAM_VALUE, ATTITUDE, COMMAND_ACK, EXTENDED_SYS_STATE and CURRENT_MODE"""
TRUTH_MESSAGES = frozenset({115})
"""HIL_STATE_QUATERNION"""


@dataclass(frozen=True, slots=True)
class SitlSettings:
    """How to run the instances."""

    build: Path
    """PX4's build folder: holds bin/px4 and etc/"""
    folder: Path
    """where each instance gets its own working folder"""
    truth_path: Path
    stop_fd: int
    parameters: Mapping[str, float | int]
    """beyond what `px4_build` has for a fleet on this build, or instead of one of them"""
    logs: bool = False
    """whether the instances write their logs (ULog)"""
    relayed: frozenset[int] = frozenset()
    """vehicles whose link can be cut"""
    ready_path: Path | None = None
    """a file that is made once every parameter was read back as set"""
    log: Callable[[str], None] = print


class SitlHost:
    """Runs the instances until its standard input ends, recording the simulators' truth."""

    def __init__(self, config: FleetConfig, settings: SitlSettings) -> None:
        self.config = config
        self.settings = settings
        self._stack = ExitStack()
        self._mav: Any = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self._mav.robust_parsing = True
        self._flushed_ns = 0
        self._next_round_s = 0.0
        try:
            self._states = bind(0, "the instances' state")
            self._stack.callback(self._states.close)
            self._states_port: int = self._states.getsockname()[1]
            self._file = self._stack.enter_context(settings.truth_path.open("ab"))
            self.instances: list[SitlVehicle] = []
            for vehicle in config.vehicles:
                instance = SitlVehicle(
                    config, vehicle, settings.build, settings.folder, settings.parameters, self._send,
                    logs=settings.logs, relayed=vehicle.id in settings.relayed,
                )  # fmt: skip
                self._stack.callback(instance.close)
                self.instances.append(instance)
        except BaseException:
            self._stack.close()
            raise
        self._by_system = {i.vehicle.system_id: i for i in self.instances}

    def run(self, grace_s: float) -> None:
        """Serve until the launcher is gone or says so; then leave the vehicles `grace_s` for their landing commands."""
        ended: list[bool] = []
        for s in (signal.SIGTERM, signal.SIGINT):
            signal.signal(s, lambda *_: ended.append(True))
        with self._stack:
            if not self._bring_up(ended):
                return
            if self.settings.ready_path is not None:
                self.settings.ready_path.touch()
            until: float | None = None
            stop_fds = [self.settings.stop_fd]
            while until is None or time.monotonic() < until:
                if self._serve(0.1, stop_fds) or ended:
                    ended.clear()
                    stop_fds = []
                    until = time.monotonic() + (grace_s if until is None else 0.0)
                self._tell_missing()
                self._serve_faults()
            for instance in self.instances:
                instance.px4.ask_to_end()
                factor = instance.ran_at()
                if factor is not None:
                    self.settings.log(f"vehicle {instance.vehicle.id}: simulated at {factor:.3f} of real time")

    def _tell_missing(self) -> None:
        """An instance that has ended in flight is told once; the others fly on."""
        for instance in self.instances:
            if not instance.missed and (status := instance.px4.process.poll()) is not None:
                instance.missed = True
                self.settings.log(f"vehicle {instance.vehicle.id}: PX4 ended with status {status}; see its px4.log")
                tell_ended(self.settings.folder, instance.vehicle.id, f"PX4 ended with status {status}")

    def _serve(self, timeout_s: float, stop_fds: Sequence[int]) -> bool:
        sockets: list[Any] = [self._states, *(s for i in self.instances for s in i.sockets)]
        ready, _, _ = select.select([*sockets, *stop_fds], [], [], timeout_s)
        if self._states in ready:
            self._read_states()
        for instance in self.instances:
            if instance.truth_socket in ready:
                self._read_truth(instance)
            instance.serve_relay(ready)
            if instance.orders in ready:
                answer_orders(instance.orders, instance.faults, time.monotonic())
        return any(fd in ready and not os.read(fd, 4096) for fd in stop_fds)

    def _messages(self, s: socket.socket, wanted: frozenset[int]) -> Iterator[tuple[int, Any]]:
        """What waits of those kinds, with the time at which the kernel got it (UTC, ns): this process may be late.

        The others, most of the traffic, are told by their heads at a hundredth of a decoding's cost.
        """
        while True:
            try:
                data, ancillary, _, _ = s.recvmsg(2048, 64)
            except BlockingIOError:
                return
            except ConnectionError:
                continue
            if len(data) > 9 and data[7] | data[8] << 8 | data[9] << 16 in wanted:
                for message in self._mav.parse_buffer(data) or []:
                    yield received_unix_ns(ancillary), message

    def _read_states(self) -> None:
        for time_unix_ns, message in self._messages(self._states, STATE_MESSAGES):
            instance = self._by_system.get(message.get_srcSystem())
            if instance is None or message.get_srcComponent() != 1:
                continue
            match message:
                case mavlink.MAVLink_heartbeat_message():
                    instance.armed = bool(message.base_mode & 128)
                    if not instance.mode_streamed:
                        instance.custom_mode = message.custom_mode
                case mavlink.MAVLink_current_mode_message():
                    instance.custom_mode = message.custom_mode
                case mavlink.MAVLink_command_ack_message():
                    instance.mode_streamed |= message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
                case mavlink.MAVLink_attitude_message():
                    instance.clock[1:] = [(time_unix_ns * 1e-9, message.time_boot_ms * 1e-3)]
                case mavlink.MAVLink_extended_sys_state_message():
                    instance.landed_state = message.landed_state
                case mavlink.MAVLink_param_value_message():
                    instance.checked[message.param_id.rstrip("\x00")] = told_value(message)

    def _read_truth(self, instance: SitlVehicle) -> None:
        rows = []
        for time_unix_ns, message in self._messages(instance.truth_socket, TRUTH_MESSAGES):
            if isinstance(message, mavlink.MAVLink_hil_state_quaternion_message):
                point = Geodetic(message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3)
                row = np.zeros((), TRUTH_DTYPE)
                row["time_unix_ns"] = time_unix_ns
                row["vehicle_id"] = instance.vehicle.id
                row["armed"], row["landed_state"] = instance.armed, instance.landed_state
                row["custom_mode"] = instance.custom_mode
                row["position_ned_m"] = geodetic_to_ned(point, self.config.origin)
                row["velocity_ned_m_s"] = (message.vx * 1e-2, message.vy * 1e-2, message.vz * 1e-2)
                row["setpoint_gap_max_s"] = np.nan
                row["attitude_rate_rad_s"] = hypot(message.rollspeed, message.pitchspeed)
                rows.append(row.tobytes())
        self._file.write(b"".join(rows))
        now_ns = time.monotonic_ns()
        if now_ns - self._flushed_ns > FLUSH_INTERVAL_NS:
            self._flushed_ns = now_ns
            self._file.flush()

    def _serve_faults(self) -> None:
        """End those whose time is over, and bring up whoever has booted anew."""
        now_s = time.monotonic()
        for instance in self.instances:
            instance.faults.end_due(now_s)
        if now_s >= self._next_round_s:
            self._next_round_s = now_s + ROUND_S
            for instance in self.instances:
                if not instance.up and not instance.missed:
                    instance.bring_up(self._states_port)

    def _bring_up(self, ended: Sequence[bool]) -> bool:
        """Wait until every parameter set at the start has arrived, and for CURRENT_MODE at a rate worth recording.

        False when ended meanwhile; CompanionError names vehicle and parameter that did not arrive.
        """
        deadline = time.monotonic() + STARTUP_TIMEOUT_S
        while time.monotonic() < deadline:
            waiting = [i for i in self.instances if not i.up]
            if not waiting:
                return True
            for instance in waiting:
                if instance.px4.process.poll() is not None:
                    raise CompanionError(f"vehicle {instance.vehicle.id}: {instance.px4.last_words()}")
                instance.bring_up(self._states_port)
            until = time.monotonic() + ROUND_S
            while time.monotonic() < until:
                if self._serve(0.1, [self.settings.stop_fd]) or ended:
                    return False
        missing = {i.vehicle.id: i.not_as_set for i in self.instances if i.not_as_set}
        raise CompanionError(f"PX4 parameters not as set after {STARTUP_TIMEOUT_S:.0f} s: {missing or 'silent'}")

    def _send(self, message: Any, port: int) -> None:
        self._states.sendto(message.pack(self._mav), ("127.0.0.1", port))


def told_value(message: Any) -> float | int:
    """Value of a PARAM_VALUE by its frame's bytes: as a float, an integer that is a signalling NaN's loses a bit."""
    return parameter_value(bytes(message.get_msgbuf()[HEAD_2 : HEAD_2 + 4]), message.param_type)
