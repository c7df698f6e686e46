"""Preflight: what must be true of one vehicle before it takes off. Pure; every check is a row with its value and limit.

A vehicle makes these rows of itself and takes off only if all are met, whoever asks. `operator.preflight` compares what
the vehicles say of themselves.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from hashlib import blake2s
from math import hypot, inf, isfinite
from typing import Annotated, Any, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from companion.config import FleetConfig
from companion.config.derived import Vehicle
from companion.core.frames import Geodetic, Ned, geodetic_to_ned
from companion.core.trajectory.fleet import FleetTrajectory
from companion.wire import mavlink as wire

HEARTBEAT_LIMIT_S = 3.0
POSITION_LIMIT_S = 0.5
"""a position older than this is stale: no setpoint is made from it"""
ACCURACY_LIMIT_M = 3.0
"""PX4's own limit for arming (EKF2_REQ_EPH); flags alone stay up for seconds after the position sensor's end"""
ESTIMATOR_FLAGS_NEEDED = 1 | 2 | 4
"""ESTIMATOR_STATUS: attitude, horizontal and vertical velocity"""
ESTIMATOR_GLOBAL_FLAG = 16
"""absolute horizontal position"""
ESTIMATOR_RELATIVE_FLAG = 8
RC_RECEIVER_FLAG = 1 << 16
"""SYS_STATUS: the RC receiver is healthy"""
ROUNDING = 1e-6
"""relative: PX4's parameters are float32"""


_Text = Annotated[str, Field(max_length=4000)]


@dataclass(frozen=True, slots=True)
class Check:
    """One row: what was looked at, what it was, what it may be."""

    name: _Text
    value: float | Annotated[int, Field(ge=-(1 << 63), lt=1 << 63)] | _Text | None
    """None: not known"""
    limit: _Text
    """what is allowed, with its unit"""
    passed: bool
    message: _Text
    """the fault as a sentence; of no meaning when passed"""
    permanent: bool = False
    """whether it cannot come right by waiting"""
    vehicle: int = 0
    """whose; 0: the fleet's"""

    def sentence(self) -> str:
        """The fault with the name of whose it is."""
        return f"vehicle {self.vehicle}: {self.message}" if self.vehicle else self.message


@dataclass(frozen=True, slots=True, kw_only=True)
class AutopilotFacts:
    """What a vehicle knows of its autopilot, as plain values."""

    heartbeat_age_s: float | None
    """None: never heard"""
    foreign_system_id: int | None = None
    """system id of an autopilot that has spoken on this link of late and is not ours"""
    autopilot_kind: int = -1
    vehicle_type: int = -1
    estimator_flags: int = 0
    sensors_health: int = 0
    horizontal_accuracy_m: float = inf
    origin: Geodetic | None = None
    """the estimator's; None in a local frame too"""
    home_altitude_amsl_m: float | None = None
    position_ned_m: Ned | None = None
    """fleet frame; None while the frame is not known"""
    position_age_s: float = inf
    position_rate_hz: float = 0.0
    battery_percent: int = -1
    """-1: unknown"""
    round_trip_s: float | None = None
    """None: no answer"""
    clock_ahead_s: float | None = None
    """autopilot's UTC minus ours; None: it has none"""
    parameters: Mapping[str, float | int] = field(default_factory=dict)
    missing: frozenset[str] = frozenset()
    """parameters that were asked for and never came"""


def own_checks(
    facts: AutopilotFacts, config: FleetConfig, vehicle: Vehicle, place: Ned | None = None
) -> tuple[Check, ...]:
    """All rows of one vehicle; `place`: where it should stand (its pad), None for one that flies or has flown."""
    rows = _link_checks(facts, vehicle)
    if facts.heartbeat_age_s is not None:
        rows += _estimator_checks(facts, config)
        rows += _health_checks(facts, config)
        if place is not None:
            rows += _start_checks(facts, config, place)
        if facts.autopilot_kind == wire.AUTOPILOT_PX4:
            rows += _parameter_checks(facts, config)
    return tuple(replace(row, vehicle=vehicle.id) for row in rows)


