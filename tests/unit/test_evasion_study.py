"""The study of evasion with a small flock: what it keeps of a run, the wave's speed, and the bars that end it."""

import json
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("numba")

from rich.console import Console

from companion.core.law.evasion import CALM, FLEES
from companion.errors import CompanionError
from sim.study import evasion
from sim.study.common import load_config
from sim.study.run import study
from sim.swarm.setup import Formation, Setup
from sim.swarm.swarm import Run

JUDGED = evasion.Judged(must_m=0.5, connected_within_s=30.0, held_m=6.0, within_m=1.0, threshold_m_s=0.1)
LINE = Setup(
    formation=Formation(shape="line", count=21, spacing_m=4.0), plan=False, k_p=0.0, nearest=2, duration_s=10.0,
    threat=(2.0, 0.0, 0.0, 0.0, 0.0, 10.0, 3.0),
)  # fmt: skip


def made(speed_m_s: float, apart_until_s: float = 0.0) -> Run:
    """A flight that is made up: the first of a line flees, and a wave goes along it at a speed."""
    t = np.arange(100) * 0.1
    slots = LINE.formation.slots()
    first = int(np.argmin(slots[:, 1]))
    distance = np.linalg.norm(slots - slots[first], axis=1)
    common = np.zeros((100, 21, 4))
    common[t >= 2.0, first, 3] = FLEES
    common[t >= 5.0, first, 3] = CALM
    common[:, :, 0] = 0.5 * (t[:, None] >= 2.0 + distance / speed_m_s - 1e-9)
    place = np.tile(slots, (100, 1, 1))
    place[t < apart_until_s, first] += [30.0, 0.0, 0.0]
    reference = np.concatenate([np.tile(slots, (100, 1, 1)), np.zeros((100, 21, 3))], axis=2)
    return Run(
        setup=LINE, seed=0, time_s=t, position_m=place, velocity_m_s=np.zeros((100, 21, 3)), reference=reference,
        events=np.zeros((0, 3), dtype=np.int64), messages=0, samples_sent=0, steps_dynamic=0, steps_fixed=0,
        measures={"minimum_distance_m": 4.0}, common=common,
    )  # fmt: skip


@pytest.mark.parametrize("speed_m_s", [12.0, 20.0])
def test_the_speed_is_that_of_the_wave(speed_m_s: float) -> None:
    found = evasion.figures_of(made(speed_m_s), JUDGED)
    assert found["fled"] == 1
    assert found["reached"] == 1.0
    assert found["wave_m_s"] == pytest.approx(speed_m_s, rel=0.03)
    assert found["exponent"] == pytest.approx(1.0, abs=0.2)
    assert found["wave_low_m_s"] <= found["wave_m_s"] <= found["wave_high_m_s"]
    assert found["reach_m"] == pytest.approx(80.0)


def test_who_is_not_reached_has_no_delay_and_without_a_wave_there_is_no_speed() -> None:
    slow = evasion.figures_of(made(4.0), JUDGED)
    assert 0.3 < slow["reached"] < 0.5
    assert slow["reach_m"] < 33.0
    still = made(8.0)
    still.common[:, :, 0] = 0.0
    assert evasion.figures_of(still, JUDGED)["wave_m_s"] is None


def test_it_counts_the_parts_and_how_long_after_the_last_flight_they_are_one() -> None:
    found = evasion.figures_of(made(8.0, apart_until_s=7.0), JUDGED)
    assert found["parts"] == 2
    # the last moment at which it flees is 4.9 s
    assert found["connected_s"] == pytest.approx(2.1)
    assert evasion.figures_of(made(8.0, apart_until_s=20.0), JUDGED)["connected_s"] is None
    whole = evasion.figures_of(made(8.0), JUDGED)
    assert (whole["parts"], whole["connected_s"]) == (1, 0.0)
    assert whole["lambda2"] > 0.0


def _setup_file(tmp_path: Path, must_m: float) -> Path:
    """The shipped file with forty of them for 20 s."""
    text = Path(evasion.__file__).with_suffix(".toml").read_text(encoding="utf-8")
    for before, after in (
        ("duration_s = 50.0", "duration_s = 20.0"), ("count = 300", "count = 40"),
        ("must_m = 0.5", f"must_m = {must_m}"),
        ("8.0, -60.0, 0.0, 8.0", "8.0, -30.0, 0.0, 8.0"), ("5.0, -42.0, 0.0, 0.0, 25.0", "5.0, -18.0, 0.0, 0.0, 12.0"),
    ):  # fmt: skip
        assert text.count(before) == 1
        text = text.replace(before, after)
    path = tmp_path / "own.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_study_runs_and_writes_tables_figures_and_null_models(tmp_path: Path) -> None:
    study("evasion", "0", tmp_path, setup=_setup_file(tmp_path, 0.1), console=Console(file=StringIO()))
    rows = json.loads((tmp_path / "evasion.json").read_text(encoding="utf-8"))["rows"]
    by = {(r["case"], r["scheme"]): r for r in rows}
    assert len(by) == 6
    for case in ("flies through", "startles one side"):
        flown = by[case, evasion.FLOWN]
        assert 1 <= flown["fled"] < 40
        assert flown["wave_m_s"] is None or flown["wave_m_s"] > 0.0
        assert by[case, "heartbeats only"]["messages"] < flown["messages"] < by[case, "20 Hz"]["messages"]
    for name in ("evasion.csv", "evasion_wave.png", "evasion_wave.svg", "evasion_flock.png", "evasion.html"):
        assert (tmp_path / name).stat().st_size > 0


def test_a_flock_that_comes_too_near_ends_the_command_with_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(CompanionError, match=r"below 50 m"):
        study("evasion", "0", tmp_path, setup=_setup_file(tmp_path, 50.0), console=Console(file=StringIO()))


def test_the_shipped_flock_is_three_hundred_that_heed_seven_each() -> None:
    config = load_config("evasion")
    for setup in config.cases().values():
        assert (setup.formation.count, setup.nearest, setup.plan, setup.barrier) == (300, 7, False, True)
        assert replace(setup, threat=()).epsilon_nu_m_s == 0.03
