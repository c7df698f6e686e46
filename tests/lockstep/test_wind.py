"""Five vehicles in a steady wind: the formation takes its place as it does in calm air, wherever the wind comes from.

The hold is what decides it: peers that are predicted to stay downwind hold each other there.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from flights import distances, errors, failsafes, fleet, straight, truth, until_landed, wait

from companion.core.values import Phase
from sim.lockstep.lockstep import Lockstep

DRAG_PER_S = 1.0
"""as PX4's own simulator has it: 5 m/s of wind push with 5 m/s^2"""
LIMIT_S, AFTER_S = 45.0, 30.0


class Flight(NamedTuple):
    """From take-off on."""

    formed_s: float
    """LIMIT_S: not by then"""
    centroid_m: float
    """distance of the centroid from its place (RMS, true), over AFTER_S from then on"""
    formation_m: float


@cache
def flown(hold: str, north_m_s: float = 0.0, east_m_s: float = 0.0) -> Flight:
    """A flight in that wind."""

    def change(tables: dict[str, dict[str, object]]) -> None:
        tables["stub"] |= {"drag_per_s": DRAG_PER_S, "wind_north_m_s": north_m_s, "wind_east_m_s": east_m_s}
        tables["law"]["hold"] = hold

    ls = Lockstep(fleet(5, legs=straight(60.0), change=change), seed=1)
    ls.run_until_ready(20.0)
    begun_s = ls.now_ns * 1e-9
    ls.command(b'{"verb":"takeoff"}')
    ls.run_until(begun_s + LIMIT_S, lambda: ls.all_in(Phase.FORMED))
    formed_s = ls.now_ns * 1e-9
    wait(ls, AFTER_S)
    t = truth(ls, formed_s)
    formation_m, centroid_m = errors(ls, t, t.ids)
    assert failsafes(ls) == []
    return Flight(formed_s - begun_s, *(float(np.sqrt(np.square(x).mean())) for x in (centroid_m, formation_m)))


WINDS = {"tail": (5.0, 0.0), "head": (-5.0, 0.0), "side": (0.0, 5.0)}


@pytest.mark.parametrize("wind", WINDS)
def test_in_five_metres_a_second_of_wind_the_formation_takes_its_place_as_in_calm_air(wind: str) -> None:
    calm, windy = flown("returning"), flown("returning", *WINDS[wind])
    assert windy.formed_s <= 1.25 * calm.formed_s
    assert windy.centroid_m <= 0.15
    assert windy.formation_m <= 1.2 * calm.formation_m


def test_who_is_predicted_to_stay_downwind_holds_the_others_there() -> None:
    """The null model: the same flight without the plan's pull in the hold."""
    damped = flown("damped", *WINDS["tail"])
    assert damped.formed_s >= 1.4 * flown("returning", *WINDS["tail"]).formed_s
    assert damped.centroid_m >= 2.0 * flown("returning", *WINDS["tail"]).centroid_m


def test_a_storm_that_no_vehicle_can_stand_against_brings_nobody_together_and_all_land_on_command() -> None:
    """12 m/s push with 12 m/s^2, more than the tilt gives: all are carried off, as one."""

    def change(tables: dict[str, dict[str, object]]) -> None:
        tables["stub"] |= {"drag_per_s": DRAG_PER_S, "wind_north_m_s": 12.0}

    ls = Lockstep(fleet(5, legs=straight(60.0), change=change), seed=1)
    ls.run_until_ready(20.0)
    begun_s = ls.now_ns * 1e-9
    ls.command(b'{"verb":"takeoff"}')
    wait(ls, LIMIT_S)
    assert not ls.all_in(Phase.FORMED)
    ls.command(b'{"verb":"land"}')
    until_landed(ls)
    t = truth(ls, begun_s)
    assert np.abs(t.position_ned_m[:, :, 0]).max() > 50.0, "they were carried off"
    assert distances(t).min() >= 1.5
