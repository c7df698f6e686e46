"""Set-points of PX4's automatic modes: take-off, hold, reposition, land, return. Sans-I/O, plain floats.

References are smoothed as PX4's are: they start at the vehicle's present motion and obey limits of speed and
acceleration, so that a mode change does not throw the vehicle about.
"""

import math

from sim.autopilot.modes import Mode
from sim.autopilot.parameters import ParameterTable
from sim.autopilot.setpoint import HOLD_STILL, NAN, Setpoint

APPROACH_GAIN_PER_S = 0.9
"""speed per remaining distance of a reference at most, 1/s"""
APPROACH_BRAKING_M_S2 = 0.45
"""deceleration of a vertical reference towards its target, m/s²; with the gain, from the recorded take-off's end"""
CLIMB_ACCELERATION_M_S2 = 0.53
"""how fast a take-off's climb rate builds up, m/s²; recorded"""
VERTICAL_ACCELERATION_M_S2 = 1.4
"""how fast any other vertical speed changes, m/s²; from the recorded landing"""


class Navigator:
    """The reference an automatic mode flies. All positions in the autopilot's local frame (its own estimate)."""

    def __init__(self, parameters: ParameterTable) -> None:
        self._parameters = parameters
        self._north = self._east = self._down = 0.0
        self._velocity_north = self._velocity_east = self._velocity_down = 0.0
        self._target: tuple[float, float] | None = None
        self._target_down = NAN
        self._takeoff_down = self._takeoff_yaw = NAN
        self._yaw = NAN
        self._home = (0.0, 0.0, 0.0)
        self._returning_above = False
        self._lifted = False
        self.takeoff_done = False
        """the last take-off has come within NAV_MC_ALT_RAD of its altitude"""

    def enter(
        self,
        mode: Mode,
        position: tuple[float, float, float],
        velocity: tuple[float, float, float],
        *,
        keep_altitude: bool,
    ) -> None:
        """Starts a mode at the vehicle's present estimate; `keep_altitude`: of the target before, after take-off."""
        self._north, self._east, down = position
        self._velocity_north, self._velocity_east, self._velocity_down = velocity
        self._target = None
        self._yaw = NAN
        self._down = down
        self._returning_above = False
        if mode is Mode.TAKEOFF:
            self._target = (self._north, self._east)
            self._velocity_north = self._velocity_east = 0.0
            self._lifted = False
            self.takeoff_done = False
            self._target_down = self._takeoff_down
            self._yaw = self._takeoff_yaw
            self._takeoff_down = self._takeoff_yaw = NAN
            if math.isnan(self._target_down):
                self._target_down = down - self._parameters.number("MIS_TAKEOFF_ALT")
        elif not keep_altitude:
            self._target_down = NAN

    def take_off_to(self, down_m: float, yaw_rad: float) -> None:
        """Down (NaN: MIS_TAKEOFF_ALT above here) and heading (NaN: as it is) of the next take-off."""
        self._takeoff_down = down_m
        self._takeoff_yaw = yaw_rad

    def go_to(self, north_m: float, east_m: float, down_m: float, yaw_rad: float) -> None:
        """Repositions the hold; NaN keeps what is."""
        if not (math.isnan(north_m) or math.isnan(east_m)):
            self._target = (north_m, east_m)
        if not math.isnan(down_m):
            self._target_down = down_m
        self._yaw = yaw_rad

    def shift(self, north_m: float, east_m: float, down_m: float) -> None:
        """The local frame has moved: everything local moves with it."""
        self._north += north_m
        self._east += east_m
        self._down += down_m
        self._target_down += down_m
        if self._target is not None:
            self._target = (self._target[0] + north_m, self._target[1] + east_m)
        home_north, home_east, home_down = self._home
        self._home = (home_north + north_m, home_east + east_m, home_down + down_m)

    def set_home(self, north_m: float, east_m: float, down_m: float) -> None:
        """Where RTL goes."""
        self._home = (north_m, east_m, down_m)

    def setpoint(
        self, mode: Mode, down_m: float, height_m: float, dt_s: float, *, lifted: bool, may_climb: bool
    ) -> Setpoint:
        """Advances the reference by one step.

        `down_m`: estimate; `height_m`: range finder; `lifted`: off the ground; `may_climb`: the take-off ramp lets it.
        """
        parameters = self._parameters
        if mode is Mode.TAKEOFF:
            return self._setpoint_takeoff(down_m, dt_s, lifted=lifted, may_climb=may_climb)
        if mode.is_landing:
            return self._setpoint_land(height_m, dt_s)
        if mode is Mode.RTL:
            return self._setpoint_return(down_m, height_m, dt_s)
        if mode.is_manual:
            # Nobody at the sticks: measured, it sinks. (The caller holds still for a pilot's centred sticks.)
            self._brake_horizontally(dt_s)
            self._sink(parameters.number("MPC_LAND_SPEED"), dt_s)
            return Setpoint(
                down_m=self._down,
                velocity_north_m_s=self._velocity_north,
                velocity_east_m_s=self._velocity_east,
                velocity_down_m_s=self._velocity_down,
            )
        if mode.is_auto:
            self._glide_horizontally(dt_s)
            self._glide_vertically(parameters.number("MPC_Z_VEL_MAX_UP"), dt_s)
            return self._held()
        return HOLD_STILL

    def _held(self) -> Setpoint:
        return Setpoint(
            self._north,
            self._east,
            self._down,
            self._velocity_north,
            self._velocity_east,
            self._velocity_down,
            yaw_rad=self._yaw,
        )

    def _setpoint_takeoff(self, down_m: float, dt_s: float, *, lifted: bool, may_climb: bool) -> Setpoint:
        parameters = self._parameters
        speed = parameters.number("MPC_TKO_SPEED")
        self._lifted = self._lifted or lifted
        self._glide_horizontally(dt_s)
        if self._lifted:
            self._glide_vertically(speed, dt_s, CLIMB_ACCELERATION_M_S2)
        else:
            # On the ground the reference gathers speed but stays with the vehicle.
            self._down = down_m
            self._velocity_down = (
                -min(CLIMB_ACCELERATION_M_S2 * dt_s - self._velocity_down, speed) if may_climb else 0.0
            )
        if abs(down_m - self._target_down) <= parameters.number("NAV_MC_ALT_RAD"):
            self.takeoff_done = True
        return self._held()

    def _setpoint_land(self, height_m: float, dt_s: float) -> Setpoint:
        parameters = self._parameters
        self._glide_horizontally(dt_s)
        near = height_m < parameters.number("MPC_LAND_ALT3")
        self._sink(parameters.number("MPC_LAND_CRWL" if near else "MPC_LAND_SPEED"), dt_s)
        # The reference goes on into the ground, so that the thrust fades and the landing is noticed.
        return self._held()

    def _setpoint_return(self, down_m: float, height_m: float, dt_s: float) -> Setpoint:
        parameters = self._parameters
        home_north, home_east, home_down = self._home
        away = math.hypot(self._north - home_north, self._east - home_east)
        return_down = home_down - parameters.number("RTL_RETURN_ALT")
        if away > parameters.number("RTL_MIN_DIST") and not self._returning_above:
            # Climb first, above where it is.
            self._target_down = min(return_down, self._down)
            if down_m > self._target_down + 1.0:
                self._brake_horizontally(dt_s)
                self._glide_vertically(parameters.number("MPC_Z_VEL_MAX_UP"), dt_s)
                return self._held()
            self._returning_above = True
        self._target = (home_north, home_east)
        self._glide_horizontally(dt_s)
        if away > 1.0:
            self._glide_vertically(parameters.number("MPC_Z_VEL_MAX_UP"), dt_s)
            return self._held()
        return self._setpoint_land(height_m, dt_s)

    def _brake_horizontally(self, dt_s: float) -> None:
        speed = math.hypot(self._velocity_north, self._velocity_east)
        less = self._parameters.number("MPC_ACC_HOR") * dt_s
        factor = 0.0 if speed <= less else (speed - less) / speed
        self._velocity_north *= factor
        self._velocity_east *= factor
        self._north += self._velocity_north * dt_s
        self._east += self._velocity_east * dt_s

    def _glide_horizontally(self, dt_s: float) -> None:
        if self._target is None:
            self._brake_horizontally(dt_s)
            return
        away_north = self._target[0] - self._north
        away_east = self._target[1] - self._east
        distance = math.hypot(away_north, away_east)
        acceleration = self._parameters.number("MPC_ACC_HOR")
        wanted_north = wanted_east = 0.0
        if distance > 1e-6:
            speed = min(
                self._parameters.number("MPC_XY_CRUISE"),
                math.sqrt(acceleration * distance),
                APPROACH_GAIN_PER_S * distance,
            )
            wanted_north = away_north / distance * speed
            wanted_east = away_east / distance * speed
        self._velocity_north, self._velocity_east = _towards(
            self._velocity_north, self._velocity_east, wanted_north, wanted_east, acceleration * dt_s
        )
        self._north += self._velocity_north * dt_s
        self._east += self._velocity_east * dt_s

    def _glide_vertically(
        self, speed_max_m_s: float, dt_s: float, speeding_up_m_s2: float = VERTICAL_ACCELERATION_M_S2
    ) -> None:
        if math.isnan(self._target_down):
            wanted = 0.0
        else:
            away = self._target_down - self._down
            speed = min(
                speed_max_m_s if away < 0.0 else self._parameters.number("MPC_Z_VEL_MAX_DN"),
                math.sqrt(2.0 * APPROACH_BRAKING_M_S2 * abs(away)),
                APPROACH_GAIN_PER_S * abs(away),
            )
            wanted = math.copysign(speed, away)
        slower = abs(wanted) < abs(self._velocity_down)
        step = (VERTICAL_ACCELERATION_M_S2 if slower else speeding_up_m_s2) * dt_s
        self._velocity_down += min(max(wanted - self._velocity_down, -step), step)
        self._down += self._velocity_down * dt_s
        if math.isnan(self._target_down) and self._velocity_down == 0.0:
            self._target_down = self._down

    def _sink(self, speed_m_s: float, dt_s: float) -> None:
        step = VERTICAL_ACCELERATION_M_S2 * dt_s
        self._velocity_down += min(max(speed_m_s - self._velocity_down, -step), step)
        self._down += self._velocity_down * dt_s


def _towards(north: float, east: float, wanted_north: float, wanted_east: float, step: float) -> tuple[float, float]:
    """A vector moved towards another by at most `step`."""
    change_north, change_east = wanted_north - north, wanted_east - east
    length = math.hypot(change_north, change_east)
    if length <= step:
        return wanted_north, wanted_east
    return north + change_north / length * step, east + change_east / length * step
