"""The fence: a cylinder or a polygon over the ground, with a floor and a ceiling. Plain floats, no library.

`clearance_m` is the distance to the nearest limit, negative outside: whether a vehicle is where it may be. `room_m` is
what is left of it to the margins: where a vehicle may be sent. The safety filter keeps the margins by a barrier on each
wall, so that lag, delay and gusts are paid from them and not from the fence.

    h = distance to the wall - margin,      h'' + 2 p h' + p^2 h >= 0

With h >= 0 and p h + h' >= 0 at the start, h never becomes negative. A vehicle that comes straight at v meets the
barrier 2 v/p before the margin and brakes with p v/e at most.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from math import e, hypot, inf, isfinite, sqrt
from typing import NamedTuple

from companion.core.frames import Ned

FENCE_POLE_PER_S = 1.5
"""slower than the peers': a vehicle with 0.3 s of lag and 0.1 s of delay overshoots the less, 0.5 m at 4 m/s"""
BRAKING_SHARE = 0.5
"""part of the avoidance acceleration with which the barrier brakes at the speed limit; gusts and lag have the rest"""
RETURN_SPEED_M_S = 1.0
"""how fast a vehicle beyond the margin is driven back"""


class Wall(NamedTuple):
    """A piece of the edge, seen from one place."""

    room_m: float
    """distance to it less the margin; negative within the margin and outside"""
    north: float
    """unit vector away from the wall, into the fence"""
    east: float
    bend_per_m: float = 0.0
    """h'' = n.u + bend (speed along the wall)^2"""


