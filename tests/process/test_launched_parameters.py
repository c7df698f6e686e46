"""Nobody takes off before the parameters that the launcher sets are read back as set."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from fake_px4 import fake_build
from fleet_process import flight_folder, run

from companion.io.recording import read_recording
from companion.vehicle.autopilot.px4_versions import OLDEST, VERSIONS
from sim.autopilot.stubs import TRUTH_DTYPE

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]


def fly(folder: Path, *more: str, version: str = OLDEST.name) -> Any:
    """`fleet up` on one stand-in for PX4, on PX4's own ports."""
    tables = {
        "fleet": {"name": f"launched-{os.getpid()}-{folder.name[-1]}", "origin": {
            "latitude_deg": 47.397742, "longitude_deg": 8.545594, "altitude_amsl_m": 488.0,
        }},
        "formation": {"shape": "v", "altitude_m": 2.0},
        "plan": {"legs": [], "then": "land"},
        "vehicle": [{"id": 1}],
    }  # fmt: skip
    file = folder / "fleet.toml"
    file.write_text(tomli_w.dumps(tables))
    build = fake_build(folder / "build", version)
    return run(
        "sim", "up", "--fleet", str(file), "--out", str(folder / "flights"), "--autopilot", "px4", "--px4", str(build),
        "--json", *more, folder=folder,
    )  # fmt: skip


def armed(folder: Path) -> bool:
    rows = np.fromfile(flight_folder(folder / "flights") / "truth.bin", TRUTH_DTYPE)
    assert len(rows) > 100
    return bool(rows["armed"].any())


def commands(folder: Path) -> list[str]:
    entries = read_recording(flight_folder(folder / "flights") / "vehicle-1.mcap").entries
    return [json.loads(e.body)["verb"] for e in entries if e.channel == "input/command"]


def test_a_parameter_that_px4_does_not_have_ends_the_start_on_the_ground(tmp_path: Path) -> None:
    done = fly(tmp_path, "--parameter", "NO_SUCH=3")
    assert done.returncode == 1
    assert "NO_SUCH" in done.stderr
    assert "autopilots ended before take-off" in done.stderr
    assert commands(tmp_path) == []
    assert not armed(tmp_path)


@pytest.mark.parametrize("version", [v.name for v in VERSIONS])
def test_whichever_name_of_a_setting_this_px4_has_is_read_back_and_then_it_takes_off(
    tmp_path: Path, version: str
) -> None:
    done = fly(tmp_path, "--for", "6", "--parameter", "COM_OF_LOSS_T=0.9", version=version)
    assert commands(tmp_path)[0] == "takeoff", done.stderr
    assert armed(tmp_path)
