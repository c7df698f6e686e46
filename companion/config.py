"""fleet.toml: one file for the whole fleet, validated into frozen values.

Every key has a range and a unit (its suffix); an unknown key is refused. Names of units: `_m` metres, `_s` seconds,
`_m_s` metres per second, `_deg` degrees. The derived values that the vehicles must agree on exactly (pads, slots, the
first motion, the gains, the safety radius) are computed here from the file alone.
"""

import json
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from hashlib import blake2s
from math import ceil, inf, radians, sqrt
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

import annotated_types
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from companion.core.formation import SHAPES, Slots, centred, minimum_distance, rotated, shape_slots
from companion.core.frames import Geodetic, Ned
from companion.core.law.starling import Gains, paper_gains
from companion.core.monitor import PeerMotion
from companion.core.neighbours import PeerLimits
from companion.core.prediction import HoldKind
from companion.core.safety.fence import Fence
from companion.core.safety.filter import DOWNWASH_RATIO, SafetyLimits, safety_radius_m
from companion.core.trajectory import (
    PADS,
    FleetTrajectory,
    Leg,
    SlotChange,
    Then,
    TurnLeg,
    VelocityLeg,
    goto_leg,
    leg_end,
    top_speed_m_s,
    with_formation,
    with_legs,
    with_return,
)
from companion.core.trajectory_check import (
    ALTITUDE_MIN_M,
    DURATION_MAX_S,
    LEGS_MAX,
    PLACE_MAX_M,
    PLAN_SPEED_SHARE,
    TURN_ANGLE_MAX_DEG,
    TURN_ANGLE_MIN_DEG,
    TURN_RATE_MAX_DEG_S,
    TURN_RATE_MIN_DEG_S,
    VELOCITY_MAX_M_S,
    Fault,
    MotionLimits,
    examine,
)
from companion.core.trigger import (
    ErrorTrigger,
    PeriodicTrigger,
    Spacing,
    SwitchingTrigger,
    Trigger,
    TriggerKind,
)
from companion.core.values import ZERO
from companion.errors import ConfigError

Real = Annotated[float, Field(ge=-1e5, le=1e5, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, le=1e5, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, le=1e5, allow_inf_nan=False)]
Gain = Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)]
Noise = Annotated[float, Field(ge=0, le=5, allow_inf_nan=False)]
"""standard deviation that an estimator, or the air, is assumed to have; with more nobody flies in formation"""
Wait = Annotated[float, Field(ge=1, le=3600, allow_inf_nan=False)]
"""a time for which a vehicle waits: a second at least, since the exchange takes some; no longer than batteries last"""
Percent = Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)]
VehicleId = Annotated[int, Field(ge=1, le=250)]

LANDED_APART_M = 1.0
"""vehicles that land where they are come down so far apart: a collision's distance, and the wander of both"""
SPACING_MARGIN_M = 0.2
"""slots stay this much farther apart than separation and barrier begin to act"""
STALE_AFTER = 2.1
"""a peer is stale after this many T_max without a word: one message may be lost"""
EXCHANGE_DELAY_S = 0.05
"""delay to a peer, as the error bound takes it beside t_min and the control period"""


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class OriginTable(_Table):
    """Origin of the fleet frame."""

    latitude_deg: Annotated[float, Field(ge=-90, le=90, allow_inf_nan=False)]
    longitude_deg: Annotated[float, Field(ge=-180, le=180, allow_inf_nan=False)]
    altitude_amsl_m: Annotated[float, Field(ge=-500, le=9000, allow_inf_nan=False)]


class FleetTable(_Table):
    """Name and frame."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,31}$")]
    frame: Literal["global", "local"] = "global"
    """global: autopilots know their place on earth; local: they share one local frame (motion capture)"""
    origin: OriginTable | None = None


class FormationTable(_Table):
    """The first formation."""

    shape: str = "v"
    spacing_m: Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)] = 4.0
    heading_deg: Annotated[float, Field(ge=-360, le=360, allow_inf_nan=False)] = 0.0
    altitude_m: Annotated[float, Field(ge=1, le=500, allow_inf_nan=False)] = 10.0
    """above the fleet origin"""
    custom_m: tuple[tuple[Real, Real, Real], ...] = ()
    """slots of shape "custom": forward, right, down"""


LegDuration = Annotated[float, Field(ge=0, le=DURATION_MAX_S, allow_inf_nan=False)]
LegVelocity = Annotated[float, Field(ge=-VELOCITY_MAX_M_S, le=VELOCITY_MAX_M_S, allow_inf_nan=False)]


class HoldLegTable(_Table):
    kind: Literal["hold"]
    duration_s: LegDuration


class VelocityLegTable(_Table):
    kind: Literal["velocity"]
    north_m_s: LegVelocity = 0.0
    east_m_s: LegVelocity = 0.0
    up_m_s: LegVelocity = 0.0
    duration_s: Annotated[float, Field(gt=0, le=DURATION_MAX_S, allow_inf_nan=False)]


class TurnLegTable(_Table):
    kind: Literal["turn"]
    rate_deg_s: Annotated[float, Field(ge=-TURN_RATE_MAX_DEG_S, le=TURN_RATE_MAX_DEG_S, allow_inf_nan=False)]
    """positive turns right"""
    angle_deg: Annotated[float, Field(ge=TURN_ANGLE_MIN_DEG, le=TURN_ANGLE_MAX_DEG, allow_inf_nan=False)] | None = None
    """None circles for ever"""


class GotoLegTable(_Table):
    kind: Literal["goto"]
    north_m: Annotated[float, Field(ge=-PLACE_MAX_M, le=PLACE_MAX_M, allow_inf_nan=False)]
    east_m: Annotated[float, Field(ge=-PLACE_MAX_M, le=PLACE_MAX_M, allow_inf_nan=False)]
    altitude_m: Annotated[float, Field(ge=1, le=500, allow_inf_nan=False)] | None = None
    speed_m_s: Annotated[float, Field(ge=0.1, le=VELOCITY_MAX_M_S, allow_inf_nan=False)] = 1.0
    """greatest speed of the centre; less where the vertical limits or a short way ask for it"""


LegTable = Annotated[HoldLegTable | VelocityLegTable | TurnLegTable | GotoLegTable, Field(discriminator="kind")]


class PlanTable(_Table):
    """How the formation moves once all have formed."""

    legs: Annotated[tuple[LegTable, ...], Field(max_length=LEGS_MAX)] = ()
    heading: Literal["fixed", "track"] = "fixed"
    """track: the formation's heading follows turns"""
    then: Then = "stay"
    """return: back over the pads, and land there"""
    automatic: bool = True
    """the fleet forms and starts the plan by itself; false: it waits for the operator's commands"""


