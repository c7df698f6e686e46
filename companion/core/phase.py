"""The flight's phases: every transition is in this file's one table."""

from enum import Enum, unique

from companion.core.values import Phase


@unique
class PhaseEvent(Enum):
    """What moves a vehicle from phase to phase."""

    ARMED = "the autopilot is armed on our command"
    TAKING_OFF = "the autopilot climbs in its take-off mode"
    ENGAGED = "at altitude and following our setpoints"
    SETTLED = "in its slot, with the slots at rest in the formation"
    UNSETTLED = "another formation was asked for"
    LAND = "landing is commanded, planned or decided"
    DISARMED = "the autopilot is disarmed"
    TAKEN_OVER = "the pilot or the autopilot's failsafe has changed the mode"
    TAKE_OFF = "take-off is commanded"


_P, _E = Phase, PhaseEvent

TRANSITIONS: dict[tuple[Phase, PhaseEvent], Phase] = {
    (_P.IDLE, _E.ARMED): _P.ARMED,
    (_P.ARMED, _E.TAKING_OFF): _P.CLIMBING,
    (_P.ARMED, _E.LAND): _P.LANDING,
    (_P.ARMED, _E.DISARMED): _P.IDLE,
    (_P.ARMED, _E.TAKEN_OVER): _P.RELEASED,
    (_P.CLIMBING, _E.ENGAGED): _P.FORMING,
    (_P.CLIMBING, _E.LAND): _P.LANDING,
    (_P.CLIMBING, _E.DISARMED): _P.LANDED,
    (_P.CLIMBING, _E.TAKEN_OVER): _P.RELEASED,
    (_P.FORMING, _E.SETTLED): _P.FORMED,
    (_P.FORMING, _E.LAND): _P.LANDING,
    (_P.FORMING, _E.DISARMED): _P.LANDED,
    (_P.FORMING, _E.TAKEN_OVER): _P.RELEASED,
    (_P.FORMED, _E.UNSETTLED): _P.FORMING,
    (_P.FORMED, _E.LAND): _P.LANDING,
    (_P.FORMED, _E.DISARMED): _P.LANDED,
    (_P.FORMED, _E.TAKEN_OVER): _P.RELEASED,
    (_P.LANDING, _E.DISARMED): _P.LANDED,
    (_P.LANDING, _E.TAKEN_OVER): _P.RELEASED,
    (_P.RELEASED, _E.DISARMED): _P.LANDED,
    (_P.LANDED, _E.TAKE_OFF): _P.IDLE,
}


def next_phase(phase: Phase, event: PhaseEvent) -> Phase:
    """The phase after an event; one that the table does not name leaves it as it is."""
    return TRANSITIONS.get((phase, event), phase)
