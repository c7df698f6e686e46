"""The real PX4 against the table of answers that the stand-in is held against too."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from answers import IN_THE_AIR, ON_THE_GROUND, mismatches
from real_flight import RealFlight


@pytest.fixture
def flight(build: Path, tmp_path: Path) -> Iterator[RealFlight]:
    flight = RealFlight(build, tmp_path / "px4", {"SDLOG_MODE": -1})
    try:
        flight.boot()
        yield flight
    finally:
        flight.close()


def test_px4_answers_as_the_table_says(flight: RealFlight) -> None:
    version = flight.version()
    wrong = [line for row in (*ON_THE_GROUND, *IN_THE_AIR) for line in mismatches(flight, row, version)]
    assert wrong == []
