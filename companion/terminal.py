"""The one door to a terminal: whatever is shown there has printable characters alone, and an end.

Texts come from vehicles, autopilots and files. A terminal obeys control characters: one that is printed as it came
clears the screen, or writes a line that nobody has said.
"""

import io
import sys
from typing import Final

TEXT_MAX: Final = 1000
"""characters of a text that somebody else has said"""
LINE_MAX: Final = 65_536
"""characters of a line of ours, which may have such a text of each vehicle in it"""


def one_line(said: str, most: int = TEXT_MAX) -> str:
    """A text on one line: no control characters, none that change the direction of writing, cut at `most`."""
    # So much is looked at, however long it is: twice, as spaces may fall away.
    kept = said[: 2 * most]
    plain = " ".join(_without_controls(kept).split())
    return plain if len(plain) <= most and len(kept) == len(said) else f"{plain[: most - 1]}…"


def printable(said: str) -> str:
    """The same of each line: whoever makes a text of several lines quotes others by `one_line`."""
    return "\n".join(_without_controls(line[:LINE_MAX]) for line in said.split("\n"))


def _without_controls(said: str) -> str:
    return "".join(c if c.isprintable() else " " for c in said)


def tell(said: str, *, error: bool = False) -> None:
    """Show a text of ours, which may quote others."""
    stream = sys.stderr if error else sys.stdout
    stream.write(f"{printable(said)}\n")
    stream.flush()


def tolerate_any_encoding() -> None:
    """A character that the terminal's encoding lacks is shown by its number, and ends no command."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
