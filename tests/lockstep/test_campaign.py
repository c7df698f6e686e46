"""Twenty flights of the fault campaign with four vehicles; `fleet study campaign --seeds 0..499 --jobs 2` flies ten."""

import json
import os
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from companion.errors import CompanionError, ConfigError
from sim.study import campaign, campaign_faults
from sim.study.attacks import PLANS
from sim.study.campaign import fly
from sim.study.campaign_faults import Drawn, drawn_faults, flight_of
from sim.study.common import load_config
from sim.study.run import study


def _fly(folder: Path, seeds: str, changes: dict[str, str], jobs: int = 1) -> None:
    """The campaign with some lines of its set-up changed; each must be there."""
    text = Path(campaign.__file__).with_suffix(".toml").read_text(encoding="utf-8")
    for line, changed in changes.items():
        assert line in text
        text = text.replace(line, changed)
    setup = folder / "own.toml"
    setup.write_text(text, encoding="utf-8")
    study("campaign", seeds, folder, jobs, setup, Console(file=StringIO()))


def _found(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "campaign.json").read_text(encoding="utf-8")))


@pytest.mark.timeout(1200)
def test_twenty_flights_with_random_faults_break_no_rule(tmp_path: Path) -> None:
    four = {"vehicles = 10 ": "vehicles = 4 ", "fence_radius_m = 22.0": "fence_radius_m = 18.0"}
    _fly(tmp_path, "0..19", four, jobs=len(os.sched_getaffinity(0)))
    found = _found(tmp_path)
    assert found["broken"] == []
    assert [row["count"] for row in found["rows"][:5]] == [0, 0, 0, 0, 0]


def test_a_broken_rule_ends_the_command_with_a_sentence_after_its_report_is_written(tmp_path: Path) -> None:
    """Two vehicles that have no time to land: when the flight is judged they are on their way still."""
    short = {"vehicles = 10 ": "vehicles = 2 ", "seconds = 200.0": "seconds = 4.0"}
    with pytest.raises(CompanionError, match=r"^1 of 1 flights broke a rule, of seeds 7: .*campaign\.html$"):
        _fly(tmp_path, "7", short)
    broken = _found(tmp_path)["broken"]
    assert [b["seed"] for b in broken] == [7]
    assert len(broken[0]["stuck"]) == 2
    page = (tmp_path / "campaign.html").read_text(encoding="utf-8")
    assert "1 of 1 flights broke a rule" in page
    assert "Parameters were chosen on" not in page


def test_a_seed_draws_the_same_one_to_three_faults_each_time_within_their_window() -> None:
    flight = flight_of(load_config("campaign"))
    for seed in range(200):
        faults = drawn_faults(flight, seed)
        assert faults == drawn_faults(flight, seed)
        assert 1 <= len(faults) <= flight.most_faults
        assert all(flight.faults_from_s <= f.at_s <= flight.faults_to_s for f in faults)
        assert all(0 <= f.vehicle_id <= flight.vehicles for f in faults)
    kinds = {f.kind for seed in range(200) for f in drawn_faults(flight, seed)}
    assert len(kinds) == 20
    assert isinstance(drawn_faults(flight, 0)[0], Drawn)


def test_a_kind_that_is_left_out_changes_only_the_faults_that_were_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = flight_of(load_config("campaign"))
    with_all = [drawn_faults(flight, seed) for seed in range(200)]
    fewer = {kind: own for kind, own in reversed(campaign_faults.EXPLAINED.items()) if kind != "forged_plan"}
    monkeypatch.setattr(campaign_faults, "EXPLAINED", fewer)
    for seed, faults in enumerate(with_all):
        kept = [f for f in faults if f.kind != "forged_plan"]
        assert all(f in drawn_faults(flight, seed) for f in kept)


def test_a_message_that_ends_a_companion_breaks_a_rule_and_says_where() -> None:
    """Whatever raises in a flight, here the forger itself, is taken for an agent that does: judged until then."""
    flight = replace(flight_of(load_config("campaign")), vehicles=2, seconds=60.0)
    seed = next(s for s in range(1000) if [f.kind for f in drawn_faults(flight, s)] == ["forged_plan"])
    told: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PLANS, str(drawn_faults(flight, seed)[0].magnitude), lambda plain, _: plain.no_such_field)
        record = fly(flight, seed, told.append)
    assert record["raised"].startswith("AttributeError: 'FleetTrajectory' object has no attribute 'no_such_field'")
    assert any("climbing" in line for line in told)
    outcome = campaign.finish(load_config("campaign"), [record], [seed])
    assert outcome.broken == f"1 of 1 flights broke a rule, of seeds {seed}"
    assert outcome.values["flights"][0]["seed"] == seed


def test_an_endless_plan_of_a_stranger_keeps_nobody_in_the_air_for_ever() -> None:
    flight = replace(flight_of(load_config("campaign")), vehicles=2, kinds=("forged_plan",), operator_s=45.0)
    seed = next(s for s in range(1000) if [f.magnitude for f in drawn_faults(flight, s)] == ["endless"])
    record = fly(flight, seed)
    assert record["raised"] == ""
    assert record["stuck"] == []
    assert record["operator_landed"] == (record["ended_after_s"] > 45.0)


def test_a_set_up_may_name_the_kinds_it_wants_and_none_that_there_is_not(tmp_path: Path) -> None:
    flight = replace(flight_of(load_config("campaign")), kinds=("killed", "mute"))
    assert {f.kind for seed in range(50) for f in drawn_faults(flight, seed)} == {"killed", "mute"}
    with pytest.raises(ConfigError, match=r"kinds: there is no eclipse; known are gps_lost, .*forged_digest"):
        _fly(tmp_path, "0", {"kinds = []": 'kinds = ["eclipse"]'})
