"""The small program of the safety filter, against an oracle that tries every point where a solution can lie."""

import random
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import cos, dist, hypot, pi, sin, sqrt

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from companion.core.frames import Ned
from companion.core.safety.avoidance import sidestep
from companion.core.safety.fence import Fence, braking_pole_per_s, wall_plane
from companion.core.safety.filter import SafetyFilter, SafetyLimits, half_plane
from companion.core.safety.program import FLAT, Solution, solve
from companion.core.values import Command, Neighbour, VehicleState

Point = tuple[float, float]
Row = tuple[float, float, float]
Rows = list[Row]
Floats = npt.NDArray[np.float64]
ZERO = Ned(0.0, 0.0, 0.0)
MOST = 8.0
NEAR_M_S2 = 1e-3
"""a command may be so far from the oracle's"""
EXACT = 1e-9
"""an edge is met to this share of |g| a"""


def solved(u: Point, rows: Sequence[Sequence[float]], peers: int | None = None, most: float = MOST) -> Solution:
    given = [list(r) for r in rows]
    spare = [[0.0] * 3 for _ in rows]
    return solve(*u, given, len(rows) if peers is None else peers, len(rows), most, spare)


# -- the oracle --------------------------------------------------------------------------------------------------------


def on_circle(g: Floats, b: Floats, most: float) -> Floats:
    """Where the edges g.x = b cross the circle |x| = most; none for an edge that does not."""
    size = np.hypot(*g.T)
    n, foot = g[size > 0] / size[size > 0, None], b[size > 0] / size[size > 0]
    crosses = np.abs(foot) <= most
    n, foot = n[crosses], foot[crosses]
    along = np.sqrt(most**2 - foot**2)[:, None] * np.stack([-n[:, 1], n[:, 0]], axis=1)
    return np.concatenate([foot[:, None] * n + along, foot[:, None] * n - along])


def corners(g: Floats, b: Floats) -> Floats:
    """Where two edges g.x = b cross each other."""
    i, j = np.triu_indices(len(g), 1)
    det = g[i, 0] * g[j, 1] - g[j, 0] * g[i, 1]
    crosses = np.abs(det) > 1e-14 * np.hypot(*g[i].T) * np.hypot(*g[j].T)
    i, j, det = i[crosses], j[crosses], det[crosses]
    return np.stack([(b[i] * g[j, 1] - b[j] * g[i, 1]) / det, (g[i, 0] * b[j] - g[j, 0] * b[i]) / det], axis=1)


def oracle(u: Point, rows: Sequence[Row], most: float = MOST, within: float = EXACT) -> Point | None:
    """The nearest of all candidates that satisfy every row: u itself, its feet on edges and circle, all crossings."""
    table = np.array(rows, dtype=float).reshape(-1, 3)
    g, b = table[:, :2], table[:, 2]
    size = np.hypot(*g.T)
    wanted = np.array(u)
    feet = wanted + ((b - g @ wanted) / size**2)[:, None] * g
    rim = wanted * most / max(hypot(*u), 1e-30)
    points = np.concatenate([[wanted, rim], feet, corners(g, b), on_circle(g, b, most)])
    kept = (points @ g.T >= b - within * size * most).all(axis=1) & (np.hypot(*points.T) <= most * (1 + within))
    if not kept.any():
        return None
    points = points[kept]
    nearest = points[np.hypot(*(points - wanted).T).argmin()]
    return float(nearest[0]), float(nearest[1])


def least_miss(soft: Sequence[Row], hard: Sequence[Row], most: float = MOST, within: float = EXACT) -> float:
    """The least largest miss of the soft rows among the commands within the hard ones and the disc, 0 at least.

    It is taken on at a point of the circle along a gradient, or where two lines or a line and the circle cross: edges
    of hard rows, and lines on which two soft rows are missed alike.
    """
    if not soft:
        return 0.0
    s, h = np.array(soft, dtype=float), np.array(hard, dtype=float).reshape(-1, 3)
    i, j = np.triu_indices(len(s), 1)
    lines = np.concatenate([s[i] - s[j], h])
    lines = lines[np.hypot(lines[:, 0], lines[:, 1]) > 1e-13]
    g, b = lines[:, :2], lines[:, 2]
    points = np.concatenate(
        [corners(g, b), on_circle(g, b, most), most * s[:, :2] / np.hypot(s[:, 0], s[:, 1])[:, None]]
    )
    slack = within * np.hypot(h[:, 0], h[:, 1]) * most
    kept = (points @ h[:, :2].T >= h[:, 2] - slack).all(axis=1) & (np.hypot(*points.T) <= most * (1 + EXACT))
    return max(float((s[:, 2] - points[kept] @ s[:, :2].T).max(axis=1).min()), 0.0)


