"""A new fleet.toml: the shipped one, comments and all, for other vehicles and another network."""

import re
from ipaddress import AddressValueError, IPv4Address
from pathlib import Path

from companion.config.bounds import NOTICE_LOST_S
from companion.config.endpoints import serial_endpoint, udp_endpoint
from companion.config.file import parse_text
from companion.errors import ConfigError
from companion.shipped import FLEET_FILE, shipped

PEER_PORT = 7447
"""Zenoh's own"""
FIRST_ADDRESS, LINE = "10.0.0.11", "serial:///dev/autopilot:921600"


def new_fleet_text(
    vehicles: int | None, name: str | None, network: str, first_address: str | None, line: str | None
) -> str:
    """The text of a fleet file, validated; ConfigError if these vehicles cannot fly so.

    `first_address` (IPv4) and `line` (a MAVLink URL) are of a network "field", where each vehicle has a computer.
    """
    if network not in NOTICE_LOST_S:
        raise ConfigError(f"--network must be {' or '.join(NOTICE_LOST_S)}, got {network!r}")
    for option, value in (("--first-address", first_address), ("--line", line)):
        if value is not None and network != "field":
            raise ConfigError(f"{option} belongs to --network field, got it with {network}")
    text = shipped(FLEET_FILE).read_text(encoding="utf-8")
    head, *listed = text.split("[[vehicle]]")
    count = len(listed) if vehicles is None else vehicles
    if name is not None:
        head = _put(head, "name", name)
    if network != "laptop":
        head = _put(head, "network", network)
    rows = [f"[[vehicle]]\nid = {k + 1}\n" for k in range(count)]
    if network == "field":
        rows = [
            row + more
            for row, more in zip(rows, _addresses(count, first_address or FIRST_ADDRESS, line or LINE), strict=True)
        ]
    if vehicles is not None:
        head = head.replace("ten vehicles", f"{count} vehicle{'s' if count > 1 else ''}", 1)
    written = head + "\n".join(rows)
    parse_text(written, Path(FLEET_FILE))
    return written


def _put(text: str, key: str, value: str) -> str:
    """The first line `key = "..."` with another value, its comment kept."""
    quoted = value.replace("\\", "\\\\").replace('"', '\\"')
    return re.sub(rf'^{key} = "[^"]*"', lambda _: f'{key} = "{quoted}"', text, count=1, flags=re.MULTILINE)


def _addresses(count: int, first_address: str, line: str) -> list[str]:
    """The lines of a table that give a vehicle its line and its address."""
    if udp_endpoint(line) is None and serial_endpoint(line) is None:
        raise ConfigError(f"--line must be udp://HOST:PORT or serial:///dev/NAME:BAUD, got {line!r}")
    try:
        first = IPv4Address(first_address)
        return [f'mavlink = "{line}"\nzenoh = "tcp/{first + k}:{PEER_PORT}"\n' for k in range(count)]
    except AddressValueError:
        raise ConfigError(f"--first-address must be an IPv4 address as 10.0.0.11, got {first_address!r}") from None
