"""What follows from a fleet file, as rows a person reads before the fleet flies: `fleet check`."""

from collections.abc import Iterator

from companion.config import FleetConfig
from companion.core.formation import minimum_distance
from companion.core.trajectory.fleet import FleetTrajectory, top_speed_m_s
from companion.core.trajectory.successors import with_legs

Row = tuple[str, str, str]
"""what, its value, and why or what follows"""


def facts(config: FleetConfig) -> Iterator[Row]:
    """The rows of a file that is fit to fly."""
    x, formed = config.limits, config.first_formation
    yield "fleet", config.fleet.name, f"{config.fleet.frame} frame, digest {config.shared_hash}"
    yield "vehicles", str(len(config.vehicles)), ", ".join(str(v.id) for v in config.vehicles)
    slots = config.slots(config.formation.shape)
    yield (
        "formation", config.formation.shape,
        f"{minimum_distance(slots):.2f} m apart at least, of {config.spacing_min_m:.2f} m needed; "
        f"{config.formation.altitude_m:g} m high, heading {config.formation.heading_deg:g} deg",
    )  # fmt: skip
    yield "safety radius", f"{config.safety_radius_m:.2f} m" if x.barrier else "off", config.radius_reason
    yield "formed after", f"{formed.blend_s:.1f} s", "from over the pads"
    yield "plan", *_plan(config, formed)
    yield "fence", *_fence(config)
    yield (
        "messages", f"{config.trigger.kind} trigger",
        f"silent for {config.trigger.t_max_s:g} s at most; a peer that is gone is noticed within "
        f"{config.notice_lost_s:g} s",
    )  # fmt: skip
    yield "network", config.peers.network, f"neighbours: {config.neighbours}, within {config.peers.range_m:g} m"
    origins = ", ".join(f"{o.package} {o.version}" for o in config.foreign)
    yield "law", config.law.kind, f"within {config.law.a_max_m_s2:g} m/s^2; {origins or 'of this package'}"
    for v in config.vehicles:
        signed = "signed" if v.signing_key else "not signed"
        yield f"vehicle {v.id}", v.mavlink, f"system id {v.system_id}, {v.zenoh or 'found by scouting'}, {signed}"


def _plan(config: FleetConfig, formed: FleetTrajectory) -> tuple[str, str]:
    plan = config.plan
    begins = "by itself" if plan.automatic else "on command"
    if plan.kind == "none":
        informed = ", ".join(map(str, plan.informed)) or "nobody"
        return "none", f"the vehicles agree on a motion; informed: {informed}"
    if not plan.legs:
        return "stay", f"begins {begins}"
    start = formed.state_at(formed.blend_end_ns).centre
    planned = with_legs(
        formed, at_ns=formed.blend_end_ns, issuer=0, legs=config.plan_legs(start.position, start.velocity),
        then=plan.then,
    )  # fmt: skip
    if planned.end_ns is None:
        return f"{len(plan.legs)} legs", f"begins {begins}, never ends, {top_speed_m_s(planned):.1f} m/s at most"
    end = planned.state_at(planned.end_ns)
    away = end.centre.position
    return (
        f"{len(plan.legs)} legs",
        f"begins {begins}, {(planned.end_ns - planned.legs_start_ns) / 1e9:.0f} s, {top_speed_m_s(planned):.1f} m/s at "
        f"most; ends {away.north:.0f} m north, {away.east:.0f} m east, then: {plan.then}",
    )


def _fence(config: FleetConfig) -> tuple[str, str]:
    fence = config.fence
    if fence is None:
        return "none", "nothing keeps a vehicle near"
    centre = "the origin" if fence.centre_m is None else f"{fence.centre_m[0]:g}, {fence.centre_m[1]:g}"
    edge = "no edge" if fence.radius_m is None else f"{fence.radius_m:g} m about {centre}"
    if fence.polygon_m is not None:
        edge = f"{len(fence.polygon_m)} corners"
    return (
        edge,
        f"{fence.floor_m:g} to {fence.ceiling_m:g} m high; margins {fence.margin_m:g}, {fence.vertical_margin_m:g} m",
    )
