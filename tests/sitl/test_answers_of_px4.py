"""The real PX4 against the table of answers that the stand-in is held against too."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from answers import IN_THE_AIR, ON_THE_GROUND, mismatches
from real_flight import RealFlight

from sim.launch.px4_build import build_version, sitl_parameters


@pytest.fixture
def flight(build: Path, tmp_path: Path) -> Iterator[RealFlight]:
    no_log = {name: value for name, value in sitl_parameters(build).items() if name.startswith("SDLOG")}
    flight = RealFlight(build, tmp_path / "px4", no_log)
    try:
        flight.boot()
        yield flight
    finally:
        flight.close()


def test_px4_answers_as_the_table_says(flight: RealFlight, build: Path) -> None:
    version = build_version(build)
    wrong = [line for row in (*ON_THE_GROUND, *IN_THE_AIR) for line in mismatches(flight, row, version)]
    assert wrong == []
