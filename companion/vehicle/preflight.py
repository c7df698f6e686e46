"""Preflight: what must be true of one vehicle before it takes off. Pure; every check is a row with its value and limit.

A vehicle makes these rows of itself and takes off only if all are met, whoever asks. `operator.preflight` compares what
the vehicles say of themselves.
"""

from dataclasses import replace
from math import hypot

from companion.config import FleetConfig
from companion.config.derived import Vehicle
from companion.core.failsafe import ACCURACY_LIMIT_M, HEARTBEAT_S, STALE_S
from companion.core.frames import Ned, geodetic_to_ned
from companion.vehicle.autopilot.port import AutopilotFacts
from companion.wire.operator import Check, tidy


def own_checks(
    facts: AutopilotFacts, config: FleetConfig, vehicle: Vehicle, place: Ned | None = None
) -> tuple[Check, ...]:
    """All rows of one vehicle; `place`: where it should stand (its pad), None for one that flies or has flown."""
    rows = _link_checks(facts, vehicle)
    if facts.heartbeat_age_s is not None:
        rows += facts.identity
        rows += _estimator_checks(facts, config)
        rows += _health_checks(facts, config)
        if place is not None:
            rows += _start_checks(facts, config, place)
        rows += facts.settings
    return tuple(row if row.vehicle else replace(row, vehicle=vehicle.id) for row in rows)


def _link_checks(facts: AutopilotFacts, vehicle: Vehicle) -> list[Check]:
    age = facts.heartbeat_age_s
    limit = f"<= {HEARTBEAT_S:g} s"
    foreign = facts.foreign_system_id
    if age is None:
        rows = [Check("heartbeat", None, limit, False, "no heartbeat from the autopilot")]
        if foreign is not None:
            says = f"an autopilot of system id {foreign} is on the link, fleet.toml says {vehicle.system_id}"
            rows.append(Check("system id", foreign, f"= {vehicle.system_id}", False, says, permanent=True))
        return rows
    return [
        Check("heartbeat", tidy(age), limit, age <= HEARTBEAT_S, f"no heartbeat for {age:.0f} s"),
        Check(
            "system id", vehicle.system_id if foreign is None else foreign, f"= {vehicle.system_id}", foreign is None,
            f"an autopilot of system id {foreign} is on the link beside the own one", permanent=True,
        ),
    ]  # fmt: skip


def _estimator_checks(facts: AutopilotFacts, config: FleetConfig) -> list[Check]:
    rows = []
    is_global = config.fleet.frame == "global"
    limits = config.preflight
    flags, wanted, accuracy = facts.estimate
    healthy = facts.estimate.complete
    rows.append(
        Check(
            "estimator", f"{flags:#x}", f"has {wanted:#x}", healthy,
            f"estimator not ready (flags {flags:#x}, needs {wanted:#x})",
        )
    )  # fmt: skip
    # An estimator that is not ready says nothing of its accuracy: one fault, not two.
    rows.append(
        Check(
            "horizontal accuracy", tidy(accuracy), f"<= {ACCURACY_LIMIT_M:g} m",
            accuracy <= ACCURACY_LIMIT_M or not healthy,
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
    fresh = facts.position_age_s <= STALE_S
    rows.append(
        Check(
            "position age", tidy(facts.position_age_s), f"<= {STALE_S:g} s",
            fresh or (is_global and facts.origin is None), f"no position within {STALE_S} s",
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
        has_rc = facts.rc_healthy
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


def _level(p: Ned) -> float:
    return hypot(p.north, p.east)
