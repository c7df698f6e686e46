"""Preflight across the fleet: what differs between vehicles, named; limits just below, at, and just above."""

from math import pi
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config import FleetConfig, load
from companion.operator.clocks import ClockOffset, Exchange, best_offset
from companion.operator.preflight import FleetReport, fleet_report
from companion.operator.ways import change_distances_m
from companion.wire.operator import Check, PreflightReport

FILE = Path(__file__).resolve().parents[2] / "fleet.toml"


def config(count: int = 3, **tables: Any) -> FleetConfig:
    def change(read: dict[str, Any]) -> None:
        read["vehicle"] = read["vehicle"][:count]
        for name, more in tables.items():
            read[name].update(more)

    return load(FILE, change)


CONFIG = config()


def account(i: int, of: FleetConfig = CONFIG, **more: Any) -> PreflightReport:
    v = of.by_id(i)
    here = (v.pad_north_m, v.pad_east_m, 0.0)
    facts: dict[str, Any] = {
        "vehicle": i, "boot_id": 100 + i, "system_id": v.system_id, "configuration": of.shared_hash,
        "assignment": of.assignment_hash, "flying": False, "revision": 0, "position_ned_m": here,
        "slot_ned_m": (here[0], here[1], -10.0), "origin_ned_m": (1.0, 2.0, 0.0), "home_altitude_amsl_m": 488.0,
        "own_id_heard": False, "checks": (), **more,
    }  # fmt: skip
    return PreflightReport(**facts)


def report(
    changed: dict[int, PreflightReport | None] | None = None,
    *,
    of: FleetConfig = CONFIG,
    offsets: dict[int, ClockOffset | None] | None = None,
    boots: dict[int, frozenset[int]] | None = None,
) -> FleetReport:
    ids = [v.id for v in of.vehicles]
    accounts: dict[int, PreflightReport | None] = {i: account(i, of) for i in ids} | (changed or {})
    clocks: dict[int, ClockOffset | None] = {i: ClockOffset(0.0, 0.001) for i in ids}
    return fleet_report(of, accounts, clocks | (offsets or {}), boots or {})


def shifted(
    i: int, north: float = 0.0, east: float = 0.0, up: float = 0.0, of: FleetConfig = CONFIG
) -> PreflightReport:
    v = of.by_id(i)
    return account(i, of, position_ned_m=(v.pad_north_m + north, v.pad_east_m + east, -up))


def test_a_fleet_of_one_mind_is_fit() -> None:
    assert report().faults == []
    assert report().fit
    assert report().as_json()["fit"] is True


def test_who_is_not_heard_is_named() -> None:
    assert report({2: None}).faults == ["not heard: vehicle 2"]
    assert not report({2: None}).permanent
    assert "not heard: vehicle 1, 2, 3" in report({1: None, 2: None, 3: None}).faults


def test_each_vehicles_own_faults_are_told_with_its_id() -> None:
    row = Check("battery", 12, ">= 30 %", False, "battery at 12 %, must have 30 %", permanent=True, vehicle=2)
    told = report({2: account(2, checks=(row,))})
    assert told.faults == ["vehicle 2: battery at 12 %, must have 30 %"]
    assert told.permanent


def test_ids_that_are_not_the_vehicles_own_are_named() -> None:
    assert report({2: account(2, system_id=7)}).faults == ["vehicle 2: has system id 7, must be 2"]
    assert report({2: account(2, system_id=3)}).faults == [
        "vehicle 2: has system id 3 as vehicle 3 has", "vehicle 3: has system id 3 as vehicle 2 has",
    ]  # fmt: skip
    assert report({2: account(2, vehicle=1)}).faults == ["vehicle 2: answers as vehicle 1"]


@pytest.mark.parametrize("own_id_heard", [True, False])
def test_two_processes_under_one_id_are_named(own_id_heard: bool) -> None:
    told = report(
        {2: account(2, own_id_heard=own_id_heard)}, boots={2: frozenset({102} if own_id_heard else {102, 202})}
    )
    assert told.faults == ["vehicle 2: another companion speaks under the same id"]


