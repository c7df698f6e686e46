"""The plan: the formation's reference motion p_ref, v_d, a_d, as a function of fleet time alone.

A `FleetTrajectory` says everything that the vehicles must agree on: where the centre starts, how it goes on (legs), and
how the slots pass from one formation to the next. It is complete in itself, so a late joiner needs only the newest one,
and a new one starts exactly where the one before has taken the formation. Motions are ordered by (revision, start,
issuer); the largest wins, which is how vehicles without a leader agree on one of several proposals.
"""

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from math import atan2, copysign, cos, dist, hypot, inf, sin, sqrt
from typing import Literal, NamedTuple

from companion.core.formation import Slots, assign
from companion.core.frames import Ned
from companion.core.values import ZERO

PLAN_ACCELERATION_M_S2 = 0.5
"""the largest acceleration with which a leg changes the centre's velocity"""
GOTO_ACCELERATION_M_S2 = 2 * PLAN_ACCELERATION_M_S2
"""the largest acceleration of a goto leg, and of slots that change places"""
GOTO_MIN_S = 1.0
"""no goto leg is shorter"""
PAD_TOLERANCE_M = 0.05
TURN_RAMP_S = 3.0
"""time in which a turn's rate is built up and taken back"""
GOTO_LOOKS = 64
"""parts of a goto leg at whose ends its speed and acceleration are looked at: both are known to 0.1 %"""
PADS = "pads"
"""name of the formation in which each vehicle is over its own pad"""
MINIMUM_JERK_BEND = 5.7735
"""peak of the second derivative of `minimum_jerk`; its slope's is 15/8"""
Then = Literal["stay", "land", "return"]
BLEND_MIN_S = 8.0
"""shortest time in which slots move from one formation to the next"""

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


class Reference(NamedTuple):
    """Position (m), velocity (m/s), acceleration (m/s^2) in the fleet frame, and heading (rad)."""

    position_ned_m: Ned
    velocity_ned_m_s: Ned
    acceleration_ned_m_s2: Ned
    heading_rad: float


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


Leg = VelocityLeg | TurnLeg | GotoLeg


class _Centre(NamedTuple):
    position: Ned
    velocity: Ned
    acceleration: Ned
    turned: float
    turned_rate: float
    turned_acceleration: float


def _velocity_leg(leg: VelocityLeg, p0: Ned, v0: Ned, t: float) -> _Centre:
    v1 = leg.velocity_ned_m_s
    dn, de, dd = v1.north - v0.north, v1.east - v0.east, v1.down - v0.down
    ramp = _ramp_s(Ned(dn, de, dd))
    x = min(t / ramp, 1.0) if ramp > 0.0 else 1.0
    level = x * x * (3.0 - 2.0 * x)
    area = ramp * (x * x * x - 0.5 * x**4) + (t - ramp * x)
    slope = 6.0 * x * (1.0 - x) / ramp if ramp > 0.0 else 0.0
    return _Centre(
        Ned(p0.north + v0.north * t + dn * area, p0.east + v0.east * t + de * area, p0.down + v0.down * t + dd * area),
        Ned(v0.north + dn * level, v0.east + de * level, v0.down + dd * level),
        Ned(dn * slope, de * slope, dd * slope),
        0.0, 0.0, 0.0,
    )  # fmt: skip


def _ramp_s(dv: Ned) -> float:
    return 1.5 * sqrt(dv.north * dv.north + dv.east * dv.east + dv.down * dv.down) / PLAN_ACCELERATION_M_S2


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


def _turn_leg(leg: TurnLeg, p0: Ned, v0: Ned, t: float) -> _Centre:
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
    return _Centre(
        Ned(p0.north + north, p0.east + east, p0.down + v0.down * t),
        velocity,
        Ned(-rate * velocity.east, rate * velocity.north, 0.0),
        angle, rate, change,
    )  # fmt: skip


