"""How far the vehicles' clocks are from the operator's: asked several times, the least delayed reading counts."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from companion.errors import WireError
from companion.operator.roster import RETRY_S, STATUS_TIMEOUT_S, Link
from companion.wire.operator import CLOCK_QUESTION, ClockReading, decode

ROUNDS_LEAST, ROUNDS_MOST = 3, 10
SURE_SHARE = 0.25
"""clocks are asked again until each is known to this share of their limit, or the rounds are over"""


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """A vehicle's fleet time minus the operator's UTC."""

    ahead_s: float
    uncertain_s: float
    """half the question's time on the way"""


class Exchange(NamedTuple):
    """One question and its answer (UTC, ns): the operator's clock outside, the vehicle's inside."""

    asked_ns: int
    received_ns: int
    answered_ns: int
    back_ns: int

    @property
    def offset(self) -> ClockOffset:
        """As if both ways took the same time."""
        on_the_way = (self.back_ns - self.asked_ns) - (self.answered_ns - self.received_ns)
        ahead = (self.received_ns - self.asked_ns) + (self.answered_ns - self.back_ns)
        return ClockOffset(ahead * 0.5e-9, on_the_way * 0.5e-9)


def best_offset(exchanges: Iterable[Exchange]) -> ClockOffset | None:
    """The least delayed of several; None if none is possible (an answer that took less than no time)."""
    possible = [o for e in exchanges if (o := e.offset).uncertain_s >= 0.0]
    return min(possible, key=lambda o: o.uncertain_s, default=None)


def clock_offsets(
    link: Link, vehicle_ids: Iterable[int], limit_s: float
) -> tuple[dict[int, ClockOffset | None], dict[int, set[int]]]:
    """Each vehicle's offset (None: no answer) and the boot ids that answered under its id.

    `limit_s`: how far clocks may be apart; who is known to a good part of that is not asked again.
    """
    exchanges: dict[int, list[Exchange]] = {i: [] for i in vehicle_ids}
    boots: dict[int, set[int]] = {i: set() for i in exchanges}
    for k in range(ROUNDS_MOST if exchanges else 0):
        told = link.ask_timed(exchanges, "preflight", CLOCK_QUESTION, STATUS_TIMEOUT_S, RETRY_S)
        for i, answer in told.items():
            if answer is None:
                continue
            payload, asked_ns, back_ns = answer
            try:
                reading = decode(ClockReading, payload)
            except WireError:
                continue
            exchanges[i].append(Exchange(asked_ns, reading.received_ns, reading.answered_ns, back_ns))
            boots[i].add(reading.boot_id)
        known = [best_offset(e) for e in exchanges.values()]
        if k + 1 >= ROUNDS_LEAST and all(o is not None and o.uncertain_s <= SURE_SHARE * limit_s for o in known):
            break
    return {i: best_offset(e) for i, e in exchanges.items()}, boots
