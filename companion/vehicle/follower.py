"""Where the vehicle is to be: in its slot, or on a way of its own that never jumps, and whether it has arrived."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import dist, hypot

from companion.core.failsafe import LISTEN_S
from companion.core.phase import PhaseEvent
from companion.core.rejoin import RejoinTrajectory
from companion.core.trajectory.fleet import Reference
from companion.core.values import FORMATION_PHASES, ZERO, Instant, Phase, VehicleState
from companion.vehicle.flight import Flight

SLOT_JUMP_M = 1.0
"""a slot that is suddenly so far from where it was is not followed there at once"""
ENGAGED_AWAY_M = 3.0
"""whoever engages so far from its slot comes to it by a way of its own"""
SETTLED_TOLERANCE_M = 0.6
SETTLED_HEIGHT_M = 1.0
SETTLED_FOR_NS = 1_000_000_000
RETURNED_LIMIT_NS = 15_000_000_000
"""whoever is not over its pad so long after the way back has ended lands where it is"""


@dataclass(slots=True)
class Follower:
    """Follows the slot in formation; detached, it stands until it hears the others, and comes back smoothly."""

    flight: Flight
    happened: Callable[[PhaseEvent, Instant], None]
    """the supervisor's"""
    settled_blend_ns: int | None = None
    """start of the change of formation whose end this vehicle has settled in"""
    _own: RejoinTrajectory = field(default_factory=lambda: RejoinTrajectory(ZERO))
    _listens_until_ns: int = 0
    _engages: bool = False
    """whether the vehicle has just engaged, and may be elsewhere"""
    _slot: tuple[int, Reference] | None = None
    """the slot's reference of the tick before, and its fleet time"""
    _reference: Reference | None = None
    """the own one"""
    _settled_since_ns: int | None = None

    def phase_changed(self, event: PhaseEvent) -> None:
        """Another phase has begun."""
        self._settled_since_ns = None
        if event in (PhaseEvent.ENGAGED, PhaseEvent.RESUMED):
            self._engages = event is PhaseEvent.ENGAGED

    def stand(self, now: Instant, listen_s: float = LISTEN_S) -> None:
        """Stand by itself where the vehicle is; it comes back after listening so long."""
        self._own = RejoinTrajectory(self.flight.autopilot.position_ned_m)
        self.flight.stands_since_ns = now.monotonic_ns
        self._listens_until_ns = now.monotonic_ns + round(listen_s * 1e9)
        self.happened(PhaseEvent.STRAYED, now)

    def follow(self, slot: Reference, ego: VehicleState, now: Instant, resuming: bool) -> Reference:
        """The own reference now; `resuming`: setpoints stream for an autopilot that does not follow them yet."""
        before, self._slot = self._slot, (now.fleet_ns, slot)
        if resuming:
            self._reference = Reference(ego.position_ned_m, ZERO, ZERO, slot.heading_rad)
            return self._reference
        jumps = before is not None and _apart_m(*before, slot, now.fleet_ns) > SLOT_JUMP_M
        # Where no motion is shared the slot is where the neighbours are, and whoever comes or goes moves it.
        free = self.flight.history.at(now.fleet_ns).free_at(now.fleet_ns)
        if self.flight.phase in FORMATION_PHASES:
            if self._engages and dist(ego.position_ned_m, slot.position_ned_m) > ENGAGED_AWAY_M:
                self.stand(now)
            elif jumps and not free and self._reference is not None:
                self.stand(now, listen_s=0.0)
                self._set_out(slot, self._reference, now)
            self._engages = False
        if self.flight.phase is Phase.DETACHED:
            self._come_back(slot, jumps, now)
        detached = self.flight.phase is Phase.DETACHED
        self._reference = self._own.reference(slot, now.fleet_ns) if detached else slot
        return self._reference

    def _come_back(self, slot: Reference, jumps: bool, now: Instant) -> None:
        own = self._own
        if own.start_ns is None:
            if now.monotonic_ns >= self._listens_until_ns and not self.flight.outdated and self._hears_somebody(now):
                self._set_out(slot, own.reference(slot, now.fleet_ns), now)
        elif jumps and self._reference is not None:
            self._set_out(slot, self._reference, now)
        elif own.over(now.fleet_ns):
            self.happened(PhaseEvent.REJOINED, now)

    def _set_out(self, slot: Reference, here: Reference, now: Instant) -> None:
        self._own.come_back(slot, here, now.fleet_ns, self.flight.config.limits.speed_max_m_s / 2)
        self.flight.stands_since_ns = None

    def _hears_somebody(self, now: Instant) -> bool:
        peers = self.flight.peers
        return not peers.ids or (peers.silent_for_s(now) == 0.0 and not peers.deaf(now))

    def arrived(self, ego: VehicleState, reference: Reference, now: Instant) -> PhaseEvent | None:
        """What follows from where the vehicle is: it has taken its slot, or is back over its pad and lands."""
        phase, history = self.flight.phase, self.flight.history
        newest = history.newest
        over_ns = newest.end_ns if phase is Phase.RETURNING else newest.blend_end_ns
        if phase not in (Phase.FORMING, Phase.RETURNING) or over_ns is None or now.fleet_ns < over_ns:
            return None
        if history.at(now.fleet_ns) is not newest:
            return None
        settled = self._settled(ego, reference, now)
        if phase is Phase.RETURNING:
            return PhaseEvent.LAND if settled or now.fleet_ns > over_ns + RETURNED_LIMIT_NS else None
        if not settled:
            return None
        self.settled_blend_ns = newest.blend_start_ns
        return PhaseEvent.SETTLED

    def _settled(self, ego: VehicleState, reference: Reference, now: Instant) -> bool:
        p, r = ego.position_ned_m, reference.position_ned_m
        level_m = hypot(p.north - r.north, p.east - r.east)
        if not (level_m < SETTLED_TOLERANCE_M and abs(p.down - r.down) < SETTLED_HEIGHT_M):
            self._settled_since_ns = None
            return False
        if self._settled_since_ns is None:
            self._settled_since_ns = now.monotonic_ns
        return now.monotonic_ns - self._settled_since_ns >= SETTLED_FOR_NS


def _apart_m(then_ns: int, then: Reference, now: Reference, now_ns: int) -> float:
    """How far a reference is from where the one before leads."""
    dt_s = min((now_ns - then_ns) * 1e-9, 1.0)
    p, v = then.position_ned_m, then.velocity_ned_m_s
    led = (p.north + v.north * dt_s, p.east + v.east * dt_s, p.down + v.down * dt_s)
    return dist(led, now.position_ned_m)
