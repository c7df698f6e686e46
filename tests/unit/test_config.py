"""fleet.toml: what is refused, and that the refusal says where, what came and what is allowed."""

import copy
import math
import re
import tomllib
from collections.abc import Callable, Iterator
from math import hypot, sqrt
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config import FleetConfig, load
from companion.config.checks import refuse_shared_lines
from companion.config.endpoints import autopilot_port, companion_port, serial_endpoint, udp_endpoint
from companion.config.file import parse
from companion.config.overrides import on_this_computer, plan_legs, resize
from companion.core.frames import Ned
from companion.core.law.starling import StarlingLaw
from companion.core.monitor import own_error_m
from companion.core.prediction import PlainHold, Pull, ReturningHold
from companion.core.safety.fence import Fence
from companion.core.trajectory.legs import GotoLeg, TurnLeg, VelocityLeg
from companion.errors import ConfigError

DEFAULT = Path(__file__).resolve().parents[2] / "fleet.toml"
Tables = dict[str, Any]
Change = Callable[[Tables], None]
NAN, INF = math.nan, math.inf


def default_tables() -> Tables:
    return tomllib.loads(DEFAULT.read_text(encoding="utf-8"))


def put(path: str, value: object) -> Change:
    """Set a value at a dotted path, with numbers for places in a list; missing tables come into being."""

    def change(tables: Tables) -> None:
        place: Any = tables
        *parents, last = (int(p) if p.isdigit() else p for p in path.split("."))
        for part in parents:
            place = place.setdefault(part, {}) if isinstance(place, dict) else place[part]
        place[last] = value

    return change


def changed(*changes: Change) -> Tables:
    tables = default_tables()
    for change in changes:
        change(tables)
    return tables


def refusal(*changes: Change) -> str:
    with pytest.raises(ConfigError) as caught:
        parse(changed(*changes), "fleet.toml")
    return str(caught.value)


def test_the_default_file_flies_ten_vehicles_in_a_v_at_four_metres() -> None:
    config = load(DEFAULT)
    assert [v.id for v in config.vehicles] == list(range(1, 11))
    assert [v.system_id for v in config.vehicles] == list(range(1, 11))
    assert (config.formation.shape, config.formation.spacing_m) == ("v", 4.0)
    assert config.plan_legs(config.first_motion.centre_ned_m)
    assert config.first_motion.velocity_ned_m_s == (0.0, 0.0, 0.0)


def leaves(value: object, path: str = "") -> Iterator[tuple[str, object]]:
    if isinstance(value, dict):
        for key, item in value.items():
            yield from leaves(item, f"{path}.{key}" if path else key)
    elif isinstance(value, list):
        for k, item in enumerate(value):
            yield from leaves(item, f"{path}.{k}")
    else:
        yield path, value


def with_every_number() -> Tables:
    """The default file with every number written out that it may leave out."""
    tables = changed(
        put("law.r0_m", 2.0),
        put("peers.scouting_port", 7450),
        put("formation.custom_m", [[4.0 * k, 0.0, 0.0] for k in range(10)]),
        put("vehicle.0", {"id": 1, "system_id": 1, "slot": 0, "pad_m": [1.0, -20.0]}),
    )
    tables["plan"]["legs"].append({"kind": "goto", "north_m": 4.0, "east_m": 1.0, "altitude_m": 9.0, "speed_m_s": 1.0})
    tables["plan"]["legs"][0].update(east_m_s=0.0, up_m_s=0.0)
    return tables


NUMBERS = [
    path
    for path, value in leaves(with_every_number())
    if isinstance(value, int | float) and not isinstance(value, bool)
]


def in_file(path: str) -> str:
    return "$" + re.sub(r"\.(\d+)", r"[\1]", "." + path)


@pytest.mark.parametrize("path", NUMBERS)
def test_every_number_that_is_not_finite_or_absurd_or_no_number_is_refused_by_name(path: str) -> None:
    parse(with_every_number(), "fleet.toml")
    wrong: tuple[object, ...] = (NAN, INF, -INF, 1e300, -1e300, True, "4", [1.0], {})
    for value in wrong:
        tables = with_every_number()
        put(path, value)(tables)
        with pytest.raises(ConfigError) as caught:
            parse(tables, "fleet.toml")
        text = str(caught.value)
        assert text.startswith("fleet.toml: $")
        assert in_file(path) in text, (path, value, text)
        assert "got" in text
        if not isinstance(value, list | dict):
            assert repr(value) in text, (path, value, text)


