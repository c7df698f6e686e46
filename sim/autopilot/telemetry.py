"""What the stand-in PX4 knows of itself: one estimate, in every frame and unit that its messages need."""

import math

from companion.core.frames import Geodetic, Ned
from sim.autopilot.commander import Commander
from sim.autopilot.dynamics import GRAVITY_M_S2, Vehicle
from sim.autopilot.parameters import ParameterTable
from sim.autopilot.setpoint import Setpoint

WGS84_SEMI_MAJOR_M = 6_378_137.0
WGS84_ECCENTRICITY_SQUARED = 6.69437999014e-3


class Projection:
    """Local north/east (m) to WGS84 degrees around one origin, to second order: 1 cm within a kilometre."""

    def __init__(self, origin: Geodetic) -> None:
        self.origin = origin
        latitude = math.radians(origin.latitude_deg)
        sine = math.sin(latitude)
        root = math.sqrt(1.0 - WGS84_ECCENTRICITY_SQUARED * sine * sine)
        across = WGS84_SEMI_MAJOR_M / root
        self._along = WGS84_SEMI_MAJOR_M * (1.0 - WGS84_ECCENTRICITY_SQUARED) / root**3
        self._across = across
        self._cosine = math.cos(latitude)
        self._tangent = math.tan(latitude)

    def to_degrees(self, north_m: float, east_m: float) -> tuple[float, float]:
        """Latitude and longitude of a local position."""
        bend = self._tangent / self._across
        latitude = north_m / self._along - east_m * east_m * bend / (2.0 * self._along)
        longitude = east_m / (self._across * self._cosine) * (1.0 + north_m * bend)
        return (
            self.origin.latitude_deg + math.degrees(latitude),
            self.origin.longitude_deg + math.degrees(longitude),
        )

    def to_local(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """North and east of a point, the inverse of `to_degrees`."""
        latitude = math.radians(latitude_deg - self.origin.latitude_deg)
        longitude = math.radians(longitude_deg - self.origin.longitude_deg)
        bend = self._tangent / self._across
        north = latitude * self._along
        east = longitude * self._across * self._cosine
        for _ in range(3):
            corrected = north + east * east * bend / 2.0
            east = longitude * self._across * self._cosine / (1.0 + corrected * bend)
            north = latitude * self._along
        return north + east * east * bend / 2.0, east


class Telemetry:
    """What the autopilot knows of itself at `time_ns` (since boot); the builders below read it."""

    def __init__(
        self,
        *,
        system_id: int,
        origin: Geodetic,
        vehicle: Vehicle,
        commander: Commander,
        parameters: ParameterTable,
        utc_at_boot_ns: int,
    ) -> None:
        self.system_id = system_id
        self.projection = Projection(origin)
        self.vehicle = vehicle
        self.commander = commander
        self.parameters = parameters
        self.utc_at_boot_ns = utc_at_boot_ns
        self.now_ns = 0
        self.time_ns = 0
        """time of the estimate, ns since boot"""
        self.north_m = self.east_m = self.down_m = 0.0
        self.velocity_north_m_s = self.velocity_east_m_s = self.velocity_down_m_s = 0.0
        self.specific_force_ned_m_s2 = (0.0, 0.0, -GRAVITY_M_S2)
        """acceleration less gravity: what an accelerometer feels"""
        self.roll_rad = self.pitch_rad = self.yaw_rad = 0.0
        self.roll_rate_rad_s = self.pitch_rate_rad_s = self.yaw_rate_rad_s = 0.0
        self.setpoint: Setpoint | None = None
        """what the position controller flies; None: idle"""
        self.home_local_ned_m: Ned | None = None
        self.home_time_ns = 0
        self.battery_fraction = 1.0
        self.battery_forced: float | None = None
        """a battery that is said to be at this fraction, whatever it has given"""
        self.reset_counter = 0
        self.gps_ok = True
        self.gps_lost_for_s = 0.0
        self.ping_sequence = 0

    def count_reset(self) -> None:
        """The estimate jumps: ODOMETRY.reset_counter says so."""
        self.reset_counter = (self.reset_counter + 1) & 0xFF

    def set_home(self, now_ns: int) -> None:
        """Home is where the estimate is."""
        self.home_local_ned_m = Ned(self.north_m, self.east_m, self.down_m)
        self.home_time_ns = now_ns

    def move_origin(self, origin: Geodetic, by_ned_m: Ned) -> None:
        """The local frame's origin has moved by `by_ned_m`: what is local moves the other way."""
        self.projection = Projection(origin)
        self.north_m -= by_ned_m.north
        self.east_m -= by_ned_m.east
        self.down_m -= by_ned_m.down
        home = self.home_local_ned_m
        if home is not None:
            self.home_local_ned_m = Ned(
                home.north - by_ned_m.north, home.east - by_ned_m.east, home.down - by_ned_m.down
            )

    # One estimate in every frame

    @property
    def boot_ms(self) -> int:
        """Time of the estimate, ms since boot."""
        return self.time_ns // 1_000_000

    @property
    def altitude_amsl_m(self) -> float:
        """Altitude of the estimate."""
        return self.projection.origin.altitude_amsl_m - self.down_m

    @property
    def height_m(self) -> float:
        """What the range finder measures."""
        return max(self.vehicle.ground_down_m - self.vehicle.down_m, 0.0)

    def degrees_e7(self, north_m: float, east_m: float) -> tuple[int, int]:
        """A local position as MAVLink's integers."""
        latitude, longitude = self.projection.to_degrees(north_m, east_m)
        return round(latitude * 1e7), round(longitude * 1e7)

    def quaternion(self) -> list[float]:
        """Attitude, body to NED, w x y z."""
        return quaternion(self.roll_rad, self.pitch_rad, self.yaw_rad)

    def thrust_fraction(self) -> float:
        """Collective thrust, 0 to 1, MPC_THR_HOVER hovers."""
        if not self.commander.motors_run:
            return 0.001 if self.commander.armed else 0.0
        lift = (GRAVITY_M_S2 - self.vehicle.thrust_down_m_s2) / GRAVITY_M_S2
        return min(max(lift * self.parameters.number("MPC_THR_HOVER"), 0.12), 1.0)


def quaternion(roll_rad: float, pitch_rad: float, yaw_rad: float) -> list[float]:
    """Quaternion (w, x, y, z) of roll, pitch, yaw (intrinsic ZYX)."""
    cr, sr = math.cos(roll_rad / 2), math.sin(roll_rad / 2)
    cp, sp = math.cos(pitch_rad / 2), math.sin(pitch_rad / 2)
    cy, sy = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    return [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]


def to_body(
    ned: tuple[float, float, float], roll_rad: float, pitch_rad: float, yaw_rad: float
) -> tuple[float, float, float]:
    """A NED vector in the body's forward-right-down axes."""
    north, east, down = ned
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    cy, sy = math.cos(yaw_rad), math.sin(yaw_rad)
    return (
        cp * cy * north + cp * sy * east - sp * down,
        (sr * sp * cy - cr * sy) * north + (sr * sp * sy + cr * cy) * east + sr * cp * down,
        (cr * sp * cy + sr * sy) * north + (cr * sp * sy - sr * cy) * east + cr * cp * down,
    )
