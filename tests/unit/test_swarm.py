"""The compiled swarm: its random streams, neighbour list, network and measures."""

import math
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("numba")

from companion.core.law import starling as law
from companion.core.law.intent import IntentGains, response
from companion.core.prediction import axis, damped
from companion.core.safety import filter as safety
from companion.errors import ConfigError
from sim.swarm.swarm import Formation, NeighbourList, Setup, kernels, run, setup_from, starts

SHORT = Setup(duration_s=12.0)
GUSTY = replace(SHORT, gust_m_s2=0.3, sigma_p_m=0.05, sigma_v_m_s=0.05)


def test_same_seed_gives_the_same_flight_and_another_seed_another() -> None:
    a, b, c = run(GUSTY, 4), run(GUSTY, 4), run(GUSTY, 5)
    assert np.array_equal(a.position_m, b.position_m)
    assert np.array_equal(a.events, b.events)
    assert not np.array_equal(a.position_m, c.position_m)


MANY = pytest.mark.parametrize("states", [1500, pytest.param(20_000, marks=pytest.mark.long)])


@MANY
def test_the_law_that_is_flown_is_the_one_that_is_compiled(states: int) -> None:
    loops = kernels()
    rng = np.random.default_rng(states)
    flight = law.Gains(3.0, 3.0, 4.0, 1.0, 0.3, 1.2, 5.0, 1.0, 1.0, 1.0)
    paper = law.paper_gains(3.0, 6.7, 5.6, 1.2)
    for k in range(states):
        gains = flight if k % 4 else paper
        numbers = (rng.normal(size=9) * rng.choice([0.1, 1.0, 10.0])).tolist()
        rest = rng.normal(size=9).tolist()
        count = float(rng.integers(0, 20))
        sums = law.pair(*numbers, gains)
        flown = (
            *sums, *law.finish(count, sums, *rest, gains), *law.separation(*numbers[:3], gains),
            *axis(*rest[:6], damped(0.4, 0.7)),
        )  # fmt: skip
        compiled = (
            *loops.pair(*numbers, gains), *loops.finish(count, sums, *rest, gains),
            *loops.separation(*numbers[:3], gains), *loops.axis(*rest[:6], damped(0.4, 0.7)),
        )  # fmt: skip
        assert all(abs(x - y) <= 1e-9 * (1.0 + abs(x)) for x, y in zip(flown, compiled, strict=True))


@MANY
def test_the_filter_that_is_flown_is_the_one_that_is_compiled(states: int) -> None:
    """Barriers, the choice of whom to pass, and the program, with up to twenty peers and walls, met or not."""
    loops = kernels()
    rng = np.random.default_rng(states)
    most, apart, seen = 8.0, [], [0, 0, 0]
    for _ in range(states):
        count = int(rng.integers(1, 21))
        peers = int(rng.integers(0, count + 1))
        scenes = np.hstack([rng.normal(0.0, rng.choice([0.5, 2.0]), (count, 3)), rng.normal(0.0, 1.5, (count, 3))])
        rows = []
        for scene, asked, velocity in zip(
            scenes.tolist(), rng.normal(0.0, 0.3, (count, 2)).tolist(), rng.normal(size=(count, 2)).tolist(),
            strict=True,
        ):  # fmt: skip
            radius, shared = (0.65, True) if asked[0] > 0.0 else (1.0, False)
            row = safety.barrier(*scene, radius, shared, *asked)
            other = loops.barrier(*scene, radius, shared, *asked)
            assert all(abs(x - y) <= 1e-11 * (1.0 + abs(x)) for x, y in zip(row, other, strict=True))
            rows.append([*row, *velocity])
        u, v = rng.uniform(-5.6, 5.6, 2).tolist(), rng.normal(0.0, 1.5, 2).tolist()
        planes = np.array(rows)
        compiled = loops.avoid(*u, *v, planes, peers, count, most, np.zeros((count, 3)))
        flown = safety.avoid(*u, *v, rows, peers, count, most, [[0.0] * 3 for _ in rows])
        assert (compiled.peer, compiled.wall) == (flown.peer, flown.wall)
        assert compiled[4:] == pytest.approx(flown[4:], abs=1e-6)
        apart.append(math.dist(compiled[:2], flown[:2]))
        seen[0 if flown[4:] == (0.0, 0.0) else 1 if flown.peers_missed_m_s2 == 0.0 else 2] += 1
    assert min(seen) > 0.05 * states, seen
    # In a few sets that cannot be met, rounding decides between edges that are nearly parallel.
    assert sum(x > 1e-6 for x in apart) <= 0.001 * states
    assert max(apart) < 1e-3


def test_fast_law_over_a_neighbour_list_equals_the_core_called_pair_by_pair() -> None:
    loops = kernels()
    rng = np.random.default_rng(2)
    n, range_m = 60, 4.0
    x, v = rng.uniform(-5, 5, (n, 3)), rng.normal(size=(n, 3))
    slot = x + rng.normal(scale=0.3, size=(n, 3))
    rows = np.hstack([x + 0.05, v, slot])
    near = NeighbourList(range_m)
    near.update(x)
    gains = law.Gains(3.0, 6.7, 5.6, 1.0, 0.3, 1.2, 5.0, 1.0, 1.0, 1.0)
    plan = np.zeros(9)
    u, residual = np.zeros((n, 3)), np.zeros((n, 3))
    loops.law_fast(x, v, rows, slot, near.start, near.column, range_m**2, plan, gains, u, residual)
    for i in range(n):
        shares = []
        for j in range(n):
            if j != i and np.linalg.norm(x[i] - rows[j, :3]) <= range_m:
                shares.append(law.pair(*(x[i] - rows[j, :3]), *(v[i] - rows[j, 3:6]), *(slot[i] - slot[j]), gains))
        expected = law.finish(len(shares), law.total(shares), *(x[i] - slot[i]), *v[i], 0.0, 0.0, 0.0, gains)
        assert np.allclose(u[i], expected, rtol=1e-9, atol=1e-9)


