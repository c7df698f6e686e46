"""The door to an autopilot: what a companion asks of it and what it tells, in words that no autopilot owns.

An adapter implements `AutopilotPort` (`px4.py` does); everything else in `vehicle` knows this file alone. A companion
asks by verbs and learns what came of them from what the autopilot tells, since only that is true: a verb is asked
again at each tick for as long as it is wanted, and the adapter sees that the link is not flooded by it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, unique
from math import inf
from typing import NamedTuple, Protocol

from companion.core.events import Event
from companion.core.failsafe import ACCURACY_LIMIT_M
from companion.core.frames import Geodetic, Ned
from companion.core.values import Instant, SafeSetpoint
from companion.wire.operator import Check


class FlightMode(NamedTuple):
    """What the autopilot does: one of the four that a companion asks for, or another, which is named by its adapter."""

    name: str


TAKE_OFF = FlightMode("take-off")
"""it climbs by itself to the altitude that was asked for"""
HOLD = FlightMode("hold")
"""it stays where it is by itself"""
OFFBOARD = FlightMode("offboard")
"""it flies the companion's setpoints"""
LAND = FlightMode("land")
"""it lands by itself where it is"""


@unique
class Verb(Enum):
    """What a companion asks of an autopilot."""

    ARM = "arm"
    TAKE_OFF = "take off"
    ENGAGE = "engage"
    HOLD = "hold"
    LAND = "land"
    KILL = "kill"


class Heard(NamedTuple):
    """What one datagram brought."""

    autopilot: bool
    """a sign of life or a position: what proves that it is our own autopilot that speaks"""
    position: bool
    """a position newer than the one before"""


NOTHING = Heard(autopilot=False, position=False)


class Outcome(NamedTuple):
    """What came of a request that the autopilot has not refused."""

    since_ns: int
    """when it was accepted, or taken for not answered (monotonic)"""
    accepted: bool
    """False: sent once and not answered, so that nobody knows whether it was done"""


class Estimate(NamedTuple):
    """What the autopilot's estimator says of itself."""

    flags: int
    """what it estimates, a bit each, by the autopilot's own numbers"""
    needed: int
    """those of them without which nobody flies in the fleet's frame"""
    accuracy_m: float
    """horizontal; infinite where none is told"""

    @property
    def complete(self) -> bool:
        """Whether it estimates all that is needed."""
        return self.flags & self.needed == self.needed

    @property
    def certain(self) -> bool:
        """Whether a formation may be flown by it."""
        return self.complete and self.accuracy_m <= ACCURACY_LIMIT_M


@dataclass(frozen=True, slots=True, kw_only=True)
class AutopilotFacts:
    """What preflight judges, as plain values."""

    heartbeat_age_s: float | None
    """None: never heard"""
    foreign_system_id: int | None = None
    """system id of an autopilot that has spoken on this link of late and is not ours"""
    identity: tuple[Check, ...] = ()
    """whether the adapter can fly this autopilot and this vehicle"""
    settings: tuple[Check, ...] = ()
    """whether the autopilot's parameters suit a fleet"""
    estimate: Estimate
    rc_healthy: bool = False
    """whether a pilot's transmitter is received"""
    origin: Geodetic | None = None
    """the estimator's; None in a local frame too"""
    home_altitude_amsl_m: float | None = None
    position_ned_m: Ned | None = None
    """fleet frame; None while the frame is not known"""
    position_age_s: float = inf
    position_rate_hz: float = 0.0
    battery_percent: int = -1
    """-1: unknown"""
    round_trip_s: float | None = None
    """None: no answer"""
    clock_ahead_s: float | None = None
    """autopilot's UTC minus ours; None: it has none"""


class AutopilotPort(Protocol):
    """One autopilot, over whatever link: bytes come in by `receive` and go out by `due` and `setpoint`."""

    events: list[Event]
    """what happened; emptied by whoever has read it"""

    # -- bytes ---------------------------------------------------------------------------------------------------------

    def receive(self, datagram: bytes, now: Instant) -> Heard:
        """Take what came on the link; returns what it brought. Never raises for what others send."""

    def due(self, now: Instant) -> list[bytes]:
        """What to send now."""

    def next_deadline_ns(self) -> int:
        """When `due` next has something to say (monotonic)."""

    def setpoint(self, setpoint: SafeSetpoint) -> bytes:
        """The datagram that has the autopilot fly a setpoint; only once `state` has told one."""

    # -- what it tells -------------------------------------------------------------------------------------------------

    @property
    def heartbeat_ns(self) -> int | None:
        """When it last gave a sign of life (monotonic); None: never."""

    @property
    def armed(self) -> bool:
        """Whether the motors may turn."""

    @property
    def mode(self) -> FlightMode:
        """What it does."""

    @property
    def mode_name(self) -> str:
        """The same by the autopilot's own name, for people."""

    @property
    def acts_by_itself(self) -> bool:
        """Whether its mode is a failsafe of its own, and nobody's wish."""

    @property
    def on_ground(self) -> bool | None:
        """Whether it stands on the ground; None while it does not tell."""

    @property
    def position_ns(self) -> int | None:
        """When the latest position was made (monotonic); None before the first."""

    @property
    def position_ned_m(self) -> Ned:
        """The latest position, fleet frame."""

    @property
    def velocity_ned_m_s(self) -> Ned:
        """The velocity that came with it."""

    @property
    def origin_crept_ned_m(self) -> Ned:
        """How far its estimator's origin has moved so far in steps too small for a jump of the position."""

    @property
    def battery_percent(self) -> int:
        """Charge as last told; -1: never."""

    def state(self, now: Instant) -> tuple[Ned, Ned] | None:
        """Position and velocity now (fleet frame), the latest carried on by its age; None if stale or without frame."""

    def position_age_s(self, now: Instant) -> float:
        """Age of the latest position; infinite before the first."""

    def heartbeat_age_s(self, now: Instant) -> float | None:
        """Age of the latest sign of life; None before the first."""

    def estimate(self, now: Instant) -> Estimate:
        """What its estimator says of itself; nothing and infinite once that is old."""

    def battery(self, now: Instant) -> int:
        """Charge (%); -1 where it is not told, or was told too long ago."""

    def facts(self, now: Instant) -> AutopilotFacts:
        """What preflight judges."""

    @property
    def rejected(self) -> Mapping[str, int]:
        """What was refused and went wrong on the link, by name."""

    # -- what is asked of it -------------------------------------------------------------------------------------------

    def arm(self) -> None:
        """Let the motors turn; sent once, since an arming whose answer is lost may have been undone by the pilot."""

    def take_off(self, altitude_amsl_m: float) -> None:
        """Climb; NaN: to the autopilot's own altitude of take-off."""

    def engage(self) -> None:
        """Fly our setpoints, which stream already."""

    def hold(self) -> None:
        """Stay where it is."""

    def land(self) -> None:
        """Land where it is."""

    def kill(self) -> None:
        """Stop the motors at once, wherever it is."""

    def outcome(self, verb: Verb) -> Outcome | None:
        """What came of it, once the autopilot has told what it led to; None before, and where it was refused."""

    def withdraw(self, *verbs: Verb) -> None:
        """Ask no more for what is wanted no longer, or was seen to be done though its answer was lost."""

    def cancel(self) -> None:
        """Ask for nothing more: the vehicle is somebody else's now."""

    def doubt_origin(self) -> None:
        """Ask for the estimator's origin again, since a position jumped."""
