"""What we know of our autopilot and what we have asked of it. Sans-I/O; used by the agent alone.

PX4's quirks that shape it: an answer to a command names only the command, so commands of one kind are asked one after
another; GPS_GLOBAL_ORIGIN comes once after boot and must be requested; LOCAL_POSITION_NED says nothing of its validity;
what a command has done shows in the next HEARTBEAT, which comes once a second.
"""

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from math import dist, inf
from typing import NamedTuple

from companion.core.counts import Counts
from companion.core.events import AutopilotRebooted, Event, OriginMoved, RequestRefused, RequestUnanswered
from companion.core.failsafe import DAMAGE_M, STATUS_S
from companion.core.frames import Geodetic, LocalFrame, Ned
from companion.core.values import ZERO, Instant, SafeSetpoint
from companion.vehicle.preflight import (
    ESTIMATOR_FLAGS_NEEDED,
    ESTIMATOR_GLOBAL_FLAG,
    ESTIMATOR_RELATIVE_FLAG,
    HEARTBEAT_LIMIT_S,
    PARAMETERS,
    POSITION_LIMIT_S,
    AutopilotFacts,
    same_setting,
)
from companion.wire import mavlink as wire
from companion.wire.mavlink import MavlinkCodec, Px4Mode, mode_name

RETRY_S = 0.5
TRIES = 8
ANSWER_S = 1.0
"""what is asked once is taken for not answered after this; preflight allows a link no such round trip"""
EFFECT_S = 0.2
"""a HEARTBEAT this much later than an answer knows of what was answered: PX4 makes the two in different threads"""
PARAMETER_TRIES = 6
PARAMETERS_AT_ONCE = 3
"""requests on the way at a time: a serial line carries the positions too"""
PARAMETER_PERIOD_NS = 5_000_000_000
"""how often all are read anew on the ground, since a ground station may set them"""
ROUND_TRIP_PERIOD_NS = 1_000_000_000
ROUND_TRIP_SAMPLES = 5
ROUND_TRIP_SILENCE_NS = 3_500_000_000
CLOCK_SAMPLES = 5
RATE_WINDOW_NS = 2_000_000_000
LATENCY_WINDOW_NS = 1_000_000_000
"""short, since a simulated autopilot's clock may run several per cent slow: what it falls behind within the window
counts as delay"""
BOOT_MS_ROUND = 1 << 32
BOOT_MS_SLACK = 2_000
"""clocks and links differ by less than this between two positions (ms); no autopilot boots faster and speaks"""
ACCEPTED, TEMPORARILY_REJECTED, IN_PROGRESS = 0, 1, 5


COUNTED = (
    "autopilot reboot", "position repeated", "estimator origin moved", "time answer to nothing asked",
    "answer to nothing asked", "unanswered",
    *(f"refused: {name}" for name in ("stream", "arming", "take-off", "kill", *(mode.name for mode in Px4Mode))),
)  # fmt: skip
"""what a client counts"""


@dataclass(slots=True)
class _Request:
    name: str
    make: Callable[[], bytes]
    once: bool = False
    """whether it may have been done though its answer is lost, and must not be done twice"""
    tries: int = 0
    next_ns: int = 0
    withdrawn: bool = False
    """asked, and wanted no longer: it waits for its answer only"""

    @property
    def given_up(self) -> bool:
        """Whether it is not sent again without an answer."""
        return self.withdrawn or self.tries >= (1 if self.once else TRIES)


class Outcome(NamedTuple):
    """What came of a request that the autopilot has not refused."""

    since_ns: int
    """when it was accepted, or taken for not answered (monotonic)"""
    accepted: bool
    """False: sent once and not answered, so that nobody knows whether it was done"""