def _goto_leg(leg: GotoLeg, p0: Ned, v0: Ned, t: float) -> _Centre:
    whole = leg.duration_s
    x = min(t / whole, 1.0)
    m, m1, m2 = minimum_jerk(x)
    f, f1, f2 = fading(x)
    way = Ned(*(b - a for a, b in zip(p0, leg.target_ned_m, strict=True)))
    return _Centre(
        Ned(*(p + d * m + v * whole * f for p, d, v in zip(p0, way, v0, strict=True))),
        Ned(*(d * m1 / whole + v * f1 for d, v in zip(way, v0, strict=True))),
        Ned(*(d * m2 / whole**2 + v * f2 / whole for d, v in zip(way, v0, strict=True))),
        0.0, 0.0, 0.0,
    )  # fmt: skip


def minimum_jerk(x: float) -> tuple[float, float, float]:
    """Value, slope and curvature over x in [0, 1] of the rest-to-rest polynomial 10x^3 - 15x^4 + 6x^5."""
    x = min(max(x, 0.0), 1.0)
    return (
        x * x * x * (10.0 - 15.0 * x + 6.0 * x * x),
        30.0 * x * x * (1.0 - x) ** 2,
        60.0 * x * (1.0 - x) * (1.0 - 2.0 * x),
    )


def fading(x: float) -> tuple[float, float, float]:
    """Value, slope and curvature over x in [0, 1] of the quintic with value 0, slope 1 at 0 and rest at 1: by it a
    velocity from before fades."""
    x = min(max(x, 0.0), 1.0)
    return (
        x - 6 * x**3 + 8 * x**4 - 3 * x**5,
        1 - 18 * x**2 + 32 * x**3 - 15 * x**4,
        -36 * x + 96 * x**2 - 60 * x**3,
    )


def _goto_looks() -> tuple[tuple[float, float, float, float], ...]:
    """Slopes and curvatures of `minimum_jerk` and `fading` within a goto leg, where the first is steepest included."""
    bend = sqrt(1.0 / 12.0)
    places = [k / GOTO_LOOKS for k in range(1, GOTO_LOOKS)] + [0.5 - bend, 0.5 + bend]
    return tuple((*minimum_jerk(x)[1:], *fading(x)[1:]) for x in places)


_GOTO_LOOKS = _goto_looks()


def goto_duration_s(
    way: Ned, velocity: Ned, speed_m_s: float, climb_m_s: float = inf, descent_m_s: float = inf
) -> float:
    """Time of a goto leg over `way` (m) from `velocity` (m/s) whose greatest speed is `speed_m_s`.

    The leg's velocity at x = t/T is way m'(x)/T + velocity f'(x) (`minimum_jerk`, `fading`), so at each x the condition
    |v| <= speed is a quadratic in 1/T; the largest 1/T that meets all is the answer. It is smaller where the vertical
    speeds or GOTO_ACCELERATION_M_S2 ask for it, and T at least GOTO_MIN_S. A leg that begins faster than `speed_m_s`
    becomes no faster than it begins.
    """
    c = way.north**2 + way.east**2 + way.down**2
    b = way.north * velocity.north + way.east * velocity.east + way.down * velocity.down
    a = velocity.north**2 + velocity.east**2 + velocity.down**2
    top2 = max(speed_m_s * speed_m_s, a)
    climb, descent = max(climb_m_s, -velocity.down), max(descent_m_s, velocity.down)
    per_s = 1.0 / GOTO_MIN_S
    for m1, _, f1, _ in _GOTO_LOOKS:
        if c > 1e-18:
            free, along = top2 - a * f1 * f1, b * f1
            root = sqrt(along * along + c * free)
            per_s = min(per_s, free / (m1 * (root + along)) if along > 0.0 else (root - along) / (c * m1))
        if way.down > 1e-9:
            per_s = min(per_s, (descent - velocity.down * f1) / (way.down * m1))
        elif way.down < -1e-9:
            per_s = min(per_s, (climb + velocity.down * f1) / (-way.down * m1))

    def acceleration2(s: float) -> float:
        return max(s * s * (c * m2 * m2 * s * s + 2.0 * b * m2 * f2 * s + a * f2 * f2) for _, m2, _, f2 in _GOTO_LOOKS)

    if acceleration2(per_s) > GOTO_ACCELERATION_M_S2**2:
        least, most = 0.0, per_s
        for _ in range(40):
            middle = 0.5 * (least + most)
            least, most = (least, middle) if acceleration2(middle) > GOTO_ACCELERATION_M_S2**2 else (middle, most)
        per_s = least
    return 1.0 / per_s