def excess(u: Point, rows: Sequence[Sequence[float]], most: float = MOST) -> float:
    """By how many m/s^2 a command is outside a row or the disc, at most."""
    outside = [(r[2] - r[0] * u[0] - r[1] * u[1]) / hypot(r[0], r[1]) for r in rows]
    return max([hypot(*u) - most, *outside])


def judge(u: Point, rows: Sequence[Row], most: float = MOST) -> str:
    """Compare with the oracle; what kind of state it was."""
    answer = solved(u, rows, most=most)
    x = answer[:2]
    expected = oracle(u, rows, most)
    scale = most / MOST
    if expected is None:
        miss, size = least_miss(rows, [], most), max(hypot(r[0], r[1]) for r in rows)
        assert hypot(*x) <= most * (1 + EXACT)
        assert answer.peers_missed == pytest.approx(miss, rel=1e-7, abs=EXACT * size * most)
        lowered = [(g, h, b - answer.peers_missed) for g, h, b in rows]
        assert excess(x, lowered, most) <= 1e-6 * scale
        # Of all that miss no more it is the nearest.
        other = oracle(u, lowered, most, within=1e-10)
        assert other is None or dist(x, u) <= dist(other, u) + NEAR_M_S2 * scale
        return "not attainable"
    assert answer.peers_missed <= 1e-6 * scale * max((hypot(r[0], r[1]) for r in rows), default=1.0)
    assert excess(x, rows, most) <= 1e-6 * scale
    if dist(x, expected) > NEAR_M_S2 * scale:
        # What is allowed depends on less than the oracle's tolerance: edges that are nearly parallel.
        exact = oracle(u, rows, most, within=1e-13)
        assert exact is None or dist(x, u) <= dist(exact, u) + NEAR_M_S2 * scale
        return "decided by rounding"
    if expected == u:
        return "free"
    return "on the rim" if hypot(*x) > most * (1 - 1e-6) else "blocked"


# -- random states -----------------------------------------------------------------------------------------------------


def neighbour(rng: random.Random, k: int, reach_m: float) -> Neighbour:
    r, a, up = reach_m * sqrt(rng.random()), rng.uniform(-pi, pi), rng.choice([0.0, 0.0, rng.uniform(-3, 3)])
    end = Ned(rng.uniform(-4, 4), rng.uniform(-4, 4), up) if rng.random() < 0.1 else None
    shares = rng.random() < 0.6
    return Neighbour(
        k + 2, Ned(r * cos(a), r * sin(a), up), Ned(rng.gauss(0, 1.5), rng.gauss(0, 1.5), rng.choice([0.0, 0.5])),
        ZERO, 0.1, shares, shares, rng.choice([0.0, 0.35, 0.6]), end,
        reference_acceleration_ned_m_s2=Ned(rng.gauss(0, 0.3), rng.gauss(0, 0.3), 0.0),
    )  # fmt: skip


def state_and_neighbours(rng: random.Random, most_peers: int) -> tuple[VehicleState, list[Neighbour]]:
    ego = VehicleState(0, ZERO, Ned(rng.gauss(0, 1.5), rng.gauss(0, 1.5), 0.0))
    reach_m = rng.choice([2.0, 4.0, 8.0])
    return ego, [neighbour(rng, k, reach_m) for k in range(rng.randint(1, most_peers))]


def wanted(rng: random.Random) -> Point:
    r, a = MOST * sqrt(rng.random()), rng.uniform(-pi, pi)
    return r * cos(a), r * sin(a)


def in_flight(rng: random.Random) -> tuple[Point, Rows]:
    ego, neighbours = state_and_neighbours(rng, 20)
    return wanted(rng), [half_plane(ego, ZERO, n)[:3] for n in neighbours]


