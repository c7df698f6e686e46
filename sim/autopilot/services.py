"""MAVLink's small protocols as PX4 answers them: parameters, missions (none), files (none), time, ping. Sans-I/O."""

import os
import struct
from collections.abc import Callable
from typing import Any

os.environ["MAVLINK20"] = "1"
from pymavlink.dialects.v20 import development as mavlink

from sim.autopilot.link import Link
from sim.autopilot.parameters import HASH_INDEX, HASH_NAME, TYPE_UINT32, ParameterTable

TYPE_MISMATCH = 7
"""MAV_PARAM_ERROR; newer than pymavlink's dialect"""
FTP_NAK = 129
"""opcode of a refusal"""
FTP_UNKNOWN_COMMAND = 7
"""its error code"""


class Services:
    """Answers every request of these protocols that is addressed to the autopilot."""

    def __init__(self, link: Link, parameters: ParameterTable, on_parameter_changed: Callable[[], None]) -> None:
        self._link = link
        self._parameters = parameters
        self._on_parameter_changed = on_parameter_changed
        self.listing: list[int] = []
        """indices of the parameter list that is being sent"""

    def step(self) -> None:
        """Goes on with the parameter list, one a step."""
        if self.listing:
            self._send_parameter(self.listing.pop(0))

    def synchronise(self, message: Any) -> None:
        """TIMESYNC: own boot time back, the other's mirrored."""
        if message.tc1 == 0:
            self._link.send(mavlink.MAVLink_timesync_message(self._link.now_ns, message.ts1))

    def ping(self, message: Any) -> None:
        """PING: a request is mirrored to its sender."""
        if message.target_system == 0 and message.target_component == 0:
            self._link.send(
                mavlink.MAVLink_ping_message(
                    message.time_usec, message.seq, message.get_srcSystem(), message.get_srcComponent()
                )
            )

    def list_parameters(self) -> None:
        """PARAM_REQUEST_LIST: the hash first, then all by index."""
        self.listing = [HASH_INDEX, *range(len(self._parameters))]

    def read_parameter(self, message: Any) -> None:
        """PARAM_REQUEST_READ, by index or by name."""
        table = self._parameters
        if message.param_index >= 0:
            if message.param_index < len(table):
                self._send_parameter(message.param_index)
            else:
                self._refuse_parameter(message, "", message.param_index, mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST)
        elif message.param_id == HASH_NAME:
            self._send_parameter(HASH_INDEX)
        elif message.param_id in table:
            self._send_parameter(table.index(message.param_id))
        else:
            self._refuse_parameter(message, message.param_id, -1, mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST)

    def _refuse_parameter(self, message: Any, name: str, index: int, error: int) -> None:
        """PARAM_ERROR to who asked, of versions that say it; the others are silent."""
        if self._parameters.version.parameter_errors:
            self._link.send(
                mavlink.MAVLink_param_error_message(
                    message.get_srcSystem(), message.get_srcComponent(), name.encode(), index, error
                )
            )

    def set_parameter(self, message: Any) -> bool:
        """PARAM_SET: a change is echoed twice, the same value once; False: refused."""
        table = self._parameters
        changed = table.set_from_wire(message.param_id, message.param_value, message.param_type)
        if changed is None:
            known = message.param_id in table
            error = TYPE_MISMATCH if known else mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST
            self._refuse_parameter(message, message.param_id, -1, error)
            return False
        for _ in range(2 if changed else 1):
            self._send_parameter(table.index(message.param_id))
        if changed:
            self._on_parameter_changed()
        return True

    def _send_parameter(self, index: int) -> None:
        table = self._parameters
        if index == HASH_INDEX:
            name, value, kind = HASH_NAME, table.hash_check(), TYPE_UINT32
        else:
            name = table.names[index]
            value, kind = table.wire_value(name), table.wire_type(name)
        self._link.send(mavlink.MAVLink_param_value_message(name.encode(), value, kind, len(table), index))

    def count_mission(self, message: Any) -> None:
        """MISSION_REQUEST_LIST: there is no mission, no fence and no rally point."""
        self._link.send(
            mavlink.MAVLink_mission_count_message(
                message.get_srcSystem(), message.get_srcComponent(), 0, message.mission_type
            )
        )

    def clear_mission(self, message: Any) -> None:
        """MISSION_CLEAR_ALL, and an upload of nothing."""
        self._acknowledge_mission(message, mavlink.MAV_MISSION_ACCEPTED)

    def refuse_mission(self, message: Any) -> None:
        """MISSION_COUNT above zero: nothing can be stored."""
        self._acknowledge_mission(message, mavlink.MAV_MISSION_NO_SPACE)

    def _acknowledge_mission(self, message: Any, result: int) -> None:
        self._link.send(
            mavlink.MAVLink_mission_ack_message(
                message.get_srcSystem(), message.get_srcComponent(), result, message.mission_type
            )
        )

    def refuse_file_transfer(self, message: Any) -> None:
        """FILE_TRANSFER_PROTOCOL: NAK. A client that gets no answer at all waits for many seconds."""
        sequence, session, opcode = struct.unpack_from("<HBB", bytes(message.payload))
        reply = struct.pack("<HBBBBBBI", sequence + 1 & 0xFFFF, session, FTP_NAK, 1, opcode, 0, 0, 0)
        reply += bytes([FTP_UNKNOWN_COMMAND])
        self._link.send(
            mavlink.MAVLink_file_transfer_protocol_message(
                0, message.get_srcSystem(), message.get_srcComponent(), list(reply.ljust(251, b"\0"))
            )
        )
