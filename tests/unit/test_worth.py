"""What the messages buy: the null models are what they are called, and the study says what it found."""

import json
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

pytest.importorskip("numba")
pytest.importorskip("matplotlib")

from companion.errors import CompanionError, ConfigError
from sim.study import worth
from sim.study.common import Config, load_config
from sim.study.run import study
from sim.swarm.state import CAUSES
from sim.swarm.swarm import run

SCENES = ("crossing slots, all faults", "leaderless, 5 of 10 informed")


def _short(*scenes: str) -> Config:
    """The shipped set-up with a few scenarios of 24 s."""
    config = load_config("worth")
    values = dict(config.values)
    values["base"] = {**values["base"], "duration_s": 24.0}
    values["cases"] = {name: values["cases"][name] for name in scenes}
    values["about"] = {name: {**values["about"][name], "f_after_s": 8.0} for name in scenes}
    return replace(config, values=values)


@pytest.fixture(scope="module")
def flown() -> dict[str, dict[str, dict[str, float]]]:
    return dict(worth.piece(_short(*SCENES), 3))


@pytest.mark.parametrize("scene", SCENES)
def test_nothing_received_means_that_no_message_reaches_anyone(scene: str, flown: worth.Record) -> None:
    silent = flown[scene][worth.NOTHING]
    assert silent["received"] == 0
    assert silent["worst_m"] is None
    assert all(r["received"] > 0 for name, r in flown[scene].items() if name != worth.NOTHING)


@pytest.mark.parametrize("scene", SCENES)
def test_heartbeats_only_means_that_nothing_is_triggered(scene: str, flown: worth.Record) -> None:
    beats = flown[scene][worth.BEATS]
    assert beats["triggered"] == beats["near"] == 0
    assert beats["messages"] == beats["first"] + beats["heartbeat"]
    assert flown[scene][worth.FLOWN]["triggered"] > 0


@pytest.mark.parametrize("scene", SCENES)
def test_a_period_with_the_same_number_of_messages_has_it_within_a_few_per_cent(
    scene: str, flown: worth.Record
) -> None:
    assert flown[scene][worth.SAME]["messages"] == pytest.approx(flown[scene][worth.FLOWN]["messages"], rel=0.05)


@pytest.mark.parametrize("scene", SCENES)
def test_the_causes_of_every_scheme_add_up(scene: str, flown: worth.Record) -> None:
    for name, record in flown[scene].items():
        assert sum(record[cause] for cause in CAUSES) == record["messages"], name


@pytest.mark.parametrize("scene", SCENES)
def test_twenty_hertz_is_twenty_messages_a_second_and_nothing_is_filtered_in_the_raw_one(
    scene: str, flown: worth.Record
) -> None:
    config = _short(scene)
    schemes = worth.schemes_of(config, config.cases()[scene])
    for name in (worth.RAW, "20 Hz, filtered"):
        assert flown[scene][name]["messages"] == pytest.approx(10 * 24.0 * 20.0, rel=0.01)
    assert not schemes[worth.RAW].send_filter
    assert schemes["20 Hz, filtered"].send_filter


def test_every_scenario_says_what_it_is_judged_by() -> None:
    config = load_config("worth")
    assert set(worth.about_of(config)) == set(config.cases())
    short = dict(config.values)
    short["about"] = {}
    with pytest.raises(ConfigError, match=r"\$\.about must name the scenarios"):
        worth.about_of(replace(config, values=short))


def test_what_is_never_beyond_its_limit_responds_at_once_and_what_always_is_never_does() -> None:
    setup = _short(SCENES[1]).cases()[SCENES[1]]
    flight = run(replace(setup, trigger="periodic", near=False, gust_m_s2=0.0), 3)
    loose, strict = (
        worth.responses_s(flight, worth.About(events_s=(10.0,), within=within, f_after_s=8.0)) for within in (0.3, 1e-6)
    )
    assert (loose, strict) == ([0.0], [None])


def test_a_pair_counts_once_however_long_it_is_close() -> None:
    config = _short(SCENES[1])
    flight = run(replace(config.cases()[SCENES[1]], loss=1.0), 3)
    pairs = worth.close_pairs(flight, 1e6), worth.close_pairs(flight, 0.0)
    assert pairs == (45, 0)


def test_better_needs_more_than_the_spread_of_the_difference() -> None:
    rng = np.random.default_rng(1)
    theirs = rng.normal(1.0, 0.3, 40)
    assert worth._better(theirs - 0.2 + rng.normal(0.0, 0.05, 40), theirs) == "yes"
    assert worth._better(theirs + 0.2 + rng.normal(0.0, 0.05, 40), theirs) == "no"
    assert worth._better(theirs + rng.normal(0.0, 0.5, 40), theirs) == "alike"
    assert worth._better(theirs + 0.2 + rng.normal(0.0, 0.05, 40), theirs, larger=True) == "yes"


def _setup_file(tmp_path: Path, must_m: float) -> Path:
    """The shipped file with one scenario of 24 s, which must keep a distance."""
    text = Path(worth.__file__).with_suffix(".toml").read_text(encoding="utf-8")
    cases = text.index("[cases.")
    about = text.index("[about.")
    schemes = text.index("[schemes.")
    path = tmp_path / "own.toml"
    scene = text[text.index('[cases."a failing motor"]') : text.index("# 5 m/s of wind")]
    path.write_text(
        text[:cases].replace("duration_s = 60.0", "duration_s = 24.0") + scene
        + '[about."a failing motor"]\nevents_s = [10.0]\nwithin = 0.5\nf_after_s = 10.0\n'
        + f"must_m = {must_m}\n" + text[schemes:],
        encoding="utf-8",
    )  # fmt: skip
    assert about > cases
    return path


def test_the_study_runs_writes_its_tables_and_says_where_a_trigger_buys_nothing(tmp_path: Path) -> None:
    study("worth", "0..1", tmp_path, setup=_setup_file(tmp_path, 0.1), console=Console(file=StringIO()))
    found = json.loads((tmp_path / "worth.json").read_text(encoding="utf-8"))
    (judged,) = found["judged"]
    assert judged["scenario"] == "a failing motor"
    said = " ".join(found["findings"])
    assert "a failing motor" in said
    assert judged["bounded"] == (judged["worst_ratio"] <= 1.0 / 3.0)
    for name in ("worth_judged.csv", "worth_all.csv", "worth_error.png", "worth_error.svg", "worth.html"):
        assert (tmp_path / name).stat().st_size > 0


def test_a_must_that_is_broken_ends_the_command_with_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(CompanionError, match=r"a failing motor: 0 of 1 seeds below 0\.5 m.*must be 50 m"):
        study("worth", "0", tmp_path, setup=_setup_file(tmp_path, 50.0), console=Console(file=StringIO()))