def _link_checks(facts: AutopilotFacts, vehicle: Vehicle) -> list[Check]:
    age = facts.heartbeat_age_s
    limit = f"<= {HEARTBEAT_LIMIT_S:g} s"
    foreign = facts.foreign_system_id
    if age is None:
        rows = [Check("heartbeat", None, limit, False, "no heartbeat from the autopilot")]
        if foreign is not None:
            says = f"an autopilot of system id {foreign} is on the link, fleet.toml says {vehicle.system_id}"
            rows.append(Check("system id", foreign, f"= {vehicle.system_id}", False, says, permanent=True))
        return rows
    kind, type_ = facts.autopilot_kind, facts.vehicle_type
    return [
        Check("heartbeat", tidy(age), limit, age <= HEARTBEAT_LIMIT_S, f"no heartbeat for {age:.0f} s"),
        Check(
            "system id", vehicle.system_id if foreign is None else foreign, f"= {vehicle.system_id}", foreign is None,
            f"an autopilot of system id {foreign} is on the link beside the own one", permanent=True,
        ),
        Check(
            "autopilot", kind, f"= {wire.AUTOPILOT_PX4} (PX4)", kind == wire.AUTOPILOT_PX4,
            f"autopilot is no PX4 (MAV_AUTOPILOT {kind})", permanent=True,
        ),
        Check(
            "vehicle type", type_, "a multicopter", type_ in wire.MULTICOPTERS,
            f"vehicle is no multicopter (MAV_TYPE {type_})", permanent=True,
        ),
    ]  # fmt: skip


def _estimator_checks(facts: AutopilotFacts, config: FleetConfig) -> list[Check]:
    rows = []
    is_global = config.fleet.frame == "global"
    limits = config.preflight
    wanted = ESTIMATOR_FLAGS_NEEDED | (ESTIMATOR_GLOBAL_FLAG if is_global else ESTIMATOR_RELATIVE_FLAG)
    flags, accuracy = facts.estimator_flags, facts.horizontal_accuracy_m
    healthy = flags & wanted == wanted
    rows.append(
        Check(
            "estimator", f"{flags:#x}", f"has {wanted:#x}", healthy,
            f"estimator not ready (flags {flags:#x}, needs {wanted:#x})",
        )
    )  # fmt: skip
    sure = accuracy <= ACCURACY_LIMIT_M
    # An estimator that is not ready says nothing of its accuracy: one fault, not two.
    rows.append(
        Check(
            "horizontal accuracy", tidy(accuracy), f"<= {ACCURACY_LIMIT_M:g} m", sure or not healthy,
            f"position uncertain by {accuracy:.1f} m, may be {ACCURACY_LIMIT_M:g} m",
        )
    )  # fmt: skip
    if is_global:
        away = None if facts.origin is None else _level(geodetic_to_ned(facts.origin, config.origin))
        rows.append(
            Check(
                "estimator origin", tidy(away), f"<= {limits.origin_limit_m:g} m from the fleet origin",
                away is not None and away <= limits.origin_limit_m,
                "estimator origin unknown" if away is None else
                f"estimator origin lies {away:.0f} m from the fleet origin, may be {limits.origin_limit_m:g} m",
                permanent=away is not None,
            )
        )  # fmt: skip
    known = facts.position_ned_m is not None or not is_global
    # Without its origin a position is none of the fleet frame: that fault is told above.
    fresh = facts.position_age_s <= POSITION_LIMIT_S
    rows.append(
        Check(
            "position age", tidy(facts.position_age_s), f"<= {POSITION_LIMIT_S:g} s",
            fresh or (is_global and facts.origin is None), f"no position within {POSITION_LIMIT_S} s",
        )
    )  # fmt: skip
    rate = facts.position_rate_hz
    rows.append(
        Check(
            "position rate", tidy(rate), f">= {limits.position_rate_min_hz:g} Hz",
            rate >= limits.position_rate_min_hz or not known,
            f"positions come at {rate:.1f} Hz, must at {limits.position_rate_min_hz:g} Hz",
        )
    )  # fmt: skip
    return rows


