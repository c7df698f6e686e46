"""A stand-in for one PX4: datagrams in, datagrams out, no I/O. The same class serves processes and lockstep.

Time is an argument, in the host's monotonic nanoseconds; inside it is nanoseconds since boot on a fixed grid of 4 ms,
PX4's own simulation step. The same seed and the same calls give the same bytes. Its parts are the other files here.
"""

import os
import random
from collections.abc import Mapping
from typing import Any

os.environ["MAVLINK20"] = "1"
from pymavlink.dialects.v20 import development as mavlink

from companion.core.frames import Geodetic, Ned, ned_to_geodetic
from companion.vehicle.autopilot.px4_versions import OLDEST, version_named
from companion.wire.mavlink_frames import is_one_frame
from companion.wire.signing import ticks_at
from sim.autopilot.commander import HOME_SET_NS, Commander, Result
from sim.autopilot.commands import CommandRequest, answer, set_mode
from sim.autopilot.disturbances import GustParameters, NoiseParameters, OrnsteinUhlenbeck, normals
from sim.autopilot.dynamics import Vehicle
from sim.autopilot.dynamics_parameters import DynamicsParameters
from sim.autopilot.estimator import Estimator
from sim.autopilot.events import EventReporter
from sim.autopilot.faults import LASTING, OF_PX4_ALONE, Fault, FaultKind
from sim.autopilot.flight import Flight
from sim.autopilot.lasting_faults import LastingFaults
from sim.autopilot.link import COMPONENT_ID, Link, StreamSchedule
from sim.autopilot.modes import Mode
from sim.autopilot.navigator import Navigator
from sim.autopilot.offboard import SetpointFields, decode_setpoint
from sim.autopilot.packing import unpacked
from sim.autopilot.parameters import ParameterTable, loop_gains
from sim.autopilot.services import Services
from sim.autopilot.signing import Signing
from sim.autopilot.telemetry import Telemetry
from sim.autopilot.truth import TruthState, minus, plus