def test_files_and_assignments_that_differ_are_named() -> None:
    (said,) = report({3: account(3, configuration="0123")}).faults
    assert said.startswith("vehicle 3: its fleet.toml differs from the operator's (hash 0123, must be ")
    theirs = config(law={"k_s": 2.5}, peers={"digest": 5})
    (said,) = report({3: account(3, configuration="0123", digests=theirs.shared_digests)}).faults
    assert said.startswith(
        "vehicle 3: its fleet.toml differs from the operator's in law.k_s, peers.digest (hash 0123, "
    )
    other = {f"{name}_m_s2": 1.0 for name in "abcdefgh"}
    digests = {**CONFIG.shared_digests, **dict.fromkeys(other, "0000")}
    (said,) = report({3: account(3, configuration="0123", digests=digests)}).faults
    assert "in a_m_s2, b_m_s2, c_m_s2, d_m_s2, e_m_s2, f_m_s2 and 2 more (hash 0123" in said
    (said,) = report({1: account(1, assignment="4567")}).faults
    assert said.startswith("vehicle 1: assigns the slots otherwise than the operator (hash 4567, must be ")


HOSTILE = {"law": "", "x" * 64: "y" * 4000, "\x1b[2J\nvehicle 1: fit": "", "limits": "zzzz" * 10}


def test_digests_that_are_none_are_told_on_one_printable_line() -> None:
    (said,) = report({3: account(3, configuration="0123", digests=HOSTILE)}).faults
    assert said.startswith("vehicle 3: its fleet.toml differs from the operator's in fleet, ")
    assert said.isprintable()
    assert len(said) <= 1100


# -- clocks ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("ahead_s", "fit"), [(0.0999, True), (0.1019, True), (0.1021, False), (-0.1021, False)])
def test_clocks_may_be_apart_by_their_limit_and_what_the_measurement_leaves_open(ahead_s: float, fit: bool) -> None:
    told = report(offsets={2: ClockOffset(ahead_s, 0.001)})
    if fit:
        assert told.faults == []
    else:
        assert told.faults == [
            f"vehicle 2: its clock is {abs(ahead_s):.3f} s from vehicle 1, 3's, may be 0.1 s",
        ]


def test_of_two_vehicles_both_clocks_are_named() -> None:
    two = config(2)
    told = report(of=two, offsets={2: ClockOffset(0.5, 0.001)})
    assert [f.split(":")[0] for f in told.faults] == ["vehicle 1", "vehicle 2"]


@pytest.mark.parametrize(("uncertain_s", "fit"), [(0.1, True), (0.1001, False)])
def test_a_clock_that_cannot_be_compared_well_enough_is_named(uncertain_s: float, fit: bool) -> None:
    told = report(offsets={3: ClockOffset(0.0, uncertain_s)})
    expected = ["vehicle 3: its clock can be compared to 0.100 s only, must be to 0.1 s"]
    assert told.faults == ([] if fit else expected)
    assert report(offsets={3: None}).faults == ["vehicle 3: its clock cannot be compared: no answer"]


@pytest.mark.parametrize(("ahead_s", "fit"), [(1.0, True), (1.01, False), (-1.0, True), (-1.01, False)])
def test_the_operators_own_clock_must_be_the_fleets(ahead_s: float, fit: bool) -> None:
    told = report(offsets={i: ClockOffset(ahead_s, 0.001) for i in (1, 2, 3)})
    assert told.fit is fit
    if not fit:
        assert told.faults[0].startswith(f"the operator's clock is {-ahead_s:+.2f} s against the fleet's")


@given(
    ahead_ms=st.integers(-5000, 5000),
    ways_ms=st.lists(st.tuples(st.integers(0, 500), st.integers(0, 500), st.integers(0, 50)), min_size=1, max_size=6),
)
def test_an_offset_is_known_to_within_its_uncertainty(ahead_ms: int, ways_ms: list[tuple[int, int, int]]) -> None:
    readings = []
    for k, (there, back, inside) in enumerate(ways_ms):
        asked = 1_700_000_000_000 + 1000 * k
        received = asked + there + ahead_ms
        readings.append((asked, received, received + inside, asked + there + inside + back))
    offset = best_offset(Exchange(*(x * 1_000_000 for x in r)) for r in readings)
    assert offset is not None
    assert abs(offset.ahead_s - ahead_ms * 1e-3) <= offset.uncertain_s + 1e-9
    assert offset.uncertain_s == pytest.approx(min(there + back for there, back, _ in ways_ms) * 0.5e-3)


