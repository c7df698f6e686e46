"""The supervisor: it leads one vehicle's autopilot from phase to phase, and does what the table of failsafes says.

No I/O and no peers' bytes. At each control tick (`watch`) it finishes what the operator commanded, follows what the
autopilot shows, has the detectors look, and asks the autopilot for the next step. Phases are `core.phase`'s, failsafes
`core.failsafe`'s, and a detector (`vehicle.detectors`) stands behind each of the failsafes that are noticed here.
"""

from collections.abc import Callable
from math import nan

from companion.config import FleetConfig
from companion.core.counts import Counts
from companion.core.events import (
    Event,
    FailsafeActed,
    FailsafeNoted,
    KillCause,
    KillCommanded,
    Killed,
    NoWayBack,
    PhaseChanged,
)
from companion.core.failsafe import FAILSAFES, Action, Failsafe
from companion.core.frames import Ned
from companion.core.health import FallWatch, PositionWatch
from companion.core.neighbours.table import PeerTable
from companion.core.phase import PhaseEvent, next_phase
from companion.core.trajectory.fleet import Reference
from companion.core.trajectory.history import TrajectoryHistory
from companion.core.values import FILTERED_PHASES, FLYING_PHASES, SETTLED_PHASES, Instant, Phase, VehicleState
from companion.vehicle.autopilot.port import LAND, OFFBOARD, TAKE_OFF, AutopilotPort, Verb
from companion.vehicle.detectors import DETECTORS, Finding, Note
from companion.vehicle.flight import Flight
from companion.vehicle.follower import Follower
from companion.vehicle.pending import STREAM_BEFORE_NS, PendingCommands

BEING_KILLED = "it is being killed"


