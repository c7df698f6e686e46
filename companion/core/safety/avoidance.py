"""What becomes of a wanted command where half-planes forbid it: of those they leave, the one nearest to it.

Where it is a peer that blocks the command, it is moved along that peer first: two that are sent head on would else stop
in front of each other, each at the command nearest to its own.
"""

from collections.abc import MutableSequence, Sequence
from math import hypot
from typing import NamedTuple

from companion.core.safety.program import FLAT, solve

SIDESTEP_SPEED_M_S = 0.6
"""speed along the obstacle at which a blocked vehicle passes it, on its right"""


class Avoidance(NamedTuple):
    """What becomes of a wanted command."""

    north: float
    east: float
    peer: bool
    """it came too near to a peer"""
    wall: bool
    """it came too near to a wall"""
    peers_missed_m_s2: float
    """by how much not even this command keeps the peers' half-planes"""
    walls_missed_m_s2: float


def avoid(
    u_north: float, u_east: float, v_north: float, v_east: float, rows: Sequence[MutableSequence[float]], peers: int,
    count: int, most: float, spare: Sequence[MutableSequence[float]],
) -> Avoidance:  # fmt: skip
    """The command nearest to u, |u| <= `most`, that keeps what the rows say, at the own velocity v (m/s).

    Rows are those of half-planes, `peers` of peers before those of walls, `count` in all; they and `spare`, room for as
    many, are used up. Where it is a peer that blocks u, u is moved along it first.
    """
    blocking, worst, wall = -1, 0.0, False
    for k in range(count):
        missing = rows[k][2] - rows[k][0] * u_north - rows[k][1] * u_east
        if missing > 0.0 and k >= peers:
            wall = True
        elif missing > 0.0:
            missing = missing / max(hypot(rows[k][0], rows[k][1]), FLAT)
            if missing > worst:
                blocking, worst = k, missing
    peer = blocking >= 0
    if not peer and not wall:
        return Avoidance(u_north, u_east, False, False, 0.0, 0.0)
    if peer:
        row = rows[blocking]
        u_north, u_east = sidestep(u_north, u_east, row[0], row[1], v_north - row[3], v_east - row[4])
    s = solve(u_north, u_east, rows, peers, count, most, spare)
    return Avoidance(s.north, s.east, peer, wall, s.peers_missed, s.others_missed)


def sidestep(
    u_north: float, u_east: float, g_north: float, g_east: float, v_north: float, v_east: float
) -> tuple[float, float]:
    """u with what moves it to the right along the plane that it violates most; v is the velocity relative to the
    obstacle (m/s). A command that does not press against the obstacle stays as it is: without this, head-on pairs stop
    for ever."""
    size = max(hypot(g_north, g_east), FLAT)
    n_north, n_east = g_north / size, g_east / size
    pressing = -(u_north * n_north + u_east * n_east)
    right_north, right_east = n_east, -n_north
    sideways = v_north * right_north + v_east * right_east
    push = min(max(pressing, 0.0), 1.0) * 1.5 * max(SIDESTEP_SPEED_M_S - sideways, 0.0)
    return u_north + push * right_north, u_east + push * right_east
