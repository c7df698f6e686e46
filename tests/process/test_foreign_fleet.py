"""Ten stubs, and a study, flown by a law of another package: real processes, and not one change in the product."""

import json
import os
from pathlib import Path

import pytest
from fleet_process import flight_folder, make_fleet, run
from foreign import EXAMPLE, install

from companion.io.recorder import read_recording
from companion.io.replay import replay_file
from sim import study

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]

COUNT = 10
SPRINGS_CASE = """
[cases."springs"]
law = "springs"
law_parameters = { nearest = 3 }
hold = "damped"
reading = "V2"
a_max_m_s2 = 5.0
range_m = 100.0
range_on_truth = false
trigger = "error"
epsilon_m = 0.2
t_min_s = 0.05
t_max_s = 10.0
count_start = true
send_filter = true
"""
STALL_MS = 300.0
COMPILES_S = 380.0
"""a study's first run after a change compiles"""


def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The examples' package, for this process and those that it starts."""
    site = install(EXAMPLE, tmp_path / "site")
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(site), os.environ.get("PYTHONPATH")])))


def test_a_foreign_law_flies_ten_stubs_and_their_recordings_name_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed(tmp_path, monkeypatch)
    fleet = make_fleet(
        tmp_path, COUNT, law={"kind": "springs", "nearest": 6}, trigger={"kind": "impatient"},
        plan={"legs": [{"kind": "velocity", "north_m_s": 1.0, "duration_s": 10.0}], "then": "land"},
    )  # fmt: skip
    done = run("sim", "up", "--fleet", str(fleet.file), "--out", "flights", "--json", folder=tmp_path)
    summary = json.loads(done.stdout)
    recordings = sorted(flight_folder(tmp_path / "flights").glob("vehicle-*.mcap"))
    assert len(recordings) == COUNT
    for path in recordings:
        named = json.loads(read_recording(path).metadata["foreign"])
        assert [(n["kind"], n["package"], n["version"]) for n in named] == [
            ("springs", "starling-springs", "0.1.0"), ("impatient", "starling-springs", "0.1.0"),
        ]  # fmt: skip
        assert len({n["source"] for n in named}) == 1
    assert replay_file(recordings[0]).same
    if summary["reference_lateness_ms"]["max"] > STALL_MS:
        pytest.skip(f"this machine stalled for {summary['reference_lateness_ms']['max']:.0f} ms: no flight to judge")
    assert [c for c in summary["criteria"] if not c["met"]] == [], done.stderr
    assert done.returncode == 0
    assert summary["minimum_distance_m"] >= 1.2


def test_a_foreign_law_flies_a_study_beside_ours_and_its_results_name_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("numba")
    pytest.importorskip("matplotlib")
    installed(tmp_path, monkeypatch)
    shipped = (Path(study.__file__).parent / "table3.toml").read_text(encoding="utf-8")
    (tmp_path / "mine.toml").write_text(shipped + SPRINGS_CASE, encoding="utf-8")
    asked = ("table3", "--setup", "mine.toml", "--seeds", "3", "--out", "out")
    done = run("sim", "study", *asked, folder=tmp_path, timeout_s=COMPILES_S)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "out" / "table3.json").read_text(encoding="utf-8"))
    assert [(o["kind"], o["package"], o["version"]) for o in found["foreign"]] == [
        ("springs", "starling-springs", "0.1.0")
    ]
    rows = {r["method"]: r for r in found["rows"]}
    springs, still = rows["springs"], rows["switching (paper), literal"]
    assert 6 <= springs["triggers"] < 0.1 * rows["periodic, true 20 Hz"]["triggers"]
    assert springs["formation_rmse_m"] < 0.1 * still["formation_rmse_m"]
    assert springs["speed_end_m_s"] > 0.9, "and it flies on"
