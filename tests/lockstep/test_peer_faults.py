"""Whatever peers do not say, or somebody says in their name: nobody comes near anybody, nor a vehicle that was lost."""

import sys
from collections.abc import Callable
from dataclasses import replace

import pytest
from flights import failsafes, until, wait
from peer_faults import LIES, Liar, lied_to, moving, restarted, states_lost

from companion.core.trajectory.successors import with_legs
from companion.core.values import FORMATION_PHASES, Phase
from companion.wire.peer import encode_motion
from sim.autopilot.faults import Fault, FaultKind

pytestmark = pytest.mark.timeout(600)
"""a flight is simulated within a test, on whatever machine"""

CLEARANCE_M = 1.2
LONG_SEEDS = range(100, 120)
STRAIGHT: list[dict[str, object]] = [{"kind": "velocity", "north_m_s": 1.0, "duration_s": 60.0}]


def least_of_twenty(what: str, flight: Callable[[int], float]) -> float:
    """The least of twenty seeds' distances (m), printed with its seed."""
    least_m, seed = min((flight(seed), seed) for seed in LONG_SEEDS)
    sys.stdout.write(f"{what}: least distance of {len(LONG_SEEDS)} flights {least_m:.2f} m, seed {seed}\n")
    return least_m


@pytest.mark.parametrize(("shape", "seed", "line"), [("column", 1, False), ("column", 2, True), ("v", 3, False)])
def test_others_keep_clear_of_a_vehicle_whose_companion_starts_anew_in_flight(
    shape: str, seed: int, line: bool
) -> None:
    nearest_m, i, ls = restarted(shape, seed, line)
    assert nearest_m >= CLEARANCE_M
    assert not line or ls.vehicles[i].agent.publisher.messages_sent > 0
    assert line or ls.vehicles[i].agent.publisher.messages_sent == 0
    assert all(p is Phase.LANDED for j, p in ls.phases().items() if j != i)


@pytest.mark.long
@pytest.mark.parametrize("stops", [True, False])
@pytest.mark.parametrize("line", [True, False])
@pytest.mark.parametrize("shape", ["column", "v"])
def test_over_twenty_seeds_nobody_comes_near_a_vehicle_whose_companion_starts_anew(
    shape: str, line: bool, stops: bool
) -> None:
    what = f"restarted, {shape}, {'with' if line else 'without'} its line, {'stops' if stops else 'lands'}"
    assert least_of_twenty(what, lambda seed: restarted(shape, seed, line, stops)[0]) >= CLEARANCE_M


def test_a_companion_that_knows_not_where_it_is_says_nothing_and_is_known_to_be_there() -> None:
    ls = moving(3, "v", 1, STRAIGHT)
    ls.kill(2)
    wait(ls, 1.0)
    ls.restart(2, line_dead_s=4.0)
    wait(ls, 3.5)
    assert ls.vehicles[2].agent.publisher.messages_sent == 0
    assert ls.vehicles[1].agent.peers.phases()[2] is None
    wait(ls, 3.0)
    # With its line it tells where it truly is, idle and in the air, or landed by its autopilot meanwhile.
    assert ls.vehicles[1].agent.peers.phases()[2] is Phase.IDLE
    told = ls.vehicles[1].agent.peers.sample(2)
    assert told is not None
    p, q = told.position_ned_m, ls.positions()[2]
    assert abs(p.north - q.north) + abs(p.east - q.east) < 1.0


@pytest.mark.parametrize("count", [4, 6])
def test_who_hear_nobodys_states_in_a_turn_stand_apart_and_land(count: int) -> None:
    nearest_m, ls = states_lost(count, seed=2, t_max_s=3.0)
    assert nearest_m >= CLEARANCE_M
    told = [(i, note) for i, note in failsafes(ls) if "nobody's states heard: leave formation" in note]
    assert [i for i, _ in sorted(told)] == list(ls.vehicles)
    assert ls.all_in(Phase.LANDED)


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("count", [5, 10])
def test_over_twenty_seeds_nobody_comes_near_when_all_states_are_lost_in_a_turn(count: int) -> None:
    assert least_of_twenty(f"states lost, {count}", lambda seed: states_lost(count, seed)[0]) >= CLEARANCE_M


def test_one_that_alone_hears_nobody_stands_apart_and_comes_back() -> None:
    ls = moving(4, "v", 4, STRAIGHT, t_max_s=3.0)
    ls.drop_topic("state", 2)
    until(ls, 14.0, lambda: ls.phases()[2] is Phase.DETACHED)
    wait(ls, 1.0)
    assert {p for i, p in ls.phases().items() if i != 2} == {Phase.MOVING}
    assert all(ls.vehicles[i].agent.peers.phases()[2] is Phase.DETACHED for i in (1, 3, 4))
    ls.restore_topics()
    until(ls, 40.0, lambda: ls.phases()[2] in FORMATION_PHASES)


PUSHED_M = {
    "all_have_landed": 1.0,
    "moves_third_parties": 0.6,
    "sequence_from_the_end": 0.6,
    "drifts": 8.0,
    "drifts_from_ahead": 8.0,
    "teleports": 15.0,
    "alternates": 15.0,
}
"""how far from its slot a vehicle comes at most; a place that is told of under the vehicle's own id pushes further"""


@pytest.mark.parametrize("name", LIES)
def test_a_liar_brings_nobody_together_and_ends_nobodys_flight(name: str) -> None:
    liar: Liar = lied_to(name)
    assert liar.least_m() >= CLEARANCE_M
    assert set(liar.ls.phases().values()) == {Phase.MOVING}
    assert liar.pushed_m() <= PUSHED_M[name]
    counted = set().union(*(v.agent.peers.rejected for v in liar.ls.vehicles.values()))
    assert counted <= {
        "a peer's state jumps",
        "two sources under one id",
        "repeated or out of order",
        "digest: contradicts what was heard",
        "own id",
    }
    assert name == "sequence_from_the_end" or liar.ls.own_id_heard[2] > 0


def test_who_wants_to_return_when_a_forger_has_used_up_the_revisions_lands_and_nobody_ends() -> None:
    liar = Liar()
    newest = liar.ls.vehicles[2].agent.history.newest
    last = with_legs(newest, at_ns=liar.ls.now.fleet_ns + 2_000_000_000, issuer=2, legs=newest.legs)
    liar.says(liar.sample(2, revision=2**32 - 1))
    payload = encode_motion(replace(last, revision=2**32 - 1, legs_start_ns=newest.legs_start_ns))
    liar.ls.inject_peer("fleet/2/plan", payload, *liar.ls.vehicles)
    wait(liar.ls, 3.0)
    assert {v.agent.history.newest.revision for v in liar.ls.vehicles.values()} == {2**32 - 1}
    liar.ls.vehicles[1].autopilot.inject(Fault(FaultKind.LOW_BATTERY, 0.15, 1000.0))
    until(liar.ls, 60.0, lambda: liar.ls.phases()[1] is Phase.LANDED)
    assert any("no way back to the pads: the revisions of motions are used up" in note for _, _, note in liar.ls.notes)


def test_a_second_companion_of_one_id_moves_nobody_and_both_are_named() -> None:
    liar = Liar()
    liar.ls.add_twin(2)
    wait(liar.ls, 12.0)
    assert liar.least_m() >= CLEARANCE_M
    assert liar.pushed_m() < 0.6
    for i in (1, 3, 4, 5):
        assert liar.ls.vehicles[i].agent.peers.rejected["two sources under one id"] > 0
    assert any(i == 2 and note.startswith("own id heard from another") for _, i, note in liar.ls.notes)
