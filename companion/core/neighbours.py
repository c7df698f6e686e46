"""The peer table: what this vehicle knows of the others, and what that says about now."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import dist, hypot, isfinite
from statistics import median

from companion.core.counts import Counts
from companion.core.failsafe import FROZEN_S, SUSPECT_S, Failsafe
from companion.core.frames import Ned
from companion.core.health import MOVING_M_S, jumped
from companion.core.hold import HoldKind, axis, weights
from companion.core.monitor import PeerMotion
from companion.core.near import near_bound_m
from companion.core.plan import Moment, Programme, Reference
from companion.core.values import (
    AIRBORNE_PHASES,
    FLYING_PHASES,
    FORMATION_PHASES,
    LOW_PHASES,
    ZERO,
    Instant,
    Neighbour,
    PeerMessage,
    PeerSample,
    Phase,
)
from companion.core.vectors import between, share_of_segment

FUTURE_LIMIT_S = 1.0
"""a sample from further ahead than this comes from a clock that is wrong"""
PRESENCE_DELAY_S = 1.5
"""how long after a peer's end its presence may still be reported"""
VERTICAL_DAMPING_S = 2.0
FREE_DAMPING_S = 2.0
"""time in which the velocity of a vehicle fades that follows no plan that we know: the pilot's, or one apart"""
PEER_ACCELERATION_M_S2 = 8.0
PEER_SPEED_M_S = 8.0
"""and no peer is faster than this beyond the velocity that it told"""
PEER_MARGIN_M = 1.0
PEER_MARGIN_M_S = 1.0
"""two samples of a peer further apart than this and PEER_ACCELERATION_M_S2 explain are no motion"""
GATE_VELOCITY_M_S = 0.7
GATE_RESIDUAL_M = 2.0
GATE_PERIOD_NS = 100_000_000
UNCERTAINTY_GROWTH_M_S = 0.3
UNCERTAINTY_GROWTH_MAX_M = 1.0


REFUSED = ("own id", "foreign id", "not finite", "from the future", "too old on arrival", "repeated or out of order")
"""why a sample is not taken"""
LIES = (Failsafe.PEER_LIES.value, Failsafe.PEER_FROZEN.value)
"""why nothing is built on a sample that is taken"""
_NOWHERE = Reference(ZERO, ZERO, ZERO, 0.0)


@dataclass(frozen=True, slots=True)
class PeerLimits:
    """What the table needs to know of the configuration."""

    hold: HoldKind
    hold_damping_s: float
    range_m: float
    stale_after_s: float
    """a peer silent for longer is stale: beyond T_max with its jitter"""
    isolated_flight_s: float
    """how long a vehicle that hears nobody flies on before it holds by itself"""
    uncertainty_m: float
    """bound on the prediction's error of a peer that is heard"""
    motion: PeerMotion
    """what a peer can do unseen"""
    digest_size: int


def held(
    sample: PeerSample, reference_then: tuple[Ned, Ned], reference: Reference, fleet_ns: int, limits: PeerLimits
) -> tuple[Ned, Ned]:
    """Position and velocity at `fleet_ns` as a sample foretells them: what receivers use and senders compare with.

    `reference_then` is p_ref and v_d of the sender's slot at the sample's time, `reference` the one at `fleet_ns`. A
    vehicle in formation is held by the configured hold. One that climbs or lands stays over its spot, and its vertical
    speed fades, since it ends at its altitude or on the ground; the velocity of one that flies by itself, or under
    somebody else, fades too. Whoever has landed or waits to be armed stands.
    """
    tau_s = max(0.0, (fleet_ns - sample.time_ns) * 1e-9)
    p, v = sample.position_ned_m, sample.velocity_ned_m_s
    if sample.phase in FORMATION_PHASES:
        w = weights(limits.hold, tau_s, limits.hold_damping_s)
        then_p, then_v = reference_then
        now_p, now_v = reference.position_ned_m, reference.velocity_ned_m_s
        x, vx = axis(p.north, v.north, then_p.north, then_v.north, now_p.north, now_v.north, w)
        y, vy = axis(p.east, v.east, then_p.east, then_v.east, now_p.east, now_v.east, w)
        z, vz = axis(p.down, v.down, then_p.down, then_v.down, now_p.down, now_v.down, w)
        return Ned(x, y, z), Ned(vx, vy, vz)
    if sample.phase in (Phase.ARMED, Phase.CLIMBING, Phase.LANDING):
        w = weights("damped", tau_s, VERTICAL_DAMPING_S)
        return Ned(p.north, p.east, p.down + w.position * v.down), Ned(0.0, 0.0, w.velocity * v.down)
    if sample.phase in (Phase.APART, Phase.RELEASED, Phase.IDLE):
        # IDLE too: a companion that starts in flight does not steer.
        w = weights("damped", tau_s, FREE_DAMPING_S)
        k, f = w.position, w.velocity
        return Ned(p.north + k * v.north, p.east + k * v.east, p.down + k * v.down), Ned(*(f * x for x in v))
    return p, ZERO


