"""Preflight across the fleet: what the vehicles say of themselves, compared. Pure.

A vehicle on its own cannot know that another's file, clock, altitude or place differs from its own.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from math import inf
from statistics import median
from typing import Any

from companion.config import FleetConfig
from companion.core.formation import minimum_distance
from companion.core.trajectory.fleet import top_speed_m_s
from companion.core.trajectory.successors import with_legs
from companion.core.trajectory_check import ALTITUDE_MIN_M, PLAN_SPEED_SHARE, SPEED_SLACK
from companion.core.values import ZERO
from companion.operator.clocks import ClockOffset
from companion.operator.ways import change_distances_m, level_distance_m, ways_apart_m
from companion.terminal import one_line
from companion.wire.operator import Check, PreflightReport, tidy, unmet, warnings

BODY_M = 0.5
"""closer than this two vehicles touch; what is kept where the barrier is off"""
KEYS_SHOWN_MAX = 6
OPERATOR_CLOCK_LIMIT_S = 1.0
"""commanded motions start two seconds ahead by the operator's clock"""


@dataclass(frozen=True, slots=True)
class FleetReport:
    """Every row of every vehicle and of the fleet."""

    checks: tuple[Check, ...]

    @property
    def fit(self) -> bool:
        """Whether the fleet may take off."""
        return all(c.passed for c in self.checks)

    @property
    def permanent(self) -> bool:
        """Whether something is at fault that does not come right by waiting."""
        return any(c.permanent for c in unmet(self.checks))

    @property
    def faults(self) -> list[str]:
        """Each fault as a sentence that names vehicle, value and limit."""
        return [c.sentence() for c in unmet(self.checks)]

    @property
    def warnings(self) -> list[str]:
        """What is no fault and yet worth a word, each sentence once with the vehicles that it is said of."""
        vehicles: dict[str, list[str]] = {}
        for c in warnings(self.checks):
            vehicles.setdefault(one_line(c.message), []).append(str(c.vehicle))
        return [f"vehicle {', '.join(ids)}: {says}" for says, ids in vehicles.items()]

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        rows = [asdict(c) for c in self.checks]
        return {"fit": self.fit, "faults": self.faults, "warnings": self.warnings, "checks": rows}


def fleet_report(
    config: FleetConfig,
    reports: Mapping[int, PreflightReport | None],
    offsets: Mapping[int, ClockOffset | None],
    boots: Mapping[int, frozenset[int]],
    unreadable: Mapping[int, str] | None = None,
) -> FleetReport:
    """All rows: `reports` by vehicle id (None: silent), `boots`: the processes that answered under each id;
    `unreadable`: what is wrong with an answer of another form."""
    heard = {i: a for i, a in reports.items() if a is not None}
    unreadable = unreadable or {}
    silent = [i for i, a in reports.items() if a is None and i not in unreadable]
    rows = [
        Check(
            "vehicles heard", len(heard), f"= {len(reports)}", not silent,
            f"not heard: vehicle {', '.join(str(i) for i in silent)}",
        )
    ]  # fmt: skip
    for i, why in unreadable.items():
        says = f"its answer cannot be read ({why}): is its companion of another version?"
        rows.append(Check("answer", None, "of this version's form", False, says, True, i))
    for i, report in heard.items():
        rows += [replace(c, vehicle=i) for c in report.checks]
    rows += _identities(config, heard, boots)
    rows += _agreement(config, heard)
    rows += _clocks(config, heard, offsets)
    rows += _references(config, heard)
    rows += _starts(config, heard)
    rows += _change(config, heard)
    rows += _plan(config)
    return FleetReport(tuple(rows))


def _identities(
    config: FleetConfig, heard: Mapping[int, PreflightReport], boots: Mapping[int, frozenset[int]]
) -> Iterator[Check]:
    used = Counter(a.system_id for a in heard.values())
    for i, a in heard.items():
        wanted = config.by_id(i).system_id
        yield Check("vehicle id", a.vehicle, f"= {i}", a.vehicle == i, f"answers as vehicle {a.vehicle}", True, i)
        others = [str(j) for j, b in heard.items() if j != i and b.system_id == a.system_id]
        says = f"has system id {a.system_id}, must be {wanted}"
        if others:
            says = f"has system id {a.system_id} as vehicle {', '.join(others)} has"
        yield Check(
            "one system id", a.system_id, f"= {wanted}, its own alone",
            a.system_id == wanted and used[a.system_id] == 1, says, True, i,
        )  # fmt: skip
        count = len(boots.get(i, frozenset()))
        twice = a.own_id_heard or count > 1
        yield Check(
            "one process", "more than one" if twice else "one", "one a vehicle id", not twice,
            "another companion speaks under the same id", True, i,
        )  # fmt: skip


