"""Mutants of safety filter, program, near mode and phases: each must fail a test or stand explained in survivors.toml.

mutmut changes what is inside functions; what is outside of them (constants, defaults, the table of transitions) is
changed here. All of it happens in a copy, in a temporary directory.
"""

import ast
import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Annotated, NamedTuple

import pytest
import tomli_w
import typer

ROOT = Path(__file__).resolve().parents[2]
EXPLAINED = Path(__file__).with_name("survivors.toml")
_PROGRAM, _SAFETY, _FENCE, _NEAR = (f"tests/unit/test_{x}.py" for x in ("program", "safety", "fence", "near"))
SOURCES = {
    "companion/core/safety/filter.py": (_SAFETY, _FENCE, _PROGRAM),
    "companion/core/safety/avoidance.py": (_PROGRAM, _SAFETY, _FENCE),
    "companion/core/safety/program.py": (_PROGRAM, _SAFETY, _FENCE),
    "companion/core/trigger/near.py": (_NEAR,),
    "companion/core/phase.py": ("tests/unit/test_phase.py",),
}
"""what is changed, and the tests of which one must fail then, the likeliest first"""
TESTS = tuple(dict.fromkeys(test for tests in SOURCES.values() for test in tests))
FLIGHTS = (
    "test_safety.py::test_two_sent_head_on", "test_safety.py::test_the_same_two_collide",
    "test_safety.py::test_one_avoids_alone", "test_safety.py::test_a_follower_passes",
    "test_safety.py::test_a_column_of", "test_safety.py::test_vehicles_that_change_places",
    "test_safety.py::test_a_vehicle_lifted", "test_fence.py::test_a_vehicle_at_the_speed_limit",
    "test_fence.py::test_whatever_the_limits", "test_fence.py::test_no_law_and_no_gust",
    "test_fence.py::test_a_climb_for_ever", "test_fence.py::test_a_vehicle_blown_out",
)  # fmt: skip
"""left out: they are three quarters of the tests' time, and what they show of a mutant the others must show exactly"""
PYTEST_ARGUMENTS = [
    "-p",
    "no:randomly",
    "-p",
    "no:cacheprovider",
    "-m",
    "not long",
    *(f"--deselect=tests/unit/{x}" for x in FLIGHTS),
]
CONFIGURATION = {
    "tool": {
        "mutmut": {
            "source_paths": ["companion"],
            "only_mutate": list(SOURCES),
            "also_copy": ["docs"],
            "pytest_add_cli_args": PYTEST_ARGUMENTS,
            "pytest_add_cli_args_test_selection": list(TESTS),
            "timeout_multiplier": 100.0,
            "use_git_change_detection": False,
        },
        "pytest": {"ini_options": {"addopts": "-q", "timeout": 180, "markers": ["long"]}},
    }
}
CONFTEST = """
from hypothesis import Phase, settings

# The same examples every time, and none made smaller: a failure is all that is asked for.
settings.register_profile(
    "mutation", derandomize=True, database=None, deadline=None, phases=(Phase.explicit, Phase.generate)
)
settings.load_profile("mutation")
"""


class Mutant(NamedTuple):
    """A change to a source file, by the place and the lines that differ."""

    where: str
    before: str
    after: str

    def __str__(self) -> str:
        return f"{self.where}: {self.before} -> {self.after}"


