"""PX4 behind the port, over MAVLink: what it has said, and what is asked of it.

PX4's quirks that shape it: GPS_GLOBAL_ORIGIN comes once after boot and must be requested; LOCAL_POSITION_NED says
nothing of its validity; what a command has done shows in the next HEARTBEAT, which comes once a second.
"""

from collections import deque
from math import dist, inf

from companion.config import FleetConfig
from companion.config.derived import Vehicle
from companion.core.counts import Counts, summed
from companion.core.events import AutopilotIdentified, AutopilotRebooted, Event, OriginMoved
from companion.core.failsafe import DAMAGE_M, HEARTBEAT_S, STALE_S, STATUS_S
from companion.core.frames import Geodetic, LocalFrame, Ned
from companion.core.values import ZERO, Instant, SafeSetpoint
from companion.vehicle.autopilot.boot_clock import BootClock
from companion.vehicle.autopilot.parameter_reader import ParameterReader
from companion.vehicle.autopilot.port import (
    HOLD,
    LAND,
    OFFBOARD,
    TAKE_OFF,
    AutopilotFacts,
    Estimate,
    FlightMode,
    Heard,
    Outcome,
    Verb,
)
from companion.vehicle.autopilot.px4_identity import Px4Identity
from companion.vehicle.autopilot.px4_parameters import PARAMETERS, ParameterRows, identity_checks
from companion.vehicle.autopilot.px4_versions import same_setting
from companion.vehicle.autopilot.requests import STREAM, Requests
from companion.vehicle.autopilot.round_trips import RoundTrips
from companion.wire import mavlink as wire
from companion.wire import px4
from companion.wire.mavlink import MavlinkCodec
from companion.wire.px4 import Px4Mode, Software, mode_name

CLOCK_SAMPLES = 5
FLAGS_NEEDED = 1 | 2 | 4
"""ESTIMATOR_STATUS: attitude, horizontal and vertical velocity"""
GLOBAL_FLAG, RELATIVE_FLAG = 16, 8
"""horizontal position, absolute and relative"""
RC_RECEIVER_FLAG = 1 << 16
"""SYS_STATUS: the RC receiver is healthy"""

MODES: dict[int, FlightMode] = {
    Px4Mode.AUTO_TAKEOFF: TAKE_OFF,
    Px4Mode.AUTO_LOITER: HOLD,
    Px4Mode.OFFBOARD: OFFBOARD,
    Px4Mode.AUTO_LAND: LAND,
    Px4Mode.AUTO_DESCEND: LAND,
}
"""PX4's modes by the port's words; every other one goes by its own name"""
REQUESTS = {
    Verb.ARM: "arming",
    Verb.TAKE_OFF: "take-off",
    Verb.ENGAGE: Px4Mode.OFFBOARD.name,
    Verb.HOLD: Px4Mode.AUTO_LOITER.name,
    Verb.LAND: Px4Mode.AUTO_LAND.name,
    Verb.KILL: "kill",
}
"""a verb's request by its name in logs and counts"""
COUNTED = (
    "autopilot reboot", "position repeated", "estimator origin moved", "time answer to nothing asked",
    "answer to nothing asked", "unanswered", *(f"refused: {name}" for name in (STREAM, *REQUESTS.values())),
)  # fmt: skip
"""what is counted of a PX4"""


