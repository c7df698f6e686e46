"""What an autopilot does that nobody asked for, and does not do that was asked for."""

from typing import ClassVar

from companion.core.failsafe import (
    CLIMB_S,
    FROZEN_S,
    HEARTBEAT_S,
    NOT_FOLLOWED_M_S,
    NOT_FOLLOWED_S,
    NOT_FOLLOWED_SHARE,
    TAKE_OFF_S,
    Failsafe,
)  # fmt: skip
from companion.core.health import Debounce
from companion.core.values import FILTERED_PHASES, FLYING_PHASES, Instant, Phase
from companion.vehicle.autopilot.port import HOLD, LAND, OFFBOARD, TAKE_OFF, Verb
from companion.vehicle.detectors.base import Detector, Finding
from companion.vehicle.flight import Flight

STOPPED_LOW_S = FROZEN_S + 0.1
"""a climb that ended too low by positions that may have frozen meanwhile, which shows after FROZEN_S"""
ON_THE_WAY_UP = (TAKE_OFF, HOLD, OFFBOARD)
"""modes of a take-off, from arming until setpoints are followed"""


class HeartbeatLost(Detector):
    """Nothing proves any more that the autopilot lives: a landing of which nobody tells the end would last for ever."""

    failsafe = Failsafe.HEARTBEAT
    phases = FLYING_PHASES

    def look(self, flight: Flight, now: Instant) -> Finding | None:
        age_s = flight.autopilot.heartbeat_age_s(now)
        return Finding() if age_s is not None and age_s > HEARTBEAT_S else None


class _ModeLeft(Detector):
    """The autopilot is in a mode that nobody here has asked for, or has ended the climb too low."""

    phases = FLYING_PHASES
    by_itself: ClassVar[bool]
    """whether the autopilot's own failsafe did it"""

    def __init__(self) -> None:
        self._stopped_low = Debounce(STOPPED_LOW_S)

    def look(self, flight: Flight, now: Instant) -> Finding | None:
        stopped_low = self._stopped_low.holds(flight.stopped_low, now.monotonic_ns)
        if not stopped_low and not mode_is_foreign(flight):
            return None
        autopilot = flight.autopilot
        return Finding(autopilot.mode_name) if autopilot.acts_by_itself == self.by_itself else None


class LeftByPilot(_ModeLeft):
    """The pilot, or whoever else commands the autopilot, has the vehicle."""

    failsafe = Failsafe.PILOT
    by_itself = False


class LeftByAutopilot(_ModeLeft):
    """The autopilot's own failsafe has the vehicle."""

    failsafe = Failsafe.AUTOPILOT
    by_itself = True


def mode_is_foreign(flight: Flight) -> bool:
    """Whether the mode is one in which nobody may be who flies for us."""
    mode, before, phase = flight.autopilot.mode, flight.mode_before, flight.phase
    if phase in FILTERED_PHASES:
        return mode != OFFBOARD
    match phase:
        case Phase.ARMED:
            return mode not in (*ON_THE_WAY_UP, before)
        case Phase.CLIMBING:
            return mode not in ON_THE_WAY_UP
        case Phase.LANDING if flight.land_seen:
            # On disarming PX4 falls back to the mode before, which the heartbeat tells a second later.
            return mode not in (LAND, OFFBOARD, before) and not flight.autopilot.on_ground
    return mode not in (*ON_THE_WAY_UP, LAND, before)


class NotFollowed(Detector):
    """The vehicle flies elsewhere than it is told to, or its positions and its velocities tell different things."""

    failsafe = Failsafe.NOT_FOLLOWED
    phases = FILTERED_PHASES
    needs_position = True

    def __init__(self) -> None:
        self._unfollowed = Debounce(NOT_FOLLOWED_S)

    def look(self, flight: Flight, now: Instant) -> Finding | None:
        off_m_s = flight.unfollowed_m_s
        followed = off_m_s <= max(NOT_FOLLOWED_M_S, NOT_FOLLOWED_SHARE * flight.config.limits.speed_max_m_s)
        return Finding(f"{off_m_s:.1f} m/s off") if self._unfollowed.holds(not followed, now.monotonic_ns) else None


class NotArmed(Detector):
    """The take-off fails at its first step; whoever disarms has the last word."""

    failsafe = Failsafe.NOT_ARMED
    phases = frozenset({Phase.PREFLIGHT})

    def look(self, flight: Flight, now: Instant) -> Finding | None:
        if flight.lasts_s(now) > TAKE_OFF_S:
            return Finding("take-off given up")
        outcome = flight.autopilot.outcome(Verb.ARM)
        if outcome is None or flight.autopilot.mode == OFFBOARD:
            return None
        # An arming that was not answered may have been done, and undone by the pilot.
        what = "disarmed again after it was armed" if outcome.accepted else "the arming was not answered"
        return Finding(f"{what}; the take-off is given up")


class NoTakeOff(Detector):
    """It is armed and stays on the ground."""

    failsafe = Failsafe.NO_TAKE_OFF
    phases = frozenset({Phase.ARMED})

    def look(self, flight: Flight, now: Instant) -> Finding | None:
        return Finding() if flight.lasts_s(now) > TAKE_OFF_S else None


class AltitudeNotReached(Detector):
    """The climb does not end."""

    failsafe = Failsafe.ALTITUDE
    phases = frozenset({Phase.CLIMBING})

    def look(self, flight: Flight, now: Instant) -> Finding | None:
        return Finding() if flight.lasts_s(now) > CLIMB_S else None