def anyhow(rng: random.Random) -> tuple[Point, Rows]:
    """Half-planes of any direction, close enough to the disc to matter, in a unit from a millionth to a million."""
    rows, unit = [], 10 ** rng.uniform(-6, 6)
    for _ in range(rng.randint(1, 12)):
        a, size = rng.uniform(-pi, pi), unit * rng.uniform(0.01, 1.0)
        rows.append((size * cos(a), size * sin(a), size * rng.uniform(-9.0, rng.choice([-2.0, 2.0, 9.0]))))
    return wanted(rng), rows


def degenerate(rng: random.Random) -> tuple[Point, Rows]:
    """The same twice, opposed, through one point, touching the circle, nearly parallel; in any order."""
    rows = anyhow(rng)[1][:3]
    corner, unit = wanted(rng), hypot(*rows[0][:2])
    for _ in range(rng.randint(1, 8)):
        a = rng.choice([rng.uniform(-pi, pi), pi / 2 * rng.randint(0, 3)])
        g, h, b = rng.choice(rows)
        size = rng.choice([1.0, 0.3, 40.0])
        kind = rng.randrange(6)
        if kind == 0:
            rows.append((size * g, size * h, size * b))
        elif kind == 1:
            rows.append((-size * g, -size * h, -size * b - rng.choice([0.0, 0.0, 1.0]) * hypot(g, h)))
        elif kind == 2:
            size *= unit
            rows.append((size * cos(a), size * sin(a), size * (cos(a) * corner[0] + sin(a) * corner[1])))
        elif kind == 3:
            size *= unit
            rows.append((size * cos(a), size * sin(a), size * MOST))
        elif kind == 4:
            size *= unit
            rows.append((size * cos(a), size * sin(a), -size * MOST))
        else:
            t = 10 ** rng.uniform(-9, -2)
            rows.append((g * cos(t) - h * sin(t), g * sin(t) + h * cos(t), b))
    rng.shuffle(rows)
    return (corner if rng.random() < 0.2 else wanted(rng)), rows


STATES: dict[str, Callable[[random.Random], tuple[Point, Rows]]] = {
    "in flight": in_flight, "anyhow": anyhow, "degenerate": degenerate,
}  # fmt: skip


def judged(kind: str, seeds: range) -> dict[str, int]:
    counts: dict[str, int] = {}
    for seed in seeds:
        u, rows = STATES[kind](random.Random(f"{kind}/{seed}"))
        try:
            what = judge(u, rows)
        except AssertionError as error:
            raise AssertionError(f"{kind}, seed {seed}: {u}, {rows}") from error
        counts[what] = counts.get(what, 0) + 1
    return counts


@pytest.mark.parametrize("kind", STATES)
def test_the_command_is_the_oracles(kind: str) -> None:
    counts = judged(kind, range(700))
    assert counts.get("decided by rounding", 0) <= (14 if kind == "degenerate" else 0)
    assert min(counts[what] for what in ("free", "blocked", "on the rim", "not attainable")) >= 8, counts


@pytest.mark.parametrize("seed", [1687, 10768, 13378, 21509, 23526])
def test_the_command_is_the_oracles_where_rounding_would_close_what_lowered_rows_leave(seed: int) -> None:
    """Of thirty thousand degenerate states these need rows lowered a little further than their least miss."""
    assert judged("degenerate", range(seed, seed + 1)) == {"not attainable": 1}


@pytest.mark.long
@pytest.mark.parametrize("kind", STATES)
def test_the_command_is_the_oracles_in_many_states(kind: str) -> None:
    counts = judged(kind, range(1000, 31_000))
    assert counts.get("decided by rounding", 0) <= (600 if kind == "degenerate" else 0), counts
    sys.stdout.write(f"{kind}: {counts}\n")


# -- the filter --------------------------------------------------------------------------------------------------------