def goto_leg(
    start: Ned, velocity: Ned, target: Ned, speed_m_s: float, climb_m_s: float = inf, descent_m_s: float = inf
) -> GotoLeg:
    """A leg from a place and a velocity to a point, at `speed_m_s` at most (`goto_duration_s`)."""
    way = Ned(target.north - start.north, target.east - start.east, target.down - start.down)
    return GotoLeg(target, goto_duration_s(way, velocity, speed_m_s, climb_m_s, descent_m_s))


class GotoPeaks(NamedTuple):
    """The greatest level speed, climb, descent (m/s) and acceleration (m/s^2) of a goto leg, where it is looked at."""

    level_m_s: float
    climb_m_s: float
    descent_m_s: float
    acceleration_m_s2: float


def goto_peaks(leg: GotoLeg, start: Ned, velocity: Ned) -> GotoPeaks:
    """How fast a goto leg is flown from a place and a velocity."""
    per_s = 1.0 / leg.duration_s
    n, e, d = ((b - a) * per_s for a, b in zip(start, leg.target_ned_m, strict=True))
    vn, ve, vd = velocity
    level2, climb, descent, bend2 = vn * vn + ve * ve, max(-vd, 0.0), max(vd, 0.0), 0.0
    for m1, m2, f1, f2 in _GOTO_LOOKS:
        x, y, z = n * m1 + vn * f1, e * m1 + ve * f1, d * m1 + vd * f1
        level2, climb, descent = max(level2, x * x + y * y), max(climb, -z), max(descent, z)
        x, y, z = n * m2 + vn * f2, e * m2 + ve * f2, d * m2 + vd * f2
        bend2 = max(bend2, x * x + y * y + z * z)
    return GotoPeaks(sqrt(level2), climb, descent, sqrt(bend2) * per_s)


def blend_duration_s(
    changes: Sequence["SlotChange"], speed_m_s: float, climb_m_s: float = inf, descent_m_s: float = inf
) -> float:
    """Time in which slots change places: minimum jerk, below the speeds and 1 m/s^2, and BLEND_MIN_S at least."""
    seconds = BLEND_MIN_S
    for before, after in changes:
        level, down = hypot(after.north - before.north, after.east - before.east), after.down - before.down
        vertical = down / descent_m_s if down > 0.0 else -down / climb_m_s
        seconds = max(
            seconds, 1.875 * level / speed_m_s, 1.875 * vertical, sqrt(MINIMUM_JERK_BEND * dist(before, after))
        )
    return seconds


def velocity_ramp_s(leg: VelocityLeg, v0: Ned) -> float:
    """How long a velocity leg changes the velocity (s)."""
    return _ramp_s(Ned(*(b - a for a, b in zip(v0, leg.velocity_ned_m_s, strict=True))))


def leg_duration_s(leg: Leg, v0: Ned) -> float:
    """How long the leg lasts from the velocity v0 (m/s)."""
    match leg:
        case VelocityLeg():
            return max(leg.duration_s, velocity_ramp_s(leg, v0))
        case TurnLeg():
            return turn_rate_and_time(leg)[1]
        case GotoLeg():
            return leg.duration_s


def leg_end(leg: Leg, p0: Ned, v0: Ned) -> tuple[float, Ned, Ned, float]:
    """Duration (s), place, velocity and angle turned at the end of a leg begun at p0 with v0; one without end ends
    where it began."""
    duration = leg_duration_s(leg, v0)
    if duration == inf:
        return inf, p0, v0, 0.0
    end = _along(leg, p0, v0, duration)
    return duration, end.position, end.velocity, end.turned