def _health_checks(facts: AutopilotFacts, config: FleetConfig) -> list[Check]:
    limits = config.preflight
    battery, least = facts.battery_percent, limits.battery_min_percent
    trip, ahead = facts.round_trip_s, facts.clock_ahead_s
    rows = [
        Check(
            "battery", battery if battery >= 0 else None, f">= {least:g} %", battery >= least or least == 0,
            f"battery at {battery} %, must have {least:g} %" if battery >= 0 else
            f"battery unknown, must have {least:g} %",
            permanent=battery >= 0,
        ),
        Check(
            "link round trip", tidy(trip), f"<= {limits.round_trip_limit_s:g} s",
            trip is not None and trip <= limits.round_trip_limit_s,
            "autopilot does not answer TIMESYNC" if trip is None else
            f"link's round trip takes {trip:.3f} s, may take {limits.round_trip_limit_s:g} s",
        ),
        Check(
            "autopilot clock", tidy(ahead), f"within {limits.autopilot_clock_limit_s:g} s of the companion's",
            ahead is None or abs(ahead) <= limits.autopilot_clock_limit_s,
            f"autopilot's clock is {ahead or 0.0:+.2f} s against the companion's, "
            f"may be {limits.autopilot_clock_limit_s:g} s",
        ),
    ]  # fmt: skip
    if limits.require_rc:
        has_rc = bool(facts.sensors_health & RC_RECEIVER_FLAG)
        rows.append(Check("RC receiver", "healthy" if has_rc else "not healthy", "healthy", has_rc, "no RC receiver"))
    return rows


def _start_checks(facts: AutopilotFacts, config: FleetConfig, place: Ned) -> list[Check]:
    """Where it stands: unknown while its position is, which is told elsewhere."""
    limits, position = config.preflight, facts.position_ned_m
    off = None if position is None else hypot(position.north - place.north, position.east - place.east)
    rows = [
        Check(
            "pad", tidy(off), f"<= {limits.pad_limit_m:g} m", off is None or off <= limits.pad_limit_m,
            f"stands {off or 0.0:.1f} m from its pad, may stand {limits.pad_limit_m:g} m", permanent=True,
        )
    ]  # fmt: skip
    if config.fleet.frame == "local":
        return rows
    height = None if position is None else -position.down
    rows.append(
        Check(
            "start altitude", tidy(height), f"within {limits.altitude_limit_m:g} m of the fleet origin's",
            height is None or abs(height) <= limits.altitude_limit_m,
            f"stands {height or 0.0:+.1f} m from the fleet origin's altitude, may be {limits.altitude_limit_m:g} m",
            permanent=True,
        )
    )  # fmt: skip
    home = facts.home_altitude_amsl_m
    apart = None if home is None or height is None else home - (config.origin.altitude_amsl_m + height)
    rows.append(
        Check(
            "home altitude", tidy(apart), f"within {limits.altitude_limit_m:g} m of the estimate's",
            apart is None or abs(apart) <= limits.altitude_limit_m,
            f"home lies {apart or 0.0:+.1f} m from the estimated altitude, may be {limits.altitude_limit_m:g} m",
        )
    )  # fmt: skip
    return rows


class Rule(NamedTuple):
    """What a PX4 parameter must be for a fleet in OFFBOARD."""

    limit: str
    meets: Callable[[float], bool]
    why: str


PARAMETERS = (
    "COM_OF_LOSS_T", "COM_OBL_RC_ACT", "COM_RC_OVERRIDE", "NAV_RCL_ACT", "COM_RCL_EXCEPT", "NAV_DLL_ACT", "GF_ACTION",
    "COM_LOW_BAT_ACT", "COM_DISARM_LAND", "MPC_XY_VEL_MAX", "MPC_Z_VEL_MAX_UP", "MPC_Z_VEL_MAX_DN", "MAN_OVERRIDE_SPD",
)  # fmt: skip
"""PX4 parameters that preflight reads"""
ALTERNATIVES = (("COM_RC_OVERRIDE", "MAN_OVERRIDE_SPD"),)
"""names under which PX4's versions have one setting (the second since v1.18): whichever answers counts"""


