"""The clock that all in lockstep share, and what passes between agents, stubs and network at its times.

They speak the real MAVLink and peer bytes; only sockets and waiting are missing. Same seed, same bits.
"""

import heapq
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from math import dist
from random import Random
from typing import Any

from companion.config import FleetConfig
from companion.core.events import Event
from companion.core.values import Instant
from companion.io.records import peer_body
from companion.vehicle.agent import Agent
from companion.vehicle.outputs import Outputs
from companion.wire.events import encode_event
from sim.autopilot.autopilot import Autopilot
from sim.autopilot.stub_fleet import stub_settings
from sim.autopilot.stubs import build_autopilot, truth_record
from sim.lockstep.bound_count import BoundCount
from sim.lockstep.network import Network, NetworkParameters

UTC_AT_START_NS = 1_700_000_000_000_000_000
LINK_DELAY_NS = 300_000
"""one way between autopilot and companion"""
PRESENCE_DELAY_NS = 100_000_000
TRUTH_INTERVAL_NS = 20_000_000
NEVER_NS = 1 << 62


@dataclass(slots=True)
class Vehicle:
    """One vehicle in lockstep."""

    agent: Agent
    autopilot: Autopilot
    alive: bool = True
    """whether the companion runs"""


@dataclass(frozen=True, slots=True)
class Sent:
    """One put of a companion, for the count of messages."""

    time_ns: int
    vehicle_id: int
    topic: str
    size: int


