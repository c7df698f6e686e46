"""Frames: WGS84 to the fleet frame, and each autopilot's local NED frame to the fleet frame.

The fleet frame is north-east-down in metres, its origin the fleet origin of fleet.toml (WGS84 latitude and
longitude, AMSL altitude). Every autopilot has a local NED frame of its own, whose origin is where its estimator
happened to start (GPS_GLOBAL_ORIGIN, MAVLink 49). Positions are shifted by the difference of the two origins.
"""

from dataclasses import dataclass
from typing import NamedTuple

import pymap3d


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
    east, north, _ = pymap3d.geodetic2enu(
        point.latitude_deg, point.longitude_deg, 0.0, origin.latitude_deg, origin.longitude_deg, 0.0
    )
    return Ned(float(north), float(east), origin.altitude_amsl_m - point.altitude_amsl_m)


def ned_to_geodetic(position_ned_m: Ned, origin: Geodetic) -> Geodetic:
    """Inverse of `geodetic_to_ned`, to a millimetre within some kilometres of the origin."""
    north, east, down = position_ned_m
    # On the ellipsoid the tangent plane's point lies lower by the curvature; two corrections suffice for a millimetre.
    up = 0.0
    latitude = longitude = 0.0
    for _ in range(3):
        latitude, longitude, height = pymap3d.enu2geodetic(
            east, north, up, origin.latitude_deg, origin.longitude_deg, 0.0
        )
        up -= float(height)
    return Geodetic(float(latitude), float(longitude), origin.altitude_amsl_m - down)


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
