"""The faults that lockstep itself injects do what they say, and nothing else."""

import pytest
from flights import fleet, launch, until, wait

from companion.core.values import Phase
from sim.lockstep.lockstep import Lockstep

pytestmark = pytest.mark.timeout(600)
"""a flight is simulated within a test, on whatever machine"""


def waiting(count: int = 3) -> Lockstep:
    def manual(tables: dict[str, dict[str, object]]) -> None:
        tables["plan"]["automatic"] = False
        tables["trigger"]["t_max_s"] = 2.0

    ls = launch(fleet(count, change=manual), seed=3)
    until(ls, 20.0, lambda: ls.all_in(Phase.WAITING))
    return ls


def ages_s(ls: Lockstep, i: int) -> list[float]:
    peers = ls.vehicles[i].agent.peers
    return [(ls.now.fleet_ns - s.time_ns) * 1e-9 for j in sorted(peers.ids) if (s := peers.sample(j)) is not None]


def test_states_are_lost_to_those_named_while_presence_stays() -> None:
    ls = waiting()
    ls.drop_topic("state", 2)
    wait(ls, 2.6)
    assert min(ages_s(ls, 2)) > 2.5
    assert max(ages_s(ls, 1)) < 2.5
    ls.restore_topics()
    wait(ls, 2.5)
    assert max(ages_s(ls, 2)) < 2.5
    assert not any("foreign" in kind for kind in ls.vehicles[2].agent.peers.rejected)


def test_a_companion_restarts_with_a_line_that_comes_back() -> None:
    ls = waiting()
    ls.kill(1)
    wait(ls, 0.5)
    ls.restart(1, line_dead_s=3.0)
    wait(ls, 2.5)
    assert ls.vehicles[1].agent.autopilot.heartbeat_ns is None
    wait(ls, 2.0)
    assert ls.vehicles[1].agent.autopilot.heartbeat_ns is not None


def test_what_is_injected_is_heard_by_those_named_and_not_by_whom_it_names() -> None:
    ls = waiting()
    for receivers in ((2,), ()):
        ls.inject_peer("fleet/1/state", b"nonsense", *receivers)
    assert [ls.vehicles[i].agent.rejected["state: version"] for i in (1, 2, 3)] == [0, 2, 1]


def test_a_second_companion_of_one_id_speaks_and_the_first_hears_that_it_does() -> None:
    ls = waiting()
    boot_id = ls.vehicles[1].agent.boot_id
    twin = ls.add_twin(1)
    wait(ls, 3.0)
    assert twin.boot_id != boot_id
    assert twin.publisher.messages_sent > 0
    assert ls.own_id_heard[1] >= twin.publisher.messages_sent