VELOCITY, TURN = "plan.legs.0", "plan.legs.1"
RANGES = [
    ("fleet.name", "Two Words", "must be at most 32 of a-z"),
    ("fleet.frame", "body", "must be 'global' or 'local'"),
    ("fleet.origin.latitude_deg", 90.1, "a finite number >= -90 and <= 90 deg"),
    ("fleet.origin.longitude_deg", -181.0, "a finite number >= -180 and <= 180 deg"),
    ("fleet.origin.altitude_amsl_m", 9001, "a finite number >= -500 and <= 9000 m"),
    ("formation.spacing_m", 0, "a finite number > 0 and <= 1000 m"),
    ("formation.spacing_m", -4.0, "a finite number > 0 and <= 1000 m"),
    ("formation.heading_deg", 361, "a finite number >= -360 and <= 360 deg"),
    ("formation.altitude_m", 0.5, "a finite number >= 1 and <= 500 m"),
    ("plan.then", "hover", "'stay', 'land' or 'return'"),
    ("plan.heading", "north", "'fixed' or 'track'"),
    ("plan.automatic", 1, "true or false"),
    (f"{VELOCITY}.kind", "loop", "one of hold, velocity, turn, goto"),
    (f"{VELOCITY}.duration_s", 0, "a finite number > 0 and <= 86400 s"),
    (f"{TURN}.rate_deg_s", 61.0, "a finite number >= -60 and <= 60 deg/s"),
    (f"{TURN}.angle_deg", 5e-324, "a finite number >= 0.01 and <= 36000 deg"),
    ("law.kind", "boids", "one of starling, paper, intent"),
    ("law.hold", "second", "'returning', 'damped', 'zero' or 'first'"),
    ("law.k_s", -0.1, "a finite number >= 0 and <= 100"),
    ("law.a_max_m_s2", 1e-9, "a finite number >= 2 and <= 20 m/s^2"),
    ("trigger.kind", "always", "one of error, switching, periodic"),
    ("trigger.gamma_s2", 0.0, "a finite number >= 0.0001 and <= 100 s^2"),
    ("trigger.near_period_s", 0.049, "a finite number >= 0.05 and <= 0.2 s"),
    ("trigger.near_period_s", 0.21, "a finite number >= 0.05 and <= 0.2 s"),
    ("trigger.t_max_s", 61.0, "a finite number >= 0.5 and <= 60 s"),
    ("limits.speed_max_m_s", 12.1, "a finite number >= 0.2 and <= 12 m/s"),
    ("limits.climb_max_m_s", 3.1, "a finite number >= 0.1 and <= 3 m/s"),
    ("limits.descent_max_m_s", 1.6, "a finite number >= 0.1 and <= 1.5 m/s"),
    ("limits.jerk_max_m_s3", 1e-9, "a finite number >= 5 and <= 1000 m/s^3"),
    ("limits.avoidance_acceleration_m_s2", 8.5, "a finite number >= 2 and <= 8 m/s^2"),
    ("limits.avoidance_acceleration_m_s2", 1e-6, "a finite number >= 2 and <= 8 m/s^2"),
    ("limits.position_noise_m", 1e5, "a finite number >= 0 and <= 5 m"),
    ("law.hold_damping_s", 1e-300, "a finite number >= 0.05 and <= 10 s"),
    ("trigger.epsilon_m", 1e-200, "a finite number >= 0.01 and <= 5 m"),
    ("trigger.t_max_s", 1e-9, "a finite number >= 0.5 and <= 60 s"),
    ("trigger.t_min_s", 5.0, "a finite number >= 0 and <= 1 s"),
    ("peers.wait_s", 1e-9, "a finite number >= 1 and <= 3600 s"),
    ("peers.isolated_flight_s", 0.5, "a finite number >= 1 and <= 3600 s"),
    ("failsafe.isolated_hold_s", 1e5, "a finite number >= 1 and <= 3600 s"),
    ("limits.barrier", "yes", "true or false"),
    ("fence.radius_m", 0.0, "a finite number > 0 and <= 100000 m"),
    ("fence.floor_m", -501.0, "a finite number >= -500 and <= 1000 m"),
    ("fence.ceiling_m", 1001, "a finite number >= -500 and <= 1000 m"),
    ("fence.margin_m", -0.1, "a finite number >= 0 and <= 100 m"),
    ("fence.vertical_margin_m", 100.5, "a finite number >= 0 and <= 100 m"),
    ("peers.digest", 31, "a whole number >= 0 and <= 30"),
    ("peers.digest", 2.0, "a whole number >= 0 and <= 30"),
    ("peers.network", "mesh", "'laptop' or 'field'"),
    ("peers.notice_lost_s", 0.9, "a finite number >= 1 and <= 10 s"),
    ("peers.notice_lost_s", 10.1, "a finite number >= 1 and <= 10 s"),
    ("peers.notice_lost_s", NAN, "a finite number >= 1 and <= 10 s"),
    ("peers.notice_lost_s", "soon", "a finite number >= 1 and <= 10 s"),
    ("peers.scouting_port", 80, "a whole number >= 1024 and <= 65535"),
    ("preflight.battery_min_percent", 101, "a finite number >= 0 and <= 100 %"),
    ("preflight.battery_min_percent", -1, "a finite number >= 0 and <= 100 %"),
    ("preflight.position_rate_min_hz", 1, "a finite number >= 5 and <= 1000 Hz"),
    ("preflight.round_trip_limit_s", 0, "a finite number > 0 and <= 1 s"),
    ("preflight.clock_limit_s", NAN, "a finite number > 0 and <= 0.5 s"),
    ("preflight.origin_limit_m", 0, "a finite number > 0"),
    ("preflight.altitude_spread_m", 0, "a finite number > 0"),
    ("preflight.pad_limit_m", 0, "a finite number > 0"),
    ("preflight.offboard_loss_limit_s", 61, "a finite number > 0 and <= 5 s"),
    ("preflight.require_rc", 1, "true or false"),
    ("stub.dynamics", "rigid", "'px4' or 'ideal'"),
    ("vehicle.0.id", 0, "a whole number >= 1 and <= 250"),
    ("vehicle.0.id", 251, "a whole number >= 1 and <= 250"),
    ("vehicle.0.id", "one", "a whole number >= 1 and <= 250"),
    ("vehicle.0.system_id", 0, "a whole number >= 1 and <= 250"),
    ("vehicle.0.slot", "first", 'a whole number >= 0 and <= 249, or "auto"'),
    ("vehicle.0.slot", -1, 'a whole number >= 0 and <= 249, or "auto"'),
    ("vehicle.0.mavlink", "tcp://127.0.0.1:5760", "udp://HOST:PORT or serial:///dev/NAME:BAUD"),
    ("vehicle.0.mavlink", "udp://127.0.0.1:70000", "udp://HOST:PORT or serial:///dev/NAME:BAUD"),
    ("vehicle.0.zenoh", "127.0.0.1:7447", "PROTOCOL/HOST:PORT"),
    ("vehicle.0.zenoh", "tcp/127.0.0.1:70000", "PROTOCOL/HOST:PORT"),
]


