"""The starling law: separation, alignment and cohesion toward a desired formation.

The functions below are the whole of it, on plain numbers and `Neighbour` values: `share` is what one neighbour adds,
`combine` makes the command of the sum. A companion calls them as they are; a swarm study compiles them
(`sim.swarm.kernels`). Only `sums_over`, the sum between them, has a compiled form of its own: it is rounded once here
and after each term there.

With the symbols of the paper (Mei, Duan: "Decentralized Cooperative Control of Unmanned Aerial Vehicles Based on
Emergent Mechanism of Starlings"), its Eq. (2) reads

    u_i = k_s sum_j phi_s(r_ij) r^_ij - k_a sum_j (v_i - v^_j) - k_c sum_j ((p_i - p^_j) - d_ij)
    phi_s(r) = 1/r^2 - 1/r0^2 for r < r0, else 0

and what is flown by default is

    u      = u_sep + s u_rest      u_sep clipped at a_max, s the largest in [0, 1] with |u| <= a_max
    u_sep  = k_s sum_{r < r0} (1/r^2 - 1/r0^2) r^_ij                       r floored at 0.2 m
    u_rest = -(k_a/n) sum sat(v_i - v^_j) - (k_c/n) sum sat(p_i - p^_j - d_ij) - k_v (v_i - v_d) + a_d - k_p sat(m_i)
    m_i    = mean over self and neighbours of p^_j - p_ref,j

Velocities are compared as they differ from what the plan asks of each slot: slots that turn or change places have their
own. Whoever is not in formation is kept apart from; whoever is not known to be at one place is left to the filter.

Deviations from the paper: separation repels (the printed sign attracts) and ends at r0; the sums are divided by the
number of neighbours n, so that stiffness does not grow with the crowd; errors saturate, so that a far neighbour cannot
outweigh separation; k_v, a_d and k_p keep the formation moving and in place, where Eq. (2) under held neighbours
brakes it to a standstill. `Gains` with `normalise = 0`, infinite saturations, `k_v = k_p = 0` is Eq. (2) itself
(`core.law.paper`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import fsum, sqrt
from typing import NamedTuple

from companion.core.frames import Ned
from companion.core.law.base import Wanted
from companion.core.trajectory.fleet import Reference
from companion.core.values import Neighbour, VehicleState

DISTANCE_FLOOR_M = 0.2
"""separation grows no further below this distance"""


class Gains(NamedTuple):
    """Gains of the law, per vehicle the same."""

    k_s: float
    """separation (m^3/s^2)"""
    k_a: float
    """alignment (1/s)"""
    k_c: float
    """cohesion (1/s^2)"""
    k_v: float
    """tracking of the plan's velocity (1/s)"""
    k_p: float
    """tracking of the plan's place by the neighbourhood's mean (1/s^2); 0 without a plan"""
    r0: float
    """separation's range (m)"""
    a_max: float
    """limit of the whole command (m/s^2)"""
    saturation_position: float
    """norm at which a position error saturates (m)"""
    saturation_velocity: float
    """norm at which a velocity error saturates (m/s)"""
    normalise: float
    """1: sums are divided by the number of neighbours; 0: they are not (Eq. 2)"""
    vertical: float = 1.0
    """1: the law acts along the vertical too; 0: on the level only, distances still in space (altitude is flown by
    position)"""


class Sums(NamedTuple):
    """What neighbours add: separation, saturated velocity error, saturated position error, position residual."""

    sep_x: float
    sep_y: float
    sep_z: float
    vel_x: float
    vel_y: float
    vel_z: float
    pos_x: float
    pos_y: float
    pos_z: float
    res_x: float
    res_y: float
    res_z: float
    formed: float
    """how many of the neighbours are in formation"""


def pair(
    dx: float, dy: float, dz: float, dvx: float, dvy: float, dvz: float, ox: float, oy: float, oz: float, g: Gains
) -> Sums:
    """One neighbour's share of the sums of Eq. (2).

    (dx, dy, dz) = p_i - p^_j (m), (dvx, dvy, dvz) = v_i - v^_j (m/s), (ox, oy, oz) = d_ij (m). At zero distance the
    direction is undefined and separation is zero.
    """
    r = max(sqrt(dx * dx + dy * dy + dz * dz), DISTANCE_FLOOR_M)
    sep = g.k_s * max(1.0 / (r * r) - 1.0 / (g.r0 * g.r0), 0.0) / r
    vel = min(1.0, g.saturation_velocity / max(sqrt(dvx * dvx + dvy * dvy + dvz * dvz), 1e-12))
    ex = dx - ox
    ey = dy - oy
    ez = dz - oz
    pos = min(1.0, g.saturation_position / max(sqrt(ex * ex + ey * ey + ez * ez), 1e-12))
    return Sums(
        sep * dx, sep * dy, sep * dz, vel * dvx, vel * dvy, vel * dvz, pos * ex, pos * ey, pos * ez, ex, ey, ez,
        1.0,
    )  # fmt: skip


