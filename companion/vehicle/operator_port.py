"""What an operator asks of one vehicle: commands with their answers, its own preflight, its status."""

from dataclasses import dataclass
from typing import NamedTuple

from companion.config import FleetConfig
from companion.core.counts import Counts, Refusal, summed
from companion.core.frames import Ned, geodetic_to_ned
from companion.core.law.evasion import Threat
from companion.core.neighbours.table import PeerTable
from companion.core.trajectory.history import TrajectoryHistory
from companion.core.values import FLYING_PHASES, Instant, Phase
from companion.errors import WireError
from companion.vehicle.agreement import Agreement
from companion.vehicle.autopilot.port import AutopilotPort
from companion.vehicle.graph_watch import GraphWatch
from companion.vehicle.orders import ORDER_FAULTS, OrderBook
from companion.vehicle.outputs import TickReport
from companion.vehicle.plan_exchange import PlanExchange
from companion.vehicle.preflight import own_checks
from companion.vehicle.publisher import Publisher
from companion.vehicle.supervisor import Supervisor
from companion.wire.operator import (
    Answer,
    Check,
    Command,
    Place,
    PreflightReport,
    Scare,
    Status,
    Whereabouts,
    decode_command,
    encode,
    unmet,
)
from companion.wire.peer import leg_from_json, motion_to_json

FAILSAFES_SHOWN_MAX = 20
"""the last ones stand in a status: one that comes again and again must not make it too large to be sent"""
SCARED_AHEAD_S = 10.0
"""what is fled begins no later than so long from now: people would forget a threat for later, vehicles would not"""
SHARED = "the fleet flies a motion that all share"
REJECTED = tuple(f"command: {kind}" for kind in ORDER_FAULTS)
"""what the port counts"""


class Activity(NamedTuple):
    """What the agent's control ticks have done."""

    up_s: float
    """since the agent first acted"""
    setpoints_sent: int
    tick: TickReport | None
    """the last one"""
    limited: dict[str, int]
    """what the safety filter counts"""


