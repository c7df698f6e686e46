"""Faults from outside: `fleet fault`, and scenario files of `fleet up`.

An autopilot's is one datagram: to the port on which the host of SITL instances takes orders, or to the stub's own. A
companion's is carried out by the launcher on its process.
"""

import json
import socket
from dataclasses import dataclass
from enum import StrEnum
from math import inf
from pathlib import Path
from typing import Any

from companion.config import FleetConfig
from companion.config.derived import Vehicle
from companion.config.file import read_tables
from companion.errors import CompanionError, ConfigError
from sim.autopilot.faults import Fault, FaultKind, decode_order, encode_order
from sim.autopilot.stub_fleet import stub_port
from sim.launch.sitl_faults import ORDER_PORT

ANSWER_TIMEOUT_S = 1.0
TRIES = 3
STOPPED_S = 3.0


class CompanionFaultKind(StrEnum):
    """What befalls a companion's process."""

    KILLED = "companion_killed"
    """SIGKILL: it says nothing any more"""
    STOPPED = "companion_stopped"
    """it stands still (SIGSTOP) for duration_s (3), and goes on"""
    RESTARTED = "companion_restarted"
    """SIGKILL, and another one is started at once"""


@dataclass(frozen=True, slots=True)
class CompanionFault:
    """One fault of a companion's process."""

    kind: CompanionFaultKind
    duration_s: float = STOPPED_S
    """of a standstill"""

    def __post_init__(self) -> None:
        if not 0.0 < self.duration_s < inf:
            raise ValueError(f"duration_s must be > 0 s and finite, got {self.duration_s}")


KINDS = (*FaultKind, *CompanionFaultKind)


def order_fault(config: FleetConfig, vehicle_id: int, fault: Fault) -> None:
    """Have a running autopilot of this machine suffer a fault; CompanionError if it does not answer or refuses."""
    vehicle = config.by_id(vehicle_id)
    for _ in range(TRIES):
        for port in _order_ports(vehicle):
            if (answer := _ordered(port, encode_order(vehicle_id, fault))) is None:
                continue
            if answer.get("refused"):
                raise CompanionError(f"vehicle {vehicle_id} refused: {answer['refused']}")
            return
    ports = " nor ".join(str(port) for port in _order_ports(vehicle))
    raise CompanionError(
        f"nobody answers at UDP 127.0.0.1:{ports}: does vehicle {vehicle_id} fly on this machine, as a stub or a PX4 "
        "that `fleet up` has started?"
    )


def _order_ports(vehicle: Vehicle) -> tuple[int, int]:
    """Where the autopilot's host may take orders: of SITL instances, of a stub. A port of nobody refuses at once."""
    return ORDER_PORT + vehicle.instance, stub_port(vehicle)


def _ordered(port: int, order: bytes) -> dict[str, Any] | None:
    """What came back; None: nobody is there, or nothing that is an answer."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.settimeout(ANSWER_TIMEOUT_S)
        try:
            s.connect(("127.0.0.1", port))
            s.send(order)
            answer = json.loads(s.recv(4096))
        except (TimeoutError, ConnectionRefusedError, ValueError):
            return None
        return answer if isinstance(answer, dict) else None


@dataclass(frozen=True, slots=True)
class ScheduledFault:
    """One line of a scenario."""

    at_s: float
    """after the take-off command"""
    vehicle_id: int
    fault: Fault | CompanionFault


def load_scenario(path: Path, config: FleetConfig) -> tuple[ScheduledFault, ...]:
    """Faults of a scenario file, in the order of their times.

    The file has tables `[[fault]]` with at_s (s after take-off), vehicle, kind, and optionally magnitude, duration_s,
    offset_ned_m, wind_ned_m_s. ConfigError names file, table and what is wrong.
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
            vehicle_id, fault = _decoded(order)
        except (ValueError, TypeError) as error:
            raise ConfigError(f"{where}: {error}") from error
        config.by_id(vehicle_id)
        found.append(ScheduledFault(float(at_s), vehicle_id, fault))
    return tuple(sorted(found, key=lambda f: f.at_s))


def _decoded(order: dict[str, Any]) -> tuple[int, Fault | CompanionFault]:
    """Whose fault, and which; ValueError and TypeError say what came and what is allowed."""
    kind = order.get("kind")
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, got {kind!r}")
    if kind not in tuple(CompanionFaultKind):
        return decode_order(json.dumps(order).encode())
    allowed = {"vehicle", "kind", "duration_s"}
    if unknown := set(order) - allowed:
        raise ValueError(f"unknown keys {sorted(unknown)}, allowed with {kind} are {sorted(allowed)}")
    vehicle_id = order.get("vehicle")
    if not isinstance(vehicle_id, int) or isinstance(vehicle_id, bool):
        raise ValueError(f"vehicle must be a whole number, got {vehicle_id!r}")
    return vehicle_id, CompanionFault(CompanionFaultKind(kind), float(order.get("duration_s", STOPPED_S)))
