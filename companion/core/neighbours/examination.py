"""The examination of samples: whether one vehicle can have said them.

One rule for every sample, whatever brought it: does a track explain it? What no vehicle can have flown since the
track's last sample is another vehicle's, or a lie.
"""

from collections.abc import Sequence
from itertools import pairwise
from math import dist, hypot

from companion.core.failsafe import FROZEN_S
from companion.core.health import MOVING_M_S
from companion.core.neighbours.lost import possible_path
from companion.core.neighbours.sample import ALOFT_M, Foresight, aloft, stands
from companion.core.neighbours.track import Track
from companion.core.values import FLYING_PHASES, Instant, PeerSample, Phase
from companion.core.vectors import closest_point_parameter, lerp

PEER_ACCELERATION_M_S2 = 8.0
PEER_SPEED_M_S = 8.0
"""no peer flies further than this in a second"""
PEER_MARGIN_M = 1.0
PEER_MARGIN_M_S = 1.0
"""a sample further from what was foreseen than this and PEER_ACCELERATION_M_S2 explain opens another track"""
UNTOLD_S = 1.0
"""a peer that leaves what is foreseen of it speaks at once: it accelerates no longer than this without being heard"""
LOST_NEAR_M = 5.0
"""one that was lost is believed to be the same if it comes back so near the path it was lost on, or beneath it"""
CARRIED_S = 120.0
"""a vehicle that was lost in the air, and tells from elsewhere that it stands on the ground, is believed after so long:
from the highest ceiling (50 m) a landing at 0.7 m/s takes 71 s, and it must be carried away after that"""


def explains(track: Track, sample: PeerSample, foresight: Foresight) -> bool:
    """Whether a sample and a track's last can be of one vehicle."""
    before, after = track.sample, sample
    if track.lost_at_ns is not None and aloft(before):
        return comes_back(track, sample, foresight)
    reference_then = track.reference_then
    if after.time_ns < before.time_ns:
        before, after = after, before
        reference_then = foresight.reference_then(before)
    if stands(before) and stands(after):
        return True  # on the ground estimators start anew, and vehicles are carried
    high = before.position_ned_m.down < -ALOFT_M
    if high and before.phase in FLYING_PHASES - {Phase.LANDING} and stands(after):
        return False  # nobody lands without having been landing
    p, v, _ = foresight.at(before, reference_then, after.time_ns)
    dt_s = min((after.time_ns - before.time_ns) * 1e-9, UNTOLD_S)
    reach = min(0.5 * PEER_ACCELERATION_M_S2 * dt_s, PEER_SPEED_M_S) * dt_s
    margin = max(PEER_MARGIN_M, foresight.limits.uncertainty_m)
    if not dist(p, after.position_ned_m) <= margin + reach:
        return False
    if stands(before) or stands(after):
        return True
    return dist(v, after.velocity_ned_m_s) <= PEER_MARGIN_M_S + PEER_ACCELERATION_M_S2 * dt_s


def leads_to(track: Track, sample: PeerSample, foresight: Foresight) -> bool:
    """Whether a vehicle on that track can have flown to where a sample that it does not explain has it."""
    q = sample.position_ned_m
    dt_s = abs(sample.time_ns - track.sample.time_ns) * 1e-9
    if not dist(track.sample.position_ned_m, q) <= PEER_MARGIN_M + PEER_SPEED_M_S * dt_s:
        return False
    p = foresight.at(track.sample, track.reference_then, sample.time_ns).position_ned_m
    return aloft(sample) or hypot(p.north - q.north, p.east - q.east) <= LOST_NEAR_M


def comes_back(track: Track, sample: PeerSample, foresight: Foresight) -> bool:
    """Whether a sample is of a vehicle that was lost in the air: it is near where that may be, or beneath it."""
    path, _ = possible_path(track, max(sample.time_ns, track.stopped_ns), foresight)
    q = sample.position_ned_m
    for a, b in pairwise(path):
        p = lerp(a, b, closest_point_parameter(q._replace(down=a.down), a, b))
        if hypot(p.north - q.north, p.east - q.east) <= LOST_NEAR_M and q.down >= p.down - LOST_NEAR_M:
            return True
    return False


def frozen(track: Track, sample: PeerSample) -> bool:
    """Whether it moves without changing its position."""
    steered = FLYING_PHASES - {Phase.ARMED}
    return (
        track.sample.phase in steered
        and sample.phase in steered
        and sample.position_ned_m == track.sample.position_ned_m
        and hypot(*sample.velocity_ned_m_s) > MOVING_M_S
        and sample.time_ns - track.same_since_ns >= FROZEN_S * 1e9
    )


def undisproved(tracks: Sequence[Track], stale_ns: int, now: Instant) -> list[Track]:
    """The tracks of a peer that are not disproved.

    Disproved is one that has not been told of for as long as a peer may be silent (`stale_ns`), while another was that
    it can have led to; one that stood on the ground; and one in the air, once another has been told of for CARRIED_S
    without it.
    """

    def disproves(other: Track, track: Track) -> bool:
        told_ns = other.sample.time_ns
        since_ns = max(track.sample.time_ns, other.first_ns)
        if told_ns <= track.sample.time_ns:
            return False
        if other.reached or not aloft(track.sample):
            return now.fleet_ns - since_ns > stale_ns
        return told_ns - since_ns > CARRIED_S * 1e9

    return [t for t in tracks if not any(disproves(other, t) for other in tracks)]
