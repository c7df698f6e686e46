"""The common motion where no plan gives one: what this vehicle takes it to be, and where that puts its slot.

The vehicle's estimate nu of the common velocity goes its own way (`core.law.consensus`) and travels with its samples.
Who has a wish takes that for nu; who flees a threat, the velocity to flee with (`core.law.evasion`). Who is not in
formation takes the mean of what it hears, and starts from that when it comes in; who hears nobody stands. Near the
fence's edge nobody keeps a nu that leads out.

The slot is where the neighbours say: the mean over them, and the vehicle itself once it is in formation, of where the
others' predictions and the slots' offsets put it. So what is far from it is far from the formation, wherever that is.
Who flees has no slot: its place is where it is.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import hypot
from typing import NamedTuple

from companion.config import FleetConfig
from companion.core.frames import Ned
from companion.core.law.consensus import STEP_MAX_S, common_velocity_rate, saturated
from companion.core.law.evasion import CALM, FLEES, NO_THREAT, UNDISTURBED, Threat, evade
from companion.core.neighbours.table import PeerTable
from companion.core.prediction import common_way
from companion.core.trajectory.fleet import FleetTrajectory, TrajectoryState
from companion.core.trajectory.legs import Leg, TurnLeg, VelocityLeg
from companion.core.trajectory_check import PLAN_SPEED_SHARE
from companion.core.values import ZERO, CommonMotion, Instant, Neighbour, VehicleState

SATURATION_M_S = 1.0
"""norm at which a difference of two estimates saturates"""
WALL_RATE_PER_S = 0.5
"""a common motion toward the fence's edge is no faster than the room left to the slot, times this"""


class Centre(NamedTuple):
    """Where the formation's centre is by what one vehicle knows, and how fast it goes on."""

    time_ns: int
    """fleet time"""
    position_ned_m: Ned
    velocity_ned_m_s: Ned


@dataclass(frozen=True, slots=True)
class Wish:
    """Where an informed vehicle wants the fleet to go: a velocity as a function of fleet time."""

    motion: FleetTrajectory
    """of which the centre's velocity counts, and no place"""

    def at(self, fleet_ns: int) -> tuple[Ned, Ned]:
        """Velocity (m/s) and acceleration (m/s^2)."""
        now = self.motion.state_at(fleet_ns).centre
        return now.velocity, now.acceleration