def outside_functions(source: str) -> Iterator[tuple[Mutant, str]]:
    """Each change of a constant, default or table entry, with the whole changed source; decorators stay as they are."""
    lines = source.splitlines(keepends=True)

    def changed(where: str, line: int, text: str) -> tuple[Mutant, str]:
        whole = "".join([*lines[: line - 1], text, *lines[line:]])
        return Mutant(where, lines[line - 1].strip(), text.strip()), whole

    for where, value in _values(ast.parse(source).body):
        for node in ast.walk(value):
            if isinstance(node, ast.Constant):
                for new in _others(node.value):
                    yield changed(where, node.lineno, _replaced(lines, node, repr(new)))
            elif isinstance(node, ast.Dict):
                targets = sorted({x.attr for x in node.values if isinstance(x, ast.Attribute)})
                for key, target in zip(node.keys, node.values, strict=True):
                    assert key is not None
                    assert isinstance(target, ast.Attribute)
                    yield changed(where, key.lineno, "")
                    other = targets[(targets.index(target.attr) + 1) % len(targets)]
                    yield changed(where, target.lineno, _replaced(lines, target, f"_P.{other}"))
            elif node is value and isinstance(node, ast.Tuple) and all(isinstance(x, ast.Attribute) for x in node.elts):
                for x in node.elts:
                    rest = ", ".join(ast.unparse(y) for y in node.elts if y is not x)
                    yield changed(where, node.lineno, _replaced(lines, node, f"({rest})"))


def _values(body: list[ast.stmt], owner: str = "") -> Iterator[tuple[str, ast.expr]]:
    """What is assigned in a module and its classes, and what arguments are by default, each with a name."""
    for node in body:
        if isinstance(node, ast.ClassDef):
            yield from _values(node.body, f"{node.name}.")
        elif isinstance(node, ast.FunctionDef):
            for default in (*node.args.defaults, *(x for x in node.args.kw_defaults if x is not None)):
                yield owner + node.name, default
        elif isinstance(node, ast.Assign):
            yield owner + ast.unparse(node.targets[0]), node.value
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            yield owner + ast.unparse(node.target), node.value


def _others(value: object) -> list[object]:
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [value - 1, value + 1]
    if isinstance(value, float):
        return [float(f"{0.9 * value:.9g}"), float(f"{1.1 * value:.9g}")] if value else [-1.0, 1.0]
    return [f"XX{value}XX"] if isinstance(value, str) else []


def _replaced(lines: list[str], node: ast.expr, text: str) -> str:
    line = lines[node.lineno - 1].encode()
    assert node.end_col_offset is not None
    assert node.lineno == node.end_lineno
    return (line[: node.col_offset] + text.encode() + line[node.end_col_offset :]).decode()


def run(command: list[str], directory: Path, *, show: bool = False) -> subprocess.CompletedProcess[str]:
    """A command in the copy, in a session of its own, so that none of its processes outlives an interrupt."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    environment |= {"PYTHONHASHSEED": "0", "PYTHONDONTWRITEBYTECODE": "1"}
    into = None if show else subprocess.PIPE
    process = subprocess.Popen(
        command, cwd=directory, env=environment, stdout=into, stderr=into, text=True, start_new_session=True
    )
    try:
        out, err = process.communicate()
    except BaseException:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        raise
    return subprocess.CompletedProcess(command, process.returncode, out or "", err or "")


def survivors_inside(copy: Path, jobs: int, names: list[str]) -> tuple[int, list[Mutant]]:
    """mutmut's mutants: how many, and those that no test fails on."""
    mutmut = [str(Path(sys.executable).with_name("mutmut"))]
    if run([*mutmut, "run", "--max-children", str(jobs), *names], copy, show=True).returncode != 0:
        raise typer.Exit(2)
    of = {
        name: state
        for line in run([*mutmut, "results", "--all", "true"], copy).stdout.splitlines()
        for name, state in [line.strip().split(": ")]
        if not (names and state == "not checked")
    }
    undecided = sorted(name for name, state in of.items() if state not in ("killed", "timeout", "survived"))
    if undecided:
        typer.echo("neither killed nor survived: " + ", ".join(f"{x} ({of[x]})" for x in undecided))
        raise typer.Exit(2)
    survived = []
    for name in (x for x, state in of.items() if state == "survived"):
        diff = run([*mutmut, "show", name], copy).stdout.splitlines()
        before, after = (
            " ".join(x[1:].strip() for x in diff if x[:1] == sign and x[:3] != 3 * sign) for sign in ("-", "+")
        )
        function = name.rsplit(".", 1)[1].rsplit("__mutmut_", 1)[0].removeprefix("x").strip("ǁ").removeprefix("_")
        survived.append(Mutant(function.replace("ǁ", "."), before, after))
    return len(of), survived


