"""What the tools say of the source: lint, format and types, as pyproject.toml asks; the tests that the docs name."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    "command", [("ruff", "check", "."), ("ruff", "format", "--check", "."), ("mypy",)], ids=" ".join
)
def test_the_source_is_clean(command: tuple[str, ...]) -> None:
    result = subprocess.run([sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.timeout(900)
def test_what_the_ordinary_run_leaves_out_still_fits_the_product() -> None:
    """Flights on a real PX4, benches and the mutation run are checked for types: a name that is gone shows."""
    folders = ("tests/sitl", "tests/bench", "tests/mutation", "tests/golden")
    files = [str(p) for folder in folders for p in sorted((ROOT / folder).glob("*.py"))]
    flags = ("--explicit-package-bases", "--implicit-reexport", "--disable-error-code=func-returns-value")
    path = os.pathsep.join(str(ROOT / x) for x in (".", "tests/process", "tests/wire", "tests/sitl"))
    result = subprocess.run(
        [sys.executable, "-m", "mypy", *flags, *files],
        cwd=ROOT, env={**os.environ, "MYPYPATH": path}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert result.returncode == 0, result.stdout + result.stderr


def test_every_test_that_the_docs_name_exists() -> None:
    """Names in backquotes; one that ends in dots is the beginning of one."""
    docs = "\n".join(p.read_text(encoding="utf-8") for p in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))))
    code = "\n".join(p.read_text(encoding="utf-8") for p in (ROOT / "tests").rglob("*.py"))
    defined = set(re.findall(r"^ *(?:async )?(?:def )?(test_\w+)(?:\(| = )", code, re.MULTILINE))
    named = re.findall(r"`(test_\w+)(\.\.\.)?`", docs)
    files = re.findall(r"\btests/[\w/]+\.(?:py|toml)", docs)
    assert len(named) > 20
    assert len(files) > 10
    assert [n for n, dots in named if n not in defined and not (dots and any(d.startswith(n) for d in defined))] == []
    assert [f for f in files if not (ROOT / f).exists()] == []
