"""Bytes that this process's TCP connections have put on the interface, as the kernel counts them."""

import os
import socket
import struct

ETHERNET_IP_TCP_BYTES = 14 + 20 + 32
"""headers of a segment: Ethernet, IPv4, TCP with time stamps"""
_BYTES_SENT_AT = 200
_SEGMENTS_OUT_AT = 136


def tcp_bytes_sent() -> int:
    """Bytes sent over all open TCP connections of this process, headers and keep-alives included (TCP_INFO)."""
    total = 0
    for name in os.listdir("/proc/self/fd"):
        try:
            if not os.readlink(f"/proc/self/fd/{name}").startswith("socket:"):
                continue
            copy = socket.socket(fileno=os.dup(int(name)))
        except OSError:
            continue
        with copy:
            if copy.type != socket.SOCK_STREAM or copy.family not in (socket.AF_INET, socket.AF_INET6):
                continue
            try:
                info = copy.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256)
            except OSError:
                continue
        if len(info) >= _BYTES_SENT_AT + 8:
            sent = struct.unpack_from("@Q", info, _BYTES_SENT_AT)[0]
            segments = struct.unpack_from("@I", info, _SEGMENTS_OUT_AT)[0]
            total += sent + segments * ETHERNET_IP_TCP_BYTES
    return total
