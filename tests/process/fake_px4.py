"""A build folder whose `bin/px4` is a stub with a ground station's link: PX4's place in tests of its launcher."""

import os
import sys
from pathlib import Path

from companion.core.frames import Geodetic, Ned
from sim.autopilot.parameters import defaults
from sim.autopilot.stubs import StubFleetSettings, StubVehicleSettings, run_stubs

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).resolve().parent
VERSION = "FAKE_PX4_VERSION"
"""environment: whose parameters it has"""


def fake_build(folder: Path) -> Path:
    """A folder that passes for PX4's build/px4_sitl_default."""
    (folder / "bin").mkdir(parents=True)
    (folder / "etc").mkdir()
    program = folder / "bin" / "px4"
    program.write_text(
        f"#!{sys.executable}\nimport sys\nsys.path[:0] = {[str(ROOT), str(HERE)]!r}\n"
        "from fake_px4 import main\nmain()\n"
    )
    program.chmod(0o755)
    return folder


def main() -> None:
    """`px4 -i N -d ETC -w FOLDER`, with PX4_HOME_* and PX4_PARAM_*; parameters that there are not are passed over."""
    index = int(sys.argv[sys.argv.index("-i") + 1])
    version = os.environ.get(VERSION, "1.16")
    home = Geodetic(*(float(os.environ[f"PX4_HOME_{name}"]) for name in ("LAT", "LON", "ALT")))
    known = defaults(version)
    given = {name.removeprefix("PX4_PARAM_"): value for name, value in os.environ.items()}
    parameters = {name: type(known[name])(given[name]) for name in known if name in given}
    vehicle = StubVehicleSettings(
        index + 1, index + 1, 14580 + index, 14540 + index, Ned(0.0, 0.0, 0.0), instance=index,
        parameters=tuple(parameters.items()), px4_version=version,
    )  # fmt: skip
    run_stubs(StubFleetSettings((vehicle,), home, ground=True))
