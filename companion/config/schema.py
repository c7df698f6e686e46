"""The tables of fleet.toml: each key with its range, its unit and its default."""

from typing import Annotated, Literal

from pydantic import Field

from companion.config.law_tables import AnyLaw, StarlingTable
from companion.config.numbers import Noise, NotNegative, Percent, Positive, Real, Table, VehicleId, Wait, Wind
from companion.config.trigger_tables import AnyTrigger, ErrorTable
from companion.core.trajectory.fleet import Then
from companion.core.trajectory_check import (
    DURATION_MAX_S,
    LEGS_MAX,
    PLACE_MAX_M,
    TURN_ANGLE_MAX_DEG,
    TURN_ANGLE_MIN_DEG,
    TURN_RATE_MAX_DEG_S,
    VEHICLES_MAX,
    VELOCITY_MAX_M_S,
)


class OriginTable(Table):
    """Origin of the fleet frame."""

    latitude_deg: Annotated[float, Field(ge=-90, le=90, allow_inf_nan=False)]
    longitude_deg: Annotated[float, Field(ge=-180, le=180, allow_inf_nan=False)]
    altitude_amsl_m: Annotated[float, Field(ge=-500, le=9000, allow_inf_nan=False)]


class FleetTable(Table):
    """Name and frame."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,31}$")]
    frame: Literal["global", "local"] = "global"
    """global: autopilots know their place on earth; local: they share one local frame (motion capture)"""
    origin: OriginTable | None = None


class FormationTable(Table):
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


class HoldLegTable(Table):
    kind: Literal["hold"]
    duration_s: LegDuration


class VelocityLegTable(Table):
    kind: Literal["velocity"]
    north_m_s: LegVelocity = 0.0
    east_m_s: LegVelocity = 0.0
    up_m_s: LegVelocity = 0.0
    duration_s: Annotated[float, Field(gt=0, le=DURATION_MAX_S, allow_inf_nan=False)]


class TurnLegTable(Table):
    kind: Literal["turn"]
    rate_deg_s: Annotated[float, Field(ge=-TURN_RATE_MAX_DEG_S, le=TURN_RATE_MAX_DEG_S, allow_inf_nan=False)]
    """positive turns right"""
    angle_deg: Annotated[float, Field(ge=TURN_ANGLE_MIN_DEG, le=TURN_ANGLE_MAX_DEG, allow_inf_nan=False)] | None = None
    """None circles for ever"""


class GotoLegTable(Table):
    kind: Literal["goto"]
    north_m: Annotated[float, Field(ge=-PLACE_MAX_M, le=PLACE_MAX_M, allow_inf_nan=False)]
    east_m: Annotated[float, Field(ge=-PLACE_MAX_M, le=PLACE_MAX_M, allow_inf_nan=False)]
    altitude_m: Annotated[float, Field(ge=1, le=500, allow_inf_nan=False)] | None = None
    speed_m_s: Annotated[float, Field(ge=0.1, le=VELOCITY_MAX_M_S, allow_inf_nan=False)] = 1.0
    """greatest speed of the centre; less where the vertical limits or a short way ask for it"""


LegTable = Annotated[HoldLegTable | VelocityLegTable | TurnLegTable | GotoLegTable, Field(discriminator="kind")]


class PlanTable(Table):
    """How the formation moves once all have formed."""

    kind: Literal["legs", "none"] = "legs"
    """none: no motion is shared; the vehicles agree on a velocity by what they publish"""
    informed: Annotated[tuple[VehicleId, ...], Field(max_length=VEHICLES_MAX)] = ()
    """with kind "none": the vehicles that know the legs and fly them; the others follow these by alignment"""
    legs: Annotated[tuple[LegTable, ...], Field(max_length=LEGS_MAX)] = ()
    heading: Literal["fixed", "track"] = "fixed"
    """track: the formation's heading follows turns"""
    then: Then = "stay"
    """return: back over the pads, and land there"""
    automatic: bool = True
    """the fleet forms and starts the plan by itself; false: it waits for the operator's commands"""


class LimitsTable(Table):
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


class FenceTable(Table):
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


NOTICE_LEAST_S, NOTICE_MOST_S = 1.0, 10.0
"""of `peers.notice_lost_s`"""