def same_setting(name: str) -> tuple[str, ...]:
    """All names of a parameter's setting, its own included."""
    return next((names for names in ALTERNATIVES if name in names), (name,))


def _one_of(*allowed: int) -> tuple[str, Callable[[float], bool]]:
    text = f"{', '.join(str(a) for a in allowed[:-1])} or {allowed[-1]}"
    return text, lambda value: value in allowed


def _at_least(limit: float, unit: str) -> tuple[str, Callable[[float], bool]]:
    return f">= {limit:g} {unit}", lambda value: value >= limit * (1.0 - ROUNDING)


HOLD_ON_LOSS = 5
"""COM_OBL_RC_ACT"""


def parameter_rules(config: FleetConfig, on_loss: float | None = None) -> dict[str, Rule]:
    """Parameter -> its rule; those of a pilot's transmitter depend on `preflight.require_rc`.

    `on_loss`: the autopilot's COM_OBL_RC_ACT, on which COM_LOW_BAT_ACT's depends: what holds must end some day.
    """
    limits, pilot = config.limits, config.preflight.require_rc
    longest = config.preflight.offboard_loss_limit_s
    low_battery = Rule(*_one_of(0, 2, 3), "not an action of PX4's")
    if on_loss == HOLD_ON_LOSS:
        low_battery = Rule(
            *_one_of(2, 3),
            f"with COM_OBL_RC_ACT {HOLD_ON_LOSS} it would hover without a companion until its battery is empty",
        )
    return {
        "COM_OF_LOSS_T": Rule(
            f"<= {longest:g} s and > 0", lambda v: 0.0 < v <= longest * (1.0 + ROUNDING),
            "the autopilot acts too late, or without need",
        ),
        "COM_OBL_RC_ACT": Rule(
            *(_one_of(0, 4, 5) if pilot else _one_of(4, 5)),
            "when setpoints end it must land or hold; position mode sinks to the ground without RC, and nobody tells "
            "the others of a way back",
        ),
        "COM_RC_OVERRIDE": Rule("has bit 1", lambda v: bool(int(v) & 2), "a pilot's sticks would not end OFFBOARD"),
        "MAN_OVERRIDE_SPD": Rule(">= 0", lambda v: v >= 0.0, "a pilot's sticks would not end OFFBOARD"),
        "NAV_RCL_ACT": Rule(
            *(_one_of(1, 2, 3) if pilot else _one_of(0, 1, 2, 3)), "lost RC must not end in a fall, nor in nothing"
        ),
        "COM_RCL_EXCEPT": Rule(
            "any, with RC" if pilot else "has bit 2", lambda v: pilot or bool(int(v) & 4),
            "without RC OFFBOARD would fail for want of it",
        ),
        "NAV_DLL_ACT": Rule(*_one_of(0, 1, 2, 3), "a lost ground station must not end in a fall"),
        "GF_ACTION": Rule(*_one_of(0, 1, 2, 3, 5), "a crossed fence must not end in a fall"),
        "COM_LOW_BAT_ACT": low_battery,
        "COM_DISARM_LAND": Rule("> 0 s", lambda v: v > 0.0, "without disarming a landing has no end"),
        "MPC_XY_VEL_MAX": Rule(*_at_least(limits.speed_max_m_s, "m/s"), "slower than limits.speed_max_m_s"),
        "MPC_Z_VEL_MAX_UP": Rule(*_at_least(limits.climb_max_m_s, "m/s"), "slower than limits.climb_max_m_s"),
        "MPC_Z_VEL_MAX_DN": Rule(*_at_least(limits.descent_max_m_s, "m/s"), "slower than limits.descent_max_m_s"),
    }  # fmt: skip


