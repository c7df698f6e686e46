"""The stand-in's estimator: true state plus errors, published on PX4's grid of 8 ms. Sans-I/O."""

import math
import random

from sim.autopilot.disturbances import NoiseParameters, OrnsteinUhlenbeck, normals
from sim.autopilot.dynamics import GRAVITY_M_S2, Vehicle
from sim.autopilot.telemetry import Telemetry

NO_AID_TIMEOUT_NS = 5_000_000_000
"""the position is invalid this long after the last fix (EKF2_NOAID_TOUT)"""
STEP_HEIGHT_M = 1.5
"""height at which the recorded estimate stepped in its climb"""
STEP_SIGMA_M = 0.03
"""by about this much"""


class Estimator:
    """Errors of one vehicle's estimate, and what becomes of them when something breaks.

    The loops fly by the estimate without its white velocity noise; what is reported has it.
    """

    def __init__(
        self, noise: NoiseParameters, vehicle: Vehicle, telemetry: Telemetry, step_s: float, seed: str
    ) -> None:
        self._noise = noise
        self._vehicle = vehicle
        self._telemetry = telemetry
        self._step_s = step_s
        self._white = normals(random.Random(f"{seed}/velocity")).__next__
        self._faulty = random.Random(f"{seed}/faults")
        self._faulty_normal = normals(self._faulty)
        self._position = OrnsteinUhlenbeck(
            noise.position_sigma_m, noise.position_time_constant_s, step_s, normals(random.Random(f"{seed}/position"))
        )
        self._bias = OrnsteinUhlenbeck(
            noise.velocity_bias_sigma_m_s,
            noise.velocity_bias_time_constant_s,
            step_s,
            normals(random.Random(f"{seed}/bias")),
        )
        self._extra_position: OrnsteinUhlenbeck | None = None
        self._velocity_sigma = noise.velocity_sigma_m_s
        """of the white noise that is reported (m/s)"""
        self._drift_velocity: tuple[float, float] | None = None
        self._drift = (0.0, 0.0)
        self._gps_lost_ns: int | None = None
        self._frozen = False
        self._step_down = 0.0
        self._climb_seen = False

    # Faults

    def lose_gps(self, drift_m_s: float, now_ns: int) -> None:
        """No fix from now on: dead reckoning drifts in some horizontal direction."""
        angle = self._faulty.uniform(0.0, math.tau)
        self._drift_velocity = (drift_m_s * math.cos(angle), drift_m_s * math.sin(angle))
        self._gps_lost_ns = now_ns
        self._telemetry.gps_ok = False

    def regain_gps(self) -> None:
        """A fix again: the estimate jumps back and says so."""
        if self._gps_lost_ns is None:
            return
        self._gps_lost_ns = None
        self._drift_velocity = None
        self._drift = (0.0, 0.0)
        self._telemetry.gps_ok = True
        self._telemetry.gps_lost_for_s = 0.0
        self._telemetry.commander.position_valid = True
        self._telemetry.count_reset()

    def freeze(self, frozen: bool) -> None:
        """Reported positions stand still; the loops go on with the real ones."""
        self._frozen = frozen

    def add_noise(self, sigma: float) -> None:
        """More error on top: sigma m of position (correlated) and sigma m/s of velocity (white); 0 ends it."""
        self._velocity_sigma = math.hypot(self._noise.velocity_sigma_m_s, sigma)
        self._extra_position = None
        if sigma > 0.0:
            self._extra_position = OrnsteinUhlenbeck(
                sigma, self._noise.position_time_constant_s, self._step_s, self._faulty_normal
            )

    # One step

    def step(self, now_ns: int) -> None:
        """Publishes the estimate of now."""
        self._position.step()
        self._bias.step()
        position, bias = self._position, self._bias
        error_north, error_east, error_down = position.north, position.east, position.down
        bias_north, bias_east, bias_down = bias.north, bias.east, bias.down
        if self._extra_position is not None:
            self._extra_position.step()
            error_north += self._extra_position.north
            error_east += self._extra_position.east
            error_down += self._extra_position.down
        if self._drift_velocity is not None and self._gps_lost_ns is not None:
            drift_north, drift_east = self._drift_velocity
            self._drift = (self._drift[0] + drift_north * self._step_s, self._drift[1] + drift_east * self._step_s)
            bias_north += drift_north
            bias_east += drift_east
            lost_ns = now_ns - self._gps_lost_ns
            self._telemetry.gps_lost_for_s = lost_ns / 1e9
            if lost_ns >= NO_AID_TIMEOUT_NS:
                self._telemetry.commander.position_valid = False
        error_north += self._drift[0]
        error_east += self._drift[1]
        self._step_in_climb()
        error_down += self._step_down
        vehicle = self._vehicle
        vehicle.position_error_north_m = error_north
        vehicle.position_error_east_m = error_east
        vehicle.position_error_down_m = error_down
        vehicle.velocity_error_north_m_s = bias_north
        vehicle.velocity_error_east_m_s = bias_east
        vehicle.velocity_error_down_m_s = bias_down
        self._publish(now_ns)

    def _step_in_climb(self) -> None:
        """PX4's altitude estimate steps by some centimetres in a normal climb, and the reset counter with it."""
        if not self._telemetry.commander.armed:
            self._climb_seen = False
        elif not self._climb_seen and self._telemetry.height_m > STEP_HEIGHT_M:
            self._climb_seen = True
            if self._noise.position_sigma_m > 0.0:
                self._step_down = next(self._faulty_normal) * STEP_SIGMA_M
                self._telemetry.count_reset()

    def _publish(self, now_ns: int) -> None:
        vehicle, telemetry = self._vehicle, self._telemetry
        telemetry.time_ns = now_ns
        if not self._frozen:
            telemetry.north_m = vehicle.north_m + vehicle.position_error_north_m
            telemetry.east_m = vehicle.east_m + vehicle.position_error_east_m
            telemetry.down_m = vehicle.down_m + vehicle.position_error_down_m
        north = vehicle.velocity_north_m_s + vehicle.velocity_error_north_m_s
        east = vehicle.velocity_east_m_s + vehicle.velocity_error_east_m_s
        down = vehicle.velocity_down_m_s + vehicle.velocity_error_down_m_s
        sigma = self._velocity_sigma
        if sigma > 0.0:
            white = self._white
            north += white() * sigma
            east += white() * sigma
            down += white() * sigma
        telemetry.velocity_north_m_s = north
        telemetry.velocity_east_m_s = east
        telemetry.velocity_down_m_s = down
        telemetry.specific_force_ned_m_s2 = (
            vehicle.acceleration_north_m_s2,
            vehicle.acceleration_east_m_s2,
            vehicle.acceleration_down_m_s2 - GRAVITY_M_S2,
        )
        roll, pitch, yaw = vehicle.attitude_rad()
        per_s = 1.0 / self._step_s
        telemetry.roll_rate_rad_s = (roll - telemetry.roll_rad) * per_s
        telemetry.pitch_rate_rad_s = (pitch - telemetry.pitch_rad) * per_s
        telemetry.yaw_rate_rad_s = vehicle.yaw_rate_rad_s
        telemetry.roll_rad, telemetry.pitch_rad, telemetry.yaw_rad = roll, pitch, yaw