def test_a_reading_that_cannot_be_is_left_out() -> None:
    assert best_offset([]) is None
    assert best_offset([Exchange(10, 100, 300, 20)]) is None


# -- where the vehicles stand ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("up_m", "fit"), [(3.0, True), (3.01, False)])
def test_start_altitudes_must_agree(up_m: float, fit: bool) -> None:
    expected = ["start altitudes are 3.01 m apart, may be 3 m: vehicle 1 at 0.00 m, vehicle 2 at 3.01 m"]
    assert report({2: shifted(2, up=up_m)}).faults == ([] if fit else expected)


@pytest.mark.parametrize(("altitude_m", "fit"), [(485.0, True), (484.99, False), (491.0, True), (491.01, False)])
def test_home_altitudes_must_agree(altitude_m: float, fit: bool) -> None:
    faults = report({2: account(2, home_altitude_amsl_m=altitude_m)}).faults
    assert not faults if fit else faults[0].startswith("home altitudes are 3.01 m apart, may be 3 m")


@pytest.mark.parametrize(("north_m", "fit"), [(1001.0, True), (1001.1, False)])
def test_estimators_origins_must_not_be_far_apart(north_m: float, fit: bool) -> None:
    faults = report({2: account(2, origin_ned_m=(north_m, 2.0, 0.0))}).faults
    assert faults == (
        [] if fit else ["estimator origins of vehicle 1 and 2 are 1000 m apart, may be 1000 m"]
    )  # fmt: skip


def test_who_flies_elsewhere_is_not_compared_with_who_stands() -> None:
    assert report({2: account(2, flying=True, position_ned_m=(20.0, 0.0, -10.0))}).faults == []


@pytest.mark.parametrize(("gap_m", "fit"), [(0.001, True), (-0.01, False), (-1.0, False)])
def test_nobody_starts_under_one_that_flies(gap_m: float, fit: bool) -> None:
    pad, level_m = CONFIG.by_id(1), CONFIG.safety_radius_m + gap_m
    above = account(2, flying=True, revision=3, position_ned_m=(pad.pad_north_m - level_m, pad.pad_east_m, -6.0))
    told = report({2: above})
    limit = f"{CONFIG.safety_radius_m:.2f} m"
    expected = [f"vehicle 2 flies {level_m:.2f} m from over vehicle 1's start; must be {limit}"]
    assert told.faults == ([] if fit else expected)
    assert not told.permanent, "it may fly on"


def test_whoever_flies_is_no_start_under_another() -> None:
    pad = CONFIG.by_id(1)
    both = {i: account(i, flying=True, revision=3, position_ned_m=(pad.pad_north_m, pad.pad_east_m, -3.0 * i))
            for i in (1, 2)}  # fmt: skip
    assert report({**both, 3: shifted(3, north=-20.0)}).faults == []


def test_an_unknown_position_is_no_fault_of_the_fleet() -> None:
    assert report({2: account(2, position_ned_m=None, origin_ned_m=None, home_altitude_amsl_m=None)}).faults == []


@pytest.mark.parametrize(("gap_m", "fit"), [(0.01, True), (-0.01, False)])
def test_vehicles_must_stand_apart_by_the_safety_radius(gap_m: float, fit: bool) -> None:
    a, b = CONFIG.by_id(1), CONFIG.by_id(2)
    apart = b.pad_east_m - a.pad_east_m
    faults = report({2: shifted(2, east=CONFIG.safety_radius_m + gap_m - apart)}).faults
    assert not faults if fit else faults[0].startswith("vehicle 1 and 2 stand 1.49 m apart; must be 1.50 m")


@pytest.mark.parametrize(("beyond_m", "fit"), [(-0.01, True), (0.0, True), (0.01, False)])
def test_vehicles_must_stand_inside_the_fence(beyond_m: float, fit: bool) -> None:
    fence = CONFIG.geofence
    assert fence is not None
    assert fence.radius_m is not None
    edge = fence.centre_north_m + fence.radius_m
    there = account(2, position_ned_m=(edge + beyond_m, fence.centre_east_m, 0.0), slot_ned_m=(edge, 0.0, -10.0))
    said = [f for f in report({2: there}).faults if "fence" in f]
    assert said == ([] if fit else ["vehicle 2 stands 0.01 m outside the fence"])


