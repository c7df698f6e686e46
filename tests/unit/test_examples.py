"""Every fleet file that is shipped or shown flies, on the network that it names and rehearsed on one computer."""

import re
from pathlib import Path

import pytest

from companion.config.checks import refuse_shared_lines
from companion.config.file import load, parse, read_tables
from companion.config.overrides import on_this_computer

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted(ROOT.glob("examples/**/fleet.toml"))


def test_there_are_examples() -> None:
    assert FILES


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.parent.name)
def test_an_example_is_fit_for_its_vehicles_and_for_a_rehearsal(path: Path) -> None:
    config = load(path)
    tables = read_tables(path, on_this_computer)
    refuse_shared_lines(parse(tables, path.name))
    assert len({v.zenoh for v in config.vehicles}) == len(config.vehicles)


def test_the_table_of_a_vehicle_that_the_docs_show_is_the_examples(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "companion-computer.md").read_text(encoding="utf-8")
    shown = re.search(r"( {4}\[peers\]\n.*?)\n\n[^ ]", page, re.DOTALL)
    assert shown is not None
    lines = [line.strip() for line in shown[1].splitlines() if line.strip()]
    example = (ROOT / "examples" / "six-quads-mesh" / "fleet.toml").read_text(encoding="utf-8")
    kept = {line.partition("#")[0].strip() for line in example.splitlines()}
    assert [line for line in lines if line.partition("#")[0].strip() not in kept] == []
