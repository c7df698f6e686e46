"""The newest trajectory among vehicles without a leader: what others propose is validated and adopted, what is new is
told on, and what follows by itself is proposed.

Trajectories are ordered (`FleetTrajectory.order`) and every vehicle keeps the largest one that it has found sound, so
all come to the same one, in whatever order they hear of several.
"""

from enum import Enum, unique
from math import dist
from random import Random

from companion.config import FleetConfig
from companion.core.budget import Bucket, ExaminationBudget
from companion.core.counts import Counts, RefusalKind
from companion.core.events import Event, MotionAdopted
from companion.core.neighbours.table import PeerTable
from companion.core.trajectory.fleet import PADS, FleetTrajectory, motion_order
from companion.core.trajectory.history import TrajectoryHistory
from companion.core.trajectory.successors import assignment_matches, going_on, over_the_pads, with_legs
from companion.core.trajectory_check import Fault, examine, revision_fault
from companion.core.values import FILTERED_PHASES, SETTLED_PHASES, Instant, PeerMessage, Phase
from companion.errors import ConfigError, WireError
from companion.vehicle.agreement import Agreement
from companion.vehicle.publisher import Publisher, spread_ns
from companion.vehicle.supervisor import Supervisor
from companion.wire.peer import WIRE_FAULTS, decode_motion, encode_motion, motion_from_json

PROPOSAL_DELAY_NS = 3_000_000_000
"""how far ahead a vehicle proposes a start that follows by itself"""
PROPOSAL_SPREAD_NS = 100_000_000
"""times the vehicles: what each waits at most before it proposes; the first of all comes after about this"""
START_FROM_NOW_MAX_NS = 3_600_000_000_000
OUT_OF_FORMATION = frozenset({Phase.IDLE, Phase.DETACHED, Phase.LANDING, Phase.LANDED, Phase.RELEASED})
"""phases of peers for which nobody waits any more once the formation has been taken"""
COMMAND_LOOKS_PER_S, COMMAND_LOOKS_MOST = 250.0, 1200.0
"""what examining commanded trajectories may cost (`core.budget`)"""
DECODING_LOOKS_PER_BYTE = 0.002
REFUSED_KEPT = 8
"""so many plans that were refused for what they are, not for when they came, are not examined again"""
PLAN_COPIES = 2
"""a plan that this many others have just told need not be told again"""
REJECTED = (
    *(f"plan: {kind}" for kind in (*WIRE_FAULTS, *RefusalKind)),
    "plan: foreign id",
    "plan: refused before",
    "plan: more than can be examined",
    "command: motion",
    "command: more than can be examined",
)
"""what the exchange counts"""


@unique
class Proposal(Enum):
    """What a vehicle proposes without being told to."""

    RETURN = "back over the pads"
    FORM = "into the formation"
    FLY = "the plan's legs"