class PeersTable(Table):
    """Exchange between the vehicles."""

    range_m: Positive = 100.0
    neighbours: Literal["auto", "all", "range", "nearest"] = "auto"
    """whom the law heeds: everybody heard, those within the range, or the nearest by slots, mutually; auto: range, but
    nearest in a fleet of more than twenty without a plan"""
    nearest: Annotated[int, Field(ge=1, le=VEHICLES_MAX)] = 7
    digest: Annotated[int, Field(ge=0, le=30)] = 3
    """how many peers' latest samples a message carries"""
    wait_s: Wait = 60.0
    """how long a vehicle in the air waits for the others"""
    missing: Literal["land", "continue"] = "land"
    """what it does then: land, or form with those that are up"""
    isolated_flight_s: Wait = 5.0
    """how long a vehicle that hears nobody flies on before it holds"""
    network: Literal["laptop", "field"] = "laptop"
    notice_lost_s: Annotated[float, Field(ge=NOTICE_LEAST_S, le=NOTICE_MOST_S, allow_inf_nan=False)] | None = None
    """a peer whose computer or radio is gone is noticed within this time: the sessions' lease and keep-alives follow,
    and `trigger.t_max_s` where it is left out; None: 4 on a laptop, 2 in the field. Shorter, one stalled segment would
    be taken for a lost peer; longer, the others fly into the place where it has stopped"""
    scouting_port: Annotated[int, Field(ge=1024, le=65535)] | None = None
    """multicast port by which a laptop's vehicles find each other; None: from the fleet's name"""


PadLimit = Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)]
"""how far from its place a vehicle may be found: beyond a hundred metres it is another field"""


class PreflightTable(Table):
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


class FailsafeTable(Table):
    """Limits of failsafes; the others are constants (`core.failsafe`)."""

    battery_low_percent: Percent = 25.0
    battery_low: Literal["return", "land", "continue"] = "return"
    """return: the whole fleet flies back over its pads and lands there"""
    battery_critical_percent: Percent = 12.0
    """land at once; 0 never"""
    isolated_hold_s: Wait = 10.0
    """how long a vehicle that hears nobody stands before it lands"""


class LaunchTable(Table):
    """The pads: a grid about the fleet origin, for vehicles that name no pad."""

    spacing_m: Positive = 4.0
    heading_deg: Real = 0.0
    first_instance: Annotated[int, Field(ge=0, le=200)] = 0
    """PX4's instance number of the first vehicle: a second simulated fleet on one machine needs numbers of its own"""


class StubTable(Table):
    """What stub autopilots simulate."""

    position_noise_m: NotNegative = 0.05
    velocity_noise_m_s: NotNegative = 0.05
    gust_m_s2: NotNegative = 0.3
    lag_s: NotNegative = 0.15
    drag_per_s: NotNegative = 0.2
    wind_north_m_s: Wind = 0.0
    """where the air flows to; it pushes by the drag: 5 m/s at 1.0 /s, which is PX4's SIH, with 5 m/s^2"""
    wind_east_m_s: Wind = 0.0
    origin_scatter_m: NotNegative = 5.0
    """how far each estimator's origin lies from its vehicle's pad"""
    dynamics: Literal["px4", "ideal"] = "px4"
    px4: Literal["1.16", "1.17", "1.18", "main"] = "1.16"
    """which PX4 the stubs play: its parameters, modes and answers"""
    signing: bool = False
    """they demand signed MAVLink; keys are made for vehicles that name none"""


class VehicleTable(Table):
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
    signing_key: Annotated[str, Field(min_length=1, max_length=500)] | None = None
    """file of the key by which its MAVLink link is signed, beside this file; None: it is not signed"""
    enabled: bool = True


class FleetTables(Table):
    """The whole of fleet.toml, as it is written."""

    fleet: FleetTable
    formation: FormationTable = FormationTable()
    plan: PlanTable = PlanTable()
    law: AnyLaw = StarlingTable()
    trigger: AnyTrigger = ErrorTable()
    limits: LimitsTable = LimitsTable()
    fence: FenceTable | None = None
    peers: PeersTable = PeersTable()
    preflight: PreflightTable = PreflightTable()
    failsafe: FailsafeTable = FailsafeTable()
    launch: LaunchTable = LaunchTable()
    stub: StubTable = StubTable()
    vehicle: Annotated[tuple[VehicleTable, ...], Field(min_length=1, max_length=250)]
