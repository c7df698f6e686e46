"""Phases: every pair of phase and event, against a table written from the description of a flight.

A flight goes idle, armed, climbing, forming, formed, landing, landed. Disarming ends it wherever it is; landing may be
asked of every vehicle that is armed and ours; a takeover releases every vehicle that is armed, and nothing but its
disarming takes it back from there.
"""

import pytest

from companion.core.phase import TRANSITIONS, PhaseEvent, next_phase
from companion.core.values import FILTERED_PHASES, Phase

# One row for each phase: what follows in it on each event; a dash leaves it as it is.
EXPECTED = """
            ARMED  TAKING_OFF  ENGAGED  SETTLED  UNSETTLED  LAND     DISARMED  TAKEN_OVER  TAKE_OFF
IDLE        ARMED  -           -        -        -          -        -         -           -
ARMED       -      CLIMBING    -        -        -          LANDING  IDLE      RELEASED    -
CLIMBING    -      -           FORMING  -        -          LANDING  LANDED    RELEASED    -
FORMING     -      -           -        FORMED   -          LANDING  LANDED    RELEASED    -
FORMED      -      -           -        -        FORMING    LANDING  LANDED    RELEASED    -
LANDING     -      -           -        -        -          -        LANDED    RELEASED    -
LANDED      -      -           -        -        -          -        -         -           IDLE
RELEASED    -      -           -        -        -          -        LANDED    -           -
"""


def expected_rows() -> list[tuple[Phase, PhaseEvent, Phase]]:
    header, *lines = EXPECTED.strip().splitlines()
    events = [PhaseEvent[name] for name in header.split()]
    rows = []
    for line in lines:
        name, *cells = line.split()
        assert len(cells) == len(events)
        for event, cell in zip(events, cells, strict=True):
            rows.append((Phase[name], event, Phase[name] if cell == "-" else Phase[cell]))
    return rows


ROWS = expected_rows()


def test_the_table_names_every_pair_once() -> None:
    assert sorted((p, e.name) for p, e, _ in ROWS) == sorted((p, e.name) for p in Phase for e in PhaseEvent)


@pytest.mark.parametrize(("phase", "event", "after"), ROWS, ids=lambda x: x.name)
def test_phase_after_event(phase: Phase, event: PhaseEvent, after: Phase) -> None:
    assert next_phase(phase, event) is after


def test_no_entry_of_the_table_leads_back_to_where_it_starts() -> None:
    assert all(before is not after for (before, _), after in TRANSITIONS.items())


def test_a_released_vehicle_is_steered_again_only_after_it_was_disarmed() -> None:
    reachable = {Phase.RELEASED}
    for _ in Phase:
        reachable |= {next_phase(p, e) for p in reachable for e in PhaseEvent if e is not PhaseEvent.DISARMED}
    assert reachable == {Phase.RELEASED}


@pytest.mark.parametrize("phase", [p for p in Phase if p not in (Phase.IDLE, Phase.LANDED)])
def test_every_phase_of_a_flight_ends_landed_or_idle(phase: Phase) -> None:
    assert next_phase(phase, PhaseEvent.DISARMED) in (Phase.LANDED, Phase.IDLE)


def test_only_phases_in_formation_have_an_active_filter() -> None:
    assert {Phase.FORMING, Phase.FORMED} == FILTERED_PHASES
