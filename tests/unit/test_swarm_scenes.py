"""What may happen to the swarm: legs that some know, wind, failing motors, partitions, late joiners, near mode."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("numba")

from companion.core.frames import Ned
from companion.core.law import evasion
from companion.core.safety import filter as safety
from companion.core.trigger import near
from companion.core.values import Neighbour
from companion.errors import ConfigError
from sim.swarm import compiled as core
from sim.swarm.options import linked_pairs, near_uncertainty_m
from sim.swarm.setup import Formation, Setup, setup_from
from sim.swarm.state import CAUSES
from sim.swarm.swarm import motion_table, quantile_m, run

FOUR = Setup(formation=Formation(count=4), duration_s=12.0, control_every=2, k_p=0.3, links=True)
GUARDED = replace(FOUR, barrier=True, barrier_radius_m=1.0, near=True)


def test_a_leg_turns_the_motion_by_its_angle_and_leaves_its_speed() -> None:
    legs = ((2.0, np.pi / 2, 3.0),)
    table = motion_table(replace(FOUR, legs=legs), 1001)[:, 0]
    assert table[100, 3:6] == pytest.approx([1.0, 0.0, 0.0])
    assert table[1000, 3:6] == pytest.approx([0.0, 1.0, 0.0], abs=1e-9)
    assert np.linalg.norm(table[:, 3:6], axis=1) == pytest.approx(np.ones(1001))
    assert np.diff(table[:, :3], axis=0) / 0.01 == pytest.approx(table[1:, 3:6], abs=0.005)
    assert np.linalg.norm(table[300, 6:9]) == pytest.approx(np.pi / 6)


def test_who_is_informed_draws_those_that_are_not_and_without_messages_draws_nobody() -> None:
    led = replace(FOUR, plan=False, k_p=0.0, informed=(0, 2), legs=((2.0, np.pi / 2, 2.0),), duration_s=30.0)
    wish = np.array([0.0, 1.0, 0.0])
    heard, deaf = run(led, 1), run(replace(led, loss=1.0), 1)
    assert np.linalg.norm(heard.velocity_m_s[-1] - wish, axis=1).max() < 0.3
    assert np.linalg.norm(deaf.velocity_m_s[-1, [0, 2]] - wish, axis=1).max() < 0.1
    assert np.linalg.norm(deaf.velocity_m_s[-1, [1, 3]] - wish, axis=1).min() > 0.9


def test_where_everything_is_lost_nothing_arrives_and_nobody_is_predicted() -> None:
    flown = run(replace(FOUR, loss=1.0), 1)
    assert flown.messages > 0
    assert flown.received == 0
    assert flown.measures["bound_samples"] == 0


def test_half_the_acceleration_makes_a_push_last_longer_and_hits_nobody_else() -> None:
    alone = replace(FOUR, loss=1.0, start_ball_m=0.0, start_velocity_m_s=0.0)
    pushed = replace(alone, push_agent=1, push_time_s=2.0, push_m_s=(0.0, 1.0, 0.0))
    weak = replace(pushed, disturbances=((1, 0.0, np.inf, 0.5, 0.0, 0.0, 0.0),))
    sound, failing = run(pushed, 1).place_error_m(), run(weak, 1).place_error_m()
    assert failing[:, 1].max() > 1.3 * sound[:, 1].max()
    assert np.delete(failing, 1, axis=1).max() < 1e-9


def test_a_push_acts_on_its_vehicle_in_its_time_with_its_acceleration() -> None:
    drifting = replace(FOUR, loss=1.0, start_ball_m=0.0, start_velocity_m_s=0.0, k_v=0.0, k_p=0.0)
    blown = run(replace(drifting, disturbances=((2, 3.0, 5.0, 1.0, 0.0, -1.5, 0.0),)), 1)
    assert np.abs(blown.velocity_m_s[blown.time_s <= 3.0, :, 1]).max() == pytest.approx(0.0, abs=1e-9)
    assert blown.velocity_m_s[-1, :, 1] == pytest.approx([0.0, 0.0, -3.0, 0.0], abs=1e-6)


def test_a_partition_cuts_what_passes_between_its_parts_and_only_that() -> None:
    every = replace(FOUR, trigger="periodic", period_s=0.5)
    whole, cut = run(every, 1), run(replace(every, partitions=((0.0, 6.0, 2.0),)), 1)
    assert whole.messages == cut.messages
    # of each message's three receivers one is on the own side: for half of the time
    assert cut.received == pytest.approx(whole.received * (0.5 + 0.5 / 3.0), rel=0.05)


def test_a_late_joiner_is_silent_and_deaf_until_it_joins_and_then_takes_its_slot() -> None:
    late = run(replace(FOUR, joins=((3, 4.0, 0.0, -12.0, 0.0),), duration_s=40.0), 1)
    assert late.events[late.events[:, 1] == 3, 0].min() == 400
    place = late.place_error_m()[:, 3]
    assert place[late.time_s < 4.0].min() > 10.0
    assert place[-1] < 0.3


def test_who_heeds_whom_is_mutual_and_each_heeds_at_least_its_nearest() -> None:
    setup = replace(FOUR, formation=Formation(shape="line", count=6, spacing_m=2.0), nearest=2)
    off = ~np.eye(6, dtype=bool)
    linked = np.zeros((6, 6), dtype=np.uint8)
    linked[off] = linked_pairs(setup)
    assert (linked == linked.T).all()
    assert linked.sum(axis=1).min() >= 2
    assert linked[0].tolist() == [0, 1, 1, 0, 0, 0]
    assert not linked_pairs(FOUR).size


def test_everybody_heeded_is_what_is_flown_without_a_number() -> None:
    few, all_of_them = replace(FOUR, nearest=1), replace(FOUR, nearest=3)
    assert np.array_equal(run(all_of_them, 1).position_m, run(FOUR, 1).position_m)
    assert not np.array_equal(run(few, 1).position_m, run(FOUR, 1).position_m)


def test_two_that_are_near_speak_at_near_modes_rate_and_without_it_they_do_not() -> None:
    crossing = replace(GUARDED, scrambled=True, start_ball_m=0.2, loss=0.3, delay_s=0.1, digest=3)
    near_mode, without = run(crossing, 2), run(replace(crossing, near=False), 2)
    assert near_mode.by_cause()["near"] > 20
    assert without.by_cause()["near"] == 0
    spoke = near_mode.events[near_mode.events[:, 2] == CAUSES.index("near"), 1]
    most = near_mode.events[near_mode.events[:, 1] == np.bincount(spoke).argmax(), 0] * crossing.dt_s
    assert np.median(np.diff(most)) == pytest.approx(0.1, abs=0.021)


def test_in_steady_flight_near_mode_says_nothing() -> None:
    flown = run(GUARDED, 1)
    late = flown.events[flown.events[:, 0] > 400]
    assert CAUSES.index("near") not in late[:, 2]


def test_causes_add_up_to_the_messages() -> None:
    for setup in (FOUR, GUARDED, replace(FOUR, trigger="periodic", period_s=0.2)):
        flown = run(setup, 3)
        assert sum(flown.by_cause().values()) == flown.messages
        assert flown.by_cause()["first"] == 4


def test_spread_periods_send_as_many_messages_and_not_at_once() -> None:
    every = replace(FOUR, trigger="periodic", period_s=1.0, t_max_s=1e9)
    together, spread = run(every, 1), run(replace(every, period_spread=True), 1)
    assert abs(together.messages - spread.messages) <= 4
    late = spread.events[spread.events[:, 0] > 0]
    assert len(np.unique(late[:, 0])) == len(late)


def test_the_push_that_makes_near_is_the_flown_one() -> None:
    rng = np.random.default_rng(4)
    for _ in range(2000):
        apart, velocity, other = (Ned(*rng.normal(scale=x, size=3).tolist()) for x in (3.0, 0.05, 0.05))
        peer = Neighbour(2, apart, velocity, apart, 0.0, bool(rng.random() < 0.8), True, 0.3, None, other)
        limits = (float(rng.uniform(0.5, 3.0)), float(rng.uniform(0.5, 2.0)))
        assert core.near_push_m_s2(peer, velocity, *limits) == pytest.approx(
            near.near_push_m_s2(peer, velocity, *limits)
        )
        assert core.resting_push_m_s2(*limits) == pytest.approx(safety.resting_push_m_s2(*limits))


def test_a_near_peers_uncertainty_is_the_stated_one_until_its_sample_is_old() -> None:
    table = near_uncertainty_m(GUARDED)
    assert table[0] == pytest.approx(GUARDED.uncertainty_m)
    assert table[-1] == pytest.approx(GUARDED.uncertainty_m + near.MISSING_MAX_M)
    assert (np.diff(table) >= 0.0).all()


def test_a_share_of_the_errors_is_read_from_their_bins() -> None:
    bins = np.zeros(4000, dtype=np.int64)
    bins[[10, 500]] = 999, 1
    assert quantile_m(bins, 0.5) == pytest.approx(0.011)
    assert quantile_m(bins, 0.9999) == pytest.approx(0.501)


FREE = replace(
    FOUR, formation=Formation(shape="grid", count=9, spacing_m=4.0), plan=False, k_p=0.0, nearest=3, links=False,
    barrier=True, r0_m=2.0, duration_s=30.0, start_ball_m=0.1, start_velocity_m_s=0.0,
)  # fmt: skip
SCARED = replace(FREE, threat=(4.0, 4.0, -9.0, 0.0, 0.0, 8.0, 3.0))
"""it stands beside the formation, north of where that is by then"""


def test_who_sees_the_threat_flees_it_the_others_follow_and_in_the_end_all_fly_as_before() -> None:
    calm, flown = run(FREE, 1), run(SCARED, 1)
    fled = (flown.common[:, :, 3] == evasion.FLEES).any(axis=0)
    assert 1 <= fled.sum() <= 6
    assert not calm.common.size
    before = flown.time_s <= 4.0
    assert np.array_equal(flown.position_m[before], calm.position_m[before])
    nu = flown.common[:, :, :2]
    moved = np.linalg.norm(nu - nu[0], axis=2).max(axis=0)
    assert moved[fled].min() > 0.5
    assert moved[~fled].max() > 0.1
    assert np.linalg.norm(nu[-1] - [1.0, 0.0], axis=1).max() < 0.1
    assert flown.measures["minimum_distance_m"] > 1.5
    assert flown.formation_error_m()[-1].max() < 0.5


def test_without_messages_nobody_but_those_that_see_the_threat_moves() -> None:
    deaf = run(replace(SCARED, loss=1.0), 1)
    fled = (deaf.common[:, :, 3] == evasion.FLEES).any(axis=0)
    assert fled.any()
    assert np.abs(deaf.common[:, ~fled, 1]).max() < 1e-9


def test_an_informed_one_flees_and_goes_back_to_what_it_knows() -> None:
    led = run(replace(SCARED, informed=(0, 1, 2, 3, 4, 5, 6, 7, 8)), 1)
    fled = (led.common[:, :, 3] == evasion.FLEES).any(axis=0)
    assert np.linalg.norm(led.common[:, fled, :2] - [1.0, 0.0], axis=2).max() > 0.5
    assert led.common[-1, :, :2] == pytest.approx(np.tile([1.0, 0.0], (9, 1)))


def test_the_evasion_that_is_compiled_is_the_flown_one() -> None:
    rng = np.random.default_rng(5)
    for _ in range(500):
        e = evasion.Evasion(int(rng.integers(3)), *rng.normal(size=6).tolist(), float(rng.uniform(0.0, 5.0)))
        threat = evasion.Threat(*rng.normal(scale=5.0, size=4).tolist(), float(rng.uniform(1.0, 20.0)), 10.0)
        at = (float(rng.uniform(-1.0, 11.0)), *rng.normal(scale=8.0, size=2).tolist(), *rng.normal(size=2).tolist())
        assert core.evade(e, threat, *at, 0.02) == pytest.approx(evasion.evade(e, threat, *at, 0.02))


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"loss": 1.1}, "loss must be in"),
        ({"near": True}, "near must be false without the barrier"),
        ({"informed": [1]}, "informed must be empty with a plan"),
        ({"plan": False, "informed": [12]}, "must be one of 0..9"),
        ({"plan": False, "joins": [[1, 2.0, 0.0, 0.0, 0.0]]}, "joins must be empty without a plan"),
        ({"disturbances": [[1.0, 2.0]]}, "disturbances must be rows of 7 numbers"),
        ({"nearest": 10}, "nearest must be less than the agents"),
        ({"threat": [1.0, 0.0, 0.0, 0.0, 0.0, 5.0, 3.0]}, "threat must be empty with a plan"),
        ({"plan": False, "threat": [1.0, 0.0, 0.0]}, "threat must be seven numbers"),
        ({"epsilon_nu_m_s": 0.0}, "epsilon_nu_m_s must be > 0"),
    ],
)
def test_a_scene_that_cannot_be_flown_is_refused_with_a_sentence(values: dict[str, object], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        setup_from(values, "own.toml")