class LawTable(_Table):
    """Gains of the law."""

    kind: Literal["starling", "paper"] = "starling"
    hold: HoldKind = "damped"
    hold_damping_s: Annotated[float, Field(ge=0.05, le=10, allow_inf_nan=False)] = 0.7
    """shorter, a prediction forgets velocity within a tick or two; longer, it runs away with it"""
    k_s: Gain = 3.0
    k_a: Gain = 3.0
    k_c: Gain = 4.0
    k_v: Gain = 1.0
    k_p: Gain = 0.3
    a_max_m_s2: Annotated[float, Field(ge=2, le=20, allow_inf_nan=False)] = 5.0
    """at least twice what plans ask for (1 m/s^2): the rest keeps the formation against gusts"""
    r0_m: Annotated[float, Field(ge=0.1, le=1000, allow_inf_nan=False)] | None = None
    """range of separation; None: half the spacing"""


class TriggerTable(_Table):
    """When to tell the peers."""

    kind: TriggerKind = "error"
    epsilon_m: Annotated[float, Field(ge=0.01, le=5, allow_inf_nan=False)] = 0.3
    """below a centimetre every tick is an event; the safety radius grows with it"""
    gamma_s2: Annotated[float, Field(ge=1e-4, le=100, allow_inf_nan=False)] = 0.1
    """an error of velocity counts as an error of place sqrt(gamma) seconds later"""
    kappa: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 0.3
    t_min_s: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 0.05
    """longer, an event would wait for longer than the safety radius allows for"""
    t_max_s: Annotated[float, Field(ge=0.5, le=60, allow_inf_nan=False)] = 10.0
    """shorter, a peer would be stale between two of its ticks"""
    period_s: Positive = 0.05
    """of kind "periodic" """
    near_period_s: Annotated[float, Field(ge=0.05, le=0.2, allow_inf_nan=False)] = 0.1
    """how often vehicles speak that are near each other; never off, since without it the safety filter does not hold
    under loss"""
    alpha: NotNegative = 0.1
    beta: NotNegative = 0.3
    delta_min: Positive = 0.01
    delta_f: Positive = 0.02
    eta: NotNegative = 0.3


class LimitsTable(_Table):
    """Limits on every setpoint, and what the vehicles are assumed to measure."""

    speed_max_m_s: Annotated[float, Field(ge=0.2, le=12, allow_inf_nan=False)] = 4.0
    climb_max_m_s: Annotated[float, Field(ge=0.1, le=3, allow_inf_nan=False)] = 1.5
    """slower, an estimator's vertical noise moves a vehicle faster than its plan"""
    descent_max_m_s: Annotated[float, Field(ge=0.1, le=1.5, allow_inf_nan=False)] = 1.0
    jerk_max_m_s3: Annotated[float, Field(ge=5, le=1000, allow_inf_nan=False)] = 100.0
    """at least: what plans ask for (1 m/s^2) within 0.2 s, the lag of a good velocity loop"""
    avoidance_acceleration_m_s2: Annotated[float, Field(ge=2, le=8, allow_inf_nan=False)] = 8.0
    """what every command is held to: at least what the law needs, or it could neither follow a plan nor brake"""
    barrier: bool = True
    control_rate_hz: Annotated[float, Field(ge=20, le=50, allow_inf_nan=False)] = 50.0
    position_noise_m: Noise = 0.05
    velocity_noise_m_s: Noise = 0.05
    gust_m_s2: Noise = 0.3


class FenceTable(_Table):
    """Where the vehicles may be: a cylinder or a polygon over the ground, floor and ceiling. No table, no fence."""

    radius_m: Positive | None = None
    """of the cylinder; None with a polygon, or where floor and ceiling alone limit"""
    centre_m: tuple[Real, Real] | None = None
    """north, east of the fleet origin; None: the origin"""
    polygon_m: tuple[tuple[Real, Real], ...] | None = None
    """corners (north, east), at least three, either way round"""
    floor_m: Annotated[float, Field(ge=-500, le=1000, allow_inf_nan=False)]
    """above the fleet origin"""
    ceiling_m: Annotated[float, Field(ge=-500, le=1000, allow_inf_nan=False)]
    margin_m: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 2.0
    """vehicles and plans stay this far inside the edge: lag and gusts are paid from it"""
    vertical_margin_m: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 0.5
    """and this far from floor and ceiling"""


class PeersTable(_Table):
    """Exchange between the vehicles."""

    range_m: Positive = 100.0
    digest: Annotated[int, Field(ge=0, le=30)] = 3
    """how many peers' latest samples a message carries"""
    wait_s: Wait = 60.0
    """how long a vehicle in the air waits for the others"""
    missing: Literal["land", "continue"] = "land"
    """what it does then: land, or form with those that are up"""
    isolated_flight_s: Wait = 5.0
    """how long a vehicle that hears nobody flies on before it holds"""
    network: Literal["laptop", "field"] = "laptop"
    scouting_port: Annotated[int, Field(ge=1024, le=65535)] | None = None
    """multicast port by which a laptop's vehicles find each other; None: from the fleet's name"""