def _agreement(config: FleetConfig, heard: Mapping[int, PreflightReport]) -> Iterator[Check]:
    assignment = config.assignment_hash
    for i, a in heard.items():
        same = a.configuration == config.shared_hash
        yield Check(
            "configuration", a.configuration, f"= {config.shared_hash}", same, "" if same else _difference(config, a),
            True, i,
        )  # fmt: skip
        yield Check(
            "assignment", a.assignment, f"= {assignment}", a.assignment == assignment,
            f"assigns the slots otherwise than the operator (hash {a.assignment}, must be {assignment})", True, i,
        )  # fmt: skip


def _difference(config: FleetConfig, answer: PreflightReport) -> str:
    """In which keys a vehicle's file is another, or that its digests do not tell."""
    keys = config.differing(answer.digests) if answer.digests else []
    more = f" and {len(keys) - KEYS_SHOWN_MAX} more" if len(keys) > KEYS_SHOWN_MAX else ""
    where = f" in {', '.join(keys[:KEYS_SHOWN_MAX])}{more}" if keys else ""
    return (
        f"its fleet.toml differs from the operator's{where} (hash {answer.configuration}, must be {config.shared_hash})"
    )


def _clocks(
    config: FleetConfig, heard: Mapping[int, PreflightReport], offsets: Mapping[int, ClockOffset | None]
) -> Iterator[Check]:
    limit = config.preflight.clock_limit_s
    known = {i: o for i in heard if (o := offsets.get(i)) is not None}
    middle = median(o.ahead_s for o in known.values()) if known else 0.0
    for i in heard:
        offset = known.get(i)
        if offset is None or offset.uncertain_s > limit:
            says = "its clock cannot be compared: no answer"
            if offset is not None:
                says = f"its clock can be compared to {offset.uncertain_s:.3f} s only, must be to {limit:g} s"
            yield Check("clock", None, f"<= {limit:g} s apart", False, says, vehicle=i)
            continue
        from_middle = offset.ahead_s - middle
        far = {
            j: abs(offset.ahead_s - o.ahead_s)
            for j, o in known.items()
            if abs(offset.ahead_s - o.ahead_s) > limit + offset.uncertain_s + o.uncertain_s
        }
        # Of two that disagree the one farther from the fleet's middle is at fault; of two alone, both are.
        at_fault = [j for j in far if abs(from_middle) >= abs(known[j].ahead_s - middle) - 1e-6]
        worst = max((far[j] for j in at_fault), default=0.0)
        yield Check(
            "clock", tidy(from_middle), f"<= {limit:g} s apart", not at_fault,
            f"its clock is {worst:.3f} s from vehicle {', '.join(str(j) for j in at_fault)}'s, may be {limit:g} s",
            vehicle=i,
        )  # fmt: skip
    if known:
        yield Check(
            "operator's clock", tidy(-middle), f"within {OPERATOR_CLOCK_LIMIT_S:g} s of the fleet's",
            abs(middle) <= OPERATOR_CLOCK_LIMIT_S,
            f"the operator's clock is {-middle:+.2f} s against the fleet's, may be {OPERATOR_CLOCK_LIMIT_S:g} s",
        )  # fmt: skip


def _references(config: FleetConfig, heard: Mapping[int, PreflightReport]) -> Iterator[Check]:
    """Altitudes and origins that must agree although each came from a receiver of its own."""
    limits = config.preflight
    if config.fleet.frame == "local":
        return
    standing = {i: a for i, a in heard.items() if not a.flying and a.revision == 0}
    heights = {i: 0.0 - a.position_ned_m[2] for i, a in standing.items() if a.position_ned_m is not None}
    homes = {i: a.home_altitude_amsl_m for i, a in standing.items() if a.home_altitude_amsl_m is not None}
    for name, values in (("start altitudes", heights), ("home altitudes", homes)):
        spread = max(values.values(), default=0.0) - min(values.values(), default=0.0)
        yield Check(
            name, tidy(spread), f"<= {limits.altitude_spread_m:g} m apart", spread <= limits.altitude_spread_m,
            f"{name} are {spread:.2f} m apart, may be {limits.altitude_spread_m:g} m: {_extremes(values)}",
        )  # fmt: skip
    origins = {i: a.origin_ned_m for i, a in heard.items() if a.origin_ned_m is not None}
    pairs = {(i, j): level_distance_m(p, q) for (i, p), (j, q) in combinations(origins.items(), 2)}
    (i, j), apart = max(pairs.items(), key=lambda item: item[1], default=((0, 0), 0.0))
    yield Check(
        "estimator origins", tidy(apart), f"<= {limits.origin_limit_m:g} m apart", apart <= limits.origin_limit_m,
        f"estimator origins of vehicle {i} and {j} are {apart:.0f} m apart, may be {limits.origin_limit_m:g} m",
    )  # fmt: skip


def _extremes(values: Mapping[int, float]) -> str:
    low, high = min(values, key=values.__getitem__, default=0), max(values, key=values.__getitem__, default=0)
    return f"vehicle {low} at {values.get(low, 0.0):.2f} m, vehicle {high} at {values.get(high, 0.0):.2f} m"


def _separation_m(config: FleetConfig) -> float:
    return config.safety_radius_m if config.limits.barrier else BODY_M