@dataclass(frozen=True)
class Fence:
    """Where vehicles may be, in the fleet frame; without radius and corners only floor and ceiling limit."""

    floor_m: float
    """above the fleet origin"""
    ceiling_m: float
    radius_m: float | None = None
    centre_north_m: float = 0.0
    centre_east_m: float = 0.0
    corners_m: tuple[tuple[float, float], ...] = ()
    """(north, east) of a simple polygon, either way round"""
    margin_m: float = 2.0
    """vehicles stay this far inside the edge"""
    vertical_margin_m: float = 0.5
    """and this far above the floor and below the ceiling"""

    @cached_property
    def _edges(self) -> tuple[tuple[float, float, float, float, float], ...]:
        """(north, east) of each edge's start, its unit direction with the inside on its left, and its length."""
        corners = self.corners_m
        area = sum(a[0] * b[1] - b[0] * a[1] for a, b in zip(corners, (*corners[1:], *corners[:1]), strict=True))
        if area < 0.0:
            corners = corners[::-1]
        edges = []
        for a, b in zip(corners, (*corners[1:], *corners[:1]), strict=True):
            length = hypot(b[0] - a[0], b[1] - a[1])
            if length > 0.0:
                edges.append((a[0], a[1], (b[0] - a[0]) / length, (b[1] - a[1]) / length, length))
        return tuple(edges)

    def _feet(self, north: float, east: float) -> Iterator[tuple[float, float, float, float, float]]:
        """Of each edge: distance, vector from its nearest point to the place, and its normal into the fence."""
        for a_north, a_east, d_north, d_east, length in self._edges:
            along = min(max((north - a_north) * d_north + (east - a_east) * d_east, 0.0), length)
            x, y = north - a_north - along * d_north, east - a_east - along * d_east
            yield hypot(x, y), x, y, -d_east, d_north

    def _within(self, north: float, east: float) -> bool:
        """Whether a ray to the north crosses the polygon's edge an odd number of times."""
        odd = False
        for a_north, a_east, d_north, d_east, length in self._edges:
            b_east = a_east + length * d_east
            if (a_east > east) != (b_east > east) and north < a_north + (east - a_east) * d_north / d_east:
                odd = not odd
        return odd

    def edge_clearance_m(self, north: float, east: float) -> float:
        """Level distance to the edge, negative outside; infinite without an edge."""
        if self.radius_m is not None:
            return self.radius_m - hypot(north - self.centre_north_m, east - self.centre_east_m)
        if not self._edges:
            return inf
        distance = min(foot[0] for foot in self._feet(north, east))
        return distance if self._within(north, east) else -distance

    @cached_property
    def convex(self) -> bool:
        """Whether the straight way between two places inside is inside: of a cylinder, and of a polygon without notch.

        Only then is the least room on a straight way that at one of its ends.
        """
        edges = self._edges
        return all(a[2] * b[3] - a[3] * b[2] >= -1e-12 for a, b in zip(edges, (*edges[1:], *edges[:1]), strict=True))

    def edge_room_along_m(self, a_north: float, a_east: float, b_north: float, b_east: float) -> float:
        """Least room to the edge's margin on the straight way from a to b; minus infinity where the way leads over the
        edge of a polygon with notches, or begins outside it."""
        if self._edges and not self.convex:
            return self._notched_room_along_m(a_north, a_east, b_north, b_east)
        if self._edges:
            # Inside, the nearest edge is that whose line is nearest; outside, the line is no further than the edge.
            least = inf
            for c_north, c_east, d_north, d_east, _ in self._edges:
                a = (a_east - c_east) * d_north - (a_north - c_north) * d_east
                b = (b_east - c_east) * d_north - (b_north - c_north) * d_east
                least = min(least, a, b)
            if least >= 0.0:
                return least - self.margin_m
        return min(self.edge_room_m(a_north, a_east), self.edge_room_m(b_north, b_east))

    def _notched_room_along_m(self, a_north: float, a_east: float, b_north: float, b_east: float) -> float:
        """Two ways that do not cross are nearest at an end of one of them."""
        way_north, way_east = b_north - a_north, b_east - a_east
        way2 = way_north * way_north + way_east * way_east
        least2, within = inf, False
        for c_north, c_east, d_north, d_east, length in self._edges:
            ax, ay = a_north - c_north, a_east - c_east
            bx, by = b_north - c_north, b_east - c_east
            a_along, b_along = ax * d_north + ay * d_east, bx * d_north + by * d_east
            a_left, b_left = ay * d_north - ax * d_east, by * d_north - bx * d_east
            if (a_left > 0.0) != (b_left > 0.0):
                crossing = a_along + a_left / (a_left - b_left) * (b_along - a_along)
                if 0.0 <= crossing <= length:
                    return -inf
            end_east = c_east + length * d_east
            if (c_east > a_east) != (end_east > a_east) and a_north < c_north + (a_east - c_east) * d_north / d_east:
                within = not within
            beyond = a_along - min(max(a_along, 0.0), length)
            least2 = min(least2, beyond * beyond + a_left * a_left)
            beyond = b_along - min(max(b_along, 0.0), length)
            least2 = min(least2, beyond * beyond + b_left * b_left)
            # The edge's start from the way; its end is the next edge's start.
            share = min(max(-(ax * way_north + ay * way_east) / way2, 0.0), 1.0) if way2 > 0.0 else 0.0
            x, y = ax + share * way_north, ay + share * way_east
            least2 = min(least2, x * x + y * y)
        return sqrt(least2) - self.margin_m if within else -inf

    def clearance_m(self, position_ned_m: Ned) -> float:
        """Distance to the nearest of edge, floor and ceiling; negative outside."""
        altitude = -position_ned_m.down
        return min(
            self.edge_clearance_m(position_ned_m.north, position_ned_m.east),
            altitude - self.floor_m,
            self.ceiling_m - altitude,
        )

    def contains(self, position_ned_m: Ned) -> bool:
        """Whether a place is inside; the margins are not counted. One that is not finite is not."""
        return all(map(isfinite, position_ned_m)) and self.clearance_m(position_ned_m) >= 0.0

    def edge_room_m(self, north: float, east: float) -> float:
        """Level distance to the edge's margin; negative beyond it."""
        return self.edge_clearance_m(north, east) - self.margin_m

    def vertical_room_m(self, down: float) -> float:
        """Distance to the margin of floor or ceiling, the nearer one; negative beyond it."""
        return min(self.lowest_down_m - down, down - self.highest_down_m)

    def room_m(self, position_ned_m: Ned) -> float:
        """Distance to the nearest margin; negative beyond it."""
        north, east, down = position_ned_m
        return min(self.edge_room_m(north, east), self.vertical_room_m(down))

    @property
    def highest_down_m(self) -> float:
        """Down of the ceiling's margin."""
        return self.vertical_margin_m - self.ceiling_m

    @property
    def lowest_down_m(self) -> float:
        """Down of the floor's margin."""
        return -self.vertical_margin_m - self.floor_m

    def walls(self, north: float, east: float) -> tuple[Wall, ...]:
        """What of the edge a barrier must keep from there: inside every edge, outside the way back.

        Of an edge whose nearest point is its end the barrier is that of the point, taken without the bend that would
        let a vehicle nearer: so a notch limits the place beside it and not the whole line of its edge.
        """
        if self.radius_m is not None:
            return (self._round_wall(north - self.centre_north_m, east - self.centre_east_m, self.radius_m),)
        if not self._edges:
            return ()
        if self._within(north, east):
            return tuple(
                Wall(d - self.margin_m, x / d, y / d) if d > 1e-9 else Wall(-self.margin_m, n_north, n_east)
                for d, x, y, n_north, n_east in self._feet(north, east)
            )
        d, x, y, n_north, n_east = min(self._feet(north, east))
        if d <= 1e-9:
            return (Wall(-self.margin_m, n_north, n_east),)
        return (Wall(-d - self.margin_m, -x / d, -y / d),)

    def _round_wall(self, x: float, y: float, radius: float) -> Wall:
        r = hypot(x, y)
        kept = radius - self.margin_m
        n_north, n_east = (-x / r, -y / r) if r > 1e-9 else (-1.0, 0.0)
        # The bend of the distance grows without bound toward the centre, where no wall is near.
        return Wall(kept - r, n_north, n_east, -1.0 / max(r, 0.5 * kept))


def braking_pole_per_s(speed_max_m_s: float, avoidance_acceleration_m_s2: float) -> float:
    """Pole of the fence's barrier: at the speed limit it brakes with a share of what avoidance may use, p v/e."""
    return min(FENCE_POLE_PER_S, BRAKING_SHARE * e * avoidance_acceleration_m_s2 / speed_max_m_s)


def wall_plane(wall: Wall, v_north: float, v_east: float, pole_per_s: float) -> tuple[float, float, float]:
    """(n_north, n_east, b) of n.u >= b, the barrier of one wall for the level command u (m/s^2).

    Beyond the margin h is taken no deeper than what leads back at RETURN_SPEED_M_S.
    """
    h_rate = wall.north * v_north + wall.east * v_east
    across = v_east * wall.north - v_north * wall.east
    h = max(wall.room_m, -2.0 * RETURN_SPEED_M_S / pole_per_s)
    b = -wall.bend_per_m * across * across - 2.0 * pole_per_s * h_rate - pole_per_s * pole_per_s * h
    return wall.north, wall.east, b
