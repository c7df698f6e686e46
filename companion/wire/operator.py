"""The operator's protocol as typed values and as JSON: commands and their answers, status, preflight, clock.

    fleet/<id>/command     Command -> Answer
    fleet/<id>/status      b"" -> Status
    fleet/<id>/preflight   b"" -> PreflightReport, CLOCK_QUESTION -> ClockReading

Each form stands here once. Whoever knows a value builds it, without an examination: a vehicle in trouble still says
what it can. Whoever reads one examines all of it: sizes, ranges and types, and no keys are missing. Keys beyond these
are passed over, so that a newer companion may tell more.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from math import isfinite
from typing import Annotated, Any, Final, Literal, NamedTuple, TypeVar, get_args

from pydantic import Field, TypeAdapter, ValidationError

from companion.errors import WireError
from companion.terminal import one_line

COMMAND_BYTES_MAX: Final = 65_536
"""what the transport carries"""
ANSWER_BYTES_MAX: Final = 1 << 20
"""of whatever a vehicle answers"""
PLACES_MAX: Final = 8
"""so many companions of one vehicle id may be addressed at a time"""
CLOCK_QUESTION: Final = b"clock"

Verb = Literal["takeoff", "land", "motion", "wish", "scare", "release", "resume", "kill"]
VERBS: Final[tuple[Verb, ...]] = get_args(Verb)
ENDING: Final[frozenset[Verb]] = frozenset({"land", "release", "kill"})
"""what ends a flight"""
COMMAND_FAULTS: Final = ("malformed", "unknown verb", "id", "issuer", "places")
"""every kind of fault of `decode_command`"""

_Number = Annotated[float, Field(allow_inf_nan=False)]
_NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_Count = Annotated[int, Field(ge=0, lt=1 << 63)]
_Unsigned32 = Annotated[int, Field(ge=0, lt=1 << 32)]
_Text = Annotated[str, Field(max_length=4000)]
_Word = Annotated[str, Field(max_length=64)]
_Name = Annotated[str, Field(min_length=1, max_length=64)]
_VehicleId = Annotated[int, Field(ge=1, le=250)]
_SystemId = Annotated[int, Field(ge=0, le=255)]
_Coordinate = Annotated[float, Field(ge=-1e8, le=1e8, allow_inf_nan=False)]
"""metres that every true answer keeps by far, and within which what is computed from it cannot overflow"""
_Point = tuple[_Coordinate, _Coordinate, _Coordinate]
THREAT_PLACE_MAX_M: Final = 10_000.0
"""north and east of a threat, from the fleet origin"""
THREAT_SPEED_MAX_M_S: Final = 30.0
"""of each component of its velocity"""
THREAT_RADIUS_M: Final = (1.0, 50.0)
THREAT_LASTS_S: Final = (0.5, 60.0)
_Place = Annotated[float, Field(ge=-THREAT_PLACE_MAX_M, le=THREAT_PLACE_MAX_M, allow_inf_nan=False)]
_Speed = Annotated[float, Field(ge=-THREAT_SPEED_MAX_M_S, le=THREAT_SPEED_MAX_M_S, allow_inf_nan=False)]


class Place(NamedTuple):
    """Where a vehicle is in the order of its commands."""

    boot_id: _Count
    """of its companion"""
    begun: _Count
    """flights begun since the companion's start: take-offs and resumptions"""
    obeyed: _Count
    """commands obeyed since then"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scare:
    """What is fled (`core.law.evasion`), on the level; fleet frame."""

    begins_ns: _Count
    """fleet time"""
    north_m: _Place
    """where it is then"""
    east_m: _Place
    north_m_s: _Speed = 0.0
    east_m_s: _Speed = 0.0
    radius_m: Annotated[float, Field(ge=THREAT_RADIUS_M[0], le=THREAT_RADIUS_M[1], allow_inf_nan=False)]
    """within which it is fled"""
    lasts_s: Annotated[float, Field(ge=THREAT_LASTS_S[0], le=THREAT_LASTS_S[1], allow_inf_nan=False)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """One command, the same bytes to every vehicle that it is for."""

    verb: Verb
    id: _Name
    """the operator's own: two commands alike are two commands"""
    issuer: _Name
    after: Mapping[_VehicleId, Annotated[tuple[Place, ...], Field(max_length=PLACES_MAX)]]
    """vehicle id -> its places that the operator saw: one, unless two companions answer as this vehicle"""
    confirm: bool = False
    """of `kill`: a person was asked whether it is meant"""
    motion: Any = None
    """of `motion`: a fleet's trajectory (`wire.peer.motion_from_json`)"""
    leg: Any = None
    """of `wish`: where one vehicle is to draw the fleet (`wire.peer.leg_from_json`); None: nowhere any more"""
    threat: Scare | None = None
    """of `scare`"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What a vehicle answers to a command."""

    vehicle: _VehicleId
    accepted: bool
    reason: str | None
    """why not"""
    phase: _Word = ""
    in_order: bool = True
    """False: it has gone on since the place that the command names"""
    revision: _Count | None = None
    """of its newest motion"""
    place: Place | None = None
    """None: it cannot say"""


