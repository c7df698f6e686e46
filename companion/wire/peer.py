"""Peer messages as bytes: little-endian, fixed layout, a version in front.

    header  B version, B vehicle id, B phase, B digest entries, I boot id, I sequence, I revision, q motion start ns,
            B motion issuer, B flags (1: the next message is due soon; 2: numbers of the law follow), B near ids
    sample  q time ns, 3f position (m), 3f velocity (m/s)                                  fleet frame, NED
    digest  for each entry: B vehicle id, B phase, I revision, sample
    near    for each id: B vehicle id, ascending
    law     with flag 2: B count (1 to FIELDS_MAX), so many f of the own sample, then as many of each of the digest's
    common  with flag 4: B count, then for each: B which sample (0: the own, k: the digest's k-th), 2f velocity (m/s),
            2f its rate (m/s^2), north and east; ascending

A motion travels as JSON (`encode_motion`): it is rare, and a person can read it in a capture.
"""

import json
import struct
from collections.abc import Collection
from itertools import pairwise
from math import isfinite
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from companion.core.frames import Ned
from companion.core.law.base import FIELDS_MAX
from companion.core.trajectory.fleet import REVISIONS, FleetTrajectory
from companion.core.trajectory.goto import GOTO_MIN_S
from companion.core.trajectory.legs import FreeLeg, GotoLeg, Leg, TurnLeg, VelocityLeg
from companion.core.trajectory.slots import BLEND_MIN_S, SlotChange
from companion.core.trajectory_check import (
    DURATION_MAX_S,
    HEADING_MAX_RAD,
    LEGS_MAX,
    MOTION_BYTES_MAX,
    PLACE_MAX_M,
    TURN_ANGLE_MAX_RAD,
    TURN_ANGLE_MIN_RAD,
    TURN_RATE_MAX_RAD_S,
    TURN_RATE_MIN_RAD_S,
    VEHICLES_MAX,
    VELOCITY_MAX_M_S,
)
from companion.core.values import CommonMotion, PeerMessage, PeerSample, Phase
from companion.errors import WireError
from companion.terminal import one_line

VERSION = 3
"""3: near mode's flag and ids"""
WIRE_FAULTS = ("version", "length", "phase", "flags", "near ids", "common", "not finite", "out of range", "motion")
"""every kind of WireError that is raised here"""
PLAUSIBLE_MAX = 1e6
"""no position (m) or velocity (m/s) is larger than this: float32 holds far more, and squares of it overflow later"""
DUE_SOON = 1
"""flag: the next message is due within `trigger.near_period_s` and a control period"""
TOLD = 2
"""flag: numbers of the sender's law follow"""
COMMON = 4
"""flag: what samples say of the common motion follows"""
COMMON_MAX = 20.0
"""no common velocity (m/s) and no rate of it (m/s^2) is larger than this"""
_HEADER = struct.Struct("<BBBBIIIqBBB")
_SAMPLE = struct.Struct("<q6f")
_ENTRY = struct.Struct("<BBI")
_COMMON = struct.Struct("<B4f")


def encode_state(message: PeerMessage) -> bytes:
    """A state message's payload."""
    s = message.sample
    common = [(k, x.common) for k, x in enumerate((s, *message.digest)) if x.common is not None]
    flags = DUE_SOON * message.due_soon | TOLD * bool(s.told) | COMMON * bool(common)
    parts = [
        _HEADER.pack(
            VERSION, s.vehicle_id, s.phase, len(message.digest), message.boot_id, message.sequence, s.revision,
            message.motion_start_ns, message.motion_issuer, flags, len(message.near_ids),
        ),
        _sample_bytes(s),
    ]  # fmt: skip
    for entry in message.digest:
        parts += [_ENTRY.pack(entry.vehicle_id, entry.phase, entry.revision), _sample_bytes(entry)]
    parts.append(bytes(message.near_ids))
    if s.told:
        numbers = [x for sample in (s, *message.digest) for x in sample.told]
        parts.append(struct.pack(f"<B{len(numbers)}f", len(s.told), *numbers))
    if common:
        parts += [bytes([len(common)]), *(_COMMON.pack(k, *said) for k, said in common)]
    return b"".join(parts)


