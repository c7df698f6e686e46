"""Faults of a real PX4 in SITL, ordered like a stub's and carried out by PX4's own means.

MAV_CMD_INJECT_FAILURE for GPS and battery (SYS_FAILURE_EN; for GPS since v1.18), SIH's wind by its parameters, a mode
change as a ground station sends it for the pilot, a relay in the companion's link, and the end of the process with a
new one after it for a reboot.
"""

import json
import os
import socket
import struct
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Protocol

os.environ["MAVLINK20"] = "1"
from pymavlink.dialects.v20 import development as mavlink

from companion.errors import CompanionError
from companion.wire.px4 import Px4Mode, mode_parameters
from sim.autopilot.faults import LASTING, Fault, FaultKind, decode_order

ORDER_PORT = 25100
"""UDP port on which the host takes orders for instance i: this plus i"""
GPS_UNIT, BATTERY_UNIT = 4, 100
"""FAILURE_UNIT"""
WORKING, OFF, STUCK, WRONG = 0, 1, 2, 4
"""FAILURE_TYPE"""
INJECTED: Mapping[FaultKind, tuple[int, int]] = {
    FaultKind.GPS_LOST: (GPS_UNIT, OFF),
    FaultKind.GPS_STUCK: (GPS_UNIT, STUCK),
    FaultKind.GPS_WRONG: (GPS_UNIT, WRONG),
    FaultKind.LOW_BATTERY: (BATTERY_UNIT, OFF),
}
GPS_USED = "SIM_GPS_USED"
"""satellites of the simulated receiver; below four it has no fix. It stands in for an injected failure before v1.18"""
GPS_USED_DEFAULT = 10
WIND = ("SIH_WIND_N", "SIH_WIND_E")
KINDS = frozenset({*INJECTED, FaultKind.WIND, FaultKind.PILOT_TAKEOVER, FaultKind.REBOOT, FaultKind.LINK_LOST})


def kinds_of(has_parameter: Callable[[str], bool]) -> frozenset[FaultKind]:
    """What a build can suffer."""
    without = set() if has_parameter(WIND[0]) else {FaultKind.WIND, FaultKind.GPS_STUCK, FaultKind.GPS_WRONG}
    return KINDS - without


class Sufferer(Protocol):
    """One running instance, as faults reach it."""

    system_id: int

    def send(self, message: Any) -> None:
        """A MAVLink message as a ground station's."""

    def cut_link(self, cut: bool) -> None:
        """Nothing passes the companion's link, or all does again."""

    def reboot(self) -> None:
        """End the process; another takes its place."""


@dataclass(slots=True)
class InstanceFaults:
    """Those of one instance: what is ordered is done at once, what lasts is ended in its time."""

    vehicle_id: int
    instance: Sufferer
    has_parameter: Callable[[str], bool]
    calm_m_s: tuple[float, float]
    """SIH's wind without a fault: north, east"""
    _ends_s: dict[FaultKind, float] = field(default_factory=dict)

    def carry_out(self, order: bytes, now_s: float) -> str | None:
        """Do what a datagram orders; returns why not."""
        try:
            vehicle_id, fault = decode_order(order)
            if vehicle_id != self.vehicle_id:
                raise ValueError(f"this is vehicle {self.vehicle_id}, not {vehicle_id}")
            known = kinds_of(self.has_parameter)
            if fault.kind not in known:
                raise ValueError(f"this PX4 suffers {', '.join(sorted(known))}, got {fault.kind}")
            self._begin(fault, now_s)
        except (ValueError, TypeError, CompanionError) as error:
            return str(error)
        return None

    def _begin(self, fault: Fault, now_s: float) -> None:
        if fault.kind in LASTING and not fault.duration_s > 0.0:
            self._end(fault.kind)
            return
        self._set(fault.kind, fault, begins=True)
        if fault.kind in LASTING:
            self._ends_s[fault.kind] = now_s + fault.duration_s

    def end_due(self, now_s: float) -> None:
        """End those whose time is over."""
        for kind in [kind for kind, end_s in self._ends_s.items() if now_s >= end_s]:
            self._end(kind)

    def forget(self) -> None:
        """A boot ends them all."""
        self._ends_s.clear()

    def _end(self, kind: FaultKind) -> None:
        if self._ends_s.pop(kind, None) is not None:
            self._set(kind, Fault(kind), begins=False)

    def _set(self, kind: FaultKind, fault: Fault, *, begins: bool) -> None:
        match kind:
            case FaultKind.GPS_LOST if not self.has_parameter(WIND[0]):
                self._parameter(GPS_USED, 0 if begins else GPS_USED_DEFAULT)
            case _ if kind in INJECTED:
                unit, how = INJECTED[kind]
                self._command(mavlink.MAV_CMD_INJECT_FAILURE, unit, how if begins else WORKING)
            case FaultKind.WIND:
                speeds = fault.wind_ned_m_s[:2] if begins else self.calm_m_s
                for name, speed in zip(WIND, speeds, strict=True):
                    self._parameter(name, float(speed))
            case FaultKind.PILOT_TAKEOVER:
                self._command(*mode_parameters(Px4Mode.AUTO_LOITER))
            case FaultKind.REBOOT:
                self.instance.reboot()
            case FaultKind.LINK_LOST:
                self.instance.cut_link(begins)

    def _command(self, command: int, *parameters: float) -> None:
        values = [*parameters, *([0.0] * (7 - len(parameters)))]
        self.instance.send(mavlink.MAVLink_command_long_message(self.instance.system_id, 1, command, 0, *values))

    def _parameter(self, name: str, value: float | int) -> None:
        kind = mavlink.MAV_PARAM_TYPE_INT32 if isinstance(value, int) else mavlink.MAV_PARAM_TYPE_REAL32
        wire = bytewise(value) if isinstance(value, int) else value
        self.instance.send(mavlink.MAVLink_param_set_message(self.instance.system_id, 1, name.encode(), wire, kind))


def bytewise(value: int) -> float:
    """The float whose bytes are those of an INT32, as PX4 wants it in PARAM_SET."""
    return float(struct.unpack("<f", struct.pack("<i", value))[0])


def answer_orders(orders: socket.socket, faults: InstanceFaults, now_s: float) -> None:
    """Take every order that waits, and say to each sender what came of it."""
    while True:
        try:
            order, sender = orders.recvfrom(4096)
        except BlockingIOError:
            return
        except ConnectionError:
            continue
        refused = faults.carry_out(order, now_s)
        with suppress(OSError):
            orders.sendto(json.dumps({"refused": refused}).encode(), sender)
