"""The peer table: what this vehicle knows of the others, and what that says about now.

A *track* is what one vehicle can have said, sample after sample. A sample that no track of its peer explains opens
another, and both places are kept clear of until one of them is left. What is passed on by others (a digest) opens none
and moves none far.
"""

from dataclasses import dataclass, field
from math import dist, isfinite

from companion.core.counts import Counts
from companion.core.events import PeerDoubted
from companion.core.failsafe import SUSPECT_S, Failsafe
from companion.core.frames import Ned, new
from companion.core.neighbours import examination, silence
from companion.core.neighbours.gates import GATE_PERIOD_NS, outliers
from companion.core.neighbours.graph import Graph, mutual_nearest
from companion.core.neighbours.lost import nearest_piece
from companion.core.neighbours.sample import Foresight, PeerLimits, aloft
from companion.core.neighbours.track import Peer, Track
from companion.core.prediction import common_way
from companion.core.trajectory.fleet import FleetTrajectory, Reference, TrajectoryState
from companion.core.trajectory.history import TrajectoryHistory
from companion.core.trigger.near import near_bound_m
from companion.core.values import (
    FLYING_PHASES,
    FORMATION_PHASES,
    LOW_PHASES,
    Instant,
    Neighbour,
    PeerMessage,
    PeerSample,
    Phase,
)
from companion.core.vectors import closest_point_parameter, lerp

FUTURE_LIMIT_S = 1.0
"""a sample from further ahead than this comes from a clock that is wrong"""
LATE_S = 2.0
"""a sample older than what is known is looked at only if it is younger than this; else it is taken for a repeat"""
HEARSAY_M = 2.0
"""what others pass on moves a peer no further than this from what it lately said itself"""
TRACKS_MAX = 3
UNSTEERED_M = 0.5
"""how much further than another one may be that its pilot or its autopilot moves: nobody tells where it turns next"""
UNCERTAINTY_GROWTH_M_S = 0.3
UNCERTAINTY_GROWTH_MAX_M = 1.0
HEARSAY_REFUSED = "digest: contradicts what was heard"