LIMITS = SafetyLimits(
    speed_max_m_s=4.0, climb_max_m_s=1.5, descent_max_m_s=1.0, jerk_max_m_s3=1e9, avoidance_acceleration_m_s2=MOST
)
FENCES = (
    None,
    Fence(2.0, 50.0, radius_m=12.0),
    Fence(2.0, 50.0, corners_m=((-10.0, -10.0), (10.0, -10.0), (10.0, -2.0), (0.0, 0.0), (10.0, 2.0), (-10.0, 10.0))),
)
"""the last with a notch"""
HEIGHT = Ned(0.0, 0.0, -10.0)


def moved(by: Ned, place: Ned) -> Ned:
    return Ned(place.north + by.north, place.east + by.east, place.down + by.down)


def judge_filter(rng: random.Random, most_peers: int) -> str:
    """One state of a vehicle near others and near the fence, or beyond it: what the filter makes of any command."""
    fence = rng.choice(FENCES)
    ego, neighbours = state_and_neighbours(rng, most_peers)
    place = moved(HEIGHT, Ned(rng.uniform(-11, 11), rng.uniform(-11, 11), 0.0))
    ego = ego._replace(position_ned_m=place)
    neighbours = [
        n._replace(
            position_ned_m=moved(place, n.position_ned_m),
            last_seen_ned_m=None if n.last_seen_ned_m is None else moved(place, n.last_seen_ned_m),
        )
        for n in neighbours
    ]
    asked = Ned(rng.gauss(0, 0.3), rng.gauss(0, 0.3), 0.0)
    command = Command(Ned(*wanted(rng), 0.0), place, ZERO, asked, 0.0)

    def flown(limits: SafetyLimits, others: Sequence[Neighbour]) -> tuple[Point, SafetyFilter]:
        f = SafetyFilter(limits)
        setpoint = f.apply(command, ego, others, ZERO, 0.02)
        assert setpoint is not None
        return (setpoint.acceleration_north_m_s2, setpoint.acceleration_east_m_s2), f

    u, _ = flown(replace(LIMITS, barrier=False), [])
    x, f = flown(replace(LIMITS, fence=fence), neighbours)
    planes = [half_plane(ego, asked, n) for n in neighbours]
    peers = [p[:3] for p in planes]
    walls: Rows = []
    if fence is not None:
        v, pole = ego.velocity_ned_m_s, braking_pole_per_s(LIMITS.speed_max_m_s, MOST)
        walls = [wall_plane(w, v.north, v.east, pole) for w in fence.walls(place.north, place.east)]
    missing = [excess(u, [p], most=99.0) for p in peers]
    if max(missing) > 0.0:
        p = planes[missing.index(max(missing))]
        v = ego.velocity_ned_m_s
        u = sidestep(*u, p.g_north, p.g_east, v.north - p.v_north, v.east - p.v_east)
    expected = oracle(u, [*peers, *walls])
    if expected is not None:
        assert x == pytest.approx(expected, abs=NEAR_M_S2)
        assert excess(x, [*peers, *walls]) <= 1e-6
        assert {"peer distance not attainable", "fence not attainable"}.isdisjoint(f.counts)
        return "free" if expected == u else "kept"
    miss = least_miss(peers, [])
    assert (f.counts["peer distance not attainable"] > 0) is (miss > 1e-6)
    assert hypot(*x) <= MOST * (1 + EXACT)
    assert max(b - g * x[0] - h * x[1] for g, h, b in peers) <= miss + 1e-6
    if walls:
        lowered = [(g, h, b - miss - EXACT * hypot(g, h) * MOST) for g, h, b in peers]
        out = least_miss(walls, lowered, within=1e-3 * EXACT)
        assert max(b - g * x[0] - h * x[1] for g, h, b in walls) <= out + NEAR_M_S2
        if abs(out - 0.01) > NEAR_M_S2:
            assert (f.counts["fence not attainable"] > 0) is (out > 0.01)
    return "peers missed" if miss > 0.0 else "fence missed"


def judged_filter(seeds: range) -> dict[str, int]:
    counts: dict[str, int] = {}
    for seed in seeds:
        try:
            what = judge_filter(random.Random(f"filter/{seed}"), (3, 9, 20)[seed % 3])
        except AssertionError as error:
            raise AssertionError(f"seed {seed}") from error
        counts[what] = counts.get(what, 0) + 1
    return counts


