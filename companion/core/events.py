"""What happens to a vehicle in flight, as values: a flight is judged by these, and `sentence` makes text of them."""

from dataclasses import dataclass
from enum import Enum, unique

from companion.core.failsafe import Action, Failsafe
from companion.core.phase import PhaseEvent
from companion.core.trajectory.fleet import FleetTrajectory
from companion.core.values import Phase


@unique
class KillCause(Enum):
    """How a vehicle's motors came to stop before it had landed."""

    COMMAND = "killed by command"
    FELL = "its motors stopped in the air"


@dataclass(frozen=True, slots=True)
class PhaseChanged:
    """A vehicle went from one phase to another."""

    before: Phase
    after: Phase
    why: PhaseEvent


@dataclass(frozen=True, slots=True)
class MotionAdopted:
    """A vehicle flies by this motion from its start on: its own proposal, a peer's, or an operator's."""

    motion: FleetTrajectory


@dataclass(frozen=True, slots=True)
class FailsafeActed:
    """A failsafe was noticed and acted on."""

    failsafe: Failsafe
    action: Action
    detail: str
    """in which way it failed; may be empty"""

    @property
    def sentence(self) -> str:
        """What failed, in which way, and what was done."""
        return ": ".join(x for x in (self.failsafe.value, self.detail, self.action.value) if x)


@dataclass(frozen=True, slots=True)
class FailsafeNoted:
    """A failsafe was noticed, and calls for no action."""

    failsafe: Failsafe
    detail: str


@dataclass(frozen=True, slots=True)
class PeerDoubted:
    """A peer's states cannot all be true."""

    vehicle_id: int
    failsafe: Failsafe
    detail: str
    """what is done about it"""


@dataclass(frozen=True, slots=True)
class GraphNearBreaking:
    """The graph of those that heed each other has fallen apart, or the loss of one vehicle would split it."""

    edge: int
    """the vehicle at its edge"""
    lambda2: float


@dataclass(frozen=True, slots=True)
class NoWayBack:
    """The fleet's way back to its pads cannot be flown: the vehicle lands where it is."""

    reason: str


@dataclass(frozen=True, slots=True)
class KillCommanded:
    """The operator has the motors stopped."""


@dataclass(frozen=True, slots=True)
class KillGivenUp:
    """The autopilot did not stop the motors."""


@dataclass(frozen=True, slots=True)
class Killed:
    """A vehicle's motors were stopped before it had landed."""

    cause: KillCause


@dataclass(frozen=True, slots=True)
class ResumeGivenUp:
    """The autopilot did not follow setpoints again."""

    mode: str
    """in which it stays"""


@dataclass(frozen=True, slots=True)
class AutopilotRebooted:
    """The autopilot's time since boot has begun anew."""


@dataclass(frozen=True, slots=True)
class AutopilotIdentified:
    """The autopilot has told what it is."""

    software: str
    """its name and version"""


@dataclass(frozen=True, slots=True)
class OriginMoved:
    """The autopilot's estimator has another origin."""


@dataclass(frozen=True, slots=True)
class RequestRefused:
    """The autopilot refused what was asked of it."""

    request: str
    result: int
    """the autopilot's own number of the reason"""


@dataclass(frozen=True, slots=True)
class RequestUnanswered:
    """The autopilot never answered what was asked of it."""

    request: str


Event = (
    PhaseChanged | MotionAdopted | FailsafeActed | FailsafeNoted | PeerDoubted | GraphNearBreaking | NoWayBack
    | KillCommanded | KillGivenUp | Killed | ResumeGivenUp | AutopilotRebooted | AutopilotIdentified | OriginMoved
    | RequestRefused | RequestUnanswered
)  # fmt: skip


def sentence(event: Event) -> str:
    """An event as logs and recordings show it to people."""
    match event:
        case PhaseChanged(before, after, why):
            return f"{before.name.lower()} -> {after.name.lower()}: {why.value}"
        case MotionAdopted(motion):
            return f"motion {motion.revision} ({motion.shape}) by {motion.issuer or 'the operator'}"
        case FailsafeActed():
            return f"failsafe: {event.sentence}"
        case FailsafeNoted(failsafe, detail):
            return f"{failsafe.value}: {detail}"
        case PeerDoubted(vehicle_id, failsafe, detail):
            return f"vehicle {vehicle_id}: {failsafe.value}: {detail}"
        case GraphNearBreaking(edge, lambda2):
            return f"the graph of neighbours is near breaking: vehicle {edge} is at its edge, lambda2 {lambda2:.2f}"
        case NoWayBack(reason):
            return f"no way back to the pads: {reason}: land"
        case KillCommanded():
            return "killed by command: the motors are stopped"
        case KillGivenUp():
            return "kill given up: the autopilot has not disarmed"
        case Killed(cause):
            return f"killed: {cause.value}"
        case ResumeGivenUp(mode):
            return f"resume given up: the autopilot stays in {mode}"
        case AutopilotRebooted():
            return "autopilot rebooted"
        case AutopilotIdentified(software):
            return f"autopilot is {software}"
        case OriginMoved():
            return "estimator origin moved"
        case RequestRefused(request, result):
            return f"autopilot refused {request} (result {result})"
        case RequestUnanswered(request):
            return f"autopilot never answered {request}"
