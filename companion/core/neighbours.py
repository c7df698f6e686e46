"""The peer table: what this vehicle knows of the others, and what that says about now.

Every sample is examined by the same rule, whatever brought it: does a track explain it? A *track* is what one vehicle
can have said, sample after sample. A sample that no track of its peer explains opens another, and both places are kept
clear of until one of them is left (`_forget`). What is passed on by others (a digest) opens none and moves none far.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import dist, hypot, isfinite
from statistics import median

from companion.core.counts import Counts
from companion.core.events import PeerDoubted
from companion.core.failsafe import FROZEN_S, SUSPECT_S, Failsafe
from companion.core.frames import Ned
from companion.core.health import MOVING_M_S
from companion.core.monitor import PeerMotion
from companion.core.near import near_bound_m
from companion.core.prediction import HoldKind, axis, weights
from companion.core.safety.filter import DOWNWASH_RATIO
from companion.core.trajectory.fleet import Reference, TrajectoryState
from companion.core.trajectory.history import TrajectoryHistory
from companion.core.values import (
    AIRBORNE_PHASES,
    FILTERED_PHASES,
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
from companion.core.vectors import closest_point_parameter, lerp, nearest_on_path, off_chord, piece_about

FUTURE_LIMIT_S = 1.0
"""a sample from further ahead than this comes from a clock that is wrong"""
PRESENCE_DELAY_S = 1.5
"""how long after a peer's end its presence may still be reported"""
VERTICAL_DAMPING_S = 2.0
FREE_DAMPING_S = 2.0
"""time in which the velocity of a vehicle fades that follows no plan that we know: the pilot's, or one apart"""
PEER_ACCELERATION_M_S2 = 8.0
PEER_SPEED_M_S = 8.0
"""no peer flies further than this in a second"""
PEER_MARGIN_M = 1.0
PEER_MARGIN_M_S = 1.0
"""a sample further from what was foreseen than this and PEER_ACCELERATION_M_S2 explain opens another track"""
UNTOLD_S = 1.0
"""a peer that leaves what is foreseen of it speaks at once: it accelerates no longer than this without being heard"""
LATE_S = 2.0
"""a sample older than what is known is looked at only if it is younger than this; else it is taken for a repeat"""
HEARSAY_M = 2.0
"""what others pass on moves a peer no further than this from what it lately said itself"""
ALOFT_M = 2.0
"""above the fleet's origin; a vehicle that is idle higher than this was found in the air by a companion that started"""
LOST_NEAR_M = 5.0
"""one that was lost is believed to be the same if it comes back so near the path it was lost on, or beneath it"""
CARRIED_S = 120.0
"""a vehicle that was lost in the air, and tells from elsewhere that it stands on the ground, is believed after so long:
from the highest ceiling (50 m) a landing at 0.7 m/s takes 71 s, and it must be carried away after that"""
TRACKS_MAX = 3
MISSING_HEARTBEATS = 12
"""so many heartbeats, due from all peers together, are not lost by chance: 0.5^12 is 0.02 %"""
HEARTBEAT_MARGIN_S = 0.5
"""a heartbeat may be under way for so long"""
STANDING_S = 1.0
"""braking to a stand"""
PATH_STEP_NS = 500_000_000
PIECE_M = 0.1
STRAIGHT_M = 0.05
GATE_VELOCITY_M_S = 0.7
GATE_RESIDUAL_M = 2.0
GATE_PERIOD_NS = 100_000_000
UNSTEERED_M = 0.5
"""how much further than another one may be that its pilot or its autopilot moves: nobody tells where it turns next"""
UNCERTAINTY_GROWTH_M_S = 0.3
UNCERTAINTY_GROWTH_MAX_M = 1.0
JUMPS = Failsafe.PEER_LIES.value
HEARSAY_REFUSED = "digest: contradicts what was heard"