def test_neighbour_list_holds_everyone_within_range_until_relative_motion_uses_up_the_skin() -> None:
    rng = np.random.default_rng(3)
    x = rng.uniform(0, 30, (300, 3))
    near = NeighbourList(5.0)
    assert near.update(x)
    for drift in (0.0, 50.0):
        moved = x + drift + rng.uniform(-0.25, 0.25, x.shape)
        assert not near.update(moved)
        for i in range(0, 300, 17):
            wanted = set(np.nonzero(np.linalg.norm(moved - moved[i], axis=1) <= 5.0)[0]) - {i}
            assert wanted <= set(near.column[near.start[i] : near.start[i + 1]])
    assert near.update(x + rng.uniform(-2, 2, x.shape))


def test_above_200_agents_no_array_is_square_and_the_swarm_still_forms() -> None:
    large = Setup(
        formation=Formation(shape="cloud", count=250, spacing_m=3.0), range_m=7.6, duration_s=4.0, dt_s=0.02,
        dense_measures=False,
    )  # fmt: skip
    flown = run(large, 0)
    error = np.sqrt((flown.formation_error_m() ** 2).mean(axis=1))
    assert error[-1] < 0.3 * error[0]
    with pytest.raises(ConfigError, match="200"):
        replace(large, loss=0.1)


def test_per_link_memory_without_loss_or_delay_changes_nothing() -> None:
    shared, links = run(GUSTY, 1), run(replace(GUSTY, links=True), 1)
    assert np.allclose(shared.position_m, links.position_m, atol=1e-6)
    assert shared.messages == links.messages


def test_loss_makes_predictions_worse_and_digests_heal_them() -> None:
    lossy = replace(SHORT, loss=0.5, gust_m_s2=0.3, duration_s=40.0)
    plain = [run(lossy, s).measures["prediction_error_square_sum"] / run(lossy, s).measures["bound_samples"]
             for s in range(4)]  # fmt: skip
    healed = [run(replace(lossy, digest=9), s) for s in range(4)]
    told = [r.measures["prediction_error_square_sum"] / r.measures["bound_samples"] for r in healed]
    assert np.mean(told) < np.mean(plain)


def test_prediction_error_stays_below_its_bound_while_nothing_is_lost() -> None:
    for setup in (SHORT, GUSTY, replace(GUSTY, lag_s=0.3), replace(GUSTY, delay_s=0.1)):
        flown = run(setup, 2)
        assert flown.measures["bound_violations"] == 0
        assert flown.measures["bound_worst_ratio"] < 1.0


def test_response_of_the_intent_prediction_solves_its_equation() -> None:
    for k_p, k_d in ((5.6, 7.7), (9.0, 1.0), (4.0, 4.0)):
        g = IntentGains(k_p, k_d, 2.0, 1.0, 1.0, 1.0)
        e, rate = 0.3, -0.2
        for _ in range(2000):
            rate += 0.0005 * (-k_d * rate - k_p * e)
            e += 0.0005 * rate
        r = response(1.0, g)
        assert r.ee * 0.3 - r.ed * 0.2 == pytest.approx(e, abs=2e-3)
        assert r.de * 0.3 - r.dd * 0.2 == pytest.approx(rate, abs=2e-3)


def test_a_peer_that_vanishes_is_left_behind_and_nobody_touches_it() -> None:
    flown = run(replace(SHORT, fault="vanish", fault_agent=1, fault_time_s=5.0, barrier=True, links=True, k_p=0.3), 3)
    assert flown.measures["minimum_distance_m"] > 0.6
    assert np.linalg.norm(flown.velocity_m_s[-1, 1]) < 1e-6
    assert flown.rms_formation_m(9.0) < 0.1


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"formation": {"count": 1}}, "formation.count must be at least 2"),
        ({"loss": 1.0}, "loss must be"),
        ({"hold": "cubic"}, "must be one of zero, first, damped, observer"),
        ({"speed": 1.0}, "is not a setting"),
        ({"dt_s": float("nan")}, "dt_s must be > 0"),
        ({"formation": {"shape": "star"}}, "formation.shape must be"),
    ],
)
def test_a_setup_that_cannot_be_flown_is_refused_with_a_sentence(values: dict[str, object], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        run(setup_from(values, "x.toml: $.base"), 0)


def test_a_formation_out_of_range_is_refused() -> None:
    with pytest.raises(ConfigError, match="not connected at range_m = 1"):
        run(replace(SHORT, range_m=1.0), 0)


def test_starts_stay_in_their_ball_and_keep_their_separation() -> None:
    setup = replace(SHORT, start_ball_m=3.0, start_separation_m=1.5)
    x, _ = starts(setup, 7)
    assert np.linalg.norm(x - setup.formation.slots(), axis=1).max() <= 3.0
    gaps = np.linalg.norm(x[:, None] - x[None, :], axis=2) + 10 * np.eye(len(x))
    assert gaps.min() >= 1.5
