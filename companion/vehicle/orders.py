"""The operator's commands as a vehicle takes them: in their order, each once, with an answer that a retry gets again.

A vehicle tells its place: which companion it is (boot id), how many flights it has begun, how many commands it has
obeyed. A command names, for each vehicle that it is for, the place that its operator saw. So it says what was known
when it was given, and a vehicle that has gone on since knows that it comes late:

- what begins or changes a flight is obeyed at exactly that place: whatever was obeyed in between refuses it;
- what ends a flight (`ENDING`) is obeyed throughout that flight: nothing that was obeyed in between keeps it away, but
  one that was captured or held up does not reach a later flight, nor another companion.

Nobody can be locked out: a place is the vehicle's own and is told with every answer, the refusing ones too. No number
is shared, so none can be used up by somebody else, by a companion that starts late, or by time.
"""

import json
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass, field
from hashlib import blake2s
from typing import Any, NamedTuple

from companion.core.counts import Refusal
from companion.core.trajectory import REVISIONS

REVISION_JUMP_MAX = 10_000
"""no motion is further ahead than this of those that are known: nobody may use up the revisions for all others"""
NAME_LENGTH_MAX = 64
"""of a command's id and issuer"""
PLACES_MAX = 8
"""so many companions of one vehicle id may be addressed at a time"""
ANSWERS_KEPT = 32
"""a retry comes within seconds; operators give a command a second at most"""
ORDER_FAULTS = ("malformed", "unknown verb", "id", "issuer", "places", "not in order")
"""every kind of refusal that is made here"""
VERBS = ("takeoff", "land", "motion", "release", "resume", "kill")
ENDING = frozenset({"land", "release", "kill"})
"""what ends a flight"""


class Place(NamedTuple):
    """Where a vehicle is in the order of its commands."""

    boot_id: int
    """of its companion"""
    begun: int
    """flights begun since the companion's start: take-offs and resumptions"""
    obeyed: int
    """commands obeyed since then"""


@dataclass(frozen=True, slots=True)
class Order:
    """One command, as one vehicle reads it."""

    verb: str
    id: str
    """the operator's own: two commands alike are two commands"""
    issuer: str
    after: tuple[Place, ...]
    """this vehicle's places that the operator saw: one, unless two companions answer as this vehicle"""
    fields: dict[str, Any]


def read_order(payload: bytes, vehicle_id: int) -> Order | Refusal:
    """The command in a payload, or what is wrong with it."""
    try:
        fields = json.loads(payload)
        verb = fields["verb"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return Refusal("malformed", "not a command: needs a JSON object with a verb")
    if verb not in VERBS:
        return Refusal("unknown verb", f"unknown verb {verb!r:.60}; known: {', '.join(VERBS)}")
    given_id, issuer = fields.get("id"), fields.get("issuer")
    for name, text in (("id", given_id), ("issuer", issuer)):
        if not isinstance(text, str) or not 0 < len(text) <= NAME_LENGTH_MAX:
            return Refusal(name, f"{name} must be a text of up to {NAME_LENGTH_MAX} characters, got {text!r:.60}")
    after = fields.get("after")
    told = after.get(str(vehicle_id), []) if isinstance(after, dict) else None
    places = [read_place(p) for p in told[: PLACES_MAX + 1]] if isinstance(told, list) else [None]
    if None in places or len(places) > PLACES_MAX:
        return Refusal(
            "places", "after must be an object of vehicle ids, each with [boot id, flights begun, commands obeyed]"
        )
    return Order(verb, given_id, issuer, tuple(p for p in places if p is not None), fields)


def read_place(told: object) -> Place | None:
    """A place as JSON carries it; None for anything else."""
    match told:
        case [int(boot_id), int(begun), int(obeyed)] if not any(isinstance(x, bool) for x in (boot_id, begun, obeyed)):
            return Place(boot_id, begun, obeyed)
    return None


@dataclass(slots=True)
class OrderBook:
    """How many commands were obeyed, and what was answered to the last ones."""

    boot_id: int
    obeyed: int = 0
    _last: str = ""
    """the last command obeyed, for sentences"""
    _answers: OrderedDict[bytes, bytes] = field(default_factory=OrderedDict)
    """digest of a command's bytes -> its answer"""

    def answer_again(self, payload: bytes) -> bytes | None:
        """The answer given to these bytes, if they came before: a retry changes nothing."""
        return self._answers.get(_digest(payload))

    def place(self, begun: int) -> Place:
        """Where this vehicle is; `begun`: flights so far."""
        return Place(self.boot_id, begun, self.obeyed)

    def refusal(self, order: Order, begun: int) -> Refusal | None:
        """Why a command comes too late, or is not for this companion."""
        here = self.place(begun)
        if here in order.after or (order.verb in ENDING and any(p[:2] == here[:2] for p in order.after)):
            return None
        if not order.after:
            why = "it does not say at which place it finds this vehicle"
        elif all(p.boot_id != here.boot_id for p in order.after):
            why = "it is for another companion of this vehicle, which was started anew since or runs beside it"
        elif all(p.begun != begun for p in order.after):
            why = "it is for another flight of this vehicle"
        else:
            why = f"{self._last} was obeyed in between"
        return Refusal("not in order", why)

    def obeyed_now(self, order: Order) -> None:
        """Go on by one place."""
        self.obeyed += 1
        self._last = f"{order.verb} by {order.issuer}"

    def answered(self, payload: bytes, answer: bytes) -> None:
        """Remember a command's answer."""
        self._answers[_digest(payload)] = answer
        while len(self._answers) > ANSWERS_KEPT:
            self._answers.popitem(last=False)


def _digest(payload: bytes) -> bytes:
    return blake2s(payload, digest_size=16).digest()


def revision_fault(revision: int, own: int, told: Iterable[int]) -> str | None:
    """Why a motion's revision is out of all order: none that can be told, or too far ahead of one's own newest and of
    every one `told` by a peer.

    Whoever starts late holds revision 0 and hears from the others' states how far they are.
    """
    if revision >= REVISIONS:
        return "the revisions of motions are used up"
    newest = max([own, *told])
    if revision > newest + REVISION_JUMP_MAX:
        return f"its revision {revision} is more than {REVISION_JUMP_MAX} ahead of {newest}, the newest known"
    return None