REFUSED = ("own id", "foreign id", "not finite", "from the future", "too old on arrival", "repeated or out of order")
"""why a sample is not taken"""
COUNTED = (
    *REFUSED, *(f"digest: {r}" for r in REFUSED), HEARSAY_REFUSED,
    Failsafe.PEER_LIES.value, Failsafe.PEER_FROZEN.value, Failsafe.TWO_SOURCES.value,
)  # fmt: skip
"""what is counted: samples that are not taken, and those on which nothing is built"""
_NOWHERE = Reference(ZERO, ZERO, ZERO, 0.0)


@dataclass(frozen=True, slots=True)
class PeerLimits:
    """What the table needs to know of the configuration."""

    hold: HoldKind
    hold_damping_s: float
    range_m: float
    stale_after_s: float
    """a peer silent for longer is stale: beyond T_max with its jitter"""
    heartbeat_s: float
    """T_max: every peer speaks at least so often"""
    isolated_flight_s: float
    """how long a vehicle that hears nobody flies on before it holds by itself"""
    uncertainty_m: float
    """bound on the prediction's error of a peer that is heard"""
    motion: PeerMotion
    """what a peer can do unseen"""
    digest_size: int


def predict_sample(
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
    if sample.phase in (Phase.DETACHED, Phase.RELEASED, Phase.IDLE):
        # IDLE too: a companion that starts in flight does not steer.
        w = weights("damped", tau_s, FREE_DAMPING_S)
        k, f = w.position, w.velocity
        return Ned(p.north + k * v.north, p.east + k * v.east, p.down + k * v.down), Ned(*(f * x for x in v))
    return p, ZERO


def aloft(sample: PeerSample) -> bool:
    """Whether a vehicle that says nothing more after this cannot be taken to stand where it was."""
    found_in_the_air = sample.phase in (Phase.IDLE, Phase.PREFLIGHT) and sample.position_ned_m.down < -ALOFT_M
    return sample.phase in AIRBORNE_PHASES or found_in_the_air


def _stands(sample: PeerSample) -> bool:
    return sample.phase is Phase.ARMED or not aloft(sample)


@dataclass(slots=True)
class _Track:
    """What one vehicle can have said, sample after sample."""

    sample: PeerSample
    reference_then: tuple[Ned, Ned]
    """p_ref and v_d of its slot at the sample's time"""
    first_ns: int
    """time of its first sample"""
    own: tuple[PeerSample, tuple[Ned, Ned]] | None
    """the last sample that the peer sent itself, with its reference"""
    reached: bool = True
    """it can have flown here from what was told before"""
    same_since_ns: int = 0
    """time of the first sample with its present position"""
    due_ns: int = 0
    """fleet time from which it is lost if nothing more is heard"""
    due_stopped_ns: int = 0
    """what `stopped_ns` is then"""
    due_flown_ns: int = 0
    lost_at_ns: int | None = None
    """fleet time at which presence ended or silence became too long"""
    silent: bool = False
    """it is lost by its silence, not by the end of its presence"""
    stopped_ns: int = 0
    """of a lost one: it flew on until then at least"""
    flown_ns: int = 0
    """and no longer than until then"""
    path: list[Ned] = field(default_factory=list)
    """where it may be, every PATH_STEP_NS from `stopped_ns` on"""

    def fall_silent(self) -> None:
        """It has said nothing for too long."""
        self.lose(self.due_ns, self.due_stopped_ns, self.due_flown_ns, silent=True)

    def lose(self, at_ns: int, stopped_ns: int, flown_ns: int, silent: bool) -> None:
        """It is lost; where it may be begins at `stopped_ns`."""
        self.lost_at_ns, self.silent = at_ns, silent
        self.stopped_ns, self.flown_ns = max(stopped_ns, self.sample.time_ns), flown_ns
        self.path = []


@dataclass(slots=True)
class _Peer:
    tracks: list[_Track] = field(default_factory=list)
    """the one that was told of last in front; more than one while it is not known where the vehicle is"""
    boots: dict[int, tuple[int, int]] = field(default_factory=dict)
    """boot id -> times of its first sample and of its last"""
    boot_id: int | None = None
    present: bool = False
    suspect_until_ns: int = 0
    """fleet time until which nothing is built on what it says"""
    twofold_until_ns: int = 0
    """the same, since two sources speak under its id"""
    noted_until_ns: int = 0
    """until then another place of it is not noted again: a liar writes no log"""
    due_soon: bool = False
    """its last message came in near mode, so that one that is missing is known to be"""


@dataclass(slots=True)
class PeerTable:
    """Peers by vehicle id. Nothing here raises for what a peer sends; it is refused, counted and named."""

    own_id: int
    ids: frozenset[int]
    """every enabled vehicle's id but the own"""
    limits: PeerLimits
    history: TrajectoryHistory
    rejected: Counts = field(default_factory=lambda: Counts(COUNTED))
    events: list[PeerDoubted] = field(default_factory=list)
    """what happened; emptied by the agent"""
    _peers: dict[int, _Peer] = field(default_factory=dict)
    _gated: frozenset[int] = frozenset()
    _gated_until_ns: int = 0
    """when the gates are looked at anew (monotonic ns)"""
    _deaf_from_ns: int | None = None
    """fleet time from which nobody's states are heard any more, if nothing comes before"""

    def __post_init__(self) -> None:
        self._peers = {i: _Peer() for i in sorted(self.ids)}

    # -- what is heard -------------------------------------------------------------------------------------------------

    def accept(self, message: PeerMessage, now: Instant) -> str | None:
        """Take a peer's message; returns why not if it was refused."""
        sample = message.sample
        reason = self._refusal(sample, now)
        if reason is None:
            reason = self._hear(self._peers[sample.vehicle_id], sample, message.boot_id, now)
            if reason is None:
                self._peers[sample.vehicle_id].due_soon = message.due_soon
        if reason is not None:
            self.rejected[reason] += 1
            return reason
        for hearsay in message.digest:
            if hearsay.vehicle_id == self.own_id:
                continue
            reason = self._refusal(hearsay, now)
            if reason is not None:
                self.rejected[f"digest: {reason}"] += 1
            elif not self._overhear(self._peers[hearsay.vehicle_id], hearsay, now):
                self.rejected[HEARSAY_REFUSED] += 1
        self._reckon()
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

    def _hear(self, peer: _Peer, sample: PeerSample, boot_id: int, now: Instant) -> str | None:
        """A sample that came from the peer itself, or from whoever speaks under its id."""
        matching = [t for t in peer.tracks if self._explains(t, sample)]
        earlier = [t for t in matching if t.sample.time_ns < sample.time_ns]
        if matching and not earlier:
            return "repeated or out of order"
        late = now.fleet_ns - sample.time_ns > LATE_S * 1e9
        if late and any(t.sample.time_ns >= sample.time_ns for t in peer.tracks):
            # Nobody's truth is that old; time orders samples, since a sequence number can be forged for good.
            return "repeated or out of order"
        anew = peer.boot_id != boot_id
        self._count_sources(peer, sample, boot_id, now)
        reference = self._reference_then(sample)
        if earlier:
            track, *others = earlier
            # What explains one sample together is one vehicle.
            peer.tracks = [track, *(t for t in peer.tracks if t is not track and t not in others)]
            lie = track.lost_at_ns is None and self._frozen(track, sample)
            if lie:
                self.rejected[Failsafe.PEER_FROZEN.value] += 1
                peer.suspect_until_ns = now.fleet_ns + round(SUSPECT_S * 1e9)
        else:
            track = self._open(peer, sample, reference)
        if anew or track.lost_at_ns is None or sample.time_ns > track.lost_at_ns:
            # One that was sent before the sender's end, and came late, brings nobody back.
            peer.present = True
            track.lost_at_ns = None
        self._store(track, sample, reference)
        track.own = (sample, reference)
        return None

    def _open(self, peer: _Peer, sample: PeerSample, reference: tuple[Ned, Ned]) -> _Track:
        """Another place where the peer may be; of too many, the one that lasted the shortest goes."""
        track = _Track(sample, reference, sample.time_ns, None, same_since_ns=sample.time_ns)
        if peer.tracks:
            track.reached = any(self._leads_to(t, sample) for t in peer.tracks)
            self.rejected[JUMPS] += 1
            if sample.time_ns >= peer.noted_until_ns:
                peer.noted_until_ns = sample.time_ns + round(self.limits.stale_after_s * 1e9)
                self.events.append(PeerDoubted(sample.vehicle_id, Failsafe.PEER_LIES, "both places are kept clear of"))
            if len(peer.tracks) == TRACKS_MAX:
                peer.tracks.remove(min(reversed(peer.tracks), key=lambda t: t.sample.time_ns - t.first_ns))
        peer.tracks.insert(0, track)
        return track

    def _count_sources(self, peer: _Peer, sample: PeerSample, boot_id: int, now: Instant) -> None:
        """Notice two processes that live at a time: one that speaks again after another, of its id, has begun."""
        first_ns, last_ns = peer.boots.pop(boot_id, (sample.time_ns, sample.time_ns))
        stale_ns = now.fleet_ns - round(self.limits.stale_after_s * 1e9)
        peer.boots = {b: times for b, times in peer.boots.items() if times[1] >= stale_ns}
        twofold = any(first_ns < begun_ns < sample.time_ns for begun_ns, _ in peer.boots.values())
        while len(peer.boots) >= TRACKS_MAX:
            del peer.boots[max(peer.boots, key=lambda b: peer.boots[b][0])]
        peer.boots[boot_id] = (min(first_ns, sample.time_ns), max(last_ns, sample.time_ns))
        peer.boot_id = boot_id
        if twofold:
            self.rejected[Failsafe.TWO_SOURCES.value] += 1
            if now.fleet_ns >= peer.twofold_until_ns:
                self.events.append(
                    PeerDoubted(sample.vehicle_id, Failsafe.TWO_SOURCES, "all the distance is kept to it")
                )
            peer.twofold_until_ns = now.fleet_ns + round(self.limits.stale_after_s * 1e9)

    def _overhear(self, peer: _Peer, sample: PeerSample, now: Instant) -> bool:
        """A sample that another peer has passed on; whether it agrees with what is known."""
        if not peer.tracks:
            self._open(peer, sample, self._reference_then(sample))
            return True
        if sample.time_ns <= peer.tracks[0].sample.time_ns:
            return True
        track = next((t for t in peer.tracks if self._explains(t, sample)), None)
        if track is None or sample.time_ns <= track.sample.time_ns:
            return track is not None
        if track.own is not None and track.lost_at_ns is None:
            said, reference_then = track.own
            if now.fleet_ns - said.time_ns <= (self.limits.heartbeat_s + HEARTBEAT_MARGIN_S) * 1e9:
                foreseen, _ = self._foreseen(said, reference_then, sample.time_ns)
                moved = dist(foreseen, sample.position_ned_m) > HEARSAY_M
                if moved or (said.phase in FORMATION_PHASES) is not (sample.phase in FORMATION_PHASES):
                    return False
        self._store(track, sample, self._reference_then(sample))
        if track.lost_at_ns is not None and (track.silent or sample.time_ns > track.lost_at_ns):
            track.lost_at_ns = None  # it is alive though it is not heard here
        return True

    # -- the examination -----------------------------------------------------------------------------------------------

    def _explains(self, track: _Track, sample: PeerSample) -> bool:
        """Whether a sample and a track's last can be of one vehicle."""
        before, after = track.sample, sample
        if track.lost_at_ns is not None and aloft(before):
            return self._comes_back(track, sample)
        reference_then = track.reference_then
        if after.time_ns < before.time_ns:
            before, after = after, before
            reference_then = self._reference_then(before)
        if _stands(before) and _stands(after):
            return True  # on the ground estimators start anew, and vehicles are carried
        high = before.position_ned_m.down < -ALOFT_M
        if high and before.phase in FLYING_PHASES - {Phase.LANDING} and _stands(after):
            return False  # nobody lands without having been landing
        p, v = self._foreseen(before, reference_then, after.time_ns)
        dt_s = min((after.time_ns - before.time_ns) * 1e-9, UNTOLD_S)
        reach = min(0.5 * PEER_ACCELERATION_M_S2 * dt_s, PEER_SPEED_M_S) * dt_s
        margin = max(PEER_MARGIN_M, self.limits.uncertainty_m)
        if not dist(p, after.position_ned_m) <= margin + reach:
            return False
        if _stands(before) or _stands(after):
            return True
        return dist(v, after.velocity_ned_m_s) <= PEER_MARGIN_M_S + PEER_ACCELERATION_M_S2 * dt_s

    def _leads_to(self, track: _Track, sample: PeerSample) -> bool:
        """Whether a vehicle on that track can have flown to where a sample that it does not explain has it."""
        q = sample.position_ned_m
        dt_s = abs(sample.time_ns - track.sample.time_ns) * 1e-9
        if not dist(track.sample.position_ned_m, q) <= PEER_MARGIN_M + PEER_SPEED_M_S * dt_s:
            return False
        p, _ = self._foreseen(track.sample, track.reference_then, sample.time_ns)
        return aloft(sample) or hypot(p.north - q.north, p.east - q.east) <= LOST_NEAR_M

    def _comes_back(self, track: _Track, sample: PeerSample) -> bool:
        """Whether a sample is of a vehicle that was lost in the air: it is near where that may be, or beneath it."""
        path, _ = self._path(track, max(sample.time_ns, track.stopped_ns))
        q = sample.position_ned_m
        for a, b in pairwise(path):
            p = lerp(a, b, closest_point_parameter(q._replace(down=a.down), a, b))
            if hypot(p.north - q.north, p.east - q.east) <= LOST_NEAR_M and q.down >= p.down - LOST_NEAR_M:
                return True
        return False

    def _frozen(self, track: _Track, sample: PeerSample) -> bool:
        """Whether it moves without changing its position."""
        steered = FLYING_PHASES - {Phase.ARMED}
        return (
            track.sample.phase in steered
            and sample.phase in steered
            and sample.position_ned_m == track.sample.position_ned_m
            and hypot(*sample.velocity_ned_m_s) > MOVING_M_S
            and sample.time_ns - track.same_since_ns >= FROZEN_S * 1e9
        )

    def _store(self, track: _Track, sample: PeerSample, reference_then: tuple[Ned, Ned]) -> None:
        if sample.position_ned_m != track.sample.position_ned_m:
            track.same_since_ns = sample.time_ns
        track.sample, track.reference_then, track.path = sample, reference_then, []
        track.stopped_ns = max(track.stopped_ns, sample.time_ns)

    def _forget(self, peer: _Peer, now: Instant) -> None:
        """Leave the tracks that are disproved.

        One that has not been told of for as long as a peer may be silent, while another was that it can have led to;
        one that stood on the ground; and one in the air, once another has been told of for CARRIED_S without it.
        """
        stale_ns = round(self.limits.stale_after_s * 1e9)
        kept = []
        for t in peer.tracks:
            disproved = False
            for other in peer.tracks:
                told_ns = other.sample.time_ns
                since_ns = max(t.sample.time_ns, other.first_ns)
                if told_ns <= t.sample.time_ns:
                    continue
                if other.reached or not aloft(t.sample):
                    disproved |= now.fleet_ns - since_ns > stale_ns
                else:
                    disproved |= told_ns - since_ns > CARRIED_S * 1e9
            if not disproved:
                kept.append(t)
        peer.tracks = kept

    # -- presence and silence ------------------------------------------------------------------------------------------

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
        if not alive:
            flown_ns = now.fleet_ns + round(self.limits.isolated_flight_s * 1e9)
            for track in peer.tracks:
                if track.lost_at_ns is None:
                    track.lose(now.fleet_ns, now.fleet_ns - round(PRESENCE_DELAY_S * 1e9), flown_ns, silent=False)
        self._reckon()

    def _reckon(self) -> None:
        """Foresee from when each peer is lost by its silence, and from when this vehicle hears nobody.

        One that misses its heartbeats while others are heard may have stopped at any time since its last sample. When
        all miss theirs at once, the link is gone and not they: each flies on until it, too, has heard nobody for
        `_deaf_after_ns`. Since all hear the same, each knows when that is for every other, but for its own messages.
        """
        limits = self.limits
        stale_ns = round(limits.stale_after_s * 1e9)
        overdue_ns = round((limits.heartbeat_s + HEARTBEAT_MARGIN_S) * 1e9)
        heard = [p for p in self._peers.values() if p.tracks and p.present]
        times = sorted((p.tracks[0].sample.time_ns for p in heard), reverse=True)
        several = len(times) >= 2
        deaf_ns = self._deaf_after_ns(len(times))
        self._deaf_from_ns = times[0] + deaf_ns if several else None
        for peer in self._peers.values():
            for track in peer.tracks:
                track.due_ns, track.due_stopped_ns = track.sample.time_ns + stale_ns, track.sample.time_ns
                track.due_flown_ns = track.due_ns + round(limits.isolated_flight_s * 1e9)
        if not several:
            return
        common = [p.tracks[0] for p in heard if p.tracks[0].sample.time_ns + overdue_ns >= times[0]]
        oldest_ns = min(t.sample.time_ns for t in common)
        stood_ns = max(times[0], oldest_ns + overdue_ns) + deaf_ns + round(STANDING_S * 1e9)
        for track in common:
            last_ns = track.sample.time_ns
            others_ns = times[1] if last_ns == times[0] else times[0]
            if last_ns <= others_ns + deaf_ns:
                track.due_ns = track.due_stopped_ns = others_ns + deaf_ns
                track.due_flown_ns = stood_ns

    def _deaf_after_ns(self, count: int) -> int:
        """After how long without any state from `count` peers that are said to be there none can come any more.

        Of few peers that would last longer than it takes a vehicle alone to stand.
        """
        limits = self.limits
        heartbeats = max(1.0, MISSING_HEARTBEATS / max(count, 1))
        alone_s = limits.stale_after_s + limits.isolated_flight_s
        return round(min(alone_s, heartbeats * limits.heartbeat_s + HEARTBEAT_MARGIN_S) * 1e9)

    def deaf(self, now: Instant) -> bool:
        """Whether no state comes any more from several peers that are all said to be there."""
        return self._deaf_from_ns is not None and now.fleet_ns > self._deaf_from_ns

    def sample(self, vehicle_id: int) -> PeerSample | None:
        """The latest sample of a peer, its own or by digest."""
        tracks = self._peers[vehicle_id].tracks
        return tracks[0].sample if tracks else None

    def due_soon(self, vehicle_id: int) -> bool:
        """Whether a peer last said that it speaks in near mode, so that its messages are known to be due."""
        return self._peers[vehicle_id].due_soon

    def boot_id(self, vehicle_id: int) -> int | None:
        """The boot id a peer last gave."""
        return self._peers[vehicle_id].boot_id

    def phases(self) -> dict[int, Phase | None]:
        """Each peer's phase as it last said, None for one that is lost or never was heard."""
        return {
            i: p.tracks[0].sample.phase if p.tracks and p.tracks[0].lost_at_ns is None and p.present else None
            for i, p in self._peers.items()
        }

    def oldest_age_s(self, now: Instant) -> float | None:
        """Age of the oldest sample among the peers that are there (s)."""
        ages = [now.fleet_ns - p.tracks[0].sample.time_ns for p in self._peers.values() if p.tracks and p.present]
        return max(ages) * 1e-9 if ages else None

    def silent_for_s(self, now: Instant) -> float | None:
        """How long everybody has been lost: gone, or silent for longer than a peer may be (s).

        None if nobody ever was heard. Whoever is still said to be there but says nothing counts as silent, in whatever
        phase it was.
        """
        newest = [p.tracks[0] for p in self._peers.values() if p.tracks]
        ends = [t.due_ns if t.lost_at_ns is None else t.lost_at_ns for t in newest]
        return max(now.fleet_ns - max(ends), 0) * 1e-9 if ends else None

    def digest(self) -> tuple[PeerSample, ...]:
        """The latest samples of peers for passing on, newest first; none of a peer that is lost, or in two places."""
        known = [p.tracks[0] for p in self._peers.values() if len(p.tracks) == 1]
        samples = [t.sample for t in known if t.lost_at_ns is None]
        samples.sort(key=lambda s: (-s.time_ns, s.vehicle_id))
        return tuple(samples[: self.limits.digest_size])

    # -- what that says about now --------------------------------------------------------------------------------------

    def plan_changed(self) -> None:
        """Look the references of the samples up again, after a motion was adopted."""
        for peer in self._peers.values():
            for track in peer.tracks:
                track.reference_then = self._reference_then(track.sample)
                if track.own is not None:
                    track.own = (track.own[0], self._reference_then(track.own[0]))
                track.path = []

    def _reference_then(self, sample: PeerSample) -> tuple[Ned, Ned]:
        reference = self.history.reference(sample.vehicle_id, sample.time_ns)
        return reference.position_ned_m, reference.velocity_ned_m_s

    def _foreseen(self, sample: PeerSample, reference_then: tuple[Ned, Ned], fleet_ns: int) -> tuple[Ned, Ned]:
        reference = self.history.reference(sample.vehicle_id, fleet_ns)
        return predict_sample(sample, reference_then, reference, fleet_ns, self.limits)

    def predict(
        self, ego_ned_m: Ned, now: Instant, moment: TrajectoryState, gated: bool, above_ground: bool = False
    ) -> list[Neighbour]:
        """Every known peer within range, predicted to now under the plan at that `moment`, in the order of the ids.

        One that may be in two places is there twice. With `gated` (only once formed), peers whose prediction is far
        from what the others' say drop from alignment and cohesion; they still count for separation. With `above_ground`
        (before landing) the place above one that stands on the ground or lands is taken too, up to the own altitude.
        """
        slots = self.history.at(now.fleet_ns).slots
        own = moment.slot(slots[self.own_id]).position_ned_m
        neighbours = []
        for i, peer in self._peers.items():
            if not peer.tracks:
                continue
            if len(peer.tracks) > 1:
                self._forget(peer, now)
            reference = moment.slot(slots[i])
            for track in peer.tracks:
                n = self._predict(peer, track, ego_ned_m, now, reference, own)
                if above_ground and track.sample.phase in LOW_PHASES:
                    p = n.position_ned_m
                    n = n._replace(last_seen_ned_m=p._replace(down=min(p.down, ego_ned_m.down)))
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
        place, other = n.position_ned_m, n.last_seen_ned_m
        if other is not None:
            place = lerp(place, other, closest_point_parameter(ego_ned_m, place, other))
        return dist(place, ego_ned_m) <= self.limits.range_m

    def _predict(
        self, peer: _Peer, track: _Track, ego_ned_m: Ned, now: Instant, reference: Reference, own: Ned
    ) -> Neighbour:
        limits, sample = self.limits, track.sample
        follows = sample.phase in FORMATION_PHASES
        tau_s = max(0.0, (now.fleet_ns - sample.time_ns) * 1e-9)
        if now.fleet_ns > track.due_ns and track.lost_at_ns is None and aloft(sample):
            track.fall_silent()
        uncertainty = limits.uncertainty_m
        other_end: Ned | None = None
        lost_at_ns = track.lost_at_ns
        if lost_at_ns is not None and aloft(sample):
            since_s = (now.fleet_ns - lost_at_ns) * 1e-9
            uncertainty += min(UNCERTAINTY_GROWTH_M_S * max(since_s, 0.0), UNCERTAINTY_GROWTH_MAX_M)
            position, velocity, other_end = self._lost_piece(track, ego_ned_m, now)
        else:
            position, velocity = predict_sample(sample, track.reference_then, reference, now.fleet_ns, limits)
            if peer.due_soon:
                uncertainty = near_bound_m(tau_s, uncertainty, limits.motion)
            if not follows and aloft(sample) and sample.phase not in FLYING_PHASES:
                uncertainty += UNSTEERED_M
        sound = (
            follows
            and lost_at_ns is None
            and len(peer.tracks) == 1
            and now.fleet_ns >= peer.suspect_until_ns
            and now.fleet_ns >= peer.twofold_until_ns
        )
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

    def _lost_piece(self, track: _Track, ego_ned_m: Ned, now: Instant) -> tuple[Ned, Ned, Ned]:
        """The straight piece of a lost peer's path that is nearest: both its ends, the first with its velocity.

        A straight path is one piece. Of a curved one, the velocity is such that the nearest place, which lies within
        the piece, moves as fast as one that far along the path: from nothing where the peer stopped to all of it where
        it flies on.
        """
        path, velocity = self._path(track, now.fleet_ns)
        if off_chord(path) <= STRAIGHT_M:
            return path[-1], velocity, path[0]
        edge, share = nearest_on_path(ego_ned_m, path, DOWNWASH_RATIO)
        front, back, at = piece_about(path, edge, share, PIECE_M)
        if velocity != ZERO and at < 1.0:
            a, b = path[edge], path[edge + 1]
            scale = (edge + share) / (len(path) - 1) / (1.0 - at) * hypot(*velocity) / max(dist(a, b), 1e-9)
            velocity = Ned(scale * (b.north - a.north), scale * (b.east - a.east), scale * (b.down - a.down))
        return front, velocity, back

    def _path(self, track: _Track, fleet_ns: int) -> tuple[list[Ned], Ned]:
        """Where a lost peer may be, from where it may have stopped to where it is if it flew on, and how fast.

        One whose presence ended was seen alive until shortly before, so it stopped no earlier than PRESENCE_DELAY_S
        before that; one that fell silent by itself may have stopped at any time since its last sample (`_reckon` says
        what holds when all fall silent at once). A vehicle that hears nobody holds by itself after `isolated_flight_s`,
        so it flew on no longer than that. One that was armed, climbed or landed is somewhere in the column between
        there and its altitude, or the ground; so is one in whose flight a companion started.
        """
        sample = track.sample
        last = sample.position_ned_m
        if sample.phase not in FORMATION_PHASES:
            slot = self.history.reference(sample.vehicle_id, sample.time_ns).position_ned_m
            top, ground = min(slot.down, last.down), max(0.0, last.down)
            ends = {Phase.ARMED: top, Phase.CLIMBING: top, Phase.LANDING: ground}
            if sample.phase in ends:
                return [last, last._replace(down=ends[sample.phase])], ZERO
            p, v = predict_sample(sample, (ZERO, ZERO), _NOWHERE, fleet_ns, self.limits)
            if sample.phase is Phase.RELEASED or sample.phase in FILTERED_PHASES:
                return [last, p], v
            return [last, p._replace(down=max(p.down, ground))], ZERO
        end_ns = max(min(fleet_ns, track.flown_ns), track.stopped_ns)
        while (next_ns := track.stopped_ns + len(track.path) * PATH_STEP_NS) < end_ns or not track.path:
            track.path.append(self._foreseen(sample, track.reference_then, next_ns)[0])
        end, velocity = self._foreseen(sample, track.reference_then, end_ns)
        return [*track.path, end], velocity if fleet_ns < track.flown_ns else ZERO


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
