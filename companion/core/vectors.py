"""Vector helpers that the peer table, the trajectories and the safety filter share."""

from collections.abc import Sequence
from math import dist, inf

from companion.core.frames import Ned


def closest_point_parameter(position: Ned, a: Ned, b: Ned, vertical_ratio: float = 1.0) -> float:
    """How far along from a (0) to b (1) the place nearest to `position` is, vertical lengths divided by the ratio."""
    north, east, down = b.north - a.north, b.east - a.east, (b.down - a.down) / vertical_ratio**2
    length2 = north * north + east * east + down * (b.down - a.down)
    if length2 <= 1e-9:
        return 0.0
    along = (position.north - a.north) * north + (position.east - a.east) * east + (position.down - a.down) * down
    return min(max(along / length2, 0.0), 1.0)


def lerp(a: Ned, b: Ned, share: float) -> Ned:
    """The place that far along from a (0) to b (1)."""
    return Ned(
        a.north + share * (b.north - a.north), a.east + share * (b.east - a.east), a.down + share * (b.down - a.down)
    )


def nearest_on_path(position: Ned, path: Sequence[Ned], vertical_ratio: float) -> tuple[int, float]:
    """Where a path of at least two points is nearest: the edge's number, and how far along it (0 to 1)."""
    best, found = inf, (0, 0.0)
    for k in range(len(path) - 1):
        a, b = path[k], path[k + 1]
        share = closest_point_parameter(position, a, b, vertical_ratio)
        p = lerp(a, b, share)
        distance2 = (
            (p.north - position.north) ** 2
            + (p.east - position.east) ** 2
            + ((p.down - position.down) / vertical_ratio) ** 2
        )
        if distance2 < best:
            best, found = distance2, (k, share)
    return found


def off_chord(path: Sequence[Ned]) -> float:
    """How far the points of a path are from the straight line between its ends, at most (m)."""
    a, b = path[0], path[-1]
    return max(dist(p, lerp(a, b, closest_point_parameter(p, a, b))) for p in path)


def piece_about(path: Sequence[Ned], edge: int, share: float, half_m: float) -> tuple[Ned, Ned, float]:
    """A straight piece of a path about a place on it, no longer than `half_m` to either side of the place.

    Returns the piece's end towards the path's end, the one towards its start, and how far from the former to the latter
    the place is (0 to 1). It ends where the path does.
    """
    a, b = path[edge], path[edge + 1]
    length = max(dist(a, b), 1e-9)
    at_m = share * length
    forward = half_m if edge < len(path) - 2 else min(half_m, length - at_m)
    backward = half_m if edge > 0 else min(half_m, at_m)
    front = lerp(a, b, (at_m + forward) / length)
    back = lerp(a, b, (at_m - backward) / length)
    return front, back, forward / max(forward + backward, 1e-9)
