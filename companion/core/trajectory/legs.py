"""Legs: how the formation's centre goes on from a place and a velocity.

Each kind is flown in closed form: its state at any time needs no state before it, so all vehicles compute the same.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import copysign, cos, inf, sin, sqrt
from typing import Literal, NamedTuple

from companion.core.frames import Ned
from companion.core.trajectory.polynomials import fading, minimum_jerk
from companion.core.values import ZERO

PLAN_ACCELERATION_M_S2 = 0.5
"""the largest acceleration with which a leg changes the centre's velocity"""
TURN_RAMP_S = 3.0
"""time in which a turn's rate is built up and taken back"""

# Gauss-Legendre nodes and weights on [0, 1], order 8: exact to 1e-15 for the arcs of a turn's ramp.
_NODES = (
    (0.01985507175123188, 0.05061426814518813),
    (0.10166676129318664, 0.1111905172266872),
    (0.2372337950418355, 0.1568533229389437),
    (0.4082826787521751, 0.181341891689181),
    (0.5917173212478249, 0.181341891689181),
    (0.7627662049581645, 0.1568533229389437),
    (0.8983332387068134, 0.1111905172266872),
    (0.9801449282487681, 0.05061426814518813),
)


@dataclass(frozen=True, slots=True)
class VelocityLeg:
    """Change the centre's velocity smoothly to `velocity_ned_m_s` and keep it; zero velocity holds."""

    velocity_ned_m_s: Ned
    duration_s: float
    """length of the leg, the change included; it lasts at least as long as the change"""
    kind: Literal["velocity"] = "velocity"


@dataclass(frozen=True, slots=True)
class TurnLeg:
    """Turn the horizontal velocity at `rate_rad_s` (positive clockwise) through `angle_rad`, its speed unchanged.

    An angle too small to reach the rate within TURN_RAMP_S is turned at a lower one.
    """

    rate_rad_s: float
    angle_rad: float
    """how far, positive; infinite circles for ever"""
    kind: Literal["turn"] = "turn"


@dataclass(frozen=True, slots=True)
class GotoLeg:
    """Fly the centre to a point and come to rest there: a quintic polynomial of time."""

    target_ned_m: Ned
    duration_s: float
    kind: Literal["goto"] = "goto"


@dataclass(frozen=True, slots=True)
class FreeLeg:
    """No common motion that all share, for ever: the vehicles agree on one by what they publish (`vehicle.agreement`).

    What is shared goes on: slots, heading, altitude. The centre stands in it, and the common motion comes on top.
    """

    kind: Literal["free"] = "free"


Leg = VelocityLeg | TurnLeg | GotoLeg | FreeLeg


class CentreState(NamedTuple):
    position: Ned
    velocity: Ned
    acceleration: Ned
    turned: float
    turned_rate: float
    turned_acceleration: float


def leg_duration_s(leg: Leg, v0: Ned) -> float:
    """How long the leg lasts from the velocity v0 (m/s)."""
    match leg:
        case VelocityLeg():
            return max(leg.duration_s, velocity_ramp_s(leg, v0))
        case TurnLeg():
            return turn_rate_and_time(leg)[1]
        case GotoLeg():
            return leg.duration_s
        case FreeLeg():
            return inf


def leg_end(leg: Leg, p0: Ned, v0: Ned) -> tuple[float, Ned, Ned, float]:
    """Duration (s), place, velocity and angle turned at the end of a leg begun at p0 with v0; one without end ends
    where it began."""
    duration = leg_duration_s(leg, v0)
    if duration == inf:
        return inf, p0, v0, 0.0
    end = along(leg, p0, v0, duration)
    return duration, end.position, end.velocity, end.turned


def along(leg: Leg, p0: Ned, v0: Ned, t: float) -> CentreState:
    match leg:
        case VelocityLeg():
            return _velocity_leg(leg, p0, v0, t)
        case TurnLeg():
            return _turn_leg(leg, p0, v0, t)
        case GotoLeg():
            return _goto_leg(leg, p0, v0, t)
        case FreeLeg():
            return CentreState(p0, ZERO, ZERO, 0.0, 0.0, 0.0)


def _velocity_leg(leg: VelocityLeg, p0: Ned, v0: Ned, t: float) -> CentreState:
    v1 = leg.velocity_ned_m_s
    dn, de, dd = v1.north - v0.north, v1.east - v0.east, v1.down - v0.down
    ramp = velocity_ramp_s(leg, v0)
    x = min(t / ramp, 1.0) if ramp > 0.0 else 1.0
    level = x * x * (3.0 - 2.0 * x)
    area = ramp * (x * x * x - 0.5 * x**4) + (t - ramp * x)
    slope = 6.0 * x * (1.0 - x) / ramp if ramp > 0.0 else 0.0
    return CentreState(
        Ned(p0.north + v0.north * t + dn * area, p0.east + v0.east * t + de * area, p0.down + v0.down * t + dd * area),
        Ned(v0.north + dn * level, v0.east + de * level, v0.down + dd * level),
        Ned(dn * slope, de * slope, dd * slope),
        0.0, 0.0, 0.0,
    )  # fmt: skip


