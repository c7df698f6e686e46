"""The small program behind the safety filter: two unknowns, half-planes and a disc, solved exactly.

Of the horizontal commands x with |x| <= a that satisfy every row g.x >= b, the one nearest to a wanted u is sought.
Where there is none the rows are lowered, the first `peers` of them (distances) before the rest (the fence): each class
by its least largest miss, max(b - g.x), and of the commands that miss no more the one nearest to u is taken. A miss has
the unit of the rows; those of the filter are made so that it is the acceleration (m/s^2) at which a distance falls
short.

The method is incremental linear programming (Seidel, "Small-dimensional linear programming and convex hulls made easy",
1991) with a disc, as in linear programs 1 to 3 of RVO2 (van den Berg, Guy, Lin, Manocha, "Reciprocal n-body collision
avoidance", ISRR 2009), with the nearest command where theirs is mostly the farthest along a direction. If the best
command for the first k rows breaks row k + 1, the best for k + 1 rows lies on that row's edge, since what is allowed is
convex: on a line, of which the disc and the rows before leave an interval. So n rows take at most n (n - 1)/2
intersections. The least miss is a program in one more unknown: where row k + 1 is missed by more than all before, it is
the worst in the solution, and no row before may be missed by more; these are half-planes again, one for each, within
which the command lies that is farthest along g.

Rows are (g_north, g_east, b, ...) of any scale, as many as `count`; one whose gradient is below FLAT binds no command.
Plain floats and loops over rows: a companion calls these functions as they are, a swarm study compiles them.
"""

from collections.abc import MutableSequence, Sequence
from math import copysign, hypot, sqrt
from typing import NamedTuple

ROUNDING = 1e-12
"""share of |g| a by which a command may miss an edge and still lies on it"""
SLACK = 1e-9
"""share of |g| a by which rows that cannot be met are lowered beyond their least miss: rounding must not close what is
left of the set"""
FLAT = 1e-12
"""a smaller gradient is none"""


class Solution(NamedTuple):
    """A command, and by how much the rows of each class are missed where not all can be met."""

    north: float
    east: float
    peers_missed: float
    others_missed: float


def solve(
    u_north: float, u_east: float, rows: Sequence[MutableSequence[float]], peers: int, count: int, most: float,
    spare: Sequence[MutableSequence[float]],
) -> Solution:  # fmt: skip
    """The command nearest to u within all rows and the disc |x| <= `most`, or what misses least; see above.

    Where not all rows can be met their b are lowered in place. `spare` is room for as many rows.
    """
    north, east, met = best(u_north, u_east, False, rows, count, most)
    if met:
        return Solution(north, east, 0.0, 0.0)
    north, east, peers_missed = give_way(0.0, 0.0, rows, 0, peers, most, spare)
    north, east, others_missed = give_way(north, east, rows, peers, count, most, spare)
    x, y, met = best(u_north, u_east, False, rows, count, most)
    if met:
        north, east = x, y
    return Solution(north, east, peers_missed, others_missed)


def best(
    u_north: float, u_east: float, far: bool, rows: Sequence[Sequence[float]], count: int, most: float
) -> tuple[float, float, bool]:
    """The command within rows and disc that is nearest to u or, if `far`, farthest in its direction; False if none is
    within."""
    share = most / max(hypot(u_north, u_east), FLAT)
    if not far:
        share = min(share, 1.0)
    north, east = share * u_north, share * u_east
    met = True
    for k in range(count):
        size = hypot(rows[k][0], rows[k][1])
        missing = rows[k][2] - rows[k][0] * north - rows[k][1] * east
        if size >= FLAT and missing > ROUNDING * size * most:
            north, east, met = on_edge(u_north, u_east, far, rows, k, most)
            if not met:
                break
    return north, east, met


def on_edge(
    u_north: float, u_east: float, far: bool, rows: Sequence[Sequence[float]], k: int, most: float
) -> tuple[float, float, bool]:
    """`best` among the commands on the edge of row k, within the rows before it and the disc."""
    size = hypot(rows[k][0], rows[k][1])
    n_north, n_east, foot = rows[k][0] / size, rows[k][1] / size, rows[k][2] / size
    # The edge is foot (n_north, n_east) + t (-n_east, n_north).
    met = foot <= most * (1.0 + ROUNDING)
    high = sqrt(max(most * most - foot * foot, 0.0))
    low = -high
    for j in range(k):
        size = hypot(rows[j][0], rows[j][1])
        if size < FLAT:
            continue
        g_north, g_east = rows[j][0] / size, rows[j][1] / size
        slope = g_east * n_north - g_north * n_east
        missing = rows[j][2] / size - foot * (g_north * n_north + g_east * n_east)
        if slope > ROUNDING:
            low = max(low, missing / slope)
        elif slope < -ROUNDING:
            high = min(high, missing / slope)
        elif missing > ROUNDING * most:
            met = False
    if low > high + ROUNDING * most:
        met = False
    t = u_east * n_north - u_north * n_east
    if far:
        t = copysign(2.0 * most, t)
    t = min(max(t, low), high)
    return foot * n_north - t * n_east, foot * n_east + t * n_north, met


def give_way(
    north: float, east: float, rows: Sequence[MutableSequence[float]], first: int, count: int, most: float,
    spare: Sequence[MutableSequence[float]],
) -> tuple[float, float, float]:  # fmt: skip
    """Lower rows[first:count] by their least largest miss among the commands within rows[:first] and the disc.

    (north, east) is one of these commands. Returns one that misses no more, and the miss.
    """
    least = 0.0
    for i in range(first, count):
        g_north, g_east, b = rows[i][0], rows[i][1], rows[i][2]
        size = hypot(g_north, g_east)
        if size < FLAT or b - g_north * north - g_east * east <= least + ROUNDING * size * most:
            continue
        for j in range(i):
            share = 1.0 if j >= first and hypot(rows[j][0], rows[j][1]) >= FLAT else 0.0
            spare[j][0] = rows[j][0] - share * g_north
            spare[j][1] = rows[j][1] - share * g_east
            spare[j][2] = rows[j][2] - share * b
        x, y, met = best(g_north, g_east, True, spare, i, most)
        if met:
            # There is such a command; where rounding hides it, the one at hand stays.
            north, east = x, y
        least = max(b - g_north * north - g_east * east, 0.0)
    for i in range(first, count):
        rows[i][2] -= least + SLACK * most * hypot(rows[i][0], rows[i][1])
    return north, east, least
