"""The table of failsafes: that of the docs is the one that the flight acts by."""

from pathlib import Path

from companion.core.failsafe import FAILSAFES, Failsafe, table

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "failsafes.md"


def test_the_table_has_a_row_for_everything_that_may_fail() -> None:
    assert set(FAILSAFES) == set(Failsafe)


def test_the_table_in_the_docs_is_the_flights_own() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    shown = "".join(line + "\n" for line in text.splitlines() if line.startswith("|"))
    assert shown == table(), "regenerate it with the command that the document names"
