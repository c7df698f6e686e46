"""One vehicle's flight: it leads the autopilot from phase to phase, and does what the table of failsafes says.

No I/O and no peers' bytes: `agent` asks it at each control tick where to be (`follow`), whether to steer (`steers`),
and passes the operator's commands on. Phases are `core.phase`'s, failsafes `core.failsafe`'s.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import dist, hypot

from companion.config import FleetConfig
from companion.core.counts import Counts
from companion.core.events import (
    Event,
    FailsafeActed,
    FailsafeNoted,
    KillCause,
    KillCommanded,
    Killed,
    KillGivenUp,
    NoWayBack,
    PhaseChanged,
    ResumeGivenUp,
)
from companion.core.failsafe import (
    BATTERY_S,
    CLIMB_S,
    CREEP_LIMIT_M,
    FAILSAFES,
    FROZEN_S,
    HEARTBEAT_S,
    JUMPS_S,
    LISTEN_S,
    LOST_S,
    TAKE_OFF_S,
    UNCERTAIN_S,
    Action,
    Failsafe,
)
from companion.core.frames import Ned
from companion.core.health import Debounce, PositionWatch
from companion.core.neighbours import PeerTable
from companion.core.phase import PhaseEvent, next_phase
from companion.core.rejoin import RejoinTrajectory
from companion.core.trajectory.fleet import Reference
from companion.core.trajectory.history import TrajectoryHistory
from companion.core.values import (
    FILTERED_PHASES,
    FLYING_PHASES,
    FORMATION_PHASES,
    SETTLED_PHASES,
    ZERO,
    Instant,
    Phase,
    VehicleState,
)
from companion.vehicle.autopilot.px4 import Px4Autopilot
from companion.vehicle.preflight import ACCURACY_LIMIT_M
from companion.wire import mavlink as wire
from companion.wire.mavlink import Px4Mode

SETTLED_TOLERANCE_M = 0.6
SETTLED_FOR_NS = 1_000_000_000
RETURNED_LIMIT_NS = 15_000_000_000
"""whoever is not over its pad so long after the way back has ended lands where it is"""
ALTITUDE_TOLERANCE_M = 0.4
HOLD_MARGIN_M = 1.0
"""hold mode this far below the take-off's altitude is the pilot's doing, not the take-off's end"""
OUR_MODES = frozenset({Px4Mode.AUTO_TAKEOFF, Px4Mode.AUTO_LOITER, Px4Mode.OFFBOARD})
"""modes in which a vehicle may be while we fly it, but for landing"""
STREAM_BEFORE_NS = 200_000_000
"""setpoints are streamed so long before OFFBOARD is asked for"""
STOPPED_LOW_S = FROZEN_S + 0.1
"""a climb that ended too low by positions that may have frozen meanwhile, which shows after FROZEN_S"""
SLOT_JUMP_M = 1.0
"""a slot that is suddenly so far from where it was is not followed there at once"""
ENGAGED_AWAY_M = 3.0
"""whoever engages so far from its slot comes to it by a way of its own"""
RESUME_LIMIT_NS = 5_000_000_000
RELEASE_LIMIT_NS = 4_000_000_000
LATE_MODE_NS = 1_000_000_000
"""a mode that was asked for and is wanted no longer may come so late"""
LATE_MODES = frozenset({Px4Mode.OFFBOARD, Px4Mode.AUTO_TAKEOFF})
KILL_LIMIT_NS = 10_000_000_000
FALL_M_S = 4.0
"""no autopilot sinks so fast on its own motors (PX4's limits of descent end there): who does falls"""
FALL_NS = 10_000_000_000
"""a fall so shortly before or after the motors were seen to stop has to do with it"""
LANDED_STATE_UNKNOWN, ON_GROUND = 0, 1
BEING_KILLED = "it is being killed"


@dataclass(slots=True)
class _Orders:
    """What was commanded and is not done yet; each with its time (monotonic ns)."""

    resume_ns: int | None = None
    release_ns: int | None = None
    modes_to_leave: frozenset[int] = frozenset()
    """for hold mode, since the release or the end of a resume; whoever chooses another mode has the vehicle"""
    kill_ns: int | None = None
    kill_armed: bool = False
    """whether there were motors to stop"""

    @property
    def none_open(self) -> bool:
        """Whether nothing more is asked of the autopilot for a command."""
        return self.resume_ns is None and self.release_ns is None and self.kill_ns is None


