"""The lock on a fleet's name: one launcher a machine, and no file that is left behind locks anybody out."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from companion.errors import CompanionError
from sim.launch.lock import only_flight


def test_a_second_launcher_of_a_name_is_refused_with_what_to_do(tmp_path: Path) -> None:
    with (
        only_flight("kestrel", tmp_path),
        pytest.raises(CompanionError, match=r"'kestrel' is flown on this machine already .*another fleet.name"),
        only_flight("kestrel", tmp_path),
    ):
        pass


def test_another_name_and_the_same_name_afterwards_are_free(tmp_path: Path) -> None:
    for _ in range(2):
        with only_flight("kestrel", tmp_path), only_flight("merlin", tmp_path):
            pass


def test_a_killed_launcher_leaves_a_file_and_no_lock(tmp_path: Path) -> None:
    code = (
        "import os, pathlib, signal, sys; from sim.launch.lock import only_flight\n"
        "with only_flight('kestrel', pathlib.Path(sys.argv[1])): os.kill(os.getpid(), signal.SIGKILL)"
    )
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False).returncode == -9
    assert [f.name for f in tmp_path.iterdir()] == ["starling-fleet-kestrel.lock"]
    with only_flight("kestrel", tmp_path):
        pass


def test_a_link_in_the_place_of_the_lock_is_not_followed(tmp_path: Path) -> None:
    os.symlink(tmp_path / "elsewhere", tmp_path / "starling-fleet-kestrel.lock")
    with pytest.raises(CompanionError, match="cannot open the lock"), only_flight("kestrel", tmp_path):
        pass
    assert not (tmp_path / "elsewhere").exists()
