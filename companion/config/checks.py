"""Faults of a fleet.toml that only several values together show, each as a sentence."""

from collections.abc import Iterator
from math import inf, sqrt

from companion.config.derived import FleetConfig
from companion.config.endpoints import (
    LOOPBACK,
    companion_port,
    is_zenoh_endpoint,
    serial_endpoint,
    udp_endpoint,
    zenoh_host,
)
from companion.config.schema import FenceTable, GotoLegTable, TurnLegTable, VehicleTable, VelocityLegTable
from companion.core.formation import minimum_distance
from companion.core.law.base import FIELDS_MAX
from companion.core.safety.fence import Fence
from companion.core.trajectory.fleet import FleetTrajectory
from companion.core.trajectory.successors import with_legs
from companion.core.trajectory_check import PLAN_SPEED_SHARE, TURN_RATE_MIN_DEG_S, Fault, examine
from companion.errors import ConfigError

SYSTEM_ID_MAX = 250
"""above are those of ground stations"""


def faults(config: FleetConfig) -> list[str]:
    """All that is wrong with a file whose values are each in range; what follows from another fault is left out."""
    found = list(_rule_faults(config)) or list(_table_faults(config))
    if found:
        return found
    try:
        formed = config.first_formation
    except ConfigError as error:
        return [str(error)]
    return list(_motion_faults(config, formed))


def _rule_faults(config: FleetConfig) -> Iterator[str]:
    """A law or a trigger that cannot be made from its table, or does not say what all others reckon with.

    Ours can; what those of other packages do is anything.
    """
    try:
        fields = config.law.law(config.r0_m).fields
        if not (isinstance(fields, tuple) and len(fields) <= FIELDS_MAX and all(isinstance(f, str) for f in fields)):
            yield f"$.law.kind = {config.law.kind!r}: its fields must be at most {FIELDS_MAX} names, got {fields!r}"
    except Exception as error:  # noqa: BLE001 - see above
        yield f"$.law.kind = {config.law.kind!r} cannot be made: {type(error).__name__}: {error}"
    try:
        bound_m = config.prediction_error_m
        if not 0.0 < bound_m < inf:
            yield f"$.trigger.kind = {config.trigger.kind!r}: its error bound must be finite and > 0 m, got {bound_m}"
        elif not isinstance(config.trigger_rule.cause, str):
            yield f"$.trigger.kind = {config.trigger.kind!r}: its cause must be a sentence's part"
    except Exception as error:  # noqa: BLE001 - see above
        yield f"$.trigger.kind = {config.trigger.kind!r} cannot be made: {type(error).__name__}: {error}"


def _table_faults(config: FleetConfig) -> Iterator[str]:
    """What single values cannot tell: references and duplicates across tables."""
    if config.fleet.frame == "global" and config.fleet.origin is None:
        yield '$.fleet.origin is required with frame = "global" (latitude_deg, longitude_deg, altitude_amsl_m)'
    if not config.vehicles:
        yield "$.vehicle: at least one vehicle must be enabled"
    if config.stub.signing and config.stub.px4 in ("1.16", "1.17"):
        yield f'$.stub.signing needs $.stub.px4 = "1.18" or "main": PX4 v{config.stub.px4} signs nothing'
    yield from _vehicle_faults(config)
    pads = [(v.pad_north_m, v.pad_east_m, 0.0) for v in config.vehicles]
    if minimum_distance(pads) < config.safety_radius_m and config.limits.barrier:
        yield (
            f"$.launch.spacing_m / $.vehicle[].pad_m: pads must be at least the safety radius "
            f"{config.safety_radius_m:.2f} m apart ({config.radius_reason}), got {minimum_distance(pads):.2f} m"
        )
    yield from config.law.faults()
    yield from config.trigger.faults()
    if config.peers.range_m < config.range_min_m:
        yield (
            f"$.peers.range_m must be at least {config.range_min_m:.2f} m ($.formation.spacing_m, and twice the way of "
            f"braking from $.limits.speed_max_m_s), got {config.peers.range_m:g}"
        )
    yield from _plan_faults(config)
    if config.fence is not None:
        yield from _fence_faults(config.fence)