@dataclass(slots=True)
class BootClock:
    """The autopilot's boot time on our monotonic clock: the least delayed message of the last seconds tells the offset.

    A message's age beyond that is the delay it met on its way.
    """

    _window: deque[tuple[int, int]] = field(default_factory=deque)
    """(arrival, offset), offsets rising: a monotonic queue, so that the front is the window's minimum"""
    last_boot_ms: int = -1

    def restart(self) -> None:
        """Forget: the autopilot has booted anew."""
        self._window.clear()
        self.last_boot_ms = -1

    def arrived(self, boot_ms: int, monotonic_ns: int) -> int:
        """When the message was made (monotonic ns), given when it arrived."""
        offset = monotonic_ns - boot_ms * 1_000_000
        while self._window and self._window[-1][1] >= offset:
            self._window.pop()
        self._window.append((monotonic_ns, offset))
        while self._window[0][0] < monotonic_ns - LATENCY_WINDOW_NS:
            self._window.popleft()
        self.last_boot_ms = boot_ms
        return boot_ms * 1_000_000 + self._window[0][1]


@dataclass(slots=True)
class ParameterReader:
    """Reads the parameters that preflight looks at, in rounds; one that never comes is missing until it does.

    Of the names of one setting the one that has answered is read on, and the others are not asked for.
    """

    values: dict[str, float | int] = field(default_factory=dict)
    missing: set[str] = field(default_factory=set)
    _open: dict[str, tuple[int, int]] = field(default_factory=lambda: dict.fromkeys(PARAMETERS, (0, 0)))
    """still wanted in this round: (tries so far, when the next is due)"""
    _round_ns: int = 0
    """when the next round begins"""

    def restart(self) -> None:
        """Forget: the autopilot has booted anew."""
        self.values.clear()
        self.missing.clear()
        self._open = dict.fromkeys(PARAMETERS, (0, 0))

    def take(self, name: str, value: float | int) -> None:
        """A value that came, asked for or not."""
        if name in PARAMETERS:
            self.values[name] = value
            for other in same_setting(name):
                self.missing.discard(other)
                self._open.pop(other, None)

    def due(self, now_ns: int) -> list[str]:
        """Names to ask for now."""
        if not self._open and now_ns >= self._round_ns:
            known = self.values.keys()
            wanted = [n for n in PARAMETERS if n in known or known.isdisjoint(same_setting(n))]
            self._open = dict.fromkeys(wanted, (0, 0))
        asked = []
        for name, (tries, next_ns) in list(self._open.items())[:PARAMETERS_AT_ONCE]:
            if now_ns < next_ns:
                continue
            if tries >= PARAMETER_TRIES:
                del self._open[name]
                self.values.pop(name, None)
                self.missing.add(name)
            else:
                self._open[name] = (tries + 1, now_ns + round(RETRY_S * 1e9))
                asked.append(name)
        self._round_ns = now_ns + PARAMETER_PERIOD_NS if self._open else self._round_ns
        return asked

    def next_deadline_ns(self) -> int:
        """When `due` next has something to say (monotonic ns)."""
        waiting = list(self._open.values())[:PARAMETERS_AT_ONCE]
        return min((next_ns for _, next_ns in waiting), default=self._round_ns)


class Heard(NamedTuple):
    """What one datagram brought."""

    autopilot: bool
    """a heartbeat or a position: what proves that it is our autopilot that speaks"""
    position: bool
    """a position newer than the one before"""


NOTHING = Heard(autopilot=False, position=False)


