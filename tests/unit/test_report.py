"""A flight's page: whole, small, from one file, and nothing in it that somebody else has written as markup."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.errors import CompanionError
from sim.launch.summary.flight import Flight
from sim.launch.summary.recorded import recorded_flight
from sim.launch.summary.summarise import summarise
from sim.report.commands import draw
from sim.report.page import page, write_page
from sim.report.series import HEARTBEAT_SHARE, Pair, series_of

GOLDEN = Path(__file__).resolve().parents[1] / "golden" / "px4_flight.mcap"
BYTES_MAX = 5_000_000
VOID = {"meta"}


class Tags(HTMLParser):
    """Counts what a page opens and loads, and whether it closes it."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[str] = []
        self.loads: list[str] = []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.seen.append(tag)
        self.loads += [v or "" for k, v in attributes if k in ("src", "href", "xlink:href", "data", "action")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attributes)
        self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def flown() -> tuple[Flight, dict[str, Any]]:
    flight, missing = recorded_flight([GOLDEN])
    return flight, {**summarise(flight), "missing": missing, "rejected": None}


def read(text: str) -> Tags:
    tags = Tags()
    tags.feed(text)
    return tags


def test_a_page_is_whole_small_and_loads_nothing(flown: tuple[Flight, dict[str, Any]]) -> None:
    text = page(*flown)
    tags = read(text)
    assert tags.open == []
    assert len(text.encode()) < BYTES_MAX
    assert all(target.startswith("#") for target in tags.loads)
    assert "script" not in tags.seen
    assert not re.search(r"@import|url\((?!#)", text)
    assert tags.seen.count("svg") == 6  # of one vehicle there are no distances, and no graph


def test_what_vehicles_and_operators_said_is_no_markup(flown: tuple[Flight, dict[str, Any]]) -> None:
    flight, figures = flown
    hostile = "<script>alert(1)</script><img src=x onerror=alert(1)>"
    said = {
        **figures,
        "failsafes": [hostile],
        "lost": [hostile],
        "unrecorded": {1: hostile},
        "killed": {1: hostile},
        "versions": {hostile: hostile},
        "criteria": [{"what": hostile, "value": hostile, "limit": hostile, "met": False}],
    }
    tags = read(page(flight, said))
    assert "script" not in tags.seen
    assert "img" not in tags.seen


def test_a_page_says_whether_the_flight_passed(flown: tuple[Flight, dict[str, Any]]) -> None:
    flight, figures = flown
    for passed, word in ((True, "passed"), (False, "not passed")):
        assert f">{word}</span></h1>" in page(flight, {**figures, "passed": passed})


def test_a_place_that_cannot_be_written_is_told(flown: tuple[Flight, dict[str, Any]], tmp_path: Path) -> None:
    with pytest.raises(CompanionError, match=r"cannot write .*none/page\.html: No such file"):
        write_page(*flown, tmp_path / "none" / "page.html")


def test_messages_are_told_apart_by_the_silence_before_them(flown: tuple[Flight, dict[str, Any]]) -> None:
    flight, _ = flown
    series = series_of(flight)
    assert not series.true
    (times,), (silent,) = series.messages_s.values(), series.after_silence.values()
    assert len(times) == len(silent) > 2
    gaps = np.diff(times)
    assert (silent[1:] == (gaps >= HEARTBEAT_SHARE * flight.config.trigger.t_max_s)).all()
    assert silent.any()
    assert not silent.all()


def test_a_pair_that_never_was_known_is_the_last_of_the_closest() -> None:
    assert Pair((1, 2), np.array([np.nan, 3.0, 2.0])).least_m == 2.0
    assert Pair((1, 2), np.array([np.nan, np.nan])).least_m == np.inf
    assert Pair((1, 2), np.zeros(0)).least_m == np.inf


@pytest.mark.parametrize("figures", [6, 0])
def test_a_flight_of_which_nobody_is_left_has_its_page(
    figures: int, flown: tuple[Flight, dict[str, Any]], tmp_path: Path
) -> None:
    flight, _ = flown
    ticks = flight.ticks if figures else {i: rows[:0] for i, rows in flight.ticks.items()}
    lost = replace(flight, lost=frozenset(flight.ticks), ticks=ticks)
    text = page(lost, {**summarise(lost), "missing": {}, "rejected": None})
    assert ">not passed</span></h1>" in text
    assert read(text).seen.count("svg") == figures


def test_a_flight_that_cannot_be_drawn_is_told_and_is_no_fault_of_the_flight(
    flown: tuple[Flight, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    draw(*flown, tmp_path / "none")
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == f"no report: cannot write {tmp_path}/none/report.html: No such file or directory\n"
    draw(*flown, tmp_path)
    assert capsys.readouterr().out == f"report: {tmp_path}/report.html\n"
