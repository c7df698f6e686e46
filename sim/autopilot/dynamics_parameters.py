"""What a vehicle's motion is made with: the constants of its body, and the parameters of PX4's loops. Values only."""

import math
from dataclasses import dataclass
from typing import Literal

from sim.autopilot.disturbances import require


@dataclass(frozen=True, slots=True)
class DynamicsParameters:
    """Physics of one vehicle, and the loop's constants that PX4 does not offer as parameters."""

    model: Literal["px4", "ideal"] = "px4"
    """`px4`: PX4's loops; `ideal`: double integrator for studies"""
    attitude_lag_s: float = 0.15
    """time constant from commanded to flown horizontal acceleration (tilt), s; 0: none"""
    thrust_lag_s: float = 0.07
    """time constant from commanded to flown vertical acceleration (motors), s; 0: none"""
    drag_per_s: float = 0.1
    """linear drag: acceleration -drag·(v - wind), 1/s. PX4's SIH: 1.0 by default"""
    wind_north_m_s: float = 0.0
    """steady, where the air flows to; it moves nothing without drag. PX4's SIH: SIH_WIND_N"""
    wind_east_m_s: float = 0.0
    thrust_max_g: float = 2.0
    """largest thrust per mass, in units of gravity"""
    ideal_velocity_gain_per_s: float = 2.0
    """`ideal` only: acceleration per velocity error, 1/s"""
    ideal_position_gain_per_s: float = 0.5
    """`ideal` only: velocity per position error, 1/s; a quarter of the velocity gain is critically damped"""
    yaw_gain_per_s: float = 2.8
    """yaw rate per yaw error, 1/s (MC_YAW_P)"""
    yaw_rate_max_rad_s: float = 1.05
    """largest yaw rate, rad/s (MPC_YAWRAUTO_MAX, 60 deg/s)"""

    def __post_init__(self) -> None:
        if self.model not in ("px4", "ideal"):
            raise ValueError(f"model must be 'px4' or 'ideal', got {self.model!r}")
        for name in ("attitude_lag_s", "thrust_lag_s", "drag_per_s"):
            require(name, getattr(self, name), 0.0 <= getattr(self, name) < math.inf, ">= 0")
        for name in ("wind_north_m_s", "wind_east_m_s"):
            require(name, getattr(self, name), math.isfinite(getattr(self, name)), "finite")
        for name in (
            "ideal_velocity_gain_per_s",
            "ideal_position_gain_per_s",
            "yaw_gain_per_s",
            "yaw_rate_max_rad_s",
        ):
            require(name, getattr(self, name), 0.0 < getattr(self, name) < math.inf, "> 0")
        require("thrust_max_g", self.thrust_max_g, 1.0 < self.thrust_max_g < math.inf, "> 1")


@dataclass(slots=True)
class LoopGains:
    """PX4's controller parameters (MPC_*); mutable, since PARAM_SET acts on them in flight."""

    position_horizontal_per_s: float = 0.95
    position_vertical_per_s: float = 1.0
    velocity_horizontal_p: float = 1.8
    velocity_horizontal_i: float = 0.4
    velocity_horizontal_d: float = 0.2
    velocity_vertical_p: float = 4.0
    velocity_vertical_i: float = 2.0
    velocity_vertical_d: float = 0.0
    speed_max_horizontal_m_s: float = 12.0
    speed_max_up_m_s: float = 3.0
    speed_max_down_m_s: float = 1.5
    tilt_max_rad: float = math.radians(45.0)