def _vehicle_faults(config: FleetConfig) -> Iterator[str]:
    """What two vehicles share that only one can have, and addresses that are none."""
    taken: dict[tuple[str, str, object], int] = {}
    for k, v in enumerate(config.vehicle):
        system_id = v.id + config.launch.first_instance if v.system_id is None else v.system_id
        if system_id > SYSTEM_ID_MAX:
            yield (
                f"$.vehicle[{k}]: its MAVLink system id would be {system_id}, may be {SYSTEM_ID_MAX}: a lower id, or "
                "a lower $.launch.first_instance"
            )
        link = v.mavlink or f"udp://127.0.0.1:{companion_port(config.launch.first_instance + k)}"
        line = _line(link)
        if line is None:
            yield f"$.vehicle[{k}].mavlink must be udp://HOST:PORT or serial:///dev/NAME:BAUD, got {link!r}"
        host = _host(v)
        values: list[tuple[str, str, object]] = [("id", "", v.id), ("system_id", "", system_id)]
        values.append(("mavlink", f" on {host}" if host else "", line or link))
        if v.zenoh is not None:
            values.append(("zenoh", "", v.zenoh))
            if not is_zenoh_endpoint(v.zenoh):
                yield f"$.vehicle[{k}].zenoh must be PROTOCOL/HOST:PORT with tcp, udp, tls or quic, got {v.zenoh!r}"
        if config.peers.network == "field" and v.enabled and (v.zenoh is None or v.zenoh.startswith("udp/")):
            yield (
                f'$.vehicle[{k}].zenoh must be tcp/HOST:PORT with $.peers.network = "field" (by UDP a pair that loses '
                f"a declaration stays deaf), got {v.zenoh or 'nothing'}: name the address at which the others reach it"
            )
        if v.slot != "auto":
            values.append(("slot", "", v.slot))
            if v.enabled and v.slot >= len(config.vehicles):
                yield f"$.vehicle[{k}].slot must be below the {len(config.vehicles)} enabled vehicles, got {v.slot}"
        for value in values:
            if value in taken:
                name, where, came = value
                yield f"$.vehicle[{k}].{name} must be unique{where}, got {came!r} as in $.vehicle[{taken[value]}]"
            else:
                taken[value] = k


def _line(link: str) -> int | str | None:
    """The UDP port or the device of a link's URL: one process has it; None if it is neither."""
    if (udp := udp_endpoint(link)) is not None:
        return udp[1]
    serial = serial_endpoint(link)
    return None if serial is None else serial[0]


def _host(vehicle: VehicleTable) -> str:
    """The computer that a vehicle's companion runs on, as its own address names it; "" is this one.

    Lines and ports are a computer's own: six companions on six computers may all call their line /dev/autopilot.
    """
    host = "" if vehicle.zenoh is None else zenoh_host(vehicle.zenoh)
    return "" if host in LOOPBACK else host


def refuse_shared_lines(config: FleetConfig) -> None:
    """Raise ConfigError if the companions of a fleet cannot all run on one computer, for several have one line."""
    owners: dict[int | str | None, list[int]] = {}
    for v in config.vehicles:
        owners.setdefault(_line(v.mavlink), []).append(v.id)
    if shared := [ids for ids in owners.values() if len(ids) > 1]:
        raise ConfigError(
            "\n".join(
                f"vehicles {', '.join(map(str, ids))} have one line, mavlink = {config.by_id(ids[0]).mavlink!r}, and "
                "one computer has one of it: start `companion run --vehicle ID` on each vehicle's own, or rehearse the "
                "file on this one by `fleet up --rehearse`"
                for ids in shared
            )
        )


