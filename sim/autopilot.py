"""A stand-in for one PX4: datagrams in, datagrams out, no I/O. The same class serves processes and lockstep.

Time is an argument, in the host's monotonic nanoseconds; inside it is nanoseconds since boot on a fixed grid of 4 ms,
PX4's own simulation step. The same seed and the same calls give the same bytes.
"""

import math
import os
import random
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

os.environ["MAVLINK20"] = "1"
from pymavlink.dialects.v20 import development as mavlink

from companion.core.frames import Geodetic, Ned, ned_to_geodetic
from sim.dynamics import (
    HOLD_STILL,
    NAN,
    DynamicsParameters,
    GustParameters,
    LoopGains,
    NoiseParameters,
    OrnsteinUhlenbeck,
    Setpoint,
    Vehicle,
)
from sim.px4_commander import HOME_SET_NS, Commander, Result
from sim.px4_commands import CommandRequest, answer, set_mode
from sim.px4_modes import LandedState, Mode
from sim.px4_navigator import Navigator
from sim.px4_parameters import HASH_INDEX, HASH_NAME, TYPE_UINT32, ParameterTable
from sim.px4_streams import ON_REQUEST, STREAMS, Telemetry

STEP_NS = 4_000_000
"""grid of the dynamics and of everything that is sent, ns"""
STEP_S = STEP_NS / 1e9
ESTIMATE_STEPS = 2
"""the estimator publishes every so many steps: 125 Hz, as PX4's does"""
FIRST_MESSAGE_NS = 1_600_000_000
"""first HEARTBEAT after boot, as measured"""
ORIGIN_SENT_NS = 1_800_000_000
"""GPS_GLOBAL_ORIGIN comes by itself once, this long after boot"""
COMPONENT_ID = 1
BATTERY_DRAIN_PER_S = 1.0 / 60.0
"""while armed; down to half, and full again when disarmed, as recorded"""
BATTERY_LOWEST_FRACTION = 0.5
PARAMETERS_PER_STEP = 1
"""PARAM_REQUEST_LIST is answered at this pace"""
FORCE_BIT = 1 << 9
NO_OFFSET = Ned(0.0, 0.0, 0.0)
MAVLINK_FTP_NAK = 129
MAVLINK_FTP_UNKNOWN_COMMAND = 7


@dataclass(frozen=True, slots=True)
class TruthState:
    """What is true of the vehicle, whatever its estimator says."""

    time_ns: int
    """host's monotonic time of this state, on the grid, ns"""
    position_ned_m: Ned
    """fleet frame"""
    velocity_ned_m_s: Ned
    acceleration_ned_m_s2: Ned
    yaw_rad: float
    armed: bool
    custom_mode: int
    landed_state: int
    setpoint_gap_max_s: float
    """longest time without a valid set-point while OFFBOARD flew"""
    setpoint_count: int
    """valid offboard set-points since boot"""
    setpoint_last_ns: int | None
    """host's monotonic time of the last one"""