@pytest.mark.parametrize(("path", "value", "allowed"), RANGES, ids=[f"{p}={v}" for p, v, _ in RANGES])
def test_a_value_out_of_its_range_is_refused_with_place_value_and_range(path: str, value: object, allowed: str) -> None:
    text = refusal(put(path, value))
    assert text.startswith(f"fleet.toml: {in_file(path)}")
    assert allowed in text
    assert "got" in text
    assert "\n" not in text


@pytest.mark.parametrize(
    ("path", "known"),
    [
        ("colour", "fence, fleet, formation, launch"),
        ("fleet.colour", "frame, name, origin"),
        ("fence.colour", "ceiling_m, centre_m, floor_m, margin_m, polygon_m, radius_m, vertical_margin_m"),
        ("fleet.origin.colour", "altitude_amsl_m, latitude_deg, longitude_deg"),
        ("law.colour", "a_max_m_s2"),
        ("vehicle.3.colour", "enabled, id, mavlink"),
        (f"{VELOCITY}.colour", "duration_s, east_m_s, kind, north_m_s, up_m_s"),
        (f"{TURN}.colour", "angle_deg, kind, rate_deg_s"),
    ],
)
def test_an_unknown_key_is_refused_and_the_known_ones_are_named(path: str, known: str) -> None:
    text = refusal(put(path, 1))
    assert text.startswith(f"fleet.toml: {in_file(path)} is not a known key; known here: ")
    assert known in text


@pytest.mark.parametrize(
    ("one", "other", "text"),
    [
        (put("vehicle.1.id", 1), None, "$.vehicle[1].id must be unique, got 1 as in $.vehicle[0]"),
        (put("vehicle.1.system_id", 1), None, "$.vehicle[1].system_id must be unique, got 1 as in $.vehicle[0]"),
        (
            put("vehicle.1.mavlink", "udp://0.0.0.0:14540"), None,
            "$.vehicle[1].mavlink must be unique, got 14540 as in $.vehicle[0]",
        ),
        (
            put("vehicle.0.mavlink", "serial:///dev/ttyS1:921600"), put("vehicle.1.mavlink", "serial:///dev/ttyS1:57600"),
            "$.vehicle[1].mavlink must be unique, got '/dev/ttyS1' as in $.vehicle[0]",
        ),
        (
            put("vehicle.0.zenoh", "tcp/127.0.0.1:7447"), put("vehicle.1.zenoh", "tcp/127.0.0.1:7447"),
            "$.vehicle[1].zenoh must be unique, got 'tcp/127.0.0.1:7447' as in $.vehicle[0]",
        ),
        (put("vehicle.0.slot", 3), put("vehicle.1.slot", 3), "$.vehicle[1].slot must be unique, got 3"),
    ],
    ids=["id", "system id", "port", "serial device", "endpoint", "slot"],
)  # fmt: skip
def test_what_two_vehicles_share_is_refused_with_both_their_places(
    one: Change, other: Change | None, text: str
) -> None:
    assert text in refusal(one, *([other] if other else []))


def on_computers(*lines: str, host: str = "10.0.0.{k}") -> Change:
    """Vehicles of a mesh, each on the computer that its address names, with these lines to their autopilots."""

    def change(tables: Tables) -> None:
        tables["peers"]["network"] = "field"
        tables["vehicle"] = [
            {"id": k, "mavlink": line, "zenoh": f"tcp/{host.format(k=k)}:{7446 + k}"} for k, line in enumerate(lines, 1)
        ]

    return change


LINES = ("serial:///dev/autopilot:921600", "udp://0.0.0.0:14540")


@pytest.mark.parametrize("line", LINES)
def test_lines_of_one_name_on_several_computers_are_as_many_lines(line: str) -> None:
    config = parse(changed(on_computers(*[line] * 6)), "fleet.toml")
    assert [v.mavlink for v in config.vehicles] == [line] * 6
    with pytest.raises(ConfigError) as caught:
        refuse_shared_lines(config)
    assert str(caught.value).startswith(
        f"vehicles 1, 2, 3, 4, 5, 6 have one line, mavlink = {line!r}, and one computer "
    )
    assert "fleet up --rehearse" in str(caught.value)


@pytest.mark.parametrize(("host", "where"), [("10.0.0.1", " on 10.0.0.1"), ("127.0.0.1", ""), ("[::1]", "")])
@pytest.mark.parametrize("line", LINES)
def test_lines_of_one_name_on_one_computer_are_refused(line: str, host: str, where: str) -> None:
    assert f"$.vehicle[1].mavlink must be unique{where}, got" in refusal(on_computers(line, line, host=host))


def test_a_hardware_file_is_rehearsed_on_one_computer_with_its_own_network_limits() -> None:
    tables = changed(on_computers(*[LINES[0]] * 6), put("preflight.require_rc", True))
    hardware = parse(tables, "fleet.toml")
    on_this_computer(tables)
    here = parse(tables, "fleet.toml")
    refuse_shared_lines(here)
    assert (here.peers.network, here.notice_lost_s) == ("laptop", hardware.notice_lost_s)
    assert [v.mavlink for v in here.vehicles] == [f"udp://127.0.0.1:{companion_port(k)}" for k in range(6)]
    assert not here.preflight.require_rc
    assert here.fleet.name == f"{hardware.fleet.name}-rehearsal", "no verb for the vehicles reaches it"


def test_the_longest_name_leaves_room_for_a_rehearsals() -> None:
    tables = changed(put("fleet.name", "a" * 32))
    on_this_computer(tables)
    assert parse(tables, "fleet.toml").fleet.name == f"{'a' * 22}-rehearsal"


def line_of(*slots: list[float]) -> Change:
    def change(tables: Tables) -> None:
        tables["formation"].update(shape="custom", custom_m=list(slots))
        tables["vehicle"] = tables["vehicle"][: len(slots)]

    return change


