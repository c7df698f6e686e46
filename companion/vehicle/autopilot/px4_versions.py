"""PX4's versions as one table: where they differ in what a fleet sets, demands, is answered and simulated with.

A row holds from its version on. Which row an autopilot is of is told by AUTOPILOT_VERSION; forks and builds without
tags tell it wrongly, so the parameters that answer have the last word (`version_of`). What a row's fields say was seen
on PX4 itself where `flown` names it, and read in its source elsewhere (docs/px4.md).
"""

from collections.abc import Container, Mapping
from dataclasses import dataclass, field

from companion.errors import ConfigError
from companion.wire.px4 import Software


@dataclass(frozen=True, slots=True, kw_only=True)
class Px4Version:
    """What holds from a version of PX4 on."""

    name: str
    number: tuple[int, int]
    flown: str
    """on what it was flown for this project; empty: its differences were read in its source"""
    sticks: str
    """the parameter by which a pilot's sticks end OFFBOARD"""
    sticks_value: float | int
    """what it is set to: PX4's default, with OFFBOARD among what sticks end"""
    sticks_way: str
    """how a pilot ends OFFBOARD with his sticks then"""
    logging: tuple[str, int]
    """the parameter, and its value, by which no log is written"""
    parameter_errors: bool
    """PARAM_ERROR (345) answers a request for a parameter that there is not"""
    strict_commands: bool
    """a mode that there is not is rejected in flight, and a command with a value in a field that it does not use is
    denied; target system 0 is meant too"""
    signing: bool
    """MAVLink signing can be demanded"""
    descend_mode: bool
    """a landing without a position is a mode of its own (AUTO sub-mode 20), not LAND"""
    rc_loss_actions: frozenset[int]
    """NAV_RCL_ACT's values that neither end in a fall nor do nothing"""
    battery_actions: frozenset[int]
    """COM_LOW_BAT_ACT's values; 1 has never been one"""
    roll_pitch_gain_per_s: float
    """MC_ROLL_P's and MC_PITCH_P's default: how fast a commanded tilt is taken up"""
    sih_parameters: Mapping[str, float | int] = field(default_factory=dict)
    """what its simulator (SIH) wants beside"""
    sih_wind: bool = False
    """its simulator has wind (SIH_WIND_N, SIH_WIND_E; m/s, may change in flight)"""


_NOISY_SIH = {"EKF2_ACC_NOISE": 0.6, "EKF2_GYR_NOISE": 0.1}
"""what SIH's sensors are like until v1.17: in flight their white noise is 0.5, 1.7 and 1.4 m/s^2 and 0.14, 0.07 and
0.03 rad/s a sample, of which the estimator's defaults (0.35 and 0.015) know nothing, so that it wanders by half a metre
(docs/px4.md). Since v1.18 they are quiet, and these values make the estimate worse"""
_MOVED = "moves a stick, however slowly"
_MOVED_FAST = "moves a stick fast, from the middle to its end in less than a second: a slow one does nothing"

VERSIONS = (
    Px4Version(
        name="1.16", number=(1, 16), flown="SIH quadrotor, release/1.16",
        sticks="COM_RC_OVERRIDE", sticks_value=3, sticks_way=_MOVED, logging=("SDLOG_MODE", -1),
        parameter_errors=False, strict_commands=False, signing=False, descend_mode=False,
        rc_loss_actions=frozenset({1, 2, 3}), battery_actions=frozenset({0, 2, 3}), roll_pitch_gain_per_s=6.5,
        sih_parameters=_NOISY_SIH,
    ),
    Px4Version(
        name="1.17", number=(1, 17), flown="",
        sticks="COM_RC_OVERRIDE", sticks_value=3, sticks_way=_MOVED, logging=("SDLOG_BACKEND", 0),
        parameter_errors=False, strict_commands=False, signing=False, descend_mode=False,
        rc_loss_actions=frozenset({1, 2, 3}), battery_actions=frozenset({0, 2, 3}), roll_pitch_gain_per_s=4.0,
        sih_parameters=_NOISY_SIH,
    ),
    Px4Version(
        name="1.18", number=(1, 18), flown="",
        sticks="MAN_OVERRIDE_SPD", sticks_value=1.0, sticks_way=_MOVED_FAST, logging=("SDLOG_BACKEND", 0),
        parameter_errors=True, strict_commands=True, signing=True, descend_mode=False,
        rc_loss_actions=frozenset({1, 2, 3, 7}), battery_actions=frozenset({0, 2, 3}), roll_pitch_gain_per_s=4.0,
        sih_wind=True,
    ),
    Px4Version(
        name="main", number=(1, 19), flown="SIH quadrotor, main of August 2026",
        sticks="MAN_OVERRIDE_SPD", sticks_value=1.0, sticks_way=_MOVED_FAST, logging=("SDLOG_BACKEND", 0),
        parameter_errors=True, strict_commands=True, signing=True, descend_mode=True,
        rc_loss_actions=frozenset({1, 2, 3, 7}), battery_actions=frozenset({0, 2, 3, 4}), roll_pitch_gain_per_s=4.0,
        sih_wind=True,
    ),
)  # fmt: skip
"""oldest first; `main` is v1.19 to be"""
OLDEST, NEWEST = VERSIONS[0], VERSIONS[-1]
STICKS = tuple(dict.fromkeys(v.sticks for v in VERSIONS))
"""all names of the setting by which sticks end OFFBOARD"""


def version_named(name: str) -> Px4Version:
    """A row by its name; ConfigError names those that there are."""
    for version in VERSIONS:
        if version.name == name:
            return version
    raise ConfigError(f"PX4 version must be one of {', '.join(v.name for v in VERSIONS)}, got {name!r}")


def fleet_parameters(version: Px4Version) -> dict[str, float | int]:
    """What a fleet without RC sets: land when the setpoints end, sticks end OFFBOARD, OFFBOARD needs no RC."""
    return {"COM_OBL_RC_ACT": 4, version.sticks: version.sticks_value, "NAV_RCL_ACT": 0, "COM_RCL_EXCEPT": 4}


def same_setting(name: str) -> tuple[str, ...]:
    """All names of a parameter's setting, its own included."""
    return STICKS if name in STICKS else (name,)


def version_of(told: Software | None, there: Container[str]) -> Px4Version:
    """The row of an autopilot that tells this of itself and has those parameters.

    A version between two rows is of the older one; one that is older than all, or that nothing is known of, is of the
    newest that its parameters allow.
    """
    known = [v for v in VERSIONS if v.sticks in there] or list(VERSIONS)
    told_rows = [v for v in known if told is not None and v.number <= told.number]
    if told_rows:
        return told_rows[-1]
    return known[-1] if told is None or told.number < OLDEST.number else known[0]