class Agreement:
    """One vehicle's part in agreeing on the common motion."""

    def __init__(self, config: FleetConfig, vehicle_id: int, peers: PeerTable) -> None:
        self.wish: Wish | None = None
        """of an informed vehicle; a shared motion ends it"""
        self.told: CommonMotion | None = None
        """what goes with the own samples; None where a motion is shared, and out of formation"""
        self.centre: Centre | None = None
        """None where a motion is shared"""
        self._threat, self._threat_ns = NO_THREAT, 0
        """what is fled, and since when it is there (fleet time); a shared motion ends it"""
        self._evasion = UNDISTURBED
        self._config = config
        self._id = vehicle_id
        self._peers = peers
        self._speed_max_m_s = PLAN_SPEED_SHARE * config.limits.speed_max_m_s
        self._velocity = self._acceleration = ZERO
        self._slot: Ned | None = None
        """the own slot's place, of the tick before"""
        self._time_ns: int | None = None
        """fleet time of the step before; None: a motion was shared"""
        self._followed = False
        """whether the vehicle was in formation while a motion was shared, in the tick before"""

    # -- what an operator wishes ---------------------------------------------------------------------------------------

    def inform(self, legs: tuple[Leg, ...], fleet_ns: int) -> None:
        """Take a wish, from the present common velocity on; without legs there is none any more."""
        self.wish = self._wish(legs, fleet_ns) if legs else None

    def refusal(self, leg: Leg) -> str | None:
        """Why a leg cannot be a wish; None if it can."""
        match leg:
            case VelocityLeg(velocity_ned_m_s=v):
                speed = hypot(v.north, v.east)
                if v.down != 0.0:
                    return "a wish is level: the altitude is shared"
                if speed > self._speed_max_m_s:
                    return f"it flies at {speed:.2f} m/s, may {self._speed_max_m_s:g} m/s"
                return None
            case TurnLeg():
                return None
        return "a wish is a velocity or a turn: nobody has a place that the others share"

    def _wish(self, legs: tuple[Leg, ...], fleet_ns: int) -> Wish:
        return Wish(
            replace(
                self._config.first_motion, legs_start_ns=fleet_ns, start_ns=fleet_ns, velocity_ned_m_s=self._velocity,
                legs=legs,
            )
        )  # fmt: skip

    # -- what is fled --------------------------------------------------------------------------------------------------

    def scare(self, threat: Threat, begins_ns: int) -> None:
        """Flee a threat from that fleet time on, whenever it is near; it takes the place of the one before."""
        self._threat, self._threat_ns = threat, begins_ns

    @property
    def flees(self) -> bool:
        """Whether the vehicle flees: it holds no place in the formation then."""
        return self._evasion.doing == FLEES

    def _undisturbed(self) -> None:
        """Nothing is fled, and the common velocity was what it is."""
        v = self._velocity
        self._evasion = UNDISTURBED._replace(calm_north_m_s=v.north, calm_east_m_s=v.east)

    def _evade(self, ego: VehicleState, now: Instant) -> bool:
        """One step of what the vehicle does about a threat; whether that is its velocity."""
        dt_s, since_s = self._step_s(now), (now.fleet_ns - self._threat_ns) * 1e-9
        e, v, p = self._evasion, self._velocity, ego.position_ned_m
        if self.wish is not None:
            # It goes back to what it was told.
            told, _ = self.wish.at(now.fleet_ns)
            e = e._replace(calm_north_m_s=told.north, calm_east_m_s=told.east)
        self._evasion = e = evade(e, self._threat, since_s, p.north, p.east, v.north, v.east, dt_s)
        if e.doing == CALM:
            return False
        self._velocity = Ned(e.north_m_s, e.east_m_s, 0.0)
        self._acceleration = Ned(e.north_m_s2, e.east_m_s2, 0.0)
        return True

    # -- at each control tick ------------------------------------------------------------------------------------------

    def advance(
        self, plan: FleetTrajectory, shared: TrajectoryState, ego: VehicleState, heard: Iterable[Neighbour], part: bool,
        now: Instant,
    ) -> TrajectoryState:  # fmt: skip
        """The motion at this moment with the common one in it; `heard`: the neighbours as last predicted, `part`: the
        vehicle is in formation."""
        if not plan.free_at(now.fleet_ns):
            self._velocity, self._acceleration = shared.centre.velocity._replace(down=0.0), ZERO
            self._slot = self._time_ns = self.told = self.centre = self.wish = None
            self._threat = NO_THREAT
            self._undisturbed()
            self._followed = part
            return shared
        said = (self._peers.common_velocity_m_s(n.vehicle_id, now) for n in heard if n.in_formation)
        told = [x for x in said if x is not None]
        self._estimate(plan, told, ego, part, now)
        self._heed_fence()
        v, a = self._velocity, self._acceleration
        self.told = CommonMotion(v.north, v.east, a.north, a.east) if part else None
        self._time_ns = now.fleet_ns
        return shared._replace(centre=shared.centre._replace(velocity=v, acceleration=a))

    def _estimate(
        self, plan: FleetTrajectory, told: Sequence[tuple[float, float]], ego: VehicleState, part: bool, now: Instant
    ) -> None:
        """One step of the own estimate."""
        begins = self._time_ns is None
        if begins and part and self._followed:
            # All came from the shared motion at the same time, so all begin with its velocity.
            self._acceleration = ZERO
            if plan.issuer and self._id in self._config.plan.informed:
                assert plan.free_from_ns is not None
                self.wish = self._wish(self._config.plan_legs(ZERO), plan.free_from_ns)
        elif not part or begins:
            n = max(len(told), 1)
            self._velocity = Ned(sum(v[0] for v in told) / n, sum(v[1] for v in told) / n, 0.0)
            self._acceleration = ZERO
            self._undisturbed()
        elif self._evade(ego, now):
            pass
        elif self.wish is not None:
            self._velocity, self._acceleration = self.wish.at(now.fleet_ns)
        else:
            dt_s = self._step_s(now)
            v, a = self._velocity, self._acceleration
            # The own one as the others predict it, so that of two the one comes as much nearer as the other.
            here = common_way(CommonMotion(v.north, v.east, a.north, a.east), dt_s)
            errors = [
                saturated(here.north_m_s - north, here.east_m_s - east, 0.0, SATURATION_M_S) for north, east in told
            ]
            north, east, _ = common_velocity_rate(
                float(len(errors)), sum(e[0] for e in errors), sum(e[1] for e in errors), 0.0
            )
            self._velocity = Ned(v.north + dt_s * north, v.east + dt_s * east, 0.0)
            self._acceleration = Ned(north, east, 0.0)
        speed = hypot(self._velocity.north, self._velocity.east)
        if speed > self._speed_max_m_s:
            share = self._speed_max_m_s / speed
            self._velocity = Ned(share * self._velocity.north, share * self._velocity.east, 0.0)

    def _step_s(self, now: Instant) -> float:
        assert self._time_ns is not None
        return min((now.fleet_ns - self._time_ns) * 1e-9, STEP_MAX_S)

    def _heed_fence(self) -> None:
        """Whoever is to fly near the edge knows that the common motion does not go on there."""
        fence = self._config.geofence
        if fence is None or self._slot is None:
            return
        for wall in fence.walls(self._slot.north, self._slot.east):
            v, a = self._velocity, self._acceleration
            inward = v.north * wall.north + v.east * wall.east
            more = -WALL_RATE_PER_S * max(wall.room_m, 0.0) - inward
            if more > 0.0:
                self._velocity = Ned(v.north + more * wall.north, v.east + more * wall.east, 0.0)
                outward = min(a.north * wall.north + a.east * wall.east, 0.0)
                self._acceleration = Ned(a.north - outward * wall.north, a.east - outward * wall.east, 0.0)

    def place(
        self, plan: FleetTrajectory, moment: TrajectoryState, ego: VehicleState, neighbours: Iterable[Neighbour],
        part: bool, now: Instant,
    ) -> TrajectoryState:  # fmt: skip
        """The same with the centre where the neighbours put it, or the own slot where the vehicle is while it flees; a
        shared motion as it is."""
        if self._time_ns is None:
            return moment
        p = ego.position_ned_m
        places = [(p.north, p.east)] if part and not self.flees else []
        for n in neighbours:
            if n.in_formation:
                q, d = n.position_ned_m, n.offset_ned_m
                places.append((q.north + d.north, q.east + d.east))
        if not places:
            places = [(p.north, p.east)]
        slot = moment.slot(plan.slots[self._id]).position_ned_m
        north = sum(x for x, _ in places) / len(places)
        east = sum(y for _, y in places) / len(places)
        c = moment.centre.position
        centre = Ned(c.north + north - slot.north, c.east + east - slot.east, c.down)
        self._slot = Ned(north, east, slot.down)
        self.centre = Centre(now.fleet_ns, centre, self._velocity)
        if self.flees:
            self._slot = Ned(p.north, p.east, slot.down)
            centre = Ned(c.north + p.north - slot.north, c.east + p.east - slot.east, c.down)
        return moment._replace(centre=moment.centre._replace(position=centre))