def _along(leg: Leg, p0: Ned, v0: Ned, t: float) -> _Centre:
    match leg:
        case VelocityLeg():
            return _velocity_leg(leg, p0, v0, t)
        case TurnLeg():
            return _turn_leg(leg, p0, v0, t)
        case GotoLeg():
            return _goto_leg(leg, p0, v0, t)


class SlotChange(NamedTuple):
    """One vehicle's slot before and after the blend: offsets (forward, right, down) from the centre, m."""

    before: Ned
    after: Ned


class TrajectoryState(NamedTuple):
    """A motion at one time: what all its slots have in common, so that each slot costs little."""

    centre: _Centre
    heading_rad: float
    cosine: float
    sine: float
    rate: float
    rate_change: float
    blend: tuple[float, float, float]
    """part of the way from the slots before to those after, its rate (1/s) and the rate's change (1/s^2)"""

    def slot(self, change: SlotChange) -> Reference:
        """p_ref,i = c + R(psi) D_i and its derivatives."""
        (p, v, a, _, _, _), heading, c, s, rate, bend, (m, m1, m2) = self
        (f0, r0, d0), (f1, r1, d1) = change
        df, dr, dd = f1 - f0, r1 - r0, d1 - d0
        forward, right = f0 + m * df, r0 + m * dr
        dn, de = c * forward - s * right, s * forward + c * right
        if rate == bend == m1 == m2 == 0.0:
            # Slots at rest in a formation that does not turn, which is most of a flight: all move as the centre does.
            return Reference(Ned(p.north + dn, p.east + de, p.down + d0 + m * dd), v, a, heading)
        wn, we = c * df - s * dr, s * df + c * dr
        return Reference(
            Ned(p.north + dn, p.east + de, p.down + d0 + m * dd),
            Ned(v.north - rate * de + m1 * wn, v.east + rate * dn + m1 * we, v.down + m1 * dd),
            Ned(
                a.north - bend * de - rate * rate * dn - 2 * rate * m1 * we + m2 * wn,
                a.east + bend * dn - rate * rate * de + 2 * rate * m1 * wn + m2 * we,
                a.down + m2 * dd,
            ),
            heading,
        )


REVISIONS = 1 << 32
"""a motion's revision is below this, as it travels"""


def motion_order(revision: int, start_ns: int, issuer: int) -> tuple[int, int, int]:
    """What `FleetTrajectory.order` is, of a motion that is only named."""
    return (revision, -start_ns, issuer)


