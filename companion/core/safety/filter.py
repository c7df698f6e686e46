"""The safety filter: the last thing between a command and the autopilot. It knows nothing of the law.

Priority, highest first: finite, distance to peers, fence, acceleration, speed, jerk. Nothing below delays what stands
above: where peers and fence cannot both be kept, the peers are, and of the commands that do so the one that misses the
fence least is flown.

Distance is kept by an exponential control barrier per pair. With x = p_i - p^_j, vertical lengths divided by
c = 2.5 (a multirotor's downwash), d the safety radius of the pair and both poles at 2.5 /s,

    h = |x|^2 - d^2,      h'' + 5 h' + 6.25 h >= 0

is a half-plane for the horizontal command u: g.u >= b. Altitude is flown by position, so u has no vertical part. Of a
pair whose filters are both active each takes half; toward anybody else this vehicle takes all. It is written divided by
2 |x|, so that g is the part of the direction from the peer that is level, b an acceleration of the distance, and what
is missing the acceleration at which the distance falls short: so a near peer's is compared with a far one's, and with a
wall's, where not all can be kept. The command nearest to the law's that satisfies every half-plane and the acceleration
limit is flown (`core.safety.avoidance`): a small program, solved exactly in `core.safety.program`.

The fence's walls are half-planes of the same kind (`core.safety.fence`). Altitude is limited where it is flown: the
position sent stays between floor and ceiling, and the velocity sent ends there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import copysign, hypot, isfinite, sqrt
from typing import NamedTuple

from companion.core.counts import Counts
from companion.core.estimate import VelocityReference
from companion.core.frames import Ned
from companion.core.safety.avoidance import avoid
from companion.core.safety.fence import Fence, braking_pole_per_s, wall_plane
from companion.core.values import Command, Neighbour, SafeSetpoint, VehicleState
from companion.core.vectors import closest_point_parameter, lerp

DOWNWASH_RATIO = 2.5
"""vertical half-axis of the safety ellipsoid over its horizontal one"""
POLE_PER_S = 2.5
COLLISION_DISTANCE_M = 0.5
LAG_ALLOWANCE_M = 0.15
SPEED_APPROACH_PER_S = 2.0
"""how fast the speed may approach its limit: acceleration along the velocity per what is left"""
BIAS_MAX_M_S = 1.0
"""most of the estimator's velocity bias, per axis, that is put back into what is sent: PX4's is 0.15-0.25 m/s. It is
added after the speed limit, so that no more than speed_max + 1.42 m/s is ever sent"""
ALTITUDE_APPROACH_PER_S = 1.0
"""how fast the vertical velocity sent may lead to floor or ceiling: per metre that is left"""
FENCE_MISS_M_S2 = 0.01
"""from this on a fence that is not kept is counted"""
ROUNDED_M_S2 = 1e-6
"""less than this is missed by rounding only"""
FAR_M = 1e6
"""a peer said to be farther than this is looked at in full, since its numbers may not be finite ones"""


@dataclass(frozen=True, slots=True)
class SafetyLimits:
    """Limits on every setpoint."""

    speed_max_m_s: float
    """horizontal"""
    climb_max_m_s: float
    descent_max_m_s: float
    jerk_max_m_s3: float
    avoidance_acceleration_m_s2: float
    """horizontal; what avoidance may use, beyond the law's own limit"""
    barrier: bool = True
    """keep the distance to peers"""
    fence: Fence | None = None
    """kept whether or not the distance to peers is"""


class HalfPlane(NamedTuple):
    """g.u >= b for the horizontal command u (m/s^2)."""

    g_north: float
    g_east: float
    b: float
    """m/s^2 where |g| is 1; see above"""
    vehicle_id: int = 0
    """whose distance it keeps; 0: a wall's"""
    v_north: float = 0.0
    """velocity of the obstacle (m/s)"""
    v_east: float = 0.0


def safety_radius_m(neighbour_uncertainty_m: float) -> float:
    """Distance kept from a prediction (m): a collision's, what lag costs, and the prediction's own error."""
    return COLLISION_DISTANCE_M + LAG_ALLOWANCE_M + neighbour_uncertainty_m


def nearest_hypothesis(position: Ned, neighbour: Neighbour) -> tuple[Ned, Ned]:
    """Where on the line between a lost peer's two possible ends it is nearest to us, and how fast that point moves.

    For a peer that is heard there is one place, its prediction.
    """
    a, v, b = neighbour.position_ned_m, neighbour.velocity_ned_m_s, neighbour.last_seen_ned_m
    if b is None:
        return a, v
    share = closest_point_parameter(position, a, b, DOWNWASH_RATIO)
    moving = 1.0 - share
    return lerp(a, b, share), Ned(moving * v.north, moving * v.east, moving * v.down)


