"""The stand-in against the table of answers that a real PX4 is held against too."""

import pytest
from answers import IN_THE_AIR, ON_THE_GROUND, Answer, mismatches
from autopilot_flight import Flight

from companion.vehicle.autopilot.px4_versions import VERSIONS, Px4Version


@pytest.mark.parametrize("version", VERSIONS, ids=lambda v: v.name)
@pytest.mark.parametrize("row", [*ON_THE_GROUND, *IN_THE_AIR], ids=lambda row: f"{row.when}: {row.what}")
def test_the_stand_in_answers_as_px4_does(row: Answer, version: Px4Version) -> None:
    flight = Flight(px4=version.name)
    flight.run(5.0)
    assert mismatches(flight, row, version) == []
