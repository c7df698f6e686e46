"""What is true of a stub's vehicle. Values only."""

from typing import NamedTuple

from companion.core.frames import Ned


class TruthState(NamedTuple):
    """What is true of the vehicle, whatever its estimator says."""

    time_ns: int
    """host's monotonic time of this state, on the grid, ns"""
    position_ned_m: Ned
    """fleet frame"""
    velocity_ned_m_s: Ned
    acceleration_ned_m_s2: Ned
    yaw_rad: float
    armed: bool
    custom_mode: int
    landed_state: int
    setpoint_gap_max_s: float
    """longest time without a valid set-point while OFFBOARD flew"""
    setpoint_count: int
    """valid offboard set-points since boot"""
    setpoint_last_ns: int | None
    """host's monotonic time of the last one"""


def plus(a: Ned, b: Ned) -> Ned:
    """Sum of two vectors of one frame."""
    return Ned(a.north + b.north, a.east + b.east, a.down + b.down)


def minus(a: Ned, b: Ned) -> Ned:
    """Difference of two vectors of one frame."""
    return Ned(a.north - b.north, a.east - b.east, a.down - b.down)
