"""When a vehicle tells its peers: a trigger says when they can no longer predict it.

    error      |e_p|^2 + gamma |e_v|^2 >= epsilon^2 + min(kappa |residual|, 0.1 m)^2
    switching  |e_p|^2 + gamma |e_v|^2 >= delta_i(t), Eq. (5) of the paper
    periodic   every period
    near       at a fixed rate while somebody is near, on top of each of the others

with e = own state - what the peers predict. Besides, nobody is silent for longer than T_max, and what an error fires is
never closer than t_min to the message before.

Each kind is a class that says when it fires and how far, while nothing is lost, a vehicle may be from what its peers
predict: the safety radius is made from that, so no kind can be flown without saying it. A vehicle holds one, made by
the table of its kind (`config.trigger_tables`).
"""

from typing import NamedTuple, Protocol

from companion.core.monitor import PeerMotion


class Situation(NamedTuple):
    """What a trigger decides upon."""

    error_position_2: float
    """squared distance of the own position from what the peers predict (m^2)"""
    error_velocity_2: float
    """the same of the velocity (m^2/s^2)"""
    mean_residual_2: float
    """squared mean residual of the formation (m^2)"""
    formation_s: float
    """time since the vehicle flies in formation"""
    time_ns: int
    """own clock; each vehicle's is shifted by its own part of a second, so that periods do not end together"""
    sent_ns: int
    """when the last message was sent, by the same clock"""
    told: tuple[float, ...] = ()
    """the law's own numbers (`Law.fields`) as the peers take them to be by the last message"""
    tells: tuple[float, ...] = ()
    """the same as they would be sent now"""
    error_common_2: float = 0.0
    """squared error of what the peers take for the own estimate of the common velocity, where no motion is shared
    (m^2/s^2)"""
    error_told_m: float = 0.0
    """how far off the peers are by the law's own numbers alone (`Hold.told_error_m`)"""


class Trigger(Protocol):
    """When to tell the peers, and what they may be wrong by meanwhile."""

    def fires(self, now: Situation) -> bool:
        """Whether a message is wanted, t_min aside."""
        ...

    def error_bound_m(self, motion: PeerMotion) -> float:
        """Bound on the peers' prediction error while nothing is lost (m)."""
        ...

    @property
    def waits(self) -> bool:
        """Whether t_min holds a message back: a period is its own bound, and would drift by it."""
        ...

    @property
    def cause(self) -> str:
        """The keys of fleet.toml that the bound comes from, with their values, for messages."""
        ...