@dataclass(slots=True)
class _Peer:
    sample: PeerSample | None = None
    reference_then: tuple[Ned, Ned] = (ZERO, ZERO)
    boot_id: int | None = None
    sequence: int = 0
    present: bool = False
    lost_at_ns: int | None = None
    """fleet time at which presence ended or silence became too long"""
    silent: bool = False
    """it is lost by its silence, not by the end of its presence"""
    suspect_until_ns: int = 0
    """fleet time until which nothing is built on what it says"""
    due_soon: bool = False
    """its last message came in near mode, so that one that is missing is known to be"""
    same_since_ns: int = 0
    """time of the first sample with its present position"""


@dataclass(slots=True)
class PeerTable:
    """Peers by vehicle id. Nothing here raises for what a peer sends; it is refused, counted and named."""

    own_id: int
    ids: frozenset[int]
    """every enabled vehicle's id but the own"""
    limits: PeerLimits
    programme: Programme
    rejected: Counts = field(default_factory=lambda: Counts((*REFUSED, *(f"digest: {r}" for r in REFUSED), *LIES)))
    _peers: dict[int, _Peer] = field(default_factory=dict)
    _gated: frozenset[int] = frozenset()
    _gated_until_ns: int = 0
    """when the gates are looked at anew (monotonic ns)"""

    def __post_init__(self) -> None:
        self._peers = {i: _Peer() for i in sorted(self.ids)}

    def accept(self, message: PeerMessage, now: Instant) -> str | None:
        """Take a peer's message; returns why not if it was refused."""
        sample = message.sample
        reason = self._refusal(sample, now)
        if reason is None:
            peer = self._peers[sample.vehicle_id]
            newer = (message.sequence - peer.sequence) % (1 << 32)
            if peer.boot_id == message.boot_id and not 0 < newer < (1 << 31):
                reason = "repeated or out of order"
            else:
                if peer.boot_id != message.boot_id or peer.lost_at_ns is None or sample.time_ns > peer.lost_at_ns:
                    # One that was sent before the sender's end, and came late, brings nobody back.
                    peer.present, peer.lost_at_ns, peer.silent = True, None, False
                if peer.boot_id == message.boot_id:
                    self._examine(peer, sample, now)
                peer.boot_id, peer.sequence = message.boot_id, message.sequence
                peer.due_soon = message.due_soon
                self._store(peer, sample)
        if reason is not None:
            self.rejected[reason] += 1
            return reason
        for hearsay in message.digest:
            known = self._peers.get(hearsay.vehicle_id)
            if hearsay.vehicle_id == self.own_id or (
                known is not None and known.sample is not None and hearsay.time_ns <= known.sample.time_ns
            ):
                continue
            reason = self._refusal(hearsay, now)
            if reason is None:
                self._store(self._peers[hearsay.vehicle_id], hearsay)
            else:
                self.rejected[f"digest: {reason}"] += 1
        return None

    def _refusal(self, sample: PeerSample, now: Instant) -> str | None:
        if sample.vehicle_id == self.own_id:
            return "own id"
        if sample.vehicle_id not in self._peers:
            return "foreign id"
        if not all(isfinite(x) for x in (*sample.position_ned_m, *sample.velocity_ned_m_s)):
            return "not finite"
        if (sample.time_ns - now.fleet_ns) * 1e-9 > FUTURE_LIMIT_S:
            return "from the future"
        if (now.fleet_ns - sample.time_ns) * 1e-9 > self.limits.stale_after_s:
            return "too old on arrival"
        return None

    def _examine(self, peer: _Peer, sample: PeerSample, now: Instant) -> None:
        """Suspect a peer whose next sample no motion explains, or that moves without changing its position."""
        last = peer.sample
        if last is None or sample.time_ns <= last.time_ns:
            return
        # One that stands armed may jump: PX4's estimator resets on the ground.
        steered = FLYING_PHASES - {Phase.ARMED}
        if last.phase not in steered or sample.phase not in steered:
            return
        lie = None
        if jumped(
            (last.position_ned_m, last.velocity_ned_m_s), (sample.position_ned_m, sample.velocity_ned_m_s),
            (sample.time_ns - last.time_ns) * 1e-9, PEER_ACCELERATION_M_S2, PEER_MARGIN_M, PEER_MARGIN_M_S,
            PEER_SPEED_M_S,
        ):  # fmt: skip
            lie = Failsafe.PEER_LIES.value
        elif (
            sample.position_ned_m == last.position_ned_m
            and hypot(*sample.velocity_ned_m_s) > MOVING_M_S
            and sample.time_ns - peer.same_since_ns >= FROZEN_S * 1e9
        ):
            lie = Failsafe.PEER_FROZEN.value
        if lie is not None:
            self.rejected[lie] += 1
            peer.suspect_until_ns = now.fleet_ns + round(SUSPECT_S * 1e9)

    def _store(self, peer: _Peer, sample: PeerSample) -> None:
        if peer.sample is not None and sample.time_ns <= peer.sample.time_ns:
            return
        if peer.sample is None or sample.position_ned_m != peer.sample.position_ned_m:
            peer.same_since_ns = sample.time_ns
        peer.sample = sample
        if peer.lost_at_ns is not None and (peer.silent or sample.time_ns > peer.lost_at_ns):
            # By digest: it is alive though it is not heard here.
            peer.lost_at_ns, peer.silent = None, False
        reference = self.programme.reference(sample.vehicle_id, sample.time_ns)
        peer.reference_then = (reference.position_ned_m, reference.velocity_ned_m_s)

    def plan_changed(self) -> None:
        """Look the references of the samples up again, after a motion was adopted."""
        for peer in self._peers.values():
            if peer.sample is not None:
                reference = self.programme.reference(peer.sample.vehicle_id, peer.sample.time_ns)
                peer.reference_then = (reference.position_ned_m, reference.velocity_ned_m_s)

    def presence(self, vehicle_id: int, alive: bool, now: Instant) -> None:
        """Liveliness of a peer's process came or went.

        That a process is there says nothing of where its vehicle is: one that was lost comes back with a sample.
        """
        peer = self._peers.get(vehicle_id)
        if peer is None:
            if vehicle_id != self.own_id:
                self.rejected["foreign id"] += 1
            return
        peer.present = alive
        if not alive and peer.lost_at_ns is None:
            peer.lost_at_ns = now.fleet_ns

    def sample(self, vehicle_id: int) -> PeerSample | None:
        """The latest sample of a peer, its own or by digest."""
        return self._peers[vehicle_id].sample

    def due_soon(self, vehicle_id: int) -> bool:
        """Whether a peer last said that it speaks in near mode, so that its messages are known to be due."""
        return self._peers[vehicle_id].due_soon

    def boot_id(self, vehicle_id: int) -> int | None:
        """The boot id a peer last gave."""
        return self._peers[vehicle_id].boot_id

    def phases(self) -> dict[int, Phase | None]:
        """Each peer's phase as it last said, None for one that is lost or never was heard."""
        return {
            i: p.sample.phase if p.sample is not None and p.lost_at_ns is None and p.present else None
            for i, p in self._peers.items()
        }

    def oldest_age_s(self, now: Instant) -> float | None:
        """Age of the oldest sample among the peers that are there (s)."""
        ages = [now.fleet_ns - p.sample.time_ns for p in self._peers.values() if p.sample is not None and p.present]
        return max(ages) * 1e-9 if ages else None

    def silent_for_s(self, now: Instant) -> float | None:
        """How long everybody has been lost: gone, or silent for longer than a peer may be (s).

        None if nobody ever was heard. Whoever is still said to be there but says nothing counts as silent, in whatever
        phase it was.
        """
        allowed_ns = round(self.limits.stale_after_s * 1e9)
        ends = [
            p.sample.time_ns + allowed_ns if p.lost_at_ns is None else p.lost_at_ns
            for p in self._peers.values()
            if p.sample is not None
        ]
        return max(now.fleet_ns - max(ends), 0) * 1e-9 if ends else None

    def digest(self) -> tuple[PeerSample, ...]:
        """The latest samples of peers for passing on, newest first."""
        samples = [p.sample for p in self._peers.values() if p.sample is not None and p.lost_at_ns is None]
        samples.sort(key=lambda s: (-s.time_ns, s.vehicle_id))
        return tuple(samples[: self.limits.digest_size])

    def predict(
        self, ego_ned_m: Ned, now: Instant, moment: Moment, gated: bool, above_ground: bool = False
    ) -> list[Neighbour]:
        """Every known peer within range, predicted to now under the plan at that `moment`, in the order of the ids.

        With `gated` (only once formed), peers whose prediction is far from what the others' say drop from alignment
        and cohesion; they still count for separation. With `above_ground` (before landing) the place above one that
        stands on the ground or lands is taken too, up to the own altitude.
        """
        slots = self.programme.at(now.fleet_ns).slots
        own = moment.slot(slots[self.own_id]).position_ned_m
        neighbours = []
        for i, peer in self._peers.items():
            if peer.sample is not None:
                n = self._predict(peer, peer.sample, now, moment.slot(slots[i]), own)
                if above_ground and peer.sample.phase in LOW_PHASES:
                    p = n.position_ned_m
                    n = n._replace(other_end_ned_m=p._replace(down=min(p.down, ego_ned_m.down)))
                if self._in_range(n, ego_ned_m):
                    neighbours.append(n)
        if not gated:
            return neighbours
        if now.monotonic_ns >= self._gated_until_ns:
            self._gated_until_ns = now.monotonic_ns + GATE_PERIOD_NS
            self._gated = outliers(neighbours, ego_ned_m)
        if not self._gated:
            return neighbours
        return [n._replace(in_formation=False) if n.vehicle_id in self._gated else n for n in neighbours]

    def _in_range(self, n: Neighbour, ego_ned_m: Ned) -> bool:
        """Whether it may be within range: for a lost peer, the nearest place between its two ends."""
        place, other = n.position_ned_m, n.other_end_ned_m
        if other is not None:
            place = between(place, other, share_of_segment(ego_ned_m, place, other))
        return dist(place, ego_ned_m) <= self.limits.range_m

    def _predict(self, peer: _Peer, sample: PeerSample, now: Instant, reference: Reference, own: Ned) -> Neighbour:
        limits = self.limits
        follows = sample.phase in FORMATION_PHASES
        airborne = sample.phase in AIRBORNE_PHASES
        tau_s = max(0.0, (now.fleet_ns - sample.time_ns) * 1e-9)
        if tau_s > limits.stale_after_s and peer.lost_at_ns is None and airborne:
            peer.lost_at_ns, peer.silent = sample.time_ns + round(limits.stale_after_s * 1e9), True
        position, velocity = held(sample, peer.reference_then, reference, now.fleet_ns, limits)
        uncertainty = limits.uncertainty_m
        other_end: Ned | None = None
        sound = follows and peer.lost_at_ns is None and now.fleet_ns >= peer.suspect_until_ns
        if airborne and peer.lost_at_ns is not None:
            since_s = (now.fleet_ns - peer.lost_at_ns) * 1e-9
            uncertainty += min(UNCERTAINTY_GROWTH_M_S * max(since_s, 0.0), UNCERTAINTY_GROWTH_MAX_M)
            position, velocity, other_end = self._both_ends(peer, sample, peer.lost_at_ns, now)
        elif peer.due_soon:
            uncertainty = near_bound_m(tau_s, uncertainty, limits.motion)
        slot = reference.position_ned_m
        # By place: naming the fields costs as much again, for every peer at every tick.
        return Neighbour(
            sample.vehicle_id,
            position,
            velocity,
            Ned(own.north - slot.north, own.east - slot.east, own.down - slot.down),
            tau_s,
            sound,
            sound,
            uncertainty,
            other_end,
            reference.velocity_ned_m_s,
            reference.acceleration_ned_m_s2,
        )

    def _both_ends(self, peer: _Peer, sample: PeerSample, lost_at_ns: int, now: Instant) -> tuple[Ned, Ned, Ned]:
        """Where a lost peer is if it flew on, how fast, and where if it stopped.

        One whose presence ended was seen alive until shortly before, so it stopped no earlier than PRESENCE_DELAY_S
        before that; one that fell silent may have stopped at any time since its last sample. A vehicle that hears
        nobody holds by itself after `isolated_flight_s`, so it flew on no longer than that. One that was armed,
        climbed or landed is somewhere in the column between there and its altitude, or the ground.
        """
        if sample.phase not in FORMATION_PHASES:
            last = sample.position_ned_m
            slot = self.programme.reference(sample.vehicle_id, sample.time_ns).position_ned_m
            top = min(slot.down, last.down)
            ends = {Phase.ARMED: top, Phase.CLIMBING: top, Phase.LANDING: max(0.0, last.down)}
            if sample.phase in ends:
                return Ned(last.north, last.east, ends[sample.phase]), ZERO, last
            return *held(sample, (ZERO, ZERO), _NOWHERE, now.fleet_ns, self.limits), last

        def at(fleet_ns: int) -> tuple[Ned, Ned]:
            reference = self.programme.reference(sample.vehicle_id, fleet_ns)
            return held(sample, peer.reference_then, reference, fleet_ns, self.limits)

        seen_ns = sample.time_ns if peer.silent else lost_at_ns - round(PRESENCE_DELAY_S * 1e9)
        stopped, _ = at(max(sample.time_ns, seen_ns))
        latest_ns = lost_at_ns + round(self.limits.isolated_flight_s * 1e9)
        flown, velocity = at(min(now.fleet_ns, latest_ns))
        return flown, velocity if now.fleet_ns < latest_ns else ZERO, stopped