def half_plane(ego: VehicleState, shared_acceleration: Ned, neighbour: Neighbour) -> HalfPlane:
    """The barrier of one pair as a half-plane for the own horizontal command.

    `shared_acceleration` is what the plan asks of the own slot (m/s^2). Toward a peer that shares the avoidance the
    command counts relative to the mean of both slots', the same for both of the pair, so that their halves make up a
    whole; toward any other it counts in full.
    """
    p, v = nearest_hypothesis(ego.position_ned_m, neighbour)
    q = ego.position_ned_m
    w = ego.velocity_ned_m_s
    x, y = q.north - p.north, q.east - p.east
    z = (q.down - p.down) / DOWNWASH_RATIO
    vx, vy = w.north - v.north, w.east - v.east
    vz = (w.down - v.down) / DOWNWASH_RATIO
    if neighbour.last_seen_ned_m is not None:
        vx, vy, vz = _across_segment(q, neighbour, vx, vy, vz)
    d = safety_radius_m(neighbour.uncertainty_m)
    s, t = shared_acceleration, neighbour.reference_acceleration_ned_m_s2
    g_north, g_east, b = barrier(
        x, y, z, vx, vy, vz, d, neighbour.shares_avoidance, 0.5 * (s.north + t.north), 0.5 * (s.east + t.east)
    )
    return HalfPlane(g_north, g_east, b, neighbour.vehicle_id, v.north, v.east)


def _across_segment(position: Ned, neighbour: Neighbour, vx: float, vy: float, vz: float) -> tuple[float, float, float]:
    """The part of a relative velocity (vertical divided by c) that changes the distance to a lost peer's segment.

    Beside the segment the nearest place slides along with us, so that moving along it turns no distance: counted as
    motion past a point it would seem to carry us away, and the filter would let us in.
    """
    a, b = neighbour.position_ned_m, neighbour.last_seen_ned_m
    if b is None or not 0.0 < closest_point_parameter(position, a, b, DOWNWASH_RATIO) < 1.0:
        return vx, vy, vz
    x, y, z = b.north - a.north, b.east - a.east, (b.down - a.down) / DOWNWASH_RATIO
    along = (vx * x + vy * y + vz * z) / (x * x + y * y + z * z)
    return vx - along * x, vy - along * y, vz - along * z


def barrier(
    x: float, y: float, z: float, vx: float, vy: float, vz: float, d: float, shared: bool,
    shared_north: float, shared_east: float,
) -> tuple[float, float, float]:  # fmt: skip
    """(g_north, g_east, b) of g.u >= b for the relative position and velocity, vertical already divided by c."""
    if x * x + y * y < 1e-6:
        # Exactly above one another the gradient vanishes: the lower one leaves to the north-east, the upper one away.
        x = y = copysign(1e-3, z)
    h = x * x + y * y + z * z - d * d
    h_rate = 2.0 * (x * vx + y * vy + z * vz)
    drift = 2.0 * (vx * vx + vy * vy + vz * vz) + 2.0 * POLE_PER_S * h_rate + POLE_PER_S * POLE_PER_S * h
    g_north, g_east = 2.0 * x, 2.0 * y
    half = -0.5 * drift + g_north * shared_north + g_east * shared_east
    # Two that touch already are not let outweigh all others.
    size = 2.0 * max(sqrt(x * x + y * y + z * z), COLLISION_DISTANCE_M)
    return g_north / size, g_east / size, (half if shared else -drift) / size


def out_of_reach(ego: VehicleState, shared_acceleration: Ned, neighbour: Neighbour, most_m_s2: float) -> bool:
    """Whether every command up to `most_m_s2` satisfies the pair's half-plane, told from the distance alone.

    With r the distance (vertical lengths divided by c), w the relative speed, p the pole, d the safety radius, U the
    largest command and S that of both slots' plan: |g| <= 1 and h' >= -2 r w, so that

        p^2 (r^2 - d^2) - 4 p r w - k r >= 0,   k = 2 U, or 4 (U + S) where each of a pair takes half

    is enough for 2 r g.u >= 2 r b. It holds for all r >= d + (4 p w + k)/p^2. A lost peer's line is always looked at in
    full.
    """
    if neighbour.last_seen_ned_m is not None:
        return False
    p, q = neighbour.position_ned_m, ego.position_ned_m
    v, w = neighbour.velocity_ned_m_s, ego.velocity_ned_m_s
    x, y, z = q.north - p.north, q.east - p.east, (q.down - p.down) / DOWNWASH_RATIO
    vx, vy, vz = w.north - v.north, w.east - v.east, (w.down - v.down) / DOWNWASH_RATIO
    k = 2.0 * most_m_s2
    if neighbour.shares_avoidance:
        s, t = shared_acceleration, neighbour.reference_acceleration_ned_m_s2
        k = 4.0 * (most_m_s2 + 0.5 * hypot(s.north + t.north, s.east + t.east))
    speed = sqrt(vx * vx + vy * vy + vz * vz)
    reach = safety_radius_m(neighbour.uncertainty_m) + (4.0 * POLE_PER_S * speed + k) / POLE_PER_S**2
    return reach * reach <= x * x + y * y + z * z < FAR_M * FAR_M


