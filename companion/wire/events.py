"""Events as JSON, for recordings: `{"kind": "phase", "before": "formed", "after": "landing"}`."""

import json

from companion.core.events import Event, FailsafeActed, KillCause, Killed, MotionAdopted, PhaseChanged
from companion.core.failsafe import Failsafe
from companion.core.values import Phase
from companion.errors import WireError
from companion.wire.peer import motion_from_json, motion_to_json


def encode_event(event: Event) -> bytes:
    """An event's JSON."""
    said: dict[str, object]
    match event:
        case PhaseChanged():
            said = {"kind": "phase", "before": event.before.name.lower(), "after": event.after.name.lower()}
        case MotionAdopted():
            said = {"kind": "motion", "motion": motion_to_json(event.motion)}
        case FailsafeActed():
            said = {"kind": "failsafe", "failsafe": event.failsafe.name.lower(), "sentence": event.sentence}
        case Killed():
            said = {"kind": "killed", "cause": event.cause.name.lower()}
    return json.dumps(said, separators=(",", ":")).encode()


def decode_event(payload: bytes) -> Event:
    """An event from its JSON; WireError for anything that is not exactly one."""
    try:
        match json.loads(payload):
            case {"kind": "phase", "before": str(before), "after": str(after)}:
                return PhaseChanged(Phase[before.upper()], Phase[after.upper()])
            case {"kind": "motion", "motion": dict(motion)}:
                return MotionAdopted(motion_from_json(motion))
            case {"kind": "failsafe", "failsafe": str(name), "sentence": str(sentence)}:
                return FailsafeActed(Failsafe[name.upper()], sentence)
            case {"kind": "killed", "cause": str(cause)}:
                return Killed(KillCause[cause.upper()])
    except (ValueError, KeyError, RecursionError) as error:
        raise WireError("event", str(error)) from None
    raise WireError("event", "of no known kind")