class Autopilot:
    """One vehicle: dynamics, estimator, commander, MAVLink."""

    def __init__(
        self,
        *,
        system_id: int,
        boot_ns: int,
        utc_offset_ns: int,
        fleet_origin: Geodetic,
        home_ned_m: Ned,
        ekf_origin_offset_m: Ned = NO_OFFSET,
        dynamics: DynamicsParameters | None = None,
        gust: GustParameters | None = None,
        noise: NoiseParameters | None = None,
        parameters: Mapping[str, float | int] | None = None,
        yaw_rad: float = 0.0,
        seed: int = 0,
    ) -> None:
        """`boot_ns`: host's monotonic time of boot; UTC is monotonic + `utc_offset_ns`; `home_ned_m`: true start.

        The estimator's origin lies at `home_ned_m` + `ekf_origin_offset_m` (fleet frame); position reports are relative
        to it.
        """
        if not 1 <= system_id <= 255:
            raise ValueError(f"system_id must be 1..255, got {system_id}")
        self._dynamics = dynamics if dynamics is not None else DynamicsParameters()
        self._gust_parameters = gust if gust is not None else GustParameters()
        self._noise = noise if noise is not None else NoiseParameters()
        self._boot_ns = boot_ns
        self._utc_offset_ns = utc_offset_ns
        self._fleet_origin = fleet_origin
        self._random = random.Random(f"{seed}/{system_id}")
        self.parameters = ParameterTable({**(parameters or {}), "MAV_SYS_ID": system_id})
        self._origin_ned_m = Ned(*(a + b for a, b in zip(home_ned_m, ekf_origin_offset_m, strict=True)))
        start = Ned(*(-offset for offset in ekf_origin_offset_m))
        self.vehicle = Vehicle(start.north, start.east, start.down, self._dynamics, LoopGains(), yaw_rad)
        self._start()

    def _start(self) -> None:
        """Everything that a boot sets up; the vehicle itself stays where it is."""
        rng = self._random
        noise, gust = self._noise, self._gust_parameters
        estimate_s = STEP_S * ESTIMATE_STEPS
        self._gust = OrnsteinUhlenbeck(gust.sigma_m_s2, gust.time_constant_s, STEP_S, rng, gust.bound_m_s2)
        self._position_error = OrnsteinUhlenbeck(
            noise.position_sigma_m, noise.position_time_constant_s, estimate_s, rng
        )
        self._velocity_bias = OrnsteinUhlenbeck(
            noise.velocity_bias_sigma_m_s, noise.velocity_bias_time_constant_s, estimate_s, rng
        )
        self.commander = Commander(self.parameters, self.vehicle)
        self.commander.on_home_moved = self._set_home
        self.navigator = Navigator(self.parameters)
        origin = ned_to_geodetic(self._origin_ned_m, self._fleet_origin)
        self.telemetry = Telemetry(
            system_id=self.parameters.integer("MAV_SYS_ID"),
            origin=origin,
            origin_in_fleet_ned_m=self._origin_ned_m,
            vehicle=self.vehicle,
            commander=self.commander,
            parameters=self.parameters,
            utc_at_boot_ns=self._boot_ns + self._utc_offset_ns,
        )
        self._mav = mavlink.MAVLink(None, srcSystem=self.telemetry.system_id, srcComponent=COMPONENT_ID)
        self._mav.robust_parsing = True
        self._outbox: list[bytes] = []
        self.now_ns = 0
        self._steps = 0
        self._intervals_ns = {message: round(1e9 / rate) for message, (rate, _) in STREAMS.items()}
        self._due_ns = dict.fromkeys(STREAMS, FIRST_MESSAGE_NS)
        self._next_due_ns = FIRST_MESSAGE_NS
        self._origin_announced = False
        self._home_set = False
        self._pending_parameters: list[int] = []
        self._offboard_setpoint: Setpoint | None = None
        self._flown_mode = Mode.LOITER
        self._offboard_since_ns: int | None = None
        self._setpoint_gap_max_ns = 0
        self._setpoint_count = 0
        self._wants_takeoff = False
        self.rejected: dict[str, int] = {}
        """what came in and was dropped, by reason"""
        self._apply_gains()
        self._estimate()

    # The host's side

    def receive(self, datagram: bytes, now_ns: int) -> None:
        """Takes what arrived from the link at `now_ns`; answers wait for the next `advance`."""
        self._catch_up(now_ns)
        for message in self._mav.parse_buffer(datagram) or ():
            if message.get_type() == "BAD_DATA":
                self._reject("bad_data")
            else:
                self._handle(message)

    def next_deadline_ns(self) -> int:
        """When `advance` should be called next."""
        if self._outbox:
            return self._boot_ns + self.now_ns
        if self._pending_parameters:
            return self._boot_ns + self.now_ns + STEP_NS
        late = -(-self._next_due_ns // STEP_NS) * STEP_NS
        return self._boot_ns + max(late, self.now_ns + STEP_NS)

    def advance(self, now_ns: int) -> list[bytes]:
        """Moves on to `now_ns` and gives what is to be sent, one message a datagram."""
        self._catch_up(now_ns)
        sent, self._outbox = self._outbox, []
        return sent

    def truth(self) -> TruthState:
        """What is true at the last step of the grid."""
        vehicle, origin, commander = self.vehicle, self._origin_ned_m, self.commander
        last = commander.setpoint_last_ns
        return TruthState(
            time_ns=self._boot_ns + self.now_ns,
            position_ned_m=Ned(
                vehicle.north_m + origin.north, vehicle.east_m + origin.east, vehicle.down_m + origin.down
            ),
            velocity_ned_m_s=Ned(vehicle.velocity_north_m_s, vehicle.velocity_east_m_s, vehicle.velocity_down_m_s),
            acceleration_ned_m_s2=Ned(
                vehicle.acceleration_north_m_s2, vehicle.acceleration_east_m_s2, vehicle.acceleration_down_m_s2
            ),
            yaw_rad=vehicle.yaw_rad,
            armed=commander.armed,
            custom_mode=commander.mode.custom_mode,
            landed_state=int(commander.landed_state),
            setpoint_gap_max_s=self._setpoint_gap_max_ns / 1e9,
            setpoint_count=self._setpoint_count,
            setpoint_last_ns=None if last is None else self._boot_ns + last,
        )

    # One step of the grid

    def _catch_up(self, now_ns: int) -> None:
        target = now_ns - self._boot_ns
        while self.now_ns + STEP_NS <= target:
            self._step()

    def _step(self) -> None:
        self.now_ns += STEP_NS
        self._steps += 1
        now = self.telemetry.now_ns = self.now_ns
        self._gust.step()
        self._fly(now)
        gust = self._gust
        self.vehicle.move(gust.north, gust.east, gust.down, STEP_S)
        if self._steps % ESTIMATE_STEPS == 0:
            self._estimate()
        self.commander.step(now, wants_takeoff=self._wants_takeoff)
        self._drain_battery()
        if not self._home_set and now >= HOME_SET_NS:
            self._home_set = True
            self._set_home()
        if not self._origin_announced and now >= ORIGIN_SENT_NS:
            self._origin_announced = True
            self.send_now(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
        if self._pending_parameters:
            for index in self._pending_parameters[:PARAMETERS_PER_STEP]:
                self._send_parameter(index)
            del self._pending_parameters[:PARAMETERS_PER_STEP]
        if now >= self._next_due_ns:
            self._send_due(now)

    def _fly(self, now_ns: int) -> None:
        commander, vehicle, telemetry = self.commander, self.vehicle, self.telemetry
        mode = commander.mode
        if mode is not self._flown_mode:
            self._enter(mode)
        if mode is Mode.OFFBOARD and commander.armed:
            since = self._offboard_since_ns if self._offboard_since_ns is not None else now_ns
            last = commander.setpoint_last_ns
            gap = now_ns - (since if last is None else max(since, last))
            self._setpoint_gap_max_ns = max(self._setpoint_gap_max_ns, gap)
        if not commander.armed:
            self._wants_takeoff = False
            telemetry.setpoint = None
            vehicle.idle()
            return
        setpoint = self._setpoint(mode)
        self._wants_takeoff = self._asks_for_takeoff(mode, setpoint)
        if not commander.motors_run:
            telemetry.setpoint = None
            vehicle.idle()
            return
        telemetry.setpoint = setpoint
        vehicle.gains.speed_max_up_m_s = self._speed_up_limit_m_s(now_ns)
        vehicle.thrust_min_g = commander.thrust_min_g
        vehicle.control(setpoint, STEP_S)
        if mode is Mode.TAKEOFF and self.navigator.takeoff_done:
            commander.choose(Mode.LOITER, now_ns)

    def _speed_up_limit_m_s(self, now_ns: int) -> float:
        return self.commander.speed_up_limit_m_s(now_ns, self.parameters.number("MPC_Z_VEL_MAX_UP"))

    def _setpoint(self, mode: Mode) -> Setpoint:
        if mode is Mode.OFFBOARD:
            setpoint = self._offboard_setpoint
            return HOLD_STILL if setpoint is None or not setpoint.is_flyable() else setpoint
        if mode.is_manual and self.commander.pilot_present:
            return HOLD_STILL
        vehicle = self.vehicle
        estimated_down = vehicle.down_m + vehicle.position_error_down_m
        return self.navigator.setpoint(
            mode,
            estimated_down,
            self.telemetry.height_m,
            STEP_S,
            lifted=not vehicle.on_ground,
            may_climb=self.commander.motors_run and self._speed_up_limit_m_s(self.now_ns) > 0.0,
        )

    def _asks_for_takeoff(self, mode: Mode, setpoint: Setpoint) -> bool:
        if mode is Mode.TAKEOFF:
            return True
        if mode is not Mode.OFFBOARD:
            return False
        down = self.vehicle.down_m + self.vehicle.position_error_down_m
        return setpoint.down_m < down or setpoint.velocity_down_m_s < 0.0 or setpoint.acceleration_down_m_s2 < 0.0

    def _enter(self, mode: Mode) -> None:
        before, self._flown_mode = self._flown_mode, mode
        if mode is Mode.OFFBOARD:
            self._offboard_setpoint = None
            self._offboard_since_ns = self.now_ns
            return
        vehicle = self.vehicle
        self.navigator.enter(
            mode,
            (
                vehicle.north_m + vehicle.position_error_north_m,
                vehicle.east_m + vehicle.position_error_east_m,
                vehicle.down_m + vehicle.position_error_down_m,
            ),
            (vehicle.velocity_north_m_s, vehicle.velocity_east_m_s, vehicle.velocity_down_m_s),
            keep_altitude=before is Mode.TAKEOFF and self.navigator.takeoff_done,
        )

    def _estimate(self) -> None:
        """The estimator publishes: true state plus its errors. What flies is this without the white noise."""
        self._position_error.step()
        self._velocity_bias.step()
        vehicle, telemetry = self.vehicle, self.telemetry
        position, bias = self._position_error, self._velocity_bias
        vehicle.position_error_north_m = position.north
        vehicle.position_error_east_m = position.east
        vehicle.position_error_down_m = position.down
        vehicle.velocity_error_north_m_s = bias.north
        vehicle.velocity_error_east_m_s = bias.east
        vehicle.velocity_error_down_m_s = bias.down
        telemetry.time_ns = self.now_ns
        telemetry.north_m = vehicle.north_m + position.north
        telemetry.east_m = vehicle.east_m + position.east
        telemetry.down_m = vehicle.down_m + position.down
        sigma = self._noise.velocity_sigma_m_s
        if sigma > 0.0:
            gauss = self._random.gauss
            telemetry.velocity_north_m_s = vehicle.velocity_north_m_s + bias.north + gauss(0.0, sigma)
            telemetry.velocity_east_m_s = vehicle.velocity_east_m_s + bias.east + gauss(0.0, sigma)
            telemetry.velocity_down_m_s = vehicle.velocity_down_m_s + bias.down + gauss(0.0, sigma)
        else:
            telemetry.velocity_north_m_s = vehicle.velocity_north_m_s + bias.north
            telemetry.velocity_east_m_s = vehicle.velocity_east_m_s + bias.east
            telemetry.velocity_down_m_s = vehicle.velocity_down_m_s + bias.down
        roll, pitch, yaw = vehicle.attitude_rad()
        per_s = 1.0 / (STEP_S * ESTIMATE_STEPS)
        telemetry.roll_rate_rad_s = (roll - telemetry.roll_rad) * per_s
        telemetry.pitch_rate_rad_s = (pitch - telemetry.pitch_rad) * per_s
        telemetry.yaw_rate_rad_s = vehicle.yaw_rate_rad_s
        telemetry.roll_rad, telemetry.pitch_rad, telemetry.yaw_rad = roll, pitch, yaw

    def _drain_battery(self) -> None:
        telemetry = self.telemetry
        if not self.commander.armed:
            telemetry.battery_fraction = 1.0
        elif telemetry.battery_fraction > BATTERY_LOWEST_FRACTION:
            telemetry.battery_fraction -= BATTERY_DRAIN_PER_S * STEP_S

    def _set_home(self) -> None:
        telemetry = self.telemetry
        home = Ned(telemetry.north_m, telemetry.east_m, telemetry.down_m)
        telemetry.home_local_ned_m = home
        telemetry.home_time_ns = self.now_ns
        self.navigator.set_home(*home)

    def _apply_gains(self) -> None:
        number = self.parameters.number
        self.vehicle.gains = LoopGains(
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

    # Sending

    def _send(self, message: Any) -> None:
        self._outbox.append(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) & 0xFF

    def _send_due(self, now_ns: int) -> None:
        next_due_ns = now_ns + 1_000_000_000
        for message_id, due_ns in self._due_ns.items():
            again_ns = due_ns
            if due_ns <= now_ns:
                message = STREAMS[message_id][1](self.telemetry)
                if message is not None:
                    self._send(message)
                # A stream asked to be faster than the grid comes once a step.
                again_ns = max(due_ns + self._intervals_ns[message_id], now_ns + 1)
                self._due_ns[message_id] = again_ns
            next_due_ns = min(next_due_ns, again_ns)
        self._next_due_ns = next_due_ns

    def send_now(self, message_id: int) -> bool:
        """Sends one message of a kind; False: not available."""
        if message_id in STREAMS:
            message = STREAMS[message_id][1](self.telemetry)
        elif message_id in ON_REQUEST:
            message = ON_REQUEST[message_id](self.telemetry)
        else:
            return False
        if message is None:
            return False
        self._send(message)
        return True

    def set_interval_us(self, message_id: int, interval_us: float) -> bool:
        """SET_MESSAGE_INTERVAL: -1 switches a stream off, 0 restores its default; False: no such stream."""
        if message_id not in STREAMS or not math.isfinite(interval_us):
            return False
        if interval_us < 0.0:
            self._due_ns.pop(message_id, None)
            self._intervals_ns.pop(message_id, None)
            return True
        default_ns = round(1e9 / STREAMS[message_id][0])
        self._intervals_ns[message_id] = default_ns if interval_us == 0.0 else round(interval_us * 1000.0)
        self._due_ns[message_id] = max(self.now_ns + 1, FIRST_MESSAGE_NS)
        self._next_due_ns = min(self._next_due_ns, self._due_ns[message_id])
        return True

    def interval_us(self, message_id: int) -> int:
        """A stream's interval; -1 off, 0 not available."""
        if message_id not in STREAMS:
            return 0
        return self._intervals_ns[message_id] // 1000 if message_id in self._intervals_ns else -1

    def report_interval(self, message_id: int) -> None:
        """Sends MESSAGE_INTERVAL."""
        self._send(mavlink.MAVLink_message_interval_message(max(message_id, 0), self.interval_us(message_id)))

    def change_mode(self, mode: Mode) -> Result:
        """A user's mode change."""
        return self.commander.choose(mode, self.now_ns)

    def reboot(self) -> None:
        """Restarts from the beginning, on the ground or in the air."""
        self._boot_ns += self.now_ns
        self._start()

    # Receiving

    def _reject(self, reason: str) -> None:
        self.rejected[reason] = self.rejected.get(reason, 0) + 1

    def _addressed(self, message: Any) -> bool:
        system_ok: bool = message.target_system in (0, self.telemetry.system_id)
        return system_ok and message.target_component in (0, COMPONENT_ID)

    def _handle(self, message: Any) -> None:
        match message:
            case mavlink.MAVLink_set_position_target_local_ned_message():
                if self._addressed(message):
                    self._take_setpoint(message)
            case mavlink.MAVLink_command_long_message() | mavlink.MAVLink_command_int_message():
                self._take_command(message)
            case mavlink.MAVLink_set_mode_message():
                if message.target_system == self.telemetry.system_id:
                    set_mode(
                        self, message.base_mode, message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24 & 0xFF
                    )
            case mavlink.MAVLink_timesync_message():
                if message.tc1 == 0:
                    self._send(mavlink.MAVLink_timesync_message(self.now_ns, message.ts1))
            case mavlink.MAVLink_ping_message():
                if message.target_system == 0 and message.target_component == 0:
                    self._send(
                        mavlink.MAVLink_ping_message(
                            message.time_usec, message.seq, message.get_srcSystem(), message.get_srcComponent()
                        )
                    )
            case (
                mavlink.MAVLink_param_request_list_message()
                | mavlink.MAVLink_param_request_read_message()
                | mavlink.MAVLink_param_set_message()
            ):
                if self._addressed(message):
                    self._take_parameter(message)
            case (
                mavlink.MAVLink_mission_request_list_message()
                | mavlink.MAVLink_mission_clear_all_message()
                | mavlink.MAVLink_mission_count_message()
            ):
                if self._addressed(message):
                    self._take_mission(message)
            case mavlink.MAVLink_file_transfer_protocol_message():
                if self._addressed(message):
                    self._refuse_file_transfer(message)
            case _:
                pass

    def _take_setpoint(self, message: Any) -> None:
        setpoint, reason = decode_setpoint(message, self.vehicle.yaw_rad)
        if setpoint is None:
            self._reject(reason)
            return
        commander = self.commander
        commander.setpoint_seen = True
        commander.setpoint_last_ns = self.now_ns
        self._setpoint_count += 1
        if commander.mode is Mode.OFFBOARD:
            if self._flown_mode is not Mode.OFFBOARD:
                self._enter(Mode.OFFBOARD)
            self._offboard_setpoint = setpoint

    def _take_command(self, message: Any) -> None:
        if not self._addressed(message):
            return
        if isinstance(message, mavlink.MAVLink_command_int_message):
            latitude, longitude = message.x / 1e7, message.y / 1e7
            altitude = message.z
        else:
            latitude, longitude, altitude = message.param5, message.param6, message.param7
        request = CommandRequest(
            message.command,
            (message.param1, message.param2, message.param3, message.param4),
            latitude,
            longitude,
            altitude,
        )
        result = answer(self, request)
        self._send(
            mavlink.MAVLink_command_ack_message(
                message.command, int(result), 0, 0, message.get_srcSystem(), message.get_srcComponent()
            )
        )

    def _take_parameter(self, message: Any) -> None:
        table = self.parameters
        match message:
            case mavlink.MAVLink_param_request_list_message():
                self._pending_parameters = [HASH_INDEX, *range(len(table))]
            case mavlink.MAVLink_param_request_read_message():
                if message.param_index >= 0:
                    if message.param_index < len(table):
                        self._send_parameter(message.param_index)
                elif message.param_id == HASH_NAME:
                    self._send_parameter(HASH_INDEX)
                elif message.param_id in table:
                    self._send_parameter(table.index(message.param_id))
            case _:
                changed = table.set_from_wire(message.param_id, message.param_value, message.param_type)
                if changed is None:
                    self._reject("parameter")
                    return
                for _ in range(2 if changed else 1):
                    self._send_parameter(table.index(message.param_id))
                if changed:
                    self._apply_gains()

    def _send_parameter(self, index: int) -> None:
        table = self.parameters
        if index == HASH_INDEX:
            name, value, kind = HASH_NAME, table.hash_check(), TYPE_UINT32
        else:
            name = table.names[index]
            value, kind = table.wire_value(name), table.wire_type(name)
        self._send(mavlink.MAVLink_param_value_message(name.encode(), value, kind, len(table), index))

    def _take_mission(self, message: Any) -> None:
        """There is no mission, fence or rally point, and none can be stored."""
        system, component = message.get_srcSystem(), message.get_srcComponent()
        match message:
            case mavlink.MAVLink_mission_request_list_message():
                self._send(mavlink.MAVLink_mission_count_message(system, component, 0, message.mission_type))
            case mavlink.MAVLink_mission_count_message() if message.count > 0:
                self._send(
                    mavlink.MAVLink_mission_ack_message(
                        system, component, mavlink.MAV_MISSION_NO_SPACE, message.mission_type
                    )
                )
            case _:
                self._send(
                    mavlink.MAVLink_mission_ack_message(
                        system, component, mavlink.MAV_MISSION_ACCEPTED, message.mission_type
                    )
                )

    def _refuse_file_transfer(self, message: Any) -> None:
        """Answers NAK; a client that gets no answer at all waits for many seconds."""
        payload = bytes(message.payload)
        sequence, session, opcode = struct.unpack_from("<HBB", payload)
        reply = struct.pack("<HBBBBBBI", sequence + 1 & 0xFFFF, session, MAVLINK_FTP_NAK, 1, opcode, 0, 0, 0)
        reply += bytes([MAVLINK_FTP_UNKNOWN_COMMAND])
        self._send(
            mavlink.MAVLink_file_transfer_protocol_message(
                0, message.get_srcSystem(), message.get_srcComponent(), list(reply.ljust(251, b"\0"))
            )
        )


def decode_setpoint(message: Any, yaw_rad: float) -> tuple[Setpoint | None, str]:
    """SET_POSITION_TARGET_LOCAL_NED as PX4 takes it; None and a reason where PX4 drops it.

    Frames LOCAL_NED (1) and BODY_NED (8, turned by `yaw_rad`; no position); bit 9 (force) and set-points that say
    nothing finite are dropped.
    """
    mask = message.type_mask

    def take(bit: int, values: tuple[float, ...]) -> list[float]:
        return [NAN if mask >> (bit + i) & 1 or not math.isfinite(v) else v for i, v in enumerate(values)]

    position = take(0, (message.x, message.y, message.z))
    velocity = take(3, (message.vx, message.vy, message.vz))
    acceleration = take(6, (message.afx, message.afy, message.afz))
    frame = message.coordinate_frame
    if frame == mavlink.MAV_FRAME_BODY_NED:
        cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
        for vector in (velocity, acceleration):
            vector[0], vector[1] = cosine * vector[0] - sine * vector[1], sine * vector[0] + cosine * vector[1]
        position = [NAN, NAN, NAN]
    elif frame != mavlink.MAV_FRAME_LOCAL_NED:
        return None, "setpoint_frame"
    if mask & FORCE_BIT and not all(math.isnan(a) for a in acceleration):
        return None, "setpoint_force"
    if all(math.isnan(value) for value in (*position, *velocity, *acceleration)):
        return None, "setpoint_empty"
    yaw = NAN if mask >> 10 & 1 or not math.isfinite(message.yaw) else message.yaw
    rate = NAN if mask >> 11 & 1 or not math.isfinite(message.yaw_rate) else message.yaw_rate
    north, east, down = position
    v_north, v_east, v_down = velocity
    a_north, a_east, a_down = acceleration
    return Setpoint(north, east, down, v_north, v_east, v_down, a_north, a_east, a_down, yaw, rate), ""


__all__ = ["Autopilot", "LandedState", "TruthState", "decode_setpoint"]
