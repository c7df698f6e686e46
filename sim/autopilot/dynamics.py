"""Point-mass dynamics of a multicopter under PX4's position controller. Pure.

All vectors are north-east-down, in metres, m/s and m/s². Time advances only by the `dt_s` a caller passes; whoever
needs reproducible runs passes the same grid.

Two models share one body:

* `px4`: PX4's multicopter position controller (PositionControl.cpp) as measured on PX4 1.16:
      v_sp = v_ff + K_p (p_sp - p)                    each axis on its own; a NaN term has no influence
      a_sp = a_ff + P (v_sp - v) + ∫ I (v_sp - v) - D v'   without a velocity set-point: a_ff alone, nothing feeds back
  with its limits, its tilt limit and its anti-windup, behind first-order lags of attitude and thrust.
* `ideal`: a double integrator with an optional lag, for studies: an acceleration set-point is flown exactly, velocity
  and position through proportional loops without an integrator.
"""

import math
from math import cos, hypot, isnan, remainder, sin, tan

from sim.autopilot.dynamics_parameters import DynamicsParameters, LoopGains
from sim.autopilot.setpoint import NAN, Setpoint

GRAVITY_M_S2 = 9.80665
"""standard gravity, CONSTANTS_ONE_G of PX4"""
THRUST_MIN_G = 0.24
"""least thrust per mass in flight, in units of gravity (MPC_THR_MIN 0.12 with MPC_THR_HOVER 0.5)"""
LANDED_THRUST_LOSS = 0.68
"""share of the weight no longer carried at which the land detector calls the thrust low: MPC_THR_MIN plus a tenth of
the way to hover"""


def constrain_horizontal(
    first_north: float, first_east: float, second_north: float, second_east: float, limit: float
) -> tuple[float, float]:
    """Sum of two vectors, no longer than `limit`, keeping the first at the second's cost (ControlMath::constrainXY)."""
    if limit <= 0.0:
        return 0.0, 0.0
    north = first_north + second_north
    east = first_east + second_east
    if north * north + east * east <= limit * limit:
        return north, east
    first_length = math.hypot(first_north, first_east)
    if first_length >= limit or math.hypot(second_north - first_north, second_east - first_east) < 0.001:
        return first_north / first_length * limit, first_east / first_length * limit
    second_length = math.hypot(second_north, second_east)
    unit_north = second_north / second_length
    unit_east = second_east / second_length
    along = unit_north * first_north + unit_east * first_east
    room = first_length * first_length - limit * limit
    scale = -along + math.sqrt(along * along - room)
    return first_north + unit_north * scale, first_east + unit_east * scale