@dataclass(frozen=True)
class FleetTrajectory:
    """The fleet's motion from `start_ns` on: immutable, the same bytes on every vehicle."""

    revision: int
    start_ns: int
    """fleet time from which it replaces the motion before it (ns)"""
    issuer: int
    """vehicle that proposed it, or 0 for the operator or the configuration"""
    shape: str
    """name of the formation that the slots end in"""
    slots: dict[int, SlotChange]
    """vehicle id -> its slots"""
    blend_start_ns: int
    """fleet time at which the slots begin to pass from before to after (ns)"""
    blend_s: float
    """how long they take; 0: they are there"""
    legs_start_ns: int
    """fleet time at which the first leg begins (ns); a change of formation leaves the legs as they are"""
    centre_ned_m: Ned
    """the centre at the start of the legs"""
    velocity_ned_m_s: Ned
    heading_rad: float
    """clockwise from north, at the start of the legs"""
    heading_rate_rad_s: float
    """left over from a turn that these legs interrupt; it dies out within TURN_RAMP_S"""
    heading_follows_turns: bool
    legs: tuple[Leg, ...]
    then: Then = "stay"
    """what the vehicles do when the last leg has ended; "return": they fly back over their pads, and land there"""

    @property
    def order(self) -> tuple[int, int, int]:
        """Larger wins: the newest revision, and of several proposals for it the one that starts first, which mostly is
        the one that most have heard by then."""
        return motion_order(self.revision, self.start_ns, self.issuer)

    @cached_property
    def leg_starts(self) -> tuple[tuple[float, Ned, Ned, float], ...]:
        """For each leg and the state after the last: (time since the legs' start, position, velocity, angle turned).

        What follows a leg without end is left out, and the last time is infinite.
        """
        rows = [(0.0, self.centre_ned_m, self.velocity_ned_m_s, 0.0)]
        for leg in self.legs:
            t, p, v, turned = rows[-1]
            duration, p, v, angle = leg_end(leg, p, v)
            rows.append((t + duration, p, v, turned + angle))
            if duration == inf:
                break
        return tuple(rows)

    @cached_property
    def _times(self) -> list[float]:
        return [row[0] for row in self.leg_starts]

    @property
    def end_ns(self) -> int | None:
        """Fleet time at which the last leg and the blend are over; None for a motion without end."""
        last = self.leg_starts[-1][0]
        if last == inf:
            return None
        return max(self.legs_start_ns + round(last * 1e9), self.blend_end_ns)

    @property
    def blend_end_ns(self) -> int:
        """Fleet time at which the slots are those of the new formation."""
        return self.blend_start_ns + round(self.blend_s * 1e9)

    @property
    def returns(self) -> bool:
        """Whether it brings the vehicles back over their pads, to land there."""
        return self.shape == PADS and self.then == "land"

    @property
    def climb_at_end_m_s(self) -> float:
        """Vertical speed of the centre with which the motion goes on for ever (m/s, up)."""
        return -self.leg_starts[-1][2].down

    def activity(self, fleet_ns: int) -> Literal["none", "legs", "rest"]:
        """What the legs do at a time: there are none, they run, or the centre rests after or within them."""
        if not self.legs:
            return "none"
        t = (fleet_ns - self.legs_start_ns) * 1e-9
        k = max(bisect_right(self._times, t) - 1, 0)
        since, _, v, _ = self.leg_starts[k]
        if k >= len(self.legs):
            return "rest" if v == ZERO else "legs"
        leg = self.legs[k]
        stops = isinstance(leg, VelocityLeg) and leg.velocity_ned_m_s == ZERO
        return "rest" if stops and t - since >= _ramp_s(v) else "legs"

    def state_at(self, fleet_ns: int) -> TrajectoryState:
        """The centre, the heading and the blend at a time; before the legs' start the centre's velocity is constant."""
        t = (fleet_ns - self.legs_start_ns) * 1e-9
        k = max(bisect_right(self._times, t) - 1, 0)
        since, p, v, turned = self.leg_starts[k]
        if t < 0.0 or k >= len(self.legs):
            dt = t - since
            now = _Centre(
                Ned(p.north + v.north * dt, p.east + v.east * dt, p.down + v.down * dt), v, ZERO, 0.0, 0.0, 0.0
            )
        else:
            now = _along(self.legs[k], p, v, t - since)
        follow = 1.0 if self.heading_follows_turns else 0.0
        left, left_rate, left_change = self._left_over_turn(t)
        heading = self.heading_rad + follow * (turned + now.turned) + left
        return TrajectoryState(
            now,
            _wrapped(heading),
            cos(heading),
            sin(heading),
            follow * now.turned_rate + left_rate,
            follow * now.turned_acceleration + left_change,
            self._blend(fleet_ns),
        )

    def _left_over_turn(self, t: float) -> tuple[float, float, float]:
        rate = self.heading_rate_rad_s
        if rate == 0.0:
            return 0.0, 0.0, 0.0
        x = min(max(t / TURN_RAMP_S, 0.0), 1.0)
        return (
            rate * TURN_RAMP_S * (x - x**3 + 0.5 * x**4),
            rate * (1.0 - 3.0 * x * x + 2.0 * x**3),
            rate * 6.0 * x * (x - 1.0) / TURN_RAMP_S,
        )

    def _blend(self, fleet_ns: int) -> tuple[float, float, float]:
        x = (fleet_ns - self.blend_start_ns) * 1e-9 / self.blend_s if self.blend_s > 0.0 else 1.0
        if not 0.0 < x < 1.0:
            return (0.0 if x <= 0.0 else 1.0), 0.0, 0.0
        m, m1, m2 = minimum_jerk(x)
        return m, m1 / self.blend_s, m2 / self.blend_s**2

    def reference(self, vehicle_id: int, fleet_ns: int) -> Reference:
        """p_ref,i, v_d,i and a_d,i of one vehicle's slot at a time."""
        return self.state_at(fleet_ns).slot(self.slots[vehicle_id])