@pytest.mark.parametrize(("level_m", "fit"), [(0.99, False), (1.0, True), (1.01, True)])
def test_slots_above_each_other_are_far_enough_apart_to_land(level_m: float, fit: bool) -> None:
    stacked = line_of([0.0, 0.0, 0.0], [level_m, 0.0, -5.0])
    if fit:
        parse(changed(stacked), "fleet.toml")
    else:
        assert "'custom' must be at least 1 m apart on the level, since vehicles land where they are" in refusal(
            stacked
        )


def test_a_way_back_that_leaves_the_fence_is_refused() -> None:
    def notch(tables: Tables) -> None:
        edge = [[-8, -9], [26, -9], [26, 30], [-8, 30], [-8, 14], [9, 14], [9, 9], [-8, 9]]
        tables["fence"] = {"polygon_m": edge, "floor_m": 1.0, "ceiling_m": 30.0, "margin_m": 1.0}
        tables["vehicle"] = tables["vehicle"][:2]
        tables["plan"].update(then="land", legs=[
            {"kind": "goto", "north_m": north, "east_m": east, "speed_m_s": 2.0}
            for north, east in ((18.0, 0.0), (18.0, 22.0), (0.0, 22.0))
        ])  # fmt: skip

    parse(changed(notch), "fleet.toml")
    assert '$.plan.then = "return": the way back from the last leg must stay inside' in refusal(
        notch, put("plan.then", "return")
    )


def drop(path: str) -> Change:
    def change(tables: Tables) -> None:
        place: Any = tables
        *parents, last = (int(p) if p.isdigit() else p for p in path.split("."))
        for part in parents:
            place = place[part]
        del place[last]

    return change


def nobody(tables: Tables) -> None:
    for v in tables["vehicle"]:
        v["enabled"] = False


def legs(*rows: dict[str, object]) -> Change:
    return put("plan.legs", list(rows))


def fence(**table: object) -> Change:
    return put("fence", {"floor_m": 2.0, "ceiling_m": 50.0, **table})


def line_within(radius_m: float) -> Change:
    """Ten in line are 36 m wide."""

    def change(tables: Tables) -> None:
        tables["formation"]["shape"] = "line"
        tables["fence"]["radius_m"] = radius_m

    return change


def periodic(period_s: float) -> Change:
    def change(tables: Tables) -> None:
        tables["trigger"].update(kind="periodic", period_s=period_s)

    return change


def polygon(*corners: list[int]) -> Change:
    return fence(polygon_m=list(corners))


def in_the_field(first: str) -> Change:
    def change(tables: Tables) -> None:
        tables["peers"]["network"] = "field"
        for k, v in enumerate(tables["vehicle"]):
            v["zenoh"] = f"tcp/10.0.0.{k + 1}:7447" if k else first

    return change


