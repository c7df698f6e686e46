"""The stand-in, as every version that it plays, against the table of answers that a real PX4 is held against too."""

import pytest
from answers import IN_THE_AIR, ON_THE_GROUND, mismatches
from autopilot_flight import Flight

from companion.vehicle.autopilot.px4_versions import VERSIONS, Px4Version


@pytest.mark.parametrize("version", VERSIONS, ids=lambda v: v.name)
def test_the_stand_in_answers_as_px4_does(version: Px4Version) -> None:
    """Row after row in one flight, as the real one is asked."""
    flight = Flight(px4=version.name)
    flight.run(5.0)
    assert [line for row in (*ON_THE_GROUND, *IN_THE_AIR) for line in mismatches(flight, row, version)] == []


def test_an_answer_that_is_another_versions_is_found_and_named() -> None:
    old, new = VERSIONS[0], VERSIONS[-1]
    flight = Flight(px4=new.name)
    flight.run(5.0)
    wrong = [line for row in ON_THE_GROUND for line in mismatches(flight, row, old)]
    assert any(line.startswith("landed: an unknown main mode: result 1, expected 0") for line in wrong)
