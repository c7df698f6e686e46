"""What a detector is: the one that notices one row of `core.failsafe.FAILSAFES`."""

from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

from companion.core.failsafe import Action, Failsafe
from companion.core.values import Instant, Phase
from companion.vehicle.flight import Flight


class Finding(NamedTuple):
    """A failsafe to act on."""

    detail: str = ""
    """in which way it failed"""
    action: Action | None = None
    """what the configuration chose among the row's ways; None: the row's action"""
    said: bool = False
    """whether it was said before, and is acted on again without another word"""


class Note(NamedTuple):
    """A failsafe to say and to count, that calls for no action."""

    detail: str


class Detector(ABC):
    """Notices one failsafe. It is asked at each control tick of its phases, and only reads the flight."""

    failsafe: ClassVar[Failsafe]
    phases: ClassVar[frozenset[Phase]]
    """in which it is asked"""
    needs_position: ClassVar[bool] = False
    """whether it is not asked while the vehicle is to be steered and does not know where it is"""

    @abstractmethod
    def look(self, flight: Flight, now: Instant) -> Finding | Note | None:
        """What is found now; None: nothing, or nothing new."""