ACROSS = [
    (put("formation.spacing_m", 1.5), "$.formation.spacing_m", "the safety radius 1.50 m", "got 1.50 m"),
    (put("law.r0_m", 5.0), "$.formation.spacing_m", "separation's range 5.00 m", "got 4.00 m"),
    (put("formation.shape", "star"), "$.formation.shape", "v, line, column, circle, grid, spiral, sphere, custom",
     "got 'star'"),
    (put("formation.shape", "custom"), "$.formation.custom_m", "each of the 10 enabled vehicles", "got 0"),
    (line_of([0.0, 0.0, 0.0], [0.5, 0.0, 3.2]), "$.formation.spacing_m", "above each other inside the downwash",
     "larger spacing"),
    (line_of([0.0, 0.0, 0.0], [4.0, 0.0, 30.0]), "$.formation.altitude_m", "no slot below 1 m", "got -5.00"),
    (drop("fleet.origin"), "$.fleet.origin", "is required", "latitude_deg, longitude_deg, altitude_amsl_m"),
    (drop("vehicle.0.id"), "$.vehicle[0].id", "is required", ""),
    (put("vehicle", []), "$.vehicle", "at least 1", "got 0"),
    (nobody, "$.vehicle", "at least one vehicle must be enabled", ""),
    (put("peers.network", "field"), "$.vehicle[0].zenoh", 'tcp/HOST:PORT with $.peers.network = "field"',
     "got nothing: name the address"),
    (in_the_field("udp/10.0.0.1:7447"), "$.vehicle[0].zenoh", "by UDP a pair that loses a declaration stays deaf",
     "got udp/10.0.0.1:7447: name the address"),
    (put("vehicle.0.slot", 10), "$.vehicle[0].slot", "below the 10 enabled vehicles", "got 10"),
    (put("launch.spacing_m", 1.0), "$.launch.spacing_m", "at least the safety radius 1.50 m", "got 1.00 m"),
    (put("vehicle.0.pad_m", [-2.0, -7.5]), "$.vehicle[].pad_m", "at least the safety radius", "got"),
    (put("trigger", {"t_min_s": 0.5, "t_max_s": 0.5}), "$.trigger.t_min_s", "below $.trigger.t_max_s = 0.5", "got 0.5"),
    (put("peers.range_m", 0.5), "$.peers.range_m", "must be at least 6.96 m", "got 0.5"),
    (put("peers.range_m", 6.95), "$.peers.range_m", "must be at least 6.96 m", "got 6.95"),
    (put("law.k_v", 0.09), "$.law.k_v", 'at least 0.1 1/s with $.law.hold = "returning"',
     'got 0.09; or take hold = "damped"'),
    (put("trigger.t_min_s", 0.11), "$.trigger.t_min_s", "<= $.trigger.near_period_s = 0.1 s", "got 0.11"),
    (periodic(0.04), "$.trigger.period_s", ">= $.trigger.t_min_s = 0.05 s", "got 0.04"),
    (periodic(60.0), "$.launch.spacing_m", "87.19 m apart (86.54 m of it since a peer is known no better with "
     "$.trigger.period_s = 60 s)", "got 4.00"),
    (periodic(0.6), "$.launch.spacing_m", "known no better with $.trigger.period_s = 0.6 s", "got 4.00"),
    (put(f"{VELOCITY}.north_m_s", 3.1), "$.plan.legs[0]", "<= 3 m/s (3/4 of $.limits.speed_max_m_s)", "got 3.1"),
    (put(f"{VELOCITY}.up_m_s", 1.2), "$.plan.legs[0].up_m_s", "<= 1.125 m/s", "got 1.2"),
    (put(f"{VELOCITY}.up_m_s", -0.8), "$.plan.legs[0].up_m_s", ">= -0.75", "got -0.8"),
    (put(f"{VELOCITY}.up_m_s", -0.5), "$.plan.legs[0]", "leads to -1.66 m above the origin", "must stay at 1 m"),
    (put(f"{TURN}.rate_deg_s", 0), "$.plan.legs[1].rate_deg_s", "0.01 deg/s or more", "got 0"),
    (drop(f"{TURN}.angle_deg"), "$.plan.legs[1].angle_deg", "is required except in the last leg", ""),
    (legs({"kind": "goto", "north_m": 5.0, "east_m": 0.0, "speed_m_s": 3.5}), "$.plan.legs[0].speed_m_s",
     "<= 3 m/s", "got 3.5"),
    (put("fence.polygon_m", [[-90, -90], [90, -90], [90, 90]]), "$.fence", "radius_m or polygon_m", "got both"),
    (polygon([-90, -90], [90, -90]), "$.fence.polygon_m", "at least 3 corners", "got 2"),
    (polygon([-90, -90], [90, 90], [90, -90], [-90, 90]), "$.fence.polygon_m", "not cross or touch itself",
     "got Self-intersection[0 0]"),
    (polygon([-90, -90], [90, -90], [90, -90], [-90, -90]), "$.fence.polygon_m", "not cross or touch itself", "got"),
    (polygon([-90, -1], [90, -1], [90, 1], [-90, 1]), "$.fence.polygon_m", "wider than twice $.fence.margin_m = 2 m",
     "got nothing inside"),
    (fence(centre_m=[0.0, 0.0]), "$.fence.centre_m", "belongs to radius_m", "missing"),
    (put("fence.radius_m", 2.0), "$.fence.radius_m", "> $.fence.margin_m = 2 m", "got 2"),
    (put("fence.ceiling_m", 2.5), "$.fence.ceiling_m", "at least 1 m", "got 2.5"),
    (drop("fence.floor_m"), "$.fence.floor_m", "is required", ""),
    (put("vehicle.2.pad_m", [199.0, 0.0]), "$.vehicle[2].pad_m", "inside the fence by $.fence.margin_m = 2 m",
     "got [199, 0], 1.00 m too far out"),
    (put("formation.altitude_m", 2.4), "$.formation.altitude_m", ">= 2.5 and <= 49.5 m", "got 2.4"),
    (put("formation.altitude_m", 49.6), "$.formation.altitude_m", ">= 2.5 and <= 49.5 m", "got 49.6"),
    (line_within(19.0), "$.formation", "must be inside the fence by its margin", "got 1.00 m beyond it"),
    (put("fence.radius_m", 32.0), "$.plan.legs[0]", "must stay inside the fence by its margin", "got vehicle"),
    (legs({"kind": "hold", "duration_s": 1.0}, {"kind": "goto", "north_m": 500.0, "east_m": 0.0}), "$.plan.legs[1]",
     "must stay inside the fence", "m beyond it"),
    (legs({"kind": "velocity", "north_m_s": 2.9, "duration_s": 20.0}, {"kind": "turn", "rate_deg_s": 1.0}),
     "$.plan.legs[1]", "must stay inside the fence", "s into the plan"),
    (legs({"kind": "velocity", "up_m_s": 1.0, "duration_s": 60.0}), "$.plan.legs[0]", "inside the fence",
     "got vehicle"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "where", "allowed", "came"), ACROSS, ids=[w for _, w, _, _ in ACROSS])
def test_values_that_do_not_go_together_are_refused(change: Change, where: str, allowed: str, came: str) -> None:
    text = refusal(change)
    assert text.startswith("fleet.toml: $")
    assert where in text
    assert allowed in text
    assert came in text


@pytest.mark.parametrize(
    ("changes", "notice_s", "t_max_s"),
    [
        ((), 4.0, 10.0), ((in_the_field("tcp/10.0.0.1:7447"),), 2.0, 10.0),
        ((put("peers.notice_lost_s", 10),), 10.0, 10.0), ((put("peers.notice_lost_s", 1.0),), 1.0, 5.0),
        ((put("peers.notice_lost_s", 1.5), put("trigger.t_max_s", 9.0)), 1.5, 9.0),
    ],
)  # fmt: skip
def test_the_longest_silence_follows_from_how_soon_a_lost_peer_is_to_be_noticed(
    changes: tuple[Change, ...], notice_s: float, t_max_s: float
) -> None:
    config = parse(changed(*changes), "fleet.toml")
    assert (config.notice_lost_s, config.trigger.t_max_s) == (notice_s, t_max_s)
    assert config.peer_limits.notice_lost_s == (notice_s if config.peers.network == "field" else 1.5)
    assert config.peer_limits.heartbeat_s == config.peer_motion.t_max_s == t_max_s


def test_the_fence_of_the_file_is_what_the_safety_filter_keeps() -> None:
    config = load(DEFAULT)
    assert config.safety_limits.fence == config.geofence == Fence(2.0, 50.0, radius_m=200.0)
    assert parse(changed(drop("fence")), "fleet.toml").safety_limits.fence is None
    corners = ([-90, -90], [90, -90], [90, 90], [-90, 90])
    parsed = parse(changed(polygon(*corners)), "fleet.toml").geofence
    assert parsed is not None
    assert parsed.corners_m == tuple(map(tuple, corners))
    assert parsed.margin_m == 2.0
    low = parse(changed(fence()), "fleet.toml").geofence
    assert low is not None
    assert low.edge_clearance_m(1e4, 0.0) == INF


