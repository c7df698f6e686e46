"""The gates of a settled formation: a peer whose prediction is far from what the others' say does not draw it."""

from collections.abc import Mapping, Sequence
from statistics import median

from companion.core.frames import Ned
from companion.core.values import Neighbour

GATE_VELOCITY_M_S = 0.7
GATE_RESIDUAL_M = 2.0
GATE_PERIOD_NS = 100_000_000
"""how often they are looked at"""


def is_outlier(velocity_north: float, velocity_east: float, residual_north: float, residual_east: float) -> bool:
    """The gates of a formed peer: its velocity against its slot's (m/s), its residual against the median's (m)."""
    return (
        velocity_north * velocity_north + velocity_east * velocity_east > GATE_VELOCITY_M_S * GATE_VELOCITY_M_S
        or residual_north * residual_north + residual_east * residual_east > GATE_RESIDUAL_M * GATE_RESIDUAL_M
    )


def outliers(
    neighbours: Sequence[Neighbour], ego: Ned, said: Mapping[int, tuple[float, float] | None] | None = None
) -> frozenset[int]:
    """Ids of those in formation whose prediction is far from what the others' say.

    Where no motion is shared, `said` is what each takes for the common velocity (north, east, m/s), and its own is
    compared with that: the vehicles are still to agree, and one that flees, or knows where to go, flies as it says.
    """
    residuals = []
    for n in neighbours:
        if n.in_formation:
            p, d = n.position_ned_m, n.offset_ned_m
            residuals.append((n, ego.north - p.north - d.north, ego.east - p.east - d.east))
    if not residuals:
        return frozenset()
    middle_north, middle_east = median(r[1] for r in residuals), median(r[2] for r in residuals)
    gated = []
    for n, north, east in residuals:
        v, slot = n.velocity_ned_m_s, n.reference_velocity_ned_m_s
        due_north, due_east = (said and said[n.vehicle_id]) or (slot.north, slot.east)
        if is_outlier(v.north - due_north, v.east - due_east, north - middle_north, east - middle_east):
            gated.append(n.vehicle_id)
    return frozenset(gated)