REFUSED = ("own id", "foreign id", "not finite", "from the future", "too old on arrival", "repeated or out of order")
"""why a sample is not taken"""
COUNTED = (
    *REFUSED, *(f"digest: {r}" for r in REFUSED), HEARSAY_REFUSED,
    Failsafe.PEER_LIES.value, Failsafe.PEER_FROZEN.value, Failsafe.TWO_SOURCES.value,
)  # fmt: skip
"""what is counted: samples that are not taken, and those on which nothing is built"""


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
    _peers: dict[int, Peer] = field(default_factory=dict)
    _gated: frozenset[int] = frozenset()
    _gated_until_ns: int = 0
    """when the gates are looked at anew (monotonic ns)"""
    _deaf_from_ns: int | None = None
    """fleet time from which nobody's states are heard any more, if nothing comes before"""
    _joined: tuple[FleetTrajectory, Graph] | None = None
    """the slots' graph, and the motion whose it is"""
    foresight: Foresight = field(init=False)
    """what samples say about other times, the own ones to the peers included"""
    _stale_ns: int = field(init=False)

    def __post_init__(self) -> None:
        self._peers = {i: Peer() for i in sorted(self.ids)}
        self.foresight = Foresight(self.history, self.limits)
        self._stale_ns = round(self.limits.stale_after_s * 1e9)

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
        self._deaf_from_ns = silence.reckon(self._peers.values(), self.limits)
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

    def _hear(self, peer: Peer, sample: PeerSample, boot_id: int, now: Instant) -> str | None:
        """A sample that came from the peer itself, or from whoever speaks under its id."""
        matching = [t for t in peer.tracks if examination.explains(t, sample, self.foresight)]
        earlier = [t for t in matching if t.sample.time_ns < sample.time_ns]
        if matching and not earlier:
            return "repeated or out of order"
        late = now.fleet_ns - sample.time_ns > LATE_S * 1e9
        if late and any(t.sample.time_ns >= sample.time_ns for t in peer.tracks):
            # Nobody's truth is that old; time orders samples, since a sequence number can be forged for good.
            return "repeated or out of order"
        anew = peer.boot_id != boot_id
        self._count_sources(peer, sample, boot_id, now)
        reference = self.foresight.reference_then(sample)
        if earlier:
            track, *others = earlier
            # What explains one sample together is one vehicle.
            peer.tracks = [track, *(t for t in peer.tracks if t is not track and t not in others)]
            lie = track.lost_at_ns is None and examination.frozen(track, sample)
            if lie:
                self.rejected[Failsafe.PEER_FROZEN.value] += 1
                peer.suspect_until_ns = now.fleet_ns + round(SUSPECT_S * 1e9)
        else:
            track = self._open(peer, sample, reference)
        if anew or track.lost_at_ns is None or sample.time_ns > track.lost_at_ns:
            # One that was sent before the sender's end, and came late, brings nobody back.
            peer.present = True
            track.lost_at_ns = None
        track.take(sample, reference)
        track.own = (sample, reference)
        return None

    def _open(self, peer: Peer, sample: PeerSample, reference: tuple[Ned, Ned]) -> Track:
        """Another place where the peer may be; of too many, the one that lasted the shortest goes."""
        track = Track(sample, reference, sample.time_ns, None, same_since_ns=sample.time_ns)
        if peer.tracks:
            track.reached = any(examination.leads_to(t, sample, self.foresight) for t in peer.tracks)
            self.rejected[Failsafe.PEER_LIES.value] += 1
            if sample.time_ns >= peer.noted_until_ns:
                peer.noted_until_ns = sample.time_ns + self._stale_ns
                self.events.append(PeerDoubted(sample.vehicle_id, Failsafe.PEER_LIES, "both places are kept clear of"))
            if len(peer.tracks) == TRACKS_MAX:
                peer.tracks.remove(min(reversed(peer.tracks), key=lambda t: t.sample.time_ns - t.first_ns))
        peer.tracks.insert(0, track)
        return track

    def _count_sources(self, peer: Peer, sample: PeerSample, boot_id: int, now: Instant) -> None:
        """Notice two processes that live at a time: one that speaks again after another, of its id, has begun."""
        first_ns, last_ns = peer.boots.pop(boot_id, (sample.time_ns, sample.time_ns))
        stale_ns = now.fleet_ns - self._stale_ns
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
            peer.twofold_until_ns = now.fleet_ns + self._stale_ns

    def _overhear(self, peer: Peer, sample: PeerSample, now: Instant) -> bool:
        """A sample that another peer has passed on; whether it agrees with what is known."""
        if not peer.tracks:
            self._open(peer, sample, self.foresight.reference_then(sample))
            return True
        if sample.time_ns <= peer.tracks[0].sample.time_ns:
            return True
        track = next((t for t in peer.tracks if examination.explains(t, sample, self.foresight)), None)
        if track is None or sample.time_ns <= track.sample.time_ns:
            return track is not None
        if track.own is not None and track.lost_at_ns is None:
            said, reference_then = track.own
            if now.fleet_ns - said.time_ns <= (self.limits.heartbeat_s + silence.HEARTBEAT_MARGIN_S) * 1e9:
                foreseen = self.foresight.at(said, reference_then, sample.time_ns)
                moved = dist(foreseen.position_ned_m, sample.position_ned_m) > HEARSAY_M
                if moved or (said.phase in FORMATION_PHASES) is not (sample.phase in FORMATION_PHASES):
                    return False
        track.take(sample, self.foresight.reference_then(sample))
        if track.lost_at_ns is not None and (track.silent or sample.time_ns > track.lost_at_ns):
            track.lost_at_ns = None  # it is alive though it is not heard here
        return True

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
            stopped_ns = now.fleet_ns - round(self.limits.notice_lost_s * 1e9)
            flown_ns = now.fleet_ns + round((self.limits.notice_spread_s + self.limits.isolated_flight_s) * 1e9)
            for track in peer.tracks:
                if track.lost_at_ns is None:
                    track.lose(now.fleet_ns, stopped_ns, flown_ns, silent=False)
        self._deaf_from_ns = silence.reckon(self._peers.values(), self.limits)

    def deaf(self, now: Instant) -> bool:
        """Whether no state comes any more from several peers that are all said to be there."""
        return self._deaf_from_ns is not None and now.fleet_ns > self._deaf_from_ns

    def sample(self, vehicle_id: int) -> PeerSample | None:
        """The latest sample of a peer, its own or by digest."""
        tracks = self._peers[vehicle_id].tracks
        return tracks[0].sample if tracks else None

    def common_velocity_m_s(self, vehicle_id: int, now: Instant) -> tuple[float, float] | None:
        """What a peer takes for the fleet's common velocity by now (north, east); None if it tells none."""
        sample = self.sample(vehicle_id)
        if sample is None or sample.common is None:
            return None
        way = common_way(sample.common, max(0.0, (now.fleet_ns - sample.time_ns) * 1e-9))
        return way.north_m_s, way.east_m_s

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
        newest_ns: int | None = None
        for peer in self._peers.values():
            if peer.tracks:
                track = peer.tracks[0]
                end_ns = track.due_ns if track.lost_at_ns is None else track.lost_at_ns
                if end_ns >= now.fleet_ns:
                    return 0.0
                if newest_ns is None or end_ns > newest_ns:
                    newest_ns = end_ns
        return None if newest_ns is None else (now.fleet_ns - newest_ns) * 1e-9

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
                track.reference_then = self.foresight.reference_then(track.sample)
                if track.own is not None:
                    track.own = (track.own[0], self.foresight.reference_then(track.own[0]))
                track.path = []

    def predict(
        self, ego_ned_m: Ned, now: Instant, moment: TrajectoryState, gated: bool, above_ground: bool = False
    ) -> list[Neighbour]:
        """Every known peer within range, predicted to now under the plan at that `moment`, in the order of the ids.

        Where the law heeds all whom it hears, those out of range are among them.

        Where no motion is shared, `moment` has the common motion as this vehicle takes it to be, and each peer is
        predicted by its own.

        Of a lost one the nearest place where it may be must be within range. One that may be in two places is there
        twice. With `gated` (only once formed), peers whose prediction is far from what the others' say drop from
        alignment and cohesion; they still count for separation. With `above_ground` (before landing) the place above
        one that stands on the ground or lands is taken too, up to the own altitude.
        """
        motion = self.history.at(now.fleet_ns)
        slots, free = motion.slots, motion.free_at(now.fleet_ns)
        shared = motion.state_at(now.fleet_ns) if free else moment
        own = moment.slot(slots[self.own_id]).position_ned_m
        neighbours = []
        for i, peer in self._peers.items():
            if not peer.tracks:
                continue
            if len(peer.tracks) > 1:
                peer.tracks = examination.undisproved(peer.tracks, self._stale_ns, now)
            reference = moment.slot(slots[i])
            for track in peer.tracks:
                n = self._predict(
                    peer, track, ego_ned_m, now, reference, own, shared.slot(slots[i]) if free else reference
                )
                if above_ground and track.sample.phase in LOW_PHASES:
                    p = n.position_ned_m
                    n = n._replace(last_seen_ned_m=p._replace(down=min(p.down, ego_ned_m.down)))
                place = n.position_ned_m
                if n.last_seen_ned_m is not None:
                    place = lerp(place, n.last_seen_ned_m, closest_point_parameter(ego_ned_m, place, n.last_seen_ned_m))
                if dist(place, ego_ned_m) <= self.limits.range_m or self.limits.neighbours == "all":
                    neighbours.append(n)
        if self.limits.neighbours == "nearest":
            heeded = self.joined(motion)[self.own_id]
            neighbours = [n if n.vehicle_id in heeded else n._replace(in_formation=False) for n in neighbours]
        if not gated:
            return neighbours
        if now.monotonic_ns >= self._gated_until_ns:
            self._gated_until_ns = now.monotonic_ns + GATE_PERIOD_NS
            said = {n.vehicle_id: self.common_velocity_m_s(n.vehicle_id, now) for n in neighbours} if free else None
            self._gated = outliers(neighbours, ego_ned_m, said)
        if not self._gated:
            return neighbours
        return [n._replace(in_formation=False) if n.vehicle_id in self._gated else n for n in neighbours]

    def joined(self, motion: FleetTrajectory) -> Graph:
        """Who is whose neighbour in a motion's slots, where the nearest are."""
        if self._joined is None or self._joined[0] is not motion:
            after = {i: change.after for i, change in motion.slots.items()}
            self._joined = motion, mutual_nearest(after, self.limits.nearest)
        return self._joined[1]

    def _predict(
        self, peer: Peer, track: Track, ego_ned_m: Ned, now: Instant, reference: Reference, own: Ned, shared: Reference
    ) -> Neighbour:
        limits, sample = self.limits, track.sample
        follows = sample.phase in FORMATION_PHASES
        tau_s = max(0.0, (now.fleet_ns - sample.time_ns) * 1e-9)
        if now.fleet_ns > track.due_ns and track.lost_at_ns is None and aloft(sample):
            track.fall_silent()
        uncertainty, told = limits.uncertainty_m, sample.told
        other_end: Ned | None = None
        lost_at_ns = track.lost_at_ns
        if lost_at_ns is not None and aloft(sample):
            since_s = (now.fleet_ns - lost_at_ns) * 1e-9
            uncertainty += min(UNCERTAINTY_GROWTH_M_S * max(since_s, 0.0), UNCERTAINTY_GROWTH_MAX_M)
            position, velocity, other_end = nearest_piece(track, ego_ned_m, now.fleet_ns, self.foresight)
        else:
            position, velocity, told = self.foresight.under(shared, sample, track.reference_then, now.fleet_ns)
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
        offset = new(Ned, (own.north - slot.north, own.east - slot.east, own.down - slot.down))
        return new(
            Neighbour,
            (
                sample.vehicle_id, position, velocity, offset, tau_s, sound, sound, uncertainty, other_end,
                reference.velocity_ned_m_s, reference.acceleration_ned_m_s2, told,
            ),
        )  # fmt: skip
