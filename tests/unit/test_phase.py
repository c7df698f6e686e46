"""Phases: every pair of phase and event, against a table written from the description of a flight.

A flight goes idle, preflight, armed, climbing, waiting, forming, formed, moving and holding, returning, landing,
landed. Disarming ends it wherever it is; landing may be asked of every vehicle that is armed and ours; a takeover
releases every vehicle that is armed, and nothing but its disarming or the operator's resume takes it back from there.
"""

from pathlib import Path

import pytest

from companion.core.phase import ABORTS, TRANSITIONS, PhaseEvent, diagram, next_phase
from companion.core.values import (
    AIRBORNE_PHASES,
    FILTERED_PHASES,
    FLYING_PHASES,
    FORMATION_PHASES,
    SETTLED_PHASES,
    Phase,
)

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "phases.md"

# One row for each phase: what follows in it on each event; what is not named leaves it as it is.
EXPECTED = {
    "IDLE": "TAKE_OFF PREFLIGHT, RESUMED DETACHED",
    "PREFLIGHT": "ARMED ARMED, GIVEN_UP IDLE, LAND IDLE, GIVEN_AWAY IDLE",
    "ARMED": "TAKING_OFF CLIMBING, LAND LANDING, DISARMED IDLE, TAKEN_OVER RELEASED, GIVEN_AWAY RELEASED",
    "CLIMBING": "ENGAGED WAITING, LAND LANDING, DISARMED LANDED, TAKEN_OVER RELEASED, GIVEN_AWAY RELEASED",
    "WAITING": "FORM FORMING, RETURN RETURNING, STRAYED DETACHED, LAND LANDING, DISARMED LANDED, TAKEN_OVER RELEASED, "
    "GIVEN_AWAY RELEASED",
    "FORMING": "SETTLED FORMED, RETURN RETURNING, STRAYED DETACHED, LAND LANDING, DISARMED LANDED, "
    "TAKEN_OVER RELEASED, GIVEN_AWAY RELEASED",
    "FORMED": "FORM FORMING, MOVE MOVING, REST HOLDING, RETURN RETURNING, STRAYED DETACHED, LAND LANDING, "
    "DISARMED LANDED, TAKEN_OVER RELEASED, GIVEN_AWAY RELEASED",
    "MOVING": "FORM FORMING, REST HOLDING, RETURN RETURNING, STRAYED DETACHED, LAND LANDING, DISARMED LANDED, "
    "TAKEN_OVER RELEASED, GIVEN_AWAY RELEASED",
    "HOLDING": "FORM FORMING, MOVE MOVING, RETURN RETURNING, STRAYED DETACHED, LAND LANDING, DISARMED LANDED, "
    "TAKEN_OVER RELEASED, GIVEN_AWAY RELEASED",
    "RETURNING": "FORM FORMING, STRAYED DETACHED, LAND LANDING, DISARMED LANDED, "
    "TAKEN_OVER RELEASED, GIVEN_AWAY RELEASED",
    "DETACHED": "REJOINED WAITING, LAND LANDING, DISARMED LANDED, TAKEN_OVER RELEASED, GIVEN_AWAY RELEASED",
    "LANDING": "DISARMED LANDED, TAKEN_OVER RELEASED, GIVEN_AWAY RELEASED",
    "LANDED": "TAKE_OFF PREFLIGHT",
    "RELEASED": "RESUMED DETACHED, DISARMED LANDED",
}


def expected(phase: Phase, event: PhaseEvent) -> Phase:
    cells = dict(cell.split() for cell in EXPECTED[phase.name].split(", "))
    return Phase[cells.get(event.name, phase.name)]


ROWS = [(p, e, expected(p, e)) for p in Phase for e in PhaseEvent]


def test_the_expected_table_names_every_phase_and_every_event() -> None:
    assert set(EXPECTED) == {p.name for p in Phase}
    named = {cell.split()[0] for row in EXPECTED.values() for cell in row.split(", ")}
    assert named == {e.name for e in PhaseEvent}


@pytest.mark.parametrize(("phase", "event", "after"), ROWS, ids=lambda x: x.name)
def test_phase_after_event(phase: Phase, event: PhaseEvent, after: Phase) -> None:
    assert next_phase(phase, event) is after


def test_no_entry_of_the_table_leads_back_to_where_it_starts() -> None:
    assert all(before is not after for (before, _), after in TRANSITIONS.items())


def test_a_released_vehicle_is_steered_again_only_on_command_or_after_it_was_disarmed() -> None:
    reachable = {Phase.RELEASED}
    left_by = {PhaseEvent.DISARMED, PhaseEvent.RESUMED}
    for _ in Phase:
        reachable |= {next_phase(p, e) for p in reachable for e in PhaseEvent if e not in left_by}
    assert reachable == {Phase.RELEASED}


@pytest.mark.parametrize("phase", [*FLYING_PHASES, Phase.RELEASED])
def test_every_phase_of_a_flight_ends_landed_or_idle_when_disarmed(phase: Phase) -> None:
    assert next_phase(phase, PhaseEvent.DISARMED) in (Phase.LANDED, Phase.IDLE)


@pytest.mark.parametrize("phase", sorted(FLYING_PHASES))
@pytest.mark.parametrize("event", ABORTS)
def test_every_phase_of_a_flight_has_every_abort(phase: Phase, event: PhaseEvent) -> None:
    assert next_phase(phase, event) in (Phase.LANDING, Phase.LANDED, Phase.RELEASED, Phase.IDLE)


def test_every_phase_can_be_reached_from_the_ground() -> None:
    reachable = {Phase.IDLE}
    for _ in Phase:
        reachable |= {next_phase(p, e) for p in reachable for e in PhaseEvent}
    assert reachable == set(Phase)


def test_the_sets_of_phases_lie_in_each_other() -> None:
    P = Phase
    assert {P.WAITING, P.FORMING, P.FORMED, P.MOVING, P.HOLDING, P.RETURNING} == FORMATION_PHASES
    assert {P.FORMED, P.MOVING, P.HOLDING} == SETTLED_PHASES
    assert FORMATION_PHASES | {P.DETACHED} == FILTERED_PHASES
    assert FILTERED_PHASES | {P.ARMED, P.CLIMBING, P.LANDING} == FLYING_PHASES
    assert FILTERED_PHASES | {P.ARMED, P.CLIMBING, P.LANDING, P.RELEASED} == AIRBORNE_PHASES


def test_the_diagram_in_the_docs_is_drawn_from_the_table() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    drawn = text.split("```mermaid\n", 1)[1].split("```", 1)[0]
    assert drawn == diagram(), "regenerate it with the command that the document names"


def test_the_diagram_shows_every_transition_once_or_as_one_of_all() -> None:
    drawn = diagram()
    for (before, event), after in TRANSITIONS.items():
        own = f"{before.name.lower()} --> {after.name.lower()}: {event.value}\n"
        assert own in drawn or f"flying --> {after.name.lower()}: {event.value}\n" in drawn
