"""Formation shapes and who takes which slot.

A shape gives N slots as offsets (forward, right, down) in metres about the formation's centre, which is the mean of
its slots; a heading turns them into the fleet frame. Shapes exist for every N >= 1.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from math import ceil, cos, inf, pi, sin, sqrt

from companion.core.frames import Ned

Slots = tuple[Ned, ...]
"""offsets (forward, right, down) from the formation's centre, m"""


def v_shape(count: int, spacing_m: float) -> Slots:
    """A V that opens backward: the leader's slot first, then the arms in turn; `spacing_m` along each arm."""
    step = spacing_m / sqrt(2.0)
    return tuple(Ned(-step * ((k + 1) // 2), step * ((k + 1) // 2) * (1 if k % 2 else -1), 0.0) for k in range(count))


def line(count: int, spacing_m: float) -> Slots:
    """Side by side across the heading."""
    return tuple(Ned(0.0, spacing_m * k, 0.0) for k in range(count))


def column(count: int, spacing_m: float) -> Slots:
    """One behind the other along the heading."""
    return tuple(Ned(-spacing_m * k, 0.0, 0.0) for k in range(count))


def circle(count: int, spacing_m: float) -> Slots:
    """On a circle, neighbours `spacing_m` apart (chord)."""
    radius = 0.0 if count == 1 else spacing_m / (2.0 * sin(pi / count)) if count > 2 else spacing_m / 2.0
    return tuple(Ned(radius * cos(2 * pi * k / count), radius * sin(2 * pi * k / count), 0.0) for k in range(count))


def grid(count: int, spacing_m: float) -> Slots:
    """Rows of a square, filled from the front left."""
    side = ceil(sqrt(count))
    return tuple(Ned(-spacing_m * (k // side), spacing_m * (k % side), 0.0) for k in range(count))


def spiral(count: int, spacing_m: float) -> Slots:
    """An Archimedean spiral in the level plane, neighbours along it and turns of it `spacing_m` apart."""
    slots = [Ned(0.0, 0.0, 0.0)]
    angle = 0.0
    pitch = spacing_m / (2 * pi) * 1.15
    while len(slots) < count:
        last = slots[-1]
        low, high = angle, angle + 2 * pi
        for _ in range(60):
            middle = 0.5 * (low + high)
            x, y = pitch * middle * cos(middle), pitch * middle * sin(middle)
            low, high = (low, middle) if sqrt((x - last[0]) ** 2 + (y - last[1]) ** 2) >= spacing_m else (middle, high)
        angle = high
        slots.append(Ned(pitch * angle * cos(angle), pitch * angle * sin(angle), 0.0))
    return tuple(slots)


def sphere(count: int, spacing_m: float) -> Slots:
    """A Fibonacci lattice on a sphere, scaled until the nearest two slots are `spacing_m` apart."""
    if count == 1:
        return (Ned(0.0, 0.0, 0.0),)
    golden = pi * (3.0 - sqrt(5.0))
    unit = []
    for k in range(count):
        z = 1.0 - 2.0 * (k + 0.5) / count
        r = sqrt(1.0 - z * z)
        unit.append((r * cos(golden * k), r * sin(golden * k), z))
    scale = spacing_m / minimum_distance(unit)
    return tuple(Ned(scale * x, scale * y, scale * z) for x, y, z in unit)


SHAPES: Mapping[str, Callable[[int, float], Slots]] = {
    "v": v_shape,
    "line": line,
    "column": column,
    "circle": circle,
    "grid": grid,
    "spiral": spiral,
    "sphere": sphere,
}


def centred(slots: Sequence[Sequence[float]]) -> Slots:
    """The slots about their mean."""
    n = len(slots)
    mean = [sum(s[k] for s in slots) / n for k in range(3)]
    return tuple(Ned(s[0] - mean[0], s[1] - mean[1], s[2] - mean[2]) for s in slots)


def shape_slots(shape: str, count: int, spacing_m: float) -> Slots:
    """The named shape's slots about their mean; KeyError for a shape that does not exist."""
    return centred(SHAPES[shape](count, spacing_m))


def rotated(slots: Sequence[Ned], heading_rad: float) -> Slots:
    """(forward, right, down) offsets as (north, east, down) at a heading (rad, clockwise from north)."""
    c, s = cos(heading_rad), sin(heading_rad)
    return tuple(Ned(c * f - s * r, s * f + c * r, d) for f, r, d in slots)


def pairwise_distances_m(slots: Sequence[Sequence[float]], vertical_scale: float = 1.0) -> list[float]:
    """Distances of all pairs (m) in order (0,1), (0,2), ...; down divided by `vertical_scale`."""
    points = [(north, east, down / vertical_scale) for north, east, down in slots]
    return [sqrt((a - d) ** 2 + (b - e) ** 2 + (c - f) ** 2) for (a, b, c), (d, e, f) in combinations(points, 2)]


def minimum_distance(slots: Sequence[Sequence[float]], vertical_scale: float = 1.0) -> float:
    """Smallest distance of any pair (m); infinite for fewer than two."""
    return min(pairwise_distances_m(slots, vertical_scale), default=inf)