class Whereabouts(NamedTuple):
    """Where a vehicle takes the formation's centre to be, and how fast it goes on; fleet frame, no motion being
    shared."""

    time_ns: _Count
    """fleet time"""
    position_ned_m: _Point
    velocity_ned_m_s: _Point


@dataclass(frozen=True, slots=True, kw_only=True)
class Status:
    """A vehicle's account of itself."""

    vehicle: _VehicleId
    phase: _Word
    mode: _Word
    """its autopilot's"""
    killed: _Text | None
    """by what its motors were stopped in the air"""
    armed: bool
    ready: list[_Text]
    """why it may not take off; empty when it may"""
    unfit: list[_Text]
    """those of `ready` that do not come right by waiting"""
    revision: _Count
    """of its newest motion"""
    fleet: _Word
    up_s: _NotNegative
    """since its companion's start"""
    place: Place
    shape: _Word
    moving: bool
    """whether its motion has legs, or never ends"""
    position_error_m: _Number | None
    """distance from its slot"""
    neighbours: _Count
    nearest_m: _Number | None
    """to the nearest neighbour, as it believes"""
    oldest_age_s: _Number | None
    """of what it knows of a peer"""
    messages: _Count
    """state messages sent so far"""
    messages_by_cause: dict[_Text, _Count]
    setpoints: _Count
    battery_percent: Annotated[int, Field(ge=-1, le=100)]
    """-1: unknown"""
    autopilot_age_s: _Number | None
    """since its autopilot's last heartbeat; None: never heard"""
    configuration: _Word
    """digest of the part of fleet.toml that all must share"""
    failsafes: list[_Text]
    """the last that acted"""
    rejected: dict[_Text, _Count]
    """inputs refused and faults seen, by kind"""
    limited: dict[_Text, _Count]
    """setpoints that each limit changed"""
    own_id_heard: bool
    """whether somebody else speaks under its id"""
    motion: dict[str, Any]
    """its newest (`wire.peer.motion_from_json`); whether anybody could follow it is another question"""
    centre: Whereabouts | None = None
    """None where a motion is shared, which tells it"""
    informed: bool = False
    """whether it has a wish where the fleet is to go"""
    flees: bool = False
    """whether it flees a threat that it sees"""
    lambda2: _Number | None = None
    """of the graph of those that heed each other, as it sees it"""
    graph_edge: _VehicleId | None = None
    """the vehicle at that graph's edge"""
    lateness_ms: _Number | None = None
    """of its last control tick; None: no process runs it"""
    dropped: _Count = 0
    """messages of peers for which its process had no room"""
    recorder_lost: _Count = 0
    """entries missing in its recording"""
    packets_hz: _Number | None = None
    """packets that its network connections send a second, over the last ten; None: nobody counts them"""
    bytes_per_s: _Number | None = None
    """the same in bytes, headers included"""


@dataclass(frozen=True, slots=True)
class Check:
    """One row of preflight: what was looked at, what it was, what it may be."""

    name: _Text
    value: float | Annotated[int, Field(ge=-(1 << 63), lt=1 << 63)] | _Text | None
    """None: not known"""
    limit: _Text
    """what is allowed, with its unit"""
    passed: bool
    message: _Text
    """the fault, or what is worth a word, as a sentence; of no meaning where it is neither"""
    permanent: bool = False
    """whether it cannot come right by waiting"""
    vehicle: _SystemId = 0
    """whose; 0: the fleet's"""
    warns: bool = False
    """met, and yet an operator should read the message"""

    def sentence(self) -> str:
        """The fault with the name of whose it is."""
        message = one_line(self.message)
        return f"vehicle {self.vehicle}: {message}" if self.vehicle else message


@dataclass(frozen=True, slots=True, kw_only=True)
class PreflightReport:
    """What a vehicle answers to a preflight question: its own rows, and the facts that only a comparison can judge."""

    vehicle: _SystemId
    boot_id: _Unsigned32
    system_id: _SystemId
    configuration: _Word
    assignment: _Word
    """digest of who takes which slot of the first formation"""
    flying: bool
    """whether it flies on its companion's command"""
    revision: _Unsigned32
    """of its newest motion"""
    position_ned_m: _Point | None
    """fleet frame"""
    slot_ned_m: _Point
    """where its motion wants it at the moment, fleet frame"""
    origin_ned_m: _Point | None
    """its estimator's origin in the fleet frame; None in a local frame, and while unknown"""
    home_altitude_amsl_m: _Coordinate | None
    own_id_heard: bool
    """whether somebody else speaks under its id"""
    checks: Annotated[tuple[Check, ...], Field(max_length=200)]
    digests: Annotated[dict[_Word, _Text], Field(max_length=40)] = field(default_factory=dict)
    """of each table of its fleet.toml (`FleetConfig.shared_digests`)"""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockReading:
    """A vehicle's fleet time at a question's arrival and at its answer (UTC, ns)."""

    boot_id: _Unsigned32
    received_ns: _Count
    answered_ns: _Count


