"""Evasion: bounded, smooth, away from the threat, and over when it is over."""

from math import hypot, isfinite

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.core.law import evasion
from companion.core.law.evasion import CALM, FLEES, GOES_BACK, UNDISTURBED, Evasion, Threat, away, evade, wish

DT_S = 0.02
places = st.floats(-1e4, 1e4)
speeds = st.floats(-30.0, 30.0)
calm = st.floats(-2.0, 2.0)
threats = st.builds(Threat, places, places, speeds, speeds, st.floats(1.0, 50.0), st.floats(0.5, 60.0))
near = st.floats(-60.0, 60.0)
doings = st.sampled_from((CALM, FLEES, GOES_BACK))


def stepped(
    threat: Threat, seconds: float, north: float, east: float, common: tuple[float, float], from_s: float = 0.0,
    e: Evasion = UNDISTURBED,
) -> Evasion:  # fmt: skip
    """A vehicle that stands at a place and whose wish is its common velocity."""
    e = e._replace(calm_north_m_s=common[0], calm_east_m_s=common[1]) if e is UNDISTURBED else e
    for k in range(round(seconds / DT_S)):
        e = evade(e, threat, from_s + k * DT_S, north, east, *common, DT_S)
        if e.doing != CALM:
            common = (e.north_m_s, e.east_m_s)
    return e


@given(threats, st.floats(-1e4, 1e4), places, places, speeds, speeds, calm, calm, doings, st.floats(0.0, 1.0))
def test_the_wish_is_finite_and_changes_no_faster_than_it_may(
    threat: Threat, since_s: float, north: float, east: float, nu_n: float, nu_e: float, c_n: float, c_e: float,
    doing: int, dt_s: float,
) -> None:  # fmt: skip
    e = evade(Evasion(doing, 0.0, 0.0, 0.0, 0.0, c_n, c_e, 2.0), threat, since_s, north, east, nu_n, nu_e, dt_s)
    assert all(isfinite(x) for x in e)
    assert hypot(e.north_m_s - nu_n, e.east_m_s - nu_e) <= evasion.FLEE_RATE_M_S2 * dt_s + 1e-9
    assert hypot(e.north_m_s2, e.east_m_s2) <= evasion.TOLD_RATE_M_S2 * (1.0 + 1e-6)


@given(threats, st.floats(0.0, 60.0), places, places, calm, calm)
def test_what_is_wished_is_no_faster_than_the_fleet_and_the_flight_together(
    threat: Threat, since_s: float, north: float, east: float, c_n: float, c_e: float
) -> None:
    w = wish(threat, since_s, north, east, c_n, c_e, evasion.FLEE_SPEED_M_S)
    assert hypot(*w) <= hypot(c_n, c_e) + evasion.FLEE_SPEED_M_S + 1e-9


@given(threats, st.floats(0.0, 5.0), near, near, calm, calm)
def test_within_half_the_radius_it_leads_away_however_the_fleet_flew(
    threat: Threat, since_s: float, north: float, east: float, c_n: float, c_e: float
) -> None:
    north, east = north + threat.north_m, east + threat.east_m
    distance, a_n, a_e = away(threat, since_s, north, east)
    w = wish(threat, since_s, north, east, c_n, c_e, evasion.FLEE_SPEED_M_S)
    outward = w[0] * a_n + w[1] * a_e
    assert outward >= c_n * a_n + c_e * a_e - 1e-9
    if distance <= 0.5 * threat.radius_m:
        assert outward >= evasion.FLEE_SPEED_M_S - 1e-9
    if distance >= threat.radius_m:
        assert w == (c_n, c_e)


@given(threats, st.floats(0.0, 5.0), near, near, calm, calm, st.floats(-0.01, 0.01), st.floats(-0.01, 0.01))
def test_places_that_are_near_each_other_wish_nearly_the_same(
    threat: Threat, since_s: float, north: float, east: float, c_n: float, c_e: float, d_n: float, d_e: float
) -> None:
    north, east = north + threat.north_m, east + threat.east_m
    distance, _, _ = away(threat, since_s, north, east)
    if distance <= 1.0:
        return
    one = wish(threat, since_s, north, east, c_n, c_e, evasion.FLEE_SPEED_M_S)
    two = wish(threat, since_s, north + d_n, east + d_e, c_n, c_e, evasion.FLEE_SPEED_M_S)
    # the size by the smooth step's slope of 3 / R, the direction by 1 / distance
    slope = (evasion.FLEE_SPEED_M_S + hypot(c_n, c_e)) * (3.0 / threat.radius_m + 2.0 / (distance - 0.02))
    assert hypot(one[0] - two[0], one[1] - two[1]) <= slope * hypot(d_n, d_e) + 1e-9