def velocity_ramp_s(leg: VelocityLeg, v0: Ned) -> float:
    """How long a velocity leg changes the velocity (s): a smoothstep whose steepest is PLAN_ACCELERATION_M_S2."""
    v1 = leg.velocity_ned_m_s
    north, east, down = v1.north - v0.north, v1.east - v0.east, v1.down - v0.down
    return 1.5 * sqrt(north * north + east * east + down * down) / PLAN_ACCELERATION_M_S2


def _turn_leg(leg: TurnLeg, p0: Ned, v0: Ned, t: float) -> CentreState:
    plateau, whole = turn_rate_and_time(leg)
    ramp = TURN_RAMP_S
    angle, rate, change = _turn_profile(leg, t)
    north, east = _arc(leg, v0, 0.0, min(t, ramp))
    if t > ramp:
        # Constant rate in closed form, up to the falling ramp.
        until = min(t, whole - ramp)
        a0, a1 = _turn_profile(leg, ramp)[0], _turn_profile(leg, until)[0]
        s, c = (sin(a1) - sin(a0)) / plateau, (cos(a1) - cos(a0)) / plateau
        north += s * v0.north + c * v0.east
        east += s * v0.east - c * v0.north
        if t > until:
            n, e = _arc(leg, v0, until, t)
            north, east = north + n, east + e
    c, s = cos(angle), sin(angle)
    velocity = Ned(c * v0.north - s * v0.east, s * v0.north + c * v0.east, v0.down)
    return CentreState(
        Ned(p0.north + north, p0.east + east, p0.down + v0.down * t),
        velocity,
        Ned(-rate * velocity.east, rate * velocity.north, 0.0),
        angle, rate, change,
    )  # fmt: skip


def _turn_profile(leg: TurnLeg, t: float) -> tuple[float, float, float]:
    """Angle turned (rad), its rate and its acceleration at t; the rate rises and falls as a smoothstep."""
    rate, whole = turn_rate_and_time(leg)
    ramp = TURN_RAMP_S

    def rising(s: float) -> tuple[float, float, float]:
        x = min(s / ramp, 1.0)
        level = x * x * (3.0 - 2.0 * x)
        angle = rate * (ramp * (x * x * x - 0.5 * x**4) + (s - ramp * x))
        return angle, rate * level, rate * 6.0 * x * (1.0 - x) / ramp

    if t <= whole - ramp:
        return rising(t)
    total = leg.angle_rad * (1.0 if rate > 0.0 else -1.0)
    angle, now, change = rising(max(whole - t, 0.0))
    return total - angle, now, -change


def turn_rate_and_time(leg: TurnLeg) -> tuple[float, float]:
    """Signed rate (rad/s) and whole duration (s): the rate's area under two ramps and the plateau is the angle."""
    rate = min(abs(leg.rate_rad_s), leg.angle_rad / TURN_RAMP_S)
    return copysign(rate, leg.rate_rad_s), max(leg.angle_rad / abs(leg.rate_rad_s), TURN_RAMP_S) + TURN_RAMP_S


@lru_cache(maxsize=16)
def _arc(leg: TurnLeg, v0: Ned, start: float, end: float) -> tuple[float, float]:
    """Integral of the turning velocity over [start, end] of the leg (m); the whole rising ramp's is asked for at every
    tick of the turn."""
    north = east = 0.0
    for node, weight in _NODES:
        angle, _, _ = _turn_profile(leg, start + node * (end - start))
        c, s = cos(angle), sin(angle)
        north += weight * (c * v0.north - s * v0.east)
        east += weight * (s * v0.north + c * v0.east)
    return north * (end - start), east * (end - start)


def _goto_leg(leg: GotoLeg, p0: Ned, v0: Ned, t: float) -> CentreState:
    whole = leg.duration_s
    x = min(t / whole, 1.0)
    m, m1, m2 = minimum_jerk(x)
    f, f1, f2 = fading(x)
    (pn, pe, pd), (tn, te, td), (vn, ve, vd) = p0, leg.target_ned_m, v0
    n, e, d = tn - pn, te - pe, td - pd
    return CentreState(
        Ned(pn + n * m + vn * whole * f, pe + e * m + ve * whole * f, pd + d * m + vd * whole * f),
        Ned(n * m1 / whole + vn * f1, e * m1 / whole + ve * f1, d * m1 / whole + vd * f1),
        Ned(
            n * m2 / whole**2 + vn * f2 / whole,
            e * m2 / whole**2 + ve * f2 / whole,
            d * m2 / whole**2 + vd * f2 / whole,
        ),
        0.0, 0.0, 0.0,
    )  # fmt: skip
