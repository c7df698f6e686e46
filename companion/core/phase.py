"""The flight's phases: every transition is in this file's one table, and the diagram in the docs is drawn from it."""

from collections import Counter
from enum import Enum, unique

from companion.core.values import Phase


@unique
class PhaseEvent(Enum):
    """What moves a vehicle from phase to phase."""

    TAKE_OFF = "take-off is commanded"
    GIVEN_UP = "the take-off is given up"
    ARMED = "the autopilot is armed on our command"
    TAKING_OFF = "the autopilot climbs in its take-off mode"
    ENGAGED = "at altitude and following our setpoints"
    FORM = "a formation is asked for"
    SETTLED = "in its slot, with the slots at rest in the formation"
    MOVE = "the plan's legs run"
    REST = "the formation's motion rests"
    RETURN = "the way back over the pads begins"
    STRAYED = "its slot is elsewhere, or a failsafe holds it"
    REJOINED = "back in its slot"
    RESUMED = "the operator has us steer again"
    LAND = "landing is commanded, planned or decided"
    DISARMED = "the autopilot is disarmed"
    TAKEN_OVER = "the pilot or the autopilot's failsafe has changed the mode"
    GIVEN_AWAY = "released or killed on the operator's command"


_P, _E = Phase, PhaseEvent

