"""The graph in use as one vehicle sees it: how well it holds together, and a warning before it falls apart."""

from collections.abc import Generator, Sequence
from itertools import combinations
from math import dist

from companion.core.events import Event, GraphNearBreaking
from companion.core.frames import Ned
from companion.core.neighbours.graph import Connectivity, Graph, among, connectivity_in_steps
from companion.core.neighbours.table import PeerTable
from companion.core.trajectory.fleet import FleetTrajectory
from companion.core.values import Instant, Neighbour

PERIOD_NS = 1_000_000_000
"""how often it is looked at"""


class GraphWatch:
    """Looks at the graph of those in formation that this vehicle sees, itself included."""

    def __init__(self, vehicle_id: int, peers: PeerTable) -> None:
        self.events: list[Event] = []
        """emptied by the agent"""
        self.connectivity: Connectivity | None = None
        """None: nobody else is in formation, or the vehicle itself is not"""
        self._id = vehicle_id
        self._peers = peers
        self._graph: Graph = {}
        self._work: Generator[None, None, Connectivity] | None = None
        """what is being reckoned of that graph"""
        self._due_ns = 0

    def look(
        self, plan: FleetTrajectory, here_ned_m: Ned, neighbours: Sequence[Neighbour], part: bool, now: Instant
    ) -> None:
        """Look once a second; what has changed is reckoned a step a tick, so that no setpoint waits for it."""
        if now.monotonic_ns >= self._due_ns:
            self._due_ns = now.monotonic_ns + PERIOD_NS
            graph = self._seen(plan, here_ned_m, neighbours) if part else {}
            if graph != self._graph:
                self._graph = graph
                self._work = connectivity_in_steps(graph) if len(graph) > 1 else None
                if self._work is None:
                    self.connectivity = None
        if self._work is None:
            return
        try:
            next(self._work)
        except StopIteration as done:
            self._work = None
            self._found(done.value)

    def _found(self, found: Connectivity) -> None:
        broke = self.connectivity is not None and self.connectivity.breaks
        self.connectivity = found
        if found.breaks and not broke:
            self.events.append(GraphNearBreaking(found.edge, found.lambda2))

    def _seen(self, plan: FleetTrajectory, here_ned_m: Ned, neighbours: Sequence[Neighbour]) -> Graph:
        """Of those that share the avoidance, as whoever is soundly in formation does."""
        places = {n.vehicle_id: n.position_ned_m for n in neighbours if n.shares_avoidance} | {self._id: here_ned_m}
        limits = self._peers.limits
        if limits.neighbours == "nearest":
            return among(self._peers.joined(plan), places.keys())
        joined: dict[int, set[int]] = {i: set() for i in sorted(places)}
        for i, j in combinations(joined, 2):
            if limits.neighbours == "all" or dist(places[i], places[j]) <= limits.range_m:
                joined[i].add(j)
                joined[j].add(i)
        return joined