def test_the_filter_flies_the_oracles_command() -> None:
    counts = judged_filter(range(1000))
    assert min(counts[what] for what in ("free", "kept", "peers missed", "fence missed")) >= 20, counts


@pytest.mark.long
def test_the_filter_flies_the_oracles_command_in_many_states() -> None:
    sys.stdout.write(f"filter: {judged_filter(range(1000, 31_000))}\n")


# -- cases by hand -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize(
    ("u", "rows", "expected"),
    [
        ((1.0, 2.0), [], (1.0, 2.0)),
        ((9.0, 12.0), [], (4.8, 6.4)),
        ((3.0, 1.0), [(1.0, 0.0, 3.0)], (3.0, 1.0)),  # on the edge
        ((2.0, 1.0), [(1.0, 0.0, 3.0)], (3.0, 1.0)),
        ((0.0, 0.0), [(2.0, 0.0, 2.0), (0.0, 2.0, 4.0)], (1.0, 2.0)),  # a corner
        ((0.0, 0.0), [(1.0, 0.0, 2.0), (1.0, 0.0, 2.0), (3.0, 0.0, 6.0)], (2.0, 0.0)),  # the same edge thrice
        ((0.0, 0.0), [(1.0, 0.0, 1.0), (-1.0, 0.0, -1.0)], (1.0, 0.0)),  # a line
        ((0.0, 0.0), [(1.0, 0.0, 1.0), (-1.0, 0.0, -1.0), (0.0, 1.0, 2.0), (0.0, -1.0, -2.0)], (1.0, 2.0)),
        ((0.0, 0.0), [(0.6, 0.8, 8.0)], (4.8, 6.4)),  # touches the disc
        ((0.0, 7.0), [(1.0, 0.0, 4.8)], (4.8, 6.4)),  # ends on the rim
        ((0.0, -7.0), [(1.0, 0.0, 4.8)], (4.8, -6.4)),
        ((0.0, 8.0), [(-1.0, 0.0, 4.8), (0.0, -1.0, -6.0)], (-4.8, 6.0)),
        ((5.0, 3.0), [(1.0, 0.0, -9.0), (0.0, 0.0, 0.0), (0.0, 0.0, -1.0)], (5.0, 3.0)),
        ((-5.0, 3.0), [(0.0, 0.0, 5.0), (1.0, 0.0, 0.0)], (0.0, 3.0)),  # no command changes the first
        ((0.0, 0.0), [(0.0, 0.0, 5.0), (1.0, 0.0, 2.0), (0.0, 1.0, 3.0)], (2.0, 3.0)),
    ],
)
def test_known_cases(u: Point, rows: Rows, expected: Point, scale: float) -> None:
    scaled = [(scale * g, scale * h, scale * b) for g, h, b in rows]
    assert solved(u, scaled) == pytest.approx((*expected, 0.0, 0.0), abs=1e-9)
    unit = (scale * u[0], scale * u[1])
    lengthened = [(g, h, scale * b) for g, h, b in rows]
    answer = solved(unit, lengthened, most=scale * MOST)
    assert (answer.north / scale, answer.east / scale) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize(
    ("u", "rows", "peers", "expected"),
    [
        # Beyond the disc: as far as it goes.
        ((1.0, 5.0), [(1.0, 0.0, 9.0)], 1, (8.0, 0.0, 1.0, 0.0)),
        ((1.0, 5.0), [(0.6, -0.8, 9.0)], 1, (4.8, -6.4, 1.0, 0.0)),
        ((1.0, 5.0), [(3.0, 4.0, 45.0)], 1, (4.8, 6.4, 5.0, 0.0)),
        # Opposed: the middle, where it is nearest to u.
        ((1.0, 5.0), [(1.0, 0.0, 2.0), (-1.0, 0.0, 1.0)], 2, (0.5, 5.0, 1.5, 0.0)),
        ((1.0, 9.0), [(1.0, 0.0, 2.0), (-1.0, 0.0, 1.0)], 2, (0.5, sqrt(63.75), 1.5, 0.0)),
        # One that acts half as much on its distance gives way where it costs less.
        ((0.0, 0.0), [(1.0, 0.0, 2.0), (-0.5, 0.0, 2.0)], 2, (0.0, 0.0, 2.0, 0.0)),
        # A triangle inside out; with a fourth that is met in its middle, and one that is not.
        ((0.0, 0.0), [(1.0, 0.0, 1.0), (-0.6, 0.8, 1.0), (-0.6, -0.8, 1.0)], 3, (0.0, 0.0, 1.0, 0.0)),
        ((5.0, 1.0), [(1.0, 0.0, 1.0), (-0.6, 0.8, 1.0), (-0.6, -0.8, 1.0), (0.0, 1.0, 0.5)], 4, (0.0, 0.0, 1.0, 0.0)),
        # Peers before others, wherever these stand in the order of size.
        ((0.0, 0.0), [(1.0, 0.0, 2.0), (-1.0, 0.0, 1.0)], 1, (2.0, 0.0, 0.0, 3.0)),
        ((0.0, 0.0), [(1.0, 0.0, 2.0), (-1.0, 0.0, 1.0)], 0, (0.5, 0.0, 0.0, 1.5)),
        ((0.0, 3.0), [(1.0, 0.0, 9.0), (-1.0, 0.0, 1.0)], 1, (8.0, 0.0, 1.0, 9.0)),
        # What peers leave open the others decide.
        ((3.0, 3.0), [(1.0, 0.0, 2.0), (-1.0, 0.0, 1.0), (0.0, -1.0, 2.0)], 2, (0.5, -2.0, 1.5, 0.0)),
        ((3.0, 3.0), [(1.0, 0.0, 2.0), (-1.0, 0.0, 1.0), (0.0, -1.0, 2.0), (0.0, 1.0, 2.0)], 2, (0.5, 0.0, 1.5, 2.0)),
        ((3.0, 3.0), [(1.0, 0.0, 2.0), (0.0, -1.0, 2.0), (0.0, 1.0, 2.0), (-1.0, 0.0, -5.0)], 1, (3.0, 0.0, 0.0, 2.0)),
        # A row that no command changes is nobody's miss.
        ((1.0, 5.0), [(0.0, 0.0, 7.0), (1.0, 0.0, 9.0), (0.0, 0.0, 7.0)], 3, (8.0, 0.0, 1.0, 0.0)),
    ],
)
def test_what_misses_least(
    u: Point, rows: Rows, peers: int, expected: tuple[float, float, float, float], scale: float
) -> None:
    """The rim's cap within 1e-9 a of the least miss is 4.5e-5 a wide on each side."""
    scaled = [(scale * g, scale * h, scale * b) for g, h, b in rows]
    north, east, peers_missed, others_missed = solved(u, scaled, peers)
    assert (north, east) == pytest.approx(expected[:2], abs=5e-4)
    assert (peers_missed / scale, others_missed / scale) == pytest.approx(expected[2:], abs=5e-4)
    lengthened = [(g, h, scale * b) for g, h, b in rows]
    answer = solved((scale * u[0], scale * u[1]), lengthened, peers, scale * MOST)
    assert [x / scale for x in answer] == pytest.approx(expected, abs=5e-4)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("seed", range(30))
