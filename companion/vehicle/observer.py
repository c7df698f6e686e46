"""The vehicle's own state: without the estimator's velocity bias for the law, smoothed for the peers."""

from companion.core.estimate import BiasObserver, SendFilter
from companion.core.frames import Ned
from companion.core.values import Instant, VehicleState


class StateObserver:
    """Three axes of the two filters of `core.estimate`, in the fleet frame."""

    def __init__(self) -> None:
        self.observed_ns: int | None = None
        """when the own state was last known (monotonic)"""
        self._jumped = False
        self._restart()

    def _restart(self) -> None:
        self._bias = (BiasObserver(), BiasObserver(), BiasObserver())
        self._smooth = (SendFilter(), SendFilter(), SendFilter())

    def start_anew(self) -> None:
        """The position has jumped: with the next measurement both filters begin again.

        Until then what was known before the jump is what is known.
        """
        self._jumped = True

    def observe(self, position: Ned, velocity: Ned, flown_m_s2: tuple[float, float], now: Instant) -> VehicleState:
        """The own state (velocity without its bias) from one measurement and what was flown since the one before."""
        dt_s = 0.0 if self.observed_ns is None else (now.monotonic_ns - self.observed_ns) * 1e-9
        self.observed_ns = now.monotonic_ns
        if self._jumped:
            self._jumped = False
            self._restart()
        north, east, down = self._bias
        free = Ned(
            north.step(position.north, velocity.north, dt_s),
            east.step(position.east, velocity.east, dt_s),
            down.step(position.down, velocity.down, dt_s),
        )
        for axis, p, v, u in zip(self._smooth, position, free, (*flown_m_s2, 0.0), strict=True):
            axis.step(p, v, u, dt_s)
        return VehicleState(now.fleet_ns, position, free)

    @property
    def bias_m_s(self) -> Ned:
        """The estimator's velocity bias."""
        return Ned(*(axis.bias_m_s for axis in self._bias))

    @property
    def smoothed(self) -> tuple[Ned, Ned]:
        """Position and velocity as they are compared by the trigger and sent to the peers; zero before the first."""
        return Ned(*(a.position_m or 0.0 for a in self._smooth)), Ned(*(a.velocity_m_s for a in self._smooth))
