"""One vehicle's flight as values: what supervisor, detectors and follower know of it together."""

from dataclasses import dataclass, field

from companion.config import FleetConfig
from companion.core.failsafe import LISTEN_S
from companion.core.frames import Ned
from companion.core.health import JumpSeries, PositionWatch
from companion.core.neighbours.table import PeerTable
from companion.core.trajectory.history import TrajectoryHistory
from companion.core.values import FILTERED_PHASES, FLYING_PHASES, ZERO, Instant, Phase
from companion.vehicle.autopilot.port import HOLD, AutopilotPort, FlightMode

ALTITUDE_TOLERANCE_M = 0.4
HOLD_MARGIN_M = 1.0
"""hold mode this far below the take-off's altitude is the pilot's doing, not the take-off's end"""


@dataclass(slots=True)
class Flight:
    """The state of a flight. The supervisor writes it, but for what another part is named for; all others read."""

    config: FleetConfig
    autopilot: AutopilotPort
    history: TrajectoryHistory
    peers: PeerTable
    positions: PositionWatch
    phase: Phase = Phase.IDLE
    phase_since_ns: int = 0
    begun: int = 0
    """flights so far: take-offs commanded and resumptions"""
    mode_before: FlightMode | None = None
    """at arming, until the take-off: the vehicle may stay in it"""
    engaging_since_ns: int | None = None
    """since when setpoints stream so that the autopilot may follow them; None: not in this climb"""
    land_seen: bool = False
    """whether the autopilot has begun to land, in this landing"""
    forms_without: bool = False
    """the wait for the others is over, and those that are up form without them"""
    outdated: bool = False
    """a peer holds a newer motion than we do"""
    positioned: bool = False
    """whether there is an own position to steer by"""
    unpositioned_since_ns: int | None = None
    """since when there is none, in formation or detached"""
    jumps_taken: int = 0
    """of `positions.jumps`: those that were acted on"""
    jumped: bool = False
    """whether the position has jumped since the tick before, in formation or detached"""
    jumps: JumpSeries = field(default_factory=lambda: JumpSeries(LISTEN_S))
    """since the autopilot was last engaged"""
    engaged_origin_crept_ned_m: Ned = ZERO
    """of the autopilot, when it was last engaged"""
    isolated_since_ns: int | None = None
    """since when nobody else is heard, in formation or detached"""
    unfollowed_m_s: float = 0.0
    """level difference of the velocity asked for at the last tick and the own, of which positions tell too
    (`observer`); 0 where nothing was asked. The agent writes it."""
    stands_since_ns: int | None = None
    """since when it stands detached; None: it does not, or is on its way back. The follower writes it."""

    @property
    def blind(self) -> bool:
        """Whether it is to be steered, and does not know where it is."""
        return self.phase in FILTERED_PHASES and not self.positioned

    @property
    def at_altitude(self) -> bool:
        """Whether the climb is over: by the altitude, or by the autopilot's holding."""
        climbed_m = -self.autopilot.position_ned_m.down
        return climbed_m > self.config.formation.altitude_m - ALTITUDE_TOLERANCE_M or self.autopilot.mode == HOLD

    @property
    def stopped_low(self) -> bool:
        """Whether a climb has ended in hold mode below the altitude of take-off, before the autopilot is engaged."""
        autopilot = self.autopilot
        return (
            self.phase is Phase.CLIMBING and self.positioned
            and autopilot.mode == HOLD and self.engaging_since_ns is None
            and self.config.fleet.frame == "global"
            and -autopilot.position_ned_m.down < self.config.formation.altitude_m - HOLD_MARGIN_M
        )  # fmt: skip

    def observe(self, now: Instant, positioned: bool) -> bool:
        """Take what several detectors go by; whether the position has jumped since the last tick that took a jump."""
        self.positioned, self.jumped = positioned, False
        steered = self.phase in FILTERED_PHASES
        jumps = self.positions.jumps != self.jumps_taken
        # PX4's estimator resets on the ground too, seconds before arming: there is nothing to hold yet.
        grounded = self.phase not in FLYING_PHASES or self.autopilot.on_ground is True
        took = jumps and (grounded or (steered and positioned))
        if took:
            self.jumps_taken = self.positions.jumps
            self.jumped = not grounded
        if self.jumped:
            self.jumps.take(now.monotonic_ns)
        if not steered:
            self.unpositioned_since_ns = self.isolated_since_ns = None
        elif not positioned:
            self.unpositioned_since_ns = self.unpositioned_since_ns or now.monotonic_ns
        else:
            self.unpositioned_since_ns = None
            self.isolated_since_ns = (self.isolated_since_ns or now.monotonic_ns) if self._isolated(now) else None
        return took

    def _isolated(self, now: Instant) -> bool:
        silent_s = self.peers.silent_for_s(now)
        silent = silent_s is not None and silent_s > self.config.peers.isolated_flight_s
        return silent or self.peers.deaf(now)

    def lasts_s(self, now: Instant) -> float:
        """How long the phase has lasted."""
        return (now.monotonic_ns - self.phase_since_ns) * 1e-9
