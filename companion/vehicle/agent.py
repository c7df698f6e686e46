"""The vehicle agent: one vehicle's whole behaviour, without I/O. The only place where core and wire meet.

The same object flies a drone, a stub in real time, a stub in lockstep, and a recorded flight in replay: bytes and time
go in, bytes come out. It never reads a clock and never raises for what others send.

It is a mailbox (`receive_...`) and a tick (`_tick`) whose stages are lines. What a stage needs to remember is kept by
the part that does it: `observer`, `supervisor`, `peers`, `plans`, `publisher`, and `operator` for whoever asks.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import dist, hypot
from random import Random
from typing import Any

from companion.config import FleetConfig
from companion.core.counts import Counts
from companion.core.events import FailsafeNoted
from companion.core.failsafe import LATE_S, Failsafe
from companion.core.frames import Ned
from companion.core.law.base import Wanted
from companion.core.neighbours.table import PeerTable
from companion.core.safety.filter import SafetyFilter
from companion.core.trajectory.fleet import Reference, TrajectoryState
from companion.core.trajectory.history import TrajectoryHistory
from companion.core.values import (
    FILTERED_PHASES,
    FORMATION_PHASES,
    SETTLED_PHASES,
    ZERO,
    Command,
    Instant,
    Neighbour,
    Phase,
    SafeSetpoint,
    VehicleState,
)
from companion.errors import WireError
from companion.vehicle import operator_port, plan_exchange
from companion.vehicle.agreement import Agreement
from companion.vehicle.autopilot.adapters import open_autopilot
from companion.vehicle.autopilot.port import AutopilotPort, Heard
from companion.vehicle.graph_watch import GraphWatch
from companion.vehicle.guest import GUESTS, hold_of, law_of, trigger_of
from companion.vehicle.observer import StateObserver
from companion.vehicle.operator_port import Activity, OperatorPort
from companion.vehicle.orders import OrderBook
from companion.vehicle.outputs import Outputs, TickReport
from companion.vehicle.plan_exchange import PlanExchange
from companion.vehicle.publisher import OwnState, Publisher
from companion.vehicle.supervisor import Supervisor
from companion.wire.operator import Status
from companion.wire.peer import WIRE_FAULTS, decode_state

TIMER_SLACK = 2.5
"""without a new position the control tick comes this many periods after the last"""
UNSTEERED_PREDICTION_NS = 200_000_000
"""who does not steer predicts its peers this often: a crowd on the ground need not work as in the air"""
REJECTED = (
    "peer: unknown topic",
    "state: id is not the key's",
    "state: of another law",
    *(f"state: {kind}" for kind in WIRE_FAULTS),
    *plan_exchange.REJECTED,
    *operator_port.REJECTED,
    *(failsafe.value for failsafe in Failsafe),
    *GUESTS,
)
"""what an agent counts"""


class Agent:
    """One vehicle of the fleet."""

    def __init__(self, config: FleetConfig, vehicle_id: int, boot_id: int) -> None:
        self.config = config
        self.vehicle = config.by_id(vehicle_id)
        self.id = vehicle_id
        self.boot_id = boot_id
        self.rejected = Counts(REJECTED)
        others = frozenset(v.id for v in config.vehicles) - {vehicle_id}
        random = Random(vehicle_id << 32 | boot_id)
        self.autopilot: AutopilotPort = open_autopilot(config, self.vehicle)
        self.history = TrajectoryHistory([config.first_motion])
        limits = replace(config.peer_limits, hold=hold_of(config, self.rejected))
        self.peers = PeerTable(vehicle_id, others, limits, self.history)
        self.law = law_of(config, self.rejected)
        """what is flown, before the filter; tests and studies may put another in its place"""
        self.safety = SafetyFilter(config.safety_limits)
        self.observer = StateObserver()
        self.agreement = Agreement(config, vehicle_id, self.peers)
        self.graph = GraphWatch(vehicle_id, self.peers)
        self.supervisor = Supervisor(config, self.autopilot, self.history, self.peers, self._restart_filter)
        trigger = trigger_of(config, self.rejected)
        self.publisher = Publisher(config, vehicle_id, boot_id, trigger, self.history, self.peers, random)
        self.plans = PlanExchange(
            config, vehicle_id, self.history, self.peers, self.supervisor, self.publisher, self.agreement, random,
            self.rejected,
        )  # fmt: skip
        self.operator = OperatorPort(
            config, vehicle_id, boot_id, self.autopilot, self.supervisor, self.history, self.peers, self.plans,
            self.publisher, self.agreement, self.graph, self.rejected, OrderBook(boot_id),
        )  # fmt: skip
        parts = (self.supervisor, self.plans, self.peers, self.graph, self.autopilot)
        self._events: tuple[list[Any], ...] = tuple(part.events for part in parts)
        """where the parts leave what happened"""
        self.setpoints_sent = 0
        self._timer_ns = round(TIMER_SLACK * 1e9 / config.limits.control_rate_hz)
        self._ids = {str(i): i for i in others}
        """the peers as keys name them"""
        self._position_came = False
        self._began_ns: int | None = None
        """when this agent first acted (monotonic)"""
        self._ticked_ns: int | None = None
        """when the last control tick was (monotonic)"""
        self._last_tick: TickReport | None = None
        self._neighbours: list[Neighbour] = []
        self._predict_ns = 0
        """when who does not steer predicts its peers again (monotonic)"""
        self._outputs = Outputs()
        """what the next `advance` returns"""

    @property
    def phase(self) -> Phase:
        """Where the vehicle is in its flight."""
        return self.supervisor.phase

    @property
    def neighbours(self) -> Sequence[Neighbour]:
        """The peers as they were last predicted."""
        return self._neighbours

    @property
    def stopped(self) -> bool:
        """Whether nothing hangs in the air on this process."""
        return self.supervisor.stopped

    # -- the mailbox ---------------------------------------------------------------------------------------------------

    def receive_mavlink(self, datagram: bytes, now: Instant) -> Heard:
        """Bytes of one datagram from the link; what they brought."""
        heard = self.autopilot.receive(datagram, now)
        if heard.position:
            self._position_came = True
            if self.supervisor.position_came():
                self.observer.start_anew()
        return heard

    def receive_peer(self, key: str, payload: bytes, now: Instant) -> None:
        """A peer's put: `fleet/<id>/state` or `fleet/<id>/plan`."""
        path, _, topic = key.rpartition("/")
        sender = path.rpartition("/")[2]
        if topic not in ("state", "plan"):
            self.rejected["peer: unknown topic"] += 1
        elif sender == str(self.id):
            self._hear_own_id(now)
        else:
            try:
                if topic == "plan":
                    self.plans.on_plan(self._ids.get(sender), payload, now)
                else:
                    self._receive_state(sender, payload, now)
            except WireError as error:
                self.rejected[f"{topic}: {error.kind}"] += 1

    def _receive_state(self, sender: str, payload: bytes, now: Instant) -> None:
        message = decode_state(payload)
        if sender != str(message.sample.vehicle_id):
            self.rejected["state: id is not the key's"] += 1
        elif any(len(s.told) != len(self.law.fields) for s in (message.sample, *message.digest)):
            self.rejected["state: of another law"] += 1
        elif self.peers.accept(message, now) is None:
            if self.id in message.near_ids:
                self.publisher.near.named(now.monotonic_ns)
            self.plans.on_state(message, now)

    def _hear_own_id(self, now: Instant) -> None:
        """What somebody else says under this vehicle's id is not taken, and contradicted."""
        self.rejected[Failsafe.OWN_ID.value] += 1
        if not self.publisher.own_id_heard(now):
            self._outputs.events.append(FailsafeNoted(Failsafe.OWN_ID, "it says where it is itself"))
        self.publisher.on_own_id(now)

    def receive_presence(self, vehicle_id: int, alive: bool, now: Instant) -> None:
        """A peer's process appeared or ended."""
        self.peers.presence(vehicle_id, alive, now)
        if alive and vehicle_id in self.peers.ids:
            self.publisher.on_new_peer(now)
            self.plans.on_new_peer(now)

    def receive_command(self, payload: bytes, now: Instant) -> bytes:
        """An operator's command as JSON; returns the answer as JSON. The same bytes again get the same answer."""
        return self.operator.receive_command(payload, now)

    def notice(self, failsafe: Failsafe, now: Instant) -> None:
        """Something that only the process around can see: it is noted and counted, and changes nothing."""
        del now
        self.rejected[failsafe.value] += 1
        self._outputs.events.append(FailsafeNoted(failsafe, "noted"))

    def stop(self, now: Instant) -> None:
        """The process is asked to end: land. `stopped` tells when the autopilot has taken over."""
        self.supervisor.land(now)

    def status(self, now: Instant) -> Status:
        """This vehicle's account of itself, but for what only its process knows."""
        up_s = 0.0 if self._began_ns is None else (now.monotonic_ns - self._began_ns) * 1e-9
        return self.operator.status(Activity(up_s, self.setpoints_sent, self._last_tick, dict(self.safety.counts)), now)

    # -- time ----------------------------------------------------------------------------------------------------------

    def next_deadline_ns(self) -> int:
        """When `advance` must be called at the latest (monotonic ns), if nothing arrives before; 0: at once."""
        if self._position_came:
            return 0
        deadline = self.autopilot.next_deadline_ns()
        if self._ticked_ns is not None:
            deadline = min(deadline, self._ticked_ns + self._timer_ns)
        plan_ns = self.plans.next_deadline_ns()
        return deadline if plan_ns is None else min(deadline, plan_ns)

    def advance(self, now: Instant) -> Outputs:
        """Do what is due; the returned outputs are to be sent in their order."""
        if self._began_ns is None:
            self._began_ns = now.monotonic_ns
        if self._position_came or self._ticked_ns is None or now.monotonic_ns - self._ticked_ns >= self._timer_ns:
            self._tick(now)
        out, self._outputs = self._outputs, Outputs()
        out.mavlink += self.autopilot.due(now)
        plan = self.plans.due(now)
        if plan is not None:
            out.peers.append(("plan", plan))
        for events in self._events:
            if events:
                out.events += events
                events.clear()
        return out

    def _tick(self, now: Instant) -> None:
        """One control tick, from the newest position to the setpoint and what the peers are told."""
        dt_s = self._begin(now)
        measured = self.supervisor.state(now)
        self._supervise(measured is not None, now)
        self.supervisor.flight.unfollowed_m_s = 0.0
        if measured is None:
            self._publish_last_known(now)
            return
        ego = self._observe(*measured, now)
        plan, part = self.history.at(now.fleet_ns), self.phase in FORMATION_PHASES
        shared = plan.state_at(now.fleet_ns)
        slot = shared.slot(plan.slots[self.id])
        formation = self.agreement.advance(plan, shared, ego, self._neighbours, part, now)
        neighbours = self._predict(ego, formation, now)
        formation = self.agreement.place(plan, formation, ego, neighbours, part, now)
        own = slot if formation is shared else formation.slot(plan.slots[self.id])._replace(shared=False)
        reference = self.supervisor.follow(own, ego, now)
        residual, setpoint = ZERO, None
        if self.supervisor.steers:
            wanted = self._command(ego, reference, neighbours)
            residual = wanted.residual_ned_m
            setpoint = self._constrain(wanted.command(reference), ego, neighbours, dt_s)
            self._steer(setpoint)
            if setpoint is not None:
                self.supervisor.flight.unfollowed_m_s = hypot(
                    ego.velocity_ned_m_s.north - setpoint.velocity_north_m_s,
                    ego.velocity_ned_m_s.east - setpoint.velocity_east_m_s,
                )
            self.publisher.see_near(self.safety.peer_planes, neighbours, reference.velocity_ned_m_s, now)
        self.supervisor.settle(ego, reference, now)
        self.graph.look(plan, ego.position_ned_m, neighbours, part, now)
        self.plans.propose(now)
        self._publish(slot, residual, now)
        self._report_tick(ego, reference, neighbours, setpoint is not None)

    # -- the stages ----------------------------------------------------------------------------------------------------

    def _begin(self, now: Instant) -> float:
        """The time since the tick before (s; 0 for the first)."""
        self._position_came = False
        dt_s = 0.0 if self._ticked_ns is None else (now.monotonic_ns - self._ticked_ns) * 1e-9
        self._ticked_ns = now.monotonic_ns
        if dt_s > LATE_S and self.supervisor.steers:
            self.rejected[Failsafe.LOOP_LATE.value] += 1
        return dt_s

    def _supervise(self, positioned: bool, now: Instant) -> None:
        """Lead the autopilot from phase to phase and act on failsafes; a new phase is announced."""
        self.supervisor.watch(now, positioned)
        self.publisher.on_phase(self.phase, now)

    def _observe(self, position: Ned, velocity: Ned, now: Instant) -> VehicleState:
        """The own state without the estimator's velocity bias."""
        flown = self.safety.acceleration_m_s2 if self.phase in FILTERED_PHASES else (0.0, 0.0)
        return self.observer.observe(position, velocity, flown, now)

    def _predict(self, ego: VehicleState, formation: TrajectoryState, now: Instant) -> list[Neighbour]:
        """The peers within range, predicted to now."""
        if self.supervisor.steers or now.monotonic_ns >= self._predict_ns:
            self._predict_ns = now.monotonic_ns + UNSTEERED_PREDICTION_NS
            self._neighbours = self.peers.predict(
                ego.position_ned_m, now, formation, self.phase in SETTLED_PHASES, self.phase is Phase.RETURNING
            )
        return self._neighbours

    def _command(self, ego: VehicleState, reference: Reference, neighbours: Sequence[Neighbour]) -> Wanted:
        """What the law wants, and the formation's mean residual about this vehicle."""
        alone = self.supervisor.detached or self.agreement.flees
        return self.law.command(ego, reference, neighbours, alone=alone)

    def _constrain(
        self, command: Command, ego: VehicleState, neighbours: Sequence[Neighbour], dt_s: float
    ) -> SafeSetpoint | None:
        """The command within limits, fence and distances."""
        return self.safety.apply(command, ego, neighbours, self.observer.bias_m_s, dt_s)

    def _steer(self, setpoint: SafeSetpoint | None) -> None:
        """The setpoint's datagram; it comes first of what is sent."""
        if setpoint is None:
            return
        self._outputs.mavlink.append(self.autopilot.setpoint(setpoint))
        self.setpoints_sent += 1

    def _publish(self, slot: Reference, residual: Ned, now: Instant) -> None:
        """Tell the peers, if the publisher finds that they must be told."""
        since_ns, outdated = self.supervisor.formation_since_ns, self.supervisor.flight.outdated
        common = self.agreement.told if self.phase in FORMATION_PHASES else None
        own = OwnState(self.phase, *self.observer.smoothed, slot, residual, since_ns, self.law.tell(), outdated, common)
        message = self.publisher.publish(own, now)
        if message is not None:
            self._outputs.peers.append(("state", message))

    def _publish_last_known(self, now: Instant) -> None:
        """Whoever no longer knows where it is still announces what is new, from the last place it knew.

        Who never knew in this life has nothing to tell: its presence says that it is there.
        """
        if self.publisher.announces and self.observer.observed_ns is not None:
            self._publish(self.history.reference(self.id, now.fleet_ns), ZERO, now)

    def _report_tick(
        self, ego: VehicleState, reference: Reference, neighbours: Sequence[Neighbour], steered: bool
    ) -> None:
        """Report what this tick did."""
        here = ego.position_ned_m
        self._last_tick = self._outputs.tick = TickReport(
            dist(here, reference.position_ned_m),
            sum([n.in_formation for n in neighbours]),
            min([dist(n.position_ned_m, here) for n in neighbours], default=-1.0),
            steered,
            here,
            ego.velocity_ned_m_s,
        )

    def _restart_filter(self) -> None:
        """Whatever filter and law fly start anew, as the vehicle does: they are the agent's, nobody else holds them."""
        self.safety.reset()
        self.law.reset()
