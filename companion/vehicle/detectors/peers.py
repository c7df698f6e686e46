"""What the absence of the others decides. What is wrong with one peer, `core.neighbours` notices."""

from companion.core.failsafe import Action, Failsafe
from companion.core.values import FILTERED_PHASES, Instant, Phase
from companion.vehicle.detectors.base import Detector, Finding
from companion.vehicle.flight import Flight


class OthersMissing(Detector):
    """At altitude, and the others do not come."""

    failsafe = Failsafe.MISSING
    phases = frozenset({Phase.WAITING})
    needs_position = True

    def look(self, flight: Flight, now: Instant) -> Finding | None:
        peers = flight.config.peers
        waits = flight.config.plan.automatic and flight.history.newest.revision == 0 and not flight.forms_without
        if not waits or flight.lasts_s(now) <= peers.wait_s:
            return None
        missing = [i for i, phase in flight.peers.phases().items() if phase not in FILTERED_PHASES]
        detail = f"waited for vehicle {', '.join(map(str, missing))} in vain" if missing else "waited in vain"
        return Finding(detail, Action(peers.missing))


class _Isolated(Detector):
    phases = FILTERED_PHASES
    needs_position = True


class Deaf(_Isolated):
    """The others are said to be there, and none is heard: the link is gone."""

    failsafe = Failsafe.DEAF

    def look(self, flight: Flight, now: Instant) -> Finding | None:
        return Finding() if flight.isolated_since_ns == now.monotonic_ns and flight.peers.deaf(now) else None


class Alone(_Isolated):
    """The others are gone."""

    failsafe = Failsafe.ALONE

    def look(self, flight: Flight, now: Instant) -> Finding | None:
        return Finding() if flight.isolated_since_ns == now.monotonic_ns and not flight.peers.deaf(now) else None


class AloneForLong(_Isolated):
    """Nobody came back."""

    failsafe = Failsafe.ALONE_FOR_LONG

    def look(self, flight: Flight, now: Instant) -> Finding | None:
        since_ns, limit_s = flight.isolated_since_ns, flight.config.failsafe.isolated_hold_s
        return Finding() if since_ns is not None and now.monotonic_ns - since_ns > limit_s * 1e9 else None


class DetachedForLong(Detector):
    """The others are heard, and there is no way back to them: no plan was told, say."""

    failsafe = Failsafe.DETACHED_FOR_LONG
    phases = frozenset({Phase.DETACHED})
    needs_position = True

    def look(self, flight: Flight, now: Instant) -> Finding | None:
        since_ns, limit_s = flight.stands_since_ns, flight.config.peers.wait_s
        if since_ns is None or flight.isolated_since_ns is not None:
            return None
        return Finding() if now.monotonic_ns - since_ns > limit_s * 1e9 else None
