"""What an agent returns from one `advance`: datagrams, messages, events, and what its control tick did."""

from dataclasses import dataclass, field

from companion.core.events import Event, sentence
from companion.core.frames import Ned


@dataclass(slots=True)
class TickReport:
    """What one control tick did, for the recording and the live table."""

    position_error_m: float
    """distance from the own slot"""
    neighbours: int
    """in formation"""
    nearest_m: float
    """distance of the nearest peer; -1 without one"""
    steered: bool
    """whether a setpoint was sent"""
    position_ned_m: Ned
    """own position and velocity as believed (fleet frame)"""
    velocity_ned_m_s: Ned


@dataclass(slots=True)
class Outputs:
    """What to send after one `advance`, in order."""

    mavlink: list[bytes] = field(default_factory=list)
    peers: list[tuple[str, bytes]] = field(default_factory=list)
    """(topic, payload)"""
    events: list[Event] = field(default_factory=list)
    """what happened"""
    tick: TickReport | None = None
    """None where no control tick was due, or the own state is not known"""

    @property
    def notes(self) -> list[str]:
        """What happened, for the log."""
        return [sentence(event) for event in self.events]
