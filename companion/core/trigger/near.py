"""Near mode: vehicles that are near each other speak at a fixed rate, whatever the trigger says.

Near is the safety filter's own measure. The filter (`core.safety.filter`) keeps a half-plane g.u >= b for each peer;
-b/|g| is the push toward the peer (m/s^2) that would break it. A peer is near while less than PUSH_M_S2 would, and for
HOLD_S after; of two in formation whose slots are so close themselves, once they are that much nearer than in their
slots. So a tight formation is not near itself, and a vehicle that leaves its slot toward another is.

A message names the peers that its sender finds near, so that those speak too: one message that arrives is enough for
both of a pair to agree. Being named is not passed on, or two would keep each other speaking for ever.

Who speaks so says in each message that the next one is due soon: a period and a control period later at most. Of such a
peer a receiver knows that a message is missing; of any other, silence and loss look alike. `near_bound_m` says what the
peer may have done meanwhile.

Whoever flies under its own filter finds others near; whoever is in the air answers when it is named. So one that
climbs, lands or is flown by its pilot speaks once somebody under the filter is near it, and vehicles that stand on the
ground never do. A lost peer is not near, since it is not known to hear; nor is anybody where the filter keeps no
distance (`limits.barrier = false`).
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from math import hypot

from companion.core.frames import Ned
from companion.core.monitor import PeerMotion, unheard_error_m
from companion.core.safety.filter import DOWNWASH_RATIO, resting_push_m_s2
from companion.core.trigger.base import Situation
from companion.core.trigger.periodic import PeriodicTrigger
from companion.core.values import Neighbour

PUSH_M_S2 = 2.0
"""a peer is near if a push of this much toward it would break its half-plane"""
STEADY_M_S = 0.05
"""two slots keep their distance if it changes by no more than this"""
HOLD_S = 1.0
"""how long a peer stays near after the half-plane has receded, and after it named us: a few messages may be lost"""
MISSING_MAX_M = 1.0
"""what a missing message adds to a peer's uncertainty, at most"""


@dataclass(slots=True)
class NearMode:
    """One vehicle's near peers, and when to speak because of them. Times are of the own monotonic clock (ns)."""

    rate: PeriodicTrigger
    _near_until_ns: dict[int, int] = field(default_factory=dict)
    _named_until_ns: int = 0
    promised: bool = False
    """the last message said that the next one is due soon"""

    def see(self, ids: Iterable[int], now_ns: int) -> None:
        """Take the peers that are near in this tick."""
        for i in ids:
            self._near_until_ns[i] = now_ns + round(HOLD_S * 1e9)

    def named(self, now_ns: int) -> None:
        """A peer says that this vehicle is near."""
        self._named_until_ns = now_ns + round(HOLD_S * 1e9)

    def peers(self, now_ns: int) -> tuple[int, ...]:
        """Ids of the peers found near, ascending."""
        if not self._near_until_ns:
            return ()
        self._near_until_ns = {i: t for i, t in self._near_until_ns.items() if now_ns < t}
        return tuple(sorted(self._near_until_ns))

    def active(self, now_ns: int) -> bool:
        """Whether to speak at the rate: some peer is near, or named us."""
        return now_ns < self._named_until_ns or bool(self.peers(now_ns))

    def fires(self, now: Situation, active: bool) -> bool:
        """Whether a message is due, as one was promised, or as the mode begins and the last one is a period old."""
        return (active or self.promised) and self.rate.fires(now)


def near_push_m_s2(neighbour: Neighbour, slot_velocity_ned_m_s: Ned, closest_m: float, radius_m: float) -> float:
    """The push toward a peer below which it is near (m/s^2), the own slot moving at `slot_velocity_ned_m_s`.

    Less than PUSH_M_S2 only of a peer in formation whose slot keeps its distance from the own one: PUSH_M_S2 less than
    what the two slots leave with the safety radius `radius_m` of a peer whose messages are not missing. No two slots
    are taken to be closer than `closest_m`, the least that is configured.
    """
    o, v, w = neighbour.offset_ned_m, slot_velocity_ned_m_s, neighbour.reference_velocity_ned_m_s
    apart_m = hypot(o.north, o.east, o.down / DOWNWASH_RATIO)
    parting = o.north * (v.north - w.north) + o.east * (v.east - w.east) + o.down * (v.down - w.down)
    if not neighbour.in_formation or abs(parting) > STEADY_M_S * apart_m:
        return PUSH_M_S2
    return min(PUSH_M_S2, resting_push_m_s2(max(apart_m, closest_m), radius_m) - PUSH_M_S2)


def missing_m(age_s: float, bound_m: float, motion: PeerMotion) -> float:
    """What missing messages add to the bound `bound_m` on a near peer's prediction, by its latest sample's age (m).

    The sample's own age counts, whatever way it came, so that delay widens the bound as loss does. It grows from zero
    on, about a fifth of a second old, at the rate of d/dt (deviation age^2/2): no command jumps.
    """
    return min(max(unheard_error_m(age_s, motion) - bound_m, 0.0), MISSING_MAX_M)


def near_bound_m(age_s: float, bound_m: float, motion: PeerMotion) -> float:
    """How far a peer in near mode is from its prediction at most, lost messages included, by its sample's age (m).

    `bound_m` is the trigger's own bound while nothing is lost. It is

        max(bound, `unheard_error_m` of that age),   no more than bound + MISSING_MAX_M

    The first line holds whatever is lost, since it asks nothing of the messages but their age. The cap ends that: a
    peer silent for longer (`certain_age_s`) may be farther away than this says, and is kept at the cap's distance.
    """
    return bound_m + missing_m(age_s, bound_m, motion)


def certain_age_s(bound_m: float, motion: PeerMotion) -> float:
    """Up to which age of a sample `near_bound_m` holds for certain (s): where the growth meets its cap."""
    low, high = 0.0, motion.t_max_s
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if missing_m(middle, bound_m, motion) < MISSING_MAX_M else (low, middle)
    return low