def is_outlier(velocity_north: float, velocity_east: float, residual_north: float, residual_east: float) -> bool:
    """The gates of a formed peer: its velocity against its slot's (m/s), its residual against the median's (m)."""
    return (
        velocity_north * velocity_north + velocity_east * velocity_east > GATE_VELOCITY_M_S * GATE_VELOCITY_M_S
        or residual_north * residual_north + residual_east * residual_east > GATE_RESIDUAL_M * GATE_RESIDUAL_M
    )


def outliers(neighbours: Sequence[Neighbour], ego: Ned) -> frozenset[int]:
    """Ids of those in formation whose prediction is far from what the others' say."""
    residuals = []
    for n in neighbours:
        if n.in_formation:
            p, d = n.position_ned_m, n.offset_ned_m
            residuals.append((n, ego.north - p.north - d.north, ego.east - p.east - d.east))
    if not residuals:
        return frozenset()
    middle_north, middle_east = median(r[1] for r in residuals), median(r[2] for r in residuals)
    gated = []
    for n, north, east in residuals:
        v, slot = n.velocity_ned_m_s, n.reference_velocity_ned_m_s
        if is_outlier(v.north - slot.north, v.east - slot.east, north - middle_north, east - middle_east):
            gated.append(n.vehicle_id)
    return frozenset(gated)