PadLimit = Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)]
"""how far from its place a vehicle may be found: beyond a hundred metres it is another field"""


class PreflightTable(_Table):
    """What must be true before take-off."""

    battery_min_percent: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 30.0
    """0: not looked at"""
    position_rate_min_hz: Annotated[float, Field(ge=5, le=1000, allow_inf_nan=False)] = 10.0
    """slower, a vehicle at the speed limit flies a metre between two positions"""
    round_trip_limit_s: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] = 0.25
    """companion to autopilot and back; beyond 0.3 s vehicles swing (`docs/limits.md`)"""
    clock_limit_s: Annotated[float, Field(gt=0, le=0.5, allow_inf_nan=False)] = 0.1
    """between any two companions; samples from a second ahead are refused, and plans are flown by the clock"""
    autopilot_clock_limit_s: Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)] = 6.0
    """between a companion and its autopilot; PX4 sets its clock by GPS only when it is off by 5 s"""
    origin_limit_m: Positive = 1000.0
    """estimators' origins from the fleet origin, and from each other"""
    altitude_limit_m: PadLimit = 5.0
    """a vehicle on its pad, and its home, from the fleet origin's altitude"""
    altitude_spread_m: PadLimit = 3.0
    """vehicles on their pads, and their homes, from each other"""
    pad_limit_m: PadLimit = 10.0
    """a vehicle from its own pad"""
    offboard_loss_limit_s: Annotated[float, Field(gt=0, le=5, allow_inf_nan=False)] = 1.0
    """the autopilot's COM_OF_LOSS_T: for so long a vehicle flies on with its last setpoint"""
    require_rc: bool = False
    """whether every vehicle has a pilot with a transmitter"""


class FailsafeTable(_Table):
    """Limits of failsafes; the others are constants (`core.failsafe`)."""

    battery_low_percent: Percent = 25.0
    battery_low: Literal["return", "land", "continue"] = "return"
    """return: the whole fleet flies back over its pads and lands there"""
    battery_critical_percent: Percent = 12.0
    """land at once; 0 never"""
    isolated_hold_s: Wait = 10.0
    """how long a vehicle that hears nobody stands before it lands"""


class LaunchTable(_Table):
    """The pads: a grid about the fleet origin, for vehicles that name no pad."""

    spacing_m: Positive = 4.0
    heading_deg: Real = 0.0


class StubTable(_Table):
    """What stub autopilots simulate."""

    position_noise_m: NotNegative = 0.05
    velocity_noise_m_s: NotNegative = 0.05
    gust_m_s2: NotNegative = 0.3
    lag_s: NotNegative = 0.15
    drag_per_s: NotNegative = 0.2
    origin_scatter_m: NotNegative = 5.0
    """how far each estimator's origin lies from its vehicle's pad"""
    dynamics: Literal["px4", "ideal"] = "px4"
    px4_version: Literal["1.16", "1.18"] = "1.16"
    """whose parameters the stubs have"""


class VehicleTable(_Table):
    """One vehicle."""

    id: VehicleId
    system_id: VehicleId | None = None
    """MAVLink system id; None: the id"""
    mavlink: str | None = None
    """udp://HOST:PORT to listen on, or serial:///dev/NAME:BAUD; None: the port that PX4's instance id - 1 sends to"""
    zenoh: str | None = None
    """endpoint to listen on, as tcp/HOST:PORT; None: found by scouting"""
    slot: Annotated[int, Field(ge=0, le=249)] | Literal["auto"] = "auto"
    pad_m: tuple[Real, Real] | None = None
    """north, east of the fleet origin; None: the launch grid's next"""
    enabled: bool = True


class Vehicle(_Table):
    """One vehicle with every default resolved."""

    id: int
    instance: int
    """position in the file, from 0: ports and pads follow it"""
    system_id: int
    mavlink: str
    zenoh: str | None
    slot: int | Literal["auto"]
    pad_north_m: float
    pad_east_m: float


