"""Packets and bytes that this process's TCP connections have sent, as the kernel counts them (TCP_INFO).

An interface's own counters cannot tell that where several companions share it, as they do on a laptop, or where others
use it too. What is missing here are ARP and connections that never opened.
"""

import os
import socket
import struct
from contextlib import suppress

from companion.io.transport import Sent

ETHERNET_IP_TCP_BYTES = 14 + 20 + 32
"""headers of a segment: Ethernet, IPv4, TCP with time stamps"""
_BYTES_SENT_AT = 200
_SEGMENTS_OUT_AT = 136
_SO_COOKIE = 57
"""a number for each socket that no other ever gets"""


class TcpTraffic:
    """Counts over all TCP connections that this process has had, acknowledgements and keep-alives included.

    A connection that ended counts with what it had sent when it was looked at last.
    """

    def __init__(self) -> None:
        self._sent: dict[int, Sent] = {}
        """by socket, of those that are open"""
        self._ended = Sent(0, 0)

    def sent(self) -> Sent:
        """So far."""
        now = dict(_open_connections())
        for cookie in self._sent.keys() - now.keys():
            gone = self._sent[cookie]
            self._ended = Sent(self._ended.packets + gone.packets, self._ended.bytes + gone.bytes)
        self._sent = now
        return Sent(
            self._ended.packets + sum(s.packets for s in now.values()),
            self._ended.bytes + sum(s.bytes for s in now.values()),
        )


def _open_connections() -> list[tuple[int, Sent]]:
    """Each TCP socket of this process with what it has sent."""
    found = []
    for name in os.listdir("/proc/self/fd"):
        with suppress(OSError):
            if not os.readlink(f"/proc/self/fd/{name}").startswith("socket:"):
                continue
            with socket.socket(fileno=os.dup(int(name))) as copy:
                if copy.type != socket.SOCK_STREAM or copy.family not in (socket.AF_INET, socket.AF_INET6):
                    continue
                info = copy.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256)
                cookie = struct.unpack("@Q", copy.getsockopt(socket.SOL_SOCKET, _SO_COOKIE, 8))[0]
            if len(info) >= _BYTES_SENT_AT + 8:
                payload = struct.unpack_from("@Q", info, _BYTES_SENT_AT)[0]
                segments = struct.unpack_from("@I", info, _SEGMENTS_OUT_AT)[0]
                found.append((cookie, Sent(segments, payload + segments * ETHERNET_IP_TCP_BYTES)))
    return found
