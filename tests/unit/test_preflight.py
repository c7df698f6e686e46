"""One vehicle's preflight: every limit just below, at, and just above."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from math import nan
from pathlib import Path
from typing import Any

import pytest

from companion.config import FleetConfig, load
from companion.core.frames import Geodetic, Ned, ned_to_geodetic
from companion.vehicle.autopilot.port import AutopilotFacts, Estimate
from companion.vehicle.autopilot.px4_parameters import PARAMETERS, identity_checks, parameter_checks, parameter_rules
from companion.vehicle.autopilot.px4_versions import NEWEST, OLDEST, VERSIONS, Px4Version
from companion.vehicle.preflight import own_checks
from companion.wire.operator import Check, PreflightReport, decode, encode, unmet

FILE = Path(__file__).resolve().parents[2] / "fleet.toml"
PAD = Ned(2.0, -8.0, 0.0)
FIT_PARAMETERS: dict[str, float | int] = {
    "COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": 4, "COM_RC_OVERRIDE": 3, "NAV_RCL_ACT": 0, "COM_RCL_EXCEPT": 4,
    "NAV_DLL_ACT": 0, "GF_ACTION": 2, "COM_LOW_BAT_ACT": 0, "MPC_XY_VEL_MAX": 12.0, "MPC_Z_VEL_MAX_UP": 3.0,
    "MPC_Z_VEL_MAX_DN": 1.5, "COM_DISARM_LAND": 2.0,
}  # fmt: skip


def config(**preflight: Any) -> FleetConfig:
    def change(tables: dict[str, Any]) -> None:
        tables["vehicle"] = tables["vehicle"][:3]
        tables["preflight"].update(preflight)

    return load(FILE, change)


@dataclass(frozen=True, kw_only=True)
class Px4Facts:
    """What a PX4 has said, as preflight is asked about it."""

    heartbeat_age_s: float | None
    foreign_system_id: int | None = None
    autopilot_kind: int = 12
    vehicle_type: int = 2
    estimator_flags: int
    sensors_health: int = 0
    horizontal_accuracy_m: float
    origin: Geodetic | None
    home_altitude_amsl_m: float | None
    position_ned_m: Ned | None
    position_age_s: float
    position_rate_hz: float
    battery_percent: int
    round_trip_s: float | None
    clock_ahead_s: float | None
    parameters: Mapping[str, float | int]
    missing: frozenset[str] = frozenset()

    def judged(self, of: FleetConfig) -> AutopilotFacts:
        px4 = ("autopilot_kind", "vehicle_type", "estimator_flags", "sensors_health", "horizontal_accuracy_m",
               "parameters", "missing")  # fmt: skip
        rows = parameter_checks(self.parameters, self.missing, of) if self.autopilot_kind == 12 else ()
        needed = 0x17 if of.fleet.frame == "global" else 0xF
        return AutopilotFacts(
            **{f.name: getattr(self, f.name) for f in fields(self) if f.name not in px4},
            identity=identity_checks(self.autopilot_kind, self.vehicle_type),
            settings=tuple(rows),
            estimate=Estimate(self.estimator_flags, needed, self.horizontal_accuracy_m),
            rc_healthy=bool(self.sensors_health & 1 << 16),
        )


CONFIG = config()
FIT = Px4Facts(
    heartbeat_age_s=0.5, autopilot_kind=12, vehicle_type=2, estimator_flags=0x3FF, horizontal_accuracy_m=0.5,
    origin=ned_to_geodetic(Ned(3.0, 4.0, 0.5), CONFIG.origin), home_altitude_amsl_m=488.1, position_ned_m=PAD,
    position_age_s=0.02, position_rate_hz=50.0, battery_percent=90, round_trip_s=0.01, clock_ahead_s=0.001,
    parameters=FIT_PARAMETERS,
)  # fmt: skip


def faults(facts: Px4Facts, of: FleetConfig = CONFIG, place: Ned | None = PAD) -> list[str]:
    return [c.message for c in unmet(own_checks(facts.judged(of), of, of.vehicles[0], place))]


def test_a_fit_vehicle_meets_every_row_and_each_row_names_it() -> None:
    rows = own_checks(FIT.judged(CONFIG), CONFIG, CONFIG.vehicles[2], PAD)
    assert unmet(rows) == []
    assert {c.vehicle for c in rows} == {3}
    assert len({c.name for c in rows}) == len(rows)
    assert {c.name for c in rows} >= set(PARAMETERS) - {"MAN_OVERRIDE_SPD"}


LIMITS = [
    ("heartbeat_age_s", 3.0, 3.001, "no heartbeat for 3 s"),
    ("horizontal_accuracy_m", 3.0, 3.001, "position uncertain by 3.0 m, may be 3 m"),
    ("position_age_s", 0.5, 0.501, "no position within 0.5 s"),
    ("position_rate_hz", 10.0, 9.999, "positions come at 10.0 Hz, must at 10 Hz"),
    ("battery_percent", 30, 29, "battery at 29 %, must have 30 %"),
    ("round_trip_s", 0.25, 0.251, "link's round trip takes 0.251 s, may take 0.25 s"),
    ("clock_ahead_s", 6.0, 6.001, "autopilot's clock is +6.00 s against the companion's, may be 6 s"),
    ("clock_ahead_s", -6.0, -6.001, "autopilot's clock is -6.00 s against the companion's, may be 6 s"),
    ("position_ned_m", Ned(12.0, -8.0, 0.0), Ned(12.01, -8.0, 0.0), "stands 10.0 m from its pad, may stand 10 m"),
    ("home_altitude_amsl_m", 493.0, 493.01, "home lies +5.0 m from the estimated altitude, may be 5 m"),
    ("home_altitude_amsl_m", 483.0, 482.99, "home lies -5.0 m from the estimated altitude, may be 5 m"),
    ("autopilot_kind", 12, 3, "autopilot is no PX4 (MAV_AUTOPILOT 3)"),
    ("autopilot_kind", 12, 13, "autopilot is no PX4 (MAV_AUTOPILOT 13)"),
    ("vehicle_type", 13, 1, "vehicle is no multicopter (MAV_TYPE 1)"),
    ("estimator_flags", 0x17, 0x07, "estimator not ready (flags 0x7, needs 0x17)"),
    ("estimator_flags", 0x17, 0x16, "estimator not ready (flags 0x16, needs 0x17)"),
]


@pytest.mark.parametrize(("name", "allowed", "refused", "says"), LIMITS, ids=[f"{r[0]}-{r[2]}" for r in LIMITS])
def test_a_value_at_its_limit_is_met_and_one_beyond_is_the_one_fault(
    name: str, allowed: Any, refused: Any, says: str
) -> None:
    assert faults(replace(FIT, **{name: allowed})) == []
    assert faults(replace(FIT, **{name: refused})) == [says]


@pytest.mark.parametrize(
    "name", ["heartbeat_age_s", "horizontal_accuracy_m", "position_age_s", "position_rate_hz", "round_trip_s",
             "clock_ahead_s", "home_altitude_amsl_m"],
)  # fmt: skip
def test_a_value_that_is_no_number_is_refused(name: str) -> None:
    assert len(faults(replace(FIT, **{name: nan}))) == 1


@pytest.mark.parametrize(("height", "fit"), [(5.0, True), (5.01, False), (-5.0, True), (-5.01, False)])
def test_a_vehicle_must_stand_at_the_fleet_origins_altitude(height: float, fit: bool) -> None:
    there = replace(FIT, position_ned_m=Ned(PAD.north, PAD.east, -height), home_altitude_amsl_m=488.0 + height)
    expected = [f"stands {height:+.1f} m from the fleet origin's altitude, may be 5 m"]
    assert faults(there) == ([] if fit else expected)


@pytest.mark.parametrize(("north", "fit"), [(999.9, True), (1000.1, False)])
def test_the_estimators_origin_must_be_near_the_fleets(north: float, fit: bool) -> None:
    there = replace(FIT, origin=ned_to_geodetic(Ned(north, 0.0, 0.0), CONFIG.origin))
    expected = ["estimator origin lies 1000 m from the fleet origin, may be 1000 m"]
    assert faults(there) == ([] if fit else expected)


def test_before_the_heartbeat_nothing_else_is_told() -> None:
    assert faults(replace(FIT, heartbeat_age_s=None)) == ["no heartbeat from the autopilot"]


def test_an_autopilot_of_another_system_id_is_named() -> None:
    said = faults(replace(FIT, heartbeat_age_s=None, foreign_system_id=9))
    assert said[1] == "an autopilot of system id 9 is on the link, fleet.toml says 1"


def test_an_autopilot_of_another_system_id_beside_the_own_one_is_named() -> None:
    said = faults(replace(FIT, foreign_system_id=9))
    assert said == ["an autopilot of system id 9 is on the link beside the own one"]


def test_what_is_not_known_is_told_by_name() -> None:
    assert faults(replace(FIT, origin=None, position_ned_m=None)) == ["estimator origin unknown"]
    assert faults(replace(FIT, battery_percent=-1)) == ["battery unknown, must have 30 %"]
    assert faults(replace(FIT, round_trip_s=None)) == ["autopilot does not answer TIMESYNC"]
    assert faults(replace(FIT, clock_ahead_s=None, home_altitude_amsl_m=None)) == []


def test_a_battery_that_nobody_measures_may_be_left_out() -> None:
    assert faults(replace(FIT, battery_percent=-1), config(battery_min_percent=0.0)) == []


def test_all_faults_are_told_at_once() -> None:
    bad = replace(FIT, battery_percent=5, position_rate_hz=3.0, parameters={**FIT_PARAMETERS, "COM_OBL_RC_ACT": 0})
    assert len(faults(bad)) == 3


def test_a_vehicle_that_flies_is_not_asked_where_it_stands() -> None:
    aloft = replace(FIT, position_ned_m=Ned(70.0, 0.0, -30.0))
    assert faults(aloft, place=None) == []


def test_a_local_frame_needs_neither_origin_nor_global_position() -> None:
    local = CONFIG.model_copy(update={"fleet": CONFIG.fleet.model_copy(update={"frame": "local"})})
    there = replace(FIT, origin=None, estimator_flags=0xF, home_altitude_amsl_m=None)
    assert faults(there, local) == []
    assert faults(replace(there, estimator_flags=0x7), local) == ["estimator not ready (flags 0x7, needs 0xf)"]


PARAMETER_LIMITS: list[tuple[str, list[float], list[float]]] = [
    ("COM_OF_LOSS_T", [0.01, 0.5, 1.0], [-1.0, 0.0, 1.001, 5.0]),
    ("COM_OBL_RC_ACT", [4], [-1, 0, 1, 2, 3, 6, 7]),
    ("COM_RC_OVERRIDE", [2, 3], [0, 1]),
    ("MAN_OVERRIDE_SPD", [0.0, 1.0, 10.0], [-1.0, -0.001]),
    ("NAV_RCL_ACT", [0, 1, 2, 3, 7], [-1, 4, 5, 6]),
    ("COM_RCL_EXCEPT", [4, 5, 6, 7], [0, 1, 2, 3]),
    ("NAV_DLL_ACT", [0, 1, 2, 3], [-1, 4, 5, 6]),
    ("GF_ACTION", [0, 1, 2, 3, 5], [-1, 4, 6]),
    ("COM_LOW_BAT_ACT", [0, 2, 3], [-1, 1, 4]),
    ("COM_DISARM_LAND", [0.001, 2.0], [-1.0, 0.0]),
    ("MPC_XY_VEL_MAX", [4.0, 4.001, 12.0], [3.999]),
    ("MPC_Z_VEL_MAX_UP", [1.5, 1.501], [1.499]),
    ("MPC_Z_VEL_MAX_DN", [1.0, 1.001], [0.999]),
]


def test_every_parameter_that_is_read_has_a_rule() -> None:
    assert set(parameter_rules(CONFIG)) == set(PARAMETERS) == {name for name, _, _ in PARAMETER_LIMITS}


@pytest.mark.parametrize(("name", "allowed", "refused"), PARAMETER_LIMITS, ids=[r[0] for r in PARAMETER_LIMITS])
def test_a_parameter_is_judged_at_its_limits(name: str, allowed: list[float], refused: list[float]) -> None:
    for value in allowed:
        assert faults(replace(FIT, parameters={**FIT_PARAMETERS, name: value})) == [], value
    for value in refused:
        (said,) = faults(replace(FIT, parameters={**FIT_PARAMETERS, name: value}))
        assert said.startswith(f"{name} is {value:g}, must ")


@pytest.mark.parametrize("require_rc", [False, True])
@pytest.mark.parametrize(("on_loss", "low_battery", "fit"), [(4, 0, True), (5, 0, False), (5, 2, True), (5, 3, True)])
def test_what_holds_without_a_companion_must_end_with_the_battery(
    on_loss: int, low_battery: int, fit: bool, require_rc: bool
) -> None:
    there = replace(FIT, sensors_health=1 << 16, parameters={
        **FIT_PARAMETERS, "NAV_RCL_ACT": 2, "COM_OBL_RC_ACT": on_loss, "COM_LOW_BAT_ACT": low_battery,
    })  # fmt: skip
    said = faults(there, config(require_rc=require_rc))
    expected = "COM_LOW_BAT_ACT is 0, must be 2 or 3: with COM_OBL_RC_ACT 5 it would hover without a companion until "
    assert said == ([] if fit else [expected + "its battery is empty"])


def test_with_a_pilot_position_mode_is_fit_and_lost_rc_must_be_acted_on() -> None:
    pilots = config(require_rc=True)
    there = replace(FIT, sensors_health=1 << 16, parameters={
        **FIT_PARAMETERS, "COM_OBL_RC_ACT": 0, "COM_RCL_EXCEPT": 0, "NAV_RCL_ACT": 2,
    })  # fmt: skip
    assert faults(there, pilots) == []
    assert faults(replace(there, sensors_health=0), pilots) == ["no RC receiver"]
    (said,) = faults(replace(there, parameters={**there.parameters, "NAV_RCL_ACT": 0}), pilots)
    assert said.startswith("NAV_RCL_ACT is 0, must be 1, 2, 3 or 7: lost RC must not end in a fall, nor in nothing")


def test_limits_that_float32_cannot_hold_are_met_by_their_nearest() -> None:
    odd = CONFIG.model_copy(update={"limits": CONFIG.limits.model_copy(update={"descent_max_m_s": 0.7})})
    assert faults(replace(FIT, parameters={**FIT_PARAMETERS, "MPC_Z_VEL_MAX_DN": 0.699999988079071}), odd) == []


def test_parameters_that_are_still_read_and_those_that_never_come_are_told_apart() -> None:
    some = {name: v for name, v in FIT_PARAMETERS.items() if name not in ("GF_ACTION", "NAV_DLL_ACT")}
    told = faults(replace(FIT, parameters=some, missing=frozenset({"GF_ACTION"})))
    unread = "GF_ACTION cannot be read: a crossed fence must not end in a fall"
    assert told == [unread, "1 of 12 parameters not read yet"]


@pytest.mark.parametrize("version", VERSIONS, ids=lambda v: v.name)
def test_actions_are_judged_by_the_version_at_hand_and_the_reason_is_true_of_it(version: Px4Version) -> None:
    def said(name: str, value: int) -> str:
        values = {**FIT_PARAMETERS, name: value}
        rows = {c.name: c for c in parameter_checks(values, frozenset(), CONFIG, version)}
        return "" if rows[name].passed else rows[name].message

    assert (said("NAV_RCL_ACT", 7) == "") == (version.number >= (1, 18))
    assert said("NAV_RCL_ACT", 5) != ""
    emergency = "COM_LOW_BAT_ACT is 4, must be 0, 2 or 3: "
    if version is NEWEST:
        assert said("COM_LOW_BAT_ACT", 4) == emergency + "4 stops the motors in an emergency"
    else:
        assert said("COM_LOW_BAT_ACT", 4) == emergency + "not an action of this PX4's"
    assert OLDEST.battery_actions < NEWEST.battery_actions


def test_of_an_autopilot_that_is_no_px4_no_parameter_is_wanted() -> None:
    assert faults(replace(FIT, autopilot_kind=3, parameters={})) == ["autopilot is no PX4 (MAV_AUTOPILOT 3)"]


def test_only_what_waiting_may_heal_is_waited_for() -> None:
    def permanent(facts: Px4Facts) -> bool:
        (row,) = unmet(own_checks(facts.judged(CONFIG), CONFIG, CONFIG.vehicles[0], PAD))
        return row.permanent

    assert permanent(replace(FIT, parameters={**FIT_PARAMETERS, "GF_ACTION": 4}))
    assert permanent(replace(FIT, battery_percent=10))
    assert permanent(replace(FIT, autopilot_kind=3))
    assert not permanent(replace(FIT, estimator_flags=0))
    assert not permanent(replace(FIT, position_rate_hz=1.0))
    assert not permanent(replace(FIT, parameters={}))


def test_an_account_survives_its_journey() -> None:
    said = replace(FIT, position_age_s=float("inf"), round_trip_s=None)
    rows = own_checks(said.judged(CONFIG), CONFIG, CONFIG.vehicles[0], PAD)
    account = PreflightReport(
        vehicle=1, boot_id=7, system_id=1, configuration="c", assignment="a", flying=False, revision=0,
        position_ned_m=PAD, slot_ned_m=PAD, origin_ned_m=None, home_altitude_amsl_m=None, own_id_heard=False,
        checks=rows,
    )  # fmt: skip
    again = decode(PreflightReport, encode(account))
    assert again == account
    assert isinstance(again.checks[0], Check)


def test_the_assignments_hash_follows_slots_and_vehicles() -> None:
    assert CONFIG.assignment_hash == config(battery_min_percent=50.0).assignment_hash

    def widen(tables: dict[str, Any]) -> None:
        tables["vehicle"] = tables["vehicle"][:3]
        tables["formation"]["spacing_m"] = 5.0

    wider = load(FILE, widen)
    assert wider.assignment_hash != CONFIG.assignment_hash


def test_the_name_under_which_this_px4_has_a_setting_is_enough_and_one_is_needed() -> None:
    without = {name: v for name, v in FIT_PARAMETERS.items() if name != "COM_RC_OVERRIDE"}
    assert faults(replace(FIT, parameters={**without, "MAN_OVERRIDE_SPD": 1.0})) == []
    assert faults(replace(FIT, parameters={**without, "MAN_OVERRIDE_SPD": -1.0})) == [
        "MAN_OVERRIDE_SPD is -1, must be >= 0 (sticks moved that fast): a pilot's sticks would not end OFFBOARD"
    ]
    one_missing = replace(FIT, parameters=without, missing=frozenset({"COM_RC_OVERRIDE"}))
    assert faults(one_missing) == ["1 of 12 parameters not read yet"]
    both = frozenset({"COM_RC_OVERRIDE", "MAN_OVERRIDE_SPD"})
    assert faults(replace(one_missing, missing=both)) == [
        "COM_RC_OVERRIDE or MAN_OVERRIDE_SPD cannot be read: a pilot's sticks would not end OFFBOARD"
    ]
