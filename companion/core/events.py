"""What happens to a vehicle in flight, as values: a flight is judged by these, and text is made where it is shown."""

from dataclasses import dataclass
from enum import Enum, unique

from companion.core.failsafe import Failsafe
from companion.core.trajectory import FleetTrajectory
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


@dataclass(frozen=True, slots=True)
class MotionAdopted:
    """A vehicle flies by this motion from its start on: its own proposal, a peer's, or an operator's."""

    motion: FleetTrajectory


@dataclass(frozen=True, slots=True)
class FailsafeActed:
    """A failsafe was noticed and acted on."""

    failsafe: Failsafe
    sentence: str
    """what failed, in which way, and what was done"""


@dataclass(frozen=True, slots=True)
class Killed:
    """A vehicle's motors were stopped before it had landed."""

    cause: KillCause


Event = PhaseChanged | MotionAdopted | FailsafeActed | Killed
