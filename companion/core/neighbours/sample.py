"""What one sample says about another time: senders and receivers call the same function, so they agree."""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from companion.core.frames import Ned
from companion.core.monitor import PeerMotion
from companion.core.neighbours.graph import NeighbourKind
from companion.core.prediction import Held, Hold, common_way, weights
from companion.core.trajectory.fleet import Reference
from companion.core.trajectory.history import TrajectoryHistory
from companion.core.values import AIRBORNE_PHASES, FORMATION_PHASES, ZERO, PeerSample, Phase

VERTICAL_DAMPING_S = 2.0
FREE_DAMPING_S = 2.0
"""time in which the velocity of a vehicle fades that follows no plan that we know: the pilot's, or one apart"""
ALOFT_M = 2.0
"""above the fleet's origin; a vehicle that is idle higher than this was found in the air by a companion that started"""


@dataclass(frozen=True, slots=True)
class PeerLimits:
    """What the table needs to know of the configuration."""

    hold: Hold
    """of vehicles in formation"""
    range_m: float
    stale_after_s: float
    """a peer silent for longer is stale: beyond T_max with its jitter"""
    heartbeat_s: float
    """T_max: every peer speaks at least so often"""
    isolated_flight_s: float
    """how long a vehicle that hears nobody flies on before it holds by itself"""
    notice_lost_s: float
    """how long after a peer's end its presence may still be reported"""
    notice_spread_s: float
    """of two that lose each other, one may notice so much later than the other"""
    uncertainty_m: float
    """bound on the prediction's error of a peer that is heard"""
    motion: PeerMotion
    """what a peer can do unseen"""
    digest_size: int
    neighbours: NeighbourKind = "range"
    """whom the law heeds (`core.neighbours.graph`)"""
    nearest: int = 7


def predict_sample(
    sample: PeerSample, reference_then: tuple[Ned, Ned], reference: Reference, fleet_ns: int, limits: PeerLimits
) -> Held:
    """What a sample foretells for `fleet_ns`: what receivers use and senders compare with.

    `reference_then` is p_ref and v_d of the sender's slot at the sample's time, `reference` the one at `fleet_ns`. A
    vehicle in formation is held by the law's hold. One that climbs or lands stays over its spot, and its vertical
    speed fades, since it ends at its altitude or on the ground; the velocity of one that flies by itself, or under
    somebody else, fades too. Whoever has landed or waits to be armed stands.
    """
    tau_s = max(0.0, (fleet_ns - sample.time_ns) * 1e-9)
    p, v = sample.position_ned_m, sample.velocity_ned_m_s
    if sample.phase in FORMATION_PHASES:
        return limits.hold.at(sample, reference_then, reference, tau_s)
    if sample.phase in (Phase.ARMED, Phase.CLIMBING, Phase.LANDING):
        w = weights("damped", tau_s, VERTICAL_DAMPING_S)
        above = Ned(p.north, p.east, p.down + w.position * v.down)
        return Held(above, Ned(0.0, 0.0, w.velocity * v.down), sample.told)
    if sample.phase in (Phase.DETACHED, Phase.RELEASED, Phase.IDLE):
        # IDLE too: a companion that starts in flight does not steer.
        w = weights("damped", tau_s, FREE_DAMPING_S)
        k, f = w.position, w.velocity
        gone = Ned(p.north + k * v.north, p.east + k * v.east, p.down + k * v.down)
        return Held(gone, Ned(*(f * x for x in v)), sample.told)
    return Held(p, ZERO, sample.told)


def aloft(sample: PeerSample) -> bool:
    """Whether a vehicle that says nothing more after this cannot be taken to stand where it was."""
    found_in_the_air = sample.phase in (Phase.IDLE, Phase.PREFLIGHT) and sample.position_ned_m.down < -ALOFT_M
    return sample.phase in AIRBORNE_PHASES or found_in_the_air


def stands(sample: PeerSample) -> bool:
    """Whether it is on the ground, as far as is known."""
    return sample.phase is Phase.ARMED or not aloft(sample)


class Foresight(NamedTuple):
    """What samples foretell under the plan that this vehicle knows."""

    history: TrajectoryHistory
    limits: PeerLimits

    def reference_then(self, sample: PeerSample) -> tuple[Ned, Ned]:
        """p_ref and v_d of the sender's slot at the sample's time."""
        reference = self.history.reference(sample.vehicle_id, sample.time_ns)
        return reference.position_ned_m, reference.velocity_ned_m_s

    def at(self, sample: PeerSample, reference_then: tuple[Ned, Ned], fleet_ns: int) -> Held:
        """What is foretold for a time."""
        reference = self.history.reference(sample.vehicle_id, fleet_ns)
        return self.under(reference, sample, reference_then, fleet_ns)

    def under(self, reference: Reference, sample: PeerSample, reference_then: tuple[Ned, Ned], fleet_ns: int) -> Held:
        """The same, where the slot's shared reference at that time is known."""
        if sample.common is not None and sample.phase in FORMATION_PHASES:
            reference_then, reference = self._with_common_motion(reference, sample, reference_then, fleet_ns)
        return predict_sample(sample, reference_then, reference, fleet_ns, self.limits)

    def _with_common_motion(
        self, reference: Reference, sample: PeerSample, reference_then: tuple[Ned, Ned], fleet_ns: int
    ) -> tuple[tuple[Ned, Ned], Reference]:
        """What stands for p_ref and v_d, then and now, of a sample made where no motion was shared.

        The slot goes the way that is shared, and the sender's common motion on top as long as none is. A motion that
        takes over begins where the fleet is by then, wherever that is: only the way since counts.
        """
        common, then_ns, history = sample.common, sample.time_ns, self.history
        assert common is not None
        shared_then, v_then = reference_then
        free_s = max(0.0, (fleet_ns - then_ns) * 1e-9)
        motion, now = history.at(then_ns), history.at(fleet_ns)
        if not motion.free_at(then_ns):
            # Its sender did not know of the motion that all shared by then.
            return reference_then, reference
        way = [b - a for a, b in zip(shared_then, reference.position_ned_m, strict=True)]
        if motion is not now:
            way, free_s = [0.0, 0.0, 0.0], 0.0
            starts = sorted(m.start_ns for m in history.motions if then_ns < m.start_ns < fleet_ns)
            for from_ns, to_ns in pairwise((then_ns, *starts, fleet_ns)):
                motion = history.at(from_ns)
                a, b = (motion.reference(sample.vehicle_id, t).position_ned_m for t in (from_ns, to_ns))
                way = [w + q - p for w, p, q in zip(way, a, b, strict=True)]
                if motion.free_at(from_ns):
                    free_s += (to_ns - from_ns) * 1e-9
        gone = common_way(common, free_s)
        v = reference.velocity_ned_m_s
        if now.free_at(fleet_ns):
            v = Ned(v.north + gone.north_m_s, v.east + gone.east_m_s, v.down)
        return (
            (ZERO, Ned(v_then.north + common.north_m_s, v_then.east + common.east_m_s, v_then.down)),
            Reference(Ned(way[0] + gone.north_m, way[1] + gone.east_m, way[2]), v, ZERO, 0.0, shared=False),
        )
