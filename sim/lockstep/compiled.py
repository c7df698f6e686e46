"""A compiled copy of what flies in lockstep, for hundreds of flights: `python -m sim.lockstep.compiled FOLDER`.

mypyc makes C of the typed sources as they are: a flight is the same to the last bit and takes about half of the time.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from companion.errors import CompanionError

ROOT = Path(__file__).parents[2]
PACKAGES = ("companion", "sim")
MODULES = (
    *(f"sim/lockstep/{name}.py" for name in ("bound_count", "clockwork", "lockstep", "network")),
    *(f"sim/autopilot/{name}.py" for name in (
        "autopilot", "commander", "disturbances", "dynamics", "dynamics_parameters", "estimator", "events",
        "flight", "lasting_faults", "link", "navigator", "offboard", "parameters", "services", "setpoint", "telemetry",
        "truth",
    )),
    *(f"companion/core/{name}.py" for name in (
        "estimate", "frames", "law/base", "law/starling", "prediction", "safety/avoidance",
        "safety/filter", "trigger/base", "trigger/error", "trigger/periodic", "trigger/switching", "values", "vectors",
    )),
    *(
        path.relative_to(ROOT).as_posix()
        for package in ("neighbours", "trajectory")
        for path in sorted((ROOT / "companion" / "core" / package).glob("*.py"))
    ),
)  # fmt: skip
"""what costs most of a flight, and what those build on; the rest is interpreted as ever"""


def build(folder: Path) -> None:
    """Copy the packages to `folder` and compile there; CompanionError with the compiler's last words if it fails."""
    if folder.exists():
        raise CompanionError(f"{folder}: exists already; name a new folder")
    for package in PACKAGES:
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("pyproject.toml", "fleet.toml"):
        shutil.copy(ROOT / file, folder)
    quick = {"MYPYC_OPT_LEVEL": "1", "MYPYC_DEBUG_LEVEL": "0"}
    made = subprocess.run(
        [sys.executable, "-c", "from mypyc.__main__ import main; main()", "--strict", *MODULES],
        cwd=folder, env={**os.environ, **quick}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if made.returncode != 0:
        raise CompanionError(f"mypyc failed: {(made.stdout + made.stderr)[-2000:]}")
    shutil.rmtree(folder / "build")


if __name__ == "__main__":
    build(Path(sys.argv[1]).resolve())