def _sample_bytes(s: PeerSample) -> bytes:
    return _SAMPLE.pack(s.time_ns, *s.position_ned_m, *s.velocity_ned_m_s)


def decode_state(payload: bytes) -> PeerMessage:
    """A state message from its payload; WireError for a wrong version, length, phase, flag or order of near ids or
    common motions, or a number that is not finite."""
    if len(payload) < 1 or payload[0] != VERSION:
        raise WireError("version")
    if len(payload) < _HEADER.size + _SAMPLE.size:
        raise WireError("length")
    _, vehicle_id, phase, entries, boot_id, sequence, revision, start_ns, issuer, flags, near = _HEADER.unpack_from(
        payload
    )
    if flags & ~(DUE_SOON | TOLD | COMMON):
        raise WireError("flags")
    each = _ENTRY.size + _SAMPLE.size
    end = _HEADER.size + _SAMPLE.size + entries * each + near
    told = _told(payload, end, 1 + entries) if flags & TOLD else [()] * (1 + entries)
    rest = end + (1 + 4 * sum(map(len, told)) if flags & TOLD else 0)
    common = _commons(payload, rest, entries) if flags & COMMON else {}
    if len(payload) != rest + (1 + _COMMON.size * len(common) if flags & COMMON else 0):
        raise WireError("length")
    near_ids = tuple(payload[end - near : end])
    if any(a >= b for a, b in pairwise(near_ids)):
        raise WireError("near ids")
    sample = _sample(payload, _HEADER.size, vehicle_id, phase, revision)._replace(common=common.get(0), told=told[0])
    digest = []
    for k in range(entries):
        at = _HEADER.size + _SAMPLE.size + k * each
        entry = _sample(payload, at + _ENTRY.size, *_ENTRY.unpack_from(payload, at))
        digest.append(entry._replace(common=common.get(k + 1), told=told[k + 1]))
    return PeerMessage(boot_id, sequence, start_ns, issuer, sample, tuple(digest), near_ids, bool(flags & DUE_SOON))


def _told(payload: bytes, at: int, samples: int) -> list[tuple[float, ...]]:
    """The numbers of the law, of which there are some, for each of the samples."""
    count = payload[at] if len(payload) > at else 0
    if not 0 < count <= FIELDS_MAX or len(payload) < at + 1 + 4 * count * samples:
        raise WireError("length")
    numbers = struct.unpack_from(f"<{count * samples}f", payload, at + 1)
    _examine(numbers)
    return [numbers[k * count : (k + 1) * count] for k in range(samples)]


def _commons(payload: bytes, at: int, entries: int) -> dict[int, CommonMotion]:
    """What samples say of the common motion, by their places."""
    count = payload[at] if len(payload) > at else 0
    if not 0 < count <= entries + 1 or len(payload) < at + 1 + _COMMON.size * count:
        raise WireError("length")
    found: dict[int, CommonMotion] = {}
    for k in range(count):
        which, *numbers = _COMMON.unpack_from(payload, at + 1 + k * _COMMON.size)
        if which > entries or any(which <= other for other in found):
            raise WireError("common")
        _examine(numbers)
        if not all(abs(x) <= COMMON_MAX for x in numbers):
            raise WireError("out of range")
        found[which] = CommonMotion(*numbers)
    return found


def _examine(numbers: Collection[float]) -> None:
    if not all(abs(x) <= PLAUSIBLE_MAX for x in numbers):
        raise WireError("not finite" if not all(map(isfinite, numbers)) else "out of range")


