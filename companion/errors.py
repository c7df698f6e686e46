"""Errors that a user can act on. Misbehaviour of peers and autopilots is counted, not raised."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar


class CompanionError(Exception):
    """Base of every error that ends a command with a sentence instead of a traceback."""

    exit_status: ClassVar[int] = 1
    """of the command that it ends"""


class ConfigError(CompanionError):
    """A value in fleet.toml or on the command line is refused; says where, what came and what is allowed."""

    exit_status = 2


class WireError(CompanionError):
    """Bytes that are not what they claim to be; `kind` is a short fixed name for counting, `detail` what came."""

    def __init__(self, kind: str, detail: str = "") -> None:
        super().__init__(f"{kind}: {detail}" if detail else kind)
        self.kind = kind
        self.detail = detail


class RefusedError(CompanionError):
    """A command was understood and refused, by whom and why."""


class MissingLibraryError(CompanionError):
    """A command needs a library of an extra that is not installed; says which to install."""

    exit_status = 2

    def __init__(self, library: str, extra: str) -> None:
        super().__init__(f"this command needs {library}, which is not installed: pip install 'starling-fleet[{extra}]'")


@contextmanager
def libraries_of(extra: str) -> Iterator[None]:
    """Whatever library of others' is missing within is said to come with this extra."""
    try:
        yield
    except ModuleNotFoundError as error:
        library = (error.name or "").split(".")[0]
        if library in ("", "companion", "sim"):
            raise
        raise MissingLibraryError(library, extra) from None
