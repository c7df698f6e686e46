"""What PX4 must be set to for a fleet in OFFBOARD: its parameters' rules, as rows of preflight.

A companion reads parameters and never sets one.
"""

from collections.abc import Callable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import replace
from typing import NamedTuple

from companion.config import FleetConfig
from companion.vehicle.autopilot.px4_identity import Px4Identity
from companion.vehicle.autopilot.px4_versions import NEWEST, Px4Version, same_setting
from companion.wire import px4
from companion.wire.operator import Check, tidy

ROUNDING = 1e-6
"""relative: PX4's parameters are float32"""


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


def _one_of(*numbers: int) -> tuple[str, Callable[[float], bool]]:
    allowed = sorted(numbers)
    text = f"{', '.join(str(a) for a in allowed[:-1])} or {allowed[-1]}"
    return text, lambda value: value in allowed


def _at_least(limit: float, unit: str) -> tuple[str, Callable[[float], bool]]:
    return f">= {limit:g} {unit}", lambda value: value >= limit * (1.0 - ROUNDING)


HOLD_ON_LOSS = 5
"""COM_OBL_RC_ACT"""


FALLS_IN_AN_EMERGENCY = 4
"""COM_LOW_BAT_ACT"""


def parameter_rules(config: FleetConfig, on_loss: float | None = None, version: Px4Version = NEWEST) -> dict[str, Rule]:
    """Parameter -> its rule; those of a pilot's transmitter depend on `preflight.require_rc`.

    `on_loss`: the autopilot's COM_OBL_RC_ACT, on which COM_LOW_BAT_ACT's depends: what holds must end some day.
    """
    limits, pilot = config.limits, config.preflight.require_rc
    longest = config.preflight.offboard_loss_limit_s
    falls = FALLS_IN_AN_EMERGENCY in version.battery_actions
    low_battery = Rule(
        *_one_of(*version.battery_actions - {FALLS_IN_AN_EMERGENCY}),
        f"{FALLS_IN_AN_EMERGENCY} stops the motors in an emergency" if falls else "not an action of this PX4's",
    )
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
        "MAN_OVERRIDE_SPD": Rule(
            ">= 0 (sticks moved that fast)", lambda v: v >= 0.0, "a pilot's sticks would not end OFFBOARD"
        ),
        "NAV_RCL_ACT": Rule(
            *_one_of(*version.rc_loss_actions, *(() if pilot else (0,))),
            "lost RC must not end in a fall, nor in nothing" if pilot else "lost RC must not end in a fall",
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


def identity_checks(kind: int, vehicle_type: int) -> tuple[Check, ...]:
    """Whether it is a PX4 (MAV_AUTOPILOT), on a multicopter (MAV_TYPE)."""
    return (
        Check(
            "autopilot", kind, f"= {px4.AUTOPILOT_PX4} (PX4)", kind == px4.AUTOPILOT_PX4,
            f"autopilot is no PX4 (MAV_AUTOPILOT {kind})", permanent=True,
        ),
        Check(
            "vehicle type", vehicle_type, "a multicopter", vehicle_type in px4.MULTICOPTERS,
            f"vehicle is no multicopter (MAV_TYPE {vehicle_type})", permanent=True,
        ),
    )  # fmt: skip


def parameter_checks(
    values: Mapping[str, float | int], missing: AbstractSet[str], config: FleetConfig, version: Px4Version = NEWEST
) -> Iterator[Check]:
    """A row for each setting that was read or cannot be; one more while some are still asked for."""
    waiting = set()
    for name, rule in parameter_rules(config, values.get("COM_OBL_RC_ACT"), version).items():
        value = values.get(name)
        if value is not None:
            met = rule.meets(value)
            says = f"{name} is {value:g}, must be {rule.limit}: {rule.why}"
            if rule.limit.startswith("has "):
                says = f"{name} is {value:g}, must have {rule.limit[4:]}: {rule.why}"
            yield Check(name, tidy(value), rule.limit, met, says, permanent=True)
            continue
        names = same_setting(name)
        if not values.keys().isdisjoint(names):
            continue  # another version's name of it has answered
        if not set(names) <= missing:
            waiting.add(names)
        elif name == names[0]:
            yield Check(name, None, rule.limit, False, f"{' or '.join(names)} cannot be read: {rule.why}")
    if waiting:
        wanted = len({same_setting(name) for name in PARAMETERS})
        says = f"{len(waiting)} of {wanted} parameters not read yet"
        yield Check("parameters", wanted - len(waiting), f"= {wanted} read", False, says)


class ParameterRows:
    """The rows of one vehicle, made anew when what they tell of has changed: every status looks at them."""

    def __init__(self, config: FleetConfig, vehicle_id: int) -> None:
        self._config = config
        self._vehicle_id = vehicle_id
        self._known: tuple[dict[str, float | int], set[str], Check] | None = None
        """what the rows tell of: values read, names that cannot be, and the version"""
        self._rows: tuple[Check, ...] = ()

    def of(
        self, values: Mapping[str, float | int], missing: AbstractSet[str], identity: Px4Identity
    ) -> tuple[Check, ...]:
        """The rows of this PX4 with these parameters."""
        version = identity.check(values)
        if self._known != (values, missing, version):
            rows = (version, *parameter_checks(values, missing, self._config, identity.row(values)))
            self._rows = tuple(replace(row, vehicle=self._vehicle_id) for row in rows)
            self._known = dict(values), set(missing), version
        return self._rows