class Px4Autopilot:
    """One autopilot as seen over its link."""

    def __init__(
        self, system_id: int, fleet_origin: Geodetic | None, position_rate_hz: float = wire.POSITION_RATE_HZ
    ) -> None:
        self.link = MavlinkCodec(system_id)
        self.position_rate_hz = position_rate_hz
        self.counts = Counts(COUNTED)
        self.events: list[Event] = []
        """what happened; emptied by the agent"""
        self.fleet_origin = fleet_origin
        self.armed = False
        self.custom_mode = 0
        self.intended_mode: int | None = None
        """what the user chose, as CURRENT_MODE tells: another than custom_mode means a failsafe of the autopilot's"""
        self.autopilot_kind = -1
        self.vehicle_type = -1
        self.landed_state = 0
        self.battery_percent = -1
        self.sensors_health = 0
        self.home_altitude_amsl_m: float | None = None
        self.parameters = ParameterReader()
        self.estimator_flags = 0
        self.horizontal_accuracy_m = inf
        self.estimator_ns: int | None = None
        """when ESTIMATOR_STATUS last came (monotonic ns)"""
        self.health_ns: int | None = None
        """when SYS_STATUS last came (monotonic ns)"""
        self.foreign_ns: int | None = None
        """when an autopilot of another system id last spoke (monotonic ns)"""
        self.origin: Geodetic | None = None
        self.origin_crept_ned_m = ZERO
        """how far the origin has moved so far in steps too small for a jump of the position"""
        self.frame: LocalFrame | None = None if fleet_origin is not None else LocalFrame(ZERO)
        self.boot = BootClock()
        self.heartbeat_ns: int | None = None
        self.position_ns: int | None = None
        """when the latest position was made, on our monotonic clock"""
        self.position_ned_m = ZERO
        """fleet frame"""
        self.velocity_ned_m_s = ZERO
        self._queues: dict[int, deque[_Request]] = {}
        self._refused: dict[str, int] = {}
        """name of a request -> when it may be asked again after a refusal (monotonic ns)"""
        self._outcomes: dict[str, Outcome] = {}
        self._mode_asked: Px4Mode | None = None
        self._now_ns = 0
        self._next_heartbeat_ns = 0
        self._next_origin_ns = 0
        self._arrivals_ns: deque[int] = deque(maxlen=512)
        """of the latest positions"""
        self._round_trips_ns: deque[int] = deque(maxlen=ROUND_TRIP_SAMPLES)
        self._round_trip_asked_ns = 0
        self._round_trips_open_ns: deque[int] = deque(maxlen=8)
        """when what is not answered yet was asked"""
        self._round_trip_heard_ns = 0
        self._clock_ahead_ns: deque[int] = deque(maxlen=CLOCK_SAMPLES)
        self._origin_doubted = False

    def receive(self, datagram: bytes, now: Instant) -> Heard:
        """Take a datagram; returns what it brought."""
        self._now_ns = now.monotonic_ns
        ours = fresh = False
        foreign = self.link.foreign_heard
        messages = self.link.decode(datagram)
        if self.link.foreign_heard > foreign:
            self.foreign_ns = now.monotonic_ns
        for event in messages:
            match event:
                case wire.LocalPosition():
                    ours = True
                    fresh = self._position(event, now) or fresh
                case wire.Heartbeat():
                    ours = True
                    self._heartbeat(event, now)
                case wire.CurrentMode():
                    self.custom_mode = event.custom_mode
                    self.intended_mode = event.intended_custom_mode
                case wire.LandedState():
                    self.landed_state = event.state
                case wire.GlobalOrigin():
                    self._origin(event.origin)
                case wire.EstimatorHealth():
                    self.estimator_ns = now.monotonic_ns
                    self.estimator_flags = event.flags
                    self.horizontal_accuracy_m = event.horizontal_accuracy_m
                case wire.SystemHealth():
                    self.health_ns = now.monotonic_ns
                    self.battery_percent = event.battery_percent
                    self.sensors_health = event.sensors_health
                case wire.HomePosition():
                    self.home_altitude_amsl_m = event.altitude_amsl_m
                case wire.ParameterValue():
                    self.parameters.take(event.name, event.value)
                case wire.TimeAnswer():
                    self._time_answer(event, now)
                case wire.SystemTime():
                    self._clock_ahead_ns.append(event.unix_us * 1000 - now.fleet_ns)
                case wire.CommandAnswer():
                    self._answer(event, now)
        return Heard(ours, fresh)

    def _heartbeat(self, event: wire.Heartbeat, now: Instant) -> None:
        first = self.heartbeat_ns is None
        self.heartbeat_ns = now.monotonic_ns
        self.armed = event.armed
        self.custom_mode = event.custom_mode
        self.autopilot_kind = event.autopilot
        self.vehicle_type = event.vehicle_type
        if first:
            self._set_up()

    def _set_up(self) -> None:
        """Ask for what we read, and for no more: a companion's link may be a serial line."""
        streams = {**wire.STREAMS_HZ, wire.POSITION_MESSAGE_ID: self.position_rate_hz}
        for message_id, rate_hz in streams.items():
            self.ask(f"stream {message_id}", *wire.interval_parameters(message_id, rate_hz))
        for message_id in wire.STREAMS_OFF:
            self.ask(f"stream {message_id}", *wire.interval_parameters(message_id, 0.0))

    def _unwrapped(self, boot_ms: int, now: Instant) -> int:
        """Time since boot whose 32 bit go round every 49.7 days, gone on with.

        A small number after a large one is a reboot, unless it is as much later as time has passed here.
        """
        last = self.boot.last_boot_ms
        if last < 0:
            return boot_ms
        on = last - last % BOOT_MS_ROUND + boot_ms
        passed_ms = (now.monotonic_ns - self._arrivals_ns[-1]) // 1_000_000 if self._arrivals_ns else 0
        later_ms = on + BOOT_MS_ROUND - last
        return on + BOOT_MS_ROUND if on < last - 1000 and later_ms <= passed_ms + BOOT_MS_SLACK else on

    def _position(self, event: wire.LocalPosition, now: Instant) -> bool:
        boot_ms = self._unwrapped(event.boot_ms, now)
        if boot_ms < self.boot.last_boot_ms - 1000:
            self.events.append(AutopilotRebooted())
            self.counts["autopilot reboot"] += 1
            self.boot.restart()
            boot_ms = event.boot_ms
            self.origin = None
            if self.fleet_origin is not None:
                self.frame = None
            self.cancel()
            self.parameters.restart()
            self._round_trips_ns.clear()
            self._clock_ahead_ns.clear()
            self.home_altitude_amsl_m = None
            self._set_up()
        elif boot_ms <= self.boot.last_boot_ms:
            self.counts["position repeated"] += 1
            return False
        made_ns = self.boot.arrived(boot_ms, now.monotonic_ns)
        self._arrivals_ns.append(now.monotonic_ns)
        if self.frame is None:
            return False
        self.position_ns = made_ns
        self.position_ned_m = self.frame.to_fleet(event.position_local_ned_m)
        self.velocity_ned_m_s = event.velocity_ned_m_s
        return True

    def doubt_origin(self) -> None:
        """Ask for the estimator's origin again, since a position jumped."""
        self._origin_doubted = True

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

    def _time_answer(self, event: wire.TimeAnswer, now: Instant) -> None:
        if event.asked_ns not in self._round_trips_open_ns:
            self.counts["time answer to nothing asked"] += 1
            return
        self._round_trips_open_ns.remove(event.asked_ns)
        self._round_trip_heard_ns = now.monotonic_ns
        self._round_trips_ns.append(now.monotonic_ns - event.asked_ns)

    def _answer(self, event: wire.CommandAnswer, now: Instant) -> None:
        queue = self._queues.get(event.command)
        if event.command == wire.REQUEST_MESSAGE:
            return  # asked for again until the message itself comes
        if not queue or queue[0].tries == 0:
            self.counts["answer to nothing asked"] += 1
            return
        request = queue[0]
        if request.withdrawn:
            queue.popleft()
            return
        if request.once and event.result == TEMPORARILY_REJECTED:
            # It was certainly not done, and may be asked anew.
            queue.popleft()
            self._refused[request.name] = now.monotonic_ns + round(RETRY_S * 1e9)
            return
        if event.result in (TEMPORARILY_REJECTED, IN_PROGRESS) and (request.once or request.tries < TRIES):
            request.next_ns = now.monotonic_ns + round((ANSWER_S if request.once else RETRY_S) * 1e9)
            return
        queue.popleft()
        if event.result == ACCEPTED:
            self._outcomes[request.name] = Outcome(now.monotonic_ns, accepted=True)
        else:
            self._refused[request.name] = now.monotonic_ns + round(RETRY_S * 1e9)
            self.counts[f"refused: {request.name.split()[0]}"] += 1
            if not request.name.startswith("stream"):
                self.events.append(RequestRefused(request.name, event.result))

    def ask(self, name: str, command: int, *parameters: float, once: bool = False) -> None:
        """Ask for a command, retried until answered.

        The same name is not queued twice, nor right after a refusal, nor, once accepted, before a heartbeat could have
        shown what came of it. `once`: it is sent a single time, unless the answer says that it was not done.
        """
        if self._now_ns < self._refused.get(name, 0) or self._effect_is_open(name):
            return
        queue = self._queues.setdefault(command, deque())
        if all(r.name != name for r in queue):
            queue.append(_Request(name, lambda: self.link.command(command, *parameters), once))

    def outcome(self, name: str) -> Outcome | None:
        """What came of a request, once a heartbeat has come that knows of it; None before, and where it was refused."""
        return None if self._effect_is_open(name) else self._outcomes.get(name)

    def _effect_is_open(self, name: str) -> bool:
        """Whether a request was accepted, or may have been, and no heartbeat that knows of it has come yet."""
        outcome = self._outcomes.get(name)
        if outcome is None or self.heartbeat_ns is None:
            return outcome is not None
        return self.heartbeat_ns < outcome.since_ns + (round(EFFECT_S * 1e9) if outcome.accepted else 0)

    def set_mode(self, mode: Px4Mode) -> None:
        """Ask for a flight mode; one asked for before is forgotten."""
        command, *parameters = wire.mode_parameters(mode)
        if self._mode_asked is not None and self._mode_asked is not mode:
            self._queues[command].clear()
            self._outcomes.pop(self._mode_asked.name, None)
        self._mode_asked = mode
        self.ask(mode.name, command, *parameters)

    def withdraw(self, *names: str) -> None:
        """Ask no more for what is wanted no longer, or was seen to be done though its answer was lost."""
        for name in names:
            self._outcomes.pop(name, None)
        for queue in self._queues.values():
            for request in [r for r in queue if r.name in names]:
                if request.tries == 0:
                    queue.remove(request)
                else:
                    request.withdrawn = True

    def cancel(self) -> None:
        """Ask for nothing more: the vehicle is somebody else's now."""
        self._queues.clear()
        self._outcomes.clear()
        self._mode_asked = None

    def due(self, now: Instant) -> list[bytes]:
        """Datagrams to send now: heartbeat at 1 Hz, requests with their retries."""
        self._now_ns = now.monotonic_ns
        out = []
        if now.monotonic_ns >= self._next_heartbeat_ns:
            out.append(self.link.heartbeat())
            self._next_heartbeat_ns = now.monotonic_ns + 1_000_000_000
        if self.heartbeat_ns is None:
            return out
        if self._asks_origin and now.monotonic_ns >= self._next_origin_ns:
            self._next_origin_ns = now.monotonic_ns + 1_000_000_000
            out.append(self.link.command(*wire.request_message_parameters(wire.ORIGIN_MESSAGE_ID)))
        for queue in self._queues.values():
            while queue and queue[0].given_up and now.monotonic_ns >= queue[0].next_ns:
                request = queue.popleft()
                if not request.withdrawn:
                    if request.once:
                        self._outcomes[request.name] = Outcome(now.monotonic_ns, accepted=False)
                    self.counts["unanswered"] += 1
                    self.events.append(RequestUnanswered(request.name))
            if queue and now.monotonic_ns >= queue[0].next_ns:
                queue[0].tries += 1
                queue[0].next_ns = now.monotonic_ns + round((ANSWER_S if queue[0].once else RETRY_S) * 1e9)
                out.append(queue[0].make())
        if not self.armed:
            out += self._preflight_due(now.monotonic_ns)
        return out

    def _preflight_due(self, now_ns: int) -> list[bytes]:
        """On the ground: the link's round trip once a second, and the parameters."""
        out = []
        if now_ns >= self._round_trip_asked_ns + ROUND_TRIP_PERIOD_NS:
            self._round_trip_asked_ns = now_ns
            self._round_trips_open_ns.append(now_ns)
            out.append(self.link.time_request(now_ns))
        return out + [self.link.read_parameter(name) for name in self.parameters.due(now_ns)]

    def next_deadline_ns(self) -> int:
        """When `due` next has something to say (monotonic ns)."""
        times = [self._next_heartbeat_ns]
        times += [queue[0].next_ns for queue in self._queues.values() if queue]
        if self.heartbeat_ns is not None and self._asks_origin:
            times.append(self._next_origin_ns)
        if self.heartbeat_ns is not None and not self.armed:
            times += [self._round_trip_asked_ns + ROUND_TRIP_PERIOD_NS, self.parameters.next_deadline_ns()]
        return min(times)

    def setpoint(self, setpoint: SafeSetpoint) -> bytes:
        """The datagram that has the autopilot fly a setpoint; once `state` has told one, the frame is known."""
        assert self.frame is not None
        s = setpoint
        return self.link.setpoint(
            self.boot.last_boot_ms,
            self.frame.to_local(Ned(0.0, 0.0, s.position_down_m)).down,
            Ned(s.velocity_north_m_s, s.velocity_east_m_s, s.velocity_down_m_s),
            (s.acceleration_north_m_s2, s.acceleration_east_m_s2),
            s.yaw_rad,
        )

    @property
    def mode_name(self) -> str:
        """The flight mode, for people."""
        return mode_name(self.custom_mode)

    @property
    def rejected(self) -> Counter[str]:
        """What was refused and went wrong on the link, by name."""
        return self.link.rejected + self.counts

    @property
    def _asks_origin(self) -> bool:
        return self.fleet_origin is not None and (self.origin is None or self._origin_doubted)

    @property
    def flags_needed(self) -> int:
        """ESTIMATOR_STATUS flags without which nobody flies in this frame."""
        return ESTIMATOR_FLAGS_NEEDED | (
            ESTIMATOR_GLOBAL_FLAG if self.fleet_origin is not None else ESTIMATOR_RELATIVE_FLAG
        )

    def estimator(self, now: Instant) -> tuple[int, float]:
        """ESTIMATOR_STATUS's flags and horizontal accuracy (m); none and infinite once it is old."""
        if not _within(self.estimator_ns, STATUS_S, now):
            return 0, inf
        return self.estimator_flags, self.horizontal_accuracy_m

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
        if age_s > POSITION_LIMIT_S:
            return None
        p, v = self.position_ned_m, self.velocity_ned_m_s
        return Ned(p.north + v.north * age_s, p.east + v.east * age_s, p.down + v.down * age_s), v

    def round_trip_s(self, now: Instant) -> float | None:
        """Median of the last round trips; None without an answer of late, where one is asked for."""
        if not self._round_trips_ns:
            return None
        if not self.armed and now.monotonic_ns - self._round_trip_heard_ns > ROUND_TRIP_SILENCE_NS:
            return None
        return sorted(self._round_trips_ns)[len(self._round_trips_ns) // 2] * 1e-9

    def positions_heard_hz(self, now: Instant) -> float:
        """Positions a second over the last two."""
        since_ns = now.monotonic_ns - RATE_WINDOW_NS
        return sum(t > since_ns for t in self._arrivals_ns) / (RATE_WINDOW_NS * 1e-9)

    def facts(self, now: Instant) -> AutopilotFacts:
        """What preflight looks at."""
        flags, accuracy_m = self.estimator(now)
        return AutopilotFacts(
            heartbeat_age_s=self.heartbeat_age_s(now),
            foreign_system_id=self.link.foreign_system_id if _within(self.foreign_ns, HEARTBEAT_LIMIT_S, now) else None,
            autopilot_kind=self.autopilot_kind,
            vehicle_type=self.vehicle_type,
            estimator_flags=flags,
            sensors_health=self.sensors_health if _within(self.health_ns, STATUS_S, now) else 0,
            horizontal_accuracy_m=accuracy_m,
            origin=self.origin,
            home_altitude_amsl_m=self.home_altitude_amsl_m,
            position_ned_m=None if self.frame is None or self.position_ns is None else self.position_ned_m,
            position_age_s=self.position_age_s(now),
            position_rate_hz=self.positions_heard_hz(now),
            battery_percent=self.battery(now),
            round_trip_s=self.round_trip_s(now),
            # The least delayed of the last messages is nearest to the truth: delay makes the autopilot seem behind.
            clock_ahead_s=max(self._clock_ahead_ns) * 1e-9 if self._clock_ahead_ns else None,
            parameters=self.parameters.values,
            missing=frozenset(self.parameters.missing),
        )


def _within(heard_ns: int | None, limit_s: float, now: Instant) -> bool:
    return heard_ns is not None and now.monotonic_ns - heard_ns <= round(limit_s * 1e9)
