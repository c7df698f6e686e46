"""README, docs and docstrings name nothing that is not there: files, modules, what they hold, keys of fleet.toml."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
PAGES = [p for p in PAGES if p.name != "CHANGELOG.md"]
SOURCES = sorted(p for folder in ("companion", "sim", "tests", "examples") for p in (ROOT / folder).rglob("*.py"))
FILE = re.compile(r"(?<![\w/.-])(?:companion|sim|tests|docs|examples)/[\w./-]*\w\.(?:py|md|toml|json|mcap)\b")
MODULE = re.compile(r"(?<![\w./-])(?:companion|sim|core)(?:\.[a-z_]\w*)+(?:\.[A-Z]\w*)?\b(?!/)")
CODE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
FOREIGN = frozenset({"lsusb", "ptp4l", "phc2sys", "journald", "cmdline"})
"""programs and files of the operating system"""
IDENTIFIER = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*(?:\(\))?")


def texts(path: Path) -> Iterator[str]:
    """What is for people in a file: a page as a whole, of a source every docstring and comment."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        yield text
        return
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.value.value
    yield from re.findall(r"(?m)^\s*# (.*)$", text)


@cache
def words_of_the_code() -> frozenset[str]:
    """Every identifier and every word of a string in the packages and their tests, docstrings left out."""
    found: set[str] = set()
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            match node:
                case ast.Name(id=name) | ast.Attribute(attr=name) | ast.arg(arg=name) | ast.alias(name=name):
                    found.update(name.split("."))
                case ast.FunctionDef(name=name) | ast.ClassDef(name=name) | ast.AsyncFunctionDef(name=name):
                    found.add(name)
                case ast.keyword(arg=str(name)):
                    found.add(name)
                case ast.Constant(value=str(text)) if len(text) < 200:
                    found.update(re.findall(r"[A-Za-z_]\w*", text))
                case _:
                    pass
        found.add(path.stem)
    for file in [*ROOT.glob("*.toml"), *(ROOT / "sim").rglob("*.toml"), *(ROOT / "examples").rglob("*.toml")]:
        found.update(re.findall(r"[A-Za-z_]\w*", file.read_text(encoding="utf-8")))
    return frozenset(found)


def missing_module(name: str) -> bool:
    """Whether a dotted name leads nowhere; `core` is the companion's."""
    parts = ("companion." + name if name.startswith("core.") else name).split(".")
    for k in range(len(parts), 0, -1):
        try:
            found = import_module(".".join(parts[:k]))
        except ModuleNotFoundError:
            continue
        for part in parts[k:]:
            if not hasattr(found, part):
                return True
            found = getattr(found, part)
        return k == 1
    return True


@pytest.mark.parametrize("path", [*PAGES, *SOURCES], ids=lambda p: str(p.relative_to(ROOT)))
def test_what_is_named_is_there(path: Path) -> None:
    gone = []
    for text in texts(path):
        gone += [name for name in FILE.findall(text) if "NAME" not in name and not (ROOT / name).exists()]
        quoted = CODE.findall(re.sub(r"(?ms)^```.*?^```", "", text))
        for code in quoted:
            gone += [name for name in MODULE.findall(code) if missing_module(name)]
            ours = IDENTIFIER.fullmatch(code) and not code.endswith((".txt", ".conf")) and not MODULE.fullmatch(code)
            if ours:
                words = {w for w in re.findall(r"\w+", code) if not w.isupper()}
                gone += sorted(words - words_of_the_code() - FOREIGN)
    assert not gone


def test_a_name_that_is_gone_is_found() -> None:
    assert missing_module("companion.core.no_such_module")
    assert missing_module("core.trajectory.NoSuchClass")
    assert not missing_module("core.trajectory.fleet.FleetTrajectory")
    assert "no_such_word_anywhere_" + "else" not in words_of_the_code()