@dataclass(slots=True)
class OperatorPort:
    """One vehicle's side of the operator's protocol, over the parts of its agent."""

    config: FleetConfig
    vehicle_id: int
    boot_id: int
    autopilot: AutopilotPort
    supervisor: Supervisor
    history: TrajectoryHistory
    peers: PeerTable
    plans: PlanExchange
    publisher: Publisher
    agreement: Agreement
    graph: GraphWatch
    rejected: Counts
    orders: OrderBook

    @property
    def place(self) -> Place:
        """Where this vehicle is in the order of its commands."""
        return self.orders.place(self.supervisor.begun)

    # -- commands ------------------------------------------------------------------------------------------------------

    def receive_command(self, payload: bytes, now: Instant) -> bytes:
        """A command as JSON; returns the answer as JSON. The same bytes again get the same answer."""
        again = self.orders.answer_again(payload)
        if again is not None:
            return again
        try:
            command = decode_command(payload)
        except WireError as fault:
            return self._refuse(Refusal(fault.kind, fault.detail))
        places = command.after.get(self.vehicle_id, ())
        refusal = self.orders.refusal(command.verb, places, self.supervisor.begun)
        if refusal is not None:
            return self._refuse(refusal, in_order=False)
        reason = self._obey(command, now)
        if reason is None:
            self.orders.obeyed_now(command)
        answer = self._answer(reason)
        self.orders.answered(payload, answer)
        return answer

    def _obey(self, command: Command, now: Instant) -> str | None:
        """Do what is commanded; returns why not."""
        match command.verb:
            case "takeoff":
                return self._take_off(now)
            case "land":
                return self.supervisor.land(now)
            case "release":
                return self.supervisor.release(now)
            case "resume":
                return self.supervisor.resume(now)
            case "kill":
                return self.supervisor.kill(now) if command.confirm else "kill needs its confirmation"
            case "wish":
                return self._wish(command.leg, now)
            case "scare":
                return self._scare(command.threat, now)
        return self.plans.on_command(command.motion, now)

    def _take_off(self, now: Instant) -> str | None:
        phase, newest = self.supervisor.phase, self.history.newest
        if phase in FLYING_PHASES or phase is Phase.PREFLIGHT:
            return None
        if phase is Phase.RELEASED:
            return "the pilot has the vehicle"
        if newest.then == "land" and newest.end_ns is not None and now.fleet_ns >= newest.end_ns:
            return "the plan is over: restart the companions for another flight"
        reasons = self.unready(now)
        return "; ".join(reasons) if reasons else self.supervisor.take_off(now)

    def _wish(self, plain: object, now: Instant) -> str | None:
        if plain is None:
            self.agreement.inform((), now.fleet_ns)
            return None
        try:
            leg = leg_from_json(plain)
        except WireError as error:
            return str(error)
        if self.agreement.centre is None:
            return f"{SHARED}: command that one, or free it first"
        reason = self.agreement.refusal(leg)
        if reason is None:
            self.agreement.inform((leg,), now.fleet_ns)
        return reason

    def _scare(self, threat: Scare | None, now: Instant) -> str | None:
        if threat is None:
            return "scare needs a threat"
        if self.agreement.centre is None:
            return f"{SHARED}: only a free fleet flees, free it first"
        since_s = (now.fleet_ns - threat.begins_ns) * 1e-9
        if not -SCARED_AHEAD_S <= since_s <= threat.lasts_s:
            return (
                f"the threat begins {-since_s:.1f} s from now and lasts {threat.lasts_s:g} s: it must not be over, nor "
                f"more than {SCARED_AHEAD_S:g} s ahead (is the operator's clock right?)"
            )
        self.agreement.scare(
            Threat(threat.north_m, threat.east_m, threat.north_m_s, threat.east_m_s, threat.radius_m, threat.lasts_s),
            threat.begins_ns,
        )
        return None

    def _refuse(self, refusal: Refusal, in_order: bool = True) -> bytes:
        self.rejected[f"command: {refusal.kind}"] += 1
        return self._answer(refusal.sentence, in_order)

    def _answer(self, refusal: str | None, in_order: bool = True) -> bytes:
        return encode(
            Answer(
                vehicle=self.vehicle_id,
                accepted=refusal is None,
                reason=refusal,
                phase=self.supervisor.phase.name.lower(),
                in_order=in_order,
                revision=self.history.newest.revision,
                place=self.place,
            )
        )

    # -- preflight -----------------------------------------------------------------------------------------------------

    def unready(self, now: Instant) -> list[str]:
        """Why this vehicle may not take off; empty when it may."""
        return [c.message for c in unmet(self.checks(now))]

    def checks(self, now: Instant) -> tuple[Check, ...]:
        """Every row of this vehicle's own preflight."""
        vehicle, phase, armed = self.config.by_id(self.vehicle_id), self.supervisor.phase, self.autopilot.armed
        pad = None
        if phase not in FLYING_PHASES and self.history.newest.revision == 0:
            pad = Ned(vehicle.pad_north_m, vehicle.pad_east_m, 0.0)
        rows = own_checks(self.autopilot.facts(now), self.config, vehicle, pad)
        foreign = armed and phase in (Phase.IDLE, Phase.LANDED)
        silent = [i for i, theirs in self.peers.phases().items() if theirs is None]
        others = len(self.peers.ids)
        return (
            *rows,
            Check(
                "armed", "by somebody else" if foreign else "by its companion" if armed else "no",
                "not by somebody else", not foreign, "armed by somebody else", vehicle=self.vehicle_id,
            ),
            Check(
                "peers heard", others - len(silent), f"= {others}", not silent,
                f"not heard: vehicle {', '.join(str(i) for i in silent)}", vehicle=self.vehicle_id,
            ),
        )  # fmt: skip

    def preflight_report(self, now: Instant) -> PreflightReport:
        """The answer to a preflight question."""
        facts = self.autopilot.facts(now)
        origin = None if facts.origin is None else geodetic_to_ned(facts.origin, self.config.origin)
        return PreflightReport(
            vehicle=self.vehicle_id,
            boot_id=self.boot_id,
            system_id=self.config.by_id(self.vehicle_id).system_id,
            configuration=self.config.shared_hash,
            assignment=self.config.assignment_hash,
            flying=self.supervisor.phase in FLYING_PHASES,
            revision=self.history.newest.revision,
            position_ned_m=facts.position_ned_m,
            slot_ned_m=self.history.reference(self.vehicle_id, now.fleet_ns).position_ned_m,
            origin_ned_m=origin,
            home_altitude_amsl_m=facts.home_altitude_amsl_m,
            own_id_heard=self.publisher.own_id_heard(now),
            checks=self.checks(now),
            digests=self.config.shared_digests,
        )

    # -- status --------------------------------------------------------------------------------------------------------

    def status(self, activity: Activity, now: Instant) -> Status:
        """The vehicle's account of itself, but for what only its process knows."""
        tick, graph = activity.tick, self.graph.connectivity
        unready, newest = unmet(self.checks(now)), self.history.newest
        return Status(
            vehicle=self.vehicle_id,
            phase=self.supervisor.phase.name.lower(),
            mode=self.autopilot.mode_name,
            killed=None if self.supervisor.killed is None else self.supervisor.killed.value,
            armed=self.autopilot.armed,
            ready=[c.message for c in unready],
            unfit=[c.message for c in unready if c.permanent],
            revision=newest.revision,
            fleet=self.config.fleet.name,
            up_s=activity.up_s,
            place=self.place,
            shape=newest.shape,
            moving=newest.end_ns is None or bool(newest.legs),
            position_error_m=tick.position_error_m if tick else None,
            neighbours=tick.neighbours if tick else 0,
            nearest_m=tick.nearest_m if tick and tick.nearest_m >= 0 else None,
            oldest_age_s=self.peers.oldest_age_s(now),
            messages=self.publisher.messages_sent,
            messages_by_cause=dict(self.publisher.sent_because),
            setpoints=activity.setpoints_sent,
            battery_percent=self.autopilot.battery(now),
            autopilot_age_s=self.autopilot.heartbeat_age_s(now),
            configuration=self.config.shared_hash,
            failsafes=self.supervisor.failsafes[-FAILSAFES_SHOWN_MAX:],
            rejected=summed(self.rejected, self.supervisor.counts, self.peers.rejected, self.autopilot.rejected),
            limited=activity.limited,
            own_id_heard=self.publisher.own_id_heard(now),
            motion=motion_to_json(newest),
            centre=None if self.agreement.centre is None else Whereabouts(*self.agreement.centre),
            informed=self.agreement.wish is not None,
            flees=self.agreement.flees,
            lambda2=None if graph is None else graph.lambda2,
            graph_edge=None if graph is None else graph.edge,
        )
