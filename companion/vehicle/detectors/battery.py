"""What is wrong with the battery."""

from companion.core.failsafe import BATTERY_S, Action, Failsafe
from companion.core.health import Debounce
from companion.core.values import FILTERED_PHASES, FLYING_PHASES, Instant, Phase
from companion.vehicle.detectors.base import Detector, Finding, Note
from companion.vehicle.flight import Flight


def _below(flight: Flight, percent: float) -> bool:
    return 0 <= flight.autopilot.battery_percent < percent


def _charge(flight: Flight) -> str:
    return f"{flight.autopilot.battery_percent} %"


class BatteryUnknown(Detector):
    """In flight the charge is told no more; to land for it is left to the autopilot."""

    failsafe = Failsafe.BATTERY_UNKNOWN
    phases = frozenset(Phase)

    def __init__(self) -> None:
        self._known = False

    def look(self, flight: Flight, now: Instant) -> Note | None:
        known = flight.autopilot.battery(now) >= 0
        lost, self._known = self._known and not known, known
        return Note(f"last told {_charge(flight)}") if lost and flight.phase in FLYING_PHASES else None


class BatteryCritical(Detector):
    """Too little is left for anything but to land here."""

    failsafe = Failsafe.BATTERY_CRITICAL
    phases = FILTERED_PHASES | {Phase.CLIMBING}
    needs_position = True

    def __init__(self) -> None:
        self._critical = Debounce(BATTERY_S)

    def look(self, flight: Flight, now: Instant) -> Finding | None:
        critical = _below(flight, flight.config.failsafe.battery_critical_percent)
        return Finding(_charge(flight)) if self._critical.holds(critical, now.monotonic_ns) else None


class BatteryLow(Detector):
    """The fleet should go home; once a flight."""

    failsafe = Failsafe.BATTERY_LOW
    phases = FILTERED_PHASES
    needs_position = True

    def __init__(self) -> None:
        self._low = Debounce(BATTERY_S)
        self._said_in: int | None = None
        """number of the flight in which it was said"""

    def look(self, flight: Flight, now: Instant) -> Finding | None:
        limits = flight.config.failsafe
        low = self._low.holds(_below(flight, limits.battery_low_percent), now.monotonic_ns)
        if not low or self._said_in == flight.begun:
            return None
        self._said_in = flight.begun
        action = Action(limits.battery_low)
        if action is Action.RETURN and flight.history.newest.revision == 0:
            action = Action.LAND  # no formation yet that could fly back
        return Finding(_charge(flight), action)