class FleetConfig(_Table):
    """The whole of fleet.toml."""

    fleet: FleetTable
    formation: FormationTable = FormationTable()
    plan: PlanTable = PlanTable()
    law: LawTable = LawTable()
    trigger: TriggerTable = TriggerTable()
    limits: LimitsTable = LimitsTable()
    fence: FenceTable | None = None
    peers: PeersTable = PeersTable()
    preflight: PreflightTable = PreflightTable()
    failsafe: FailsafeTable = FailsafeTable()
    launch: LaunchTable = LaunchTable()
    stub: StubTable = StubTable()
    vehicle: Annotated[tuple[VehicleTable, ...], Field(min_length=1, max_length=250)]

    @cached_property
    def vehicles(self) -> tuple[Vehicle, ...]:
        """The enabled vehicles, in the file's order."""
        pads = self._grid_pads()
        return tuple(
            Vehicle(
                id=v.id,
                instance=k,
                system_id=v.id if v.system_id is None else v.system_id,
                mavlink=v.mavlink or f"udp://127.0.0.1:{companion_port(k)}",
                zenoh=v.zenoh,
                slot=v.slot,
                pad_north_m=pads[k].north if v.pad_m is None else v.pad_m[0],
                pad_east_m=pads[k].east if v.pad_m is None else v.pad_m[1],
            )
            for k, v in enumerate(self.vehicle)
            if v.enabled
        )

    def _grid_pads(self) -> Slots:
        """Two wide rows behind each other, as one lays vehicles out on a field."""
        n = len(self.vehicle)
        across = max(ceil(sqrt(2.5 * n)), 1)
        s = self.launch.spacing_m
        cells = [(-s * (k // across), s * (k % across), 0.0) for k in range(n)]
        return rotated(centred(cells), radians(self.launch.heading_deg))

    def by_id(self, vehicle_id: int) -> Vehicle:
        """The enabled vehicle of that id; refused if there is none."""
        for vehicle in self.vehicles:
            if vehicle.id == vehicle_id:
                return vehicle
        known = ", ".join(str(v.id) for v in self.vehicles)
        raise ConfigError(f"vehicle {vehicle_id} is not an enabled vehicle of this fleet; there are {known}")

    @property
    def origin(self) -> Geodetic:
        """Origin of the fleet frame; of no meaning in the local frame."""
        o = self.fleet.origin
        return Geodetic(0.0, 0.0, 0.0) if o is None else Geodetic(o.latitude_deg, o.longitude_deg, o.altitude_amsl_m)

    @property
    def r0_m(self) -> float:
        """Range of separation."""
        return self.formation.spacing_m / 2 if self.law.r0_m is None else self.law.r0_m

    @property
    def gains(self) -> Gains:
        """The law's gains: ours, or Eq. (2) of the paper as it stands within the acceleration limit."""
        law = self.law
        if law.kind == "paper":
            return paper_gains(law.k_s, law.k_a, law.k_c, self.r0_m)._replace(a_max=law.a_max_m_s2)
        return Gains(law.k_s, law.k_a, law.k_c, law.k_v, law.k_p, self.r0_m, law.a_max_m_s2, 1.0, 1.0, 1.0)

    @cached_property
    def trigger_rule(self) -> Trigger:
        """The trigger of the configured kind."""
        t = self.trigger
        match t.kind:
            case "error":
                return ErrorTrigger(t.epsilon_m, t.gamma_s2, t.kappa)
            case "switching":
                return SwitchingTrigger(t.gamma_s2, t.alpha, t.beta, t.delta_min, t.delta_f, t.eta)
            case "periodic":
                return PeriodicTrigger(t.period_s)

    @property
    def near_rate(self) -> PeriodicTrigger:
        """When vehicles speak that are near each other."""
        return PeriodicTrigger(self.trigger.near_period_s)

    @property
    def message_spacing(self) -> Spacing:
        return Spacing(self.trigger.t_min_s, self.trigger.t_max_s)

    @property
    def prediction_error_m(self) -> float:
        """Bound on how far a peer that is heard may be from its prediction (m)."""
        return self.trigger_rule.error_bound_m(self.peer_motion)

    @property
    def peer_motion(self) -> PeerMotion:
        """What the vehicles must reckon with in each other.

        The hold brakes the velocity of a vehicle that may fly at the speed limit relative to its plan; the filter may
        push it on meanwhile. The paper's hold lets it stand.
        """
        x = self.limits
        braking = x.speed_max_m_s / self.law.hold_damping_s if self.law.hold == "damped" else 0.0
        return PeerMotion(
            sigma_p_m=x.position_noise_m,
            sigma_v_m_s=x.velocity_noise_m_s,
            sigma_gust_m_s2=x.gust_m_s2,
            a_max_m_s2=self.law.a_max_m_s2,
            deviation_m_s2=max(x.avoidance_acceleration_m_s2, self.law.a_max_m_s2) + braking,
            drift_m_s=x.speed_max_m_s if self.law.hold == "zero" else 0.0,
            speed_m_s=2.0 * x.speed_max_m_s,
            latency_s=EXCHANGE_DELAY_S + self.trigger.t_min_s + 1.0 / x.control_rate_hz,
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
        braking_m = speed * self.peer_motion.latency_s + speed**2 / (2.0 * x.avoidance_acceleration_m_s2)
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

    def motion_into(self, shape: str, motion: FleetTrajectory, at_ns: int, issuer: int) -> FleetTrajectory:
        """The motion that takes over from `motion` with another formation.

        The slots use what speed the centre leaves them, half of the limit at most.
        """
        x = self.limits
        left = x.speed_max_m_s - top_speed_m_s(motion)
        return with_formation(
            motion, at_ns=at_ns, issuer=issuer, shape=shape, slots=self.slots(shape), pinned=self.pinned,
            speed_m_s=max(min(left, x.speed_max_m_s / 2), (1.0 - PLAN_SPEED_SHARE) * x.speed_max_m_s),
            climb_m_s=x.climb_max_m_s / 4, descent_m_s=x.descent_max_m_s / 4,
        )  # fmt: skip

    def motion_home(self, motion: FleetTrajectory, at_ns: int, issuer: int) -> FleetTrajectory:
        """The motion that takes over from `motion` and brings every vehicle back over its own pad, to land."""
        share = PLAN_SPEED_SHARE / 2
        return with_return(
            motion, self.first_motion, at_ns=at_ns, issuer=issuer, speed_m_s=self.return_speed_m_s,
            climb_m_s=share * self.limits.climb_max_m_s, descent_m_s=share * self.limits.descent_max_m_s,
        )  # fmt: skip

    @property
    def peer_limits(self) -> PeerLimits:
        return PeerLimits(
            hold=self.law.hold,
            hold_damping_s=self.law.hold_damping_s,
            range_m=self.peers.range_m,
            stale_after_s=STALE_AFTER * self.trigger.t_max_s,
            heartbeat_s=self.trigger.t_max_s,
            isolated_flight_s=self.peers.isolated_flight_s,
            uncertainty_m=self.prediction_error_m,
            motion=self.peer_motion,
            digest_size=self.peers.digest,
        )

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

    def slots(self, shape: str) -> Slots:
        """Slots (forward, right, down) of a shape for the enabled vehicles; refused if they are too close."""
        count = len(self.vehicles)
        if shape == "custom":
            if len(self.formation.custom_m) != count:
                raise ConfigError(
                    f"$.formation.custom_m must have one slot for each of the {count} enabled vehicles, "
                    f"got {len(self.formation.custom_m)}"
                )
            slots = centred(self.formation.custom_m)
        elif shape in SHAPES:
            slots = shape_slots(shape, count, self.formation.spacing_m)
        else:
            raise ConfigError(f"$.formation.shape must be one of {', '.join((*SHAPES, 'custom'))}, got {shape!r}")
        self._check_slots(shape, slots)
        lowest = self.formation.altitude_m - max(s.down for s in slots)
        if lowest < ALTITUDE_MIN_M:
            raise ConfigError(
                f"$.formation.altitude_m: {shape!r} must have no slot below {ALTITUDE_MIN_M:g} m, got {lowest:.2f}"
            )
        return slots

    def _check_slots(self, shape: str, slots: Slots) -> None:
        nearest = minimum_distance(slots)
        if nearest < self.spacing_min_m:
            raise ConfigError(
                f"$.formation.spacing_m: {shape!r} needs at least {self.spacing_min_m:.2f} m "
                f"(the larger of separation's range {self.r0_m:.2f} m and the safety radius "
                f"{self.safety_radius_m:.2f} m, {self.radius_reason}, and {SPACING_MARGIN_M} m), got {nearest:.2f} m"
            )
        if minimum_distance(slots, DOWNWASH_RATIO) < self.safety_radius_m + SPACING_MARGIN_M and self.limits.barrier:
            raise ConfigError(
                f"$.formation.spacing_m: slots of {shape!r} lie above each other inside the downwash ellipsoid "
                f"(vertical half-axis {DOWNWASH_RATIO * self.safety_radius_m:.2f} m, horizontal "
                f"{self.safety_radius_m:.2f} m): choose a larger spacing or a level shape"
            )
        level = minimum_distance([Ned(s.north, s.east, 0.0) for s in slots])
        if level < LANDED_APART_M * (1.0 - 1e-9):
            raise ConfigError(
                f"$.formation.spacing_m: slots of {shape!r} must be at least {LANDED_APART_M:g} m apart on the level, "
                f"since vehicles land where they are, got {level:.2f} m: choose a larger spacing or a level shape"
            )

    @cached_property
    def pinned(self) -> dict[int, int]:
        """Vehicle id -> slot, for the vehicles whose slot the file fixes."""
        return {v.id: v.slot for v in self.vehicles if v.slot != "auto"}

    @cached_property
    def first_motion(self) -> FleetTrajectory:
        """Where everybody starts: each over its own pad at the formation's altitude, at rest."""
        heading = radians(self.formation.heading_deg)
        pads = [Ned(v.pad_north_m, v.pad_east_m, 0.0) for v in self.vehicles]
        centre = [sum(p[k] for p in pads) / len(pads) for k in range(2)]
        level = rotated(centred(pads), -heading)
        return FleetTrajectory(
            revision=0,
            start_ns=0,
            issuer=0,
            shape=PADS,
            slots={v.id: SlotChange(s, s) for v, s in zip(self.vehicles, level, strict=True)},
            blend_start_ns=0,
            blend_s=0.0,
            legs_start_ns=0,
            centre_ned_m=Ned(centre[0], centre[1], -self.formation.altitude_m),
            velocity_ned_m_s=ZERO,
            heading_rad=heading,
            heading_rate_rad_s=0.0,
            heading_follows_turns=self.plan.heading == "track",
            legs=(),
        )

    def plan_legs(self, start: Ned, velocity: Ned = ZERO) -> tuple[Leg, ...]:
        """The plan's legs, begun at `start` with `velocity` (the centre's, m and m/s)."""
        return tuple(self._legs(self.plan.legs, start, velocity))

    def waypoint(self, start: Ned, velocity: Ned, table: GotoLegTable) -> Leg:
        """The leg to a waypoint from a place and a velocity of the centre, within the vertical limits."""
        x = self.limits
        down = start.down if table.altitude_m is None else -table.altitude_m
        return goto_leg(
            start, velocity, Ned(table.north_m, table.east_m, down), table.speed_m_s,
            PLAN_SPEED_SHARE * x.climb_max_m_s, PLAN_SPEED_SHARE * x.descent_max_m_s,
        )  # fmt: skip

    def _legs(self, tables: Sequence[LegTable], place: Ned, velocity: Ned) -> Iterator[Leg]:
        """Legs of the core from their tables; how long a waypoint takes follows from where the leg before has led."""
        for table in tables:
            leg: Leg
            match table:
                case HoldLegTable():
                    leg = VelocityLeg(ZERO, table.duration_s)
                case VelocityLegTable():
                    leg = VelocityLeg(Ned(table.north_m_s, table.east_m_s, -table.up_m_s), table.duration_s)
                case TurnLegTable():
                    angle = inf if table.angle_deg is None else radians(table.angle_deg)
                    leg = TurnLeg(radians(table.rate_deg_s), angle)
                case GotoLegTable():
                    leg = self.waypoint(place, velocity, table)
            yield leg
            _, place, velocity, _ = leg_end(leg, place, velocity)

    @cached_property
    def shared_hash(self) -> str:
        """Digest of what the vehicles must agree on: everything but links and the stubs' noise."""
        shared = self.model_dump(exclude={"stub": True, "vehicle": {"__all__": {"mavlink", "zenoh"}}})
        return blake2s(json.dumps(shared, sort_keys=True).encode(), digest_size=8).hexdigest()


def companion_port(instance: int) -> int:
    """UDP port on which the companion of an instance listens: PX4's for the first ten, since 14550 is the GCS's."""
    return 14540 + instance if instance < 10 else 24540 + instance


def autopilot_port(instance: int, companion: int | None = None) -> int:
    """UDP port from which the autopilot of an instance sends: 40 above its companion's for the first ten, then 1000.

    `companion` is the companion's port where it is not the instance's own: a fleet whose URLs are shifted has its
    autopilots shifted alike, so that several fit on one machine.
    """
    listening = companion_port(instance) if companion is None else companion
    return listening + (40 if instance < 10 else 1000)


def udp_endpoint(url: str) -> tuple[str, int] | None:
    """Host and port of udp://HOST:PORT (an empty host is any), or None if it is another kind of link."""
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        return None
    if parts.scheme != "udp" or port is None or not 0 < port < 65536 or parts.path not in ("", "/"):
        return None
    return parts.hostname or "0.0.0.0", port


def serial_endpoint(url: str) -> tuple[str, int] | None:
    """Device and baud rate of serial:///dev/NAME:BAUD, or None if it is another kind of link."""
    match = re.fullmatch(r"serial://(/[^:]+):(\d+)", url)
    return (match[1], int(match[2])) if match else None


def load(path: Path, change: Callable[[dict[str, Any]], None] | None = None) -> FleetConfig:
    """Read and validate a fleet.toml; `change` may edit the raw tables first (command-line overrides).

    Raises ConfigError naming file, place, what came and what is allowed; all faults of the file at once.
    """
    return parse(read_tables(path, change), path.name)


def read_tables(path: Path, change: Callable[[dict[str, Any]], None] | None = None) -> dict[str, Any]:
    """The raw tables of a TOML file, edited by `change`."""
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: is not valid TOML: {error}") from error
    if change is not None:
        change(tables)
    return tables


def parse(tables: Mapping[str, Any], name: str) -> FleetConfig:
    """Validate raw tables; `name` is the file's, for messages."""
    try:
        config = FleetConfig.model_validate_json(json.dumps(tables, default=str))
    except ValidationError as error:
        sentences = dict.fromkeys(_sentence(e) for e in error.errors())
        raise ConfigError("\n".join(f"{name}: {sentence}" for sentence in sentences)) from error
    faults = list(_faults(config))
    if not faults:
        try:
            config.slots(config.formation.shape)
        except ConfigError as error:
            faults.append(str(error))
        else:
            faults += _motion_faults(config)
    if faults:
        raise ConfigError("\n".join(f"{name}: {fault}" for fault in faults))
    return config


def _faults(config: FleetConfig) -> Iterator[str]:
    """What single values cannot tell: references and duplicates across tables."""
    if config.fleet.frame == "global" and config.fleet.origin is None:
        yield '$.fleet.origin is required with frame = "global" (latitude_deg, longitude_deg, altitude_amsl_m)'
    if not config.vehicles:
        yield "$.vehicle: at least one vehicle must be enabled"
    taken: dict[tuple[str, object], int] = {}
    for k, v in enumerate(config.vehicle):
        system_id = v.id if v.system_id is None else v.system_id
        link = v.mavlink or f"udp://127.0.0.1:{companion_port(k)}"
        udp, serial = udp_endpoint(link), serial_endpoint(link)
        if udp is None and serial is None:
            yield f"$.vehicle[{k}].mavlink must be udp://HOST:PORT or serial:///dev/NAME:BAUD, got {link!r}"
        values: list[tuple[str, object]] = [("id", v.id), ("system_id", system_id)]
        values.append(("mavlink", ("port", udp[1]) if udp else ("device", serial[0] if serial else link)))
        if v.zenoh is not None:
            values.append(("zenoh", v.zenoh))
            endpoint = re.fullmatch(r"(tcp|udp|tls|quic)/.+:(\d{1,5})", v.zenoh)
            if endpoint is None or not 0 < int(endpoint[2]) < 65536:
                yield f"$.vehicle[{k}].zenoh must be PROTOCOL/HOST:PORT with tcp, udp, tls or quic, got {v.zenoh!r}"
        if v.slot != "auto":
            values.append(("slot", v.slot))
            if v.enabled and v.slot >= len(config.vehicles):
                yield f"$.vehicle[{k}].slot must be below the {len(config.vehicles)} enabled vehicles, got {v.slot}"
        for name, value in values:
            if (name, value) in taken:
                came = value[1] if isinstance(value, tuple) else value
                yield f"$.vehicle[{k}].{name} must be unique, got {came!r} as in $.vehicle[{taken[name, value]}]"
            else:
                taken[name, value] = k
    pads = [(v.pad_north_m, v.pad_east_m, 0.0) for v in config.vehicles]
    if minimum_distance(pads) < config.safety_radius_m and config.limits.barrier:
        yield (
            f"$.launch.spacing_m / $.vehicle[].pad_m: pads must be at least the safety radius "
            f"{config.safety_radius_m:.2f} m apart ({config.radius_reason}), got {minimum_distance(pads):.2f} m"
        )
    t = config.trigger
    if t.t_min_s > t.near_period_s:
        yield f"$.trigger.t_min_s must be <= $.trigger.near_period_s = {t.near_period_s:g} s, got {t.t_min_s:g}"
    if t.kind == "periodic" and t.period_s < t.t_min_s:
        yield f"$.trigger.period_s must be >= $.trigger.t_min_s = {t.t_min_s:g} s, got {t.period_s:g}"
    if config.trigger.t_min_s >= config.trigger.t_max_s:
        yield (
            f"$.trigger.t_min_s must be below $.trigger.t_max_s = {config.trigger.t_max_s:g} s, "
            f"got {config.trigger.t_min_s:g}"
        )
    if config.peers.range_m < config.range_min_m:
        yield (
            f"$.peers.range_m must be at least {config.range_min_m:.2f} m ($.formation.spacing_m, and twice the way of "
            f"braking from $.limits.speed_max_m_s), got {config.peers.range_m:g}"
        )
    yield from _plan_faults(config)
    if config.fence is not None:
        yield from _fence_faults(config.fence)


def _plan_faults(config: FleetConfig) -> Iterator[str]:
    """Legs that ask for more than the limits leave; what follows from the legs before is `_motion_faults`."""
    limits = config.limits
    level = PLAN_SPEED_SHARE * limits.speed_max_m_s
    for k, leg in enumerate(config.plan.legs):
        where = f"$.plan.legs[{k}]"
        match leg:
            case VelocityLegTable():
                speed = sqrt(leg.north_m_s**2 + leg.east_m_s**2)
                if speed > level:
                    yield f"{where}: speed must be <= {level:g} m/s (3/4 of $.limits.speed_max_m_s), got {speed:g}"
                most, least = PLAN_SPEED_SHARE * limits.climb_max_m_s, -PLAN_SPEED_SHARE * limits.descent_max_m_s
                if not least <= leg.up_m_s <= most:
                    yield (
                        f"{where}.up_m_s must be >= {least:g} and <= {most:g} m/s "
                        f"(3/4 of $.limits.descent_max_m_s and climb_max_m_s), got {leg.up_m_s:g}"
                    )
            case TurnLegTable():
                if abs(leg.rate_deg_s) < TURN_RATE_MIN_DEG_S:
                    yield f"{where}.rate_deg_s must be {TURN_RATE_MIN_DEG_S:g} deg/s or more, got {leg.rate_deg_s:g}"
                if leg.angle_deg is None and k + 1 < len(config.plan.legs):
                    yield f"{where}.angle_deg is required except in the last leg"
            case GotoLegTable():
                if leg.speed_m_s > level:
                    yield (
                        f"{where}.speed_m_s must be <= {level:g} m/s (3/4 of $.limits.speed_max_m_s), "
                        f"got {leg.speed_m_s:g}"
                    )
    last = config.plan.legs[-1] if config.plan.legs else None
    if isinstance(last, VelocityLegTable) and last.up_m_s != 0.0 and config.plan.then == "stay":
        yield f"$.plan.legs[{len(config.plan.legs) - 1}].up_m_s must be 0 m/s in the last leg: it goes on for ever"
    if config.failsafe.battery_critical_percent > config.failsafe.battery_low_percent:
        yield (
            "$.failsafe.battery_critical_percent must be <= $.failsafe.battery_low_percent = "
            f"{config.failsafe.battery_low_percent:g}, got {config.failsafe.battery_critical_percent:g}"
        )


def _fence_faults(fence: FenceTable) -> Iterator[str]:
    """A fence that is none: two kinds of edge at once, an edge that crosses itself, nothing left inside."""
    if fence.radius_m is not None and fence.polygon_m is not None:
        yield "$.fence must have radius_m or polygon_m, got both"
    if fence.radius_m is None and fence.centre_m is not None:
        yield "$.fence.centre_m belongs to radius_m, which is missing"
    lowest, highest = fence.floor_m + fence.vertical_margin_m, fence.ceiling_m - fence.vertical_margin_m
    if lowest > highest:
        yield (
            f"$.fence.ceiling_m must be at least {2 * fence.vertical_margin_m:g} m (twice $.fence.vertical_margin_m) "
            f"above $.fence.floor_m = {fence.floor_m:g} m, got {fence.ceiling_m:g}"
        )
    if fence.radius_m is not None and fence.radius_m <= fence.margin_m:
        yield f"$.fence.radius_m must be > $.fence.margin_m = {fence.margin_m:g} m, got {fence.radius_m:g}"
    if fence.polygon_m is None:
        return
    if len(fence.polygon_m) < 3:
        yield f"$.fence.polygon_m must have at least 3 corners, got {len(fence.polygon_m)}"
        return
    # Only here: a companion without a polygon need not load it.
    from shapely import Polygon
    from shapely.validation import explain_validity

    polygon = Polygon(fence.polygon_m)
    if not polygon.is_valid:
        yield f"$.fence.polygon_m must not cross or touch itself, got {explain_validity(polygon)}"
    elif polygon.buffer(-fence.margin_m).is_empty:
        yield f"$.fence.polygon_m must be wider than twice $.fence.margin_m = {fence.margin_m:g} m, got nothing inside"


def _motion_faults(config: FleetConfig) -> Iterator[str]:
    """Pads that are not inside the fence, and motions that the vehicles would refuse of each other: the way into the
    formation, the plan, the way back."""
    fence = config.geofence
    if fence is not None:
        yield from _pad_faults(config, fence)
    if fence is not None and fence.vertical_room_m(-config.formation.altitude_m) < 0.0:
        yield (
            f"$.formation.altitude_m must be >= {-fence.lowest_down_m:g} and <= {-fence.highest_down_m:g} m "
            f"(between floor and ceiling of the fence, less $.fence.vertical_margin_m), "
            f"got {config.formation.altitude_m:g}"
        )
        return
    limits, first = config.motion_limits, config.first_motion
    formed = config.motion_into(config.formation.shape, first, 0, 0)
    fault = examine(formed, limits, first).fault
    if fault is not None:
        yield _formation_sentence(fault)
        return
    planned, start_ns = formed, formed.blend_end_ns
    if config.plan.legs:
        now = formed.state_at(start_ns).centre
        legs = config.plan_legs(now.position, now.velocity)
        planned = with_legs(formed, at_ns=start_ns, issuer=0, legs=legs, then=config.plan.then)
        fault = examine(planned, limits, formed).fault
        if fault is not None:
            yield _plan_sentence(fault)
            return
    if config.plan.then == "return" and planned.end_ns is not None:
        fault = examine(config.motion_home(planned, planned.end_ns, 0), limits, planned).fault
        if fault is not None and fault.breach is not None:
            yield (
                f'$.plan.then = "return": the way back from the last leg must stay inside the fence by its margin, '
                f"got vehicle {fault.breach.vehicle_id} {fault.breach.outside_m:.2f} m beyond it"
            )
        elif fault is not None:
            yield f'$.plan.then = "return": the way back from the last leg would be refused: {fault.sentence}'


def _pad_faults(config: FleetConfig, fence: Fence) -> Iterator[str]:
    for v in config.vehicles:
        room = fence.edge_room_m(v.pad_north_m, v.pad_east_m)
        if room < 0.0:
            yield (
                f"$.vehicle[{v.instance}].pad_m must be inside the fence by $.fence.margin_m = {fence.margin_m:g} m, "
                f"got [{v.pad_north_m:g}, {v.pad_east_m:g}], {-room:.2f} m too far out"
            )


def _formation_sentence(fault: Fault) -> str:
    if fault.breach is None:
        return f"$.formation: the way into it would be refused: {fault.sentence}"
    return (
        f"$.formation: the slot of vehicle {fault.breach.vehicle_id} must be inside the fence by its margin, "
        f"got {fault.breach.outside_m:.2f} m beyond it"
    )


def _plan_sentence(fault: Fault) -> str:
    where = "$.plan" if fault.leg is None else f"$.plan.legs[{fault.leg}]"
    if fault.breach is None or fault.breach.vehicle_id == 0:
        return f"{where} would be refused: {fault.sentence.removeprefix(f'its leg {fault.leg} ')}"
    return (
        f"{where} must stay inside the fence by its margin, got vehicle {fault.breach.vehicle_id} "
        f"{fault.breach.outside_m:.2f} m beyond it {fault.breach.time_s:.1f} s into the plan"
    )


_UNITS = {
    "_m_s3": "m/s^3", "_m_s2": "m/s^2", "_m_s": "m/s", "_deg_s": "deg/s", "_per_s": "1/s", "_s2": "s^2", "_deg": "deg",
    "_m": "m", "_s": "s", "_hz": "Hz", "_percent": "%",
}  # fmt: skip


def _sentence(error: Any) -> str:
    """One fault as a sentence: where, what is allowed, what came."""
    loc = [p for k, p in enumerate(error["loc"]) if not (p in _LEGS and k >= 3 and error["loc"][0] == "plan")]
    if "slot" in loc:
        # The two kinds of value that a slot may have are two faults to the validator.
        loc = loc[: loc.index("slot") + 1]
    path = "$" + "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in loc)
    came = error["input"]
    match error["type"]:
        case "extra_forbidden":
            return f"{path} is not a known key; known here: {', '.join(sorted(_place(error['loc'][:-1])[0]))}"
        case "too_short":
            return f"{path} must have at least {error['ctx']['min_length']}, got {error['ctx']['actual_length']}"
        case "missing":
            return f"{path} is required"
        case "string_pattern_mismatch":
            return f"{path} must match {error['ctx']['pattern']}, got {came!r}"
        case "union_tag_invalid" | "union_tag_not_found":
            return f"{path}.kind must be one of hold, velocity, turn, goto, got {came!r}"
    unit = next((u for s, u in _UNITS.items() if str(loc[-1]).endswith(s)), "") if loc[-1] != "k_s" else ""
    allowed = _allowed(tuple(loc) if "slot" in loc else error["loc"])
    message = error["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    rule = f"must be {allowed} {unit}".rstrip() if allowed else f"must be {message}"
    return f"{path} {rule}, got {came!r}"


_LEGS: Mapping[str, type[_Table]] = {
    "hold": HoldLegTable, "velocity": VelocityLegTable, "turn": TurnLegTable, "goto": GotoLegTable
}  # fmt: skip


def _place(loc: Sequence[str | int]) -> tuple[Mapping[str, FieldInfo], FieldInfo | None]:
    """The fields of the table at a place of the file, and the field that the place itself is."""
    fields: Mapping[str, FieldInfo] = FleetConfig.model_fields
    field: FieldInfo | None = None
    for part in loc:
        if isinstance(part, int):
            continue
        if part in fields:
            field = fields[part]
            table = _inner(field.annotation)
            fields = {} if table is None else table.model_fields
        elif part in _LEGS:
            fields = _LEGS[part].model_fields
        else:
            return {}, None
    return fields, field


def _inner(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        found = _inner(argument)
        if found is not None:
            return found
    return None


def _scalars(annotation: Any) -> Iterator[Any]:
    """The types inside an annotation, each with what restricts it: (type, restrictions)."""
    if annotation is float or annotation is int:
        yield annotation, ()
    elif hasattr(annotation, "__metadata__"):
        for scalar, _ in _scalars(annotation.__origin__):
            yield scalar, annotation.__metadata__
    else:
        for argument in getattr(annotation, "__args__", ()):
            yield from _scalars(argument)


def _allowed(loc: Sequence[str | int]) -> str:
    """The range of a numeric field, as 'a finite number > 0'."""
    _, field = _place(loc)
    if field is None:
        return ""
    scalars = list(_scalars(field.annotation))
    if not scalars:
        return ""
    kind, restrictions = scalars[0]
    items = [*field.metadata, *restrictions]
    bounds = []
    for item in [*items, *(m for i in items for m in getattr(i, "metadata", ()))]:
        match item:
            case annotated_types.Gt():
                bounds.append(f"> {item.gt:g}")
            case annotated_types.Ge():
                bounds.append(f">= {item.ge:g}")
            case annotated_types.Lt():
                bounds.append(f"< {item.lt:g}")
            case annotated_types.Le():
                bounds.append(f"<= {item.le:g}")
    name = "a whole number" if kind is int else "a finite number"
    text = " ".join([name, " and ".join(dict.fromkeys(bounds))]).rstrip()
    return f'{text}, or "auto"' if "auto" in str(field.annotation) else text
