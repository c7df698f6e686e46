"""The fence: a cylinder or a polygon over the ground, with a floor and a ceiling.

What is asked at every tick is plain floats; what is asked of many places at once takes a library for a polygon.

`clearance_m` is the distance to the nearest limit, negative outside: whether a vehicle is where it may be. `room_m` is
what is left of it to the margins: where a vehicle may be sent. The safety filter keeps the margins by a barrier on each
wall, so that lag, delay and gusts are paid from them and not from the fence.

    h = distance to the wall - margin,      h'' + 2 p h' + p^2 h >= 0

With h >= 0 and p h + h' >= 0 at the start, h never becomes negative. A vehicle that comes straight at v meets the
barrier 2 v/p before the margin and brakes with p v/e at most.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import dist, e, hypot, inf, isfinite
from typing import TYPE_CHECKING, NamedTuple, cast

from companion.core.frames import Ned

if TYPE_CHECKING:
    from shapely import LinearRing, Polygon

FENCE_POLE_PER_S = 1.5
"""slower than the peers': a vehicle with 0.3 s of lag and 0.1 s of delay overshoots the less, 0.5 m at 4 m/s"""
BRAKING_SHARE = 0.5
"""part of the avoidance acceleration with which the barrier brakes at the speed limit; gusts and lag have the rest"""
RETURN_SPEED_M_S = 1.0
"""how fast a vehicle beyond the margin is driven back"""


SHORTEST_WAY_M = 1e-9
"""a shorter way is a place"""


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

    @cached_property
    def _polygon(self) -> "tuple[Polygon, LinearRing]":
        """What is inside of the corners, and its edge, made ready for many questions."""
        # Only here: a companion without a polygon need not load it.
        import shapely

        polygon = shapely.Polygon(self.corners_m)
        edge = polygon.exterior
        shapely.prepare([polygon, edge])
        return polygon, edge

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

    def edge_rooms_m(self, places: Sequence[tuple[float, float]]) -> list[float]:
        """`edge_room_m` of many places (north, east), at little more than the cost of one where the edge has many
        corners."""
        if not self._edges:
            return [self.edge_room_m(*place) for place in places]
        import numpy as np
        import shapely

        polygon, edge = self._polygon
        distance = shapely.distance(edge, shapely.points(places))
        within = shapely.contains_xy(polygon, places)
        return cast(list[float], (np.where(within, distance, -distance) - self.margin_m).tolist())

    def edge_rooms_along_m(self, ways: Sequence[tuple[tuple[float, float], tuple[float, float]]]) -> list[float]:
        """Least room to the edge's margin on each straight way; minus infinity for one that leads over the edge of a
        polygon, or begins outside it."""
        if not self._edges:
            return [min(self.edge_room_m(*a), self.edge_room_m(*b)) for a, b in ways]
        import numpy as np
        import shapely

        polygon, edge = self._polygon
        # The square of a length much shorter than this would vanish, and shapely would divide by it.
        lines = [(a, b if dist(a, b) > SHORTEST_WAY_M else a) for a, b in ways]
        distance = shapely.distance(edge, shapely.linestrings(lines))
        within = shapely.contains_xy(polygon, [a for a, _ in ways])
        return cast(list[float], np.where(within & (distance > 0.0), distance - self.margin_m, -inf).tolist())

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

    @cached_property
    def highest_down_m(self) -> float:
        """Down of the ceiling's margin."""
        return self.vertical_margin_m - self.ceiling_m

    @cached_property
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
