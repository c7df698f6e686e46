"""The operator's commands that are obeyed and not done yet: the autopilot is asked until it tells that they are.

Each has a limit. A kill that goes on being asked for would stop the motors of a later flight, a hold mode would take
the vehicle from a pilot.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from companion.core.events import Event, KillGivenUp, ResumeGivenUp
from companion.core.values import Instant
from companion.vehicle.autopilot.port import HOLD, OFFBOARD, TAKE_OFF, AutopilotPort, FlightMode, Verb

STREAM_BEFORE_NS = 200_000_000
"""setpoints are streamed so long before the autopilot is asked to follow them"""
RESUME_LIMIT_NS = 5_000_000_000
RELEASE_LIMIT_NS = 4_000_000_000
LATE_MODE_NS = 1_000_000_000
"""a mode that was asked for and is wanted no longer may come so late"""
LATE_MODES = frozenset({OFFBOARD, TAKE_OFF})
KILL_LIMIT_NS = 10_000_000_000


class Done(NamedTuple):
    """What has been done in a tick."""

    killed: bool = False
    """the motors ran, and have stopped"""
    resumed: bool = False
    """the autopilot follows setpoints again"""


@dataclass(frozen=True, slots=True)
class _Kill:
    since_ns: int
    armed: bool
    """whether there were motors to stop"""


@dataclass(slots=True)
class _Hold:
    since_ns: int
    """since the release or the end of a resume"""
    modes_to_leave: frozenset[FlightMode]
    """for hold mode; whoever chooses another has the vehicle"""


@dataclass(slots=True)
class PendingCommands:
    """Kill, hold mode after a release, and resume."""

    autopilot: AutopilotPort
    events: list[Event]
    """the supervisor's"""
    _kill: _Kill | None = None
    _hold: _Hold | None = None
    _resume_since_ns: int | None = None

    @property
    def none(self) -> bool:
        """Whether nothing more is asked of the autopilot for a command."""
        return self._kill is None and self._hold is None and self._resume_since_ns is None

    @property
    def killing(self) -> bool:
        """Whether the motors are being stopped."""
        return self._kill is not None

    @property
    def resuming(self) -> bool:
        """Whether setpoints stream for an autopilot that does not follow them yet."""
        return self._resume_since_ns is not None

    # -- what is commanded ---------------------------------------------------------------------------------------------

    def kill(self, now: Instant) -> None:
        """Stop the motors; nothing else is wanted any more."""
        self._hold = self._resume_since_ns = None
        self.autopilot.cancel()
        self.autopilot.kill()
        self._kill = _Kill(now.monotonic_ns, self.autopilot.armed)

    def hold_after(self, modes: Iterable[FlightMode], now: Instant) -> None:
        """Have the autopilot leave these modes for its hold mode."""
        self._hold = _Hold(now.monotonic_ns, frozenset(modes) - {HOLD})

    def forget_hold(self) -> None:
        """Hold mode is not wanted any more."""
        self._hold = None

    def resume(self, now: Instant) -> None:
        """Stream setpoints, and have the autopilot follow them."""
        self._hold = None
        self._resume_since_ns = now.monotonic_ns

    def end_resume(self, now: Instant) -> None:
        """Nothing is to be resumed any more; OFFBOARD that comes all the same is left for hold mode."""
        if self._resume_since_ns is not None:
            self._resume_since_ns = None
            self.autopilot.withdraw(Verb.ENGAGE)
            self.hold_after({OFFBOARD}, now)

    # -- at each control tick ------------------------------------------------------------------------------------------

    def advance(self, now: Instant) -> Done:
        """Ask for what is not done yet, and give up what takes too long."""
        killed = self._kill is not None and self._advance_kill(self._kill, now)
        if self._hold is not None:
            self._advance_hold(self._hold, now)
        resumed = self._resume_since_ns is not None and self._advance_resume(self._resume_since_ns, now)
        return Done(killed, resumed)

    def _advance_kill(self, kill: _Kill, now: Instant) -> bool:
        autopilot = self.autopilot
        # What was believed before the kill may be a heartbeat old.
        heard = autopilot.heartbeat_ns is not None and autopilot.heartbeat_ns > kill.since_ns
        stopped = heard and not autopilot.armed
        if not stopped and now.monotonic_ns - kill.since_ns <= KILL_LIMIT_NS:
            autopilot.kill()
            return False
        autopilot.withdraw(Verb.KILL)
        self._kill = None
        if autopilot.armed:
            self.events.append(KillGivenUp())
        return stopped and kill.armed

    def _advance_hold(self, hold: _Hold, now: Instant) -> None:
        left = self.autopilot.mode not in hold.modes_to_leave
        if now.monotonic_ns - hold.since_ns > (LATE_MODE_NS if left else RELEASE_LIMIT_NS):
            self._hold = None
            self.autopilot.withdraw(Verb.HOLD)
        elif left:
            hold.modes_to_leave &= LATE_MODES
            self.autopilot.withdraw(Verb.HOLD)
        else:
            self.autopilot.hold()

    def _advance_resume(self, since_ns: int, now: Instant) -> bool:
        waited_ns = now.monotonic_ns - since_ns
        if not self.autopilot.armed or waited_ns > RESUME_LIMIT_NS:
            self.end_resume(now)
            self.events.append(ResumeGivenUp(self.autopilot.mode_name))
        elif self.autopilot.mode == OFFBOARD:
            self._resume_since_ns = None
            return True
        elif waited_ns > STREAM_BEFORE_NS:
            self.autopilot.engage()
        return False
