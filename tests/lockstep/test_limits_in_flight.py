"""Each limit just below, at and just above it, as an autopilot meets it: armed and not, with positions and without.

A setpoint goes to an armed vehicle with fresh positions only, and whatever is asked for, it is within the limits.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import pytest
from flights import fleet, parse, until, wait

from companion.core.frames import Ned
from companion.core.safety.filter import SafetyFilter
from companion.core.values import FILTERED_PHASES, Command, Instant, Neighbour, Phase, SafeSetpoint, VehicleState
from sim.autopilot.faults import Fault, FaultKind
from sim.lockstep.lockstep import Lockstep

SPEED_M_S, ACCELERATION_M_S2, CLIMB_M_S, DESCENT_M_S = 6.0, 5.0, 1.5, 1.0
FLOOR_M, CEILING_M, MARGIN_M = 2.0, 8.0, 0.5
ALTITUDE_M = 4.0
STEP = 0.1
"""below and above a limit, of its size"""
NEAR = 0.04
"""of a limit's size: the level speed is approached, and the estimator's bias is added to all velocities"""


def velocity_north(command: Command, ego: VehicleState, value: float) -> Command:
    return command._replace(acceleration_ned_m_s2=Ned(4.0 * (value - ego.velocity_ned_m_s.north), 0.0, 0.0))


def acceleration_north(command: Command, ego: VehicleState, value: float) -> Command:
    return command._replace(acceleration_ned_m_s2=Ned(value, 0.0, 0.0))


def velocity_down(command: Command, ego: VehicleState, value: float) -> Command:
    return command._replace(reference_velocity_ned_m_s=Ned(0.0, 0.0, value))


def position_down(command: Command, ego: VehicleState, value: float) -> Command:
    return command._replace(reference_position_ned_m=ego.position_ned_m._replace(down=value))


class Limit(NamedTuple):
    """What is asked for, and what of a setpoint must not exceed it."""

    ask: Callable[[Command, VehicleState, float], Command]
    sent: str
    """field of SET_POSITION_TARGET_LOCAL_NED, z in the fleet frame"""
    sign: float
    most: float
    """of sign times the field"""
    seconds: float
    """until what is sent is what is asked for"""


LIMITS = {
    "level speed": Limit(velocity_north, "vx", 1.0, SPEED_M_S, 4.0),
    "acceleration": Limit(acceleration_north, "afx", 1.0, ACCELERATION_M_S2, 0.3),
    "climb": Limit(velocity_down, "vz", -1.0, CLIMB_M_S, 0.5),
    "descent": Limit(velocity_down, "vz", 1.0, DESCENT_M_S, 0.5),
    "ceiling": Limit(position_down, "z", -1.0, CEILING_M - MARGIN_M, 0.5),
    "floor": Limit(position_down, "z", 1.0, -(FLOOR_M + MARGIN_M), 0.5),
}


@dataclass(slots=True)
class AskedFor(SafetyFilter):
    """The real filter, given what is asked for in the place of the command: no law reaches all of it."""

    limit: Limit | None = None
    asked: float = 0.0

    def apply(
        self, command: Command, ego: VehicleState, neighbours: Sequence[Neighbour], velocity_bias_ned_m_s: Ned,
        dt_s: float,
    ) -> SafeSetpoint | None:  # fmt: skip
        asked = command if self.limit is None else self.limit.ask(command, ego, self.asked)
        return SafetyFilter.apply(self, asked, ego, neighbours, velocity_bias_ned_m_s, dt_s)


class Flown:
    """One vehicle, and what its companion sends."""

    def __init__(self) -> None:
        def change(tables: dict[str, Any]) -> None:
            tables["limits"].update(
                speed_max_m_s=SPEED_M_S, avoidance_acceleration_m_s2=ACCELERATION_M_S2, climb_max_m_s=CLIMB_M_S,
                descent_max_m_s=DESCENT_M_S,
            )  # fmt: skip
            tables["fence"] = {"floor_m": FLOOR_M, "ceiling_m": CEILING_M, "vertical_margin_m": MARGIN_M}
            tables["stub"].update(position_noise_m=0.0, velocity_noise_m_s=0.0, gust_m_s2=0.0)
            tables["plan"]["automatic"] = False

        self.sent: list[tuple[float, Any]] = []
        self.ls = Lockstep(fleet(1, altitude_m=ALTITUDE_M, change=change), seed=3, record=self.record)
        self.agent = self.ls.vehicles[1].agent
        self.filter = self.agent.safety = AskedFor(self.agent.config.safety_limits)
        self.ls.run_until(20.0, lambda: not self.agent.operator.unready(self.ls.now))

    def record(self, i: int, channel: str, now: Instant, body: bytes) -> None:
        if channel == "output/mavlink" and body[7:10] == b"\x54\x00\x00":
            self.sent.append((now.monotonic_ns * 1e-9, parse(body)))

    def asks(self, limit: Limit | None, value: float = 0.0) -> None:
        self.filter.limit, self.filter.asked = limit, value

    def silent(self, seconds: float) -> None:
        """The autopilot sends nothing for a while."""
        self.ls.vehicles[1].autopilot.inject(Fault(FaultKind.MUTE, duration_s=seconds))

    def during(self, seconds: float) -> list[Any]:
        """The setpoints of the next seconds."""
        since_s = self.ls.now_ns * 1e-9
        wait(self.ls, seconds)
        return [m for s, m in self.sent if s > since_s]

    def in_fleet_frame(self, field: str, message: Any) -> float:
        value = float(getattr(message, field))
        frame = self.agent.autopilot.frame
        assert frame is not None
        return frame.to_fleet(Ned(0.0, 0.0, value)).down if field == "z" else value


@pytest.mark.parametrize("step", [-STEP, 0.0, STEP], ids=["below", "at", "above"])
@pytest.mark.parametrize("limit", LIMITS.values(), ids=LIMITS)
def test_what_is_sent_is_within_the_limit_and_nothing_is_sent_disarmed_or_without_positions(
    limit: Limit, step: float
) -> None:
    asked = limit.most + step * abs(limit.most)
    flown = Flown()
    flown.asks(limit, limit.sign * asked)
    assert flown.during(1.0) == [], "disarmed, positions fresh"
    flown.silent(0.9)
    assert flown.during(0.9) == [], "disarmed, positions stale"
    flown.asks(None)
    until(flown.ls, 20.0, lambda: not flown.agent.operator.unready(flown.ls.now))
    flown.ls.command(b'{"verb":"takeoff"}')
    until(flown.ls, 30.0, lambda: flown.ls.all_in(Phase.WAITING))
    wait(flown.ls, 1.0)

    flown.asks(limit, limit.sign * asked)
    sent = [limit.sign * flown.in_fleet_frame(limit.sent, m) for m in flown.during(limit.seconds)]
    tolerance = NEAR * abs(limit.most)
    assert len(sent) >= 40 * limit.seconds, "armed, positions fresh"
    assert max(sent) <= limit.most + (tolerance if limit.sent == "vx" else 1e-3)
    assert sent[-1] == pytest.approx(min(asked, limit.most), abs=tolerance)

    flown.silent(0.9)
    wait(flown.ls, 0.55)
    assert flown.during(0.3) == [], "armed, positions stale"


# -- one filter --------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class Watched(SafetyFilter):
    """The real filter, which tells how often it started anew."""

    started: int = 0

    def reset(self) -> None:
        self.started += 1
        SafetyFilter.reset(self)


def test_the_filter_that_flies_is_the_one_that_starts_anew_whatever_is_put_in_its_place() -> None:
    """Before it is let into OFFBOARD, on engaging, when it is resumed and when it then engages."""
    flown = Flown()
    agent, ls = flown.agent, flown.ls
    watched = agent.safety = Watched(agent.config.safety_limits, acceleration_m_s2=(5.0, -5.0))
    ls.command(b'{"verb":"takeoff"}')
    until(ls, 20.0, lambda: agent.phase is Phase.CLIMBING and agent.supervisor.steers)
    assert watched.started == 1
    assert abs(watched.acceleration_m_s2[0]) < 1.0, "what was flown before is forgotten"
    until(ls, 20.0, lambda: agent.phase is Phase.WAITING)
    assert watched.started == 2
    other = agent.safety = Watched(agent.config.safety_limits)
    ls.command(b'{"verb":"release"}')
    wait(ls, 3.0)
    assert agent.phase is Phase.RELEASED
    ls.command(b'{"verb":"resume"}')
    until(ls, 10.0, lambda: agent.phase in FILTERED_PHASES)
    assert (watched.started, other.started) == (2, 2)
