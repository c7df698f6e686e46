"""How much may be examined of what others send: a bucket of looks that refills with time.

What is examined is paid for afterwards, so one examination may overdraw a bucket; the next waits until it is paid.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field


@dataclass(slots=True)
class Bucket:
    """Looks that may be spent."""

    per_s: float
    most: float
    _left: float = field(init=False)
    _seen_ns: int | None = None

    def __post_init__(self) -> None:
        self._left = self.most

    def open(self, monotonic_ns: int) -> bool:
        """Whether anything is left at a time."""
        if self._seen_ns is not None:
            self._left = min(self._left + (monotonic_ns - self._seen_ns) * 1e-9 * self.per_s, self.most)
        self._seen_ns = monotonic_ns
        return self._left > 0.0

    def spend(self, looks: float) -> None:
        """Pay for an examination."""
        self._left -= looks


SENDER_LOOKS_PER_S, SENDER_LOOKS_MOST = 250.0, 600.0
ALL_LOOKS_PER_S, ALL_LOOKS_MOST = 750.0, 1200.0
"""a look is some 15 us of a fast core: about a hundredth of it goes to what is refused, however much of it comes"""


@dataclass(slots=True)
class ExaminationBudget:
    """One bucket for each sender, so that one that rages does not silence the others, and one for all together."""

    senders: Iterable[int]
    _each: dict[int, Bucket] = field(init=False)
    _all: Bucket = field(init=False)

    def __post_init__(self) -> None:
        self._each = {i: Bucket(SENDER_LOOKS_PER_S, SENDER_LOOKS_MOST) for i in self.senders}
        self._all = Bucket(ALL_LOOKS_PER_S, ALL_LOOKS_MOST)

    def open(self, sender: int, monotonic_ns: int) -> bool:
        """Whether something that a sender of those known has sent may be examined."""
        # Both are asked, since both refill by it.
        each, together = self._each[sender].open(monotonic_ns), self._all.open(monotonic_ns)
        return each and together

    def spend(self, sender: int, looks: float) -> None:
        """Pay for it."""
        self._each[sender].spend(looks)
        self._all.spend(looks)
