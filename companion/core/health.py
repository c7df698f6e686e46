"""What a vehicle can tell of its own health from what is said: positions that freeze or jump, and what lasts."""

from dataclasses import dataclass
from math import dist, hypot

from companion.core.failsafe import DAMAGE_M, DAMAGE_M_S, FROZEN_S
from companion.core.frames import Ned
from companion.core.values import ZERO

ACCELERATION_M_S2 = 15.0
"""more than any multirotor's motion needs between two positions"""
MOVING_M_S = 0.1
SIGMAS = 10.0


def jumped(
    before: tuple[Ned, Ned], after: tuple[Ned, Ned], dt_s: float, acceleration_m_s2: float, margin_m: float,
    margin_m_s: float,
) -> bool:  # fmt: skip
    """Whether two states (position m, velocity m/s) are further apart than an acceleration explains."""
    (p, v), (q, w) = before, after
    foreseen = Ned(p.north + v.north * dt_s, p.east + v.east * dt_s, p.down + v.down * dt_s)
    reach = 0.5 * acceleration_m_s2 * dt_s * dt_s
    return not (dist(q, foreseen) <= margin_m + reach and dist(v, w) <= margin_m_s + acceleration_m_s2 * dt_s)


@dataclass(slots=True)
class PositionWatch:
    """Positions and velocities as they come: whether they are frozen, and which of them jumped."""

    margin_m: float = DAMAGE_M
    margin_m_s: float = DAMAGE_M_S
    jumps: int = 0
    _time_ns: int | None = None
    _state: tuple[Ned, Ned] = (ZERO, ZERO)
    _same_since_ns: int = 0
    _frozen: bool = False

    @classmethod
    def for_noise(cls, position_noise_m: float, velocity_noise_m_s: float) -> "PositionWatch":
        """With margins that noise alone does not reach."""
        return cls(max(DAMAGE_M, SIGMAS * position_noise_m), max(DAMAGE_M_S, SIGMAS * velocity_noise_m_s))

    def restart(self) -> None:
        """Forget: the autopilot has booted anew, or its frame has."""
        self._time_ns, self._frozen = None, False

    def see(self, time_ns: int, position_ned_m: Ned, velocity_ned_m_s: Ned) -> bool:
        """Take the next position, made at `time_ns` (monotonic); whether it jumped."""
        jumps = False
        state = (position_ned_m, velocity_ned_m_s)
        if self._time_ns is not None:
            dt_s = max(time_ns - self._time_ns, 0) * 1e-9
            jumps = jumped(self._state, state, dt_s, ACCELERATION_M_S2, self.margin_m, self.margin_m_s)
            self.jumps += jumps
            same = position_ned_m == self._state[0] and hypot(*velocity_ned_m_s) > MOVING_M_S
            if not same:
                self._same_since_ns = time_ns
            self._frozen = time_ns - self._same_since_ns > round(FROZEN_S * 1e9)
        else:
            self._same_since_ns = time_ns
        self._time_ns, self._state = time_ns, state
        return jumps

    @property
    def frozen(self) -> bool:
        """Whether the position has not changed for FROZEN_S though the vehicle moves."""
        return self._frozen


@dataclass(slots=True)
class Debounce:
    """Whether something has been so for a time without a break."""

    limit_s: float
    _since_ns: int | None = None

    def holds(self, so: bool, monotonic_ns: int) -> bool:
        """Tell whether it is so now; True once it has been for `limit_s`."""
        if not so:
            self._since_ns = None
            return False
        if self._since_ns is None:
            self._since_ns = monotonic_ns
        return monotonic_ns - self._since_ns >= round(self.limit_s * 1e9)


@dataclass(slots=True)
class JumpSeries:
    """Jumps of the position that follow each other."""

    gap_s: float
    """a jump so long after the last one begins another series"""
    begun_ns: int | None = None
    """monotonic; None: no jump yet"""
    _last_ns: int = 0

    def restart(self) -> None:
        """The next jump begins a series."""
        self.begun_ns = None

    def take(self, monotonic_ns: int) -> None:
        """A jump came."""
        if self.begun_ns is None or monotonic_ns - self._last_ns >= self.gap_s * 1e9:
            self.begun_ns = monotonic_ns
        self._last_ns = monotonic_ns


FALL_M_S = 4.0
"""no autopilot sinks so fast on its own motors (PX4's limits of descent end there): who does falls"""
FALL_NS = 10_000_000_000
"""a fall so shortly before or after the motors were seen to stop has to do with it"""


@dataclass(slots=True)
class FallWatch:
    """Whether motors stopped in the air: whoever does it disarms a vehicle that falls."""

    _fell_ns: int | None = None
    _disarmed_ns: int | None = None

    def restart(self) -> None:
        """Forget: another take-off begins."""
        self._fell_ns = self._disarmed_ns = None

    def see(self, down_m_s: float, monotonic_ns: int) -> None:
        """Take the vertical velocity."""
        if down_m_s > FALL_M_S:
            self._fell_ns = monotonic_ns

    def disarmed(self, monotonic_ns: int) -> None:
        """A flight was seen to be over."""
        self._disarmed_ns = monotonic_ns

    @property
    def motors_stopped(self) -> bool:
        """Whether the vehicle fell about when it was disarmed."""
        fell, disarmed = self._fell_ns, self._disarmed_ns
        return fell is not None and disarmed is not None and abs(fell - disarmed) <= FALL_NS