@pytest.mark.parametrize(("radius", "inside"), [(51.3, True), (51.0, False)])
def test_the_plan_of_the_file_reaches_to_49_m_and_the_margin(radius: float, inside: bool) -> None:
    tables = changed(put("fence.radius_m", radius))
    if inside:
        parse(tables, "fleet.toml")
    else:
        with pytest.raises(ConfigError, match=r"\$\.plan\.legs\[\d\] must stay inside the fence"):
            parse(tables, "fleet.toml")


def test_without_a_fence_a_plan_may_lead_anywhere() -> None:
    parse(changed(drop("fence"), legs({"kind": "goto", "north_m": 5000.0, "east_m": 0.0})), "fleet.toml")


def test_all_faults_are_told_at_once_each_on_its_line() -> None:
    lines = refusal(put("law.k_s", -1), put("formation.altitude_m", NAN), put("peers.digest", 99)).splitlines()
    assert len(lines) == 3
    assert all(line.startswith("fleet.toml: $.") for line in lines)


def test_a_local_frame_needs_no_origin() -> None:
    config = parse(changed(drop("fleet.origin"), put("fleet.frame", "local")), "fleet.toml")
    assert config.fleet.origin is None


def test_without_the_barrier_slots_need_only_keep_out_of_separations_range() -> None:
    tables = changed(put("limits.barrier", False), put("formation.spacing_m", 1.0), put("launch.spacing_m", 1.0))
    assert parse(tables, "fleet.toml").spacing_min_m == pytest.approx(0.7)


@pytest.mark.parametrize("text", ["[fleet", "name = "])
def test_a_file_that_is_no_toml_is_refused_by_name(tmp_path: Path, text: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(ConfigError, match=r"mine\.toml: is not valid TOML"):
        load(path)


def test_a_file_that_is_not_there_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.toml: cannot be read: No such file"):
        load(tmp_path / "none.toml")


scalars = st.one_of(
    st.floats(), st.integers(), st.booleans(), st.text(max_size=8), st.none(),
    st.lists(st.floats(), max_size=3), st.dictionaries(st.text(max_size=4), st.integers(), max_size=2),
)  # fmt: skip
PLACES = [path for path, _ in leaves(default_tables())] + list(default_tables())


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(PLACES), scalars)
def test_whatever_stands_in_one_place_the_file_loads_or_is_refused(path: str, value: object) -> None:
    told = "fleet.toml: $"
    try:
        assert isinstance(parse(changed(put(path, value)), "fleet.toml"), FleetConfig)
    except ConfigError as error:
        told = str(error)
    assert told.startswith("fleet.toml: $")


@pytest.mark.parametrize(
    ("change", "shared"),
    [
        (put("stub.gust_m_s2", 0.0), True),
        (put("stub.dynamics", "ideal"), True),
        (put("vehicle.0.mavlink", "udp://0.0.0.0:15000"), True),
        (put("vehicle.0.zenoh", "tcp/10.0.0.1:7447"), True),
        (put("law.k_s", 3.1), False),
        (put("trigger.epsilon_m", 0.31), False),
        (put("limits.gust_m_s2", 0.31), False),
        (put("formation.spacing_m", 4.1), False),
        (put("vehicle.0.pad_m", [0.0, -30.0]), False),
        (put("vehicle.0.slot", 3), False),
        (put("vehicle.9.enabled", False), False),
        (put("fleet.name", "other"), False),
        (put("plan.then", "stay"), False),
        (put("fence.radius_m", 199.0), False),
        (drop("fence"), False),
    ],
)
def test_the_shared_hash_tells_what_vehicles_must_agree_on_and_nothing_else(change: Change, shared: bool) -> None:
    mine = parse(default_tables(), "a.toml").shared_hash
    theirs = parse(changed(change), "b.toml").shared_hash
    assert (mine == theirs) is shared


def test_a_disabled_vehicle_keeps_its_place_in_ports_and_pads() -> None:
    everyone = parse(default_tables(), "fleet.toml")
    fewer = parse(changed(put("vehicle.3.enabled", False)), "fleet.toml")
    assert [v for v in everyone.vehicles if v.id != 4] == list(fewer.vehicles)
    with pytest.raises(ConfigError, match="vehicle 4 is not an enabled vehicle"):
        fewer.by_id(4)


def test_ports_leave_the_ground_stations_alone() -> None:
    assert [companion_port(k) for k in (0, 9, 10, 29)] == [14540, 14549, 24550, 24569]
    assert [autopilot_port(k) for k in (0, 9, 10, 29)] == [14580, 14589, 25550, 25569]
    assert 14550 not in {companion_port(k) for k in range(250)}


@pytest.mark.parametrize(
    ("url", "endpoint"),
    [
        ("udp://127.0.0.1:14540", ("127.0.0.1", 14540)), ("udp://:14540", ("0.0.0.0", 14540)),
        ("udp://127.0.0.1", None), ("udp://127.0.0.1:0", None), ("udp://127.0.0.1:65536", None),
        ("udp://127.0.0.1:port", None), ("udp://127.0.0.1:1/x", None), ("tcp://127.0.0.1:1", None), ("", None),
        ("udp://[::1", None),
    ],
)  # fmt: skip
def test_udp_links_are_read_or_named_as_something_else(url: str, endpoint: tuple[str, int] | None) -> None:
    assert udp_endpoint(url) == endpoint


def test_serial_links_are_read_or_named_as_something_else() -> None:
    assert serial_endpoint("serial:///dev/ttyAMA0:921600") == ("/dev/ttyAMA0", 921600)
    assert serial_endpoint("serial:///dev/ttyAMA0") is None
    assert serial_endpoint("udp://127.0.0.1:14540") is None


def test_pads_are_a_grid_about_the_origin_in_the_files_order() -> None:
    vehicles = load(DEFAULT).vehicles
    assert sum(v.pad_north_m for v in vehicles) == pytest.approx(0.0)
    assert sum(v.pad_east_m for v in vehicles) == pytest.approx(0.0)
    assert vehicles[0].pad_north_m - vehicles[5].pad_north_m == pytest.approx(4.0)
    assert vehicles[1].pad_east_m - vehicles[0].pad_east_m == pytest.approx(4.0)


