"""When this vehicle tells the peers its state, and why; the message itself.

A message goes out when something new is announced (a phase, a trajectory, a peer that has just come), when the longest
silence is over (heartbeat), when the trigger finds that the peers can no longer predict this vehicle, and at the rate
of near mode. One that announces is repeated, since one message may be lost.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from random import Random
from typing import NamedTuple

from companion.config import FleetConfig
from companion.core.frames import Ned
from companion.core.neighbours.table import PeerTable
from companion.core.prediction import common_way
from companion.core.safety.filter import HalfPlane, push_m_s2
from companion.core.trajectory.fleet import Reference
from companion.core.trajectory.history import TrajectoryHistory
from companion.core.trigger.base import Situation, Trigger
from companion.core.trigger.near import PUSH_M_S2, NearMode, near_push_m_s2
from companion.core.values import (
    AIRBORNE_PHASES,
    FORMATION_PHASES,
    SETTLED_PHASES,
    CommonMotion,
    Instant,
    Neighbour,
    PeerMessage,
    PeerSample,
    Phase,
)
from companion.wire.peer import encode_state

CAUSES = ("first", "announced", "heartbeat", "triggered", "near")
"""why a state message is sent: nobody knows us yet; a phase or trajectory is new, or a peer is, repeats included; T_max
has passed; the trigger fired; a peer is near"""
REPEATS_NS = (250_000_000, 1_000_000_000)
"""an announcement is repeated after these delays"""
REPEATS_MAX = 8
CATCH_UP_NS = 1_000_000_000
"""a spread announcement is repeated after this; who lacks a newer trajectory says so this often"""
SPREAD_NS = 50_000_000
"""times the vehicles, up to CATCH_UP_NS: over this time they spread what all have reason to say at once"""
HEARTBEAT_JITTER = 0.2
"""part of T_max by which heartbeats come earlier at most, so that they do not bunch"""
CLOCK_SHIFT_NS = 618_033_989
"""times a vehicle's place in the file: by so much its trigger's clock is shifted, so that no two vehicles' periods, of
whatever length, end together"""
OWN_ID_ANSWER_NS = 500_000_000
"""who hears somebody speak under its own id says where it is itself, this often at most"""


def spread_ns(vehicles: int) -> int:
    """Over how long so many vehicles spread what all have reason to say at once."""
    return min(SPREAD_NS * vehicles, CATCH_UP_NS)


class OwnState(NamedTuple):
    """What a message may be needed for."""

    phase: Phase
    position_ned_m: Ned
    """smoothed, as the velocity is"""
    velocity_ned_m_s: Ned
    reference: Reference
    """of the own slot, by the shared motion"""
    mean_residual_m: Ned
    """of the formation about this vehicle"""
    formation_since_ns: int | None
    """fleet time from which the vehicle flies in formation"""
    told: tuple[float, ...] = ()
    """what the own law adds to messages (`core.law.base.Law.tell`)"""
    outdated: bool = False
    """a peer holds a newer trajectory"""
    common: CommonMotion | None = None
    """what goes with the sample where no motion is shared"""


class Publisher:
    """One vehicle's state messages."""

    def __init__(
        self, config: FleetConfig, vehicle_id: int, boot_id: int, trigger: Trigger, history: TrajectoryHistory,
        peers: PeerTable, random: Random,
    ) -> None:  # fmt: skip
        self.trigger = trigger
        self.near = NearMode(config.near_rate)
        self.messages_sent = 0
        self.sent_because: Counter[str] = Counter(dict.fromkeys(CAUSES, 0))
        """how many messages were sent for which of CAUSES"""
        self._id = vehicle_id
        self._boot_id = boot_id
        self._history = history
        self._peers = peers
        self._random = random
        self._t_min_s, self._t_max_s = config.trigger.t_min_s, config.trigger.t_max_s
        self._slots_m = (config.spacing_min_m, config.safety_radius_m)
        """the least distance of two slots, and the safety radius"""
        self._spread_ns = spread_ns(len(config.vehicles))
        self._clock_shift_ns = CLOCK_SHIFT_NS * config.by_id(vehicle_id).instance
        self._stale_ns = config.peer_limits.stale_after_s * 1e9
        self._sequence = 0
        self._sent: tuple[PeerSample, tuple[Ned, Ned]] | None = None
        """last sample sent, with p_ref and v_d of the own slot at its time"""
        self._sent_ns = 0
        self._silence_limit_s = 0.0
        self._announce_ns: list[int] = []
        """when what is announced is to be said, ascending"""
        self._announced = Phase.IDLE
        """the phase that was announced last"""
        self._own_id_ns: int | None = None
        """when somebody else last spoke under this vehicle's id"""

    # -- what is announced, whatever the trigger says ------------------------------------------------------------------

    @property
    def announces(self) -> bool:
        """Whether something is to be said yet."""
        return bool(self._announce_ns)

    def publish_now(self, now: Instant) -> None:
        """Say something at the next tick, and again."""
        self._announce_ns = [now.monotonic_ns, *(now.monotonic_ns + d for d in REPEATS_NS)]

    def publish_spread(self, now: Instant) -> None:
        """Say it soon: of what all do at one time, a burst of messages would stop a crowd on one machine."""
        first_ns = now.monotonic_ns + self._random.randrange(self._spread_ns)
        self._announce_ns = [first_ns, first_ns + CATCH_UP_NS]

    def on_phase(self, phase: Phase, now: Instant) -> None:
        """Announce the phase if it is another than the one announced."""
        if phase is self._announced:
            return
        both = {phase, self._announced}
        if not both <= FORMATION_PHASES:
            self.publish_now(now)
        elif not both <= SETTLED_PHASES:
            # Who moves and who rests follows from the plan, which all have.
            self.publish_spread(now)
        self._announced = phase

    def on_trajectory(self, now: Instant) -> None:
        """Announce that the newest trajectory is another: peers predict this vehicle under it."""
        if self._sent is not None:
            self._sent = (self._sent[0], self._reference_then(self._sent[0]))
        self.publish_spread(now)

    def on_new_peer(self, now: Instant) -> None:
        """Say it once more: whoever lost us believes us only by a new state."""
        delay_ns = self._random.randrange(self._spread_ns)
        self._announce_ns = sorted([*self._announce_ns, now.monotonic_ns + delay_ns])[:REPEATS_MAX]

    def on_own_id(self, now: Instant) -> None:
        """Somebody else speaks under this vehicle's id: contradict it at once."""
        self._own_id_ns = now.monotonic_ns
        if not self._announce_ns:
            self._announce_ns = [max(now.monotonic_ns, self._sent_ns + OWN_ID_ANSWER_NS)]

    def own_id_heard(self, now: Instant) -> bool:
        """Whether somebody else spoke under this vehicle's id lately."""
        return self._own_id_ns is not None and now.monotonic_ns - self._own_id_ns < self._stale_ns

    # -- near mode -----------------------------------------------------------------------------------------------------

    def see_near(
        self, planes: Iterable[HalfPlane], neighbours: Sequence[Neighbour], slot_velocity: Ned, now: Instant
    ) -> None:
        """Take whom the filter's half-planes show near; it makes none of peers that are far."""
        pushes = {p.vehicle_id: push for p in planes if (push := push_m_s2(p)) < PUSH_M_S2}
        if not pushes:
            return
        near = [
            n.vehicle_id
            for n in neighbours
            if n.vehicle_id in pushes
            and n.last_seen_ned_m is None
            and pushes[n.vehicle_id] < near_push_m_s2(n, slot_velocity, *self._slots_m)
        ]
        self.near.see(near, now.monotonic_ns)

    # -- the message ---------------------------------------------------------------------------------------------------

    def publish(self, own: OwnState, now: Instant) -> bytes | None:
        """A state message if one is due; why is counted."""
        near = own.phase in AIRBORNE_PHASES and self.near.active(now.monotonic_ns)
        cause = self._cause(own, near, now)
        if cause is None:
            return None
        newest = self._history.newest
        sample = PeerSample(
            self._id, now.fleet_ns, own.position_ned_m, own.velocity_ned_m_s, newest.revision, own.phase, own.common,
            own.told,
        )  # fmt: skip
        self._sent = (sample, self._reference_then(sample))
        self._sent_ns = now.monotonic_ns
        self._silence_limit_s = self._t_max_s * (1.0 - HEARTBEAT_JITTER + HEARTBEAT_JITTER * self._random.random())
        self._sequence = (self._sequence + 1) % (1 << 32)
        self.near.promised = near
        self.messages_sent += 1
        self.sent_because[cause] += 1
        near_ids = self.near.peers(now.monotonic_ns) if near else ()
        return encode_state(
            PeerMessage(
                self._boot_id, self._sequence, newest.start_ns, newest.issuer, sample, self._peers.digest(),
                near_ids=near_ids, due_soon=near,
            )
        )  # fmt: skip

    def _cause(self, own: OwnState, near: bool, now: Instant) -> str | None:
        """Which of CAUSES asks for a message; None if nothing does."""
        since_s = (now.monotonic_ns - self._sent_ns) * 1e-9
        if self._sent is None:
            self.publish_now(now)
        due = bool(self._announce_ns) and now.monotonic_ns >= self._announce_ns[0]
        if due:
            self._announce_ns = [t for t in self._announce_ns if t > now.monotonic_ns]
        if self._sent is None:
            return "first"
        if due or (own.outdated and since_s >= CATCH_UP_NS * 1e-9):
            return "announced"
        if since_s >= self._silence_limit_s:
            return "heartbeat"
        situation = self._situation(self._sent, own, now)
        if (since_s >= self._t_min_s or not self.trigger.waits) and self.trigger.fires(situation):
            return "triggered"
        return "near" if self.near.fires(situation, near) else None

    def _situation(self, sent: tuple[PeerSample, tuple[Ned, Ned]], own: OwnState, now: Instant) -> Situation:
        """What the trigger decides upon: the own state against what the peers predict of it."""
        foresight, formed = self._peers.foresight, {own.phase, sent[0].phase} <= FORMATION_PHASES
        p, v, told = foresight.under(own.reference, *sent, now.fleet_ns)
        position, velocity, residual = own.position_ned_m, own.velocity_ned_m_s, own.mean_residual_m
        since_ns = own.formation_since_ns
        return Situation(
            (position.north - p.north) ** 2 + (position.east - p.east) ** 2 + (position.down - p.down) ** 2,
            (velocity.north - v.north) ** 2 + (velocity.east - v.east) ** 2 + (velocity.down - v.down) ** 2,
            residual.north**2 + residual.east**2,
            0.0 if since_ns is None else (now.fleet_ns - since_ns) * 1e-9,
            now.monotonic_ns + self._clock_shift_ns,
            self._sent_ns + self._clock_shift_ns,
            told,
            own.told,
            _common_error_2(sent[0], own.common, now),
            foresight.limits.hold.told_error_m(told, own.told) if formed else 0.0,
        )

    def _reference_then(self, sample: PeerSample) -> tuple[Ned, Ned]:
        reference = self._history.reference(self._id, sample.time_ns)
        return reference.position_ned_m, reference.velocity_ned_m_s


def _common_error_2(sent: PeerSample, common: CommonMotion | None, now: Instant) -> float:
    """Squared error of what the peers take for the own estimate of the common velocity (m^2/s^2)."""
    if sent.common is None or common is None:
        return 0.0
    way = common_way(sent.common, max(0.0, (now.fleet_ns - sent.time_ns) * 1e-9))
    return (common.north_m_s - way.north_m_s) ** 2 + (common.east_m_s - way.east_m_s) ** 2