def tidy(value: float | int | None) -> float | int | str | None:
    """A number as rows and JSON carry it."""
    if value is None or isinstance(value, int):
        return value
    return round(value, 4) if isfinite(value) else str(value)


def unmet(checks: Iterable[Check]) -> list[Check]:
    """The rows that are not met."""
    return [c for c in checks if not c.passed]


def warnings(checks: Iterable[Check]) -> list[Check]:
    """The rows that are met and yet worth a word."""
    return [c for c in checks if c.passed and c.warns]


Spoken = Command | Answer | Status | PreflightReport | ClockReading
_S = TypeVar("_S", Command, Answer, Status, PreflightReport, ClockReading)
_FORMS: Final = {kind: TypeAdapter(kind) for kind in get_args(Spoken)}


def encode(said: Spoken) -> bytes:
    """The JSON of any of them."""
    return json.dumps(as_json(said)).encode()


def as_json(said: Spoken) -> dict[str, Any]:
    """The same as plain values; a command without what its verb does not need."""
    plain: dict[str, Any] = _FORMS[type(said)].dump_python(said, exclude_defaults=isinstance(said, Command))
    return plain


def decode(kind: type[_S], payload: bytes) -> _S:
    """What a vehicle answered; WireError of kind "answer" for anything that is not exactly one of that kind."""
    if len(payload) > ANSWER_BYTES_MAX:
        raise WireError("answer", f"has {len(payload)} bytes, may have {ANSWER_BYTES_MAX}")
    try:
        said: _S = _FORMS[kind].validate_json(payload, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        place = ".".join(str(p) for p in first["loc"]) or "JSON"
        raise WireError("answer", one_line(f"{place[:80]}: {first['msg'][:160]}")) from None
    return said


def decode_command(payload: bytes) -> Command:
    """A command; WireError of one of COMMAND_FAULTS, whose detail is a sentence, for anything else."""
    if len(payload) > COMMAND_BYTES_MAX:
        raise WireError("malformed", f"a command has {len(payload)} bytes, may have {COMMAND_BYTES_MAX}")
    try:
        command: Command = _FORMS[Command].validate_json(payload, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise _command_fault(first["loc"], first["type"], first["input"]) from None
    return command


def _threat_fault(loc: tuple[int | str, ...], got: str) -> WireError:
    allowed = {
        "begins_ns": "a fleet time in ns",
        **dict.fromkeys(("north_m", "east_m"), f"within {THREAT_PLACE_MAX_M:g} m of the fleet origin"),
        **dict.fromkeys(("north_m_s", "east_m_s"), f"within {THREAT_SPEED_MAX_M_S:g} m/s"),
        "radius_m": f"{THREAT_RADIUS_M[0]:g} to {THREAT_RADIUS_M[1]:g} m",
        "lasts_s": f"{THREAT_LASTS_S[0]:g} to {THREAT_LASTS_S[1]:g} s",
    }
    key = str(loc[0]) if loc else ""
    if key not in allowed:
        return WireError("malformed", f"threat must be an object with {', '.join(allowed)}, got {got}")
    return WireError("malformed", f"threat.{key} must be {allowed[key]}, got {got}")


def _command_fault(loc: tuple[int | str, ...], fault: str, came: object) -> WireError:
    """What is wrong with a command, as pydantic found it first."""
    key = loc[0] if loc else ""
    got = "nothing" if fault == "missing" else f"{came!r:.60}"
    match key:
        case "verb" if fault != "missing":
            return WireError("unknown verb", f"unknown verb {got}; known: {', '.join(VERBS)}")
        case "id" | "issuer":
            return WireError(str(key), f"{key} must be a text of up to 64 characters, got {got}")
        case "after":
            return WireError(
                "places",
                f"after must be an object of vehicle ids, each with up to {PLACES_MAX} of "
                f"[boot id, flights begun, commands obeyed], got {got}",
            )
        case "confirm":
            return WireError("malformed", f"confirm must be true or false, got {got}")
        case "threat":
            return _threat_fault(loc[1:], got)
    return WireError("malformed", "not a command: needs a JSON object with a verb")
