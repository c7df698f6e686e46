"""The vehicle's own state: from what its autopilot reports to what the law uses, what is sent, and what is flown.

Three small filters, each a step function of time. They work in the fleet frame and absolute position, so that a new
slot or plan is no jump to them.
"""

from dataclasses import dataclass, field
from functools import cache
from math import exp, hypot

OBSERVER_RATE_RAD_S = 1.5
"""omega of the bias observer"""
POSITION_RATE_PER_S = 2.0
"""send filter: position from position"""
CROSS_RATE_PER_S2 = 1.0
"""send filter: velocity from position"""
VELOCITY_RATE_PER_S = 5.0
"""send filter: velocity from velocity"""


@dataclass(slots=True)
class BiasObserver:
    """Velocity bias of one axis, seen as position that does not move as the velocity says.

        r = p - x^,  x^' = v_meas - b^ + 1.6 omega r,  b^' = -omega^2 r

    PX4's velocity estimate is off by 0.15-0.25 m/s, slowly; the law and the peers get v_meas - b^.
    """

    position_m: float | None = None
    bias_m_s: float = 0.0

    def step(self, position_m: float, velocity_m_s: float, dt_s: float) -> float:
        """Take one measurement, dt_s after the one before; returns the velocity without its bias (m/s)."""
        if self.position_m is None or dt_s > 0.5:
            self.position_m = position_m
        elif dt_s > 0.0:
            error = position_m - self.position_m
            w = OBSERVER_RATE_RAD_S
            self.position_m += dt_s * (velocity_m_s - self.bias_m_s + 1.6 * w * error)
            self.bias_m_s -= dt_s * w * w * error
        return velocity_m_s - self.bias_m_s


def alpha_beta(
    p: float, v: float, measured_p: float, measured_v: float, acceleration: float, dt_s: float
) -> tuple[float, float]:
    """One step of the send filter: from (p, v) dt_s ago to now, given what was commanded meanwhile."""
    predicted_p = p + dt_s * v + 0.5 * dt_s * dt_s * acceleration
    predicted_v = v + dt_s * acceleration
    error_p = measured_p - predicted_p
    error_v = measured_v - predicted_v
    return (
        predicted_p + (1.0 - exp(-POSITION_RATE_PER_S * dt_s)) * error_p,
        predicted_v + CROSS_RATE_PER_S2 * dt_s * error_p + (1.0 - exp(-VELOCITY_RATE_PER_S * dt_s)) * error_v,
    )


@dataclass(slots=True)
class SendFilter:
    """Alpha-beta filter of one axis with the flown acceleration as its input.

    What is compared by the trigger and sent to the peers: events fire at extremes of noise, and the raw state would
    send outliers. What the vehicle flies beside that acceleration it follows late (`gust_lag`, `command_lag`).
    """

    position_m: float | None = None
    velocity_m_s: float = 0.0

    def step(self, position_m: float, velocity_m_s: float, acceleration_m_s2: float, dt_s: float) -> None:
        """Take one measurement and the acceleration commanded since the one before."""
        if self.position_m is None or dt_s > 0.5:
            self.position_m, self.velocity_m_s = position_m, velocity_m_s
            return
        if dt_s <= 0.0:
            return
        self.position_m, self.velocity_m_s = alpha_beta(
            self.position_m, self.velocity_m_s, position_m, velocity_m_s, acceleration_m_s2, dt_s
        )


def gust_lag() -> tuple[float, float]:
    """How far the send filter's position and velocity end up behind, per constant acceleration that it is not told of.

    With d the unknown acceleration, e = p_f - p and w = v_f - v: e' = w - 2 e, w' = -d - e - 5 w, so e = -d/11 and
    w = -2 d/11. The response of e + T w to an impulse of d has one sign for times ahead T up to 2.6 s: no d within that
    size makes it larger, and no sinusoid passes better. (s^2, s)
    """
    position = 1.0 / (CROSS_RATE_PER_S2 + VELOCITY_RATE_PER_S * POSITION_RATE_PER_S)
    return position, POSITION_RATE_PER_S * position


@cache
def command_lag(lag_s: float) -> tuple[tuple[float, float], ...]:
    """How far the send filter's (position, velocity) run ahead of a vehicle whose acceleration follows its command
    late by a first order, per step of the command.

    They are told of the command at once. Given are the moments from the greatest velocity error (about 0.2 s after the
    step) to the greatest position error: at a time T ahead, the largest position error is the largest e + T w of them,
    and by their sign no command that stays within the step's size makes a larger one. (s^2, s)
    """
    if lag_s <= 0.0:
        return ((0.0, 0.0),)
    dt_s = 0.001
    follows = 1.0 - exp(-dt_s / lag_s)
    acceleration = p = v = filtered_p = filtered_v = 0.0
    seen: list[tuple[float, float]] = []
    while len(seen) < 2 or seen[-1][0] > seen[-2][0]:
        for _ in range(20):
            acceleration += follows * (1.0 - acceleration)
            p += dt_s * v + 0.5 * dt_s * dt_s * acceleration
            v += dt_s * acceleration
            filtered_p, filtered_v = alpha_beta(filtered_p, filtered_v, p, v, 1.0, dt_s)
        seen.append((filtered_p - p, filtered_v - v))
    return tuple(seen[max(range(len(seen)), key=lambda k: seen[k][1]) :])


@dataclass(slots=True)
class VelocityReference:
    """The velocity that goes with an acceleration to an autopilot with a velocity loop of its own.

        v_ref <- v_ref + dt (u + (v_meas - v_ref)/T_l),   |v_ref - v_meas| <= 1.5 m/s

    PX4 flies a = u + 1.8 (v_sp - v) + ...: v_sp = v would leave drag unopposed, v_sp = v + u T would multiply the
    law's gain; the leaking integral of u does neither.
    """

    leak_s: float = 1.0
    distance_max_m_s: float = 1.5
    north_m_s: float | None = None
    east_m_s: float = field(default=0.0)

    def reset(self) -> None:
        """Start from the measured velocity at the next step (on engaging)."""
        self.north_m_s = None

    def step(self, u_north: float, u_east: float, v_north: float, v_east: float, dt_s: float) -> tuple[float, float]:
        """Advance by dt_s under the command u (m/s^2) at the measured velocity v (m/s); returns the reference (m/s)."""
        if self.north_m_s is None:
            self.north_m_s, self.east_m_s = v_north, v_east
        north = self.north_m_s + dt_s * (u_north + (v_north - self.north_m_s) / self.leak_s)
        east = self.east_m_s + dt_s * (u_east + (v_east - self.east_m_s) / self.leak_s)
        distance = hypot(north - v_north, east - v_east)
        if distance > self.distance_max_m_s:
            scale = self.distance_max_m_s / distance
            north = v_north + scale * (north - v_north)
            east = v_east + scale * (east - v_east)
        self.north_m_s, self.east_m_s = north, east
        return north, east
