"""The vehicle agent: one vehicle's whole behaviour, without I/O. The only place where core and wire meet.

The same object flies a drone, a stub in real time, a stub in lockstep, and a recorded flight in replay: bytes and time
go in, bytes come out. It never reads a clock and never raises for what others send.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import dist
from random import Random

from companion.config import FleetConfig
from companion.core.budget import Bucket, ExaminationBudget
from companion.core.counts import Counts, Refusal, RefusalKind
from companion.core.estimate import BiasObserver, SendFilter
from companion.core.events import Event, FailsafeNoted, MotionAdopted, sentence
from companion.core.failsafe import LATE_S, Failsafe
from companion.core.frames import Ned, geodetic_to_ned
from companion.core.law.starling import Law, StarlingLaw
from companion.core.near import PUSH_M_S2, NearMode, near_push_m_s2
from companion.core.neighbours import PeerTable, predict_sample
from companion.core.safety.filter import SafetyFilter, push_m_s2
from companion.core.trajectory import (
    PADS,
    FleetTrajectory,
    Reference,
    TrajectoryHistory,
    assignment_matches,
    motion_order,
    over_the_pads,
    with_legs,
)
from companion.core.trajectory_check import Fault, examine, revision_fault
from companion.core.trigger import Situation
from companion.core.values import (
    AIRBORNE_PHASES,
    FILTERED_PHASES,
    FLYING_PHASES,
    FORMATION_PHASES,
    SETTLED_PHASES,
    ZERO,
    Instant,
    Neighbour,
    PeerMessage,
    PeerSample,
    Phase,
    VehicleState,
)
from companion.errors import ConfigError, WireError
from companion.vehicle.autopilot.adapters import open_autopilot
from companion.vehicle.orders import ORDER_FAULTS, OrderBook
from companion.vehicle.preflight import own_checks
from companion.vehicle.supervisor import Supervisor
from companion.wire.operator import Answer, Check, Command, PreflightReport, Status, decode_command, encode, unmet
from companion.wire.peer import (
    WIRE_FAULTS,
    decode_motion,
    decode_state,
    encode_motion,
    encode_state,
    motion_from_json,
    motion_to_json,
)

TIMER_SLACK = 2.5
"""without a new position the control tick comes this many periods after the last"""
PROPOSAL_DELAY_NS = 3_000_000_000
"""how far ahead a vehicle proposes a start that follows by itself"""
PROPOSAL_SPREAD_NS = 100_000_000
"""times the vehicles: what each waits at most before it proposes; the first of all comes after about this"""
RESEND_NS = (250_000_000, 1_000_000_000)
"""a change of phase or motion is repeated after these delays, since one message may be lost"""
OUT_OF_FORMATION = frozenset({Phase.IDLE, Phase.DETACHED, Phase.LANDING, Phase.LANDED, Phase.RELEASED})
"""phases of peers for which nobody waits any more once the formation has been taken"""
FAILSAFES_TOLD_MOST = 20
"""the last ones stand in a status: one that comes again and again must not make it too large to be sent"""
RESENDS_MAX = 8
CATCH_UP_NS = 1_000_000_000
SPREAD_NS = 50_000_000
"""times the vehicles, up to CATCH_UP_NS: over this time they spread what all have reason to say at once"""
COMMAND_LOOKS_PER_S, COMMAND_LOOKS_MOST = 400.0, 2000.0
"""what examining commanded motions may cost (`core.budget`)"""
DECODING_LOOKS_PER_BYTE = 0.002
REFUSED_KEPT = 8
"""so many plans that were refused for what they are, not for when they came, are not examined again"""
PLAN_COPIES = 2
"""a plan that this many others have just told need not be told again"""
REJECTED = (
    "peer: unknown topic",
    "state: id is not the key's",
    *(f"{topic}: {kind}" for topic in ("state", "plan") for kind in WIRE_FAULTS),
    *(f"plan: {kind}" for kind in RefusalKind),
    "plan: foreign id",
    "plan: refused before",
    "plan: more than can be examined",
    *(f"command: {kind}" for kind in (*ORDER_FAULTS, "motion", "more than can be examined")),
    *(failsafe.value for failsafe in Failsafe),
)
"""what an agent counts"""
CAUSES = ("first", "announced", "heartbeat", "triggered", "near")
"""why a state message is sent: nobody knows us yet; a phase or motion is new, or a peer is, repeats included; T_max has
passed; the trigger fired; a peer is near"""
CLOCK_SHIFT_NS = 618_033_989
"""times a vehicle's place in the file: by so much its trigger's clock is shifted, so that no two vehicles' periods, of
whatever length, end together"""
OWN_ID_ANSWER_NS = 500_000_000
"""who hears somebody speak under its own id says where it is itself, this often at most"""
LOOK_PERIOD_NS = 200_000_000
"""who does not steer looks at its peers this often: a crowd on the ground need not work as in the air"""


@dataclass(slots=True)
class Tick:
    """What one control tick did, for the log and the live table."""

    time: Instant
    driven_by_position: bool
    position_error_m: float
    """distance from the own slot"""
    neighbours: int
    nearest_m: float
    acceleration_m_s2: tuple[float, float]
    steered: bool
    """whether a setpoint was sent"""
    position_ned_m: Ned
    """own position and velocity as believed (fleet frame)"""
    velocity_ned_m_s: Ned


@dataclass(slots=True)
class Outputs:
    """What to send after one `advance`, in order."""

    mavlink: list[bytes] = field(default_factory=list)
    peers: list[tuple[str, bytes]] = field(default_factory=list)
    """(topic, payload)"""
    events: list[Event] = field(default_factory=list)
    """what happened"""
    tick: Tick | None = None

    @property
    def notes(self) -> list[str]:
        """What happened, for the log."""
        return [sentence(event) for event in self.events]


class Agent:
    """One vehicle of the fleet."""

    def __init__(self, config: FleetConfig, vehicle_id: int, boot_id: int) -> None:
        self.config = config
        self.vehicle = config.by_id(vehicle_id)
        self.id = vehicle_id
        self.boot_id = boot_id
        self.rejected = Counts(REJECTED)
        self.autopilot = open_autopilot(config, self.vehicle)
        self.history = TrajectoryHistory([config.first_motion])
        others = frozenset(v.id for v in config.vehicles) - {vehicle_id}
        self.peers = PeerTable(vehicle_id, others, config.peer_limits, self.history)
        self.law: Law = StarlingLaw(config.gains)
        """what is flown, before the filter; tests and studies may put another in its place"""
        self.safety = SafetyFilter(config.safety_limits)
        self.supervisor = Supervisor(config, self.autopilot, self.history, self.peers, self._restart_filter)
        self.orders = OrderBook(boot_id)
        self.trigger = config.trigger_rule
        self.near = NearMode(config.near_rate)
        self.messages_sent = 0
        self.sent_because: Counter[str] = Counter(dict.fromkeys(CAUSES, 0))
        """how many state messages were sent for which of CAUSES"""
        self.setpoints_sent = 0
        self._spacing = config.message_spacing
        self._slots_m = (config.spacing_min_m, config.safety_radius_m)
        """the least distance of two slots, and the safety radius"""
        self._timer_ns = round(TIMER_SLACK * 1e9 / config.limits.control_rate_hz)
        self._random = Random(vehicle_id << 32 | boot_id)
        self._bias = (BiasObserver(), BiasObserver(), BiasObserver())
        self._filter = (SendFilter(), SendFilter(), SendFilter())
        self._position_came = False
        self._last_tick: Instant | None = None
        self._began_ns: int | None = None
        """when this agent first acted (monotonic)"""
        self._observed_ns: int | None = None
        """when the own state was last known"""
        self._tick: Tick | None = None
        self._neighbours: list[Neighbour] = []
        self._look_ns = 0
        self._sequence = 0
        self._sent: tuple[PeerSample, tuple[Ned, Ned]] | None = None
        """last sample sent, with p_ref and v_d at its time"""
        self._sent_ns = 0
        self._silence_limit_s = 0.0
        self._resend_ns: list[int] = []
        self._plan_due_ns: int | None = None
        self._plan_payload = encode_motion(self.history.newest)
        self._refused_plans: list[bytes] = []
        self._plans_budget = ExaminationBudget(others)
        self._commands_budget = Bucket(COMMAND_LOOKS_PER_S, COMMAND_LOOKS_MOST)
        self._plan_told = 0
        """how often others told it since our telling became due"""
        self._spread_ns = min(SPREAD_NS * len(config.vehicles), CATCH_UP_NS)
        self._propose_ns: int | None = None
        """when to propose what follows, if nobody has by then (monotonic)"""
        self._announced = Phase.IDLE
        """the phase that the peers were last told at once"""
        self._own_id_ns: int | None = None
        """when somebody else last spoke under this vehicle's id (monotonic)"""
        self._jumps = 0
        self._outputs = Outputs()

    @property
    def phase(self) -> Phase:
        """Where the vehicle is in its flight."""
        return self.supervisor.phase

    @property
    def neighbours(self) -> Sequence[Neighbour]:
        """The peers as they were last predicted."""
        return self._neighbours

    # -- inputs ------------------------------------------------------------------------------------------------------

    def receive_mavlink(self, datagram: bytes, now: Instant) -> bool:
        """Bytes of one datagram from the link; whether it was the own autopilot's heartbeat or position."""
        heard = self.autopilot.heard
        if self.autopilot.receive(datagram, now):
            self._position_came = True
            self.supervisor.position_came()
        return self.autopilot.heard > heard

    def receive_peer(self, key: str, payload: bytes, now: Instant) -> None:
        """A peer's put: `fleet/<id>/state` or `fleet/<id>/plan`."""
        topic = key.rsplit("/", 1)[-1]
        if topic not in ("state", "plan"):
            self.rejected["peer: unknown topic"] += 1
            return
        if key.split("/")[-2:-1] == [str(self.id)]:
            self._heard_own_id(now)
            return
        try:
            if topic == "plan":
                self._receive_plan(key, payload, now)
                return
            message = decode_state(payload)
        except WireError as error:
            self.rejected[f"{topic}: {error.kind}"] += 1
            return
        if key.split("/")[-2:-1] != [str(message.sample.vehicle_id)]:
            self.rejected["state: id is not the key's"] += 1
            return
        if self.peers.accept(message, now) is None:
            if self.id in message.near_ids:
                self.near.named(now.monotonic_ns)
            self._compare_motions(message, now)

    def _heard_own_id(self, now: Instant) -> None:
        """Somebody else speaks under this vehicle's id: what it says is not taken, and contradicted at once."""
        what = Failsafe.OWN_ID
        self.rejected[what.value] += 1
        if not self.own_id_heard(now):
            self._outputs.events.append(FailsafeNoted(what, "it says where it is itself"))
        self._own_id_ns = now.monotonic_ns
        if not self._resend_ns:
            self._resend_ns = [max(now.monotonic_ns, self._sent_ns + OWN_ID_ANSWER_NS)]

    def own_id_heard(self, now: Instant) -> bool:
        """Whether somebody else spoke under this vehicle's id lately."""
        stale_ns = self.peers.limits.stale_after_s * 1e9
        return self._own_id_ns is not None and now.monotonic_ns - self._own_id_ns < stale_ns

    def _receive_plan(self, key: str, payload: bytes, now: Instant) -> None:
        if payload == self._plan_payload:
            self._plan_told += 1
            if self._plan_told >= PLAN_COPIES:
                self._plan_due_ns = None
            return
        sender = next((i for i in self.peers.ids if key.endswith(f"/{i}/plan")), None)
        if sender is None:
            self.rejected["plan: foreign id"] += 1
        elif payload in self._refused_plans:
            self.rejected["plan: refused before"] += 1
        elif not self._plans_budget.open(sender, now.monotonic_ns):
            self.rejected["plan: more than can be examined"] += 1
        else:
            self._plans_budget.spend(sender, 1.0 + DECODING_LOOKS_PER_BYTE * len(payload))
            fault, looks = self._consider(decode_motion(payload), now)
            self._plans_budget.spend(sender, looks)
            if fault is not None and fault.permanent:
                self._refused_plans = [*self._refused_plans[1 - REFUSED_KEPT :], payload]

    def receive_presence(self, vehicle_id: int, alive: bool, now: Instant) -> None:
        """A peer's process appeared or ended."""
        self.peers.presence(vehicle_id, alive, now)
        if not alive or vehicle_id not in self.peers.ids:
            return
        # Whoever lost us believes us only by a new state, and whoever comes late may lack the plan.
        delay_ns = self._random.randrange(self._spread_ns)
        self._resend_ns = sorted([*self._resend_ns, now.monotonic_ns + delay_ns])[:RESENDS_MAX]
        if self.history.newest.revision > 0 and self._plan_due_ns is None:
            self._tell_plan_soon(now)

    def receive_command(self, payload: bytes, now: Instant) -> bytes:
        """An operator's command as JSON; returns the answer as JSON. The same bytes again get the same answer."""
        again = self.orders.answer_again(payload)
        if again is not None:
            return again
        try:
            command = decode_command(payload)
        except WireError as fault:
            return self._refuse(Refusal(fault.kind, fault.detail))
        refusal = self.orders.refusal(command.verb, command.after.get(self.id, ()), self.supervisor.begun)
        if refusal is not None:
            return self._refuse(refusal, in_order=False)
        reason = self._obey(command, now)
        if reason is None:
            self.orders.obeyed_now(command)
        answer = self._reply(reason)
        self.orders.answered(payload, answer)
        return answer

    def _obey(self, command: Command, now: Instant) -> str | None:
        """Do what is commanded; returns why not."""
        match command.verb:
            case "takeoff":
                return self._command_take_off(now)
            case "land":
                return self.supervisor.land(now)
            case "release":
                return self.supervisor.release(now)
            case "resume":
                return self.supervisor.resume(now)
            case "kill":
                return self.supervisor.kill(now) if command.confirm else "kill needs its confirmation"
        if not self._commands_budget.open(now.monotonic_ns):
            self.rejected["command: more than can be examined"] += 1
            return "too many motions at once: command it again"
        try:
            motion = motion_from_json(command.motion)
        except WireError as error:
            self.rejected["command: motion"] += 1
            return str(error)
        fault, looks = self._consider(motion, now)
        self._commands_budget.spend(1.0 + looks)
        return None if fault is None else fault.sentence

    def _refuse(self, refusal: Refusal, in_order: bool = True) -> bytes:
        self.rejected[f"command: {refusal.kind}"] += 1
        return self._reply(refusal.sentence, in_order)

    def _reply(self, refusal: str | None, in_order: bool = True) -> bytes:
        return encode(
            Answer(
                vehicle=self.id,
                accepted=refusal is None,
                reason=refusal,
                phase=self.phase.name.lower(),
                in_order=in_order,
                revision=self.history.newest.revision,
                place=self.orders.place(self.supervisor.begun),
            )
        )

    def _command_take_off(self, now: Instant) -> str | None:
        if self.phase in FLYING_PHASES or self.phase is Phase.PREFLIGHT:
            return None
        if self.phase is Phase.RELEASED:
            return "the pilot has the vehicle"
        newest = self.history.newest
        if newest.then == "land" and newest.end_ns is not None and now.fleet_ns >= newest.end_ns:
            return "the plan is over: restart the companions for another flight"
        reasons = self.unready(now)
        if reasons:
            return "; ".join(reasons)
        return self.supervisor.take_off(now)

    def notice(self, failsafe: Failsafe, now: Instant) -> None:
        """Something that only the process around can see: it is noted and counted, and changes nothing."""
        del now
        self.rejected[failsafe.value] += 1
        self._outputs.events.append(FailsafeNoted(failsafe, "noted"))

    def stop(self, now: Instant) -> None:
        """The process is asked to end: land. `stopped` tells when the autopilot has taken over."""
        self.supervisor.land(now)

    @property
    def stopped(self) -> bool:
        """Whether nothing hangs in the air on this process."""
        return self.supervisor.stopped

    def unready(self, now: Instant) -> list[str]:
        """Why this vehicle may not take off; empty when it may."""
        return [c.message for c in unmet(self.checks(now))]

    def checks(self, now: Instant) -> tuple[Check, ...]:
        """Every row of this vehicle's own preflight."""
        place = None
        if self.phase not in FLYING_PHASES and self.history.newest.revision == 0:
            place = Ned(self.vehicle.pad_north_m, self.vehicle.pad_east_m, 0.0)
        rows = own_checks(self.autopilot.facts(now), self.config, self.vehicle, place)
        ours = self.phase not in (Phase.IDLE, Phase.LANDED)
        strange = self.autopilot.armed and not ours
        silent = [i for i, phase in self.peers.phases().items() if phase is None]
        others = len(self.peers.ids)
        return (
            *rows,
            Check(
                "armed", "by somebody else" if strange else "no" if not self.autopilot.armed else "by its companion",
                "not by somebody else", not strange, "armed by somebody else", vehicle=self.id,
            ),
            Check(
                "peers heard", others - len(silent), f"= {others}", not silent,
                f"not heard: vehicle {', '.join(str(i) for i in silent)}", vehicle=self.id,
            ),
        )  # fmt: skip

    def account(self, now: Instant) -> PreflightReport:
        """The answer to a preflight question."""
        facts = self.autopilot.facts(now)
        origin = None if facts.origin is None else geodetic_to_ned(facts.origin, self.config.origin)
        return PreflightReport(
            vehicle=self.id,
            boot_id=self.boot_id,
            system_id=self.vehicle.system_id,
            configuration=self.config.shared_hash,
            assignment=self.config.assignment_hash,
            flying=self.phase in FLYING_PHASES,
            revision=self.history.newest.revision,
            position_ned_m=facts.position_ned_m,
            slot_ned_m=self.history.reference(self.id, now.fleet_ns).position_ned_m,
            origin_ned_m=origin,
            home_altitude_amsl_m=facts.home_altitude_amsl_m,
            own_id_heard=self.own_id_heard(now),
            checks=self.checks(now),
        )

    # -- motions -----------------------------------------------------------------------------------------------------

    def _consider(self, motion: FleetTrajectory, now: Instant) -> tuple[Fault | None, float]:
        """Adopt a motion of somebody else's if it is newer and sound; why it was refused, and the looks it took."""
        newest = self.history.newest
        if motion.order <= newest.order:
            sentence = f"revision {motion.revision} is not newer than {newest.revision}"
            return None if newest.order == motion.order else Fault(RefusalKind.NOT_NEWER, sentence), 0.0
        fault, looks = self._unsound(motion, now)
        if fault is not None:
            self.rejected[f"plan: {fault.kind}"] += 1
        else:
            self._adopt(motion, now)
        return fault, looks

    def _unsound(self, motion: FleetTrajectory, now: Instant) -> tuple[Fault | None, float]:
        """Why a motion cannot follow the newest, and the looks that it took; what is cheap to see comes first."""
        newest = self.history.newest
        told = [s.revision for i in self.peers.ids if (s := self.peers.sample(i)) is not None]
        ahead = revision_fault(motion.revision, newest.revision, told)
        if ahead is not None:
            return Fault(RefusalKind.REVISION, ahead), 0.0
        if motion.slots.keys() != newest.slots.keys():
            return Fault(RefusalKind.VEHICLES, "its vehicles are not this fleet's"), 0.0
        if abs(motion.start_ns - now.fleet_ns) > 3_600_000_000_000:
            sentence = "it starts more than an hour from now; are the clocks set?"
            return Fault(RefusalKind.START, sentence), 0.0
        away_m = self._away_m(motion, now)
        if not away_m <= self.config.peers.range_m:
            sentence = f"it begins out of range, {away_m:.0f} m from where this vehicle is to be"
            return Fault(RefusalKind.RANGE, sentence), 1.0
        fault, looks = examine(motion, self.config.motion_limits, newest)
        return fault or self._foreign_slots(motion), looks

    def _foreign_slots(self, motion: FleetTrajectory) -> Fault | None:
        """Slots that this vehicle would not assign from its own configuration."""
        if motion.shape == PADS:
            kind = RefusalKind.PADS
            same = over_the_pads(motion, self.config.first_motion)
        else:
            kind = RefusalKind.SLOTS
            try:
                slots = self.config.slots(motion.shape)
            except ConfigError as error:
                return Fault(RefusalKind.SHAPE, str(error))
            same = assignment_matches(motion, slots, self.config.pinned)
        return None if same else Fault(kind, f"{kind}; do the configurations differ?")

    def _away_m(self, motion: FleetTrajectory, now: Instant) -> float:
        """How far the own slot jumps when a motion begins (m); a vehicle that does not fly jumps nowhere."""
        if self.phase not in FILTERED_PHASES:
            return 0.0
        at_ns = max(motion.start_ns, now.fleet_ns)
        ours = self.history.reference(self.id, at_ns).position_ned_m
        return dist(motion.reference(self.id, at_ns).position_ned_m, ours)

    def _adopt(self, motion: FleetTrajectory, now: Instant) -> None:
        before = self.history.newest
        if not self.history.adopt(motion):
            return
        self._plan_payload = encode_motion(motion)
        self.peers.plan_changed()
        if self._sent is not None:
            self._sent = (self._sent[0], self._reference_of(self._sent[0]))
        if before.returns and not motion.returns and motion.revision > before.revision:
            # Somebody wants something else after it; a motion of the same revision only won a race.
            self.supervisor.return_is_over()
        self._plan_due_ns = now.monotonic_ns if motion.issuer == self.id else None
        self._mention(now)
        self._outputs.events.append(MotionAdopted(motion))

    def _compare_motions(self, message: PeerMessage, now: Instant) -> None:
        theirs = motion_order(message.sample.revision, message.motion_start_ns, message.motion_issuer)
        ours = self.history.newest.order
        if theirs < ours and self._plan_due_ns is None:
            self._tell_plan_soon(now)
        self.supervisor.heard_order(newer=theirs > ours)

    def _tell_plan_soon(self, now: Instant) -> None:
        self._plan_due_ns = now.monotonic_ns + self._random.randrange(self._spread_ns)
        self._plan_told = 0

    def _propose(self, now: Instant) -> None:
        """Go on by itself: form once all are in the air, fly the plan once all have formed.

        Each waits a time of its own first, so that mostly one proposes and the others follow: proposals of all at
        once, each checked by all, stop a crowd on one machine for a second.
        """
        newest = self.history.newest
        automatic, supervisor = self.config.plan.automatic, self.supervisor
        up = supervisor.forms_without or self._all_up()
        forms = automatic and newest.revision == 0 and self.phase is Phase.WAITING and up
        flies = automatic and newest.revision == 1 and self._all_formed(now) and not newest.legs
        returns = (supervisor.return_wanted and not newest.returns) or (
            newest.then == "return"
            and newest.end_ns is not None
            and self.phase in SETTLED_PHASES
            and now.fleet_ns >= newest.end_ns - PROPOSAL_DELAY_NS
        )
        if not (forms or flies or returns) or self.phase not in FILTERED_PHASES:
            self._propose_ns = None
            return
        if self._propose_ns is None:
            self._propose_ns = now.monotonic_ns + self._random.randrange(PROPOSAL_SPREAD_NS * len(self.config.vehicles))
        if now.monotonic_ns < self._propose_ns:
            return
        start_ns = now.fleet_ns + PROPOSAL_DELAY_NS
        if returns:
            self._return(self._return_motion(max(start_ns, newest.start_ns + 1)), now)
        elif forms:
            self._adopt(self._formation_motion(self.config.formation.shape, start_ns), now)
        elif self.config.plan.legs:
            centre = newest.state_at(start_ns).centre
            legs, then = self.config.plan_legs(centre.position, centre.velocity), self.config.plan.then
            self._adopt(with_legs(newest, at_ns=start_ns, issuer=self.id, legs=legs, then=then), now)

    def _all_up(self) -> bool:
        """Every peer is in the air and steered."""
        return all(phase in FILTERED_PHASES for phase in self.peers.phases().values())

    def _return(self, motion: FleetTrajectory, now: Instant) -> None:
        """Propose the way back, or land here where it would lead outside the fence: the others would refuse it."""
        fault, _ = self._unsound(motion, now)
        if fault is None:
            self._adopt(motion, now)
        else:
            self.supervisor.no_way_back(fault.sentence, now)

    def _return_motion(self, start_ns: int) -> FleetTrajectory:
        return self.config.motion_home(self.history.newest, start_ns, self.id)

    def _all_formed(self, now: Instant) -> bool:
        """This vehicle has formed, and every peer that flies with it, under the newest motion; or all waited long.

        Whoever cannot get into its slot, since something stands there, keeps nobody in the air for ever.
        """
        late = now.fleet_ns > self.history.newest.blend_end_ns + round(self.config.peers.wait_s * 1e9)
        if late:
            return self.phase in (Phase.FORMING, Phase.FORMED)
        if self.phase is not Phase.FORMED:
            return False
        for i, phase in self.peers.phases().items():
            sample = self.peers.sample(i)
            if phase is None or phase in OUT_OF_FORMATION:
                continue
            if phase is not Phase.FORMED or sample is None or sample.revision != self.history.newest.revision:
                return False
        return True

    def _formation_motion(self, shape: str, start_ns: int) -> FleetTrajectory:
        return self.config.motion_into(shape, self.history.newest, start_ns, self.id)

    # -- time --------------------------------------------------------------------------------------------------------

    def next_deadline_ns(self) -> int:
        """When `advance` must be called at the latest (monotonic ns), if nothing arrives before."""
        if self._position_came:
            return 0
        deadline = self.autopilot.next_deadline_ns()
        if self._last_tick is not None:
            deadline = min(deadline, self._last_tick.monotonic_ns + self._timer_ns)
        if self._plan_due_ns is not None:
            deadline = min(deadline, self._plan_due_ns)
        return deadline

    def advance(self, now: Instant) -> Outputs:
        """Do what is due; the returned outputs are to be sent in their order."""
        if self._began_ns is None:
            self._began_ns = now.monotonic_ns
        since = None if self._last_tick is None else now.monotonic_ns - self._last_tick.monotonic_ns
        if self._position_came or since is None or since >= self._timer_ns:
            self._control(now, since)
        out = self._outputs
        out.mavlink += self.autopilot.due(now)
        if self._plan_due_ns is not None and now.monotonic_ns >= self._plan_due_ns:
            self._plan_due_ns = None
            out.peers.append(("plan", self._plan_payload))
        out.events = [*self.supervisor.events, *out.events, *self.peers.events, *self.autopilot.events]
        for part in (self.supervisor, self.peers, self.autopilot):
            part.events.clear()
        self._outputs = Outputs()
        return out

    def _control(self, now: Instant, since_ns: int | None) -> None:
        came, self._position_came = self._position_came, False
        self._last_tick = now
        dt_s = 0.0 if since_ns is None else since_ns * 1e-9
        if dt_s > LATE_S and self.supervisor.steers:
            self.rejected[Failsafe.LOOP_LATE.value] += 1
        measured = self.supervisor.state(now)
        self.supervisor.watch(now, measured is not None)
        if self.phase is not self._announced:
            both = {self.phase, self._announced}
            if not both <= FORMATION_PHASES:
                self._announce(now)
            elif not both <= SETTLED_PHASES:
                # Who moves and who rests follows from the plan, which all have.
                self._mention(now)
            self._announced = self.phase
        if measured is None:
            if self._resend_ns and self._observed_ns is not None:
                # Whoever no longer knows where it is still says so, from the last place it knew. Who never knew in this
                # life has nothing to tell: its presence says that it is there.
                self._tell(now, ZERO, self.history.reference(self.id, now.fleet_ns))
            return
        gap_s = 0.0 if self._observed_ns is None else (now.monotonic_ns - self._observed_ns) * 1e-9
        self._observed_ns = now.monotonic_ns
        ego, bias = self._observe(measured, gap_s, now)
        motion = self.history.at(now.fleet_ns)
        moment = motion.state_at(now.fleet_ns)
        reference = self.supervisor.follow(moment.slot(motion.slots[self.id]), ego, now)
        steers = self.supervisor.steers
        if steers or now.monotonic_ns >= self._look_ns:
            self._neighbours = self.peers.predict(
                ego.position_ned_m, now, moment, self.phase in SETTLED_PHASES, self.phase is Phase.RETURNING
            )
            self._look_ns = now.monotonic_ns + LOOK_PERIOD_NS
        neighbours = self._neighbours
        residual = ZERO
        steered = False
        if steers:
            command, residual = self.law.command(ego, reference, neighbours, alone=self.supervisor.detached)
            setpoint = self.safety.apply(command, ego, neighbours, bias, dt_s)
            if setpoint is not None:
                self._outputs.mavlink.append(self.autopilot.setpoint(setpoint))
                self.setpoints_sent += 1
                steered = True
            self._look_near(reference.velocity_ned_m_s, now)
        self.supervisor.settle(ego, reference, now)
        self._propose(now)
        self._tell(now, residual, reference)
        self._tick = self._outputs.tick = Tick(
            now,
            came,
            dist(ego.position_ned_m, reference.position_ned_m),
            sum(n.in_formation for n in neighbours),
            min((dist(n.position_ned_m, ego.position_ned_m) for n in neighbours), default=-1.0),
            self.safety.acceleration_m_s2,
            steered,
            ego.position_ned_m,
            ego.velocity_ned_m_s,
        )

    def _observe(self, measured: tuple[Ned, Ned], dt_s: float, now: Instant) -> tuple[VehicleState, Ned]:
        """The own state without the estimator's velocity bias, and that bias; the filter for sending goes along."""
        position, velocity = measured
        if self.supervisor.position_jumps != self._jumps:
            self._jumps = self.supervisor.position_jumps
            self._bias = (BiasObserver(), BiasObserver(), BiasObserver())
            self._filter = (SendFilter(), SendFilter(), SendFilter())
        free = Ned(*(o.step(p, v, dt_s) for o, p, v in zip(self._bias, position, velocity, strict=True)))
        flown = (*self.safety.acceleration_m_s2, 0.0) if self.phase in FILTERED_PHASES else (0.0, 0.0, 0.0)
        for f, p, v, u in zip(self._filter, position, free, flown, strict=True):
            f.step(p, v, u, dt_s)
        return VehicleState(now.fleet_ns, position, free), Ned(*(o.bias_m_s for o in self._bias))

    def _restart_filter(self) -> None:
        """Whatever filter flies starts anew, as the vehicle does: it is the agent's, and nobody else holds it."""
        self.safety.reset()

    # -- telling the peers -------------------------------------------------------------------------------------------

    def _announce(self, now: Instant) -> None:
        """Say something at once and again, whatever the trigger says."""
        self._resend_ns = [now.monotonic_ns, *(now.monotonic_ns + d for d in RESEND_NS)]

    def _mention(self, now: Instant) -> None:
        """Say it soon: of what all do at one time, a burst of messages would stop a crowd on one machine."""
        first_ns = now.monotonic_ns + self._random.randrange(self._spread_ns)
        self._resend_ns = [first_ns, first_ns + CATCH_UP_NS]

    def _reference_of(self, sample: PeerSample) -> tuple[Ned, Ned]:
        reference = self.history.reference(self.id, sample.time_ns)
        return reference.position_ned_m, reference.velocity_ned_m_s

    def _look_near(self, slot_velocity_ned_m_s: Ned, now: Instant) -> None:
        """Whom the filter's half-planes show near; it makes none of peers that are far."""
        pushes = {p.vehicle_id: push for p in self.safety.peer_planes if (push := push_m_s2(p)) < PUSH_M_S2}
        if not pushes:
            return
        near = [
            n.vehicle_id
            for n in self._neighbours
            if n.vehicle_id in pushes
            and n.last_seen_ned_m is None
            and pushes[n.vehicle_id] < near_push_m_s2(n, slot_velocity_ned_m_s, *self._slots_m)
        ]
        self.near.see(near, now.monotonic_ns)

    def _tell(self, now: Instant, residual: Ned, reference: Reference) -> None:
        """Send a state message if one is due, and count why."""
        near = self.phase in AIRBORNE_PHASES and self.near.active(now.monotonic_ns)
        filtered = tuple(f.position_m or 0.0 for f in self._filter), tuple(f.velocity_m_s for f in self._filter)
        position, velocity = Ned(*filtered[0]), Ned(*filtered[1])
        cause = self._cause(position, velocity, residual, reference, near, now)
        if cause is None:
            return
        sample = PeerSample(self.id, now.fleet_ns, position, velocity, self.history.newest.revision, self.phase)
        self._sent = (sample, self._reference_of(sample))
        self._sent_ns = now.monotonic_ns
        self._silence_limit_s = self._spacing.t_max_s * (0.8 + 0.2 * self._random.random())
        self._sequence = (self._sequence + 1) % (1 << 32)
        self.near.promised = near
        newest = self.history.newest
        message = PeerMessage(
            self.boot_id, self._sequence, newest.start_ns, newest.issuer, sample, self.peers.digest(),
            near_ids=self.near.peers(now.monotonic_ns) if near else (), due_soon=near,
        )  # fmt: skip
        self._outputs.peers.append(("state", encode_state(message)))
        self.messages_sent += 1
        self.sent_because[cause] += 1

    def _cause(
        self, position: Ned, velocity: Ned, residual: Ned, reference: Reference, near: bool, now: Instant
    ) -> str | None:
        """Which of CAUSES asks for a message; None if nothing does."""
        since_s = (now.monotonic_ns - self._sent_ns) * 1e-9
        if self._sent is None:
            self._announce(now)
        due = bool(self._resend_ns) and now.monotonic_ns >= self._resend_ns[0]
        if due:
            self._resend_ns = [t for t in self._resend_ns if t > now.monotonic_ns]
        if self._sent is None:
            return "first"
        if due or (self.supervisor.outdated and since_s >= CATCH_UP_NS * 1e-9):
            return "announced"
        situation = self._situation(self._sent, position, velocity, residual, reference, now)
        if since_s >= self._silence_limit_s:
            return "heartbeat"
        if (since_s >= self._spacing.t_min_s or not self.trigger.waits) and self.trigger.fires(situation):
            return "triggered"
        return "near" if self.near.fires(situation, near) else None

    def _situation(
        self, sent: tuple[PeerSample, tuple[Ned, Ned]], position: Ned, velocity: Ned, residual: Ned,
        reference: Reference, now: Instant,
    ) -> Situation:  # fmt: skip
        """What the trigger decides upon: the own state against what the peers predict of it."""
        p, v = predict_sample(*sent, reference, now.fleet_ns, self.peers.limits)
        since_ns = self.supervisor.formation_since_ns
        shift_ns = CLOCK_SHIFT_NS * self.vehicle.instance
        return Situation(
            (position.north - p.north) ** 2 + (position.east - p.east) ** 2 + (position.down - p.down) ** 2,
            (velocity.north - v.north) ** 2 + (velocity.east - v.east) ** 2 + (velocity.down - v.down) ** 2,
            residual.north**2 + residual.east**2,
            0.0 if since_ns is None else (now.fleet_ns - since_ns) * 1e-9,
            now.monotonic_ns + shift_ns,
            self._sent_ns + shift_ns,
        )

    # -- telling the operator ----------------------------------------------------------------------------------------

    def status(self, now: Instant) -> Status:
        """This vehicle's account of itself, but for what only its process knows."""
        tick = self._tick
        age = self.peers.oldest_age_s(now)
        unready = unmet(self.checks(now))
        return Status(
            vehicle=self.id,
            phase=self.phase.name.lower(),
            mode=self.autopilot.mode_name,
            killed=None if self.supervisor.killed is None else self.supervisor.killed.value,
            armed=self.autopilot.armed,
            ready=[c.message for c in unready],
            unfit=[c.message for c in unready if c.permanent],
            revision=self.history.newest.revision,
            fleet=self.config.fleet.name,
            up_s=0.0 if self._began_ns is None else (now.monotonic_ns - self._began_ns) * 1e-9,
            place=self.orders.place(self.supervisor.begun),
            shape=self.history.newest.shape,
            moving=self.history.newest.end_ns is None or bool(self.history.newest.legs),
            position_error_m=tick.position_error_m if tick else None,
            neighbours=tick.neighbours if tick else 0,
            nearest_m=tick.nearest_m if tick and tick.nearest_m >= 0 else None,
            oldest_age_s=age,
            messages=self.messages_sent,
            messages_by_cause=dict(self.sent_because),
            setpoints=self.setpoints_sent,
            battery_percent=self.autopilot.battery(now),
            autopilot_age_s=self.autopilot.heartbeat_age_s(now),
            configuration=self.config.shared_hash,
            failsafes=self.supervisor.failsafes[-FAILSAFES_TOLD_MOST:],
            rejected=dict(self.rejected + self.supervisor.counts + self.peers.rejected + self.autopilot.rejected),
            limited=dict(self.safety.counts),
            own_id_heard=self.own_id_heard(now),
            motion=motion_to_json(self.history.newest),
        )
