"""What a controller is asked to reach. Values only."""

import math
from math import isnan
from typing import NamedTuple

NAN = math.nan


class Setpoint(NamedTuple):
    """What a controller is asked to reach, in the frame of its own position; NaN: this axis is not controlled by it."""

    north_m: float = NAN
    east_m: float = NAN
    down_m: float = NAN
    velocity_north_m_s: float = NAN
    velocity_east_m_s: float = NAN
    velocity_down_m_s: float = NAN
    acceleration_north_m_s2: float = NAN
    acceleration_east_m_s2: float = NAN
    acceleration_down_m_s2: float = NAN
    yaw_rad: float = NAN
    yaw_rate_rad_s: float = NAN

    def is_flyable(self) -> bool:
        """PX4's own check: every axis is controlled by something, and north and east are given in pairs."""
        north, east, down, v_north, v_east, v_down, a_north, a_east, a_down = (not isnan(x) for x in self[:9])
        if north is not east or v_north is not v_east or a_north is not a_east:
            return False
        return (north or v_north or a_north) and (down or v_down or a_down)


HOLD_STILL = Setpoint(velocity_north_m_s=0.0, velocity_east_m_s=0.0, velocity_down_m_s=0.0)
"""zero velocity on every axis: what PX4 flies when a set-point cannot be flown"""
