"""The compiled law, called as the plain one is: for whoever compares the two."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.core.frames import Ned
from companion.core.law.base import Wanted
from companion.core.law.starling import Gains
from companion.core.trajectory.fleet import Reference
from companion.core.values import Neighbour, VehicleState
from sim.swarm import kernels
from sim.swarm.kernels import Floats


def as_rows(neighbours: Sequence[Neighbour]) -> Floats:
    """Neighbours as the kernels keep them, shape (at least 1, ROW)."""
    rows = np.zeros((max(len(neighbours), 1), kernels.ROW))
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
        sums = kernels.sums_over(ego, slot_velocity, rows, len(neighbours), alone, self.gains)
        return Wanted(Ned(*kernels.combine(sums, ego, reference, self.gains)), kernels.mean_residual(sums))

    def reset(self) -> None:
        """Nothing is kept."""

    @property
    def fields(self) -> tuple[str, ...]:
        """None."""
        return ()

    def tell(self) -> tuple[float, ...]:
        """Nothing."""
        return ()
