"""What waits for the control loop: of each kind a bounded number, and a bounded part of it at each turn.

Whoever sends more than is taken drives out the oldest of its own kind and nothing else: a flood of states does not push
out a plan, nor a flood of questions a command. One turn's share of every kind together takes a few control periods at
most, whatever waits.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import Final, Generic, NamedTuple, Protocol, TypeVar


class Received(Protocol):
    """Anything that came in at a time."""

    @property
    def received_monotonic_ns(self) -> int:
        """When (this machine's monotonic clock, ns)."""


class Bound(NamedTuple):
    """How much of a kind may wait, and how much of it is taken at a turn."""

    waiting: int
    a_turn: int


BOUNDS: Final = {
    "state": Bound(4096, 256),  # twenty peers at 50 Hz: four seconds
    "plan": Bound(64, 2),  # examining one may take a whole control period
    "command": Bound(64, 2),  # a motion among them is a plan too
    "preflight": Bound(16, 4),
    "status": Bound(16, 4),
}
OTHERWISE: Final = Bound(256, 16)
T = TypeVar("T", bound=Received)


@dataclass(slots=True)
class Mailbox(Generic[T]):
    """Not safe for threads by itself: its owner holds a lock."""

    bounds: dict[str, Bound] = field(default_factory=lambda: dict(BOUNDS))
    dropped: int = 0
    """what was driven out by what came later"""
    _waiting: dict[str, deque[T]] = field(default_factory=dict)

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    def put(self, kind: str, item: T) -> None:
        """Keep it for a later turn; the oldest of its kind goes if there are too many."""
        kind = kind if kind in self.bounds else ""
        queue = self._waiting.setdefault(kind, deque())
        if len(queue) >= self.bounds.get(kind, OTHERWISE).waiting:
            queue.popleft()
            self.dropped += 1
        queue.append(item)

    def take(self) -> list[T]:
        """One turn's share, in the order in which it came."""
        items = []
        for kind, queue in self._waiting.items():
            items += [queue.popleft() for _ in range(min(len(queue), self.bounds.get(kind, OTHERWISE).a_turn))]
        items.sort(key=lambda item: item.received_monotonic_ns)
        return items

    def clear(self) -> None:
        """Forget all."""
        self._waiting.clear()