def test_the_safety_radius_follows_the_trigger() -> None:
    """No kind has a radius by default: a slower period gives a larger one, and what is too large is refused."""
    radii = [parse(changed(periodic(p)), "fleet.toml").safety_radius_m for p in (0.05, 0.1, 0.2, 0.4)]
    assert radii == sorted(radii)
    motion = parse(default_tables(), "fleet.toml").peer_motion
    age_s = 0.05 + 0.02 + 0.05  # its period, the control period, the delay
    assert radii[0] == pytest.approx(0.65 + own_error_m(age_s, motion) + 0.5 * (8.0 + 4.0 / 0.7) * age_s**2)
    assert radii[-1] > 2 * radii[0]
    late = parse(changed(put("limits.control_rate_hz", 20.0)), "fleet.toml")
    assert late.safety_radius_m > parse(default_tables(), "fleet.toml").safety_radius_m


def test_what_was_accepted_by_the_shipped_values_is_accepted() -> None:
    """Pads 1.5 m and slots 1.70 m apart, to the centimetre."""
    config = parse(changed(put("launch.spacing_m", 1.5), put("formation.spacing_m", 1.7)), "fleet.toml")
    assert config.safety_radius_m > 1.49
    assert config.spacing_min_m > 1.69


BRAKES_M_S2 = {"returning": 4.0 / 0.7, "damped": 4.0 / 0.7, "zero": 0.0, "first": 0.0}
"""by the damped hold, which is the returning one's too along the vertical and without a plan"""


@pytest.mark.parametrize("hold", BRAKES_M_S2)
def test_what_a_hold_leaves_out_counts_in_a_periods_bound(hold: str) -> None:
    config = parse(changed(put("law.hold", hold)), "fleet.toml")
    motion = config.peer_motion
    assert motion.deviation_m_s2 == pytest.approx(8.0 + BRAKES_M_S2[hold])
    assert motion.drift_m_s == (4.0 if hold == "zero" else 0.0)
    assert motion.speed_m_s == pytest.approx(8.0 + (sqrt(0.3) if hold == "returning" else 0.0))


def test_a_returning_hold_beyond_the_laws_limit_counts_in_what_is_damped_of_it() -> None:
    strong = parse(changed(put("law.k_v", 3.0), put("law.hold", "returning")), "fleet.toml").law.holding()
    # Of 4 m/s it may return 5 / (0.3 + sqrt(9.3) 4), and damps the rest.
    share = 5.0 / (0.3 + sqrt(9.3) * 4.0)
    assert strong.bounds(4.0).braking_m_s2 == pytest.approx(5.0 + (1.0 - share) * 4.0 / 0.7)
    within = parse(changed(put("law.k_v", 1.0), put("law.hold_damping_s", 2.0)), "fleet.toml").law.holding()
    assert within.bounds(4.0).braking_m_s2 == pytest.approx(hypot(4.3, sqrt(0.3) * 4.0))


def test_the_returning_hold_follows_the_laws_own_pull_and_is_no_other_laws() -> None:
    config = parse(changed(put("law.k_v", 2.0), put("law.k_p", 0.5)), "fleet.toml")
    assert config.law.holding() == ReturningHold(Pull(2.0, 0.5, 1.0, 5.0), PlainHold("damped", 0.7))
    tables = changed(put("law.kind", "paper"), put("law.hold", "returning"))
    with pytest.raises(ConfigError, match=r"law.hold.*'damped', 'zero' or 'first'.*'returning'"):
        parse(tables, "fleet.toml")


DIFFERING = {
    "nothing": ((), []),
    "a link": ((put("vehicle.2.mavlink", "udp://127.0.0.1:15000"),), []),
    "a gain": ((put("law.k_s", 2.5),), ["law.k_s"]),
    "keys of two tables": (
        (put("formation.altitude_m", 11.0), put("peers.digest", 4)), ["formation.altitude_m", "peers.digest"],
    ),
    "another law": ((put("law", {"kind": "paper"}),), ["law"]),
    "no fence": ((drop("fence"),), ["fence"]),
    "a pad": ((put("vehicle.2.pad_m", [8.0, 8.0]),), ["vehicle[2]"]),
    "a vehicle fewer": ((drop("vehicle.9"),), ["vehicle"]),
    "the legs": ((drop("plan.legs.0"),), ["plan.legs"]),
}  # fmt: skip


@pytest.mark.parametrize("name", DIFFERING)
def test_the_keys_in_which_two_files_differ_are_named(name: str) -> None:
    changes, keys = DIFFERING[name]
    own, other = parse(default_tables(), "fleet.toml"), parse(changed(*changes), "fleet.toml")
    assert own.differing(other.shared_digests) == other.differing(own.shared_digests) == keys
    assert (own.shared_hash == other.shared_hash) is (not keys)


def test_a_table_that_is_not_ours_is_named() -> None:
    own = parse(default_tables(), "fleet.toml")
    assert own.differing({**own.shared_digests, "foreign": "1234"}) == ["foreign"]


def test_the_papers_law_is_selectable() -> None:
    tables = changed(put("law.kind", "paper"), put("trigger.kind", "switching"))
    config = parse(tables, "fleet.toml")
    assert config.law.holding() == PlainHold("zero", 0.7)
    law = config.law.law(config.r0_m)
    assert isinstance(law, StarlingLaw)
    assert law.gains.normalise == 0.0
    assert law.gains.k_p == 0.0
    assert law.gains.a_max == 5.0
    assert config.safety_radius_m > 0.65