def test_vehicles_on_each_others_pads_cross() -> None:
    a, b = CONFIG.by_id(1), CONFIG.by_id(2)
    apart = b.pad_east_m - a.pad_east_m
    told = report({1: shifted(1, east=apart), 2: shifted(2, east=-apart)})
    assert len(told.faults) == 1
    assert told.faults[0].startswith("ways of vehicle 1 and 2 from where they stand come within 0.00 m")
    assert told.permanent


def test_ways_that_cross_like_an_x_are_found() -> None:
    square = config(4, launch={"spacing_m": 10.0}, preflight={"pad_limit_m": 100.0})
    p = {v.id: (v.pad_north_m, v.pad_east_m) for v in square.vehicles}
    ids = list(p)
    # each of two stands beside its pad so that the straight ways home cross in their middles
    one, two = ids[0], ids[1]
    here = {one: (p[two][0] + 6.0, p[two][1], 0.0), two: (p[one][0] + 6.0, p[one][1], 0.0)}
    told = report({i: account(i, square, position_ned_m=here[i]) for i in here}, of=square)
    assert any(f.startswith(f"ways of vehicle {one} and {two}") and "within 0.00 m" in f for f in told.faults)


@pytest.mark.parametrize("barrier", [True, False])
def test_without_the_barrier_only_touching_is_refused(barrier: bool) -> None:
    of = config(3, limits={"barrier": barrier})
    apart = of.by_id(2).pad_east_m - of.by_id(1).pad_east_m
    told = report({2: shifted(2, east=1.0 - apart, of=of)}, of=of)
    assert told.fit is not barrier


# -- ways to the slots -------------------------------------------------------------------------------------------------


def test_pinned_slots_that_make_vehicles_fly_head_on_are_refused() -> None:
    def change(tables: dict[str, Any]) -> None:
        tables["vehicle"] = [{"id": 1, "slot": 1}, {"id": 2, "slot": 0}]
        tables["formation"]["shape"] = "line"

    of = load(FILE, change)
    (said,) = report(of=of).faults
    assert said.startswith("vehicle 1 and 2 come within 0.00 m on their ways to 'line'; must be 1.50 m")


def test_once_the_fleet_has_formed_its_first_change_is_no_matter() -> None:
    def change(tables: dict[str, Any]) -> None:
        tables["vehicle"] = [{"id": 1, "slot": 1}, {"id": 2, "slot": 0}]
        tables["formation"]["shape"] = "line"

    of = load(FILE, change)
    assert report({i: account(i, of, revision=1) for i in (1, 2)}, of=of).faults == []


@pytest.mark.parametrize("shape", ["v", "line", "column", "circle", "grid", "spiral", "sphere"])
@pytest.mark.parametrize("count", [2, 5, 10])
def test_the_shapes_of_the_default_file_can_be_taken_from_its_pads(shape: str, count: int) -> None:
    of = config(count, formation={"shape": shape, "altitude_m": 30.0})
    assert report(of=of).faults == []


@given(angle=st.floats(-pi, pi), count=st.integers(2, 6))
def test_the_least_distance_is_that_of_the_flown_blend(angle: float, count: int) -> None:
    of = config(count, formation={"shape": "circle", "heading_deg": angle * 180 / pi})
    motion = of.first_formation
    exact = change_distances_m(motion)
    steps = 400
    seen = dict.fromkeys(exact, float("inf"))
    for k in range(steps + 1):
        moment = motion.state_at(motion.blend_start_ns + round(motion.blend_s * 1e9 * k / steps))
        at = {i: moment.slot(change).position_ned_m for i, change in motion.slots.items()}
        for i, j in seen:
            d = sum((a - b) ** 2 for a, b in zip(at[i], at[j], strict=True)) ** 0.5
            seen[i, j] = min(seen[i, j], d)
    for pair, least in exact.items():
        assert least <= seen[pair] + 1e-6
        assert least == pytest.approx(seen[pair], abs=0.1)


def test_formation_and_plan_have_rows_with_their_figures() -> None:
    rows = {c.name: c for c in report().checks}
    assert rows["slots"].passed
    assert rows["lowest slot"].value == pytest.approx(10.0)
    assert rows["plan's speed"].value == pytest.approx(1.0, abs=0.01)
    assert rows["plan's speed"].limit == "<= 3 m/s"