TRANSITIONS: dict[tuple[Phase, PhaseEvent], Phase] = {
    (_P.IDLE, _E.TAKE_OFF): _P.PREFLIGHT,
    (_P.IDLE, _E.RESUMED): _P.DETACHED,
    (_P.PREFLIGHT, _E.ARMED): _P.ARMED,
    (_P.PREFLIGHT, _E.GIVEN_UP): _P.IDLE,
    (_P.PREFLIGHT, _E.LAND): _P.IDLE,
    (_P.PREFLIGHT, _E.GIVEN_AWAY): _P.IDLE,
    (_P.ARMED, _E.TAKING_OFF): _P.CLIMBING,
    (_P.ARMED, _E.LAND): _P.LANDING,
    (_P.ARMED, _E.DISARMED): _P.IDLE,
    (_P.ARMED, _E.TAKEN_OVER): _P.RELEASED,
    (_P.ARMED, _E.GIVEN_AWAY): _P.RELEASED,
    (_P.CLIMBING, _E.ENGAGED): _P.WAITING,
    (_P.CLIMBING, _E.LAND): _P.LANDING,
    (_P.CLIMBING, _E.DISARMED): _P.LANDED,
    (_P.CLIMBING, _E.TAKEN_OVER): _P.RELEASED,
    (_P.CLIMBING, _E.GIVEN_AWAY): _P.RELEASED,
    (_P.WAITING, _E.FORM): _P.FORMING,
    (_P.WAITING, _E.RETURN): _P.RETURNING,
    (_P.WAITING, _E.STRAYED): _P.DETACHED,
    (_P.WAITING, _E.LAND): _P.LANDING,
    (_P.WAITING, _E.DISARMED): _P.LANDED,
    (_P.WAITING, _E.TAKEN_OVER): _P.RELEASED,
    (_P.WAITING, _E.GIVEN_AWAY): _P.RELEASED,
    (_P.FORMING, _E.SETTLED): _P.FORMED,
    (_P.FORMING, _E.RETURN): _P.RETURNING,
    (_P.FORMING, _E.STRAYED): _P.DETACHED,
    (_P.FORMING, _E.LAND): _P.LANDING,
    (_P.FORMING, _E.DISARMED): _P.LANDED,
    (_P.FORMING, _E.TAKEN_OVER): _P.RELEASED,
    (_P.FORMING, _E.GIVEN_AWAY): _P.RELEASED,
    (_P.FORMED, _E.FORM): _P.FORMING,
    (_P.FORMED, _E.MOVE): _P.MOVING,
    (_P.FORMED, _E.REST): _P.HOLDING,
    (_P.FORMED, _E.RETURN): _P.RETURNING,
    (_P.FORMED, _E.STRAYED): _P.DETACHED,
    (_P.FORMED, _E.LAND): _P.LANDING,
    (_P.FORMED, _E.DISARMED): _P.LANDED,
    (_P.FORMED, _E.TAKEN_OVER): _P.RELEASED,
    (_P.FORMED, _E.GIVEN_AWAY): _P.RELEASED,
    (_P.MOVING, _E.FORM): _P.FORMING,
    (_P.MOVING, _E.REST): _P.HOLDING,
    (_P.MOVING, _E.RETURN): _P.RETURNING,
    (_P.MOVING, _E.STRAYED): _P.DETACHED,
    (_P.MOVING, _E.LAND): _P.LANDING,
    (_P.MOVING, _E.DISARMED): _P.LANDED,
    (_P.MOVING, _E.TAKEN_OVER): _P.RELEASED,
    (_P.MOVING, _E.GIVEN_AWAY): _P.RELEASED,
    (_P.HOLDING, _E.FORM): _P.FORMING,
    (_P.HOLDING, _E.MOVE): _P.MOVING,
    (_P.HOLDING, _E.RETURN): _P.RETURNING,
    (_P.HOLDING, _E.STRAYED): _P.DETACHED,
    (_P.HOLDING, _E.LAND): _P.LANDING,
    (_P.HOLDING, _E.DISARMED): _P.LANDED,
    (_P.HOLDING, _E.TAKEN_OVER): _P.RELEASED,
    (_P.HOLDING, _E.GIVEN_AWAY): _P.RELEASED,
    (_P.RETURNING, _E.FORM): _P.FORMING,
    (_P.RETURNING, _E.STRAYED): _P.DETACHED,
    (_P.RETURNING, _E.LAND): _P.LANDING,
    (_P.RETURNING, _E.DISARMED): _P.LANDED,
    (_P.RETURNING, _E.TAKEN_OVER): _P.RELEASED,
    (_P.RETURNING, _E.GIVEN_AWAY): _P.RELEASED,
    (_P.DETACHED, _E.REJOINED): _P.WAITING,
    (_P.DETACHED, _E.LAND): _P.LANDING,
    (_P.DETACHED, _E.DISARMED): _P.LANDED,
    (_P.DETACHED, _E.TAKEN_OVER): _P.RELEASED,
    (_P.DETACHED, _E.GIVEN_AWAY): _P.RELEASED,
    (_P.LANDING, _E.DISARMED): _P.LANDED,
    (_P.LANDING, _E.TAKEN_OVER): _P.RELEASED,
    (_P.LANDING, _E.GIVEN_AWAY): _P.RELEASED,
    (_P.LANDED, _E.TAKE_OFF): _P.PREFLIGHT,
    (_P.RELEASED, _E.RESUMED): _P.DETACHED,
    (_P.RELEASED, _E.DISARMED): _P.LANDED,
}
ABORTS = (PhaseEvent.LAND, PhaseEvent.DISARMED, PhaseEvent.TAKEN_OVER, PhaseEvent.GIVEN_AWAY)
"""what ends a flight from any phase of it"""


def next_phase(phase: Phase, event: PhaseEvent) -> Phase:
    """The phase after an event; one that the table does not name leaves it as it is."""
    return TRANSITIONS.get((phase, event), phase)


def diagram() -> str:
    """The table as a Mermaid state diagram; what ends a flight from all its phases is drawn once, from "flying"."""
    flying = [p for p in Phase if TRANSITIONS.get((p, PhaseEvent.LAND)) is Phase.LANDING]
    common = {e: Counter(TRANSITIONS[p, e] for p in flying).most_common(1)[0][0] for e in ABORTS}
    inside: list[str] = []
    outside: list[str] = []
    for (before, event), after in TRANSITIONS.items():
        if before in flying and common.get(event) is after:
            continue
        line = f"{before.name.lower()} --> {after.name.lower()}: {event.value}"
        (inside if before in flying and after in flying else outside).append(line)
    outside += [f"flying --> {after.name.lower()}: {event.value}" for event, after in common.items()]
    return "\n".join(
        ["stateDiagram-v2", "    [*] --> idle", "    state flying {", *(f"        {x}" for x in inside), "    }",
         *(f"    {x}" for x in outside)]
    ) + "\n"  # fmt: skip
