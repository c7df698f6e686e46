"""Faults from outside: `fleet fault`, and scenario files of `fleet up`. Each is one datagram to the stub's own port."""

import json
import socket
from dataclasses import dataclass
from pathlib import Path

from companion.config import FleetConfig
from companion.config.file import read_tables
from companion.errors import CompanionError, ConfigError
from sim.autopilot.faults import Fault, decode_order, encode_order
from sim.autopilot.stub_fleet import stub_port

ANSWER_TIMEOUT_S = 1.0
TRIES = 3


def order_fault(config: FleetConfig, vehicle_id: int, fault: Fault) -> None:
    """Have a running stub suffer a fault; CompanionError if it does not answer or refuses."""
    address = ("127.0.0.1", stub_port(config.by_id(vehicle_id)))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.settimeout(ANSWER_TIMEOUT_S)
        for _ in range(TRIES):
            try:
                s.sendto(encode_order(vehicle_id, fault), address)
                answer = json.loads(s.recv(4096))
            except (TimeoutError, ConnectionRefusedError):
                continue
            if answer.get("refused"):
                raise CompanionError(f"vehicle {vehicle_id} refused: {answer['refused']}")
            return
    raise CompanionError(f"no stub answers at UDP {address[0]}:{address[1]}: is vehicle {vehicle_id} a stub that runs?")


@dataclass(frozen=True, slots=True)
class ScheduledFault:
    """One line of a scenario."""

    at_s: float
    """after the take-off command"""
    vehicle_id: int
    fault: Fault


def load_scenario(path: Path, config: FleetConfig) -> tuple[ScheduledFault, ...]:
    """Faults of a scenario file, in the order of their times.

    The file has tables `[[fault]]` with at_s (s after take-off), vehicle, kind, and optionally magnitude, duration_s,
    offset_ned_m. ConfigError names file, table and what is wrong.
    """
    tables = read_tables(path)
    rows = tables.get("fault")
    if set(tables) != {"fault"} or not isinstance(rows, list):
        raise ConfigError(f"{path.name}: must hold tables [[fault]] alone, got {', '.join(tables) or 'none'}")
    found = []
    for k, row in enumerate(rows):
        where = f"{path.name}: $.fault[{k}]"
        order = dict(row)
        at_s = order.pop("at_s", None)
        if isinstance(at_s, bool) or not isinstance(at_s, int | float) or not 0 <= at_s < 86_400:
            raise ConfigError(f"{where}.at_s must be a finite number >= 0 and < 86400 s, got {at_s!r}")
        try:
            vehicle_id, fault = decode_order(json.dumps(order).encode())
        except (ValueError, TypeError) as error:
            raise ConfigError(f"{where}: {error}") from error
        config.by_id(vehicle_id)
        found.append(ScheduledFault(float(at_s), vehicle_id, fault))
    return tuple(sorted(found, key=lambda f: f.at_s))
