"""The graph as one vehicle sees it: told when it is reckoned, a step a tick, and a warning before it falls apart."""

from pathlib import Path

import pytest

from companion.config import FleetConfig, load
from companion.core.events import GraphNearBreaking
from companion.core.neighbours.graph import connectivity_in_steps, mutual_nearest
from companion.core.neighbours.table import PeerTable
from companion.core.trajectory.history import TrajectoryHistory
from companion.core.values import ZERO, Instant, Neighbour
from companion.vehicle.graph_watch import GraphWatch

TICK_NS = 20_000_000
FLEET = Path(__file__).parents[2] / "fleet.toml"


def configured(nearest: int) -> FleetConfig:
    def change(tables: dict[str, dict[str, object]]) -> None:
        tables["formation"]["shape"] = "line"
        tables["peers"].update(neighbours="nearest", nearest=nearest)

    return load(FLEET, change)


class Watched:
    """Vehicle 1 of a line of ten, and a clock."""

    def __init__(self, nearest: int) -> None:
        self.config = configured(nearest)
        self.plan = self.config.motion_into("line", self.config.first_motion, 0, 0)
        history = TrajectoryHistory([self.plan])
        others = frozenset(range(2, 11))
        self.watch = GraphWatch(1, PeerTable(1, others, self.config.peer_limits, history))
        self.tick = 0

    def see(self, ids: set[int], ticks: int) -> None:
        places = {i: change.after for i, change in self.plan.slots.items()}
        seen = [
            Neighbour(i, places[i], ZERO, ZERO, 0.0, True, True, 1.0, None, ZERO, ZERO, ()) for i in sorted(ids - {1})
        ]
        for _ in range(ticks):
            self.tick += 1
            now = Instant(self.tick * TICK_NS, self.tick * TICK_NS)
            self.watch.look(self.plan, places[1], seen, True, now)


def slot_order(watched: Watched) -> list[int]:
    """Ids from one end of the line to the other."""
    slots = {i: c.after for i, c in watched.plan.slots.items()}
    return sorted(slots, key=lambda i: (slots[i].east, slots[i].north))


def test_a_chain_is_warned_of_once_with_the_vehicle_at_its_edge() -> None:
    w = Watched(nearest=1)
    w.see(set(range(1, 11)), 200)
    (event,) = w.watch.events
    assert isinstance(event, GraphNearBreaking)
    assert event.edge in (slot_order(w)[0], slot_order(w)[-1])
    assert w.watch.connectivity is not None
    assert w.watch.connectivity.breaks
    w.see(set(range(1, 11)) - {slot_order(w)[0]}, 200)
    assert len(w.watch.events) == 1, "it was told"


def test_who_is_well_held_is_not_warned_until_so_many_are_gone() -> None:
    w = Watched(nearest=4)
    w.see(set(range(1, 11)), 200)
    assert w.watch.events == []
    assert w.watch.connectivity is not None
    assert w.watch.connectivity.lambda2 > 0.3
    order = [i for i in slot_order(w) if i != 1]
    w.see(set(range(1, 11)) - set(order[3:7]), 200)
    assert len(w.watch.events) == 1


def test_a_tick_does_one_step_of_what_is_reckoned_and_the_last_account_stands_meanwhile() -> None:
    w = Watched(nearest=2)
    w.see(set(range(1, 11)), 1)
    assert w.watch.connectivity is None
    steps = sum(1 for _ in connectivity_in_steps(mutual_nearest({i: c.after for i, c in w.plan.slots.items()}, 2)))
    w.see(set(range(1, 11)), steps - 1)
    assert w.watch.connectivity is None
    w.see(set(range(1, 11)), 1)
    assert w.watch.connectivity is not None


@pytest.mark.parametrize("seen", [{1}, set()])
def test_alone_there_is_no_graph(seen: set[int]) -> None:
    w = Watched(nearest=2)
    w.see(set(range(1, 11)), 200)
    w.see(seen, 60)
    assert w.watch.connectivity is None