def _wrapped(angle: float) -> float:
    return atan2(sin(angle), cos(angle))


def with_legs(
    motion: FleetTrajectory,
    *,
    at_ns: int,
    issuer: int,
    legs: tuple[Leg, ...],
    then: Then = "stay",
    heading_follows_turns: bool | None = None,
) -> FleetTrajectory:
    """The motion that takes over from `motion` at `at_ns` with other legs; the slots go on as they were."""
    now = motion.state_at(at_ns)
    return replace(
        motion,
        revision=motion.revision + 1,
        start_ns=at_ns,
        issuer=issuer,
        legs_start_ns=at_ns,
        centre_ned_m=now.centre.position,
        velocity_ned_m_s=now.centre.velocity,
        heading_rad=now.heading_rad,
        heading_rate_rad_s=now.rate,
        heading_follows_turns=motion.heading_follows_turns if heading_follows_turns is None else heading_follows_turns,
        legs=legs,
        then=then,
    )


def with_formation(
    motion: FleetTrajectory,
    *,
    at_ns: int,
    issuer: int,
    shape: str,
    slots: Slots,
    pinned: Mapping[int, int],
    speed_m_s: float,
    climb_m_s: float = inf,
    descent_m_s: float = inf,
) -> FleetTrajectory:
    """The motion that takes over from `motion` at `at_ns` with its vehicles moving to other slots.

    Each vehicle's next slot is assigned from the slots it is in at `at_ns`, both nominal (`formation.assign`);
    `pinned` names the slots of vehicles that always take the same. The legs go on as they were.
    """
    m = motion.state_at(at_ns).blend[0]
    ids = sorted(motion.slots)
    before = [Ned(*(a + m * (b - a) for a, b in zip(*motion.slots[i], strict=True))) for i in ids]
    order = assign(before, slots, _rows(ids, pinned))
    changes = [SlotChange(a, slots[k]) for a, k in zip(before, order, strict=True)]
    return replace(
        motion,
        revision=motion.revision + 1,
        start_ns=at_ns,
        issuer=issuer,
        shape=shape,
        slots=dict(zip(ids, changes, strict=True)),
        blend_start_ns=at_ns,
        blend_s=blend_duration_s(changes, speed_m_s, climb_m_s, descent_m_s),
    )


def with_return(
    motion: FleetTrajectory,
    home: FleetTrajectory,
    *,
    at_ns: int,
    issuer: int,
    speed_m_s: float,
    climb_m_s: float = inf,
    descent_m_s: float = inf,
) -> FleetTrajectory:
    """The motion that takes over from `motion` at `at_ns` and brings every vehicle back over its own pad, to land.

    `home` is the first motion, in which each stands over its pad. The centre flies to the pads' centre while the slots
    pass into the pads' arrangement, each vehicle to its own; neither is faster than `speed_m_s`.
    """
    centre = home.state_at(0).centre.position
    here = motion.state_at(at_ns)
    far = at_ns + round(1e9 * TURN_RAMP_S)
    stopped = with_legs(motion, at_ns=at_ns, issuer=issuer, legs=(VelocityLeg(ZERO, 0.0),))
    c, s = cos(stopped.state_at(far).heading_rad), sin(stopped.state_at(far).heading_rad)
    slots = {}
    for i, (a, b) in motion.slots.items():
        pad = home.reference(i, 0).position_ned_m
        north, east, down = (x - y for x, y in zip(pad, centre, strict=True))
        before = Ned(*(x + here.blend[0] * (y - x) for x, y in zip(a, b, strict=True)))
        slots[i] = SlotChange(before, Ned(c * north + s * east, c * east - s * north, down))
    flight = goto_leg(here.centre.position, here.centre.velocity, centre, speed_m_s, climb_m_s, descent_m_s)
    seconds = max(blend_duration_s(list(slots.values()), speed_m_s, climb_m_s, descent_m_s), flight.duration_s)
    return replace(
        stopped, shape=PADS, slots=slots, blend_start_ns=at_ns, blend_s=seconds,
        legs=(GotoLeg(centre, seconds),), then="land",
    )  # fmt: skip