STEP_NS = 4_000_000
"""grid of the dynamics and of everything that is sent, ns"""
STEP_S = STEP_NS / 1e9
ESTIMATE_STEPS = 2
"""the estimator publishes every so many steps: 125 Hz, as PX4's does"""
ORIGIN_SENT_NS = 1_800_000_000
"""GPS_GLOBAL_ORIGIN comes by itself once, this long after boot"""
BATTERY_DRAIN_PER_STEP = 1.0 / 60.0 * STEP_S
"""while armed, a sixtieth a second; down to half, and full again when disarmed, as recorded"""
BATTERY_LOWEST_FRACTION = 0.5
SETPOINT = mavlink.MAVLink_set_position_target_local_ned_message
SETPOINT_KEY = SETPOINT.id.to_bytes(3, "little")
NO_OFFSET = Ned(0.0, 0.0, 0.0)
COMPANION_LINK, GROUND_LINK = 0, 1
"""link ids of signatures"""


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
        px4: str = OLDEST.name,
        signing_key: bytes | None = None,
        yaw_rad: float = 0.0,
        seed: int = 0,
    ) -> None:
        """`boot_ns`: host's monotonic time of boot; UTC is monotonic + `utc_offset_ns`; `home_ned_m`: true start.

        The estimator's origin lies at `home_ned_m` + `ekf_origin_offset_m` (fleet frame); position reports are relative
        to it. Dynamics, gusts and noise that are left out are those of the dataclasses' defaults.
        """
        if not 1 <= system_id <= 255:
            raise ValueError(f"system_id must be 1..255, got {system_id}")
        dynamics = dynamics if dynamics is not None else DynamicsParameters()
        gust = gust if gust is not None else GustParameters()
        self._noise = noise if noise is not None else NoiseParameters()
        self._boot_ns = boot_ns
        self._utc_offset_ns = utc_offset_ns
        self._fleet_origin = fleet_origin
        self._ekf_origin_offset_m = ekf_origin_offset_m
        self._dynamics = dynamics
        self._seed = f"{seed}/{system_id}"
        self._boots = 0
        self.version = version_named(px4)
        if signing_key is not None and not self.version.signing:
            raise ValueError(f'PX4 {px4} signs nothing: [stub] signing needs px4 = "1.18" or newer')
        # The key outlives a boot, as PX4's does on its card; it was given at the start.
        self.signing = Signing(signing_key, ticks_at(boot_ns + utc_offset_ns))
        self.parameters = ParameterTable({**(parameters or {}), "MAV_SYS_ID": system_id}, self.version)
        self._origin_ned_m = plus(home_ned_m, ekf_origin_offset_m)
        start = minus(NO_OFFSET, ekf_origin_offset_m)
        # The vehicle moves in the estimator's own frame; what is true in the fleet frame is that plus its origin.
        self.vehicle = Vehicle(start.north, start.east, start.down, dynamics, yaw_rad=yaw_rad)
        self._gust = OrnsteinUhlenbeck(
            gust.sigma_m_s2,
            gust.time_constant_s,
            STEP_S,
            normals(random.Random(f"{self._seed}/gust")),
            gust.bound_m_s2,
        )
        self.rejected: dict[str, int] = {}
        """what came in and was dropped, by reason"""
        self._boot()

    def _boot(self) -> None:
        """Everything that a boot sets up; the vehicle itself stays where it is."""
        self._boots += 1
        self.vehicle.parameters = self._dynamics
        self.now_ns = 0
        """time since boot, on the grid"""
        self._steps = 0
        self.commander = Commander(self.parameters, self.vehicle)
        self.commander.on_home_moved = self._set_home
        self.navigator = Navigator(self.parameters)
        self.telemetry = Telemetry(
            system_id=self.parameters.integer("MAV_SYS_ID"),
            origin=ned_to_geodetic(self._origin_ned_m, self._fleet_origin),
            vehicle=self.vehicle,
            commander=self.commander,
            parameters=self.parameters,
            utc_at_boot_ns=self._boot_ns + self._utc_offset_ns,
        )
        self._estimator = Estimator(
            self._noise, self.vehicle, self.telemetry, STEP_S * ESTIMATE_STEPS, f"{self._seed}/{self._boots}"
        )
        self.link = Link(self.telemetry.system_id)
        self.schedule = StreamSchedule(self.link, self.telemetry)
        self._services = Services(self.link, self.parameters, self._apply_parameters)
        self._events = EventReporter(self.link, self.commander)
        self._flight = Flight(self.commander, self.navigator, self.vehicle, self.telemetry)
        self._origin_announced = False
        self._home_set = False
        self._faults = LastingFaults(self._estimator, self.telemetry, self.link, self.vehicle)
        self._reboot_wanted = False
        self._apply_parameters()
        self._estimator.step(0)

    # The host's side

    def receive(self, datagram: bytes, now_ns: int) -> None:
        """Takes what arrived from the link at `now_ns`; answers wait for the next `advance`."""
        self._catch_up(now_ns)
        datagram = b"" if self.link.deaf else self.signing.admitted(datagram)
        if is_one_frame(datagram) and datagram[7:10] == SETPOINT_KEY and self.link.mav.buf_len() == 0:
            # What comes many times a second is read without pymavlink's objects; what is damaged goes the long way.
            values = unpacked(SETPOINT, datagram)
            if values is not None:
                asked = SetpointFields(*values)
                if self._addressed(asked):
                    self._take_setpoint(asked)
                return
        for message in self.link.mav.parse_buffer(datagram) or ():
            if message.get_type() == "BAD_DATA":
                self._reject("bad_data")
            else:
                self._handle(message)

    def next_deadline_ns(self) -> int:
        """When `advance` should be called next: on the grid."""
        if self._services.listing:
            due_ns = self.now_ns + STEP_NS
        else:
            due_ns = max(self.schedule.next_due_ns, self.now_ns + STEP_NS)
        departure_ns = self.link.next_departure_ns()
        if departure_ns is not None:
            due_ns = min(due_ns, max(departure_ns, self.now_ns))
        return self._boot_ns - (-due_ns // STEP_NS) * STEP_NS

    def advance(self, now_ns: int) -> list[bytes]:
        """Moves on to `now_ns` and gives what is to be sent, one message a datagram."""
        self._catch_up(now_ns)
        return [self.signing.sign(packet, COMPANION_LINK) for packet in self.link.take()]

    def skip(self, until_ns: int) -> None:
        """Moves on without the streams of the time between: a host that stalled sends nothing late, as PX4 does not."""
        self.schedule.muted = True
        self._catch_up(until_ns)
        self.schedule.muted = False

    def truth(self) -> TruthState:
        """What is true at the last step of the grid."""
        vehicle, commander, origin = self.vehicle, self.commander, self._origin_ned_m
        last_ns = commander.setpoint_last_ns
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
            setpoint_gap_max_s=self._flight.stream.gap_max_ns / 1e9,
            setpoint_count=self._flight.stream.count,
            setpoint_last_ns=None if last_ns is None else self._boot_ns + last_ns,
        )

    def inject(self, fault: Fault) -> None:
        """Breaks something from now on, for as long as the fault says; ValueError for what a stub does not play."""
        if fault.kind in OF_PX4_ALONE:
            raise ValueError(f"{fault.kind} is for --autopilot px4: a stub does not play it")
        if fault.kind in LASTING:
            self._faults.order(fault, self.now_ns)
            return
        match fault.kind:
            case FaultKind.ESTIMATOR_RESET:
                self._move_origin(fault.offset_ned_m)
                self.telemetry.count_reset()
                self.schedule.send_one(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
            case FaultKind.REBOOT:
                self.reboot()
            case FaultKind.PILOT_TAKEOVER:
                self.commander.pilot_present = True
                self.commander.choose(Mode.POSCTL, self.now_ns)
            case FaultKind.PILOT_STICKS:
                self.commander.move_sticks(self.now_ns)
            case FaultKind.RC_KILL:
                self.commander.kill(self.now_ns)

    def _move_origin(self, by_ned_m: Ned) -> None:
        """The estimator's origin moves in the fleet frame; nothing true changes."""
        self._origin_ned_m = plus(self._origin_ned_m, by_ned_m)
        self.vehicle.shift(-by_ned_m.north, -by_ned_m.east, -by_ned_m.down)
        self.navigator.shift(-by_ned_m.north, -by_ned_m.east, -by_ned_m.down)
        self.telemetry.move_origin(ned_to_geodetic(self._origin_ned_m, self._fleet_origin), by_ned_m)

    # One step of the grid

    def _catch_up(self, now_ns: int) -> None:
        while self._boot_ns + self.now_ns + STEP_NS <= now_ns:
            self._step()

    def _step(self) -> None:
        now = self.now_ns + STEP_NS
        self.now_ns = self.telemetry.now_ns = self.link.now_ns = now
        self._steps += 1
        gust = self._gust
        gust.step()
        self._flight.step(now, STEP_S)
        self.vehicle.move(gust.north, gust.east, gust.down, STEP_S)
        if self._steps % ESTIMATE_STEPS == 0:
            self._estimator.step(now)
        self._drain_battery()
        self.commander.step(now, wants_takeoff=self._flight.wants_takeoff)
        self._events.step()
        self._faults.end_due(now)
        if not self._home_set and now >= HOME_SET_NS:
            self._home_set = True
            self._set_home()
        if not self._origin_announced and now >= ORIGIN_SENT_NS:
            self._origin_announced = True
            self.schedule.send_one(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
        if self._services.listing:
            self._services.step()
        if now >= self.schedule.next_due_ns:
            self.schedule.send_due(now)
        if self._reboot_wanted:
            self.reboot()

    def _drain_battery(self) -> None:
        telemetry, commander = self.telemetry, self.commander
        fraction = telemetry.battery_fraction
        if telemetry.battery_forced is not None:
            fraction = telemetry.battery_forced
        elif not commander.armed:
            fraction = 1.0
        elif fraction > BATTERY_LOWEST_FRACTION:
            fraction -= BATTERY_DRAIN_PER_STEP
        telemetry.battery_fraction = commander.battery_fraction = fraction

    def _set_home(self) -> None:
        self.telemetry.set_home(self.now_ns)
        home = self.telemetry.home_local_ned_m
        if home is not None:
            self.navigator.set_home(home.north, home.east, home.down)

    def _apply_parameters(self) -> None:
        self.vehicle.gains = loop_gains(self.parameters)
        self.commander.read_parameters()

    # What commands act on

    def send_now(self, message_id: int) -> bool:
        """Sends one message of a kind; False: not available."""
        return self.schedule.send_one(message_id)

    def set_interval_us(self, message_id: int, interval_us: float) -> bool:
        """Changes a stream's interval; False: no such stream."""
        return self.schedule.set_interval_us(message_id, interval_us, self.now_ns)

    def report_interval(self, message_id: int) -> None:
        """Sends MESSAGE_INTERVAL."""
        self.link.send(
            mavlink.MAVLink_message_interval_message(max(message_id, 0), self.schedule.interval_us(message_id))
        )

    def change_mode(self, mode: Mode) -> Result:
        """A user's mode change."""
        result = self.commander.choose(mode, self.now_ns)
        self._flight.follow_mode(self.now_ns)
        return result

    def order_reboot(self) -> None:
        """Restarts after the present step, so that the answer still leaves."""
        self._reboot_wanted = True

    def reboot(self) -> None:
        """Restarts from the beginning, on the ground or in the air: motors stop, the estimator starts anew here."""
        unsent = self.link.take()
        self._boot_ns += self.now_ns
        here = Ned(self.vehicle.north_m, self.vehicle.east_m, self.vehicle.down_m)
        self._move_origin(plus(here, self._ekf_origin_offset_m))
        self._boot()
        self.link.put_back(unsent)

    # Receiving

    def _reject(self, reason: str) -> None:
        self.rejected[reason] = self.rejected.get(reason, 0) + 1

    def _addressed(self, message: Any) -> bool:
        system_ok: bool = message.target_system in (0, self.telemetry.system_id)
        return system_ok and message.target_component in (0, COMPONENT_ID)

    def _handle(self, message: Any) -> None:
        services = self._services
        match message.get_type():
            case "TIMESYNC":
                services.synchronise(message)
            case "PING":
                services.ping(message)
            case "SETUP_SIGNING":
                self._set_up_signing(message)
            case "SET_MODE":
                if message.target_system == self.telemetry.system_id:
                    custom = message.custom_mode
                    set_mode(self, message.base_mode, custom >> 16 & 0xFF, custom >> 24 & 0xFF)
            case _ if hasattr(message, "target_system") and not self._addressed(message):
                pass  # somebody else's
            case "SET_POSITION_TARGET_LOCAL_NED":
                self._take_setpoint(message)
            case "COMMAND_LONG" | "COMMAND_INT":
                self._take_command(message)
            case "PARAM_REQUEST_LIST":
                services.list_parameters()
            case "PARAM_REQUEST_READ":
                services.read_parameter(message)
            case "PARAM_SET":
                if not services.set_parameter(message):
                    self._reject("parameter")
            case "MISSION_REQUEST_LIST":
                services.count_mission(message)
            case "MISSION_COUNT" if message.count > 0:
                services.refuse_mission(message)
            case "MISSION_COUNT" | "MISSION_CLEAR_ALL":
                services.clear_mission(message)
            case "FILE_TRANSFER_PROTOCOL":
                services.refuse_file_transfer(message)

    def _set_up_signing(self, message: Any) -> None:
        known = self.version.signing and self._addressed(message)
        if known and (why := self.signing.set_up(message, self.commander.armed)):
            self._reject(why)

    def _take_setpoint(self, message: Any) -> None:
        setpoint, reason = decode_setpoint(message, self.telemetry.yaw_rad)
        if setpoint is None:
            self._reject(reason)
            return
        self._flight.take_setpoint(setpoint, self.now_ns)

    def _take_command(self, message: Any) -> None:
        if message.target_system == 0 and not self.version.strict_commands:
            return
        if isinstance(message, mavlink.MAVLink_command_int_message):
            latitude, longitude, altitude = message.x / 1e7, message.y / 1e7, message.z
        else:
            latitude, longitude, altitude = message.param5, message.param6, message.param7
        params = (message.param1, message.param2, message.param3, message.param4)
        result = answer(self, CommandRequest(message.command, params, latitude, longitude, altitude))
        self.link.send(
            mavlink.MAVLink_command_ack_message(
                message.command, int(result), 0, 0, message.get_srcSystem(), message.get_srcComponent()
            )
        )
