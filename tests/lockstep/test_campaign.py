"""Twenty flights of the fault campaign with four vehicles; `fleet study campaign --seeds 0..499 --jobs 2` flies ten."""

import json
import os
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from sim.study import campaign
from sim.study.campaign import Drawn, drawn_faults, flight_of
from sim.study.cli import study
from sim.study.common import load_config


@pytest.mark.timeout(1200)
def test_twenty_flights_with_random_faults_break_no_rule(tmp_path: Path) -> None:
    quiet = Console(file=StringIO())
    setup = tmp_path / "four.toml"
    text = Path(campaign.__file__).with_suffix(".toml").read_text(encoding="utf-8")
    text = text.replace("vehicles = 10 ", "vehicles = 4 ").replace("fence_radius_m = 22.0", "fence_radius_m = 18.0")
    setup.write_text(text, encoding="utf-8")
    assert flight_of(load_config("campaign", setup)).vehicles == 4
    assert flight_of(load_config("campaign", setup)).fence_radius_m == 18.0
    study("campaign", "0..19", tmp_path, setup=setup, jobs=len(os.sched_getaffinity(0)), console=quiet)
    found = json.loads((tmp_path / "campaign.json").read_text(encoding="utf-8"))
    assert found["broken"] == []
    assert [row["count"] for row in found["rows"][:4]] == [0, 0, 0, 0]


def test_a_seed_draws_the_same_one_to_three_faults_each_time_within_their_window() -> None:
    flight = flight_of(load_config("campaign"))
    for seed in range(200):
        faults = drawn_faults(flight, seed)
        assert faults == drawn_faults(flight, seed)
        assert 1 <= len(faults) <= flight.most_faults
        assert all(flight.faults_from_s <= f.at_s <= flight.faults_to_s for f in faults)
        assert all(0 <= f.vehicle_id <= flight.vehicles for f in faults)
    kinds = {f.kind for seed in range(200) for f in drawn_faults(flight, seed)}
    assert len(kinds) == 15
    assert isinstance(drawn_faults(flight, 0)[0], Drawn)
