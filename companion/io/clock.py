"""The only reader of clocks: monotonic time, and fleet time made from it."""

import time

from companion.core.values import Instant

SLEW_PER_S = 500e-6
"""how fast a latched fleet clock may be drawn toward UTC (s per s)"""


class FleetClock:
    """Fleet time: UTC latched to the monotonic clock, and from then on slewed toward UTC, never stepped."""

    def __init__(self) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self._latched_ns: int | None = None

    def now(self) -> Instant:
        """The present."""
        return self.at(time.monotonic_ns())

    def at(self, monotonic_ns: int) -> Instant:
        """A monotonic time with the fleet time that belongs to it."""
        return Instant(monotonic_ns, monotonic_ns + self._offset_ns)

    def discipline(self, latched: bool) -> None:
        """Follow UTC: at once on the ground, slowly once `latched` (from arming on). To be called each second."""
        wanted = time.time_ns() - time.monotonic_ns()
        now_ns = time.monotonic_ns()
        if not latched:
            self._offset_ns, self._latched_ns = wanted, None
            return
        if self._latched_ns is not None:
            most = round((now_ns - self._latched_ns) * SLEW_PER_S)
            self._offset_ns += min(max(wanted - self._offset_ns, -most), most)
        self._latched_ns = now_ns


def realtime_to_monotonic(realtime_ns: int) -> int:
    """A kernel time stamp (CLOCK_REALTIME, as SO_TIMESTAMPNS gives it) on the monotonic clock; never later than now.

    Wall time set back between stamp and reading would else put the stamp into the future.
    """
    now_ns = time.monotonic_ns()
    return min(realtime_ns - (time.time_ns() - now_ns), now_ns)
