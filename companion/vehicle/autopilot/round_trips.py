"""How long a link takes there and back, asked for once a second."""

from collections import deque
from dataclasses import dataclass, field

PERIOD_NS = 1_000_000_000
SAMPLES = 5
SILENCE_NS = 3_500_000_000
"""no answer for so long, where one is asked for: the link's time is not known"""
OPEN_MOST = 8


@dataclass(slots=True)
class RoundTrips:
    """Requests for the time and their answers; a request is known by when it was asked."""

    _last_ns: deque[int] = field(default_factory=lambda: deque(maxlen=SAMPLES))
    _open_ns: deque[int] = field(default_factory=lambda: deque(maxlen=OPEN_MOST))
    """when what is not answered yet was asked"""
    _asked_ns: int = 0
    _heard_ns: int = 0

    @property
    def deadline_ns(self) -> int:
        """When to ask next (monotonic ns)."""
        return self._asked_ns + PERIOD_NS

    def ask(self, now_ns: int) -> bool:
        """Whether to ask now."""
        due = now_ns >= self.deadline_ns
        if due:
            self._asked_ns = now_ns
            self._open_ns.append(now_ns)
        return due

    def answered(self, asked_ns: int, now_ns: int) -> bool:
        """Take an answer to what was asked at a time; False if nothing was."""
        if asked_ns not in self._open_ns:
            return False
        self._open_ns.remove(asked_ns)
        self._heard_ns = now_ns
        self._last_ns.append(now_ns - asked_ns)
        return True

    def restart(self) -> None:
        """Forget: the autopilot has booted anew."""
        self._last_ns.clear()

    def median_s(self, now_ns: int, asking: bool) -> float | None:
        """Median of the last; None without one, and without an answer of late while one is asked for."""
        if not self._last_ns or (asking and now_ns - self._heard_ns > SILENCE_NS):
            return None
        return sorted(self._last_ns)[len(self._last_ns) // 2] * 1e-9
