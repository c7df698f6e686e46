"""The operator's commands as a vehicle takes them: in their order, each once, with an answer that a retry gets again.

A vehicle tells its place: which companion it is (boot id), how many flights it has begun, how many commands it has
obeyed. A command names, for each vehicle that it is for, the place that its operator saw. So it says what was known
when it was given, and a vehicle that has gone on since knows that it comes late:

- what begins or changes a flight is obeyed at exactly that place: whatever was obeyed in between refuses it;
- what ends a flight (`wire.operator.ENDING`) is obeyed throughout that flight: nothing that was obeyed in between
  keeps it away, but one that was captured or held up does not reach a later flight, nor another companion.

Nobody can be locked out: a place is the vehicle's own and is told with every answer, the refusing ones too. No number
is shared, so none can be used up by somebody else, by a companion that starts late, or by time.
"""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from hashlib import blake2s

from companion.core.counts import Refusal
from companion.wire.operator import COMMAND_FAULTS, ENDING, Command, Place

ANSWERS_KEPT = 32
"""a retry comes within seconds; operators give a command a second at most"""
ORDER_FAULTS = (*COMMAND_FAULTS, "not in order")
"""every kind of refusal before a command's own: of its form, and of its place in the order"""


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

    def refusal(self, verb: str, after: Sequence[Place], begun: int) -> Refusal | None:
        """Why a command comes too late, or is not for this companion; `after`: this vehicle's places in it."""
        here = self.place(begun)
        if here in after or (verb in ENDING and any(p[:2] == here[:2] for p in after)):
            return None
        if not after:
            why = "it does not say at which place it finds this vehicle"
        elif all(p.boot_id != here.boot_id for p in after):
            why = "it is for another companion of this vehicle, which was started anew since or runs beside it"
        elif all(p.begun != begun for p in after):
            why = "it is for another flight of this vehicle"
        else:
            why = f"{self._last} was obeyed in between"
        return Refusal("not in order", why)

    def obeyed_now(self, command: Command) -> None:
        """Go on by one place."""
        self.obeyed += 1
        self._last = f"{command.verb} by {command.issuer}"

    def answered(self, payload: bytes, answer: bytes) -> None:
        """Remember a command's answer."""
        self._answers[_digest(payload)] = answer
        while len(self._answers) > ANSWERS_KEPT:
            self._answers.popitem(last=False)


def _digest(payload: bytes) -> bytes:
    return blake2s(payload, digest_size=16).digest()