def test_legs_begin_where_the_one_before_ends() -> None:
    tables = changed(
        legs(
            {"kind": "goto", "north_m": 30.0, "east_m": 40.0, "speed_m_s": 1.0},
            {"kind": "hold", "duration_s": 3.0},
            {"kind": "goto", "north_m": 30.0, "east_m": 40.0, "altitude_m": 20.0},
            {"kind": "turn", "rate_deg_s": -6.0},
        )
    )
    config = parse(tables, "fleet.toml")
    away, hold, up, turn = config.plan_legs(config.first_motion.centre_ned_m)
    assert isinstance(away, GotoLeg)
    assert away.target_ned_m == (30.0, 40.0, -10.0)
    assert away.duration_s == pytest.approx(1.875 * 50.0)
    assert hold == VelocityLeg((0.0, 0.0, 0.0), 3.0)  # type: ignore[arg-type]
    assert isinstance(up, GotoLeg)
    assert up.target_ned_m.down == -20.0
    assert up.duration_s == pytest.approx(1.875 * 10.0)
    assert turn == TurnLeg(math.radians(-6.0), math.inf)


# -- overrides from the command line -----------------------------------------------------------------------------------


def test_more_vehicles_get_the_free_ids_and_fewer_are_the_first() -> None:
    tables = changed(put("vehicle.1.id", 12))
    resize(tables, 12)
    config = parse(tables, "fleet.toml")
    assert [v.id for v in config.vehicles] == [1, 12, 3, 4, 5, 6, 7, 8, 9, 10, 2, 11]
    resize(tables, 3)
    assert [v["id"] for v in tables["vehicle"]] == [1, 12, 3]


def test_as_many_vehicles_as_there_are_ids_can_be_asked_for() -> None:
    tables = default_tables()
    resize(tables, 250)
    assert sorted(v["id"] for v in tables["vehicle"]) == list(range(1, 251))


@pytest.mark.parametrize("value", [5, "ten", [1, 2], {"id": 1}])
def test_a_list_of_vehicles_that_is_none_is_left_to_the_validation(value: object) -> None:
    tables = changed(put("vehicle", value))
    resize(tables, 3)
    assert tables["vehicle"] == value
    with pytest.raises(ConfigError, match=r"\$\.vehicle"):
        parse(tables, "fleet.toml")


def test_legs_from_the_command_line_are_those_of_the_file() -> None:
    text = "hold:10,velocity:1:-0.5:20,turn:6:90,turn:-3,goto:40:0:1.5,goto:1:2"
    assert plan_legs(text) == [
        {"kind": "hold", "duration_s": 10.0},
        {"kind": "velocity", "north_m_s": 1.0, "east_m_s": -0.5, "duration_s": 20.0},
        {"kind": "turn", "rate_deg_s": 6.0, "angle_deg": 90.0},
        {"kind": "turn", "rate_deg_s": -3.0},
        {"kind": "goto", "north_m": 40.0, "east_m": 0.0, "speed_m_s": 1.5},
        {"kind": "goto", "north_m": 1.0, "east_m": 2.0},
    ]
    assert plan_legs("none") == []


@pytest.mark.parametrize(
    "text", ["", "fly:1", "hold", "hold:", "hold:x", "hold:1:2", "velocity:1:2", "turn:1:2:3", ","]
)
def test_legs_that_cannot_be_read_are_refused_with_the_form(text: str) -> None:
    with pytest.raises(ConfigError, match="--plan: leg"):
        plan_legs(text)


def test_legs_from_the_command_line_are_checked_as_those_of_the_file() -> None:
    assert "$.plan.legs[0].duration_s must be a finite number" in refusal(put("plan.legs", plan_legs("hold:nan")))


def test_the_default_tables_are_not_touched_by_parsing() -> None:
    tables = default_tables()
    before = copy.deepcopy(tables)
    parse(tables, "fleet.toml")
    assert tables == before


FREE = (put("plan.kind", "none"), put("plan.then", "stay"))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (FREE, "$.plan.legs must be empty with $.plan.kind"),
        ((put("plan.kind", "none"), put("plan.legs", [])), '$.plan.then must be "stay"'),
        ((*FREE, put("plan.legs", []), put("plan.heading", "track")), '$.plan.heading must be "fixed"'),
        ((*FREE, put("plan.informed", [3, 99])), "$.plan.informed must name enabled vehicles, got 99"),
        ((put("plan.informed", [3]),), "$.plan.informed belongs to $.plan.kind"),
        (
            (*FREE, put("plan.informed", [3]), put("plan.legs", [{"kind": "goto", "north_m": 1.0, "east_m": 0.0}])),
            "needs a place that all share",
        ),
        (
            (
                *FREE, put("plan.informed", [3]),
                put("plan.legs", [{"kind": "velocity", "up_m_s": 0.2, "duration_s": 1.0}]),
            ),
            "up_m_s must be 0 m/s",
        ),
    ],
)  # fmt: skip
def test_what_a_fleet_without_a_plan_cannot_have_is_refused(changes: tuple[Change, ...], said: str) -> None:
    assert said in refusal(*changes)


def test_a_fleet_without_a_plan_flies_a_free_leg_and_those_informed_have_the_files() -> None:
    config = parse(changed(*FREE, put("plan.informed", [3, 7])), "fleet.toml")
    assert [leg.kind for leg in config.shared_legs(Ned(0.0, 0.0, -10.0))] == ["free"]
    assert [leg.kind for leg in config.plan_legs(Ned(0.0, 0.0, -10.0))] == ["velocity", "turn", "velocity", "velocity"]


@pytest.mark.parametrize(
    ("kind", "count", "heeded"), [("none", 20, "range"), ("none", 21, "nearest"), ("legs", 30, "range")]
)
def test_a_large_fleet_without_a_plan_heeds_the_nearest(kind: str, count: int, heeded: str) -> None:
    tables = changed(put("plan.kind", kind), put("plan.then", "stay"), put("plan.legs", []))
    resize(tables, count)
    assert parse(tables, "fleet.toml").neighbours == heeded