def _starts(config: FleetConfig, heard: Mapping[int, PreflightReport]) -> Iterator[Check]:
    """Who stands too close, under whom, and whose way from where it stands to where it will hover crosses another's.

    All climb where they stand and move over their pads when they are up, which is not at one time: a way is taken as
    all its points at once.
    """
    least = _separation_m(config)
    known = {i: a for i, a in heard.items() if a.position_ned_m is not None and not a.flying}
    close, crossing = [], []
    nearest = nearest_way = inf
    for (i, a), (j, b) in combinations(known.items(), 2):
        p, q = a.position_ned_m, b.position_ned_m
        assert p is not None
        assert q is not None
        apart = level_distance_m(p, q)
        nearest = min(nearest, apart)
        if apart < least:
            close.append(f"vehicle {i} and {j} stand {apart:.2f} m apart")
            continue
        way = ways_apart_m(p, a.slot_ned_m, q, b.slot_ned_m)
        nearest_way = min(nearest_way, way)
        if way < least:
            crossing.append(f"ways of vehicle {i} and {j} from where they stand come within {way:.2f} m")
    aloft = {i: a.position_ned_m for i, a in heard.items() if a.position_ned_m is not None and a.flying}
    over = {
        (i, j): level_distance_m(a.position_ned_m, q)
        for i, a in known.items()
        if a.position_ned_m
        for j, q in aloft.items()
    }
    under = [f"vehicle {j} flies {d:.2f} m from over vehicle {i}'s start" for (i, j), d in over.items() if d < least]
    fence = config.geofence
    if fence is not None:
        inside = {i: fence.edge_clearance_m(*a.position_ned_m[:2]) for i, a in known.items() if a.position_ned_m}
        outside = [f"vehicle {i} stands {-room:.2f} m outside the fence" for i, room in inside.items() if room < 0.0]
        yield Check(
            "start in the fence", tidy(min(inside.values(), default=inf)), ">= 0 m inside", not outside,
            "; ".join(outside), permanent=True,
        )  # fmt: skip
    yield Check(
        "start positions", tidy(nearest), f">= {least:.2f} m apart", not close,
        f"{'; '.join(close)}; must be {least:.2f} m", permanent=True,
    )  # fmt: skip
    yield Check(
        "starts under who flies", tidy(min(over.values(), default=inf)), f">= {least:.2f} m apart", not under,
        f"{'; '.join(under)}; must be {least:.2f} m",
    )  # fmt: skip
    yield Check(
        "ways from the start", tidy(nearest_way), f">= {least:.2f} m apart", not crossing,
        f"{'; '.join(crossing)}; must be {least:.2f} m", permanent=True,
    )  # fmt: skip


def _change(config: FleetConfig, heard: Mapping[int, PreflightReport]) -> Iterator[Check]:
    """The first change of formation as it will be flown: each pair's least distance over the blend's common time."""
    if any(a.revision > 0 for a in heard.values()):
        return  # it has been flown
    least = _separation_m(config)
    pairs = change_distances_m(config.first_formation)
    crossing = [f"vehicle {i} and {j} come within {d:.2f} m" for (i, j), d in pairs.items() if d < least]
    yield Check(
        "ways to the slots", tidy(min(pairs.values(), default=inf)), f">= {least:.2f} m apart", not crossing,
        f"{'; '.join(crossing)} on their ways to {config.formation.shape!r}; must be {least:.2f} m", permanent=True,
    )  # fmt: skip


def _plan(config: FleetConfig) -> Iterator[Check]:
    """What fleet.toml's own validation has looked at, as rows: for whoever flies and wants to see the figures."""
    shape = config.formation.shape
    slots = config.slots(shape)
    nearest = minimum_distance(slots)
    yield Check(
        "slots", tidy(nearest), f">= {config.spacing_min_m:.2f} m apart", nearest >= config.spacing_min_m,
        f"slots of {shape!r} are {nearest:.2f} m apart, must be {config.spacing_min_m:.2f} m", permanent=True,
    )  # fmt: skip
    lowest = config.formation.altitude_m - max(s.down for s in slots)
    yield Check(
        "lowest slot", tidy(lowest), f">= {ALTITUDE_MIN_M:g} m", lowest >= ALTITUDE_MIN_M,
        f"the lowest slot of {shape!r} is at {lowest:.2f} m, must be at {ALTITUDE_MIN_M:g} m", permanent=True,
    )  # fmt: skip
    start = config.first_motion
    legs = config.plan_legs(start.centre_ned_m)
    fastest = top_speed_m_s(with_legs(start, at_ns=0, issuer=0, legs=legs)) if legs else ZERO.north
    most = PLAN_SPEED_SHARE * config.limits.speed_max_m_s
    yield Check(
        "plan's speed", tidy(fastest), f"<= {most:g} m/s", fastest <= most * SPEED_SLACK,
        f"the plan flies at {fastest:.2f} m/s, may at {most:g} m/s", permanent=True,
    )  # fmt: skip
