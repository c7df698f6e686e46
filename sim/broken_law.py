"""A law that is broken: a safety filter that is given a flight at some velocity, whatever plan and peers say."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot

from companion.core.frames import Ned
from companion.core.safety import SafetyFilter
from companion.core.values import Command, Neighbour, SafeSetpoint, VehicleState

GAIN_PER_S = 3.0
PUSH_MAX_M_S2 = 5.0


@dataclass(slots=True)
class BrokenLaw(SafetyFilter):
    """The real filter behind a broken law; give it to an agent as its `safety`."""

    velocity_ned_m_s: Ned | None = None
    """what the broken law flies at; None: the law is sound"""

    def apply(
        self,
        command: Command,
        ego: VehicleState,
        neighbours: Sequence[Neighbour],
        velocity_bias_ned_m_s: Ned,
        dt_s: float,
    ) -> SafeSetpoint | None:
        """Filter the broken law's command instead of the given one."""
        if self.velocity_ned_m_s is not None:
            wanted, v = self.velocity_ned_m_s, ego.velocity_ned_m_s
            north, east = GAIN_PER_S * (wanted.north - v.north), GAIN_PER_S * (wanted.east - v.east)
            over = max(hypot(north, east) / PUSH_MAX_M_S2, 1.0)
            command = command._replace(acceleration_ned_m_s2=Ned(north / over, east / over, 0.0))
        return SafetyFilter.apply(self, command, ego, neighbours, velocity_bias_ned_m_s, dt_s)
