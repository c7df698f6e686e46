"""The starling law: separation, alignment and cohesion toward a desired formation.

A `Law` says what a vehicle flies, before the safety filter; a companion holds one and can be given another. The one
that is flown, `StarlingLaw`, sums over the neighbours with two branch-free scalar functions on plain floats, which a
swarm study compiles over neighbour lists. With the symbols of the paper (Mei, Duan: "Decentralized Cooperative
Control of Unmanned Aerial Vehicles Based on Emergent Mechanism of Starlings"), its Eq. (2) reads

    u_i = k_s sum_j phi_s(r_ij) r^_ij - k_a sum_j (v_i - v^_j) - k_c sum_j ((p_i - p^_j) - d_ij)
    phi_s(r) = 1/r^2 - 1/r0^2 for r < r0, else 0

and what is flown by default is

    u      = u_sep + s u_rest      u_sep clipped at a_max, s the largest in [0, 1] with |u| <= a_max
    u_sep  = k_s sum_{r < r0} (1/r^2 - 1/r0^2) r^_ij                       r floored at 0.2 m
    u_rest = -(k_a/n) sum sat(v_i - v^_j) - (k_c/n) sum sat(p_i - p^_j - d_ij) - k_v (v_i - v_d) + a_d - k_p sat(m_i)
    m_i    = mean over self and neighbours of p^_j - p_ref,j

Deviations from the paper: separation repels (the printed sign attracts) and ends at r0; the sums are divided by the
number of neighbours n, so that stiffness does not grow with the crowd; errors saturate, so that a far neighbour cannot
outweigh separation; k_v, a_d and k_p keep the formation moving and in place, where Eq. (2) under held neighbours
brakes it to a standstill. `Gains` with `normalise = 0`, infinite saturations, `k_v = k_p = 0` is Eq. (2) itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import fsum, inf, sqrt
from typing import NamedTuple, Protocol

from companion.core.frames import Ned
from companion.core.trajectory.fleet import Reference
from companion.core.values import Command, Neighbour, VehicleState

DISTANCE_FLOOR_M = 0.2
"""separation grows no further below this distance"""


class Law(Protocol):
    """What a vehicle flies toward its slot and among its neighbours; it keeps no distance by itself."""

    def command(
        self, ego: VehicleState, reference: Reference, neighbours: Sequence[Neighbour], *, alone: bool
    ) -> tuple[Command, Ned]:
        """The wanted command, and the mean residual p_i - p^_j - d_ij to the neighbours in formation (m), which the
        trigger looks at.

        `ego` is the own state, its velocity free of the estimator's bias; `reference` is what the plan asks of the own
        slot. A vehicle that flies `alone` is not drawn by the formation.
        """
        ...


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


class Sums(NamedTuple):
    """What one neighbour adds: (separation, saturated velocity error, saturated position error, position residual)."""

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
    return Sums(sep * dx, sep * dy, sep * dz, vel * dvx, vel * dvy, vel * dvz, pos * ex, pos * ey, pos * ez, ex, ey, ez)


def separation(dx: float, dy: float, dz: float, g: Gains) -> tuple[float, float, float]:
    """Separation alone, for a neighbour that alignment and cohesion do not heed."""
    s = pair(dx, dy, dz, 0.0, 0.0, 0.0, dx, dy, dz, g)
    return s.sep_x, s.sep_y, s.sep_z


def finish(
    n: float,
    s: Sums,
    ex: float, ey: float, ez: float,
    wx: float, wy: float, wz: float,
    ax: float, ay: float, az: float,
    g: Gains,
) -> tuple[float, float, float]:  # fmt: skip
    """The command u (m/s^2) from the sums over n neighbours.

    (ex, ey, ez) = p_i - p_ref,i (m), (wx, wy, wz) = v_i - v_d (m/s), (ax, ay, az) = a_d (m/s^2). Since the residual to
    j is (p_i - p_ref,i) - (p^_j - p_ref,j), the mean m_i over self and neighbours is e_i - sum(residuals)/(n + 1).
    """
    divisor = max(g.normalise * n, 1.0)
    mx = ex - s.res_x / (n + 1.0)
    my = ey - s.res_y / (n + 1.0)
    mz = ez - s.res_z / (n + 1.0)
    k_p = g.k_p * min(1.0, g.saturation_position / max(sqrt(mx * mx + my * my + mz * mz), 1e-12))
    k_a = g.k_a / divisor
    k_c = g.k_c / divisor
    bx = ax - k_a * s.vel_x - k_c * s.pos_x - g.k_v * wx - k_p * mx
    by = ay - k_a * s.vel_y - k_c * s.pos_y - g.k_v * wy - k_p * my
    bz = az - k_a * s.vel_z - k_c * s.pos_z - g.k_v * wz - k_p * mz
    return within_budget(s.sep_x, s.sep_y, s.sep_z, bx, by, bz, g.a_max)


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


NO_SUMS = Sums(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def total(shares: Sequence[Sums]) -> Sums:
    """The sums over the neighbours, rounded once: the neighbours' order is of no matter."""
    return Sums(*map(fsum, zip(*shares, strict=True))) if shares else NO_SUMS


def paper_gains(k_s: float, k_a: float, k_c: float, r0: float) -> Gains:
    """Eq. (2) as printed, with the repulsive sign: plain sums, no saturation, no plan, no limit."""
    return Gains(k_s, k_a, k_c, 0.0, 0.0, r0, inf, inf, inf, 0.0)


@dataclass(frozen=True, slots=True)
class StarlingLaw:
    """The law that is flown; with `paper_gains` Eq. (2) of the paper."""

    gains: Gains

    def command(
        self, ego: VehicleState, reference: Reference, neighbours: Sequence[Neighbour], *, alone: bool
    ) -> tuple[Command, Ned]:
        """See `Law`.

        Altitude is flown by position, so the vertical errors are left out of the horizontal budget. Velocities are
        compared as they differ from what the plan asks of each slot: slots that turn or change places have their own.
        Whoever is not in formation, or is not known to be at one place, is kept apart from or left to the filter.
        """
        p, v, g = ego.position_ned_m, ego.velocity_ned_m_s, self.gains
        r, rv, ra, yaw = reference
        shares = []
        apart = (0.0, 0.0)
        for n in neighbours:
            q, w, d = n.position_ned_m, n.velocity_ned_m_s, n.offset_ned_m
            dx, dy, dz = p.north - q.north, p.east - q.east, p.down - q.down
            if n.in_formation and not alone:
                s = n.reference_velocity_ned_m_s
                dvx, dvy = v.north - w.north - (rv.north - s.north), v.east - w.east - (rv.east - s.east)
                shares.append(pair(dx, dy, dz, dvx, dvy, 0.0, d.north, d.east, dz, g))
            elif n.last_seen_ned_m is None:
                away = separation(dx, dy, dz, g)
                apart = (apart[0] + away[0], apart[1] + away[1])
        sums, count = total(shares), len(shares)
        sums = sums._replace(sep_x=sums.sep_x + apart[0], sep_y=sums.sep_y + apart[1], sep_z=0.0)
        u = finish(
            count, sums,
            p.north - r.north, p.east - r.east, 0.0,
            v.north - rv.north, v.east - rv.east, 0.0,
            ra.north, ra.east, 0.0,
            g,
        )  # fmt: skip
        share = 1.0 / count if count else 0.0
        return Command(Ned(*u), r, rv, ra, yaw), Ned(sums.res_x * share, sums.res_y * share, 0.0)
