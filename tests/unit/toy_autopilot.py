"""An autopilot of another kind than PX4, and no link: it does at once what is asked, or what a test has it do."""

from collections import Counter
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any

from companion.config import FleetConfig, load
from companion.core.events import Event
from companion.core.frames import Ned
from companion.core.health import PositionWatch
from companion.core.values import ZERO, Instant, Phase, SafeSetpoint
from companion.vehicle.agent import Agent
from companion.vehicle.autopilot.port import (
    HOLD,
    LAND,
    OFFBOARD,
    TAKE_OFF,
    AutopilotFacts,
    AutopilotPort,
    Estimate,
    FlightMode,
    Outcome,
    Verb,
)
from companion.vehicle.flight import Flight

SURE = Estimate(7, 7, 0.5)
STABLE = FlightMode("STABLE")
"""what a pilot flies by hand"""
FILE = Path(__file__).resolve().parents[2] / "fleet.toml"
UTC_NS = 1_790_000_000_000_000_000


def fleet(**tables: dict[str, Any]) -> FleetConfig:
    """Three vehicles, with some values of their tables changed."""

    def change(all_tables: dict[str, Any]) -> None:
        all_tables["vehicle"] = all_tables["vehicle"][:3]
        for name, values in tables.items():
            all_tables.setdefault(name, {}).update(values)

    return load(FILE, change)


CONFIG = fleet()


def at(seconds: float) -> Instant:
    return Instant(round(seconds * 1e9), UTC_NS + round(seconds * 1e9))


@dataclass
class ToyAutopilot:
    """`AutopilotPort` by plain fields; what is asked stands in `asked`, and is done at once where it is `obedient`."""

    obedient: bool = True
    events: list[Event] = field(default_factory=list)
    heard: int = 0
    heartbeat_ns: int | None = None
    armed: bool = False
    mode: FlightMode = STABLE
    acts_by_itself: bool = False
    on_ground: bool | None = True
    position_ns: int | None = None
    position_ned_m: Ned = ZERO
    velocity_ned_m_s: Ned = ZERO
    origin_crept_ned_m: Ned = ZERO
    battery_percent: int = 80
    battery_told: bool = True
    sure: Estimate = SURE
    outcomes: dict[Verb, Outcome] = field(default_factory=dict)
    asked: list[Verb] = field(default_factory=list)
    withdrawn: list[Verb] = field(default_factory=list)
    origin_doubted: int = 0
    altitude_amsl_m: float | None = None
    rejected: Counter[str] = field(default_factory=Counter)

    def lives(self, now: Instant) -> None:
        """A sign of life and a position."""
        self.heartbeat_ns = self.position_ns = now.monotonic_ns

    @property
    def mode_name(self) -> str:
        return self.mode.name.upper()

    def receive(self, datagram: bytes, now: Instant) -> bool:
        return False

    def due(self, now: Instant) -> list[bytes]:
        return []

    def next_deadline_ns(self) -> int:
        return 1 << 62

    def setpoint(self, setpoint: SafeSetpoint) -> bytes:
        return repr(setpoint).encode()

    def state(self, now: Instant) -> tuple[Ned, Ned] | None:
        return None if self.position_age_s(now) > 0.5 else (self.position_ned_m, self.velocity_ned_m_s)

    def position_age_s(self, now: Instant) -> float:
        return inf if self.position_ns is None else (now.monotonic_ns - self.position_ns) * 1e-9

    def heartbeat_age_s(self, now: Instant) -> float | None:
        return None if self.heartbeat_ns is None else (now.monotonic_ns - self.heartbeat_ns) * 1e-9

    def estimate(self, now: Instant) -> Estimate:
        return self.sure

    def battery(self, now: Instant) -> int:
        return self.battery_percent if self.battery_told else -1

    def facts(self, now: Instant) -> AutopilotFacts:
        return AutopilotFacts(heartbeat_age_s=self.heartbeat_age_s(now), estimate=self.sure)

    def arm(self) -> None:
        self._ask(Verb.ARM)
        self.armed = self.armed or self.obedient

    def take_off(self, altitude_amsl_m: float) -> None:
        self.altitude_amsl_m = altitude_amsl_m
        self._ask(Verb.TAKE_OFF, TAKE_OFF)

    def engage(self) -> None:
        self._ask(Verb.ENGAGE, OFFBOARD)

    def hold(self) -> None:
        self._ask(Verb.HOLD, HOLD)

    def land(self) -> None:
        self._ask(Verb.LAND, LAND)

    def kill(self) -> None:
        self._ask(Verb.KILL)
        self.armed = self.armed and not self.obedient

    def _ask(self, verb: Verb, mode: FlightMode | None = None) -> None:
        self.asked.append(verb)
        if mode is not None and self.obedient:
            self.mode = mode

    def outcome(self, verb: Verb) -> Outcome | None:
        return self.outcomes.get(verb)

    def withdraw(self, *verbs: Verb) -> None:
        self.withdrawn += verbs

    def cancel(self) -> None:
        self.asked.clear()

    def doubt_origin(self) -> None:
        self.origin_doubted += 1


def flight(phase: Phase = Phase.IDLE, config: FleetConfig = CONFIG, **said: Any) -> Flight:
    """A flight of vehicle 1 in a phase that began at 0 s, with an autopilot that has said this; peers are silent."""
    autopilot: AutopilotPort = ToyAutopilot(**said)
    agent = Agent(config, 1, 7)
    positions = PositionWatch()
    return Flight(config, autopilot, agent.history, agent.peers, positions, phase=phase, positioned=True)


def said(one: Flight) -> ToyAutopilot:
    """The flight's autopilot, for a test to change."""
    assert isinstance(one.autopilot, ToyAutopilot)
    return one.autopilot
