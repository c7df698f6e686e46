"""A law of springs: each vehicle is tied to its own slot, and to the nearest few of its neighbours.

    u = a_d - d (v - v_d) - k sat(p - p_ref) - (c/n) sum_{n nearest} sat((p - p^_j) - d_ij) + share * mean u_j

Starlings heed their six or seven nearest, however far these are (Ballerini et al., "Interaction ruling animal
collective behavior depends on topological rather than metric distance", PNAS 105(4), 2008). u_j is what the neighbours
last said that they want: two numbers that this law adds to each message. It keeps no distance: the safety filter does.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import dist, hypot
from typing import Annotated, Literal

from pydantic import Field

from companion.config.law_tables import LawTable
from companion.core.frames import Ned
from companion.core.law.base import Wanted
from companion.core.trajectory.fleet import Reference
from companion.core.values import Neighbour, VehicleState

Gain = Annotated[float, Field(ge=0, le=20, allow_inf_nan=False)]
SATURATION_M = 1.0


class SpringsTable(LawTable):
    """[law] with kind = "springs"."""

    kind: Literal["springs"] = "springs"
    damping_per_s: Gain = 3.0
    slot_per_s2: Gain = 1.0
    neighbours_per_s2: Gain = 2.0
    nearest: Annotated[int, Field(ge=1, le=50)] = 7
    share: Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False)] = 0.1

    def law(self, r0_m: float) -> "SpringsLaw":
        """The law of one vehicle. It has no separation, so `r0_m` is of no use to it."""
        del r0_m
        return SpringsLaw(self)


@dataclass(slots=True)
class SpringsLaw:
    """See above; `Law` of `companion.core.law.base`."""

    table: SpringsTable
    fields: tuple[str, ...] = ("wanted_north_m_s2", "wanted_east_m_s2")
    _wanted: tuple[float, float] = (0.0, 0.0)

    def command(
        self, ego: VehicleState, reference: Reference, neighbours: Sequence[Neighbour], *, alone: bool
    ) -> Wanted:
        """The wanted acceleration, and the mean residual to those that are heeded."""
        t, p, v = self.table, ego.position_ned_m, ego.velocity_ned_m_s
        r, rv, ra = reference[:3]
        north, east = _saturated(p.north - r.north, p.east - r.east)
        u_north = ra.north - t.damping_per_s * (v.north - rv.north) - t.slot_per_s2 * north
        u_east = ra.east - t.damping_per_s * (v.east - rv.east) - t.slot_per_s2 * east
        formed = [] if alone else [n for n in neighbours if n.in_formation]
        heeded = sorted(formed, key=lambda n: (dist(p, n.position_ned_m), n.vehicle_id))[: t.nearest]
        residual_north = residual_east = 0.0
        for n in heeded:
            off_north = p.north - n.position_ned_m.north - n.offset_ned_m.north
            off_east = p.east - n.position_ned_m.east - n.offset_ned_m.east
            residual_north, residual_east = residual_north + off_north, residual_east + off_east
            north, east = _saturated(off_north, off_east)
            told_north, told_east = n.told or (0.0, 0.0)
            u_north += (t.share * told_north - t.neighbours_per_s2 * north) / len(heeded)
            u_east += (t.share * told_east - t.neighbours_per_s2 * east) / len(heeded)
        over = max(hypot(u_north, u_east) / t.a_max_m_s2, 1.0)
        self._wanted = u_north / over, u_east / over
        each = max(len(heeded), 1)
        return Wanted(Ned(*self._wanted, 0.0), Ned(residual_north / each, residual_east / each, 0.0))

    def reset(self) -> None:
        """What was wanted before is forgotten."""
        self._wanted = (0.0, 0.0)

    def tell(self) -> tuple[float, ...]:
        """What was wanted last."""
        return self._wanted


def _saturated(north: float, east: float) -> tuple[float, float]:
    over = max(hypot(north, east) / SATURATION_M, 1.0)
    return north / over, east / over
