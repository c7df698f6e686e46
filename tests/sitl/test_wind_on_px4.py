"""Five real PX4 in a steady wind, where their simulator has one (since v1.18): they form as in calm air."""

from collections.abc import Callable
from pathlib import Path

import pytest
from px4_fleet import flying, judged, sitl_fleet

from sim.launch.px4_build import has_parameter

WIND_M_S = 5
PLAN = {"then": "land", "legs": [{"kind": "velocity", "north_m_s": 1.0, "duration_s": 40.0}]}
FORMED_S = 40.0
"""calm 25 s; with the damped hold 60 s"""
Property = Callable[[str, object], None]


@pytest.mark.parametrize("along", ["SIH_WIND_N", "SIH_WIND_E"])
def test_five_form_in_the_wind_as_in_calm_air_and_none_hangs_downwind(
    tmp_path: Path, build: Path, record_property: Property, along: str
) -> None:
    if not has_parameter(build, along):
        pytest.skip(f"this PX4's simulator has no wind ({along})")
    more = ("--autopilot", "px4", "--px4", str(build), "--parameter", f"{along}={WIND_M_S}")
    with flying(sitl_fleet(tmp_path, 5, plan=PLAN), build, *more) as flight:
        assert flight.up.wait(200.0) == 0, flight.up.out + flight.up.err
    summary = flight.summary
    steady = judged(summary, record_property)
    record_property("formed_after_s", summary["formed_after_s"])
    assert summary["formed_after_s"] <= FORMED_S
    assert steady["centroid_error_rms_m"] <= 0.12
    assert steady["formation_error_rms_m"] <= 0.1
    assert steady["attitude_rate_rms_deg_s"] <= 10.0
    assert steady["reduction_vs_20hz_percent"] >= 98.5  # short
