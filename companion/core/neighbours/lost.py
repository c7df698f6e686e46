"""Where a peer may be that has ended or fallen silent: from where it may have stopped to where it may have flown."""

from math import dist, hypot

from companion.core.frames import Ned
from companion.core.neighbours.sample import Foresight, predict_sample
from companion.core.neighbours.track import Track
from companion.core.safety.filter import DOWNWASH_RATIO
from companion.core.trajectory.fleet import Reference
from companion.core.values import FILTERED_PHASES, FORMATION_PHASES, ZERO, Phase
from companion.core.vectors import nearest_on_path, off_chord, piece_about

PATH_STEP_NS = 500_000_000
"""between two points of a path that is kept"""
STRAIGHT_M = 0.05
"""a path that bends no further than this is one straight piece"""
PIECE_M = 0.1
"""of a curved one, so much to either side of the nearest place is taken as straight"""
_NOWHERE = Reference(ZERO, ZERO, ZERO, 0.0)


def possible_path(track: Track, fleet_ns: int, foresight: Foresight) -> tuple[list[Ned], Ned]:
    """Where a lost peer may be, from where it may have stopped to where it is if it flew on, and how fast.

    One whose presence ended was seen alive until shortly before, so it stopped no earlier than `notice_lost_s`
    before that; one that fell silent by itself may have stopped at any time since its last sample (`silence` says
    what holds when all fall silent at once). A vehicle that hears nobody holds by itself after `isolated_flight_s`,
    and notices that no more than `notice_spread_s` later, so it flew on no longer than that. One that was armed,
    climbed or landed is somewhere in the column between there and its altitude, or the ground; so is one in whose
    flight a companion started.
    """
    sample = track.sample
    last = sample.position_ned_m
    if sample.phase not in FORMATION_PHASES:
        slot = foresight.history.reference(sample.vehicle_id, sample.time_ns).position_ned_m
        top, ground = min(slot.down, last.down), max(0.0, last.down)
        ends = {Phase.ARMED: top, Phase.CLIMBING: top, Phase.LANDING: ground}
        if sample.phase in ends:
            return [last, last._replace(down=ends[sample.phase])], ZERO
        p, v, _ = predict_sample(sample, (ZERO, ZERO), _NOWHERE, fleet_ns, foresight.limits)
        if sample.phase is Phase.RELEASED or sample.phase in FILTERED_PHASES:
            return [last, p], v
        return [last, p._replace(down=max(p.down, ground))], ZERO
    end_ns = max(min(fleet_ns, track.flown_ns), track.stopped_ns)
    while (next_ns := track.stopped_ns + len(track.path) * PATH_STEP_NS) < end_ns or not track.path:
        track.path.append(foresight.at(sample, track.reference_then, next_ns).position_ned_m)
    end, velocity, _ = foresight.at(sample, track.reference_then, end_ns)
    return [*track.path, end], velocity if fleet_ns < track.flown_ns else ZERO


def nearest_piece(track: Track, ego_ned_m: Ned, fleet_ns: int, foresight: Foresight) -> tuple[Ned, Ned, Ned]:
    """The straight piece of a lost peer's path that is nearest: both its ends, the first with its velocity.

    A straight path is one piece. Of a curved one, the velocity is such that the nearest place, which lies within
    the piece, moves as fast as one that far along the path: from nothing where the peer stopped to all of it where
    it flies on.
    """
    path, velocity = possible_path(track, fleet_ns, foresight)
    if off_chord(path) <= STRAIGHT_M:
        return path[-1], velocity, path[0]
    edge, share = nearest_on_path(ego_ned_m, path, DOWNWASH_RATIO)
    front, back, at = piece_about(path, edge, share, PIECE_M)
    if velocity != ZERO and at < 1.0:
        a, b = path[edge], path[edge + 1]
        scale = (edge + share) / (len(path) - 1) / (1.0 - at) * hypot(*velocity) / max(dist(a, b), 1e-9)
        velocity = Ned(scale * (b.north - a.north), scale * (b.east - a.east), scale * (b.down - a.down))
    return front, velocity, back