class Px4Autopilot:
    """One PX4 as seen over its link (`port.AutopilotPort`)."""

    def __init__(self, config: FleetConfig, vehicle: Vehicle) -> None:
        self.config = config
        self.fleet_origin = config.origin if config.fleet.frame == "global" else None
        self.codec = MavlinkCodec(vehicle.system_id)
        self.counts = Counts(COUNTED)
        self.events: list[Event] = []
        self.requests = Requests(self.codec.command, self.counts, self.events)
        self.parameters = ParameterReader(PARAMETERS, same_setting)
        self.identity = Px4Identity()
        self.armed = False
        self.custom_mode = 0
        self.intended_mode: int | None = None
        """what the user chose, as CURRENT_MODE tells: another than custom_mode means a failsafe of the autopilot's"""
        self.kind = -1
        """MAV_AUTOPILOT"""
        self.vehicle_type = -1
        """MAV_TYPE"""
        self.landed_state = 0
        self.battery_percent = -1
        self.sensors_health = 0
        self.home_altitude_amsl_m: float | None = None
        self.estimator = wire.EstimatorHealth(0, inf)
        self.estimator_ns: int | None = None
        """when ESTIMATOR_STATUS last came (monotonic ns)"""
        self.health_ns: int | None = None
        """when SYS_STATUS last came (monotonic ns)"""
        self.foreign_ns: int | None = None
        """when an autopilot of another system id last spoke (monotonic ns)"""
        self.origin: Geodetic | None = None
        self.origin_crept_ned_m = ZERO
        self.frame: LocalFrame | None = None if self.fleet_origin is not None else LocalFrame(ZERO)
        self.boot = BootClock()
        self.position_ns: int | None = None
        self.position_ned_m = ZERO
        self.velocity_ned_m_s = ZERO
        self._next_heartbeat_ns = self._next_origin_ns = 0
        self._origin_doubted = False
        self._round_trips = RoundTrips()
        self._clock_ahead_ns: deque[int] = deque(maxlen=CLOCK_SAMPLES)
        self._settings = ParameterRows(config, vehicle.id)

    # -- what it says --------------------------------------------------------------------------------------------------

    def receive(self, datagram: bytes, now: Instant) -> Heard:
        """Take a datagram; returns what it brought."""
        self.requests.now_ns = now.monotonic_ns
        ours = fresh = False
        foreign = self.codec.foreign_heard
        messages = self.codec.decode(datagram)
        if self.codec.foreign_heard > foreign:
            self.foreign_ns = now.monotonic_ns
        for message in messages:
            match message:
                case wire.LocalPosition():
                    ours = True
                    fresh = self._position(message, now) or fresh
                case wire.Heartbeat():
                    ours = True
                    self._heartbeat(message, now)
                case wire.CurrentMode():
                    self.custom_mode = message.custom_mode
                    self.intended_mode = message.intended_custom_mode
                case wire.LandedState():
                    self.landed_state = message.state
                case wire.GlobalOrigin():
                    self._origin(message.origin)
                case wire.EstimatorHealth():
                    self.estimator_ns = now.monotonic_ns
                    self.estimator = message
                case wire.SystemHealth():
                    self.health_ns = now.monotonic_ns
                    self.battery_percent = message.battery_percent
                    self.sensors_health = message.sensors_health
                case wire.HomePosition():
                    self.home_altitude_amsl_m = message.altitude_amsl_m
                case wire.ParameterValue():
                    self.parameters.take(message.name, message.value)
                case wire.ParameterError():
                    self.parameters.refused(message.name)
                case Software():
                    if self.identity.take(message):
                        self.events.append(AutopilotIdentified(f"PX4 {message}"))
                case wire.TimeAnswer():
                    if not self._round_trips.answered(message.asked_ns, now.monotonic_ns):
                        self.counts["time answer to nothing asked"] += 1
                case wire.SystemTime():
                    self._clock_ahead_ns.append(message.unix_us * 1000 - now.fleet_ns)
                case wire.CommandAnswer():
                    self.requests.answered(message, now.monotonic_ns)
        return Heard(ours, fresh)

    def _heartbeat(self, message: wire.Heartbeat, now: Instant) -> None:
        if self.heartbeat_ns is None:
            self._set_up()
        self.requests.heartbeat_ns = now.monotonic_ns
        self.armed = message.armed
        self.custom_mode = message.custom_mode
        self.kind = message.autopilot
        self.vehicle_type = message.vehicle_type

    def _set_up(self) -> None:
        """Ask for what we read, and for no more: a companion's link may be a serial line."""
        for message_id, rate_hz in px4.streams_hz(self.config.limits.control_rate_hz).items():
            self.requests.ask(f"{STREAM} {message_id}", *px4.interval_parameters(message_id, rate_hz))

    def _position(self, message: wire.LocalPosition, now: Instant) -> bool:
        boot_ms = self.boot.unwrapped(message.boot_ms, now.monotonic_ns)
        if self.boot.rebooted(boot_ms):
            self._rebooted()
            boot_ms = message.boot_ms
        elif boot_ms <= self.boot.last_boot_ms:
            self.counts["position repeated"] += 1
            return False
        made_ns = self.boot.arrived(boot_ms, now.monotonic_ns)
        if self.frame is None:
            return False
        self.position_ns = made_ns
        self.position_ned_m = self.frame.to_fleet(message.position_local_ned_m)
        self.velocity_ned_m_s = message.velocity_ned_m_s
        return True

    def _rebooted(self) -> None:
        self.events.append(AutopilotRebooted())
        self.counts["autopilot reboot"] += 1
        self.boot.restart()
        self.origin = None
        if self.fleet_origin is not None:
            self.frame = None
        self.requests.cancel()
        self.parameters.restart()
        self.identity.restart()
        self._round_trips.restart()
        self._clock_ahead_ns.clear()
        self.home_altitude_amsl_m = None
        self._set_up()

    def _origin(self, origin: Geodetic) -> None:
        self._origin_doubted = False
        if self.fleet_origin is None or origin == self.origin:
            return
        before, self.frame = self.frame, LocalFrame.from_origins(origin, self.fleet_origin)
        if self.origin is not None and before is not None:
            self.events.append(OriginMoved())
            self.counts["estimator origin moved"] += 1
            was, is_, crept = before.to_fleet(ZERO), self.frame.to_fleet(ZERO), self.origin_crept_ned_m
            if dist(was, is_) < DAMAGE_M:
                self.origin_crept_ned_m = Ned(*(c + b - a for a, b, c in zip(was, is_, crept, strict=True)))
        self.origin = origin

    # -- what is asked of it -------------------------------------------------------------------------------------------

    def arm(self) -> None:
        """Let the motors turn; sent once."""
        self.requests.ask(REQUESTS[Verb.ARM], *px4.arm_parameters(True), once=True)

    def take_off(self, altitude_amsl_m: float) -> None:
        """Climb; NaN: to PX4's MIS_TAKEOFF_ALT."""
        self.requests.ask(REQUESTS[Verb.TAKE_OFF], *px4.takeoff_parameters(altitude_amsl_m))

    def engage(self) -> None:
        """OFFBOARD, which PX4 enters only while setpoints stream."""
        self.requests.ask_mode(REQUESTS[Verb.ENGAGE], *px4.mode_parameters(Px4Mode.OFFBOARD))

    def hold(self) -> None:
        """AUTO.LOITER."""
        self.requests.ask_mode(REQUESTS[Verb.HOLD], *px4.mode_parameters(Px4Mode.AUTO_LOITER))

    def land(self) -> None:
        """AUTO.LAND."""
        self.requests.ask_mode(REQUESTS[Verb.LAND], *px4.mode_parameters(Px4Mode.AUTO_LAND))

    def kill(self) -> None:
        """Disarm by force."""
        self.requests.ask(REQUESTS[Verb.KILL], *px4.kill_parameters())

    def outcome(self, verb: Verb) -> Outcome | None:
        """What came of a verb, once a HEARTBEAT has come that knows of it."""
        return self.requests.outcome(REQUESTS[verb])

    def withdraw(self, *verbs: Verb) -> None:
        """Ask no more for these."""
        self.requests.withdraw(REQUESTS[verb] for verb in verbs)

    def cancel(self) -> None:
        """Ask for nothing more."""
        self.requests.cancel()

    def doubt_origin(self) -> None:
        """Ask for GPS_GLOBAL_ORIGIN again."""
        self._origin_doubted = True

    # -- bytes to send -------------------------------------------------------------------------------------------------

    def due(self, now: Instant) -> list[bytes]:
        """Datagrams to send now: heartbeat at 1 Hz, requests with their retries."""
        self.requests.now_ns = now.monotonic_ns
        out = []
        if now.monotonic_ns >= self._next_heartbeat_ns:
            out.append(self.codec.heartbeat())
            self._next_heartbeat_ns = now.monotonic_ns + 1_000_000_000
        if self.heartbeat_ns is None:
            return out
        if self._asks_origin and now.monotonic_ns >= self._next_origin_ns:
            self._next_origin_ns = now.monotonic_ns + 1_000_000_000
            out.append(self.codec.command(*px4.request_message_parameters(px4.ORIGIN_MESSAGE_ID)))
        out += self.requests.due()
        if not self.armed:
            out += self._preflight_due(now.monotonic_ns)
        return out

    def _preflight_due(self, now_ns: int) -> list[bytes]:
        """On the ground: the link's round trip once a second, which PX4 it is, and the parameters."""
        out = [self.codec.time_request(now_ns)] if self._round_trips.ask(now_ns) else []
        if self.identity.ask(now_ns):
            out.append(self.codec.command(*px4.request_message_parameters(px4.VERSION_MESSAGE_ID)))
        return out + [self.codec.read_parameter(name) for name in self.parameters.due(now_ns)]

    def next_deadline_ns(self) -> int:
        """When `due` next has something to say (monotonic ns)."""
        times = [self._next_heartbeat_ns, *self.requests.deadlines_ns()]
        if self.heartbeat_ns is not None and self._asks_origin:
            times.append(self._next_origin_ns)
        if self.heartbeat_ns is not None and not self.armed:
            times += [self._round_trips.deadline_ns, self.parameters.next_deadline_ns(), self.identity.deadline_ns()]
        return min(times)

    def setpoint(self, setpoint: SafeSetpoint) -> bytes:
        """SET_POSITION_TARGET_LOCAL_NED, in the frame in which `state` has told a position."""
        assert self.frame is not None
        return self.codec.setpoint(
            self.boot.last_boot_ms,
            self.frame.to_local(Ned(0.0, 0.0, setpoint.position_down_m)).down,
            Ned(setpoint.velocity_north_m_s, setpoint.velocity_east_m_s, setpoint.velocity_down_m_s),
            (setpoint.acceleration_north_m_s2, setpoint.acceleration_east_m_s2),
            setpoint.yaw_rad,
        )

    # -- what is known -------------------------------------------------------------------------------------------------

    @property
    def heartbeat_ns(self) -> int | None:
        """When HEARTBEAT last came."""
        return self.requests.heartbeat_ns

    @property
    def mode(self) -> FlightMode:
        """What it does."""
        return MODES.get(self.custom_mode) or FlightMode(self.mode_name)

    @property
    def mode_name(self) -> str:
        """PX4's name of the mode, or its number."""
        return mode_name(self.custom_mode)

    @property
    def acts_by_itself(self) -> bool:
        """Whether CURRENT_MODE tells another mode than the user's."""
        return self.intended_mode is not None and self.intended_mode != self.custom_mode

    @property
    def on_ground(self) -> bool | None:
        """Whether it stands on the ground; None while it does not tell."""
        return None if self.landed_state == 0 else self.landed_state == wire.ON_GROUND

    @property
    def rejected(self) -> dict[str, int]:
        """What was refused and went wrong on the link, by name."""
        return summed(self.codec.rejected, self.counts)

    @property
    def _asks_origin(self) -> bool:
        return self.fleet_origin is not None and (self.origin is None or self._origin_doubted)

    def estimate(self, now: Instant) -> Estimate:
        """ESTIMATOR_STATUS; nothing and infinite once it is old."""
        needed = FLAGS_NEEDED | (GLOBAL_FLAG if self.fleet_origin is not None else RELATIVE_FLAG)
        if not _within(self.estimator_ns, STATUS_S, now):
            return Estimate(0, needed, inf)
        return Estimate(self.estimator.flags, needed, self.estimator.horizontal_accuracy_m)

    def battery(self, now: Instant) -> int:
        """Charge (%); -1 where SYS_STATUS does not tell it, or is old."""
        return self.battery_percent if _within(self.health_ns, STATUS_S, now) else -1

    def position_age_s(self, now: Instant) -> float:
        """Age of the latest position (s); infinite before the first."""
        return inf if self.position_ns is None else (now.monotonic_ns - self.position_ns) * 1e-9

    def heartbeat_age_s(self, now: Instant) -> float | None:
        """Age of the latest heartbeat (s); None before the first."""
        return None if self.heartbeat_ns is None else (now.monotonic_ns - self.heartbeat_ns) * 1e-9

    def state(self, now: Instant) -> tuple[Ned, Ned] | None:
        """Position and velocity now (fleet frame), the latest carried on by its age; None if stale or without frame."""
        if self.position_ns is None or self.frame is None:
            return None
        age_s = (now.monotonic_ns - self.position_ns) * 1e-9
        if age_s > STALE_S:
            return None
        p, v = self.position_ned_m, self.velocity_ned_m_s
        return Ned(p.north + v.north * age_s, p.east + v.east * age_s, p.down + v.down * age_s), v

    def facts(self, now: Instant) -> AutopilotFacts:
        """What preflight judges."""
        settings = self._settings.of(self.parameters.values, self.parameters.missing, self.identity)
        return AutopilotFacts(
            heartbeat_age_s=self.heartbeat_age_s(now),
            foreign_system_id=self.codec.foreign_system_id if _within(self.foreign_ns, HEARTBEAT_S, now) else None,
            identity=identity_checks(self.kind, self.vehicle_type),
            settings=settings if self.kind == px4.AUTOPILOT_PX4 else (),
            estimate=self.estimate(now),
            rc_healthy=bool(self.sensors_health & RC_RECEIVER_FLAG) and _within(self.health_ns, STATUS_S, now),
            origin=self.origin,
            home_altitude_amsl_m=self.home_altitude_amsl_m,
            position_ned_m=None if self.frame is None or self.position_ns is None else self.position_ned_m,
            position_age_s=self.position_age_s(now),
            position_rate_hz=self.boot.heard_hz(now.monotonic_ns),
            battery_percent=self.battery(now),
            round_trip_s=self._round_trips.median_s(now.monotonic_ns, asking=not self.armed),
            # The least delayed of the last messages is nearest to the truth: delay makes the autopilot seem behind.
            clock_ahead_s=max(self._clock_ahead_ns) * 1e-9 if self._clock_ahead_ns else None,
        )


def _within(heard_ns: int | None, limit_s: float, now: Instant) -> bool:
    return heard_ns is not None and now.monotonic_ns - heard_ns <= round(limit_s * 1e9)
