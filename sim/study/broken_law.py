"""A law that is broken: it flies at some velocity, whatever plan and peers say. Only the safety filter is left."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot

from companion.core.frames import Ned
from companion.core.law.base import Wanted
from companion.core.trajectory.fleet import Reference
from companion.core.values import Neighbour, VehicleState
from sim.lockstep.wrapped_law import WrappedLaw

GAIN_PER_S = 3.0
PUSH_MAX_M_S2 = 5.0


@dataclass(slots=True)
class BrokenLaw(WrappedLaw):
    """A sound law that breaks; give it to an agent as its `law`."""

    velocity_ned_m_s: Ned | None = None
    """what the broken law flies at; None: the law is sound"""

    def command(
        self, ego: VehicleState, reference: Reference, neighbours: Sequence[Neighbour], *, alone: bool
    ) -> Wanted:
        """What the sound law wants, or the broken command in its place."""
        sound = self.law.command(ego, reference, neighbours, alone=alone)
        wanted, v = self.velocity_ned_m_s, ego.velocity_ned_m_s
        if wanted is None:
            return sound
        north, east = GAIN_PER_S * (wanted.north - v.north), GAIN_PER_S * (wanted.east - v.east)
        over = max(hypot(north, east) / PUSH_MAX_M_S2, 1.0)
        return Wanted(Ned(north / over, east / over, 0.0), sound.residual_ned_m)
