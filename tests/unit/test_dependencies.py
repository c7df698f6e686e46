"""What a package imports it declares: what only comes along with something else is missing where that one is not."""

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
OURS = frozenset({"companion", "sim"})


def names(requirements: list[str]) -> set[str]:
    """Distributions, without versions; an extra of our own stands for what it brings."""
    found: set[str] = set()
    for requirement in requirements:
        own = re.fullmatch(r"starling-fleet\[(\w+)\]", requirement)
        found |= names(EXTRAS[own[1]]) if own else {normal(re.split(r"[<>=!~ \[;]", requirement)[0])}
    return found


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def imported(folder: Path, but: frozenset[str] = frozenset()) -> dict[str, str]:
    """Top-level names of what is neither ours nor Python's own, and a file, not among `but`, that imports each."""
    found: dict[str, str] = {}
    for path in sorted(p for p in folder.rglob("*.py") if p.name not in but):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            modules: list[str] = []
            if isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module is not None:
                modules = [node.module]
            for module in modules:
                found.setdefault(module.split(".", maxsplit=1)[0], str(path.relative_to(ROOT)))
    return {n: where for n, where in found.items() if n not in OURS and n not in sys.stdlib_module_names}


def undeclared(folder: Path, declared: set[str], but: frozenset[str] = frozenset()) -> list[str]:
    distributions = packages_distributions()
    return [
        f"{where} imports {name}"
        for name, where in imported(folder, but).items()
        if not {normal(d) for d in distributions.get(name, [name])} & declared
    ]


FLIGHT = names(PROJECT["dependencies"])


@pytest.mark.parametrize(
    ("folder", "declared"),
    [
        ("companion", FLIGHT | names(EXTRAS["replay"])),
        ("sim/autopilot", FLIGHT | names(EXTRAS["sim"])),
        ("sim/launch", FLIGHT | names(EXTRAS["sim"])),
        ("sim/lockstep", FLIGHT | names(EXTRAS["study"])),
        ("sim", FLIGHT | names(EXTRAS["study"])),
        ("tests", FLIGHT | names(EXTRAS["test"]) | names(EXTRAS["mutation"])),
    ],
)
def test_what_is_imported_is_declared(folder: str, declared: set[str]) -> None:
    local = {p.stem for p in (ROOT / folder).rglob("*.py")} if folder == "tests" else set()
    gone = undeclared(ROOT / folder, declared)
    assert [x for x in gone if x.rsplit(" ", 1)[1] not in local | {"tests", "flights", "starling_springs"}] == []


def test_what_flies_needs_no_extra() -> None:
    """Recordings are read on the ground: the one module that reads them has an extra of its own."""
    assert undeclared(ROOT / "companion", FLIGHT, but=frozenset({"recording.py"})) == []
    assert undeclared(ROOT / "companion", FLIGHT) == ["companion/io/recording.py imports mcap"]


def test_what_only_comes_along_with_something_else_is_found() -> None:
    assert undeclared(ROOT / "companion", FLIGHT - {"pydantic"})