def _sample(payload: bytes, at: int, vehicle_id: int, phase: int, revision: int) -> PeerSample:
    time_ns, *numbers = _SAMPLE.unpack_from(payload, at)
    _examine(numbers)
    try:
        known = Phase(phase)
    except ValueError:
        raise WireError("phase") from None
    return PeerSample(vehicle_id, time_ns, Ned(*numbers[:3]), Ned(*numbers[3:]), revision, known)


# The bounds on a motion's single values: `core.trajectory_check` has them for the file and for the wire, with what a
# whole one must keep. Within them its arithmetic neither overflows nor divides by nothing.
_Metres = Annotated[float, Field(ge=-PLACE_MAX_M, le=PLACE_MAX_M, allow_inf_nan=False)]
_MetresPerSecond = Annotated[float, Field(ge=-VELOCITY_MAX_M_S, le=VELOCITY_MAX_M_S, allow_inf_nan=False)]
_Place = tuple[_Metres, _Metres, _Metres]
_Velocity = tuple[_MetresPerSecond, _MetresPerSecond, _MetresPerSecond]
_Heading = Annotated[float, Field(ge=-HEADING_MAX_RAD, le=HEADING_MAX_RAD, allow_inf_nan=False)]
_Rate = Annotated[float, Field(ge=-TURN_RATE_MAX_RAD_S - 1e-9, le=TURN_RATE_MAX_RAD_S + 1e-9, allow_inf_nan=False)]
_Duration = Annotated[float, Field(ge=0, le=DURATION_MAX_S, allow_inf_nan=False)]
_Id = Annotated[int, Field(ge=1, le=VEHICLES_MAX)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class _VelocityLeg(_Model):
    kind: Literal["velocity"]
    velocity_ned_m_s: _Velocity
    duration_s: _Duration


class _TurnLeg(_Model):
    kind: Literal["turn"]
    rate_rad_s: _Rate
    angle_rad: Annotated[float, Field(ge=TURN_ANGLE_MIN_RAD, le=TURN_ANGLE_MAX_RAD, allow_inf_nan=False)] | None
    """None circles for ever (JSON knows no infinity)"""


class _GotoLeg(_Model):
    kind: Literal["goto"]
    target_ned_m: _Place
    duration_s: Annotated[float, Field(ge=GOTO_MIN_S, le=DURATION_MAX_S, allow_inf_nan=False)]


class _FreeLeg(_Model):
    kind: Literal["free"]


_AnyLeg = Annotated[_VelocityLeg | _TurnLeg | _GotoLeg | _FreeLeg, Field(discriminator="kind")]


class _Motion(_Model):
    version: Literal[3]
    revision: Annotated[int, Field(ge=0, lt=REVISIONS)]
    start_ns: Annotated[int, Field(ge=0, lt=1 << 63)]
    issuer: Annotated[int, Field(ge=0, le=255)]
    shape: Annotated[str, Field(max_length=32)]
    slots: Annotated[dict[_Id, tuple[_Place, _Place]], Field(min_length=1, max_length=VEHICLES_MAX)]
    blend_start_ns: Annotated[int, Field(ge=0, lt=1 << 63)]
    blend_s: _Duration
    legs_start_ns: Annotated[int, Field(ge=0, lt=1 << 63)]
    centre_ned_m: _Place
    velocity_ned_m_s: _Velocity
    heading_rad: _Heading
    heading_rate_rad_s: _Rate
    heading_follows_turns: bool
    legs: Annotated[tuple[_AnyLeg, ...], Field(max_length=LEGS_MAX)]
    then: Literal["stay", "land", "return"]


def encode_motion(motion: FleetTrajectory) -> bytes:
    """A motion as JSON; floats survive exactly."""
    legs = [leg_to_json(leg) for leg in motion.legs]
    fields = {name: getattr(motion, name) for name in _Motion.model_fields if name not in ("version", "legs")}
    return json.dumps({"version": VERSION, **fields, "legs": legs}, separators=(",", ":")).encode()


def leg_to_json(leg: Leg) -> dict[str, Any]:
    """A leg as plain values."""
    match leg:
        case VelocityLeg():
            return {"kind": leg.kind, "velocity_ned_m_s": leg.velocity_ned_m_s, "duration_s": leg.duration_s}
        case TurnLeg():
            angle = leg.angle_rad if isfinite(leg.angle_rad) else None
            return {"kind": leg.kind, "rate_rad_s": leg.rate_rad_s, "angle_rad": angle}
        case GotoLeg():
            return {"kind": leg.kind, "target_ned_m": leg.target_ned_m, "duration_s": leg.duration_s}
        case FreeLeg():
            return {"kind": leg.kind}


def motion_to_json(motion: FleetTrajectory) -> dict[str, Any]:
    """A motion as plain values, to stand inside of other JSON."""
    plain: dict[str, Any] = json.loads(encode_motion(motion))
    return plain


def motion_from_json(plain: object) -> FleetTrajectory:
    """`motion_to_json`, read again; WireError as `decode_motion`."""
    try:
        payload = json.dumps(plain).encode()
    except (ValueError, TypeError, RecursionError) as error:
        raise WireError("motion", one_line(str(error), 160)) from None
    return decode_motion(payload)


def decode_motion(payload: bytes) -> FleetTrajectory:
    """A motion from JSON; WireError for anything that is not exactly one, with single values within their bounds."""
    if len(payload) > MOTION_BYTES_MAX:
        raise WireError("motion", f"has {len(payload)} bytes, may have {MOTION_BYTES_MAX}")
    try:
        m = _Motion.model_validate_json(payload)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        place = ".".join(str(p) for p in first["loc"])
        raise WireError("motion", one_line(f"{place[:80]}: {first['msg'][:160]}")) from None
    if 0.0 < m.blend_s < BLEND_MIN_S:
        raise WireError("motion", f"blend_s: must be 0 s or at least {BLEND_MIN_S:g} s, got {m.blend_s:g}")
    legs = [_leg(leg, k) for k, leg in enumerate(m.legs)]
    return FleetTrajectory(
        revision=m.revision, start_ns=m.start_ns, issuer=m.issuer, shape=m.shape,
        slots={i: SlotChange(Ned(*a), Ned(*b)) for i, (a, b) in m.slots.items()},
        blend_start_ns=m.blend_start_ns, blend_s=m.blend_s, legs_start_ns=m.legs_start_ns,
        centre_ned_m=Ned(*m.centre_ned_m), velocity_ned_m_s=Ned(*m.velocity_ned_m_s),
        heading_rad=m.heading_rad, heading_rate_rad_s=m.heading_rate_rad_s,
        heading_follows_turns=m.heading_follows_turns, legs=tuple(legs), then=m.then,
    )  # fmt: skip


def _leg(leg: _VelocityLeg | _TurnLeg | _GotoLeg | _FreeLeg, k: int) -> Leg:
    match leg:
        case _VelocityLeg():
            return VelocityLeg(Ned(*leg.velocity_ned_m_s), leg.duration_s)
        case _TurnLeg():
            if not abs(leg.rate_rad_s) >= TURN_RATE_MIN_RAD_S:
                raise WireError("motion", f"legs.{k}: a turn without a rate")
            return TurnLeg(leg.rate_rad_s, float("inf") if leg.angle_rad is None else leg.angle_rad)
        case _GotoLeg():
            return GotoLeg(Ned(*leg.target_ned_m), leg.duration_s)
        case _FreeLeg():
            return FreeLeg()


_LEG = TypeAdapter[Any](_AnyLeg)


def leg_from_json(plain: object) -> Leg:
    """`leg_to_json`, read again; WireError of kind "motion" for anything that is not exactly one."""
    try:
        return _leg(_LEG.validate_json(json.dumps(plain), strict=True), 0)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        raise WireError("motion", f"leg: {first['msg'][:160]}") from None
    except (ValueError, TypeError, RecursionError) as error:
        raise WireError("motion", str(error)[:160]) from None
