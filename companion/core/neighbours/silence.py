"""Silence: from when a peer that says nothing is lost, and from when a vehicle hears nobody.

A peer that misses its heartbeats while others are heard may have stopped at any time since its last sample. When all
miss theirs at once, the link is gone and not they: each flies on until it, too, has heard nobody for `deaf_after_ns`.
Since all hear the same, each knows when that is for every other, but for its own messages.
"""

from collections.abc import Collection

from companion.core.neighbours.sample import PeerLimits
from companion.core.neighbours.track import Peer

MISSING_HEARTBEATS = 12
"""so many heartbeats, due from all peers together, are not lost by chance: 0.5^12 is 0.02 %"""
HEARTBEAT_MARGIN_S = 0.5
"""a heartbeat may be under way for so long"""
STANDING_S = 1.0
"""braking to a stand"""


def reckon(peers: Collection[Peer], limits: PeerLimits) -> int | None:
    """Set when each track is lost if nothing more is heard of it.

    Returns the fleet time from which nobody is heard if nothing comes before; None unless several are said to be there.
    """
    stale_ns, isolated_ns = round(limits.stale_after_s * 1e9), round(limits.isolated_flight_s * 1e9)
    overdue_ns = round((limits.heartbeat_s + HEARTBEAT_MARGIN_S) * 1e9)
    for peer in peers:
        for track in peer.tracks:
            track.due_ns, track.due_stopped_ns = track.sample.time_ns + stale_ns, track.sample.time_ns
            track.due_flown_ns = track.due_ns + isolated_ns
    heard = [p.tracks[0] for p in peers if p.tracks and p.present]
    if len(heard) < 2:
        return None
    newest_ns, second_ns = sorted((t.sample.time_ns for t in heard), reverse=True)[:2]
    deaf_ns = deaf_after_ns(len(heard), limits)
    common = [t for t in heard if t.sample.time_ns + overdue_ns >= newest_ns]
    oldest_ns = min(t.sample.time_ns for t in common)
    stood_ns = max(newest_ns, oldest_ns + overdue_ns) + deaf_ns + round(STANDING_S * 1e9)
    for track in common:
        others_ns = second_ns if track.sample.time_ns == newest_ns else newest_ns
        if track.sample.time_ns <= others_ns + deaf_ns:
            track.due_ns = track.due_stopped_ns = others_ns + deaf_ns
            track.due_flown_ns = stood_ns
    return newest_ns + deaf_ns


def deaf_after_ns(count: int, limits: PeerLimits) -> int:
    """After how long without any state from `count` peers that are said to be there none can come any more.

    Of few peers that would last longer than it takes a vehicle alone to stand.
    """
    heartbeats = max(1.0, MISSING_HEARTBEATS / max(count, 1))
    alone_s = limits.stale_after_s + limits.isolated_flight_s
    return round(min(alone_s, heartbeats * limits.heartbeat_s + HEARTBEAT_MARGIN_S) * 1e9)