def _parameter_checks(facts: AutopilotFacts, config: FleetConfig) -> Iterator[Check]:
    waiting = set()
    for name, rule in parameter_rules(config, facts.parameters.get("COM_OBL_RC_ACT")).items():
        value = facts.parameters.get(name)
        if value is not None:
            met = rule.meets(value)
            says = f"{name} is {value:g}, must be {rule.limit}: {rule.why}"
            if rule.limit.startswith("has "):
                says = f"{name} is {value:g}, must have {rule.limit[4:]}: {rule.why}"
            yield Check(name, tidy(value), rule.limit, met, says, permanent=True)
            continue
        names = same_setting(name)
        if not facts.parameters.keys().isdisjoint(names):
            continue  # another version's name of it has answered
        if not facts.missing.issuperset(names):
            waiting.add(names)
        elif name == names[0]:
            yield Check(name, None, rule.limit, False, f"{' or '.join(names)} cannot be read")
    if waiting:
        wanted = len({same_setting(name) for name in PARAMETERS})
        says = f"{len(waiting)} of {wanted} parameters not read yet"
        yield Check("parameters", wanted - len(waiting), f"= {wanted} read", False, says)


def _level(p: Ned) -> float:
    return hypot(p.north, p.east)


def tidy(value: float | int | None) -> float | int | str | None:
    """A number as rows and JSON carry it."""
    if value is None or isinstance(value, int):
        return value
    return round(value, 4) if isfinite(value) else str(value)


def unmet(checks: Iterable[Check]) -> list[Check]:
    """The rows that are not met."""
    return [c for c in checks if not c.passed]


def first_formation(config: FleetConfig, motion: FleetTrajectory) -> FleetTrajectory:
    """The change of formation that the vehicles begin with from a motion: pads to slots, as they assign them."""
    return config.motion_into(config.formation.shape, motion, motion.start_ns, 0)


def assignment_hash(config: FleetConfig) -> str:
    """Digest of who takes which slot of the first formation, to a millimetre."""
    slots = first_formation(config, config.first_motion).slots
    text = "".join(f"{i}:{','.join(f'{x + 0.0:.3f}' for x in slots[i].after)};" for i in sorted(slots))
    return blake2s(text.replace("-0.000", "0.000").encode(), digest_size=8).hexdigest()


# Bounds that every true answer keeps by far, and within which what is computed from it cannot overflow.
_Coordinate = Annotated[float, Field(ge=-1e8, le=1e8, allow_inf_nan=False)]
_Id = Annotated[int, Field(ge=0, le=255)]
_Word = Annotated[str, Field(max_length=64)]
_Unsigned32 = Annotated[int, Field(ge=0, lt=1 << 32)]
_TimeNs = Annotated[int, Field(ge=0, lt=1 << 63)]
_Place = tuple[_Coordinate, _Coordinate, _Coordinate]


class PreflightReport(BaseModel):
    """What a vehicle answers to a preflight question: its own rows, and the facts that only a comparison can judge."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    vehicle: _Id
    boot_id: _Unsigned32
    system_id: _Id
    configuration: _Word
    assignment: _Word
    flying: bool
    """whether it flies on its companion's command"""
    revision: _Unsigned32
    """of its newest motion"""
    position_ned_m: _Place | None
    """fleet frame"""
    slot_ned_m: _Place
    """where its motion wants it now, fleet frame"""
    origin_ned_m: _Place | None
    """its estimator's origin in the fleet frame; None in a local frame, and while unknown"""
    home_altitude_amsl_m: _Coordinate | None
    own_id_heard: bool = False
    """whether somebody else speaks under its id"""
    checks: tuple[Check, ...]


class ClockReading(BaseModel):
    """A vehicle's fleet time at a question's arrival and at its answer."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    boot_id: _Unsigned32
    received_ns: _TimeNs
    answered_ns: _TimeNs


def as_json(check: Check) -> dict[str, Any]:
    """A row as JSON carries it."""
    return {name: getattr(check, name) for name in Check.__dataclass_fields__}
