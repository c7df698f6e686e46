"""Addresses of links (UDP, serial, Zenoh) and the ports that follow from a vehicle's place in the file."""

import re
from urllib.parse import urlsplit

LOOPBACK = frozenset({"localhost", "127.0.0.1", "[::1]", "0.0.0.0", "[::]"})
"""hosts that name the computer itself"""


def companion_port(instance: int) -> int:
    """UDP port on which the companion of an instance listens: PX4's for the first ten, since 14550 is the GCS's."""
    return 14540 + instance if instance < 10 else 24540 + instance


def autopilot_port(instance: int, companion: int | None = None) -> int:
    """UDP port from which the autopilot of an instance sends: 40 above its companion's for the first ten, then 1000.

    `companion` is the companion's port where it is not the instance's own: a fleet whose URLs are shifted has its
    autopilots shifted alike, so that several fit on one machine.
    """
    listening = companion_port(instance) if companion is None else companion
    return listening + (40 if instance < 10 else 1000)


def udp_endpoint(url: str) -> tuple[str, int] | None:
    """Host and port of udp://HOST:PORT (an empty host is any), or None if it is another kind of link."""
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        return None
    if parts.scheme != "udp" or port is None or not 0 < port < 65536 or parts.path not in ("", "/"):
        return None
    return parts.hostname or "0.0.0.0", port


def serial_endpoint(url: str) -> tuple[str, int] | None:
    """Device and baud rate of serial:///dev/NAME:BAUD, or None if it is another kind of link."""
    match = re.fullmatch(r"serial://(/[^:]+):(\d+)", url)
    return (match[1], int(match[2])) if match else None


def zenoh_host(text: str) -> str:
    """HOST of PROTOCOL/HOST:PORT: the computer whose sessions listen there."""
    return text.partition("/")[2].rpartition(":")[0]


def is_zenoh_endpoint(text: str) -> bool:
    """Whether it is PROTOCOL/HOST:PORT of a kind that Zenoh listens on."""
    match = re.fullmatch(r"(tcp|udp|tls|quic)/.+:(\d{1,5})", text)
    return match is not None and 0 < int(match[2]) < 65536
