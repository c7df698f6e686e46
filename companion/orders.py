"""The operator's commands as a vehicle takes them: in their order, each once, with an answer that a retry gets again.

A command is a JSON object with a verb, a revision and an issuer. (revision, issuer) orders them: one that is not newer
than the last that was obeyed is refused, so that no late one overrides what came after it. The operator takes the
newest revision that any vehicle tells, plus one. Every answer tells the last command that was obeyed: an operator whose
command came out of order can command again above it.
"""

import json
from dataclasses import dataclass
from typing import Any

from companion.core.counts import Refusal

REVISION_JUMP_MAX = 10_000
"""no command and no motion is further ahead of the last one than this: nobody may use up the numbers for all others"""
ISSUER_LENGTH_MAX = 64
ORDER_FAULTS = ("malformed", "unknown verb", "revision", "issuer", "not in order")
"""every kind of refusal that is made here"""
VERBS = ("takeoff", "land", "motion", "release", "resume", "kill")


@dataclass(frozen=True, slots=True)
class Order:
    """One command."""

    verb: str
    revision: int
    issuer: str
    fields: dict[str, Any]

    @property
    def rank(self) -> tuple[int, str]:
        """Larger is newer."""
        return (self.revision, self.issuer)


def read_order(payload: bytes) -> Order | Refusal:
    """The command in a payload, or what is wrong with it."""
    try:
        fields = json.loads(payload)
        verb = fields["verb"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return Refusal("malformed", "not a command: needs a JSON object with a verb")
    if verb not in VERBS:
        return Refusal("unknown verb", f"unknown verb {verb!r:.60}; known: {', '.join(VERBS)}")
    revision, issuer = fields.get("revision"), fields.get("issuer")
    if not isinstance(revision, int) or isinstance(revision, bool) or revision < 1:
        return Refusal("revision", f"revision must be a whole number >= 1, got {revision!r:.60}")
    if not isinstance(issuer, str) or not 0 < len(issuer) <= ISSUER_LENGTH_MAX:
        return Refusal("issuer", f"issuer must be a name of up to {ISSUER_LENGTH_MAX} characters, got {issuer!r:.60}")
    return Order(verb, revision, issuer, fields)


@dataclass(slots=True)
class OrderBook:
    """The last command that was obeyed, and the last answer."""

    revision: int = 0
    issuer: str = ""
    _payload: bytes | None = None
    _answer: bytes = b""

    def answer_again(self, payload: bytes) -> bytes | None:
        """The answer given to these bytes, if they are the last command's: a retry changes nothing."""
        return self._answer if payload == self._payload else None

    def refusal(self, order: Order) -> Refusal | None:
        """Why a command comes too late or is out of all order."""
        if order.rank <= (self.revision, self.issuer):
            return Refusal(
                "not in order",
                f"command {order.revision} by {order.issuer} is not newer than {self.revision} by {self.issuer}, "
                "the last that was obeyed",
            )
        if order.revision > self.revision + REVISION_JUMP_MAX:
            return Refusal(
                "not in order",
                f"command {order.revision} is more than {REVISION_JUMP_MAX} ahead of the last, {self.revision}",
            )
        return None

    def obeyed(self, order: Order) -> None:
        """Remember a command's place in the order."""
        self.revision, self.issuer = order.rank

    def answered(self, payload: bytes, answer: bytes) -> None:
        """Remember a command's answer."""
        self._payload, self._answer = payload, answer