def _plan_faults(config: FleetConfig) -> Iterator[str]:
    """Legs that ask for more than the limits leave; what follows from the legs before is `_motion_faults`."""
    limits = config.limits
    level = PLAN_SPEED_SHARE * limits.speed_max_m_s
    for k, leg in enumerate(config.plan.legs):
        where = f"$.plan.legs[{k}]"
        match leg:
            case VelocityLegTable():
                speed = sqrt(leg.north_m_s**2 + leg.east_m_s**2)
                if speed > level:
                    yield f"{where}: speed must be <= {level:g} m/s (3/4 of $.limits.speed_max_m_s), got {speed:g}"
                most, least = PLAN_SPEED_SHARE * limits.climb_max_m_s, -PLAN_SPEED_SHARE * limits.descent_max_m_s
                if not least <= leg.up_m_s <= most:
                    yield (
                        f"{where}.up_m_s must be >= {least:g} and <= {most:g} m/s "
                        f"(3/4 of $.limits.descent_max_m_s and climb_max_m_s), got {leg.up_m_s:g}"
                    )
            case TurnLegTable():
                if abs(leg.rate_deg_s) < TURN_RATE_MIN_DEG_S:
                    yield f"{where}.rate_deg_s must be {TURN_RATE_MIN_DEG_S:g} deg/s or more, got {leg.rate_deg_s:g}"
                if leg.angle_deg is None and k + 1 < len(config.plan.legs):
                    yield f"{where}.angle_deg is required except in the last leg"
            case GotoLegTable():
                if leg.speed_m_s > level:
                    yield (
                        f"{where}.speed_m_s must be <= {level:g} m/s (3/4 of $.limits.speed_max_m_s), "
                        f"got {leg.speed_m_s:g}"
                    )
    yield from _leaderless_faults(config)
    last = config.plan.legs[-1] if config.plan.legs else None
    if isinstance(last, VelocityLegTable) and last.up_m_s != 0.0 and config.plan.then == "stay":
        yield f"$.plan.legs[{len(config.plan.legs) - 1}].up_m_s must be 0 m/s in the last leg: it goes on for ever"
    if config.failsafe.battery_critical_percent > config.failsafe.battery_low_percent:
        yield (
            "$.failsafe.battery_critical_percent must be <= $.failsafe.battery_low_percent = "
            f"{config.failsafe.battery_low_percent:g}, got {config.failsafe.battery_critical_percent:g}"
        )


def _leaderless_faults(config: FleetConfig) -> Iterator[str]:
    """What only a plan that all share can have, and what only a fleet without one."""
    plan = config.plan
    if plan.kind == "legs":
        if plan.informed:
            yield f'$.plan.informed belongs to $.plan.kind = "none", got {list(plan.informed)} with "legs"'
        return
    if plan.legs and not plan.informed:
        yield (
            f'$.plan.legs must be empty with $.plan.kind = "none", or flown by those named in $.plan.informed; '
            f"got {len(plan.legs)} legs that nobody is to know"
        )
    if plan.then != "stay":
        yield f'$.plan.then must be "stay" with $.plan.kind = "none": nobody tells the others, got "{plan.then}"'
    if plan.heading != "fixed":
        yield f'$.plan.heading must be "fixed" with $.plan.kind = "none", got "{plan.heading}"'
    known = {v.id for v in config.vehicles}
    for i in plan.informed:
        if i not in known:
            yield f"$.plan.informed must name enabled vehicles, got {i}"
    for k, leg in enumerate(plan.legs):
        if isinstance(leg, GotoLegTable):
            yield f'$.plan.legs[{k}]: a "goto" needs a place that all share; with $.plan.kind = "none" there is none'
        elif isinstance(leg, VelocityLegTable) and leg.up_m_s != 0.0:
            yield f'$.plan.legs[{k}].up_m_s must be 0 m/s with $.plan.kind = "none", got {leg.up_m_s:g}'


