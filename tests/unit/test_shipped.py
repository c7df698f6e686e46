"""Files that come with the package: found in a checkout and in an installed wheel, written where they are asked for."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from companion.config import load
from companion.errors import ConfigError
from companion.shipped import FLEET_FILE, SERVICE_FILE, write_shipped

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / FLEET_FILE).read_text(encoding="utf-8")


def test_what_is_written_is_what_is_shipped(tmp_path: Path) -> None:
    written = write_shipped(tmp_path, TEXT)
    assert [p.name for p in written] == [FLEET_FILE, SERVICE_FILE]
    assert (tmp_path / FLEET_FILE).read_bytes() == (ROOT / "fleet.toml").read_bytes()
    assert (tmp_path / SERVICE_FILE).read_bytes() == (ROOT / "deploy" / SERVICE_FILE).read_bytes()


def test_nothing_is_overwritten_and_then_nothing_is_written(tmp_path: Path) -> None:
    mine = tmp_path / SERVICE_FILE
    mine.write_text("mine")
    with pytest.raises(ConfigError, match="is there already"):
        write_shipped(tmp_path, TEXT)
    assert mine.read_text() == "mine"
    assert not (tmp_path / FLEET_FILE).exists()


def test_a_folder_is_made_and_a_file_in_its_place_is_refused(tmp_path: Path) -> None:
    assert [p.exists() for p in write_shipped(tmp_path / "new" / "fleet", TEXT)] == [True, True]
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(ConfigError, match=r"taken: cannot be written: File exists"):
        write_shipped(tmp_path / "taken", TEXT)


def test_a_built_wheel_brings_its_files_and_reads_them(tmp_path: Path) -> None:
    pip = (sys.executable, "-m", "pip", "-q")
    source = tmp_path / "source"
    source.mkdir()
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=False)
    if tracked.returncode != 0:
        pytest.skip("no git here: which files belong to the sources is not known")
    for name in filter(None, tracked.stdout.decode().split("\0")):
        if (ROOT / name).is_file() and not name.startswith("tests/"):
            target = source / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes((ROOT / name).read_bytes())
    built = subprocess.run(
        [*pip, "wheel", "--no-deps", "--no-build-isolation", "--no-index", "-w", str(tmp_path / "wheel"), str(source)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert built.returncode == 0, built.stdout + built.stderr
    (wheel,) = (tmp_path / "wheel").glob("*.whl")
    site = tmp_path / "site"
    subprocess.run([*pip, "install", "--no-deps", "--no-index", "--target", str(site), str(wheel)], check=True)
    work = tmp_path / "work"
    work.mkdir()
    done = subprocess.run(
        [sys.executable, "-P", "-m", "companion", "operator", "init"],
        cwd=work, env={**os.environ, "PYTHONPATH": str(site)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert load(work / FLEET_FILE).shared_hash == load(ROOT / "fleet.toml").shared_hash
