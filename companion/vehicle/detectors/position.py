"""What is wrong with the own position."""

from math import dist

from companion.core.failsafe import CREEP_LIMIT_M, FROZEN_S, JUMPS_S, LOST_S, UNCERTAIN_S, Failsafe
from companion.core.health import Debounce
from companion.core.values import FILTERED_PHASES, Instant
from companion.vehicle.detectors.base import Detector, Finding, Note
from companion.vehicle.flight import Flight

NO_SETPOINTS = Note("no setpoints")
"""no failsafe of ours acts: positions may come again before the autopilot's does, and if it acts, it leaves OFFBOARD,
which is one"""


def _lost_just_now(flight: Flight, now: Instant) -> bool:
    return flight.unpositioned_since_ns == now.monotonic_ns


class PositionStale(Detector):
    """No new position comes."""

    failsafe = Failsafe.POSITION_STALE
    phases = FILTERED_PHASES

    def look(self, flight: Flight, now: Instant) -> Note | None:
        return NO_SETPOINTS if _lost_just_now(flight, now) and not flight.positions.frozen else None


class PositionFrozen(Detector):
    """Positions come and do not change, though the vehicle moves."""

    failsafe = Failsafe.POSITION_FROZEN
    phases = FILTERED_PHASES

    def look(self, flight: Flight, now: Instant) -> Note | None:
        return NO_SETPOINTS if _lost_just_now(flight, now) and flight.positions.frozen else None


class PositionLost(Detector):
    """By now the autopilot's own failsafe has the vehicle, whether or not we can hear it."""

    failsafe = Failsafe.POSITION_LOST
    phases = FILTERED_PHASES

    def look(self, flight: Flight, now: Instant) -> Finding | None:
        since_ns = flight.unpositioned_since_ns
        if since_ns is None:
            return None
        frozen = now.monotonic_ns - since_ns > (LOST_S - FROZEN_S) * 1e9
        return Finding() if frozen or flight.autopilot.position_age_s(now) > LOST_S else None


class PositionUncertain(Detector):
    """The estimate may drift towards the others."""

    failsafe = Failsafe.COVARIANCE
    phases = FILTERED_PHASES
    needs_position = True

    def __init__(self) -> None:
        self._uncertain = Debounce(UNCERTAIN_S)

    def look(self, flight: Flight, now: Instant) -> Finding | None:
        estimate = flight.autopilot.estimate(now)
        if self._uncertain.holds(not estimate.certain, now.monotonic_ns):
            return Finding(f"{estimate.accuracy_m:.1f} m, flags {estimate.flags:#x}")
        crept_m = dist(flight.autopilot.origin_crept_ned_m, flight.engaged_origin_crept_ned_m)
        return Finding(f"estimator's origin has crept {crept_m:.1f} m") if crept_m > CREEP_LIMIT_M else None


class PositionJumpsOn(Detector):
    """A jump follows a jump, and the vehicle does not come back to its slot."""

    failsafe = Failsafe.POSITION_JUMPS
    phases = FILTERED_PHASES
    needs_position = True

    def look(self, flight: Flight, now: Instant) -> Finding | None:
        begun_ns = flight.jumps.begun_ns
        lasts = begun_ns is not None and now.monotonic_ns - begun_ns > JUMPS_S * 1e9
        return Finding() if flight.jumped and lasts else None


class PositionJumped(Detector):
    """The position is not where the motion leads; of a series of jumps only the first is said."""

    failsafe = Failsafe.POSITION_JUMPED
    phases = FILTERED_PHASES
    needs_position = True

    def look(self, flight: Flight, now: Instant) -> Finding | None:
        return Finding(said=flight.jumps.begun_ns != now.monotonic_ns) if flight.jumped else None