def separation(dx: float, dy: float, dz: float, g: Gains) -> Sums:
    """Separation alone, from a neighbour that alignment and cohesion do not heed."""
    s = pair(dx, dy, dz, 0.0, 0.0, 0.0, dx, dy, dz, g)
    return Sums(s.sep_x, s.sep_y, s.sep_z, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def share(ego: VehicleState, slot_velocity: Ned, n: Neighbour, alone: bool, g: Gains) -> Sums:
    """What a neighbour adds; `slot_velocity` (m/s) is what the plan asks of the own slot, v_d."""
    p, q = ego.position_ned_m, n.position_ned_m
    dx, dy, dz = p.north - q.north, p.east - q.east, p.down - q.down
    if n.in_formation and not alone:
        v, w, s, d = ego.velocity_ned_m_s, n.velocity_ned_m_s, n.reference_velocity_ned_m_s, n.offset_ned_m
        return pair(
            dx, dy, dz,
            v.north - w.north - (slot_velocity.north - s.north),
            v.east - w.east - (slot_velocity.east - s.east),
            g.vertical * (v.down - w.down - (slot_velocity.down - s.down)),
            d.north, d.east, d.down if g.vertical > 0.0 else dz, g,
        )  # fmt: skip
    if n.last_seen_ned_m is None:
        return separation(dx, dy, dz, g)
    return NO_SUMS


def sums_over(ego: VehicleState, slot_velocity: Ned, neighbours: Sequence[Neighbour], alone: bool, g: Gains) -> Sums:
    """The sums over the neighbours."""
    return total([share(ego, slot_velocity, n, alone, g) for n in neighbours])


def combine(s: Sums, ego: VehicleState, reference: Reference, g: Gains) -> tuple[float, float, float]:
    """The command u (m/s^2) from the sums.

    Since the residual to j is (p_i - p_ref,i) - (p^_j - p_ref,j), the mean m_i over self and neighbours is
    e_i - sum(residuals)/(n + 1), with e_i = p_i - p_ref,i.
    """
    p, v = ego.position_ned_m, ego.velocity_ned_m_s
    r, rv, ra = reference.position_ned_m, reference.velocity_ned_m_s, reference.acceleration_ned_m_s2
    divisor = max(g.normalise * s.formed, 1.0)
    mx = p.north - r.north - s.res_x / (s.formed + 1.0)
    my = p.east - r.east - s.res_y / (s.formed + 1.0)
    mz = g.vertical * (p.down - r.down) - s.res_z / (s.formed + 1.0)
    k_p = g.k_p * min(1.0, g.saturation_position / max(sqrt(mx * mx + my * my + mz * mz), 1e-12))
    k_a = g.k_a / divisor
    k_c = g.k_c / divisor
    bx = ra.north - k_a * s.vel_x - k_c * s.pos_x - g.k_v * (v.north - rv.north) - k_p * mx
    by = ra.east - k_a * s.vel_y - k_c * s.pos_y - g.k_v * (v.east - rv.east) - k_p * my
    bz = g.vertical * (ra.down - g.k_v * (v.down - rv.down)) - k_a * s.vel_z - k_c * s.pos_z - k_p * mz
    return within_budget(s.sep_x, s.sep_y, g.vertical * s.sep_z, bx, by, bz, g.a_max)


def mean_residual(s: Sums) -> Ned:
    """Mean of p_i - p^_j - d_ij over the neighbours in formation (m)."""
    each = 1.0 / max(s.formed, 1.0)
    return Ned(each * s.res_x, each * s.res_y, each * s.res_z)


def within_budget(
    sep_x: float, sep_y: float, sep_z: float, bx: float, by: float, bz: float, a_max: float
) -> tuple[float, float, float]:
    """u = u_sep + s u_rest: separation clipped at a_max, and as much of the rest as the same limit leaves room for."""
    clip = min(1.0, a_max / max(sqrt(sep_x * sep_x + sep_y * sep_y + sep_z * sep_z), 1e-12))
    cx = clip * sep_x
    cy = clip * sep_y
    cz = clip * sep_z
    share = _share(cx * bx + cy * by + cz * bz, bx * bx + by * by + bz * bz, cx * cx + cy * cy + cz * cz, a_max)
    return cx + share * bx, cy + share * by, cz + share * bz


def _share(ab: float, bb: float, aa: float, a_max: float) -> float:
    """The largest s in [0, 1] with |a + s b| <= a_max, given a.b, b.b, a.a and |a| <= a_max."""
    bb = max(bb, 1e-12)
    root = sqrt(max(ab * ab + bb * max(min(a_max * a_max, 1e12) - aa, 0.0), 0.0))
    return max(0.0, min(1.0, (root - ab) / bb))


NO_SUMS = Sums(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def total(shares: Sequence[Sums]) -> Sums:
    """The sums of the shares, rounded once: their order is of no matter."""
    return Sums(*map(fsum, zip(*shares, strict=True))) if shares else NO_SUMS


@dataclass(frozen=True, slots=True)
class StarlingLaw:
    """The law that is flown; with the gains of `core.law.paper` Eq. (2) of the paper."""

    gains: Gains

    def command(
        self, ego: VehicleState, reference: Reference, neighbours: Sequence[Neighbour], *, alone: bool
    ) -> Wanted:
        """See `Law`."""
        g = self.gains
        sums = sums_over(ego, reference.velocity_ned_m_s, neighbours, alone, g)
        return Wanted(Ned(*combine(sums, ego, reference, g)), mean_residual(sums))

    def reset(self) -> None:
        """Nothing is kept."""

    @property
    def fields(self) -> tuple[str, ...]:
        """None."""
        return ()

    def tell(self) -> tuple[float, ...]:
        """Nothing."""
        return ()
