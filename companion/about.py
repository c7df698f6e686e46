"""What both commands say of themselves: `--version`, and how they ask for help."""

import platform
import re
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from typing import Annotated, Any, Final

import typer

from companion.terminal import tell

PACKAGE: Final = "starling-fleet"
COMMAND: Final[dict[str, Any]] = {
    "no_args_is_help": True,
    "pretty_exceptions_enable": False,
    "context_settings": {"help_option_names": ["-h", "--help"]},
}
"""settings of a command's top level"""
_EXTRAS = re.compile(r"""extra\s*==\s*["'](\w+)["']""")
_FLOWN = frozenset({"replay", "sim", "study"})
"""extras that fly or study: the tools of tests are none of a flight's versions"""


def versions() -> dict[str, str]:
    """The package's version, Python's, and that of each library of it that is installed."""
    return {PACKAGE: version(PACKAGE), "python": platform.python_version(), **dict(sorted(_libraries()))}


def _libraries() -> Iterator[tuple[str, str]]:
    for requirement in requires(PACKAGE) or ():
        extra = _EXTRAS.search(requirement)
        name = re.split(r"[^\w.-]", requirement, maxsplit=1)[0]
        if name == PACKAGE or (extra is not None and extra[1] not in _FLOWN):
            continue
        try:
            yield name, version(name)
        except PackageNotFoundError:
            continue  # of an extra that is not installed


def _show(asked: bool) -> None:
    if asked:
        for name, number in versions().items():
            tell(f"{name} {number}")
        raise typer.Exit


def with_version(
    show: Annotated[
        bool, typer.Option("--version", callback=_show, is_eager=True, help="Versions of this, Python and libraries.")
    ] = False,
) -> None:
    """The callback of a command's top level."""