def passes(copy: Path, path: str) -> bool:
    """Whether the tests of a source file pass as it stands in the copy; told by a fork that has their libraries."""
    pid = os.fork()
    if pid == 0:
        os.chdir(copy)
        sys.path.insert(0, str(copy))
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(1, 2)
        os._exit(pytest.main(["-x", *PYTEST_ARGUMENTS, *SOURCES[path]]))
    try:
        return os.waitpid(pid, 0)[1] == 0
    except BaseException:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        raise


def survivors_outside(copy: Path) -> tuple[int, list[Mutant]]:
    """This file's mutants: how many, and those that no test fails on."""
    sys.dont_write_bytecode = True
    for library in ("hypothesis.strategies", "numpy", "shapely"):
        importlib.import_module(library)
    count, survived = 0, []
    for path in SOURCES:
        source = (copy / path).read_text(encoding="utf-8")
        as_it_is = passes(copy, path)
        (copy / path).write_text("raise AssertionError\n", encoding="utf-8")
        if not as_it_is or passes(copy, path):
            raise RuntimeError(f"the tests of {path} fail without a mutant, or do not read the copy")
        for mutant, text in outside_functions(source):
            (copy / path).write_text(text, encoding="utf-8")
            if passes(copy, path):
                survived.append(mutant)
                typer.echo(f"\rsurvived: {mutant}")
            count += 1
            if sys.stdout.isatty() or count % 25 == 0:
                typer.echo(f"\r{count} outside functions, {len(survived)} survived", nl=not sys.stdout.isatty())
        (copy / path).write_text(source, encoding="utf-8")
    typer.echo()
    return count, survived


def explained() -> dict[str, str]:
    """Every mutant that may survive, with its reason."""
    groups = tomllib.loads(EXPLAINED.read_text(encoding="utf-8"))["group"]
    return {mutant: group["why"] for group in groups for mutant in group["mutants"]}


def main(
    names: Annotated[list[str] | None, typer.Argument(help="mutmut's names (*on_edge*): only these.")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="mutants at a time.")] = 1,
) -> None:
    """Change the SOURCES, one place at a time, and see that a unit test fails each time.

    Exit status 0 if every mutant was killed or stands explained in survivors.toml, and everything there survived.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    began = monotonic()
    with TemporaryDirectory(prefix="mutation-") as directory:
        copy = Path(directory)
        shutil.copytree(ROOT / "companion", copy / "companion", ignore=shutil.ignore_patterns("__pycache__"))
        for file in (*TESTS, "docs/phases.md"):
            (copy / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / file, copy / file)
        (copy / "tests/conftest.py").write_text(CONFTEST, encoding="utf-8")
        (copy / "pyproject.toml").write_text(tomli_w.dumps(CONFIGURATION), encoding="utf-8")
        count, survived = (0, []) if names else survivors_outside(copy)
        inside, more = survivors_inside(copy, jobs, names or [])
    count, survived = count + inside, survived + more
    why = explained()
    unexplained = sorted({str(x) for x in survived} - set(why))
    vanished = [] if names else sorted(set(why) - {str(x) for x in survived})
    typer.echo(
        f"{count} mutants: {count - len(survived)} killed, {len(survived)} survived, "
        f"{sum(str(x) in why for x in survived)} of them explained; {(monotonic() - began) / 60:.0f} min"
    )
    for title, mutants in (("survived, not explained", unexplained), ("explained, but no longer there", vanished)):
        for x in mutants:
            typer.echo(f"{title}: {json.dumps(x, ensure_ascii=False)}")
    if unexplained or vanished:
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