class PlanExchange:
    """One vehicle's part in agreeing on the newest trajectory."""

    def __init__(
        self, config: FleetConfig, vehicle_id: int, history: TrajectoryHistory, peers: PeerTable,
        supervisor: Supervisor, publisher: Publisher, agreement: Agreement, random: Random, rejected: Counts,
    ) -> None:  # fmt: skip
        self.events: list[Event] = []
        """what was adopted; emptied by the agent"""
        self._config = config
        self._id = vehicle_id
        self._history = history
        self._peers = peers
        self._supervisor = supervisor
        self._publisher = publisher
        self._agreement = agreement
        self._random = random
        self._rejected = rejected
        self._spread_ns = spread_ns(len(config.vehicles))
        self._payload = encode_motion(history.newest)
        """the newest trajectory as it is told"""
        self._tell_ns: int | None = None
        """when it is to be told (monotonic)"""
        self._copies_heard = 0
        """how often others told it since our telling became due"""
        self._refused: list[bytes] = []
        self._plans_budget = ExaminationBudget(peers.ids)
        self._commands_budget = Bucket(COMMAND_LOOKS_PER_S, COMMAND_LOOKS_MOST)
        self._propose_ns: int | None = None
        """when to propose what follows, if nobody has by then (monotonic)"""

    # -- what others propose -------------------------------------------------------------------------------------------

    def on_plan(self, sender: int | None, payload: bytes, now: Instant) -> None:
        """A peer tells a trajectory; WireError for bytes that are none. `sender`: None where no peer of ours spoke."""
        if payload == self._payload:
            self._copies_heard += 1
            if self._copies_heard >= PLAN_COPIES:
                self._tell_ns = None
        elif sender is None:
            self._rejected["plan: foreign id"] += 1
        elif payload in self._refused:
            self._rejected["plan: refused before"] += 1
        elif not self._plans_budget.open(sender, now.monotonic_ns):
            self._rejected["plan: more than can be examined"] += 1
        else:
            self._plans_budget.spend(sender, 1.0 + DECODING_LOOKS_PER_BYTE * len(payload))
            fault, looks = self._on_trajectory(decode_motion(payload), now)
            self._plans_budget.spend(sender, looks)
            if fault is not None and fault.permanent:
                self._refused = [*self._refused[1 - REFUSED_KEPT :], payload]

    def on_command(self, motion: object, now: Instant) -> str | None:
        """An operator commands a trajectory (its JSON, parsed); why it is refused, or None."""
        if not self._commands_budget.open(now.monotonic_ns):
            self._rejected["command: more than can be examined"] += 1
            return "too many motions at once: command it again"
        try:
            trajectory = motion_from_json(motion)
        except WireError as error:
            self._rejected["command: motion"] += 1
            return str(error)
        fault, looks = self._on_trajectory(trajectory, now)
        self._commands_budget.spend(1.0 + looks)
        return None if fault is None else fault.sentence

    def on_state(self, message: PeerMessage, now: Instant) -> None:
        """A peer's state names its newest trajectory: who lacks ours is told it; whether we lack theirs is known."""
        theirs = motion_order(message.sample.revision, message.motion_start_ns, message.motion_issuer)
        ours = self._history.newest.order
        if theirs < ours and self._tell_ns is None:
            self._tell_soon(now)
        self._supervisor.heard_order(newer=theirs > ours)

    def on_new_peer(self, now: Instant) -> None:
        """Whoever comes late may lack the plan."""
        if self._history.newest.revision > 0 and self._tell_ns is None:
            self._tell_soon(now)

    def _on_trajectory(self, motion: FleetTrajectory, now: Instant) -> tuple[Fault | None, float]:
        """Adopt a trajectory of somebody else's if it is newer and sound; why it was refused, and the looks it took."""
        newest = self._history.newest
        if motion.order == newest.order:
            return None, 0.0
        if motion.order < newest.order:
            sentence = f"revision {motion.revision} is not newer than {newest.revision}"
            return Fault(RefusalKind.NOT_NEWER, sentence), 0.0
        fault, looks = self._validate_trajectory(motion, now)
        if fault is not None:
            self._rejected[f"plan: {fault.kind}"] += 1
        else:
            self._adopt(motion, now)
        return fault, looks

    def _validate_trajectory(self, motion: FleetTrajectory, now: Instant) -> tuple[Fault | None, float]:
        """Why it cannot follow the newest, and the looks that it took; what is cheap to see comes first."""
        newest = self._history.newest
        told = [s.revision for i in self._peers.ids if (s := self._peers.sample(i)) is not None]
        ahead = revision_fault(motion.revision, newest.revision, told)
        if ahead is not None:
            return Fault(RefusalKind.REVISION, ahead), 0.0
        if motion.slots.keys() != newest.slots.keys():
            return Fault(RefusalKind.VEHICLES, "its vehicles are not this fleet's"), 0.0
        if abs(motion.start_ns - now.fleet_ns) > START_FROM_NOW_MAX_NS:
            sentence = "it starts more than an hour from now; are the clocks set?"
            return Fault(RefusalKind.START, sentence), 0.0
        away_m = self._away_m(motion, now)
        if not away_m <= self._config.peers.range_m:
            sentence = f"it begins out of range, {away_m:.0f} m from where this vehicle is to be"
            return Fault(RefusalKind.RANGE, sentence), 1.0
        fault, looks = examine(motion, self._config.motion_limits, newest)
        return fault or self._foreign_slots(motion), looks

    def _away_m(self, motion: FleetTrajectory, now: Instant) -> float:
        """How far the own slot jumps when it begins (m); a vehicle that does not fly jumps nowhere."""
        if self._supervisor.phase not in FILTERED_PHASES:
            return 0.0
        at_ns = max(motion.start_ns, now.fleet_ns)
        if motion.free_at(at_ns):
            return 0.0
        ours = self._flown(now).reference(self._id, at_ns).position_ned_m
        return dist(motion.reference(self._id, at_ns).position_ned_m, ours)

    def _flown(self, now: Instant) -> FleetTrajectory:
        """The newest motion; of one that is not shared, what this vehicle knows of it."""
        newest, centre = self._history.newest, self._agreement.centre
        if centre is None or not newest.free_at(now.fleet_ns):
            return newest
        return going_on(newest, *centre)

    def _foreign_slots(self, motion: FleetTrajectory) -> Fault | None:
        """Slots that this vehicle would not assign from its own configuration."""
        if motion.shape == PADS:
            kind = RefusalKind.PADS
            same = over_the_pads(motion, self._config.first_motion)
        else:
            kind = RefusalKind.SLOTS
            try:
                slots = self._config.slots(motion.shape)
            except ConfigError as error:
                return Fault(RefusalKind.SHAPE, str(error))
            same = assignment_matches(motion, slots, self._config.pinned)
        return None if same else Fault(kind, f"{kind}; do the configurations differ?")

    def _adopt(self, motion: FleetTrajectory, now: Instant) -> None:
        before = self._history.newest
        if not self._history.adopt(motion):
            return
        self._payload = encode_motion(motion)
        self._peers.plan_changed()
        if before.returns and not motion.returns and motion.revision > before.revision:
            # Somebody wants something else after it; a motion of the same revision only won a race.
            self._supervisor.return_is_over()
        self._tell_ns = now.monotonic_ns if motion.issuer == self._id else None
        self._publisher.on_trajectory(now)
        self.events.append(MotionAdopted(motion))

    # -- telling it on -------------------------------------------------------------------------------------------------

    def _tell_soon(self, now: Instant) -> None:
        self._tell_ns = now.monotonic_ns + self._random.randrange(self._spread_ns)
        self._copies_heard = 0

    def due(self, now: Instant) -> bytes | None:
        """The newest trajectory, if it is to be told now."""
        if self._tell_ns is None or now.monotonic_ns < self._tell_ns:
            return None
        self._tell_ns = None
        return self._payload

    def next_deadline_ns(self) -> int | None:
        """When `due` has something to say (monotonic); None: not yet known."""
        return self._tell_ns

    # -- what follows by itself ----------------------------------------------------------------------------------------

    def propose(self, now: Instant) -> None:
        """Go on by itself: form once all are in the air, fly the plan once all have formed, return once it is over.

        Each waits a time of its own first, so that mostly one proposes and the others follow: proposals of all at
        once, each checked by all, stop a crowd on one machine for a second.
        """
        proposal = self._proposal(now) if self._supervisor.phase in FILTERED_PHASES else None
        if proposal is None:
            self._propose_ns = None
            return
        if self._propose_ns is None:
            wait_ns = self._random.randrange(PROPOSAL_SPREAD_NS * len(self._config.vehicles))
            self._propose_ns = now.monotonic_ns + wait_ns
        if now.monotonic_ns < self._propose_ns:
            return
        newest, start_ns = self._history.newest, now.fleet_ns + PROPOSAL_DELAY_NS
        match proposal:
            case Proposal.RETURN:
                self._propose_return(max(start_ns, newest.start_ns + 1), now)
            case Proposal.FORM:
                shape = self._config.formation.shape
                self._adopt(self._config.motion_into(shape, newest, start_ns, self._id), now)
            case Proposal.FLY:
                centre = newest.state_at(start_ns).centre
                legs = self._config.shared_legs(centre.position, centre.velocity)
                if not legs:
                    return
                then = self._config.plan.then
                self._adopt(with_legs(newest, at_ns=start_ns, issuer=self._id, legs=legs, then=then), now)

    def _proposal(self, now: Instant) -> Proposal | None:
        """What is to follow the newest trajectory now."""
        newest, phase, plan = self._history.newest, self._supervisor.phase, self._config.plan
        over = (
            newest.then == "return"
            and newest.end_ns is not None
            and phase in SETTLED_PHASES
            and now.fleet_ns >= newest.end_ns - PROPOSAL_DELAY_NS
        )
        if over or (self._supervisor.return_wanted and not newest.returns):
            return Proposal.RETURN
        if not plan.automatic:
            return None
        if (
            newest.revision == 0
            and phase is Phase.WAITING
            and (self._supervisor.flight.forms_without or self._all_up())
        ):
            return Proposal.FORM
        if newest.revision == 1 and not newest.legs and self._all_formed(now):
            return Proposal.FLY
        return None

    def _propose_return(self, start_ns: int, now: Instant) -> None:
        """Propose the way back, or land here where it would lead outside the fence: the others would refuse it."""
        motion = self._config.motion_home(self._flown(now), start_ns, self._id)
        fault, _ = self._validate_trajectory(motion, now)
        if fault is None:
            self._adopt(motion, now)
        else:
            self._supervisor.no_way_back(fault.sentence, now)

    def _all_up(self) -> bool:
        """Every peer is in the air and steered."""
        return all(phase in FILTERED_PHASES for phase in self._peers.phases().values())

    def _all_formed(self, now: Instant) -> bool:
        """This vehicle has formed, and every peer that flies with it, under the newest trajectory; or all waited long.

        Whoever cannot get into its slot, since something stands there, keeps nobody in the air for ever.
        """
        newest, phase = self._history.newest, self._supervisor.phase
        if now.fleet_ns > newest.blend_end_ns + round(self._config.peers.wait_s * 1e9):
            return phase in (Phase.FORMING, Phase.FORMED)
        if phase is not Phase.FORMED:
            return False
        for i, theirs in self._peers.phases().items():
            if theirs is None or theirs in OUT_OF_FORMATION:
                continue
            sample = self._peers.sample(i)
            if theirs is not Phase.FORMED or sample is None or sample.revision != newest.revision:
                return False
        return True