def test_edges_that_meet_in_a_point_or_a_line_are_met_and_nothing_gives_way(seed: int, scale: float) -> None:
    """Rounding of these numbers, whatever their unit, closes no set that is a point or a line."""
    rng = random.Random(seed)
    corner, (u_north, u_east) = wanted(rng), wanted(rng)
    most, u = scale * MOST, (scale * u_north, scale * u_east)
    through = []
    for _ in range(6):
        a, size = rng.uniform(-pi, pi), rng.uniform(0.1, 3.0)
        g, h = size * cos(a), size * sin(a)
        through.append((g, h, scale * (g * corner[0] + h * corner[1])))
    north, east, *missed = solved(u, through, most=most)
    assert missed == [0.0, 0.0]
    assert excess((north, east), through, most) <= 1e-9 * scale
    g, h, b = through[0]
    back = [(-k * g, -k * h, -k * b) for k in (0.3, 1.7)]
    north, east, *missed = solved(u, [through[0], *back], most=most)
    assert missed == [0.0, 0.0]
    assert (g * north + h * east) / scale == pytest.approx(b / scale, abs=1e-9)


def test_rows_that_cannot_be_met_are_lowered_by_their_class_and_met_then() -> None:
    rows = [[1.0, 0.0, 2.0, 7.0], [-0.5, 0.0, 2.0, 8.0], [0.0, 1.0, 3.0, 9.0], [0.0, -1.0, -2.0, 9.0]]
    answer = solve(0.0, 0.0, rows, 2, 4, MOST, [[0.0] * 3 for _ in rows])
    assert answer == pytest.approx((0.0, 2.5, 2.0, 0.5), abs=1e-6)
    assert [r[2] for r in rows] == pytest.approx([0.0, 0.0, 2.5, -2.5], abs=1e-6)
    assert [r[3] for r in rows] == [7.0, 8.0, 9.0, 9.0]
    assert excess(answer[:2], rows) <= EXACT
    kept = [list(r) for r in rows]
    solve(0.0, 0.0, rows, 2, 4, MOST, [[0.0] * 3 for _ in rows])
    assert rows == kept, "what can be met is left as it is"


