"""A study flown by a law of another package: a real process, and not one change in the product."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from foreign import EXAMPLE, install

pytest.importorskip("numba")
pytest.importorskip("matplotlib")

from sim import study

pytestmark = pytest.mark.timeout(400)

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
COMPILES_S = 380.0
"""a study's first run after a change compiles"""


def test_a_foreign_law_flies_a_study_beside_ours_and_its_results_name_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = install(EXAMPLE, tmp_path / "site")
    paths = (str(site), os.environ.get("PYTHONPATH"))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
    shipped = (Path(study.__file__).parent / "table3.toml").read_text(encoding="utf-8")
    (tmp_path / "mine.toml").write_text(shipped + SPRINGS_CASE, encoding="utf-8")
    asked = ("table3", "--setup", "mine.toml", "--seeds", "3", "--out", "out")
    done = subprocess.run(
        [sys.executable, "-P", "-m", "sim", "study", *asked],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=COMPILES_S,
    )  # fmt: skip
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
