"""Counting what goes wrong, under names from a fixed set; and refusals, whose kind is such a name.

A name that holds a number from outside (a revision, an id) would make a new entry for each message, until the status
that tells the counts is too large to be sent. So a counter knows its names from the start, and whatever else counts as
OTHER.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from enum import StrEnum, unique
from typing import Any, Final, NamedTuple

OTHER: Final = "other"
"""what counts under no name of its own"""


class Counts(Counter[str]):
    """How often each of a fixed set of things has happened; `counts[name] += 1` for a name outside it counts OTHER."""

    def __init__(self, names: Iterable[str]) -> None:
        super().__init__()
        self.names: Final = frozenset(names)

    def _known(self, name: str) -> str:
        return name if name in self.names else OTHER

    def __getitem__(self, name: str) -> int:
        return super().__getitem__(self._known(name))

    def __setitem__(self, name: str, count: int) -> None:
        super().__setitem__(self._known(name), count)

    def update(  # type: ignore[override]
        self, iterable: Iterable[str] | Mapping[str, int] | None = None, /, **more: int
    ) -> None:
        """Count each of these once; a mapping's as often as it says."""
        for name, count in Counter(iterable, **more).items():
            self[name] += count

    def copy(self) -> "Counts":
        """The same names and counts."""
        other = Counts(self.names)
        other.update(self)
        return other

    def __reduce__(self) -> Any:
        return _restored, (self.names, dict(self))


def _restored(names: frozenset[str], counted: dict[str, int]) -> Counts:
    counts = Counts(names)
    counts.update(counted)
    return counts


def summed(*counts: Mapping[str, int]) -> dict[str, int]:
    """Several counts in one, without what has not happened."""
    together: dict[str, int] = {}
    for some in counts:
        for name, count in some.items():
            if count:
                together[name] = together.get(name, 0) + count
    return together


@unique
class RefusalKind(StrEnum):
    """Why a motion is refused, as a name for counting."""

    NOT_NEWER = "not newer"
    REVISION = "its revision is too far ahead"
    VEHICLES = "its vehicles are not this fleet's"
    START = "it starts more than an hour from now"
    RANGE = "it begins out of range"
    PADS = "its pads are not this vehicle's"
    SLOTS = "its slots are not what this vehicle assigns"
    SHAPE = "its shape"
    LEGS = "too many legs"
    ENDLESS = "a leg after an endless turn"
    NO_SLOTS = "no slots"
    TIMES = "times"
    TOO_LONG = "too long"
    NO_LEG = "a velocity without a leg"
    SLOTS_JUMP = "slots jump"
    CHANGE = "change of formation"
    SPEED = "its centre is too fast"
    SLOT_SPEED = "its slots are too fast"
    LOW = "too low"
    SLOTS_MEET = "its slots meet"
    LOOKS = "too many looks"
    FENCE = "it leads outside the fence"
    CLIMB = "it climbs or sinks for ever"


class Refusal(NamedTuple):
    """Why something that was asked is not done."""

    kind: str
    """a short fixed name for counting: for a motion a RefusalKind"""
    sentence: str
    """for people: what came, what is allowed"""
