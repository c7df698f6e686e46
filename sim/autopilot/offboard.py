"""Offboard set-points as PX4 takes them: what is accepted, what is dropped, and how long the stream was silent."""

import math
import os
from math import isfinite, isnan
from typing import Any, NamedTuple

os.environ["MAVLINK20"] = "1"
from pymavlink.dialects.v20 import development as mavlink

from sim.autopilot.setpoint import HOLD_STILL, NAN, Setpoint

FORCE_BIT = 1 << 9
YAW_BIT = 10
YAW_RATE_BIT = 11


class SetpointFields(NamedTuple):
    """SET_POSITION_TARGET_LOCAL_NED's fields in the wire's order, named as pymavlink names them."""

    time_boot_ms: int
    x: float
    y: float
    z: float
    vx: float
    vy: float
    vz: float
    afx: float
    afy: float
    afz: float
    yaw: float
    yaw_rate: float
    type_mask: int
    target_system: int
    target_component: int
    coordinate_frame: int


def decode_setpoint(message: Any, yaw_rad: float) -> tuple[Setpoint | None, str]:
    """SET_POSITION_TARGET_LOCAL_NED as PX4 takes it; None and a reason where PX4 drops it.

    Frames LOCAL_NED (1) and BODY_NED (8, turned by `yaw_rad`; no position); force (bit 9) and set-points that say
    nothing finite are dropped.
    """
    m, mask = message, message.type_mask
    north, east, down, v_north, v_east, v_down, a_north, a_east, a_down = [
        NAN if mask >> bit & 1 or not isfinite(value) else value
        for bit, value in enumerate((m.x, m.y, m.z, m.vx, m.vy, m.vz, m.afx, m.afy, m.afz))
    ]
    if message.coordinate_frame == mavlink.MAV_FRAME_BODY_NED:
        cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
        v_north, v_east = cosine * v_north - sine * v_east, sine * v_north + cosine * v_east
        a_north, a_east = cosine * a_north - sine * a_east, sine * a_north + cosine * a_east
        north = east = down = NAN
    elif message.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED:
        return None, "setpoint_frame"
    if mask & FORCE_BIT and not all(map(isnan, (a_north, a_east, a_down))):
        return None, "setpoint_force"
    values = (north, east, down, v_north, v_east, v_down, a_north, a_east, a_down)
    if all(map(isnan, values)):
        return None, "setpoint_empty"
    yaw = NAN if mask >> YAW_BIT & 1 or not isfinite(message.yaw) else message.yaw
    rate = NAN if mask >> YAW_RATE_BIT & 1 or not isfinite(message.yaw_rate) else message.yaw_rate
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
        begin_ns = self._since_ns
        if last_ns is not None and last_ns > begin_ns:
            begin_ns = last_ns
        self.gap_max_ns = max(self.gap_max_ns, now_ns - begin_ns)
