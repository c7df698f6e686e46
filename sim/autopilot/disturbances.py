"""What disturbs a vehicle and what its estimate is off by: correlated noise per axis. Pure.

Time advances by the fixed step that a process is made for; random numbers come from the generator that is passed in.
"""

import math
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import cos, log, sin, sqrt


@dataclass(frozen=True, slots=True)
class GustParameters:
    """Disturbance: an Ornstein-Uhlenbeck acceleration per axis, stationary sigma, clipped."""

    sigma_m_s2: float = 0.3
    """standard deviation per axis, m/s²; 0: calm"""
    time_constant_s: float = 1.0
    """correlation time, s"""
    bound_m_s2: float = 1.0
    """the disturbance never exceeds this on any axis, m/s²"""

    def __post_init__(self) -> None:
        require("sigma_m_s2", self.sigma_m_s2, 0.0 <= self.sigma_m_s2 < math.inf, ">= 0")
        require("time_constant_s", self.time_constant_s, 0.0 < self.time_constant_s < math.inf, "> 0")
        require("bound_m_s2", self.bound_m_s2, 0.0 <= self.bound_m_s2 < math.inf, ">= 0")


@dataclass(frozen=True, slots=True)
class NoiseParameters:
    """Errors of the estimate that an autopilot flies by and reports."""

    position_sigma_m: float = 0.05
    """standard deviation per axis, m; correlated"""
    position_time_constant_s: float = 2.0
    """correlation time of the position error, s"""
    velocity_sigma_m_s: float = 0.05
    """standard deviation per axis, m/s; white: in what is reported, not in what the loops fly by"""
    velocity_bias_sigma_m_s: float = 0.0
    """standard deviation per axis of a slow error of the velocity, m/s; the loops fly by it"""
    velocity_bias_time_constant_s: float = 30.0
    """correlation time of that slow error, s"""

    def __post_init__(self) -> None:
        for name in ("position_sigma_m", "velocity_sigma_m_s", "velocity_bias_sigma_m_s"):
            require(name, getattr(self, name), 0.0 <= getattr(self, name) < math.inf, ">= 0")
        for name in ("position_time_constant_s", "velocity_bias_time_constant_s"):
            require(name, getattr(self, name), 0.0 < getattr(self, name) < math.inf, "> 0")


def require(name: str, value: float, allowed: bool, range_text: str) -> None:
    """ValueError for a value that is not allowed, with what is."""
    if not allowed:
        raise ValueError(f"{name} must be {range_text}, got {value}")


def normals(rng: random.Random) -> Iterator[float]:
    """Standard normal numbers for ever: those that `rng.gauss(0, 1)` gives, at half its cost (Box and Muller 1958)."""
    uniform = rng.random
    while True:
        angle = uniform() * math.tau
        radius = sqrt(-2.0 * log(1.0 - uniform()))
        yield cos(angle) * radius
        yield sin(angle) * radius


class OrnsteinUhlenbeck:
    """Three independent Ornstein-Uhlenbeck processes, started from their stationary distribution."""

    __slots__ = ("_bound", "_decay", "_kick", "_normal", "down", "east", "north")

    def __init__(
        self, sigma: float, time_constant_s: float, dt_s: float, normal: Iterator[float], bound: float = math.inf
    ) -> None:
        self._bound = bound
        self._decay = math.exp(-dt_s / time_constant_s)
        self._kick = sigma * math.sqrt(1.0 - self._decay * self._decay)
        self._normal: Callable[[], float] = normal.__next__
        self.north = self.east = self.down = 0.0
        if sigma > 0.0:
            self.north, self.east, self.down = (self._clip(next(normal) * sigma) for _ in range(3))

    def _clip(self, value: float) -> float:
        return min(max(value, -self._bound), self._bound)

    def step(self) -> None:
        """Advances by the fixed step given at construction."""
        kick = self._kick
        if kick == 0.0:
            return
        normal, decay, bound = self._normal, self._decay, self._bound
        north = self.north * decay + normal() * kick
        east = self.east * decay + normal() * kick
        down = self.down * decay + normal() * kick
        self.north = bound if north > bound else (-bound if north < -bound else north)
        self.east = bound if east > bound else (-bound if east < -bound else east)
        self.down = bound if down > bound else (-bound if down < -bound else down)
