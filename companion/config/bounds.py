"""What vehicles may rely on: how wrong they may be about each other, and the distances, times and limits that follow.

All of it comes from the tables of fleet.toml, whoever the vehicles are.
"""

from functools import cached_property
from math import sqrt

from companion.config.schema import FleetTables
from companion.core.monitor import PeerMotion
from companion.core.safety.fence import Fence
from companion.core.safety.filter import SafetyLimits, safety_radius_m
from companion.core.trajectory_check import PLAN_SPEED_SHARE, MotionLimits
from companion.core.trigger.base import Trigger
from companion.core.trigger.periodic import PeriodicTrigger

SPACING_MARGIN_M = 0.2
"""slots stay this much farther apart than separation and barrier begin to act"""
NOTICE_LOST_S = {"laptop": 4.0, "field": 2.0}
"""default of `peers.notice_lost_s` by `peers.network`: the field's is shorter since a computer that loses its power
closes no connection, a laptop's longer since an overloaded one holds its processes up"""
KEEP_ALIVES = {"laptop": 4, "field": 2}
"""so many keep-alives a session sends in `peers.notice_lost_s` to a peer to which it sends nothing else. On a laptop
that is one a second: they are most of an idle mesh's CPU. In the field each is a packet, and TCP repeats the one that
is lost"""
T_MAX_S = 10.0
SILENCES = 5.0
"""default of `trigger.t_max_s`: so many times `peers.notice_lost_s`, and T_MAX_S at most"""
EXCHANGE_DELAY_S = 0.05
"""delay to a peer, as the error bound takes it beside the control period"""
COMMAND_LAG_S = 0.15
"""from a command to the acceleration flown, as the error bound takes it: PX4's tilt on a quadrotor, and the stubs'"""


def notice_lost_s(network: str, value: float | None) -> float:
    """`peers.notice_lost_s`, or its default on that network (s)."""
    return NOTICE_LOST_S[network] if value is None else value


def t_max_default_s(notice_s: float) -> float:
    """`trigger.t_max_s` where the file leaves it out (s).

    No message need be a keep-alive: a state costs five times a keep-alive's bytes, and each that is sent takes one's
    place on its link anyway. So the longest silence is several times `notice_s`, short only where that is short.
    """
    return min(T_MAX_S, SILENCES * notice_s)


class FleetBounds(FleetTables):
    """The tables of fleet.toml with the bounds that follow from them."""

    @property
    def r0_m(self) -> float:
        """Range of separation."""
        return self.formation.spacing_m / 2 if self.law.r0_m is None else self.law.r0_m

    @cached_property
    def trigger_rule(self) -> Trigger:
        """The trigger that the bounds are computed from; each vehicle has its own."""
        return self.trigger.trigger()

    @property
    def near_rate(self) -> PeriodicTrigger:
        """When vehicles speak that are near each other."""
        return PeriodicTrigger(self.trigger.near_period_s)

    @property
    def notice_lost_s(self) -> float:
        """Within this time a peer is noticed to be gone (s): the lease of the sessions."""
        return notice_lost_s(self.peers.network, self.peers.notice_lost_s)

    @property
    def keep_alive_s(self) -> float:
        """How long a session says nothing to a peer before it sends a keep-alive (s)."""
        return self.notice_lost_s / KEEP_ALIVES[self.peers.network]

    @cached_property
    def prediction_error_m(self) -> float:
        """Bound on how far a peer that is heard may be from its prediction (m)."""
        return self.trigger_rule.error_bound_m(self.peer_motion)

    @property
    def peer_motion(self) -> PeerMotion:
        """What the vehicles must reckon with in each other.

        The law's hold brakes a vehicle that may fly at the speed limit relative to its plan; the filter may push it on
        meanwhile.
        """
        x = self.limits
        hold = self.law.holding().bounds(x.speed_max_m_s)
        return PeerMotion(
            sigma_p_m=x.position_noise_m,
            sigma_v_m_s=x.velocity_noise_m_s,
            sigma_gust_m_s2=x.gust_m_s2,
            a_max_m_s2=self.law.a_max_m_s2,
            deviation_m_s2=max(x.avoidance_acceleration_m_s2, self.law.a_max_m_s2) + hold.braking_m_s2,
            drift_m_s=hold.drift_m_s,
            speed_m_s=2.0 * x.speed_max_m_s + hold.gained_m_s,
            lag_s=COMMAND_LAG_S,
            latency_s=EXCHANGE_DELAY_S + 1.0 / x.control_rate_hz,
            t_min_s=self.trigger.t_min_s,
            t_max_s=self.trigger.t_max_s,
        )

    @property
    def radius_reason(self) -> str:
        """Where the safety radius comes from, for messages."""
        return f"{self.prediction_error_m:.2f} m of it since a peer is known no better with {self.trigger_rule.cause}"

    @property
    def safety_radius_m(self) -> float:
        """Distance that the barrier keeps from a peer that is heard (m)."""
        return safety_radius_m(self.prediction_error_m)

    @property
    def spacing_min_m(self) -> float:
        """Smallest distance of two slots that leaves separation and barrier alone (m)."""
        barrier = self.safety_radius_m if self.limits.barrier else 0.0
        return max(self.r0_m, barrier) + SPACING_MARGIN_M

    @property
    def range_min_m(self) -> float:
        """Smallest range at which peers are looked at (m): a neighbour's distance, and what two at the speed limit that
        fly at each other need to stop, after what the exchange takes."""
        x = self.limits
        speed = x.speed_max_m_s
        heard_after_s = self.peer_motion.latency_s + self.trigger.t_min_s
        braking_m = speed * heard_after_s + speed**2 / (2.0 * x.avoidance_acceleration_m_s2)
        return self.formation.spacing_m + 2.0 * braking_m

    @property
    def return_speed_m_s(self) -> float:
        """How fast the centre flies back over the pads, and the slots about it (m/s): both together within the plan's
        share of the limit."""
        return PLAN_SPEED_SHARE * self.limits.speed_max_m_s / 2

    @property
    def motion_limits(self) -> MotionLimits:
        """What every motion must keep, whoever proposes it."""
        x = self.limits
        # Slots that change places by the assignment stay 1/sqrt(2) of their distance apart (`assignment.assign`): with
        # the offsets u before and w after of a pair u.w >= 0, since exchanging the two would else cost less.
        apart_m = self.safety_radius_m / sqrt(2.0) if x.barrier else 0.0
        return MotionLimits(x.speed_max_m_s, x.climb_max_m_s, x.descent_max_m_s, apart_m, self.geofence)

    @property
    def safety_limits(self) -> SafetyLimits:
        x = self.limits
        return SafetyLimits(
            x.speed_max_m_s, x.climb_max_m_s, x.descent_max_m_s, x.jerk_max_m_s3,
            x.avoidance_acceleration_m_s2, x.barrier, self.geofence,
        )  # fmt: skip

    @cached_property
    def geofence(self) -> Fence | None:
        """The fence as the companion flies it; None if there is none."""
        x = self.fence
        if x is None:
            return None
        north, east = (0.0, 0.0) if x.centre_m is None else x.centre_m
        return Fence(
            x.floor_m, x.ceiling_m, x.radius_m, north, east, x.polygon_m or (), x.margin_m, x.vertical_margin_m
        )
