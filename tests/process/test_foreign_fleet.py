"""Ten stubs flown by a law of another package: real processes, and not one change in the product."""

import json
import os
from pathlib import Path

import pytest
from fleet_process import flight_folder, make_fleet, run
from foreign import EXAMPLE, install

from companion.io.recording import read_recording
from companion.io.replay import replay_file

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]

COUNT = 10
STALL_MS = 300.0


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
