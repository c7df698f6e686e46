"""Vector helpers that the peer table and the safety filter share."""

from companion.core.frames import Ned


def share_of_segment(position: Ned, a: Ned, b: Ned, vertical_ratio: float = 1.0) -> float:
    """How far along from a (0) to b (1) the place nearest to `position` is, vertical lengths divided by the ratio."""
    north, east, down = b.north - a.north, b.east - a.east, (b.down - a.down) / vertical_ratio**2
    length2 = north * north + east * east + down * (b.down - a.down)
    if length2 <= 1e-9:
        return 0.0
    along = (position.north - a.north) * north + (position.east - a.east) * east + (position.down - a.down) * down
    return min(max(along / length2, 0.0), 1.0)


def between(a: Ned, b: Ned, share: float) -> Ned:
    """The place that far along from a (0) to b (1)."""
    return Ned(
        a.north + share * (b.north - a.north), a.east + share * (b.east - a.east), a.down + share * (b.down - a.down)
    )
