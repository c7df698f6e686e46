"""Laws and triggers of other packages, as guests: nothing that they do ends a companion or reaches past its place.

A guest's law says a level acceleration, held to `law.a_max_m_s2`, on which the error bound builds; altitude, heading
and setpoint are not its own, and the safety filter comes after it. What it is given cannot be changed. One that raises,
or says what is no finite number, lets the vehicle brake in that tick; for a hold that does so the damped one stands; a
trigger that raises speaks. All of it is counted. Time is not guarded (`fleet law check` says what a call costs), nor is
what Python lets any code do on purpose.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, inf, isfinite, nan

from companion.config import FleetConfig
from companion.config.law_tables import LAWS
from companion.config.trigger_tables import TRIGGERS
from companion.core.counts import Counts
from companion.core.frames import Ned
from companion.core.law.base import Law, Wanted
from companion.core.monitor import PeerMotion
from companion.core.prediction import Held, Hold, HoldBounds, PlainHold
from companion.core.trajectory.fleet import Reference
from companion.core.trigger.base import Situation, Trigger
from companion.core.values import ZERO, Neighbour, PeerSample, VehicleState
from companion.wire.peer import PLAUSIBLE_MAX

LAW_RAISED, LAW_NOT_FINITE, LAW_LIMITED = "law: raised", "law: not finite", "law: held to its limit"
HOLD_FAILED = "hold: raised or not finite"
TRIGGER_RAISED = "trigger: raised"
GUESTS = (LAW_RAISED, LAW_NOT_FINITE, LAW_LIMITED, HOLD_FAILED, TRIGGER_RAISED)
"""what guests are counted for"""
FAILURES = (Exception, SystemExit)
"""what a guest may raise without ending anything"""
BRAKING = Ned(nan, nan, 0.0)
"""the safety filter brakes for a command that is no number"""


def law_of(config: FleetConfig, counts: Counts) -> Law:
    """The law of one vehicle; a foreign one as a guest."""
    law = config.law.law(config.r0_m)
    return law if LAWS.origin(config.law.kind) is None else GuestLaw(law, config.law.a_max_m_s2, counts)


def hold_of(config: FleetConfig, counts: Counts) -> Hold:
    """How peers are predicted; a foreign hold as a guest."""
    hold = config.law.holding()
    if LAWS.origin(config.law.kind) is None or isinstance(hold, PlainHold):
        return hold
    return GuestHold(hold, PlainHold("damped", config.law.hold_damping_s), counts)


def trigger_of(config: FleetConfig, counts: Counts) -> Trigger:
    """The trigger of one vehicle; a foreign one as a guest."""
    trigger = config.trigger.trigger()
    return (
        trigger if TRIGGERS.origin(config.trigger.kind) is None else GuestTrigger(trigger, bool(trigger.waits), counts)
    )


@dataclass(slots=True)
class GuestLaw:
    """A foreign law."""

    law: Law
    a_max_m_s2: float
    counts: Counts
    fields: tuple[str, ...] = ()
    _told: tuple[float, ...] = ()
    """the last numbers that were such"""

    def __post_init__(self) -> None:
        self.fields = tuple(self.law.fields)
        self._told = (0.0,) * len(self.fields)

    def command(
        self, ego: VehicleState, reference: Reference, neighbours: Sequence[Neighbour], *, alone: bool
    ) -> Wanted:
        """What the law wants, within its limit; a law that fails wants to brake and knows no residual."""
        try:
            wanted, residual = self.law.command(ego, reference, tuple(neighbours), alone=alone)
            north, east, _ = map(float, wanted)
            off = Ned(*map(float, residual))
        except FAILURES:
            self.counts[LAW_RAISED] += 1
            return Wanted(BRAKING, ZERO)
        if not all(map(isfinite, (north, east, *off))):
            self.counts[LAW_NOT_FINITE] += 1
            return Wanted(BRAKING, ZERO)
        size = hypot(north, east)
        if size > self.a_max_m_s2:
            if size > self.a_max_m_s2 * (1.0 + 1e-9):
                self.counts[LAW_LIMITED] += 1
            north, east = north * self.a_max_m_s2 / size, east * self.a_max_m_s2 / size
        return Wanted(Ned(north, east, 0.0), off)

    def reset(self) -> None:
        """See `Law`."""
        try:
            self.law.reset()
        except FAILURES:
            self.counts[LAW_RAISED] += 1

    def tell(self) -> tuple[float, ...]:
        """The law's numbers; those before where it has none."""
        try:
            told = tuple(map(float, self.law.tell()))
        except FAILURES:
            self.counts[LAW_RAISED] += 1
            return self._told
        if len(told) != len(self.fields) or not all(abs(x) <= PLAUSIBLE_MAX for x in told):
            self.counts[LAW_NOT_FINITE] += 1
            return self._told
        self._told = told
        return told


@dataclass(slots=True)
class GuestHold:
    """A foreign hold."""

    hold: Hold
    instead: Hold
    counts: Counts

    def at(self, sample: PeerSample, then: tuple[Ned, Ned], now: Reference, tau_s: float) -> Held:
        """What it foretells, where that is a state; else what the damped hold does."""
        try:
            position, velocity, told = self.hold.at(sample, then, now, tau_s)
            held = Held(Ned(*map(float, position)), Ned(*map(float, velocity)), tuple(map(float, told)))
            if all(map(isfinite, (*held.position_ned_m, *held.velocity_ned_m_s, *held.told))):
                return held
        except FAILURES:
            pass
        self.counts[HOLD_FAILED] += 1
        return self.instead.at(sample, then, now, tau_s)

    def told_error_m(self, foreseen: tuple[float, ...], tells: tuple[float, ...]) -> float:
        """What it says; a vehicle of which it fails to say it speaks."""
        try:
            return float(self.hold.told_error_m(foreseen, tells))
        except FAILURES:
            self.counts[HOLD_FAILED] += 1
            return inf

    def bounds(self, speed_max_m_s: float) -> HoldBounds:
        """See `Hold`."""
        return self.hold.bounds(speed_max_m_s)


@dataclass(slots=True)
class GuestTrigger:
    """A foreign trigger."""

    trigger: Trigger
    waits: bool
    counts: Counts

    def fires(self, now: Situation) -> bool:
        """Whether it fires; one that fails does, as often as `t_min` allows."""
        try:
            return bool(self.trigger.fires(now))
        except FAILURES:
            self.counts[TRIGGER_RAISED] += 1
            self.waits = True
            return True

    def error_bound_m(self, motion: PeerMotion) -> float:
        """See `Trigger`."""
        return self.trigger.error_bound_m(motion)

    @property
    def cause(self) -> str:
        """See `Trigger`."""
        return self.trigger.cause
