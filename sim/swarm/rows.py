"""Law and safety filter over the rows of one agent's neighbours, compiled; and the law as the plain one is called."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.core.frames import Ned
from companion.core.law.base import Wanted
from companion.core.law.starling import Gains, Sums
from companion.core.safety.avoidance import Avoidance
from companion.core.trajectory.fleet import Reference
from companion.core.trigger.near import PUSH_M_S2
from companion.core.values import Neighbour, VehicleState
from sim.swarm.compiled import (
    avoid,
    combine,
    half_plane,
    kernel,
    mean_residual,
    near_push_m_s2,
    out_of_reach,
    push_m_s2,
    share,
)
from sim.swarm.state import ROW, Floats


@kernel
def neighbour(rows: Floats, k: int) -> Neighbour:
    """Row k as the core's functions take it."""
    last_seen = None
    if rows[k, 12] > 0.0:
        last_seen = Ned(rows[k, 13], rows[k, 14], rows[k, 15])
    return Neighbour(
        0, Ned(rows[k, 0], rows[k, 1], rows[k, 2]), Ned(rows[k, 3], rows[k, 4], rows[k, 5]),
        Ned(rows[k, 6], rows[k, 7], rows[k, 8]), 0.0, rows[k, 9] > 0.0, rows[k, 10] > 0.0, rows[k, 11], last_seen,
        Ned(rows[k, 16], rows[k, 17], rows[k, 18]), Ned(rows[k, 19], rows[k, 20], rows[k, 21]), (),
    )  # fmt: skip


@kernel
def sums_over(ego: VehicleState, slot_velocity: Ned, rows: Floats, count: int, alone: bool, g: Gains) -> Sums:
    """`law.sums_over` of the first `count` rows, rounded after each term."""
    sx, sy, sz, vx, vy, vz, px, py, pz, rx, ry, rz, n = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(count):
        q = share(ego, slot_velocity, neighbour(rows, k), alone, g)
        sx, sy, sz = sx + q.sep_x, sy + q.sep_y, sz + q.sep_z
        vx, vy, vz = vx + q.vel_x, vy + q.vel_y, vz + q.vel_z
        px, py, pz = px + q.pos_x, py + q.pos_y, pz + q.pos_z
        rx, ry, rz, n = rx + q.res_x, ry + q.res_y, rz + q.res_z, n + q.formed
    return Sums(sx, sy, sz, vx, vy, vz, px, py, pz, rx, ry, rz, n)


@kernel
def constrain(
    u_north: float, u_east: float, ego: VehicleState, shared: Ned, rows: Floats, count: int, most: float,
    planes: Floats, spare: Floats,
) -> Avoidance:  # fmt: skip
    """What the safety filter makes of a command for the sake of the first `count` rows; see `core.safety.filter`."""
    peers = 0
    for k in range(count):
        n = neighbour(rows, k)
        if out_of_reach(ego, shared, n, most):
            continue
        h = half_plane(ego, shared, n)
        planes[peers, 0], planes[peers, 1], planes[peers, 2] = h.g_north, h.g_east, h.b
        planes[peers, 3], planes[peers, 4] = h.v_north, h.v_east
        peers += 1
    return avoid(
        u_north, u_east, ego.velocity_ned_m_s.north, ego.velocity_ned_m_s.east, planes, peers, peers, most, spare
    )


@kernel
def is_near(
    ego: VehicleState, slot_velocity: Ned, shared: Ned, rows: Floats, k: int, most: float, closest: float, radius: float
) -> bool:
    """Whether the peer of row k is near, as `vehicle.publisher` takes it from the filter's half-planes."""
    n = neighbour(rows, k)
    if rows[k, 12] > 0.0 or out_of_reach(ego, shared, n, most):
        return False
    push = push_m_s2(half_plane(ego, shared, n))
    return push < PUSH_M_S2 and push < near_push_m_s2(n, slot_velocity, closest, radius)


def as_rows(neighbours: Sequence[Neighbour]) -> Floats:
    """Neighbours as the kernels keep them, shape (at least 1, ROW)."""
    rows = np.zeros((max(len(neighbours), 1), ROW))
    for row, n in zip(rows, neighbours, strict=False):
        last = n.last_seen_ned_m
        row[:] = (
            *n.position_ned_m, *n.velocity_ned_m_s, *n.offset_ned_m, n.in_formation, n.shares_avoidance,
            n.uncertainty_m, last is not None, *(last or (0.0, 0.0, 0.0)), *n.reference_velocity_ned_m_s,
            *n.reference_acceleration_ned_m_s2,
        )  # fmt: skip
    return rows


@dataclass(frozen=True, slots=True)
class CompiledLaw:
    """`law.starling.StarlingLaw`, compiled."""

    gains: Gains

    def command(
        self, ego: VehicleState, reference: Reference, neighbours: Sequence[Neighbour], *, alone: bool
    ) -> Wanted:
        """See `Law`."""
        rows, slot_velocity = as_rows(neighbours), reference.velocity_ned_m_s
        sums = sums_over(ego, slot_velocity, rows, len(neighbours), alone, self.gains)
        return Wanted(Ned(*combine(sums, ego, reference, self.gains)), mean_residual(sums))

    def reset(self) -> None:
        """Nothing is kept."""

    @property
    def fields(self) -> tuple[str, ...]:
        """None."""
        return ()

    def tell(self) -> tuple[float, ...]:
        """Nothing."""
        return ()