def _fence_faults(fence: FenceTable) -> Iterator[str]:
    """A fence that is none: two kinds of edge at once, an edge that crosses itself, nothing left inside."""
    if fence.radius_m is not None and fence.polygon_m is not None:
        yield "$.fence must have radius_m or polygon_m, got both"
    if fence.radius_m is None and fence.centre_m is not None:
        yield "$.fence.centre_m belongs to radius_m, which is missing"
    lowest, highest = fence.floor_m + fence.vertical_margin_m, fence.ceiling_m - fence.vertical_margin_m
    if lowest > highest:
        yield (
            f"$.fence.ceiling_m must be at least {2 * fence.vertical_margin_m:g} m (twice $.fence.vertical_margin_m) "
            f"above $.fence.floor_m = {fence.floor_m:g} m, got {fence.ceiling_m:g}"
        )
    if fence.radius_m is not None and fence.radius_m <= fence.margin_m:
        yield f"$.fence.radius_m must be > $.fence.margin_m = {fence.margin_m:g} m, got {fence.radius_m:g}"
    if fence.polygon_m is None:
        return
    if len(fence.polygon_m) < 3:
        yield f"$.fence.polygon_m must have at least 3 corners, got {len(fence.polygon_m)}"
        return
    # Only here: a companion without a polygon need not load it.
    from shapely import Polygon
    from shapely.validation import explain_validity

    polygon = Polygon(fence.polygon_m)
    if not polygon.is_valid:
        yield f"$.fence.polygon_m must not cross or touch itself, got {explain_validity(polygon)}"
    elif polygon.buffer(-fence.margin_m).is_empty:
        yield f"$.fence.polygon_m must be wider than twice $.fence.margin_m = {fence.margin_m:g} m, got nothing inside"


def _motion_faults(config: FleetConfig, formed: FleetTrajectory) -> Iterator[str]:
    """Pads that are not inside the fence, and motions that the vehicles would refuse of each other: the way into the
    formation (`formed`), the plan, the way back."""
    fence = config.geofence
    if fence is not None:
        yield from _pad_faults(config, fence)
    if fence is not None and fence.vertical_room_m(-config.formation.altitude_m) < 0.0:
        yield (
            f"$.formation.altitude_m must be >= {-fence.lowest_down_m:g} and <= {-fence.highest_down_m:g} m "
            f"(between floor and ceiling of the fence, less $.fence.vertical_margin_m), "
            f"got {config.formation.altitude_m:g}"
        )
        return
    limits = config.motion_limits
    fault = examine(formed, limits, config.first_motion).fault
    if fault is not None:
        yield _formation_sentence(fault)
        return
    planned, start_ns = formed, formed.blend_end_ns
    if config.plan.kind == "legs" and config.plan.legs:
        now = formed.state_at(start_ns).centre
        legs = config.plan_legs(now.position, now.velocity)
        planned = with_legs(formed, at_ns=start_ns, issuer=0, legs=legs, then=config.plan.then)
        fault = examine(planned, limits, formed).fault
        if fault is not None:
            yield _plan_sentence(fault)
            return
    if config.plan.then == "return" and planned.end_ns is not None:
        fault = examine(config.motion_home(planned, planned.end_ns, 0), limits, planned).fault
        if fault is not None and fault.breach is not None:
            yield (
                f'$.plan.then = "return": the way back from the last leg must stay inside the fence by its margin, '
                f"got vehicle {fault.breach.vehicle_id} {fault.breach.outside_m:.2f} m beyond it"
            )
        elif fault is not None:
            yield f'$.plan.then = "return": the way back from the last leg would be refused: {fault.sentence}'


def _pad_faults(config: FleetConfig, fence: Fence) -> Iterator[str]:
    for v in config.vehicles:
        room = fence.edge_room_m(v.pad_north_m, v.pad_east_m)
        if room < 0.0:
            yield (
                f"$.vehicle[{v.instance}].pad_m must be inside the fence by $.fence.margin_m = {fence.margin_m:g} m, "
                f"got [{v.pad_north_m:g}, {v.pad_east_m:g}], {-room:.2f} m too far out"
            )


def _formation_sentence(fault: Fault) -> str:
    if fault.breach is None:
        return f"$.formation: the way into it would be refused: {fault.sentence}"
    return (
        f"$.formation: the slot of vehicle {fault.breach.vehicle_id} must be inside the fence by its margin, "
        f"got {fault.breach.outside_m:.2f} m beyond it"
    )


def _plan_sentence(fault: Fault) -> str:
    where = "$.plan" if fault.leg is None else f"$.plan.legs[{fault.leg}]"
    if fault.breach is None or fault.breach.vehicle_id == 0:
        return f"{where} would be refused: {fault.sentence.removeprefix(f'its leg {fault.leg} ')}"
    return (
        f"{where} must stay inside the fence by its margin, got vehicle {fault.breach.vehicle_id} "
        f"{fault.breach.outside_m:.2f} m beyond it {fault.breach.time_s:.1f} s into the plan"
    )