@dataclass(slots=True)
class Clockwork:
    """N agents, N stub autopilots and a seeded network on one integer-nanosecond clock, in one thread."""

    config: FleetConfig
    seed: int = 0
    network: NetworkParameters = field(default_factory=NetworkParameters)
    record: Callable[[int, str, Instant, bytes], None] | None = None
    """called with every input and output of every agent: (vehicle id, channel, time, body)"""
    command_delay_s: float = 0.0
    """how much longer than LINK_DELAY_NS what a companion sends takes to its autopilot"""
    now_ns: int = 0
    vehicles: dict[int, Vehicle] = field(init=False)
    sent: list[Sent] = field(default_factory=list)
    notes: list[tuple[float, int, str]] = field(default_factory=list)
    """(seconds, vehicle, what happened)"""
    events: list[tuple[int, int, Event]] = field(default_factory=list)
    """(fleet time, vehicle, what happened)"""
    own_id_heard: Counter[int] = field(default_factory=Counter)
    """puts that reached a vehicle under its own id"""
    near_bound: BoundCount = field(default_factory=BoundCount)
    """of peers that speak in near mode"""
    bound: BoundCount = field(default_factory=BoundCount)
    """of all others that fly in formation under their law"""
    _truth: list[bytes] = field(default_factory=list)
    _net: Network = field(init=False)
    _queue: list[tuple[int, int, Callable[..., None], tuple[Any, ...]]] = field(default_factory=list)
    """what happens when: (time, order of entry, function, its arguments)"""
    _count: int = 0
    _autopilot_due_ns: dict[int, int] = field(default_factory=dict)
    _agent_due_ns: dict[int, int] = field(default_factory=dict)
    """deadlines, kept until something reaches the vehicle: asking all at each step would cost most of the time"""
    _stalled_until_ns: dict[int, int] = field(default_factory=dict)
    _line_dead_until_ns: dict[int, int] = field(default_factory=dict)
    """vehicle -> until when nothing passes between its autopilot and its companion"""
    _dropped: set[tuple[str, int]] = field(default_factory=set)
    """(topic, receiver): puts that do not arrive, while presence and everything else does"""
    _twins: dict[int, Agent] = field(default_factory=dict)
    """second companions, by the id that they share"""
    _twin_line: dict[int, int] = field(default_factory=dict)
    """twin's id -> vehicle on whose autopilot's line it is"""
    _touched: set[int] = field(default_factory=set)
    """vehicles whose deadlines may have changed"""

    def __post_init__(self) -> None:
        self._net = Network(self.network, self.seed)
        random = Random(self.seed)
        self.vehicles = {}
        settings = stub_settings(self.config, seed=self.seed)
        for v in settings.vehicles:
            autopilot = build_autopilot(settings, v, boot_ns=0, utc_offset_ns=UTC_AT_START_NS)
            agent = Agent(self.config, v.vehicle_id, boot_id=random.getrandbits(32))
            self.vehicles[v.vehicle_id] = Vehicle(agent, autopilot)
        # In the vehicles' order from now on: of what is due at one time, the first vehicle's comes first.
        self._autopilot_due_ns = dict.fromkeys(self.vehicles, 0)
        self._agent_due_ns = dict.fromkeys(self.vehicles, 0)
        for i in self.vehicles:
            self._announce_presence(i, True)
        self._at(TRUTH_INTERVAL_NS, self._sample_truth)

    @property
    def now(self) -> Instant:
        """The present, as every agent is told."""
        return Instant(self.now_ns, self.now_ns + UTC_AT_START_NS)

    def _at(self, time_ns: int, action: Callable[..., None], *arguments: Any) -> None:
        self._count += 1
        heapq.heappush(self._queue, (time_ns, self._count, action, arguments))

    def _announce_presence(self, i: int, alive: bool) -> None:
        for j in self.vehicles:
            if j != i:
                self._at(self.now_ns + PRESENCE_DELAY_NS, self._presence, j, i, alive)

    def _presence(self, receiver: int, about: int, alive: bool) -> None:
        self._touched.add(receiver)
        if self.vehicles[receiver].alive:
            self._log(receiver, "input/presence", bytes((about, alive)))
            self.vehicles[receiver].agent.receive_presence(about, alive, self.now)

    def _log(self, i: int, channel: str, body: bytes) -> None:
        if self.record is not None:
            self.record(i, channel, self.now, body)

    # -- the event loop ----------------------------------------------------------------------------------------------

    def run_until(self, time_s: float, stop: Callable[[], bool] | None = None) -> None:
        """Let time pass until `time_s` from the start, or until `stop()` (asked ten times a second) is true."""
        end_ns = round(time_s * 1e9)
        next_check_ns = self.now_ns
        self._touched.update(self.vehicles)
        while True:
            if stop is not None and self.now_ns >= next_check_ns:
                if stop():
                    return
                next_check_ns = self.now_ns + 100_000_000
                self._touched.update(self.vehicles)
            self._ask_deadlines()
            agents_ns = min(self._agent_due_ns.values())
            for twin in self._twins.values():
                agents_ns = min(agents_ns, twin.next_deadline_ns())
            time_ns = min(self._queue[0][0], agents_ns, *self._autopilot_due_ns.values())
            if time_ns > end_ns:
                self.now_ns = end_ns
                return
            self.now_ns = max(time_ns, self.now_ns)
            self._step()

    def _ask_deadlines(self) -> None:
        for i in self._touched:
            v = self.vehicles[i]
            self._autopilot_due_ns[i] = v.autopilot.next_deadline_ns()
            if v.alive:
                self._agent_due_ns[i] = max(v.agent.next_deadline_ns(), self._stalled_until_ns.get(i, 0))
            else:
                self._agent_due_ns[i] = NEVER_NS
        self._touched.clear()

    def _step(self) -> None:
        now_ns = self.now_ns
        while self._queue and self._queue[0][0] <= now_ns:
            _, _, action, arguments = heapq.heappop(self._queue)
            action(*arguments)
        self._ask_deadlines()
        for i, due_ns in self._autopilot_due_ns.items():
            if due_ns <= now_ns:
                self._touched.add(i)
                datagrams = self.vehicles[i].autopilot.advance(now_ns)
                if datagrams and self._line_works(i):
                    self._at(now_ns + LINK_DELAY_NS, self._to_companion, i, datagrams)
        for i, due_ns in self._agent_due_ns.items():
            if due_ns <= now_ns:
                self._touched.add(i)
                self._advance(i)
        for i, twin in self._twins.items():
            if twin.next_deadline_ns() <= now_ns:
                self._send(i, twin.advance(self.now), twin)

    def _line_works(self, i: int) -> bool:
        return self.now_ns >= self._line_dead_until_ns.get(i, 0)

    def _to_companion(self, i: int, datagrams: Iterable[bytes]) -> None:
        v, now = self.vehicles[i], self.now
        twins = [self._twins[k] for k, line in self._twin_line.items() if line == i] if self._twins else ()
        self._touched.add(i)
        for datagram in datagrams:
            if v.alive:
                self._log(i, "input/mavlink", datagram)
                v.agent.receive_mavlink(datagram, now)
            for twin in twins:
                twin.receive_mavlink(datagram, now)

    def _to_autopilot(self, i: int, datagrams: Iterable[bytes]) -> None:
        self._touched.add(i)
        for datagram in datagrams:
            self.vehicles[i].autopilot.receive(datagram, self.now_ns)

    def _advance(self, i: int) -> None:
        v = self.vehicles[i]
        self._log(i, "advance", b"")
        out: Outputs = v.agent.advance(self.now)
        for datagram in out.mavlink:
            self._log(i, "output/mavlink", datagram)
        for topic, payload in out.peers:
            self._log(i, "output/peer", peer_body(topic, payload))
            self.sent.append(Sent(self.now_ns, i, topic, len(payload)))
        for event in out.events:
            self._log(i, "event", encode_event(event))
            self.events.append((self.now.fleet_ns, i, event))
        self.notes += [(self.now_ns * 1e-9, i, note) for note in out.notes]
        self._send(i, out, v.agent)
        if out.tick is not None and out.tick.steered:
            self._look_at_bounds(v.agent)

    def _look_at_bounds(self, agent: Agent) -> None:
        """Of a peer that may be at several places, one must hold it: the one that comes nearest to its own bound."""
        seen: dict[int, tuple[float, float, float]] = {}
        for n in agent.neighbours:
            near, flies = agent.peers.due_soon(n.vehicle_id), self.vehicles[n.vehicle_id].agent.supervisor.steers
            if n.last_seen_ned_m is None and (near or (n.in_formation and flies)):
                true = self.vehicles[n.vehicle_id].autopilot.truth().position_ned_m
                error_m = dist(n.position_ned_m, true)
                place = (error_m / n.uncertainty_m, error_m, n.uncertainty_m)
                seen[n.vehicle_id] = min(seen.get(n.vehicle_id, place), place)
        for i, (_, error_m, bound_m) in seen.items():
            (self.near_bound if agent.peers.due_soon(i) else self.bound).see(error_m, bound_m)

    def _send(self, i: int, out: Outputs, sender: Agent) -> None:
        """What a companion sends goes on its ways, to its autopilot and to all who hear."""
        line = self._twin_line[i] if sender is self._twins.get(i) else i
        if out.mavlink and self._line_works(line):
            arrival_ns = self.now_ns + LINK_DELAY_NS + round(self.command_delay_s * 1e9)
            self._at(arrival_ns, self._to_autopilot, line, out.mavlink)
        for topic, payload in out.peers:
            key = f"fleet/{i}/{topic}"
            if i in self._twins:
                self._at(self.now_ns + LINK_DELAY_NS, self._to_peer, i, key, payload, sender)
            for j in self.vehicles:
                arrival = None if j == i else self._net.arrival_ns(i, j, self.now_ns)
                if arrival is not None and (topic, j) not in self._dropped:
                    self._at(arrival, self._to_peer, j, key, payload, sender)

    def _to_peer(self, j: int, key: str, payload: bytes, sender: Agent | None = None) -> None:
        v = self.vehicles[j]
        self._touched.add(j)
        for agent in (v.agent if v.alive else None, self._twins.get(j)):
            if agent is None or agent is sender:
                continue
            if key.split("/")[-2] == str(j):
                self.own_id_heard[j] += 1
            if agent is v.agent:
                self._log(j, "input/peer", peer_body(key, payload))
            agent.receive_peer(key, payload, self.now)

    def _sample_truth(self) -> None:
        fleet_ns = self.now.fleet_ns
        self._truth += [truth_record(i, v.autopilot.truth(), fleet_ns) for i, v in self.vehicles.items()]
        self._at(self.now_ns + TRUTH_INTERVAL_NS, self._sample_truth)
