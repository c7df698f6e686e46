"""What a law is to the vehicle that flies it.

A law takes what is known and says what acceleration it wants; the altitude, the heading, the setpoint and the distances
are not its own. A vehicle holds one, made by the table of its kind (`config.law_tables`).
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from companion.core.frames import Ned
from companion.core.trajectory.fleet import Reference
from companion.core.values import Command, Neighbour, VehicleState

FIELDS_MAX = 8
"""most numbers that a law adds to a message: 4 B each, in every message"""


class Wanted(NamedTuple):
    """What a law asks for."""

    acceleration_ned_m_s2: Ned
    """before the safety filter; only the level part is flown, since altitude is flown by position"""
    residual_ned_m: Ned
    """mean of p_i - p^_j - d_ij over the neighbours in formation, which the trigger looks at"""

    def command(self, reference: Reference) -> Command:
        """What the safety filter is given: place, speed and heading are those of the plan, whatever the law."""
        return Command(self.acceleration_ned_m_s2, *reference[:4])


class Law(Protocol):
    """What a vehicle flies toward its slot and among its neighbours; it keeps no distance by itself.

    A law may keep a state of its own (an anchor, an estimate of the common velocity); `ego.time_ns` is the time. What
    it is given cannot be changed. How a silent peer is predicted its table says (`core.prediction.Hold`).
    """

    def command(
        self, ego: VehicleState, reference: Reference, neighbours: Sequence[Neighbour], *, alone: bool
    ) -> Wanted:
        """The wanted acceleration at this tick.

        `ego` is the own state, its velocity free of the estimator's bias; `reference` is what the plan asks of the own
        slot. A vehicle that flies `alone` is not drawn by the formation.
        """
        ...

    def reset(self) -> None:
        """The vehicle begins to be steered: what was kept from before is of no meaning."""
        ...

    @property
    def fields(self) -> tuple[str, ...]:
        """Names, with units, of the numbers that the law adds to each message; FIELDS_MAX at most, mostly none."""
        ...

    def tell(self) -> tuple[float, ...]:
        """These numbers now, one for each field. A peer's are its `Neighbour.told` (sent as float32)."""
        ...