@given(st.floats(3.0, 12.0), st.floats(0.5, 4.0), st.floats(0.0, 1.5))
def test_those_before_a_threat_that_comes_go_to_its_sides(speed: float, aside_m: float, ahead_s: float) -> None:
    threat = Threat(0.0, 0.0, speed, 0.0, 10.0, 20.0)
    left = wish(threat, 0.0, ahead_s * speed, -aside_m, 0.0, 0.0, evasion.FLEE_SPEED_M_S)
    right = wish(threat, 0.0, ahead_s * speed, aside_m, 0.0, 0.0, evasion.FLEE_SPEED_M_S)
    assert right == pytest.approx((0.0, evasion.FLEE_SPEED_M_S))
    assert left == pytest.approx((0.0, -evasion.FLEE_SPEED_M_S))


def test_on_the_threats_own_way_it_goes_to_the_right_and_on_a_standing_one_north() -> None:
    coming, standing = Threat(0.0, 0.0, 5.0, 0.0, 10.0, 9.0), Threat(0.0, 0.0, 0.0, 0.0, 10.0, 9.0)
    assert wish(coming, 0.0, 3.0, 0.0, 0.0, 0.0, 2.0) == pytest.approx((0.0, 2.0))
    assert wish(standing, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0) == pytest.approx((2.0, 0.0))


def test_it_flees_then_wishes_what_it_had_and_then_is_calm_again() -> None:
    threat, common = Threat(0.0, 0.0, 0.0, 0.0, 10.0, 2.0), (0.5, 0.0)
    fled = stepped(threat, 2.0, 0.0, 3.0, common)
    assert fled.doing == FLEES
    assert (fled.north_m_s, fled.east_m_s) == pytest.approx((0.5, 2.0))
    after = stepped(threat, 2.0, 0.0, 3.0, (fled.north_m_s, fled.east_m_s), 2.0 + DT_S, fled)
    assert after.doing == GOES_BACK
    assert (after.north_m_s, after.east_m_s) == pytest.approx(common)
    late = stepped(threat, evasion.GO_BACK_S, 0.0, 3.0, common, 4.0 + DT_S, after)
    assert late.doing == CALM


@pytest.mark.parametrize(("since_s", "doing"), [(-0.02, CALM), (0.0, FLEES), (3.0, FLEES), (3.02, CALM)])
def test_a_threat_is_seen_from_its_begin_until_its_end(since_s: float, doing: int) -> None:
    threat = Threat(0.0, 0.0, 0.0, 0.0, 10.0, 3.0)
    assert evade(UNDISTURBED, threat, since_s, 1.0, 0.0, 0.0, 0.0, DT_S).doing == doing


@pytest.mark.parametrize(
    ("away_m", "doing", "next_doing"),
    [
        (9.99, CALM, FLEES),
        (10.0, CALM, CALM),
        (11.99, FLEES, FLEES),
        (12.0, FLEES, GOES_BACK),
        (9.99, GOES_BACK, FLEES),
    ],
)
def test_whoever_flees_sees_it_a_little_farther(away_m: float, doing: int, next_doing: int) -> None:
    threat = Threat(0.0, 0.0, 0.0, 0.0, 10.0, 3.0)
    e = UNDISTURBED._replace(doing=doing, left_s=evasion.GO_BACK_S)
    assert evade(e, threat, 1.0, away_m, 0.0, 0.0, 0.0, DT_S).doing == next_doing


def test_a_wave_that_comes_by_before_the_threat_is_not_what_it_goes_back_to() -> None:
    threat = Threat(0.0, 0.0, 0.0, 0.0, 10.0, 60.0)
    e = UNDISTURBED
    for k in range(50):
        e = evade(e, threat, k * DT_S, 100.0, 0.0, 1.0, 0.0, DT_S)
    assert e.doing == CALM
    assert 0.0 < e.calm_north_m_s < 0.02