def over_the_pads(motion: FleetTrajectory, home: FleetTrajectory) -> bool:
    """Whether the slots of a motion of shape "pads" are the pads' arrangement, and a return ends over each own pad."""
    ids = sorted(home.slots)
    if set(ids) != set(motion.slots):
        return False
    rows = [(motion.slots[i].after, home.slots[i].after) for i in ids]
    if any(
        abs(dist(a, b) - dist(pad_a, pad_b)) > PAD_TOLERANCE_M
        for k, (a, pad_a) in enumerate(rows)
        for b, pad_b in rows[:k]
    ):
        return False
    if not motion.returns or motion.end_ns is None:
        return not motion.returns
    end = motion.state_at(motion.end_ns)
    return all(
        dist(end.slot(motion.slots[i]).position_ned_m, home.reference(i, 0).position_ned_m) <= PAD_TOLERANCE_M
        for i in ids
    )


def assignment_matches(motion: FleetTrajectory, slots: Slots, pinned: Mapping[int, int]) -> bool:
    """Whether a received motion's slots are what this vehicle assigns from its own configuration; else refused."""
    ids = sorted(motion.slots)
    order = assign([motion.slots[i].before for i in ids], slots, _rows(ids, pinned))
    return len(slots) == len(ids) and all(
        dist(motion.slots[i].after, slots[k]) < 1e-3 for i, k in zip(ids, order, strict=True)
    )


def _rows(ids: Sequence[int], pinned: Mapping[int, int]) -> dict[int, int]:
    return {row: pinned[i] for row, i in enumerate(ids) if i in pinned}


def top_speed_m_s(motion: FleetTrajectory) -> float:
    """The centre's greatest level speed over the motion (m/s)."""
    _, _, v, _ = motion.leg_starts[0]
    fastest = hypot(v.north, v.east)
    for leg, (_, p, v, _) in zip(motion.legs, motion.leg_starts, strict=False):
        if isinstance(leg, GotoLeg):
            fastest = max(fastest, goto_peaks(leg, p, v).level_m_s)
        elif isinstance(leg, VelocityLeg):
            # Between two velocities none is faster than both; a turn changes the direction only.
            fastest = max(fastest, hypot(leg.velocity_ned_m_s.north, leg.velocity_ned_m_s.east))
    return fastest


@dataclass(slots=True)
class TrajectoryHistory:
    """The motions a vehicle knows: the newest, and those before it, for samples made under them."""

    motions: list[FleetTrajectory]

    @property
    def newest(self) -> FleetTrajectory:
        """The motion that wins so far; it may start in the future."""
        return self.motions[-1]

    def adopt(self, motion: FleetTrajectory) -> bool:
        """Take a motion if it is larger than the newest; one that replaces another of its revision replaces it."""
        if motion.order <= self.newest.order:
            return False
        kept = [m for m in self.motions if m.revision < motion.revision]
        self.motions = [*kept[-3:], motion]
        return True

    def at(self, fleet_ns: int) -> FleetTrajectory:
        """The motion in force at a time: the newest that has started."""
        for motion in reversed(self.motions):
            if fleet_ns >= motion.start_ns:
                return motion
        return self.motions[0]

    def reference(self, vehicle_id: int, fleet_ns: int) -> Reference:
        """A vehicle's reference at a time under the motion then in force."""
        return self.at(fleet_ns).reference(vehicle_id, fleet_ns)
