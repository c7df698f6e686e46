"""What strangers send, and what is left of a vehicle's account without a machine's stalls."""

from __future__ import annotations

import random
import socket
from math import nan

from pymavlink.dialects.v20 import development as dialect

from companion.wire.operator import Status

LOOPBACK = "127.0.0.1"


def datagrams(system_id: int) -> list[bytes]:
    """What a companion may be sent by somebody who is not its autopilot, or by a broken one."""
    mine = dialect.MAVLink(None, srcSystem=system_id, srcComponent=1)
    other = dialect.MAVLink(None, srcSystem=222, srcComponent=1)
    heartbeat = dialect.MAVLink_heartbeat_message(2, 12, 81, 0, 3, 3)
    position = dialect.MAVLink_local_position_ned_message(1000, nan, 0.0, 0.0, 0.0, 0.0, 0.0)
    infinite = dialect.MAVLink_local_position_ned_message(1000, 0.0, 0.0, 0.0, float("inf"), 0.0, 0.0)
    noise = random.Random(7)
    whole = heartbeat.pack(mine)
    return [
        *(noise.randbytes(n) for n in (1, 9, 40, 280, 2000)),
        b"",
        b"\xfd" + noise.randbytes(30),
        whole[:11],
        whole[:-1],
        whole[:-2] + b"\0\0",
        heartbeat.pack(other),
        position.pack(mine),
        infinite.pack(mine),
    ]


def send(port: int, messages: list[bytes]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind((LOOPBACK, 0))
        for message in messages:
            s.sendto(message, (LOOPBACK, port))


def failsafes(said: list[str]) -> list[str]:
    """All but what a machine that stalls for half a second does to a vehicle; that is not what is tested here."""
    return [what for what in said if "own position stale" not in what]


def rejected(status: Status, kind: str) -> int:
    return status.rejected.get(kind, 0)