@pytest.mark.parametrize(("size", "binds"), [(0.9 * FLAT, False), (1.1 * FLAT, True)])
def test_a_row_whose_gradient_is_flat_binds_no_command(size: float, binds: bool) -> None:
    assert solved((1.0, 0.0), [(size, 0.0, 2.0 * size)]) == pytest.approx((2.0 if binds else 1.0, 0.0, 0.0, 0.0))
    above = solved((1.0, 0.0), [(size, 0.0, 9.0 * size)])
    assert above[:2] == pytest.approx((8.0 if binds else 1.0, 0.0), abs=5e-4)


def test_only_as_many_rows_count_as_are_said_to() -> None:
    rows = [[1.0, 0.0, 2.0], [0.0, 1.0, 2.0]]
    spare = [[0.0] * 3 for _ in rows]
    assert solve(0.0, 0.0, rows, 1, 1, MOST, spare) == pytest.approx((2.0, 0.0, 0.0, 0.0))
    assert solve(0.0, 0.0, rows, 0, 0, MOST, spare) == (0.0, 0.0, 0.0, 0.0)


planes_of = st.builds(
    lambda angle, size, b: (size * cos(angle), size * sin(angle), size * b),
    st.floats(-pi, pi), st.floats(0.05, 1.0), st.floats(-10.0, 10.0),
)  # fmt: skip


@settings(deadline=None, max_examples=150)
@given(
    st.tuples(st.floats(-9.0, 9.0), st.floats(-9.0, 9.0)), st.lists(planes_of, min_size=1, max_size=8),
    st.integers(0, 8), st.randoms(use_true_random=False),
)  # fmt: skip
def test_the_order_of_rows_in_their_class_does_not_matter(u: Point, rows: Rows, peers: int, rng: random.Random) -> None:
    peers = min(peers, len(rows))
    first = solved(u, rows, peers)
    before, after = rows[:peers], rows[peers:]
    rng.shuffle(before)
    rng.shuffle(after)
    second = solved(u, [*before, *after], peers)
    assert second.peers_missed == pytest.approx(first.peers_missed, abs=1e-6)
    assert second.others_missed == pytest.approx(first.others_missed, abs=2e-3)
    # Edges that are nearly parallel meet far from where rounding puts them.
    assume(all(abs(g * k - h * j) > 1e-4 * hypot(g, h) for g, h, _ in rows for j, k, _ in rows if (g, h) != (j, k)))
    assert dist(first[:2], second[:2]) <= 2e-3


@pytest.mark.parametrize("seed", range(50))
def test_the_size_of_a_row_is_of_no_matter_where_all_can_be_met(seed: int) -> None:
    rng = random.Random(seed)
    while True:
        u, rows = in_flight(rng)
        if oracle(u, [(g, h, b + 0.01) for g, h, b in rows]) not in (None, u):
            break
    sizes = [10 ** rng.uniform(-6, 6) / hypot(g, h) for g, h, _ in rows]
    resized = [(k * g, k * h, k * b) for k, (g, h, b) in zip(sizes, rows, strict=True)]
    assert solved(u, resized) == pytest.approx(solved(u, rows), abs=1e-9)
