"""The list of mutants that may survive speaks of the source as it is; that they do is for tests/mutation/run.py."""

import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SOURCE = " ".join(
    " ".join(
        (ROOT / "companion" / "core" / name).read_text(encoding="utf-8")
        for name in ("safety/filter.py", "safety/avoidance.py", "safety/program.py", "trigger/near.py", "phase.py")
    ).split()
)
GROUPS = tomllib.loads((ROOT / "tests" / "mutation" / "survivors.toml").read_text(encoding="utf-8"))["group"]


@pytest.mark.parametrize("mutant", [x for group in GROUPS for x in group["mutants"]])
def test_what_an_explained_mutant_changes_is_in_the_source(mutant: str) -> None:
    _, change = mutant.split(": ", 1)
    before, after = change.rsplit(" -> ", 1)
    assert before != after
    assert " ".join(before.split()) in SOURCE


def test_every_explained_mutant_has_one_reason() -> None:
    mutants = [x for group in GROUPS for x in group["mutants"]]
    assert len(set(mutants)) == len(mutants)
    assert all(group["why"].endswith(".") for group in GROUPS)
