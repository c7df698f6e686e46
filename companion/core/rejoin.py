"""The own reference of a vehicle that is apart from the formation: it stands, then comes back to its slot smoothly."""

from dataclasses import dataclass

from companion.core.frames import Ned
from companion.core.trajectory.fleet import Reference
from companion.core.trajectory.polynomials import fading, minimum_jerk
from companion.core.trajectory.slots import SlotChange, blend_duration_s
from companion.core.values import ZERO


@dataclass(slots=True)
class RejoinTrajectory:
    """Stands at a place; once `come_back` is called, its distance from the slot fades away, whatever the slot does.

    With o and w the distance and the velocity relative to the slot at the start, m the minimum-jerk polynomial and f
    the quintic that fades a velocity, both over the whole time T: p(t) = p_slot(t) + (1 - m) o + T f w. Position,
    velocity and acceleration are continuous but for what the slot itself does.
    """

    place_ned_m: Ned
    start_ns: int | None = None
    """fleet time at which it set out; None: it stands"""
    _seconds: float = 1.0
    _offset: Ned = ZERO
    _velocity: Ned = ZERO

    def come_back(self, slot: Reference, own: Reference, fleet_ns: int, speed_m_s: float) -> None:
        """Set out from the own reference towards the slot's."""
        self._offset = _minus(own.position_ned_m, slot.position_ned_m)
        self._velocity = _minus(own.velocity_ned_m_s, slot.velocity_ned_m_s)
        way = SlotChange(own.position_ned_m, slot.position_ned_m)
        self._seconds = blend_duration_s([way], speed_m_s, speed_m_s, speed_m_s)
        self.start_ns = fleet_ns

    def reference(self, slot: Reference, fleet_ns: int) -> Reference:
        """The own reference at a time, given the slot's."""
        if self.start_ns is None:
            return Reference(self.place_ned_m, ZERO, ZERO, slot.heading_rad)
        whole = self._seconds
        x = (fleet_ns - self.start_ns) * 1e-9 / whole
        (m, m1, m2), (f, f1, f2) = minimum_jerk(x), fading(x)
        rows = list(zip(self._offset, self._velocity, strict=True))
        p, v, a = (
            Ned(*(s + on_offset * o + on_velocity * w for s, (o, w) in zip(of_slot, rows, strict=True)))
            for of_slot, on_offset, on_velocity in (
                (slot.position_ned_m, 1.0 - m, whole * f),
                (slot.velocity_ned_m_s, -m1 / whole, f1 if x < 1.0 else 0.0),
                (slot.acceleration_ned_m_s2, -m2 / whole**2, f2 / whole if x < 1.0 else 0.0),
            )
        )
        return Reference(p, v, a, slot.heading_rad)

    def over(self, fleet_ns: int) -> bool:
        """Whether it is back in its slot."""
        return self.start_ns is not None and fleet_ns - self.start_ns >= round(self._seconds * 1e9)


def _minus(a: Ned, b: Ned) -> Ned:
    return Ned(a.north - b.north, a.east - b.east, a.down - b.down)
