"""What a fleet must agree on: where the centre starts, how it goes on (legs), and how slots change with formations.

A `FleetTrajectory` is complete in itself, so a late joiner needs only the newest one, and a new one starts exactly
where the one before has taken the formation. They are ordered by (revision, start, issuer); the largest wins, which is
how vehicles without a leader agree on one of several proposals.
"""

from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property
from math import atan2, cos, hypot, inf, sin
from typing import Literal, NamedTuple

from companion.core.frames import Ned, new
from companion.core.trajectory.goto import goto_peaks
from companion.core.trajectory.legs import (
    TURN_RAMP_S,
    CentreState,
    FreeLeg,
    GotoLeg,
    Leg,
    VelocityLeg,
    along,
    leg_end,
    velocity_ramp_s,
)
from companion.core.trajectory.polynomials import minimum_jerk
from companion.core.trajectory.slots import SlotChange
from companion.core.values import ZERO

REVISIONS = 1 << 32
"""a trajectory's revision is below this, as it travels"""
PADS = "pads"
"""name of the formation in which each vehicle is over its own pad"""
Then = Literal["stay", "land", "return"]


class Reference(NamedTuple):
    """Position (m), velocity (m/s), acceleration (m/s^2) in the fleet frame, and heading (rad)."""

    position_ned_m: Ned
    velocity_ned_m_s: Ned
    acceleration_ned_m_s2: Ned
    heading_rad: float
    shared: bool = True
    """false: no motion is shared, and the place is where the neighbours put it"""


class TrajectoryState(NamedTuple):
    """A motion at one time: what all its slots have in common, so that each slot costs little."""

    centre: CentreState
    heading_rad: float
    cosine: float
    sine: float
    rate: float
    rate_change: float
    blend: tuple[float, float, float]
    """part of the way from the slots before to those after, its rate (1/s) and the rate's change (1/s^2)"""

    def place(self, change: SlotChange) -> Ned:
        """p_ref,i alone."""
        p, c, s, m = self.centre.position, self.cosine, self.sine, self.blend[0]
        (f0, r0, d0), (f1, r1, d1) = change
        forward, right = f0 + m * (f1 - f0), r0 + m * (r1 - r0)
        return new(
            Ned, (p.north + (c * forward - s * right), p.east + (s * forward + c * right), p.down + d0 + m * (d1 - d0))
        )

    def slot(self, change: SlotChange) -> Reference:
        """p_ref,i = c + R(psi) D_i and its derivatives."""
        (p, v, a, _, _, _), heading, c, s, rate, bend, (m, m1, m2) = self
        (f0, r0, d0), (f1, r1, d1) = change
        df, dr, dd = f1 - f0, r1 - r0, d1 - d0
        forward, right = f0 + m * df, r0 + m * dr
        dn, de = c * forward - s * right, s * forward + c * right
        if rate == bend == m1 == m2 == 0.0:
            # Slots at rest in a formation that does not turn, which is most of a flight: all move as the centre does.
            return new(Reference, (new(Ned, (p.north + dn, p.east + de, p.down + d0 + m * dd)), v, a, heading, True))
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

    @cached_property
    def free_from_ns(self) -> int | None:
        """Fleet time from which no common motion is shared; None: it always is."""
        if not self.legs or not isinstance(self.legs[-1], FreeLeg):
            return None
        return max(self.legs_start_ns + round(self.leg_starts[len(self.legs) - 1][0] * 1e9), self.start_ns)

    def free_at(self, fleet_ns: int) -> bool:
        """Whether no common motion is shared at a time."""
        return self.free_from_ns is not None and fleet_ns >= self.free_from_ns

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
        if isinstance(leg, VelocityLeg) and leg.velocity_ned_m_s == ZERO and t - since >= velocity_ramp_s(leg, v):
            return "rest"
        return "legs"

    def state_at(self, fleet_ns: int) -> TrajectoryState:
        """The centre, the heading and the blend at a time; before the legs' start the centre's velocity is constant."""
        t = (fleet_ns - self.legs_start_ns) * 1e-9
        k = max(bisect_right(self._times, t) - 1, 0)
        since, p, v, turned = self.leg_starts[k]
        if t < 0.0 or k >= len(self.legs):
            dt = t - since
            now = CentreState(
                Ned(p.north + v.north * dt, p.east + v.east * dt, p.down + v.down * dt), v, ZERO, 0.0, 0.0, 0.0
            )
        else:
            now = along(self.legs[k], p, v, t - since)
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
