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
