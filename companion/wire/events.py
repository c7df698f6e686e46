"""Events as JSON, for recordings: `{"kind": "phase", "before": "formed", "after": "landing", "why": "land"}`.

A kind's name stands for a class of `core.events`, and the other names are its fields: an enum's member by its name in
small letters, a motion as peers are told it.
"""

import json
from dataclasses import fields
from enum import Enum
from typing import Any, get_type_hints

from companion.core import events
from companion.core.events import Event
from companion.core.trajectory.fleet import FleetTrajectory
from companion.errors import WireError
from companion.wire.peer import motion_from_json, motion_to_json

KINDS: dict[str, type[Event]] = {
    "phase": events.PhaseChanged,
    "motion": events.MotionAdopted,
    "failsafe": events.FailsafeActed,
    "failsafe noted": events.FailsafeNoted,
    "peer doubted": events.PeerDoubted,
    "graph near breaking": events.GraphNearBreaking,
    "no way back": events.NoWayBack,
    "kill commanded": events.KillCommanded,
    "kill given up": events.KillGivenUp,
    "killed": events.Killed,
    "resume given up": events.ResumeGivenUp,
    "autopilot rebooted": events.AutopilotRebooted,
    "autopilot identified": events.AutopilotIdentified,
    "origin moved": events.OriginMoved,
    "request refused": events.RequestRefused,
    "request unanswered": events.RequestUnanswered,
}
_NAMES = {kind: name for name, kind in KINDS.items()}
_TYPES = {kind: get_type_hints(kind) for kind in _NAMES}


def encode_event(event: Event) -> bytes:
    """An event's JSON."""
    said = {"kind": _NAMES[type(event)], **{f.name: _as_json(getattr(event, f.name)) for f in fields(event)}}
    return json.dumps(said, separators=(",", ":")).encode()


def decode_event(payload: bytes) -> Event:
    """An event from its JSON; WireError for anything that is not exactly one."""
    try:
        said = json.loads(payload)
        kind = KINDS[said["kind"]]
        return kind(**{name: _from_json(type_, said[name]) for name, type_ in _TYPES[kind].items()})
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise WireError("event", str(error)) from None


def _as_json(value: Any) -> Any:
    match value:
        case Enum():
            return value.name.lower()
        case FleetTrajectory():
            return motion_to_json(value)
    return value


def _from_json(type_: type, value: Any) -> Any:
    if issubclass(type_, Enum):
        return type_[value.upper()] if isinstance(value, str) else type_(value)
    if type_ is FleetTrajectory:
        return motion_from_json(value)
    if type(value) is not type_:
        raise TypeError(f"{value!r:.60} is no {type_.__name__}")
    return value
