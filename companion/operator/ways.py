"""How near straight ways come to each other: from where vehicles stand, and during a change of formation."""

from collections.abc import Sequence
from itertools import combinations
from math import hypot, sqrt

from companion.core.frames import Ned
from companion.core.safety.filter import DOWNWASH_RATIO
from companion.core.trajectory.fleet import FleetTrajectory

Point = tuple[float, float, float] | Ned
"""north, east, down (m, fleet frame)"""


def change_distances_m(motion: FleetTrajectory) -> dict[tuple[int, int], float]:
    """Least distance of every pair during a change of formation, exact.

    All slots blend by one polynomial of time, so that a pair's offset goes straight from before to after; distances
    above each other count by the downwash's ratio.
    """
    found = {}
    for (i, a), (j, b) in combinations(motion.slots.items(), 2):
        before = [x - y for x, y in zip(a.before, b.before, strict=True)]
        after = [x - y for x, y in zip(a.after, b.after, strict=True)]
        found[i, j] = _nearest_to_zero(_squeezed(before), _squeezed(after))
    return found


def level_distance_m(p: Point, q: Point) -> float:
    """Distance on the map."""
    return hypot(p[0] - q[0], p[1] - q[1])


def ways_apart_m(a0: Point, a1: Point, b0: Point, b1: Point) -> float:
    """Least level distance between the ways from a0 to a1 and from b0 to b1."""
    if _cross(a0, a1, b0, b1):
        return 0.0
    return min(_to_way(a0, b0, b1), _to_way(a1, b0, b1), _to_way(b0, a0, a1), _to_way(b1, a0, a1))


def _squeezed(offset: Sequence[float]) -> Ned:
    return Ned(offset[0], offset[1], offset[2] / DOWNWASH_RATIO)


def _nearest_to_zero(p: Ned, q: Ned) -> float:
    """Distance of the segment from p to q to the zero point."""
    way = [b - a for a, b in zip(p, q, strict=True)]
    length = sum(w * w for w in way)
    t = 0.0 if length == 0.0 else min(max(-sum(a * w for a, w in zip(p, way, strict=True)) / length, 0.0), 1.0)
    return sqrt(sum((a + t * w) ** 2 for a, w in zip(p, way, strict=True)))


def _to_way(p: Point, a: Point, b: Point) -> float:
    return _nearest_to_zero(Ned(a[0] - p[0], a[1] - p[1], 0.0), Ned(b[0] - p[0], b[1] - p[1], 0.0))


def _cross(a0: Point, a1: Point, b0: Point, b1: Point) -> bool:
    def side(p: Point, q: Point, r: Point) -> float:
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])

    return side(a0, a1, b0) * side(a0, a1, b1) < 0 and side(b0, b1, a0) * side(b0, b1, a1) < 0
