"""Frames: geodetic and fleet frame are inverse to each other, level is level, local frames are shifts."""

from math import cos, hypot, radians

import pymap3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.frames import Geodetic, LocalFrame, Ned, geodetic_to_ned, ned_to_geodetic

PROPERTY = settings(deadline=None, max_examples=60)
ZURICH = Geodetic(47.3977, 8.5456, 488.0)


def degrees(limit: float) -> st.SearchStrategy[float]:
    return st.floats(-limit, limit, allow_nan=False)


origins = st.builds(Geodetic, degrees(80.0), degrees(180.0), st.floats(-400.0, 5000.0))
places = st.builds(Ned, *[st.floats(-5000.0, 5000.0)] * 2, st.floats(-500.0, 500.0))


def distance_m(a: Ned, b: Ned) -> float:
    return hypot(*(x - y for x, y in zip(a, b, strict=True)))


@PROPERTY
@given(origins, places)
def test_a_place_comes_back_from_geodetic_to_a_millimetre(origin: Geodetic, place: Ned) -> None:
    assert distance_m(geodetic_to_ned(ned_to_geodetic(place, origin), origin), place) < 1e-3


@PROPERTY
@given(origins, degrees(0.04), degrees(0.04), st.floats(-300.0, 300.0))
def test_a_geodetic_point_comes_back_from_the_fleet_frame(
    origin: Geodetic, north_deg: float, east_deg: float, up_m: float
) -> None:
    point = Geodetic(origin.latitude_deg + north_deg, origin.longitude_deg + east_deg, origin.altitude_amsl_m + up_m)
    back = ned_to_geodetic(geodetic_to_ned(point, origin), origin)
    assert back.latitude_deg == pytest.approx(point.latitude_deg, abs=1e-8)
    assert (back.longitude_deg - point.longitude_deg + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-7)
    assert back.altitude_amsl_m == pytest.approx(point.altitude_amsl_m, abs=1e-6)


@PROPERTY
@given(origins, degrees(0.1), degrees(0.1))
def test_the_level_is_that_of_a_library_which_nobody_here_wrote(
    origin: Geodetic, north_deg: float, east_deg: float
) -> None:
    point = Geodetic(origin.latitude_deg + north_deg, origin.longitude_deg + east_deg, 0.0)
    there = (point.latitude_deg, point.longitude_deg, 0.0, origin.latitude_deg, origin.longitude_deg, 0.0)
    east, north, _ = pymap3d.geodetic2enu(*there)
    ours = geodetic_to_ned(point, origin)
    assert (ours.north, ours.east) == pytest.approx((north, east), abs=1e-8)


@PROPERTY
@given(origins, degrees(0.1), degrees(0.1), st.floats(-100.0, 3000.0))
def test_vehicles_at_one_altitude_are_level_however_far_apart(
    origin: Geodetic, north_deg: float, east_deg: float, altitude_m: float
) -> None:
    here = Geodetic(origin.latitude_deg, origin.longitude_deg, altitude_m)
    far = Geodetic(origin.latitude_deg + north_deg, origin.longitude_deg + east_deg, altitude_m)
    assert geodetic_to_ned(far, origin).down == geodetic_to_ned(here, origin).down


def test_the_origin_is_zero() -> None:
    assert distance_m(geodetic_to_ned(ZURICH, ZURICH), Ned(0.0, 0.0, 0.0)) < 1e-6


@pytest.mark.parametrize(
    ("point", "expected"),
    [
        (Geodetic(47.3978, 8.5456, 488.0), Ned(11.1175, 0.0, 0.0)),
        (Geodetic(47.3977, 8.5457, 488.0), Ned(0.0, 1e-4 * 111_320.0 * cos(radians(47.3977)), 0.0)),
        (Geodetic(47.3977, 8.5456, 498.0), Ned(0.0, 0.0, -10.0)),
        (Geodetic(47.3976, 8.5455, 478.0), Ned(-11.1175, -1e-4 * 111_320.0 * cos(radians(47.3977)), 10.0)),
    ],
)
def test_north_east_and_down_have_their_signs_and_sizes(point: Geodetic, expected: Ned) -> None:
    assert distance_m(geodetic_to_ned(point, ZURICH), expected) < 0.03


def test_the_date_line_is_no_edge() -> None:
    west = Geodetic(-17.0, 179.9999, 10.0)
    east = Geodetic(-17.0, -179.9999, 10.0)
    there = geodetic_to_ned(east, west)
    assert there.east == pytest.approx(2e-4 * 111_320.0 * cos(radians(17.0)), rel=1e-3)
    assert abs(there.north) < 0.01


@PROPERTY
@given(places, places)
def test_local_frame_and_back_changes_nothing(shift: Ned, place: Ned) -> None:
    frame = LocalFrame(shift)
    assert distance_m(frame.to_local(frame.to_fleet(place)), place) < 1e-9
    assert distance_m(frame.to_fleet(frame.to_local(place)), place) < 1e-9


@PROPERTY
@given(st.builds(Ned, *[st.floats(-200.0, 200.0)] * 2, st.floats(-30.0, 30.0)), places)
def test_a_vehicle_with_another_origin_is_seen_at_the_same_place(shift: Ned, place: Ned) -> None:
    """Two autopilots some hundred metres apart report one point; both reports meet in the fleet frame."""
    own_origin = ned_to_geodetic(shift, ZURICH)
    point = ned_to_geodetic(Ned(place.north / 10, place.east / 10, place.down), ZURICH)
    frame = LocalFrame.from_origins(own_origin, ZURICH)
    seen = frame.to_fleet(geodetic_to_ned(point, own_origin))
    # 500 m away and origins 280 m apart: the meridians' convergence makes some 3 cm.
    assert distance_m(seen, geodetic_to_ned(point, ZURICH)) < 0.05
