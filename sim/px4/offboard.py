"""Offboard set-points as PX4 takes them: what is accepted, what is dropped, and how long the stream was silent."""

import math
import os
from typing import Any

os.environ["MAVLINK20"] = "1"
from pymavlink.dialects.v20 import development as mavlink

from sim.dynamics import HOLD_STILL, NAN, Setpoint

FORCE_BIT = 1 << 9
YAW_BIT = 10
YAW_RATE_BIT = 11


def decode_setpoint(message: Any, yaw_rad: float) -> tuple[Setpoint | None, str]:
    """SET_POSITION_TARGET_LOCAL_NED as PX4 takes it; None and a reason where PX4 drops it.

    Frames LOCAL_NED (1) and BODY_NED (8, turned by `yaw_rad`; no position); force (bit 9) and set-points that say
    nothing finite are dropped.
    """
    mask = message.type_mask

    def take(bit: int, values: tuple[float, float, float]) -> tuple[float, float, float]:
        first, second, third = (
            NAN if mask >> (bit + i) & 1 or not math.isfinite(value) else float(value) for i, value in enumerate(values)
        )
        return first, second, third

    north, east, down = take(0, (message.x, message.y, message.z))
    v_north, v_east, v_down = take(3, (message.vx, message.vy, message.vz))
    a_north, a_east, a_down = take(6, (message.afx, message.afy, message.afz))
    if message.coordinate_frame == mavlink.MAV_FRAME_BODY_NED:
        cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
        v_north, v_east = cosine * v_north - sine * v_east, sine * v_north + cosine * v_east
        a_north, a_east = cosine * a_north - sine * a_east, sine * a_north + cosine * a_east
        north = east = down = NAN
    elif message.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED:
        return None, "setpoint_frame"
    if mask & FORCE_BIT and not all(map(math.isnan, (a_north, a_east, a_down))):
        return None, "setpoint_force"
    values = (north, east, down, v_north, v_east, v_down, a_north, a_east, a_down)
    if all(map(math.isnan, values)):
        return None, "setpoint_empty"
    yaw = NAN if mask >> YAW_BIT & 1 or not math.isfinite(message.yaw) else message.yaw
    rate = NAN if mask >> YAW_RATE_BIT & 1 or not math.isfinite(message.yaw_rate) else message.yaw_rate
    return (
        Setpoint(north, east, down, v_north, v_east, v_down, a_north, a_east, a_down, yaw, rate),
        "",
    )


class SetpointStream:
    """Bookkeeping of the stream: the set-point that flies, how many came, the longest silence while OFFBOARD flew."""

    def __init__(self) -> None:
        self.setpoint = HOLD_STILL
        """standing still until one has come since OFFBOARD was entered"""
        self.count = 0
        self.gap_max_ns = 0
        self._since_ns = 0

    def enter(self, now_ns: int) -> None:
        """OFFBOARD begins to fly: PX4 only takes set-points that come after this."""
        self.setpoint = HOLD_STILL
        self._since_ns = now_ns

    def watch(self, now_ns: int, last_ns: int | None) -> None:
        """One step flown in OFFBOARD, the last valid set-point having come at `last_ns`."""
        begin_ns = self._since_ns if last_ns is None else max(self._since_ns, last_ns)
        self.gap_max_ns = max(self.gap_max_ns, now_ns - begin_ns)