def resting_push_m_s2(distance_m: float, radius_m: float) -> float:
    """`push_m_s2` of a pair that rests at a level distance and shares the avoidance, with its safety radius (m/s^2)."""
    return push_m_s2(HalfPlane(*barrier(distance_m, 0.0, 0.0, 0.0, 0.0, 0.0, radius_m, True, 0.0, 0.0)))


def push_m_s2(plane: HalfPlane) -> float:
    """The push toward the peer that would just break its half-plane, -b/|g| (m/s^2); negative: it is broken at rest."""
    return -plane.b / max(hypot(plane.g_north, plane.g_east), 1e-6)


ACTING = (
    "not finite", "peer not finite: braking", "command not finite: braking", "speed", "jerk", "acceleration",
    "velocity bias", "altitude", "outside the fence", "fence", "fence not attainable", "peer distance",
    "peer distance not attainable",
)  # fmt: skip
"""what the filter counts"""


@dataclass(slots=True)
class SafetyFilter:
    """One vehicle's filter: makes every SafeSetpoint that is sent."""

    limits: SafetyLimits
    counts: Counts = field(default_factory=lambda: Counts(ACTING))
    """how often which limit acted, by tick"""
    velocity_reference: VelocityReference = field(default_factory=VelocityReference)
    acceleration_m_s2: tuple[float, float] = (0.0, 0.0)
    """what was flown last: horizontal, after the filter"""
    peer_planes: list[HalfPlane] = field(default_factory=list)
    """the half-planes of the peers within reach, as of the last command"""
    _acted: set[str] = field(default_factory=set)
    """which limits acted in this tick"""

    def reset(self) -> None:
        """Start anew: on engaging."""
        self.velocity_reference.reset()
        self.acceleration_m_s2 = (0.0, 0.0)

    def apply(
        self,
        command: Command,
        ego: VehicleState,
        neighbours: Sequence[Neighbour],
        velocity_bias_ned_m_s: Ned,
        dt_s: float,
    ) -> SafeSetpoint | None:
        """The setpoint for a command, or None if nothing finite can be said (nothing is sent then).

        `ego` is the own state, its velocity free of the estimator's bias; `velocity_bias_ned_m_s` goes back into the
        velocities sent, which the autopilot compares with its own biased ones.
        """
        self._acted.clear()
        inputs = (
            *ego.position_ned_m, *ego.velocity_ned_m_s, *velocity_bias_ned_m_s, dt_s, command.yaw_rad,
            *command.reference_position_ned_m, *command.reference_velocity_ned_m_s,
            *command.reference_acceleration_ned_m_s2,
        )  # fmt: skip
        if not all(map(isfinite, inputs)):
            self.counts["not finite"] += 1
            return None
        wanted = command.acceleration_ned_m_s2
        v_north, v_east, _ = ego.velocity_ned_m_s
        planes: list[HalfPlane] = []
        unknown = 0
        if self.limits.barrier:
            shared, most = command.reference_acceleration_ned_m_s2, self.limits.avoidance_acceleration_m_s2
            planes = [half_plane(ego, shared, n) for n in neighbours if not out_of_reach(ego, shared, n, most)]
            known = [p for p in planes if isfinite(p.g_north + p.g_east + p.b)]
            unknown, planes = len(planes) - len(known), known
        self.peer_planes = planes
        if unknown:
            self._acted.add("peer not finite: braking")
            u = self._clipped(-v_north, -v_east)
        elif isfinite(wanted.north) and isfinite(wanted.east):
            u = self._limited(wanted.north, wanted.east, v_north, v_east, dt_s)
        else:
            self._acted.add("command not finite: braking")
            u = self._clipped(-v_north, -v_east)
        u = self._kept(u, v_north, v_east, planes, self._walls(ego))
        self.acceleration_m_s2 = u
        north, east = self.velocity_reference.step(u[0], u[1], v_north, v_east, dt_s)
        speed = hypot(north, east)
        if speed > self.limits.speed_max_m_s:
            self._acted.add("speed")
            north, east = (x * self.limits.speed_max_m_s / speed for x in (north, east))
        bias = self._bounded(velocity_bias_ned_m_s)
        north, east = north + bias.north, east + bias.east
        position_down, velocity_down = self._vertical(command, ego)
        velocity_down += bias.down
        if self._acted:
            self.counts.update(self._acted)
        if not isfinite(u[0] + u[1] + north + east):
            # Finite inputs so large that their products are not.
            self.counts["not finite"] += 1
            self.reset()
            return None
        return SafeSetpoint(
            velocity_north_m_s=north,
            velocity_east_m_s=east,
            velocity_down_m_s=min(max(velocity_down, -self.limits.climb_max_m_s), self.limits.descent_max_m_s),
            acceleration_north_m_s2=u[0],
            acceleration_east_m_s2=u[1],
            position_down_m=position_down,
            yaw_rad=command.yaw_rad,
        )

    def _limited(
        self, u_north: float, u_east: float, v_north: float, v_east: float, dt_s: float
    ) -> tuple[float, float]:
        limits = self.limits
        last_north, last_east = self.acceleration_m_s2
        step = hypot(u_north - last_north, u_east - last_east)
        most = limits.jerk_max_m_s3 * max(dt_s, 1e-3)
        if step > most:
            self._acted.add("jerk")
            u_north = last_north + (u_north - last_north) * most / step
            u_east = last_east + (u_east - last_east) * most / step
        speed = hypot(v_north, v_east)
        if speed > 1e-3:
            along = (u_north * v_north + u_east * v_east) / speed
            allowed = SPEED_APPROACH_PER_S * (limits.speed_max_m_s - speed)
            if along > allowed:
                self._acted.add("speed")
                u_north += (allowed - along) * v_north / speed
                u_east += (allowed - along) * v_east / speed
        return self._clipped(u_north, u_east)

    def _clipped(self, u_north: float, u_east: float) -> tuple[float, float]:
        size = hypot(u_north, u_east)
        most = self.limits.avoidance_acceleration_m_s2
        if size <= most:
            return u_north, u_east
        self._acted.add("acceleration")
        return u_north * most / size, u_east * most / size

    def _bounded(self, bias: Ned) -> Ned:
        if max(abs(bias.north), abs(bias.east), abs(bias.down)) <= BIAS_MAX_M_S:
            return bias
        self._acted.add("velocity bias")
        return Ned(*(min(max(x, -BIAS_MAX_M_S), BIAS_MAX_M_S) for x in bias))

    def _vertical(self, command: Command, ego: VehicleState) -> tuple[float, float]:
        """Down (m) and downward velocity (m/s) to send, within floor and ceiling and not leading beyond them."""
        down, v = command.reference_position_ned_m.down, command.reference_velocity_ned_m_s.down
        fence = self.limits.fence
        if fence is None:
            return down, v
        held = min(max(down, fence.highest_down_m), fence.lowest_down_m)
        up = ALTITUDE_APPROACH_PER_S * max(min(held, ego.position_ned_m.down) - fence.highest_down_m, 0.0)
        below = ALTITUDE_APPROACH_PER_S * max(fence.lowest_down_m - max(held, ego.position_ned_m.down), 0.0)
        kept = min(max(v, -up), below)
        if held != down or kept != v:
            self._acted.add("altitude")
        return held, kept

    def _walls(self, ego: VehicleState) -> list[HalfPlane]:
        """The fence's half-planes."""
        limits = self.limits
        if limits.fence is None:
            return []
        (north, east, _), (v_north, v_east, _) = ego.position_ned_m, ego.velocity_ned_m_s
        if not limits.fence.contains(ego.position_ned_m):
            self._acted.add("outside the fence")
        pole = braking_pole_per_s(limits.speed_max_m_s, limits.avoidance_acceleration_m_s2)
        return [HalfPlane(*wall_plane(wall, v_north, v_east, pole)) for wall in limits.fence.walls(north, east)]

    def _kept(
        self, u: tuple[float, float], v_north: float, v_east: float, peers: Sequence[HalfPlane],
        walls: Sequence[HalfPlane],
    ) -> tuple[float, float]:  # fmt: skip
        """The command that keeps distances and fence, nearest to u, within the acceleration that avoidance may use."""
        most = self.limits.avoidance_acceleration_m_s2
        rows = [[p.g_north, p.g_east, p.b, p.v_north, p.v_east] for p in (*peers, *walls)]
        kept = avoid(*u, v_north, v_east, rows, len(peers), len(rows), most, [[0.0] * 3 for _ in rows])
        if kept.peer:
            self._acted.add("peer distance")
        if kept.wall:
            self._acted.add("fence")
        if kept.peers_missed_m_s2 > ROUNDED_M_S2:
            self._acted.add("peer distance not attainable")
        if kept.walls_missed_m_s2 > FENCE_MISS_M_S2:
            self._acted.add("fence not attainable")
        attained = max(kept.peers_missed_m_s2, kept.walls_missed_m_s2) <= ROUNDED_M_S2
        if (kept.peer or kept.wall) and attained and hypot(kept.north, kept.east) > most - ROUNDED_M_S2:
            self._acted.add("acceleration")
        return kept.north, kept.east
