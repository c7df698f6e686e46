"""A message in each period, whatever the errors: what event triggers are compared with."""

from typing import NamedTuple

from companion.core.monitor import PeerMotion, unheard_error_m
from companion.core.trigger.base import Situation


class PeriodicTrigger(NamedTuple):
    """One message in each period, whatever the errors."""

    period_s: float

    def fires(self, now: Situation) -> bool:
        """Whether a period has ended since the last message.

        The ends lie on a fixed grid of the clock, not one period after each message: control ticks that do not divide
        the period would else stretch every one of them to the next tick.
        """
        return period_ended(now.time_ns, now.sent_ns, max(round(self.period_s * 1e9), 1))

    def error_bound_m(self, motion: PeerMotion) -> float:
        """What a vehicle can do unseen in one period, or in T_max where that is shorter, and the latency."""
        return unheard_error_m(min(self.period_s, motion.t_max_s) + motion.latency_s, motion)

    @property
    def waits(self) -> bool:
        """False."""
        return False

    @property
    def cause(self) -> str:
        """Its period."""
        return f"$.trigger.period_s = {self.period_s:g} s"


def period_ended(time_ns: int, sent_ns: int, period_ns: int) -> bool:
    """Whether the end of a period, a multiple of `period_ns`, lies after `sent_ns` and not after `time_ns`."""
    return time_ns // period_ns > sent_ns // period_ns