class Vehicle:
    """One multicopter's true motion. Mutable; the frame's origin is the caller's, `ground_down_m` is the floor in it.

    The controller works on an estimate: true position plus `position_error_*_m`, true velocity plus
    `velocity_error_*_m_s`, set by the caller before each step, and set-points are in the frame of that estimate.
    """

    __slots__ = (
        "_integral_down",
        "_integral_east",
        "_integral_north",
        "_slope_down",
        "_slope_east",
        "_slope_north",
        "acceleration_down_m_s2",
        "acceleration_east_m_s2",
        "acceleration_north_m_s2",
        "command_down_m_s2",
        "command_east_m_s2",
        "command_north_m_s2",
        "command_velocity_down_m_s",
        "command_velocity_east_m_s",
        "command_velocity_north_m_s",
        "down_m",
        "east_m",
        "gains",
        "ground_down_m",
        "north_m",
        "on_ground",
        "parameters",
        "position_error_down_m",
        "position_error_east_m",
        "position_error_north_m",
        "thrust_down_m_s2",
        "thrust_east_m_s2",
        "thrust_min_g",
        "thrust_north_m_s2",
        "velocity_down_m_s",
        "velocity_east_m_s",
        "velocity_error_down_m_s",
        "velocity_error_east_m_s",
        "velocity_error_north_m_s",
        "velocity_north_m_s",
        "yaw_rad",
        "yaw_rate_rad_s",
    )

    DERIVATIVE_FILTER_S = 1.0 / (math.tau * 5.0)
    """time constant of the filter on the velocity's derivative, s (MPC_VELD_LP, 5 Hz)"""

    def __init__(
        self,
        north_m: float,
        east_m: float,
        down_m: float,
        parameters: DynamicsParameters,
        gains: LoopGains | None = None,
        yaw_rad: float = 0.0,
    ) -> None:
        self.parameters = parameters
        self.gains = gains if gains is not None else LoopGains()
        self.north_m, self.east_m, self.down_m = north_m, east_m, down_m
        self.ground_down_m = down_m
        self.on_ground = True
        self.thrust_min_g = THRUST_MIN_G
        self.yaw_rad = yaw_rad
        self.yaw_rate_rad_s = 0.0
        self.velocity_north_m_s = self.velocity_east_m_s = self.velocity_down_m_s = 0.0
        self.acceleration_north_m_s2 = self.acceleration_east_m_s2 = self.acceleration_down_m_s2 = 0.0
        self.command_north_m_s2 = self.command_east_m_s2 = self.command_down_m_s2 = 0.0
        self.command_velocity_north_m_s = self.command_velocity_east_m_s = self.command_velocity_down_m_s = NAN
        self.thrust_north_m_s2 = self.thrust_east_m_s2 = 0.0
        self.thrust_down_m_s2 = GRAVITY_M_S2
        self.position_error_north_m = self.position_error_east_m = self.position_error_down_m = 0.0
        self.velocity_error_north_m_s = self.velocity_error_east_m_s = self.velocity_error_down_m_s = 0.0
        self._slope_north = self._slope_east = self._slope_down = 0.0
        self._integral_north = self._integral_east = self._integral_down = 0.0

    def control(self, setpoint: Setpoint, dt_s: float) -> None:
        """Turns a set-point into the commanded acceleration (before lag, drag and gust)."""
        if self.parameters.model == "px4":
            self._control_px4(setpoint, dt_s)
        else:
            self._control_ideal(setpoint)
        self._turn(setpoint.yaw_rad, setpoint.yaw_rate_rad_s, dt_s)

    def idle(self) -> None:
        """Motors at their lowest or stopped: falls when in the air, and the loops start afresh."""
        self.command_north_m_s2 = self.command_east_m_s2 = 0.0
        self.command_down_m_s2 = GRAVITY_M_S2
        self.command_velocity_north_m_s = self.command_velocity_east_m_s = self.command_velocity_down_m_s = NAN
        self.yaw_rate_rad_s = 0.0
        self.reset_integrals()

    def reset_integrals(self) -> None:
        """Forgets what the velocity loop has learned."""
        self._integral_north = self._integral_east = self._integral_down = 0.0

    def learn(self, north_m_s2: float, east_m_s2: float, down_m_s2: float) -> None:
        """Sets what the velocity loop's integrators hold, as after a long steady flight."""
        self._integral_north, self._integral_east, self._integral_down = north_m_s2, east_m_s2, down_m_s2

    def _velocity_setpoint(
        self, setpoint: Setpoint, gain_horizontal: float, gain_vertical: float
    ) -> tuple[float, float, float]:
        """Velocity asked for by the position loop and the feed-forward together, limited; NaN: none."""
        gains = self.gains
        north_m, east_m, down_m, north, east, down, _, _, _, _, _ = setpoint
        from_north = gain_horizontal * (north_m - self.north_m - self.position_error_north_m)
        from_east = gain_horizontal * (east_m - self.east_m - self.position_error_east_m)
        from_down = gain_vertical * (down_m - self.down_m - self.position_error_down_m)
        if not isnan(from_north):
            north = from_north if isnan(north) else north + from_north
        else:
            from_north = 0.0
        if not isnan(from_east):
            east = from_east if isnan(east) else east + from_east
        else:
            from_east = 0.0
        if not isnan(from_down):
            down = from_down if isnan(down) else down + from_down
        limit = gains.speed_max_horizontal_m_s
        if north * north + east * east > limit * limit:
            north, east = constrain_horizontal(from_north, from_east, north - from_north, east - from_east, limit)
        if down > gains.speed_max_down_m_s:
            down = gains.speed_max_down_m_s
        elif down < -gains.speed_max_up_m_s:
            down = -gains.speed_max_up_m_s
        self.command_velocity_north_m_s = north
        self.command_velocity_east_m_s = east
        self.command_velocity_down_m_s = down
        return north, east, down

    def _control_px4(self, setpoint: Setpoint, dt_s: float) -> None:
        gains = self.gains
        north, east, down = self._velocity_setpoint(
            setpoint, gains.position_horizontal_per_s, gains.position_vertical_per_s
        )
        error_north = north - self.velocity_north_m_s - self.velocity_error_north_m_s
        error_east = east - self.velocity_east_m_s - self.velocity_error_east_m_s
        error_down = down - self.velocity_down_m_s - self.velocity_error_down_m_s
        p, d = gains.velocity_horizontal_p, gains.velocity_horizontal_d
        _, _, _, _, _, _, a_north, a_east, a_down, _, _ = setpoint
        if not isnan(error_north):
            feedback = error_north * p + self._integral_north - self._slope_north * d
            a_north = feedback if isnan(a_north) else a_north + feedback
        else:
            error_north = 0.0
        if not isnan(error_east):
            feedback = error_east * p + self._integral_east - self._slope_east * d
            a_east = feedback if isnan(a_east) else a_east + feedback
        else:
            error_east = 0.0
        if not isnan(error_down):
            feedback = (
                error_down * gains.velocity_vertical_p
                + self._integral_down
                - self._slope_down * gains.velocity_vertical_d
            )
            a_down = feedback if isnan(a_down) else a_down + feedback
        else:
            error_down = 0.0
        # Tilt: horizontal force comes from tilting a thrust that carries the weight.
        limit = GRAVITY_M_S2 * tan(gains.tilt_max_rad)
        wanted = hypot(a_north, a_east)
        if wanted > limit:
            scale = limit / wanted
            # Anti-windup by tracking what saturation leaves (Rundqwist), as PX4 does.
            tracking = 2.0 / p if p > 0.0 else 0.0
            error_north -= tracking * (a_north - a_north * scale)
            error_east -= tracking * (a_east - a_east * scale)
            a_north *= scale
            a_east *= scale
        most_up = GRAVITY_M_S2 * (1.0 - self.parameters.thrust_max_g)
        most_down = GRAVITY_M_S2 * (1.0 - self.thrust_min_g)
        if a_down < most_up:
            a_down = most_up
            error_down = max(error_down, 0.0)
        elif a_down > most_down:
            a_down = most_down
            error_down = min(error_down, 0.0)
        gain = gains.velocity_horizontal_i
        self._integral_north += error_north * gain * dt_s
        self._integral_east += error_east * gain * dt_s
        integral_down = self._integral_down + error_down * gains.velocity_vertical_i * dt_s
        if not -GRAVITY_M_S2 <= integral_down <= GRAVITY_M_S2:
            integral_down = min(max(integral_down, -GRAVITY_M_S2), GRAVITY_M_S2)
        self._integral_down = integral_down
        self.command_north_m_s2 = a_north
        self.command_east_m_s2 = a_east
        self.command_down_m_s2 = a_down

    def _control_ideal(self, setpoint: Setpoint) -> None:
        gain = self.parameters.ideal_velocity_gain_per_s
        position_gain = self.parameters.ideal_position_gain_per_s
        north, east, down = self._velocity_setpoint(setpoint, position_gain, position_gain)
        commands = []
        for target, velocity, feed_forward in (
            (north, self.velocity_north_m_s + self.velocity_error_north_m_s, setpoint.acceleration_north_m_s2),
            (east, self.velocity_east_m_s + self.velocity_error_east_m_s, setpoint.acceleration_east_m_s2),
            (down, self.velocity_down_m_s + self.velocity_error_down_m_s, setpoint.acceleration_down_m_s2),
        ):
            a = 0.0 if isnan(feed_forward) else feed_forward
            if not isnan(target):
                a += gain * (target - velocity)
            commands.append(a)
        self.command_north_m_s2, self.command_east_m_s2, self.command_down_m_s2 = commands

    def _turn(self, yaw_rad: float, yaw_rate_rad_s: float, dt_s: float) -> None:
        parameters = self.parameters
        limit = parameters.yaw_rate_max_rad_s
        rate = 0.0 if isnan(yaw_rate_rad_s) else yaw_rate_rad_s
        if not isnan(yaw_rad):
            rate += parameters.yaw_gain_per_s * remainder(yaw_rad - self.yaw_rad, math.tau)
        if not -limit <= rate <= limit:
            rate = min(max(rate, -limit), limit)
        self.yaw_rate_rad_s = rate
        if rate != 0.0:
            self.yaw_rad = remainder(self.yaw_rad + rate * dt_s, math.tau)

    def move(self, gust_north_m_s2: float, gust_east_m_s2: float, gust_down_m_s2: float, dt_s: float) -> None:
        """Integrates the motion over one step: lag, drag, gust, ground."""
        parameters = self.parameters
        blend = dt_s / (parameters.attitude_lag_s + dt_s)
        north, east, down = self.thrust_north_m_s2, self.thrust_east_m_s2, self.thrust_down_m_s2
        self.thrust_north_m_s2 = north = north + (self.command_north_m_s2 - north) * blend
        self.thrust_east_m_s2 = east = east + (self.command_east_m_s2 - east) * blend
        blend = dt_s / (parameters.thrust_lag_s + dt_s)
        self.thrust_down_m_s2 = down = down + (self.command_down_m_s2 - down) * blend
        if self.on_ground:
            if down >= -0.05:
                self._rest()
                return
            self.on_ground = False
        drag = parameters.drag_per_s
        # Less thrust than weight also means less horizontal force at the same tilt.
        loading = 1.0 if parameters.model == "ideal" else (GRAVITY_M_S2 - down) / GRAVITY_M_S2
        v_north, v_east, v_down = self.velocity_north_m_s, self.velocity_east_m_s, self.velocity_down_m_s
        a_north = north * loading - drag * (v_north - parameters.wind_north_m_s) + gust_north_m_s2
        a_east = east * loading - drag * (v_east - parameters.wind_east_m_s) + gust_east_m_s2
        a_down = down - drag * v_down + gust_down_m_s2
        smooth = dt_s / (self.DERIVATIVE_FILTER_S + dt_s)
        self._slope_north += (a_north - self._slope_north) * smooth
        self._slope_east += (a_east - self._slope_east) * smooth
        self._slope_down += (a_down - self._slope_down) * smooth
        # Exact for an acceleration that is constant over the step.
        half = 0.5 * dt_s
        self.north_m += (v_north + half * a_north) * dt_s
        self.east_m += (v_east + half * a_east) * dt_s
        self.down_m += (v_down + half * a_down) * dt_s
        self.velocity_north_m_s = v_north + a_north * dt_s
        self.velocity_east_m_s = v_east + a_east * dt_s
        self.velocity_down_m_s = v_down + a_down * dt_s
        self.acceleration_north_m_s2 = a_north
        self.acceleration_east_m_s2 = a_east
        self.acceleration_down_m_s2 = a_down
        if self.down_m >= self.ground_down_m and self.velocity_down_m_s >= 0.0:
            self.down_m = self.ground_down_m
            self.on_ground = True
            self._rest()

    def _rest(self) -> None:
        self.velocity_north_m_s = self.velocity_east_m_s = self.velocity_down_m_s = 0.0
        self.acceleration_north_m_s2 = self.acceleration_east_m_s2 = self.acceleration_down_m_s2 = 0.0
        self._slope_north = self._slope_east = self._slope_down = 0.0

    def shift(self, north_m: float, east_m: float, down_m: float) -> None:
        """The frame has moved: the vehicle and the ground have other numbers, nothing else."""
        self.north_m += north_m
        self.east_m += east_m
        self.down_m += down_m
        self.ground_down_m += down_m

    def presses_down(self) -> bool:
        """On the ground with hardly any thrust left: what PX4's land detector takes for a landing."""
        if not self.on_ground:
            return False
        if self.parameters.model == "ideal":
            return not self.command_velocity_down_m_s <= 0.05
        return self.command_down_m_s2 > LANDED_THRUST_LOSS * GRAVITY_M_S2

    def attitude_rad(self) -> tuple[float, float, float]:
        """Roll, pitch and yaw of the thrust that is flown."""
        # Before the vertical thrust's loading the tilt is that of (a, g), see `move`.
        cos_yaw, sin_yaw = cos(self.yaw_rad), sin(self.yaw_rad)
        forward = cos_yaw * self.thrust_north_m_s2 + sin_yaw * self.thrust_east_m_s2
        right = -sin_yaw * self.thrust_north_m_s2 + cos_yaw * self.thrust_east_m_s2
        pitch = -math.atan2(forward, GRAVITY_M_S2)
        roll = math.atan2(right * cos(pitch), GRAVITY_M_S2)
        return roll, pitch, self.yaw_rad