@dataclass(slots=True)
class Supervisor:
    """Phase, failsafes and what is asked of the autopilot."""

    config: FleetConfig
    vehicle_id: int
    autopilot: Px4Autopilot
    history: TrajectoryHistory
    peers: PeerTable
    restart_filter: Callable[[], None]
    """the safety filter forgets what was flown before"""
    phase: Phase = Phase.IDLE
    failsafes: list[str] = field(default_factory=list)
    counts: Counts = field(default_factory=lambda: Counts(failsafe.value for failsafe in Failsafe))
    events: list[Event] = field(default_factory=list)
    """what happened; emptied by the agent"""
    killed: KillCause | None = None
    """how the motors were stopped before the vehicle had landed, since the last take-off command"""
    return_wanted: bool = False
    """a failsafe of this vehicle wants the whole fleet back over its pads"""
    forms_without: bool = False
    """the wait for the others is over, and those that are up form without them"""
    outdated: bool = False
    """a peer holds a newer motion than we do"""
    formation_since_ns: int | None = None
    phase_since_ns: int = 0
    begun: int = 0
    """flights so far: take-offs commanded and resumptions"""
    positions: PositionWatch = field(init=False)
    _orders: _Orders = field(default_factory=_Orders)
    _fell_ns: int | None = None
    _disarmed_ns: int | None = None
    """when a flight of ours, or of the pilot's after us, was seen to be over"""
    _mode_before: int | None = None
    """custom_mode at arming, until the take-off: the vehicle may stay in it"""
    _unpositioned: bool = False
    _unpositioned_since_ns: int = 0
    _mode_asked_ns: int = 0
    _land_seen: bool = False
    _settled_since_ns: int | None = None
    _settled_blend_ns: int | None = None
    """start of the change of formation whose end this vehicle has settled in"""
    _own: RejoinTrajectory = field(default_factory=lambda: RejoinTrajectory(ZERO))
    _apart_since_ns: int = 0
    _listens_until_ns: int = 0
    _alone_since_ns: int | None = None
    _jumps: int = 0
    _first_jump_ns: int | None = None
    _origin_crept_ned_m: Ned = ZERO
    """of the autopilot, when it was last engaged"""
    _last_jump_ns: int = 0
    _engages: bool = False
    _slot: tuple[int, Reference] | None = None
    _reference: Reference | None = None
    _uncertain: Debounce = field(default_factory=lambda: Debounce(UNCERTAIN_S))
    _low: Debounce = field(default_factory=lambda: Debounce(BATTERY_S))
    _critical: Debounce = field(default_factory=lambda: Debounce(BATTERY_S))
    _stopped_low: Debounce = field(default_factory=lambda: Debounce(STOPPED_LOW_S))
    _low_told: bool = False
    _battery_known: bool = False

    def __post_init__(self) -> None:
        limits = self.config.limits
        self.positions = PositionWatch.for_noise(limits.position_noise_m, limits.velocity_noise_m_s)

    # -- what others ask -----------------------------------------------------------------------------------------------

    @property
    def stopped(self) -> bool:
        """Whether nothing hangs in the air on this process."""
        landing = self.phase is Phase.LANDING and self._land_seen
        return self._orders.none_open and (self.phase not in FLYING_PHASES or landing)

    @property
    def steers(self) -> bool:
        """Whether setpoints are streamed: in formation, before it to be let into OFFBOARD, and until landing begins."""
        return (
            self.phase in FILTERED_PHASES
            or (self.phase is Phase.CLIMBING and self._mode_asked_ns > 0)
            or (self.phase is Phase.LANDING and not self._land_seen and self.autopilot.custom_mode == Px4Mode.OFFBOARD)
            or self._orders.resume_ns is not None
        )

    @property
    def detached(self) -> bool:
        """Whether it flies by itself: the formation does not draw it."""
        return self.phase is Phase.DETACHED or self._orders.resume_ns is not None

    # -- what others tell ----------------------------------------------------------------------------------------------

    def position_came(self) -> bool:
        """The autopilot has told a new position; whether it is a jump."""
        ap = self.autopilot
        assert ap.position_ns is not None
        return self.positions.see(ap.position_ns, ap.position_ned_m, ap.velocity_ned_m_s)

    def state(self, now: Instant) -> tuple[Ned, Ned] | None:
        """Position and velocity to steer by (fleet frame); None while there are none to trust."""
        return None if self.positions.frozen else self.autopilot.state(now)

    def heard_order(self, newer: bool) -> None:
        """A peer has told which motion it holds: `newer` than the own newest, or not."""
        self.outdated = newer

    def return_is_over(self) -> None:
        """The fleet flies something else after a way back: no failsafe of before wants it any more."""
        self.return_wanted = False

    # -- the operator's commands: each returns why it is refused, or None ----------------------------------------------

    def take_off(self, now: Instant) -> str | None:
        """Arm and climb."""
        if self._orders.kill_ns is not None:
            return BEING_KILLED
        self._orders.release_ns = None
        self.autopilot.withdraw(Px4Mode.AUTO_LOITER.name)
        self._happened(PhaseEvent.TAKE_OFF, now)
        return None

    def land(self, now: Instant) -> str | None:
        """Land where the vehicle is."""
        self._end_resume(now)
        self._happened(PhaseEvent.LAND, now)
        flies = self.autopilot.armed and self._in_the_air
        if self.phase is Phase.IDLE and flies:
            return "it flies without this companion: resume first, or take it over"
        if self.phase is Phase.RELEASED or (self.phase is not Phase.LANDING and flies):
            return "the pilot has the vehicle"
        return None

    def release(self, now: Instant) -> str | None:
        """Give the vehicle to the pilot: no setpoint any more, the autopilot in its hold mode."""
        self._end_resume(now)
        ours = self.phase in FLYING_PHASES
        self._happened(PhaseEvent.GIVEN_AWAY, now)
        if ours:
            self._hold_mode_after({self.autopilot.custom_mode, Px4Mode.OFFBOARD}, now)
        return None

    def kill(self, now: Instant) -> str | None:
        """Stop the motors at once, wherever the vehicle is."""
        self._orders.resume_ns = self._orders.release_ns = None
        self._happened(PhaseEvent.GIVEN_AWAY, now)
        self.autopilot.cancel()
        self.autopilot.ask("kill", *wire.kill_parameters())
        self._orders.kill_ns, self._orders.kill_armed = now.monotonic_ns, self.autopilot.armed
        self.events.append(KillCommanded())
        return None

    def resume(self, now: Instant) -> str | None:
        """Steer again a vehicle that was released, or that this companion found in the air."""
        if self._orders.kill_ns is not None:
            return BEING_KILLED
        if self.phase in FILTERED_PHASES or self._orders.resume_ns is not None:
            return None
        if not self.autopilot.armed:
            return "it is not armed"
        if next_phase(self.phase, PhaseEvent.RESUMED) is self.phase:
            return f"it is {self.phase.name.lower()}: to resume is for the released, and for those found in the air"
        if not self._in_the_air:
            return "it is on the ground"
        if self.autopilot.landed_state == LANDED_STATE_UNKNOWN:
            return "its autopilot does not tell whether it is in the air"
        if self.state(now) is None:
            return "no position"
        self._orders.release_ns = None
        self._orders.resume_ns = now.monotonic_ns
        self.restart_filter()
        return None

    def _end_resume(self, now: Instant) -> None:
        """Nothing is to be resumed any more; OFFBOARD that comes all the same is left for hold mode."""
        if self._orders.resume_ns is not None:
            self._orders.resume_ns = None
            self.autopilot.withdraw(Px4Mode.OFFBOARD.name)
            self._hold_mode_after({Px4Mode.OFFBOARD}, now)

    def _hold_mode_after(self, modes: set[int], now: Instant) -> None:
        self._orders.release_ns = now.monotonic_ns
        self._orders.modes_to_leave = frozenset(modes - {Px4Mode.AUTO_LOITER})

    @property
    def _in_the_air(self) -> bool:
        return self.autopilot.landed_state != ON_GROUND

    # -- phases and failsafes ------------------------------------------------------------------------------------------

    def _happened(self, event: PhaseEvent, now: Instant) -> None:
        before, after = self.phase, next_phase(self.phase, event)
        if after is before:
            return
        ap = self.autopilot
        self.events.append(PhaseChanged(before, after, event))
        if event is PhaseEvent.DISARMED:
            self._disarmed_ns = now.monotonic_ns
        elif event is PhaseEvent.TAKE_OFF:
            self.killed = self._fell_ns = self._disarmed_ns = None
        self.phase = after
        self.phase_since_ns = now.monotonic_ns
        self.begun += event in (PhaseEvent.TAKE_OFF, PhaseEvent.RESUMED)
        if after is Phase.ARMED:
            self._mode_before = ap.custom_mode
        elif before is not Phase.ARMED:
            self._mode_before = None
        self._settled_since_ns = None
        self._mode_asked_ns = 0
        # A retry of what has happened would happen again: over the pilot's head, at worst.
        ap.withdraw("arming", "take-off", Px4Mode.OFFBOARD.name)
        if event in (PhaseEvent.ENGAGED, PhaseEvent.RESUMED):
            self.restart_filter()
            self.formation_since_ns = now.fleet_ns
            self._engages = event is PhaseEvent.ENGAGED
            self._alone_since_ns = self._first_jump_ns = None
            self._origin_crept_ned_m = ap.origin_crept_ned_m
        if after is Phase.LANDING:
            self._land_seen = False
        if after is Phase.RELEASED:
            ap.cancel()
        if after not in FLYING_PHASES:
            self.return_wanted = self.forms_without = self._low_told = False

    def _fail(self, what: Failsafe, now: Instant, detail: str = "", action: Action | None = None) -> None:
        """Do what the table says, or what the configuration has chosen among the row's ways."""
        chosen = FAILSAFES[what].action if action is None else action
        acted = FailsafeActed(what, chosen, detail)
        self.failsafes.append(acted.sentence)
        self.events.append(acted)
        match chosen:
            case Action.LAND:
                self._happened(PhaseEvent.LAND, now)
            case Action.HAND_OVER:
                self._happened(PhaseEvent.TAKEN_OVER, now)
            case Action.LEAVE_FORMATION:
                self._stand(now, LISTEN_S)
            case Action.RETURN:
                self.return_wanted = True

    def _note(self, what: Failsafe, detail: str) -> None:
        """Say and count what calls for no action."""
        self.counts[what.value] += 1
        self.events.append(FailsafeNoted(what, detail))

    def _stand(self, now: Instant, listen_s: float) -> None:
        """Stand by itself where the vehicle is; it comes back after listening so long."""
        self._own = RejoinTrajectory(self.autopilot.position_ned_m)
        self._apart_since_ns = now.monotonic_ns
        self._listens_until_ns = now.monotonic_ns + round(listen_s * 1e9)
        self._happened(PhaseEvent.STRAYED, now)

    def _taken_over(self, now: Instant) -> None:
        ap = self.autopilot
        by_itself = ap.intended_mode is not None and ap.intended_mode != ap.custom_mode
        self._fail(Failsafe.AUTOPILOT if by_itself else Failsafe.PILOT, now, ap.mode_name)

    # -- at each control tick ------------------------------------------------------------------------------------------

    def watch(self, now: Instant, positioned: bool) -> None:
        """Lead the autopilot through the flight, and notice when something fails."""
        ap = self.autopilot
        self._watch_orders(now)
        self._watch_fall(now)
        if self.positions.jumps != self._jumps and (self.phase not in FLYING_PHASES or ap.landed_state == ON_GROUND):
            # PX4's estimator resets on the ground too, seconds before arming: there is nothing to hold yet.
            self._jumps = self.positions.jumps
            ap.doubt_origin()
        silent = ap.heartbeat_ns is not None and now.monotonic_ns - ap.heartbeat_ns > HEARTBEAT_S * 1e9
        if silent and self.phase in FLYING_PHASES:
            # In whatever phase: a landing of which nobody tells the end would last for ever.
            self._fail(Failsafe.HEARTBEAT, now)
            return
        self._watch_battery_status(now)
        match self.phase:
            case Phase.PREFLIGHT:
                self._watch_arming(now)
            case Phase.ARMED:
                self._watch_take_off(now)
            case Phase.CLIMBING:
                self._watch_climb(now, positioned)
            case Phase.LANDING:
                self._watch_landing(now)
            case Phase.RELEASED if not ap.armed:
                self._happened(PhaseEvent.DISARMED, now)
            case phase if phase in FILTERED_PHASES:
                self._watch_flight(now, positioned)

    def _watch_fall(self, now: Instant) -> None:
        """Notice motors that stopped in the air: whoever does it disarms a vehicle that falls."""
        if self.autopilot.velocity_ned_m_s.down > FALL_M_S:
            self._fell_ns = now.monotonic_ns
        fell, disarmed = self._fell_ns, self._disarmed_ns
        if fell is not None and disarmed is not None and abs(fell - disarmed) <= FALL_NS:
            self._note_killed(KillCause.FELL)

    def _note_killed(self, cause: KillCause) -> None:
        if self.killed is None:
            self.killed = cause
            self.events.append(Killed(cause))

    def _watch_orders(self, now: Instant) -> None:
        ap, orders = self.autopilot, self._orders
        if orders.kill_ns is not None:
            # What was believed before the kill may be a heartbeat old.
            stopped = not ap.armed and ap.heartbeat_ns is not None and ap.heartbeat_ns > orders.kill_ns
            if stopped or now.monotonic_ns - orders.kill_ns > KILL_LIMIT_NS:
                if stopped and orders.kill_armed:
                    self._note_killed(KillCause.COMMAND)
                # A retry would stop the motors of a later flight.
                ap.withdraw("kill")
                orders.kill_ns = None
                if ap.armed:
                    self.events.append(KillGivenUp())
            else:
                ap.ask("kill", *wire.kill_parameters())
        if orders.release_ns is not None:
            left = ap.custom_mode not in orders.modes_to_leave
            if now.monotonic_ns - orders.release_ns > (LATE_MODE_NS if left else RELEASE_LIMIT_NS):
                orders.release_ns = None
                ap.withdraw(Px4Mode.AUTO_LOITER.name)
            elif left:
                orders.modes_to_leave &= LATE_MODES
                ap.withdraw(Px4Mode.AUTO_LOITER.name)
            else:
                ap.set_mode(Px4Mode.AUTO_LOITER)
        if orders.resume_ns is not None:
            waited_ns = now.monotonic_ns - orders.resume_ns
            if not ap.armed or waited_ns > RESUME_LIMIT_NS:
                self._end_resume(now)
                self.events.append(ResumeGivenUp(ap.mode_name))
            elif ap.custom_mode == Px4Mode.OFFBOARD:
                orders.resume_ns = None
                self._happened(PhaseEvent.RESUMED, now)
                self._stand(now, LISTEN_S)
            elif waited_ns > STREAM_BEFORE_NS:
                ap.set_mode(Px4Mode.OFFBOARD)

    def _watch_arming(self, now: Instant) -> None:
        ap = self.autopilot
        if ap.armed:
            self._happened(PhaseEvent.ARMED, now)
        elif now.monotonic_ns - self.phase_since_ns > TAKE_OFF_S * 1e9:
            self._fail(Failsafe.NOT_ARMED, now, "take-off given up")
            self._happened(PhaseEvent.GIVEN_UP, now)
        elif ap.custom_mode == Px4Mode.OFFBOARD:
            # Left over from a flight before; without setpoints PX4 does not arm in it.
            ap.set_mode(Px4Mode.AUTO_LOITER)
        elif (outcome := ap.outcome("arming")) is not None:
            # Whoever disarms has the last word; an arming that was not answered may have been done, and undone by him.
            what = "disarmed again after it was armed" if outcome.accepted else "the arming was not answered"
            self._fail(Failsafe.NOT_ARMED, now, f"{what}; the take-off is given up")
            self._happened(PhaseEvent.GIVEN_UP, now)
        else:
            ap.ask("arming", *wire.arm_parameters(True), once=True)

    def _disarmed_early(self, now: Instant) -> None:
        """A take-off that its pilot has ended by disarming; take-off mode would take off whoever arms next."""
        self._happened(PhaseEvent.DISARMED, now)
        self._hold_mode_after({Px4Mode.AUTO_TAKEOFF}, now)

    def _watch_take_off(self, now: Instant) -> None:
        ap = self.autopilot
        if not ap.armed:
            self._disarmed_early(now)
        elif ap.custom_mode == Px4Mode.AUTO_TAKEOFF:
            self._happened(PhaseEvent.TAKING_OFF, now)
        elif ap.custom_mode not in OUR_MODES and ap.custom_mode != self._mode_before:
            self._taken_over(now)
        elif now.monotonic_ns - self.phase_since_ns > TAKE_OFF_S * 1e9:
            self._fail(Failsafe.NO_TAKE_OFF, now)
        else:
            altitude = self.config.origin.altitude_amsl_m + self.config.formation.altitude_m
            if self.config.fleet.frame == "local":
                altitude = float("nan")
            ap.ask("take-off", *wire.takeoff_parameters(altitude))

    def _watch_climb(self, now: Instant, positioned: bool) -> None:
        ap = self.autopilot
        if not ap.armed:
            self._disarmed_early(now)
            return
        if ap.custom_mode == Px4Mode.OFFBOARD:
            self._happened(PhaseEvent.ENGAGED, now)
            return
        if ap.custom_mode not in (Px4Mode.AUTO_TAKEOFF, Px4Mode.AUTO_LOITER):
            self._taken_over(now)
            return
        height = self.config.formation.altitude_m
        loiters = ap.custom_mode == Px4Mode.AUTO_LOITER
        low = self.config.fleet.frame == "global" and -ap.position_ned_m.down < height - HOLD_MARGIN_M
        stopped = positioned and loiters and low and not self._mode_asked_ns
        if self._stopped_low.holds(stopped, now.monotonic_ns):
            self._taken_over(now)
            return
        reached = -ap.position_ned_m.down > height - ALTITUDE_TOLERANCE_M
        if positioned and not stopped and (self._mode_asked_ns or reached or loiters):
            if not self._mode_asked_ns:
                self._mode_asked_ns = now.monotonic_ns
                self.restart_filter()
            elif now.monotonic_ns - self._mode_asked_ns > STREAM_BEFORE_NS:
                ap.set_mode(Px4Mode.OFFBOARD)
        if self._critical.holds(self._battery_below(self.config.failsafe.battery_critical_percent), now.monotonic_ns):
            self._fail(Failsafe.BATTERY_CRITICAL, now, f"{ap.battery_percent} %")
        elif now.monotonic_ns - self.phase_since_ns > CLIMB_S * 1e9:
            self._fail(Failsafe.ALTITUDE, now)

    def _watch_landing(self, now: Instant) -> None:
        ap = self.autopilot
        if not ap.armed:
            self._happened(PhaseEvent.DISARMED, now)
        elif ap.custom_mode == Px4Mode.AUTO_LAND:
            self._land_seen = True
        elif self._land_seen:
            # On disarming PX4 falls back to the mode before, which the heartbeat tells a second later.
            fell_back = ap.landed_state == ON_GROUND or ap.custom_mode in (Px4Mode.OFFBOARD, self._mode_before)
            if not fell_back:
                self._taken_over(now)
        elif ap.custom_mode not in OUR_MODES and ap.custom_mode != self._mode_before:
            self._taken_over(now)
        else:
            ap.set_mode(Px4Mode.AUTO_LAND)

    def _watch_flight(self, now: Instant, positioned: bool) -> None:
        ap = self.autopilot
        if not ap.armed:
            self._happened(PhaseEvent.DISARMED, now)
            return
        if ap.custom_mode != Px4Mode.OFFBOARD:
            self._taken_over(now)
            return
        if not self._watch_position(now, positioned) or self._watch_battery(now):
            return
        motion = self.history.at(now.fleet_ns)
        lands = motion.then == "land" and not motion.returns
        if lands and motion.end_ns is not None and now.fleet_ns >= motion.end_ns:
            self._happened(PhaseEvent.LAND, now)
            return
        if self._watch_peers(now):
            return
        self._watch_motion(now)

    def _watch_position(self, now: Instant, positioned: bool) -> bool:
        """Whether the own position is there to steer by."""
        ap = self.autopilot
        if not positioned and not self._unpositioned:
            # No failsafe of ours: positions may come again before the autopilot's own acts, and if it acts, it leaves
            # OFFBOARD, which is one.
            what = Failsafe.POSITION_FROZEN if self.positions.frozen else Failsafe.POSITION_STALE
            self._note(what, "no setpoints")
            self._unpositioned_since_ns = now.monotonic_ns
        self._unpositioned = not positioned
        if not positioned:
            lost = ap.position_age_s(now) > LOST_S
            frozen_ns = now.monotonic_ns - self._unpositioned_since_ns
            if lost or frozen_ns > (LOST_S - FROZEN_S) * 1e9:
                # By now the autopilot's own failsafe has the vehicle, whether or not we can hear it.
                self._fail(Failsafe.POSITION_LOST, now)
            return False
        flags, accuracy_m = ap.estimator(now)
        uncertain = not (flags & ap.flags_needed == ap.flags_needed and accuracy_m <= ACCURACY_LIMIT_M)
        if self._uncertain.holds(uncertain, now.monotonic_ns):
            self._fail(Failsafe.COVARIANCE, now, f"{accuracy_m:.1f} m, flags {flags:#x}")
            return False
        crept_m = dist(ap.origin_crept_ned_m, self._origin_crept_ned_m)
        if crept_m > CREEP_LIMIT_M:
            self._fail(Failsafe.COVARIANCE, now, f"estimator's origin has crept {crept_m:.1f} m")
            return False
        if self.positions.jumps != self._jumps:
            self._jump(now)
        return self.phase in FILTERED_PHASES

    def _jump(self, now: Instant) -> None:
        self._jumps = self.positions.jumps
        recent = now.monotonic_ns - self._last_jump_ns < LISTEN_S * 1e9
        self._last_jump_ns = now.monotonic_ns
        self.counts[Failsafe.POSITION_JUMPED.value] += 1
        self.autopilot.doubt_origin()
        self.restart_filter()
        if self._first_jump_ns is None or not recent:
            self._first_jump_ns = now.monotonic_ns
            self._fail(Failsafe.POSITION_JUMPED, now)
        elif now.monotonic_ns - self._first_jump_ns > JUMPS_S * 1e9:
            self._fail(Failsafe.POSITION_JUMPS, now)
        else:
            self._stand(now, LISTEN_S)

    def _battery_below(self, percent: float) -> bool:
        return 0 <= self.autopilot.battery_percent < percent

    def _watch_battery(self, now: Instant) -> bool:
        """Whether the battery ends the flight here and now."""
        limits = self.config.failsafe
        percent = f"{self.autopilot.battery_percent} %"
        if self._critical.holds(self._battery_below(limits.battery_critical_percent), now.monotonic_ns):
            self._fail(Failsafe.BATTERY_CRITICAL, now, percent)
            return True
        if not self._low.holds(self._battery_below(limits.battery_low_percent), now.monotonic_ns) or self._low_told:
            return False
        self._low_told = True
        action = Action(limits.battery_low)
        if action is Action.RETURN and self.history.newest.revision == 0:
            action = Action.LAND
        self._fail(Failsafe.BATTERY_LOW, now, percent, action)
        return action is Action.LAND

    def no_way_back(self, reason: str, now: Instant) -> None:
        """The fleet's way back to the pads cannot be flown: land where the vehicle is."""
        self.events.append(NoWayBack(reason))
        self._happened(PhaseEvent.LAND, now)

    def _watch_battery_status(self, now: Instant) -> None:
        """Note in flight that the battery is told no more; landing for it is left to the autopilot."""
        known = self.autopilot.battery(now) >= 0
        if self._battery_known and not known and self.phase in FLYING_PHASES:
            self._note(Failsafe.BATTERY_UNKNOWN, f"last told {self.autopilot.battery_percent} %")
        self._battery_known = known

    def _watch_peers(self, now: Instant) -> bool:
        """Whether the peers' absence decides what is done."""
        peers = self.config.peers
        waited_s = (now.monotonic_ns - self.phase_since_ns) * 1e-9
        if (
            self.phase is Phase.WAITING
            and self.history.newest.revision == 0
            and self.config.plan.automatic
            and waited_s > peers.wait_s
            and not self.forms_without
        ):
            missing = [i for i, phase in self.peers.phases().items() if phase not in FILTERED_PHASES]
            detail = f"waited for vehicle {', '.join(map(str, missing))} in vain" if missing else "waited in vain"
            self.forms_without = peers.missing == "continue"
            self._fail(Failsafe.MISSING, now, detail, Action(peers.missing))
            return not self.forms_without
        silent_s = self.peers.silent_for_s(now)
        deaf = self.peers.deaf(now)
        if not deaf and (silent_s is None or silent_s <= peers.isolated_flight_s):
            self._alone_since_ns = None
            return False
        if self._alone_since_ns is None:
            self._alone_since_ns = now.monotonic_ns
            self._fail(Failsafe.DEAF if deaf else Failsafe.ALONE, now)
        elif now.monotonic_ns - self._alone_since_ns > self.config.failsafe.isolated_hold_s * 1e9:
            self._fail(Failsafe.ALONE_FOR_LONG, now)
        return True

    def _watch_motion(self, now: Instant) -> None:
        """The phases that follow from what the formation does."""
        newest, motion = self.history.newest, self.history.at(now.fleet_ns)
        if self.phase is Phase.DETACHED:
            stands_s = (now.monotonic_ns - self._apart_since_ns) * 1e-9
            if self._own.start_ns is None and stands_s > self.config.peers.wait_s:
                self._fail(Failsafe.DETACHED_FOR_LONG, now)
            return
        if newest.returns:
            self._happened(PhaseEvent.RETURN, now)
            return
        if newest.revision > 0 and (
            self.phase in (Phase.WAITING, Phase.RETURNING) or newest.blend_start_ns != self._settled_blend_ns
        ):
            self._happened(PhaseEvent.FORM, now)
        if self.phase in SETTLED_PHASES:
            match motion.activity(now.fleet_ns):
                case "legs":
                    self._happened(PhaseEvent.MOVE, now)
                case "rest":
                    self._happened(PhaseEvent.REST, now)

    # -- where to be ---------------------------------------------------------------------------------------------------

    def follow(self, slot: Reference, ego: VehicleState, now: Instant) -> Reference:
        """The own reference: the slot's, or a way of one's own that never jumps."""
        before, self._slot = self._slot, (now.fleet_ns, slot)
        if self._orders.resume_ns is not None:
            self._reference = Reference(ego.position_ned_m, ZERO, ZERO, slot.heading_rad)
            return self._reference
        jumps = before is not None and _apart(*before, slot, now.fleet_ns) > SLOT_JUMP_M
        if self.phase in FORMATION_PHASES:
            if self._engages and dist(ego.position_ned_m, slot.position_ned_m) > ENGAGED_AWAY_M:
                self._stand(now, LISTEN_S)
            elif jumps and self._reference is not None:
                self._stand(now, 0.0)
                self._own.come_back(slot, self._reference, now.fleet_ns, self._speed_m_s)
            self._engages = False
        if self.phase is Phase.DETACHED:
            self._come_back(slot, jumps, now)
        self._reference = self._own.reference(slot, now.fleet_ns) if self.phase is Phase.DETACHED else slot
        return self._reference

    @property
    def _speed_m_s(self) -> float:
        return self.config.limits.speed_max_m_s / 2

    def _come_back(self, slot: Reference, jumps: bool, now: Instant) -> None:
        own = self._own
        if own.start_ns is None:
            if now.monotonic_ns >= self._listens_until_ns and not self.outdated and self._hears_somebody(now):
                here = own.reference(slot, now.fleet_ns)
                own.come_back(slot, here, now.fleet_ns, self._speed_m_s)
        elif jumps and self._reference is not None:
            own.come_back(slot, self._reference, now.fleet_ns, self._speed_m_s)
        elif own.over(now.fleet_ns):
            self._happened(PhaseEvent.REJOINED, now)

    def _hears_somebody(self, now: Instant) -> bool:
        return not self.peers.ids or (self.peers.silent_for_s(now) == 0.0 and not self.peers.deaf(now))

    def settle(self, ego: VehicleState, reference: Reference, now: Instant) -> None:
        """Notice that the vehicle has taken its slot, or is back over its pad."""
        newest = self.history.newest
        over_ns = newest.end_ns if self.phase is Phase.RETURNING else newest.blend_end_ns
        if self.phase not in (Phase.FORMING, Phase.RETURNING) or over_ns is None or now.fleet_ns < over_ns:
            return
        if self.history.at(now.fleet_ns) is not newest:
            return
        p, r = ego.position_ned_m, reference.position_ned_m
        near = hypot(p.north - r.north, p.east - r.east) < SETTLED_TOLERANCE_M and abs(p.down - r.down) < 1.0
        if not near:
            self._settled_since_ns = None
        elif self._settled_since_ns is None:
            self._settled_since_ns = now.monotonic_ns
        settled = self._settled_since_ns is not None and now.monotonic_ns - self._settled_since_ns >= SETTLED_FOR_NS
        if self.phase is Phase.RETURNING and (settled or now.fleet_ns > over_ns + RETURNED_LIMIT_NS):
            self._happened(PhaseEvent.LAND, now)
        elif settled:
            self._settled_blend_ns = newest.blend_start_ns
            self._happened(PhaseEvent.SETTLED, now)


def _apart(then_ns: int, then: Reference, now: Reference, now_ns: int) -> float:
    """How far a reference is from where the one before leads (m)."""
    dt_s = min((now_ns - then_ns) * 1e-9, 1.0)
    p, v = then.position_ned_m, then.velocity_ned_m_s
    led = (p.north + v.north * dt_s, p.east + v.east * dt_s, p.down + v.down * dt_s)
    return dist(led, now.position_ned_m)
