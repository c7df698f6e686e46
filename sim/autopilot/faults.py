"""Faults that a test or an operator orders from the stand-in autopilot. Values only; the autopilot carries them out."""

import json
import math
from dataclasses import dataclass
from enum import StrEnum

from companion.core.frames import Ned


class FaultKind(StrEnum):
    """What breaks. `magnitude` of `Fault` means, and defaults to, what is said here."""

    GPS_LOST = "gps_lost"
    """no fix; the estimate drifts by magnitude m/s (0.3), and is invalid after EKF2_NOAID_TOUT"""
    POSITION_FROZEN = "position_frozen"
    """positions reported repeat themselves with fresh time stamps; velocities go on"""
    ESTIMATOR_RESET = "estimator_reset"
    """the estimator's origin moves by offset_ned_m, local positions jump by as much the other way"""
    NOISE = "noise"
    """the estimate's error grows by magnitude m and m/s per axis (0.5)"""
    LOW_BATTERY = "low_battery"
    """the battery is at the fraction magnitude (0.06: critical)"""
    REBOOT = "reboot"
    """the autopilot restarts, wherever it is; the motors stop"""
    MUTE = "mute"
    """nothing is sent any more; what arrives still counts"""
    PILOT_TAKEOVER = "pilot_takeover"
    """a pilot appears and switches to position mode"""
    PILOT_STICKS = "pilot_sticks"
    """a pilot appears and moves the sticks, which COM_RC_OVERRIDE may or may not take for a takeover"""
    RC_KILL = "rc_kill"
    """the pilot's kill switch"""
    SLOW_LINK = "slow_link"
    """the link carries magnitude bytes/s towards the companion (5760, a radio at 57600 baud)"""
    LINK_LOST = "link_lost"
    """nothing passes the link, either way"""
    WIND = "wind"
    """the air flows with wind_ned_m_s; afterwards as before"""
    GPS_STUCK = "gps_stuck"
    """the receiver repeats its last fix; of a PX4 alone, which is told so by MAV_CMD_INJECT_FAILURE"""
    GPS_WRONG = "gps_wrong"
    """the receiver tells of a fix in two dimensions; of a PX4 alone"""


DEFAULT_MAGNITUDE = {
    FaultKind.GPS_LOST: 0.3,
    FaultKind.NOISE: 0.5,
    FaultKind.LOW_BATTERY: 0.06,
    FaultKind.SLOW_LINK: 5760.0,
}
LASTING = frozenset(
    {
        FaultKind.GPS_LOST,
        FaultKind.POSITION_FROZEN,
        FaultKind.NOISE,
        FaultKind.LOW_BATTERY,
        FaultKind.MUTE,
        FaultKind.SLOW_LINK,
        FaultKind.LINK_LOST,
        FaultKind.WIND,
        FaultKind.GPS_STUCK,
        FaultKind.GPS_WRONG,
    }
)
"""faults that have an end; the others happen at once"""
OF_PX4_ALONE = frozenset({FaultKind.GPS_STUCK, FaultKind.GPS_WRONG})
"""what a stub does not play"""
DEFAULT_OFFSET_NED_M = Ned(4.0, -3.0, 0.5)
CALM = Ned(0.0, 0.0, 0.0)
WIND_MAX_M_S = 30.0


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of one vehicle, from the moment it is injected."""

    kind: FaultKind
    magnitude: float | None = None
    """as said at the kind; None: its default"""
    duration_s: float = math.inf
    """how long a lasting fault lasts, s; 0 ends one that is there"""
    offset_ned_m: Ned = DEFAULT_OFFSET_NED_M
    """of an estimator reset: how far the origin moves, m"""
    wind_ned_m_s: Ned = CALM
    """of a wind: where the air flows to, level, m/s"""

    def __post_init__(self) -> None:
        if not self.duration_s >= 0.0:
            raise ValueError(f"duration_s must be >= 0 s, got {self.duration_s}")
        if self.magnitude is not None and not 0.0 <= self.magnitude < math.inf:
            raise ValueError(f"magnitude must be >= 0, got {self.magnitude}")
        if not (all(abs(x) <= WIND_MAX_M_S for x in self.wind_ned_m_s) and self.wind_ned_m_s.down == 0.0):
            raise ValueError(f"wind_ned_m_s must be level and at most {WIND_MAX_M_S:g} m/s, got {self.wind_ned_m_s}")

    @property
    def strength(self) -> float:
        """The magnitude, or the kind's default."""
        return DEFAULT_MAGNITUDE.get(self.kind, 0.0) if self.magnitude is None else self.magnitude


def encode_order(vehicle_id: int, fault: Fault) -> bytes:
    """One line that orders a fault from the host of the stand-ins; see `decode_order`."""
    order: dict[str, object] = {
        "vehicle": vehicle_id,
        "kind": fault.kind.value,
        "offset_ned_m": list(fault.offset_ned_m),
        "wind_ned_m_s": list(fault.wind_ned_m_s),
    }
    if fault.magnitude is not None:
        order["magnitude"] = fault.magnitude
    if math.isfinite(fault.duration_s):
        order["duration_s"] = fault.duration_s
    return json.dumps(order).encode() + b"\n"


def decode_order(line: bytes) -> tuple[int, Fault]:
    """Vehicle and fault of a line `{"vehicle": 3, "kind": "gps_lost", "magnitude": 0.3, "duration_s": 8}`.

    Only vehicle and kind are needed. Raises ValueError that says what came and what is allowed.
    """
    order = json.loads(line)
    if not isinstance(order, dict):
        raise ValueError(f"a fault is ordered by a JSON object, got {order!r}")
    allowed = {"vehicle", "kind", "magnitude", "duration_s", "offset_ned_m", "wind_ned_m_s"}
    if unknown := set(order) - allowed:
        raise ValueError(f"unknown keys {sorted(unknown)}, allowed are {sorted(allowed)}")
    vehicle_id, kind = order.get("vehicle"), order.get("kind")
    if not isinstance(vehicle_id, int):
        raise ValueError(f"vehicle must be a whole number, got {vehicle_id!r}")
    if kind not in set(FaultKind):
        raise ValueError(f"kind must be one of {', '.join(FaultKind)}, got {kind!r}")
    magnitude = order.get("magnitude")
    return vehicle_id, Fault(
        FaultKind(kind),
        None if magnitude is None else float(magnitude),
        float(order.get("duration_s", math.inf)),
        Ned(*(float(value) for value in order.get("offset_ned_m", DEFAULT_OFFSET_NED_M))),
        Ned(*(float(value) for value in order.get("wind_ned_m_s", CALM))),
    )
