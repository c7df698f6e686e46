"""Frames: WGS84 to the fleet frame, and each autopilot's local NED frame to the fleet frame.

The fleet frame is north-east-down in metres, its origin the fleet origin of fleet.toml (WGS84 latitude and
longitude, AMSL altitude). Every autopilot has a local NED frame of its own, whose origin is where its estimator
happened to start (GPS_GLOBAL_ORIGIN, MAVLink 49). Positions are shifted by the difference of the two origins.
"""

from dataclasses import dataclass, replace
from math import cos, degrees, hypot, radians, sin
from typing import NamedTuple

SEMIMAJOR_M, SEMIMINOR_M = 6378137.0, 6356752.31424518
"""of the WGS84 ellipsoid (NIMA TR8350.2)"""


class Ned(NamedTuple):
    """A vector in a north-east-down frame; metres or metres per second as its name says."""

    north: float
    east: float
    down: float


@dataclass(frozen=True, slots=True)
class Geodetic:
    """A point on the WGS84 ellipsoid."""

    latitude_deg: float
    """degrees north, -90 to 90"""
    longitude_deg: float
    """degrees east, -180 to 180"""
    altitude_amsl_m: float
    """metres above mean sea level; the geoid's undulation is taken as constant over a fleet's area"""


def geodetic_to_ned(point: Geodetic, origin: Geodetic) -> Ned:
    """Position of `point` in the NED frame at `origin` (m).

    North and east are those of the tangent plane at the origin. Down is the difference of the two AMSL altitudes and
    not the tangent plane's, so that two vehicles at one altitude are level however far apart they are.
    """
    latitude, longitude = radians(origin.latitude_deg), radians(origin.longitude_deg)
    x, y, z = (a - b for a, b in zip(_on_the_ellipsoid_m(point), _on_the_ellipsoid_m(origin), strict=True))
    outward = cos(longitude) * x + sin(longitude) * y
    return Ned(
        -sin(latitude) * outward + cos(latitude) * z,
        -sin(longitude) * x + cos(longitude) * y,
        origin.altitude_amsl_m - point.altitude_amsl_m,
    )


def _on_the_ellipsoid_m(point: Geodetic) -> tuple[float, float, float]:
    """Earth-centred, earth-fixed coordinates (m) of the point's foot on the ellipsoid."""
    latitude, longitude = radians(point.latitude_deg), radians(point.longitude_deg)
    prime_vertical = SEMIMAJOR_M**2 / hypot(SEMIMAJOR_M * cos(latitude), SEMIMINOR_M * sin(latitude))
    return (
        prime_vertical * cos(latitude) * cos(longitude),
        prime_vertical * cos(latitude) * sin(longitude),
        prime_vertical * (SEMIMINOR_M / SEMIMAJOR_M) ** 2 * sin(latitude),
    )


def ned_to_geodetic(position_ned_m: Ned, origin: Geodetic) -> Geodetic:
    """Inverse of `geodetic_to_ned`, to a millimetre within some kilometres of the origin and away from the poles.

    What is still missing is added, as degrees by the ellipsoid's two radii of curvature at the origin; each round
    leaves a part in some hundred (at 80 degrees, 5 km away) or less.
    """
    north, east, down = position_ned_m
    latitude = radians(origin.latitude_deg)
    prime_vertical = SEMIMAJOR_M**2 / hypot(SEMIMAJOR_M * cos(latitude), SEMIMINOR_M * sin(latitude))
    meridian = prime_vertical**3 * SEMIMINOR_M**2 / SEMIMAJOR_M**4
    point = Geodetic(origin.latitude_deg, origin.longitude_deg, origin.altitude_amsl_m - down)
    for _ in range(6):
        here = geodetic_to_ned(point, origin)
        point = Geodetic(
            point.latitude_deg + degrees((north - here.north) / meridian),
            point.longitude_deg + degrees((east - here.east) / (prime_vertical * cos(latitude))),
            point.altitude_amsl_m,
        )
    return replace(point, longitude_deg=(point.longitude_deg + 180.0) % 360.0 - 180.0)


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """One autopilot's local NED frame as seen from the fleet frame: a shift, no rotation.

    The meridians' convergence between two origins some hundred metres apart is below 1e-4 rad and is neglected.
    """

    origin_in_fleet_ned_m: Ned

    @classmethod
    def from_origins(cls, autopilot: Geodetic, fleet: Geodetic) -> "LocalFrame":
        """The frame of an autopilot whose GPS_GLOBAL_ORIGIN is `autopilot`."""
        return cls(geodetic_to_ned(autopilot, fleet))

    def to_fleet(self, local_ned_m: Ned) -> Ned:
        """A position of the autopilot's local frame in the fleet frame (m)."""
        o = self.origin_in_fleet_ned_m
        return Ned(local_ned_m.north + o.north, local_ned_m.east + o.east, local_ned_m.down + o.down)

    def to_local(self, fleet_ned_m: Ned) -> Ned:
        """A position of the fleet frame in the autopilot's local frame (m)."""
        o = self.origin_in_fleet_ned_m
        return Ned(fleet_ned_m.north - o.north, fleet_ned_m.east - o.east, fleet_ned_m.down - o.down)
