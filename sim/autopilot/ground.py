"""The stand-in vehicles on a ground station and in PX4's 3D viewer, as PX4's own scripts put them there.

From UDP 18570 + i each vehicle speaks to the ground station on 14550, with its own system id: telemetry at rates of its
own, whatever its companion has switched off, and the answers to what the ground station asks. The truth goes to
19410 + i as HIL_STATE_QUATERNION.
"""

import socket
from contextlib import suppress
from typing import Any

from pymavlink.dialects.v20 import development as mavlink

from companion.core.frames import Geodetic, ned_to_geodetic
from sim.autopilot.autopilot import GROUND_LINK, Autopilot
from sim.autopilot.link import Link, StreamSchedule
from sim.autopilot.streams import STREAMS
from sim.autopilot.telemetry import quaternion

GROUND_PORT = 14550
GROUND_LINK_PORT = 18570
TRUTH_PORT = 19410
INTERVAL_NS = 40_000_000
"""25 Hz: the truth's rate, and how often telemetry is looked after"""
RATES_HZ = {
    "HEARTBEAT": 1, "ATTITUDE": 10, "GLOBAL_POSITION_INT": 5, "LOCAL_POSITION_NED": 2, "VFR_HUD": 4, "GPS_RAW_INT": 1,
    "SYS_STATUS": 1, "EXTENDED_SYS_STATE": 1, "BATTERY_STATUS": 0.5, "HOME_POSITION": 0.5, "ESTIMATOR_STATUS": 0.5,
    "ALTITUDE": 1, "CURRENT_MODE": 0.5, "SYSTEM_TIME": 1,
}  # fmt: skip
ANSWERS = frozenset({22, 44, 47, 51, 73, 77, 110, 148, 242, 244})
"""what a ground station asks for: parameters, missions, acknowledgements, files, version, home, intervals"""


class GroundLink:
    """One vehicle's side of the ground station's link, and of the viewer's."""

    def __init__(self, instance: int, autopilot: Autopilot, fleet_origin: Geodetic) -> None:
        self._autopilot = autopilot
        self._origin = fleet_origin
        self._viewer = ("127.0.0.1", TRUTH_PORT + instance)
        self._station = ("127.0.0.1", GROUND_PORT)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.socket.bind(("127.0.0.1", GROUND_LINK_PORT + instance))
        self._telemetry: object = None
        self._due_ns = 0
        self._out = Link(autopilot.telemetry.system_id)

    def _follow(self) -> None:
        """Start the streams anew after a boot: telemetry is another object then."""
        self._telemetry = self._autopilot.telemetry
        self._schedule = StreamSchedule(self._out, self._autopilot.telemetry)
        rates = {getattr(mavlink, f"MAVLINK_MSG_ID_{name}"): rate for name, rate in RATES_HZ.items()}
        for message_id in list(STREAMS):
            rate = rates.get(message_id)
            self._schedule.set_interval_us(message_id, -1.0 if rate is None else 1e6 / rate, 0)

    def receive_all(self, now_ns: int) -> None:
        """What the ground station sends goes to the autopilot; its answers leave by the companion's link and here."""
        while True:
            try:
                self._autopilot.receive(self.socket.recv(65535), now_ns)
            except BlockingIOError:
                return
            except ConnectionRefusedError:
                continue  # no ground station listens

    def answers(self, datagram: bytes) -> None:
        """Pass on what left by the companion's link, if a ground station may have asked for it."""
        if datagram[7] | datagram[8] << 8 | datagram[9] << 16 in ANSWERS:
            self._send(datagram, self._station)

    def send_due(self, now_ns: int) -> None:
        """Telemetry that is due, and the truth."""
        if now_ns < self._due_ns:
            return
        self._due_ns = now_ns + INTERVAL_NS
        if self._telemetry is not self._autopilot.telemetry:
            self._follow()
        self._out.now_ns = self._autopilot.now_ns
        if self._schedule.next_due_ns <= self._autopilot.now_ns:
            self._schedule.send_due(self._autopilot.now_ns)
        for datagram in self._out.take():
            self._send(self._autopilot.signing.sign(datagram, GROUND_LINK), self._station)
        message: Any = self._truth()
        self._send(message.pack(self._out.mav), self._viewer)

    def _truth(self) -> Any:
        t = self._autopilot.truth()
        at = ned_to_geodetic(t.position_ned_m, self._origin)
        told = self._autopilot.telemetry
        v, a = t.velocity_ned_m_s, t.acceleration_ned_m_s2
        return mavlink.MAVLink_hil_state_quaternion_message(
            t.time_ns // 1000, quaternion(told.roll_rad, told.pitch_rad, t.yaw_rad), 0.0, 0.0, 0.0,
            round(at.latitude_deg * 1e7), round(at.longitude_deg * 1e7), round(at.altitude_amsl_m * 1e3),
            *(round(x * 100) for x in v), 0, 0, *(round(x / 9.80665 * 1000) for x in a),
        )  # fmt: skip

    def _send(self, datagram: bytes, to: tuple[str, int]) -> None:
        with suppress(BlockingIOError, ConnectionRefusedError):
            self.socket.sendto(datagram, to)