class Supervisor:
    """Leads one vehicle's flight."""

    def __init__(
        self, config: FleetConfig, autopilot: AutopilotPort, history: TrajectoryHistory, peers: PeerTable,
        restart_filter: Callable[[], None],
    ) -> None:  # fmt: skip
        limits = config.limits
        positions = PositionWatch.for_noise(limits.position_noise_m, limits.velocity_noise_m_s)
        self.config = config
        self.autopilot = autopilot
        self.flight = Flight(config, autopilot, history, peers, positions)
        self.events: list[Event] = []
        """what happened; emptied by the agent"""
        self.failsafes: list[str] = []
        """those that were acted on, as sentences"""
        self.counts = Counts(failsafe.value for failsafe in Failsafe)
        self.killed: KillCause | None = None
        """how the motors were stopped before the vehicle had landed, since the last take-off command"""
        self.return_wanted = False
        """a failsafe of this vehicle wants the whole fleet back over its pads"""
        self.formation_since_ns: int | None = None
        """fleet time since which the autopilot follows our setpoints"""
        self._restart_filter = restart_filter
        """the safety filter forgets what was flown before"""
        self._pending = PendingCommands(autopilot, self.events)
        detectors = [kind() for kind in DETECTORS]
        self._detectors = {phase: tuple(d for d in detectors if phase in d.phases) for phase in Phase}
        """who is asked in a phase, in the order of DETECTORS"""
        self._follower = Follower(self.flight, self._happened)
        self._falls = FallWatch()

    # -- what others ask -----------------------------------------------------------------------------------------------

    @property
    def phase(self) -> Phase:
        """Where the vehicle is in its flight."""
        return self.flight.phase

    @property
    def begun(self) -> int:
        """Flights so far: take-offs commanded and resumptions."""
        return self.flight.begun

    @property
    def stopped(self) -> bool:
        """Whether nothing hangs in the air on this process."""
        landing = self.phase is Phase.LANDING and self.flight.land_seen
        return self._pending.none and (landing or self.phase not in FLYING_PHASES)

    @property
    def steers(self) -> bool:
        """Whether setpoints are streamed: in formation, before it to be let into OFFBOARD, and until landing begins."""
        flight = self.flight
        return (
            self.phase in FILTERED_PHASES
            or (self.phase is Phase.CLIMBING and flight.engaging_since_ns is not None)
            or (self.phase is Phase.LANDING and not flight.land_seen and self.autopilot.mode == OFFBOARD)
            or self._pending.resuming
        )

    @property
    def detached(self) -> bool:
        """Whether it flies by itself: the formation does not draw it."""
        return self.phase is Phase.DETACHED or self._pending.resuming

    def state(self, now: Instant) -> tuple[Ned, Ned] | None:
        """Position and velocity to steer by (fleet frame); None while there are none to trust."""
        return None if self.flight.positions.frozen else self.autopilot.state(now)

    # -- what others tell ----------------------------------------------------------------------------------------------

    def position_came(self) -> bool:
        """The autopilot has told a new position; whether it is a jump."""
        ap = self.autopilot
        assert ap.position_ns is not None
        return self.flight.positions.see(ap.position_ns, ap.position_ned_m, ap.velocity_ned_m_s)

    def heard_order(self, newer: bool) -> None:
        """A peer has told which motion it holds: `newer` than the own newest, or not."""
        self.flight.outdated = newer

    def return_is_over(self) -> None:
        """The fleet flies something else after a way back: no failsafe of before wants it any more."""
        self.return_wanted = False

    def no_way_back(self, reason: str, now: Instant) -> None:
        """The fleet's way back to the pads cannot be flown: land where the vehicle is."""
        self.events.append(NoWayBack(reason))
        self._happened(PhaseEvent.LAND, now)

    # -- the operator's commands: each returns why it is refused, or None ----------------------------------------------

    def take_off(self, now: Instant) -> str | None:
        """Arm and climb."""
        if self._pending.killing:
            return BEING_KILLED
        self._pending.forget_hold()
        self.autopilot.withdraw(Verb.HOLD)
        self._happened(PhaseEvent.TAKE_OFF, now)
        return None

    def land(self, now: Instant) -> str | None:
        """Land where the vehicle is."""
        self._pending.end_resume(now)
        self._happened(PhaseEvent.LAND, now)
        flies = self.autopilot.armed and self.autopilot.on_ground is not True
        if self.phase is Phase.IDLE and flies:
            return "it flies without this companion: resume first, or take it over"
        if self.phase is Phase.RELEASED or (self.phase is not Phase.LANDING and flies):
            return "the pilot has the vehicle"
        return None

    def release(self, now: Instant) -> str | None:
        """Give the vehicle to the pilot: no setpoint any more, the autopilot in its hold mode."""
        self._pending.end_resume(now)
        ours = self.phase in FLYING_PHASES
        self._happened(PhaseEvent.GIVEN_AWAY, now)
        if ours:
            self._pending.hold_after({self.autopilot.mode, OFFBOARD}, now)
        return None

    def kill(self, now: Instant) -> str | None:
        """Stop the motors at once, wherever the vehicle is."""
        self._happened(PhaseEvent.GIVEN_AWAY, now)
        self._pending.kill(now)
        self.events.append(KillCommanded())
        return None

    def resume(self, now: Instant) -> str | None:
        """Steer again a vehicle that was released, or that this companion found in the air."""
        if self._pending.killing:
            return BEING_KILLED
        if self.phase in FILTERED_PHASES or self._pending.resuming:
            return None
        if not self.autopilot.armed:
            return "it is not armed"
        if next_phase(self.phase, PhaseEvent.RESUMED) is self.phase:
            return f"it is {self.phase.name.lower()}: to resume is for the released, and for those found in the air"
        if self.autopilot.on_ground is True:
            return "it is on the ground"
        if self.autopilot.on_ground is None:
            return "its autopilot does not tell whether it is in the air"
        if self.state(now) is None:
            return "no position"
        self._pending.resume(now)
        self._restart_filter()
        return None

    # -- at each control tick ------------------------------------------------------------------------------------------

    def watch(self, now: Instant, positioned: bool) -> None:
        """Lead the autopilot through the flight; `positioned`: `state` tells where the vehicle is."""
        self._finish_commands(now)
        self._watch_motors(now)
        self._observe(now, positioned)
        phase = self.phase
        for stage in (self._follow_autopilot, self._detect, self._lead):
            stage(now)
            if self.phase is not phase:
                return

    def _finish_commands(self, now: Instant) -> None:
        done = self._pending.advance(now)
        if done.killed:
            self._note_killed(KillCause.COMMAND)
        if done.resumed:
            self._happened(PhaseEvent.RESUMED, now)
            self._follower.stand(now)

    def _watch_motors(self, now: Instant) -> None:
        self._falls.see(self.autopilot.velocity_ned_m_s.down, now.monotonic_ns)
        if self._falls.motors_stopped:
            self._note_killed(KillCause.FELL)

    def _note_killed(self, cause: KillCause) -> None:
        if self.killed is None:
            self.killed = cause
            self.events.append(Killed(cause))

    def _observe(self, now: Instant, positioned: bool) -> None:
        if self.flight.observe(now, positioned):
            self.autopilot.doubt_origin()
        if self.flight.jumped:
            self.counts[Failsafe.POSITION_JUMPED.value] += 1
            self._restart_filter()

    def _follow_autopilot(self, now: Instant) -> None:
        """The phases that follow from what the autopilot shows."""
        ap, phase = self.autopilot, self.phase
        if phase in FILTERED_PHASES:
            if not ap.armed:
                self._happened(PhaseEvent.DISARMED, now)
            return
        match phase:
            case Phase.PREFLIGHT if ap.armed:
                self._happened(PhaseEvent.ARMED, now)
            case Phase.ARMED | Phase.CLIMBING if not ap.armed:
                # Its pilot has ended the take-off; take-off mode would take off whoever arms next.
                self._happened(PhaseEvent.DISARMED, now)
                self._pending.hold_after({TAKE_OFF}, now)
            case Phase.LANDING | Phase.RELEASED if not ap.armed:
                self._happened(PhaseEvent.DISARMED, now)
            case Phase.ARMED if ap.mode == TAKE_OFF:
                self._happened(PhaseEvent.TAKING_OFF, now)
            case Phase.CLIMBING if ap.mode == OFFBOARD:
                self._happened(PhaseEvent.ENGAGED, now)
            case Phase.LANDING if ap.mode == LAND:
                self.flight.land_seen = True

    def _detect(self, now: Instant) -> None:
        """Have the detectors look, and act on what they find until the phase changes."""
        flight, phase, blind = self.flight, self.phase, self.flight.blind
        for detector in self._detectors[phase]:
            if blind and detector.needs_position:
                continue
            match detector.look(flight, now):
                case None:
                    pass
                case Note(detail):
                    self.counts[detector.failsafe.value] += 1
                    self.events.append(FailsafeNoted(detector.failsafe, detail))
                case Finding() as finding:
                    self._act(detector.failsafe, finding, now)
                    if self.phase is not phase:
                        return

    def _act(self, failsafe: Failsafe, finding: Finding, now: Instant) -> None:
        """Do what the table says, or what the configuration has chosen among the row's ways."""
        action = FAILSAFES[failsafe].action if finding.action is None else finding.action
        if not finding.said:
            acted = FailsafeActed(failsafe, action, finding.detail)
            self.failsafes.append(acted.sentence)
            self.events.append(acted)
        match action:
            case Action.LAND:
                self._happened(PhaseEvent.LAND, now)
            case Action.HAND_OVER:
                self._happened(PhaseEvent.TAKEN_OVER, now)
            case Action.LEAVE_FORMATION:
                self._follower.stand(now)
            case Action.RETURN:
                self.return_wanted = True
            case Action.CONTINUE if failsafe is Failsafe.NOT_ARMED:
                self._happened(PhaseEvent.GIVEN_UP, now)
            case Action.CONTINUE if failsafe is Failsafe.MISSING:
                self.flight.forms_without = True

    def _lead(self, now: Instant) -> None:
        """Ask the autopilot for the phase's next step, or go on with the formation."""
        ap, phase = self.autopilot, self.phase
        if phase in FILTERED_PHASES:
            if self.flight.positioned:
                self._lead_formation(now)
            return
        match phase:
            case Phase.PREFLIGHT if ap.mode == OFFBOARD:
                ap.hold()  # left over from a flight before; without setpoints PX4 does not arm in it
            case Phase.PREFLIGHT:
                ap.arm()
            case Phase.ARMED:
                is_global = self.config.fleet.frame == "global"
                height_m = self.config.origin.altitude_amsl_m + self.config.formation.altitude_m
                ap.take_off(height_m if is_global else nan)
            case Phase.CLIMBING:
                self._lead_climb(now)
            case Phase.LANDING if not self.flight.land_seen:
                ap.land()

    def _lead_climb(self, now: Instant) -> None:
        """Once at altitude, stream setpoints, and then have the autopilot follow them."""
        flight = self.flight
        if not flight.positioned or flight.stopped_low:
            return
        if flight.engaging_since_ns is None:
            if flight.at_altitude:
                flight.engaging_since_ns = now.monotonic_ns
                self._restart_filter()
        elif now.monotonic_ns - flight.engaging_since_ns > STREAM_BEFORE_NS:
            self.autopilot.engage()

    def _lead_formation(self, now: Instant) -> None:
        """The phases that follow from the fleet's trajectory."""
        history = self.flight.history
        newest, motion = history.newest, history.at(now.fleet_ns)
        lands = motion.then == "land" and not motion.returns
        if lands and motion.end_ns is not None and now.fleet_ns >= motion.end_ns:
            self._happened(PhaseEvent.LAND, now)
        elif self.flight.isolated_since_ns is not None or self.phase is Phase.DETACHED:
            return
        elif newest.returns:
            self._happened(PhaseEvent.RETURN, now)
        else:
            unsettled = newest.blend_start_ns != self._follower.settled_blend_ns
            if newest.revision > 0 and (self.phase in (Phase.WAITING, Phase.RETURNING) or unsettled):
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
        return self._follower.follow(slot, ego, now, self._pending.resuming)

    def settle(self, ego: VehicleState, reference: Reference, now: Instant) -> None:
        """Notice that the vehicle has taken its slot, or is back over its pad."""
        arrived = self._follower.arrived(ego, reference, now)
        if arrived is not None:
            self._happened(arrived, now)

    # -- phases --------------------------------------------------------------------------------------------------------

    def _happened(self, event: PhaseEvent, now: Instant) -> None:
        """Go to the phase to which the event leads, if it leads to another."""
        flight, before, after = self.flight, self.phase, next_phase(self.phase, event)
        if after is before:
            return
        self.events.append(PhaseChanged(before, after, event))
        flight.phase, flight.phase_since_ns = after, now.monotonic_ns
        flight.engaging_since_ns = None
        if after is Phase.ARMED:
            flight.mode_before = self.autopilot.mode
        elif before is not Phase.ARMED:
            flight.mode_before = None
        self._follower.phase_changed(event)
        # A retry of what has happened would happen again: over the pilot's head, at worst.
        self.autopilot.withdraw(Verb.ARM, Verb.TAKE_OFF, Verb.ENGAGE)
        match event:
            case PhaseEvent.TAKE_OFF:
                flight.begun += 1
                self.killed = None
                self._falls.restart()
            case PhaseEvent.RESUMED:
                flight.begun += 1
                self._engaged(now)
            case PhaseEvent.ENGAGED:
                self._engaged(now)
            case PhaseEvent.DISARMED:
                self._falls.disarmed(now.monotonic_ns)
        match after:
            case Phase.LANDING:
                flight.land_seen = False
            case Phase.RELEASED:
                self.autopilot.cancel()
        if after not in FLYING_PHASES:
            self.return_wanted = flight.forms_without = False

    def _engaged(self, now: Instant) -> None:
        """The autopilot follows our setpoints from now on."""
        self._restart_filter()
        self.formation_since_ns = now.fleet_ns
        self.flight.jumps.restart()
        self.flight.engaged_origin_crept_ned_m = self.autopilot.origin_crept_ned_m
