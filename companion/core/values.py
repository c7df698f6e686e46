"""Values that pass between the parts of the core: immutable, SI units, fleet frame (NED) unless named otherwise."""

from dataclasses import dataclass
from enum import IntEnum, unique
from typing import NamedTuple

from companion.core.frames import Ned

ZERO = Ned(0.0, 0.0, 0.0)


class Instant(NamedTuple):
    """One moment on two clocks."""

    monotonic_ns: int
    """this machine's monotonic clock (ns); never compared with another machine's"""
    fleet_ns: int
    """fleet time: UTC since 1970 (ns), latched to the monotonic clock and slewed, never stepped"""


@unique
class Phase(IntEnum):
    """Where a vehicle is in its flight; `core.phase` holds every transition."""

    IDLE = 0
    PREFLIGHT = 1
    """take-off is commanded, and the autopilot is asked to arm"""
    ARMED = 2
    CLIMBING = 3
    WAITING = 4
    """at altitude over the own pad, following our setpoints, until the others are there"""
    FORMING = 5
    FORMED = 6
    MOVING = 7
    """the plan's legs run"""
    HOLDING = 8
    """the formation stands, after it has moved or on command"""
    RETURNING = 9
    """on the way to the places over the pads"""
    DETACHED = 10
    """stands by itself or comes back to its slot: steered by its own filter, and no part of the formation"""
    LANDING = 11
    LANDED = 12
    RELEASED = 13
    """the pilot or the autopilot's own failsafe has the vehicle; we send nothing"""


FORMATION_PHASES = frozenset({Phase.WAITING, Phase.FORMING, Phase.FORMED, Phase.MOVING, Phase.HOLDING, Phase.RETURNING})
"""phases in which a vehicle follows its slot, so that a pair shares the avoidance"""
FILTERED_PHASES = FORMATION_PHASES | {Phase.DETACHED}
"""phases in which a vehicle's own safety filter steers it"""
SETTLED_PHASES = frozenset({Phase.FORMED, Phase.MOVING, Phase.HOLDING})
"""phases of a vehicle that has taken its slot"""
LOW_PHASES = frozenset({Phase.IDLE, Phase.PREFLIGHT, Phase.ARMED, Phase.LANDING, Phase.LANDED})
"""phases of a vehicle that stands on the ground, or comes down to it"""
FLYING_PHASES = FILTERED_PHASES | {Phase.ARMED, Phase.CLIMBING, Phase.LANDING}
"""phases in which a vehicle hangs on its companion"""
AIRBORNE_PHASES = FLYING_PHASES | {Phase.RELEASED}
"""phases in which a vehicle that says nothing more cannot be taken to stand where it was: an armed one may have been
told to take off"""


class VehicleState(NamedTuple):
    """A vehicle's own state as its estimator tells it."""

    time_ns: int
    """fleet time at which the state held (ns)"""
    position_ned_m: Ned
    velocity_ned_m_s: Ned


class CommonMotion(NamedTuple):
    """What a vehicle takes for the fleet's common velocity where no motion is shared, on the level (fleet frame)."""

    north_m_s: float
    east_m_s: float
    north_m_s2: float
    """the rate with which it changes"""
    east_m_s2: float


class PeerSample(NamedTuple):
    """One published state of a vehicle: its own, or another's passed on in a digest."""

    vehicle_id: int
    time_ns: int
    """the sample's own time (fleet time, ns)"""
    position_ned_m: Ned
    velocity_ned_m_s: Ned
    revision: int
    """revision of the motion under which the sample was made"""
    phase: Phase
    common: CommonMotion | None = None
    """in formation, where no motion is shared; else None"""
    told: tuple[float, ...] = ()
    """what the vehicle's law adds (`core.law.base.Law.fields`)"""


@dataclass(frozen=True, slots=True)
class PeerMessage:
    """Everything one state message says."""

    boot_id: int
    """drawn anew at each start of the sender's process"""
    sequence: int
    """counts the sender's messages modulo 2**32"""
    motion_start_ns: int
    """start of the motion that the sender holds as newest (fleet time, ns)"""
    motion_issuer: int
    sample: PeerSample
    digest: tuple[PeerSample, ...]
    """the sender's latest samples of others, newest first"""
    near_ids: tuple[int, ...] = ()
    """vehicles that the sender finds near (`core.trigger.near`), ascending"""
    due_soon: bool = False
    """the sender speaks in near mode: its next message comes within `trigger.near_period_s` and a control period"""


class Neighbour(NamedTuple):
    """A peer predicted to the present."""

    vehicle_id: int
    position_ned_m: Ned
    velocity_ned_m_s: Ned
    offset_ned_m: Ned
    """desired p_i - p_j (m)"""
    age_s: float
    """age of the sample behind the prediction"""
    in_formation: bool
    """takes part in alignment and cohesion; a gated, stale, landed or lost peer does not"""
    shares_avoidance: bool
    """its own safety filter is active, so that each of the pair takes half"""
    uncertainty_m: float
    """how far from the prediction it may be"""
    last_seen_ned_m: Ned | None = None
    """where a lost peer may stand instead; it is anywhere between the two"""
    reference_velocity_ned_m_s: Ned = ZERO
    """what the plan asks of its slot: differs from the own slot's while slots turn or move"""
    reference_acceleration_ned_m_s2: Ned = ZERO
    told: tuple[float, ...] = ()
    """what its law tells (`core.law.base.Law.fields`), as the law's hold carries it on from the sample"""


class Command(NamedTuple):
    """What the law asks for, before the safety filter."""

    acceleration_ned_m_s2: Ned
    reference_position_ned_m: Ned
    """p_ref,i of the vehicle's slot"""
    reference_velocity_ned_m_s: Ned
    reference_acceleration_ned_m_s2: Ned
    yaw_rad: float


class SafeSetpoint(NamedTuple):
    """What may be sent to an autopilot. Only `core.safety.filter` makes one."""

    velocity_north_m_s: float
    velocity_east_m_s: float
    velocity_down_m_s: float
    acceleration_north_m_s2: float
    acceleration_east_m_s2: float
    position_down_m: float
    """altitude, as fleet-frame down"""
    yaw_rad: float
