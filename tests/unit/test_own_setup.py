"""A user's own copy of a study's set-up: what is missing, unknown or unfit is the file's fault, and is said so."""

from pathlib import Path

import pytest

import sim.study
from companion.errors import ConfigError
from sim.study.common import load_config
from sim.study.own_setup import flown_as, same_tables
from sim.study.run import study

SHIPPED = Path(sim.study.__file__).parent
ORIGINAL = {"base": {"n": 1}, "cases": {}, "seeds": [1]}


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.toml")), ids=lambda p: p.stem)
def test_an_unchanged_copy_is_a_set_up(path: Path, tmp_path: Path) -> None:
    copy = tmp_path / "mine.toml"
    copy.write_bytes(path.read_bytes())
    config = load_config(path.stem, copy)
    assert config.values == load_config(path.stem).values
    assert config.where == str(copy)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (
            {"base": {}, "cases": {}},
            r"mine.toml: is no set-up of the study pareto: \$.seeds is missing; its tables are ",
        ),
        ({**ORIGINAL, "more": 1}, r"\$.more is not known; its tables are base, cases, seeds"),
        ({**ORIGINAL, "base": 3}, r"\$.base must be a table, got 3"),
        ({**ORIGINAL, "seeds": {}}, r"\$.seeds must be a list, got \{\}"),
        ({}, r"\$.base is missing, \$.cases is missing, \$.seeds is missing"),
    ],
)
def test_other_tables_are_named(values: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        same_tables(values, ORIGINAL, Path("mine.toml"), Path("pareto.toml"))


def test_what_a_study_cannot_make_of_it_names_the_file(tmp_path: Path) -> None:
    mine = tmp_path / "mine.toml"
    text = (SHIPPED / "table3.toml").read_text()
    assert '"ours: flown law"' in text
    mine.write_text(text.replace('"ours: flown law"', '"mine"'))
    with pytest.raises(
        ConfigError, match=r"mine.toml: cannot be flown as a set-up of table3: 'ours: flown law' is missi"
    ):
        study("table3", "0", tmp_path / "out", setup=mine)


def test_a_fault_of_the_shipped_one_is_ours_and_is_not_hidden() -> None:
    with pytest.raises(KeyError), flown_as(None, "table3"):
        raise KeyError("base")
    said = r"mine.toml: cannot be flown as a set-up of table3: 'base' is missing"
    with pytest.raises(ConfigError, match=said), flown_as(Path("mine.toml"), "table3"):
        raise KeyError("base")
