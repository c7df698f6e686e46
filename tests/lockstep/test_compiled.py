"""The compiled copy of what flies in lockstep: the same flights as the sources give."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from companion.errors import CompanionError
from sim.lockstep.compiled import MODULES, ROOT, build

SEEDS = ("0", "1", "1001")


def flown(root: Path) -> str:
    command = [sys.executable, "-m", "sim.study.campaign", *SEEDS]
    done = subprocess.run(
        command, cwd=root, env={**os.environ, "PYTHONPATH": str(root)}, capture_output=True, text=True, check=True
    )
    return done.stdout


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_a_compiled_flight_is_the_same_to_the_last_digit_and_note(tmp_path: Path) -> None:
    build(tmp_path / "compiled")
    assert flown(tmp_path / "compiled") == flown(ROOT)


def test_every_module_that_is_to_be_compiled_is_there() -> None:
    assert [module for module in MODULES if not (ROOT / module).is_file()] == []


def test_a_compiled_copy_is_made_in_a_new_folder_alone(tmp_path: Path) -> None:
    with pytest.raises(CompanionError, match="exists already; name a new folder"):
        build(tmp_path)
