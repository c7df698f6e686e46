"""Each row of the table of failsafes: its fault is injected, and when it is noticed and what is done is checked."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
from flights import (
    distances,
    errors,
    failsafes,
    first,
    fleet,
    launch,
    straight,
    truth,
    until,
    until_formed,
    until_landed,
    wait,
)
from pymavlink.dialects.v20 import development as dialect

from companion.core.failsafe import FAILSAFES, LATE_S, STATUS_S, UNCERTAIN_S, Action, Failsafe
from companion.core.frames import Ned
from companion.core.values import Instant, PeerMessage, Phase
from companion.vehicle.autopilot.px4 import Px4Autopilot
from companion.wire.mavlink import ON_GROUND
from companion.wire.peer import encode_state
from companion.wire.px4 import Px4Mode, mode_parameters
from sim.autopilot.faults import Fault, FaultKind
from sim.lockstep.lockstep import Lockstep

pytestmark = pytest.mark.timeout(600)
"""a flight is simulated within a test, on whatever machine"""

TICK_S = 0.05
"""a control period and a message more"""
WORLD: Any = dialect.MAVLink(None, srcSystem=1, srcComponent=1)


class Tampered:
    """An autopilot whose link drops messages, by their ids: towards the companion, or commands towards it."""

    def __init__(self, autopilot: Any, dropped: tuple[int, ...] = (), dropped_commands: tuple[int, ...] = ()) -> None:
        self.autopilot = autopilot
        if isinstance(autopilot, Tampered):
            self.autopilot = autopilot.autopilot
        self.dropped, self.dropped_commands = dropped, dropped_commands

    def __getattr__(self, name: str) -> Any:
        return getattr(self.autopilot, name)

    def advance(self, now_ns: int) -> list[bytes]:
        return [d for d in self.autopilot.advance(now_ns) if int.from_bytes(d[7:10], "little") not in self.dropped]

    def receive(self, datagram: bytes, now_ns: int) -> None:
        is_command = int.from_bytes(datagram[7:10], "little") == 76
        if not (is_command and int.from_bytes(datagram[38:40], "little") in self.dropped_commands):
            self.autopilot.receive(datagram, now_ns)


@dataclass
class Scene:
    """A flight with one vehicle's setpoints recorded, and when the fault began."""

    ls: Lockstep
    setpoints: list[float]
    began_s: float = 0.0

    def begin(self) -> None:
        self.began_s = self.ls.now_ns * 1e-9

    def inject(self, kind: FaultKind, magnitude: float | None = None, **more: float) -> None:
        self.begin()
        self.ls.vehicles[1].autopilot.inject(Fault(kind, magnitude, **more))

    def tamper(self, *dropped: int, commands: tuple[int, ...] = ()) -> None:
        self.begin()
        v = self.ls.vehicles[1]
        v.autopilot = Tampered(v.autopilot, dropped, commands)  # type: ignore[assignment]

    def silence(self, message: int, last: Callable[[Px4Autopilot], int | None]) -> None:
        """Nothing more of one message; the fault begins as the last of it came."""
        self.tamper(message)
        said_ns = last(self.ls.vehicles[1].agent.autopilot)
        assert said_ns is not None
        self.began_s = said_ns * 1e-9

    @property
    def phase(self) -> Phase:
        return self.ls.vehicles[1].agent.phase

    def count(self, failsafe: Failsafe) -> int:
        told = self.ls.vehicles[1].agent.status(self.ls.now).rejected
        return int(told.get(failsafe.value, 0))

    def after(self, text: str) -> float:
        """How long after the fault a note with that text came."""
        return next(s for s, i, note in self.ls.notes if i == 1 and text in note and s >= self.began_s) - self.began_s

    def noted(self, failsafe: Failsafe) -> float:
        return self.after(f"failsafe: {failsafe.value}")

    def quiet_between(self, from_s: float, to_s: float) -> bool:
        return not any(self.began_s + from_s < s < self.began_s + to_s for s in self.setpoints)


def scene(count: int = 2, *, moving: bool = False, change: Callable[[dict[str, Any]], None] | None = None) -> Scene:
    """Vehicles that wait over their pads for a formation that nobody orders, or that move at 1 m/s."""
    setpoints: list[float] = []

    def record(i: int, channel: str, now: Instant, body: bytes) -> None:
        if i == 1 and channel == "output/mavlink" and body[7:10] == b"\x54\x00\x00":
            setpoints.append(now.monotonic_ns * 1e-9)

    def edit(tables: dict[str, Any]) -> None:
        tables["plan"]["automatic"] = moving
        if change is not None:
            change(tables)

    ls = launch(fleet(count, legs=straight(200.0), change=edit), seed=8, record=record)
    s = Scene(ls, setpoints)
    if moving:
        until_formed(ls)
        until(ls, 8.0, lambda: ls.all_in(Phase.MOVING))
        wait(ls, 3.0)
    else:
        until(ls, 20.0, lambda: ls.all_in(Phase.WAITING))
        wait(ls, 1.0)
    return s


def brief(tables: dict[str, Any]) -> None:
    tables["trigger"]["t_max_s"] = 2.0
    tables["peers"].update(isolated_flight_s=3.0, wait_s=6.0)
    tables["failsafe"]["isolated_hold_s"] = 4.0


def peer_says(s: Scene, sequence: int = 1000, revision: int | None = None, **changed: Any) -> None:
    """Vehicle 1 hears from vehicle 2 what vehicle 2 did not say."""
    agent = s.ls.vehicles[1].agent
    sample, boot_id = agent.peers.sample(2), agent.peers.boot_id(2)
    assert sample is not None
    assert boot_id is not None
    newest = agent.history.newest
    sample = sample._replace(**({"time_ns": s.ls.now.fleet_ns} | changed))
    if revision is not None:
        sample = sample._replace(revision=revision)
    message = PeerMessage(boot_id, sequence, newest.start_ns, newest.issuer, sample, ())
    agent.receive_peer("fleet/2/state", encode_state(message), s.ls.now)


def must_end(s: Scene, *phases: Phase, within_s: float = 60.0) -> None:
    until(s.ls, within_s, lambda: s.phase in phases)


def must_go_on(s: Scene, phase: Phase) -> None:
    """Nothing was done; landing on command ends it."""
    wait(s.ls, 1.0)
    assert s.phase is phase
    assert s.ls.vehicles[1].agent.supervisor.failsafes == []


# -- one scenario for each row: what it does is in its name's row; it returns when it was noticed, and the latest ------


def position_stale() -> tuple[float, float]:
    s = scene()
    s.inject(FaultKind.MUTE, duration_s=0.9)
    wait(s.ls, 2.0)
    assert s.quiet_between(0.6, 0.85)
    assert s.setpoints[-1] > s.began_s + 1.0
    must_go_on(s, Phase.WAITING)
    return s.after("own position stale: no setpoints"), 0.5


def position_frozen() -> tuple[float, float]:
    s = scene(moving=True)
    s.inject(FaultKind.POSITION_FROZEN, duration_s=0.9)
    wait(s.ls, 1.0)
    assert s.quiet_between(0.6, 0.9)
    assert s.count(Failsafe.POSITION_FROZEN) == 1
    wait(s.ls, 1.0)
    assert s.setpoints[-1] > s.began_s + 1.5
    return s.after("own position frozen: no setpoints"), 0.5


def position_lost() -> tuple[float, float]:
    s = scene()
    s.inject(FaultKind.MUTE)
    must_end(s, Phase.RELEASED, within_s=3.0)
    wait(s.ls, 12.0)
    assert not s.ls.vehicles[1].autopilot.truth().armed, "its autopilot has landed it"
    assert s.quiet_between(0.6, 20.0)
    return s.noted(Failsafe.POSITION_LOST), 1.5


def position_jumped() -> tuple[float, float]:
    s = scene()
    before = s.ls.positions()[1]
    # Its new origin is not told at once.
    s.tamper(49)
    s.inject(FaultKind.ESTIMATOR_RESET)
    must_end(s, Phase.DETACHED, within_s=1.0)
    noticed = s.noted(Failsafe.POSITION_JUMPED)
    s.tamper()
    until(s.ls, 30.0, lambda: s.phase is Phase.WAITING)
    wait(s.ls, 3.0)
    after = s.ls.positions()[1]
    assert abs(after.north - before.north) < 0.7
    assert abs(after.east - before.east) < 0.7
    assert s.count(Failsafe.POSITION_JUMPED) >= 1
    t = truth(s.ls, s.began_s)
    assert abs(t.velocity_ned_m_s[:, 0]).max() < 1.5, "it does not lunge after its estimate"
    return noticed, 0.0


def position_jumps() -> tuple[float, float]:
    s = scene()
    s.tamper(49)
    for _ in range(14):
        if s.phase not in (Phase.LANDING, Phase.RELEASED):
            s.ls.vehicles[1].autopilot.inject(Fault(FaultKind.ESTIMATOR_RESET, offset_ned_m=Ned(0.8, 0.0, 0.0)))
        wait(s.ls, 1.0)
    assert s.phase is Phase.LANDING
    must_end(s, Phase.LANDED)
    return s.noted(Failsafe.POSITION_JUMPS), 11.1


def covariance() -> tuple[float, float]:
    s = scene()
    s.tamper(230)
    for _ in range(6):
        status = dialect.MAVLink_estimator_status_message(0, 0x1FF, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 4.0, 0.5)
        s.ls.vehicles[1].agent.receive_mavlink(bytes(status.pack(WORLD)), s.ls.now)
        wait(s.ls, 0.5)
    assert s.phase is Phase.LANDING
    must_end(s, Phase.LANDED)
    return s.noted(Failsafe.COVARIANCE), 2.0


def not_followed() -> tuple[float, float]:
    def in_the_open(tables: dict[str, Any]) -> None:
        tables.setdefault("stub", {})["drag_per_s"] = 1.0

    s = scene(change=in_the_open)
    s.inject(FaultKind.WIND, wind_ned_m_s=Ned(0.0, 25.0, 0.0))  # pushes with 25 m/s^2
    must_end(s, Phase.LANDING, within_s=5.0)
    must_end(s, Phase.LANDED)
    return s.noted(Failsafe.NOT_FOLLOWED), 2.5


def heartbeat() -> tuple[float, float]:
    s = scene()
    s.silence(0, lambda autopilot: autopilot.heartbeat_ns)
    must_end(s, Phase.RELEASED, within_s=5.0)
    return s.noted(Failsafe.HEARTBEAT), 3.0


def pilot() -> tuple[float, float]:
    s = scene()
    s.inject(FaultKind.PILOT_TAKEOVER)
    wait(s.ls, 5.0)
    assert s.phase is Phase.RELEASED
    assert s.setpoints[-1] <= s.began_s + 0.2
    assert s.ls.vehicles[1].autopilot.truth().custom_mode == Px4Mode.POSCTL
    return s.noted(Failsafe.PILOT), 0.1


def autopilot() -> tuple[float, float]:
    s = scene()
    s.ls.stall(1, 1.4)
    wait(s.ls, 1.4)
    assert s.ls.vehicles[1].autopilot.truth().custom_mode == Px4Mode.AUTO_LAND
    s.begin()
    wait(s.ls, 5.0)
    assert s.phase is Phase.RELEASED
    assert s.quiet_between(0.0, 5.0)
    assert s.ls.vehicles[1].autopilot.truth().custom_mode == Px4Mode.AUTO_LAND
    return s.noted(Failsafe.AUTOPILOT), 0.1


def not_armed() -> tuple[float, float]:
    s = Scene(Lockstep(fleet(1)), [])
    s.ls.run_until(3.5)
    # In RTL PX4 does not arm.
    main = mode_parameters(Px4Mode.AUTO_RTL)
    order = dialect.MAVLink_command_long_message(1, 1, main[0], 0, *main[1:], *[0.0] * 4)
    s.ls.vehicles[1].autopilot.receive(bytes(order.pack(dialect.MAVLink(None, 255, 190))), s.ls.now_ns)
    s.ls.run_until(4.0)
    assert json.loads(s.ls.command(b'{"verb":"takeoff"}')[1])["accepted"]
    s.begin()
    wait(s.ls, 12.0)
    assert s.phase is Phase.IDLE
    return s.noted(Failsafe.NOT_ARMED), 10.0


def no_take_off() -> tuple[float, float]:
    s = Scene(Lockstep(fleet(1)), [])
    s.tamper(commands=(22,))
    parameters = s.ls.vehicles[1].autopilot.parameters
    parameters.set_from_wire("COM_DISARM_PRFLT", 60.0, parameters.wire_type("COM_DISARM_PRFLT"))
    s.ls.run_until(6.0)
    assert json.loads(s.ls.command(b'{"verb":"takeoff"}')[1])["accepted"]
    until(s.ls, 5.0, lambda: s.phase is Phase.ARMED)
    s.began_s = first(s.ls, "preflight -> armed")
    must_end(s, Phase.LANDING, within_s=12.0)
    return s.noted(Failsafe.NO_TAKE_OFF), 10.0


def altitude() -> tuple[float, float]:
    ls = launch(fleet(1, altitude_m=200.0))
    until(ls, 10.0, lambda: ls.all_in(Phase.CLIMBING))
    s = Scene(ls, [], first(ls, "armed -> climbing"))
    must_end(s, Phase.LANDING, within_s=62.0)
    return s.noted(Failsafe.ALTITUDE), 60.0


def missing() -> tuple[float, float]:
    ls = launch(fleet(2, change=brief))
    ls.command(b'{"verb":"land"}', 2)
    s = Scene(ls, [])
    until(ls, 20.0, lambda: s.phase is Phase.WAITING)
    s.began_s = first(ls, "climbing -> waiting", 1)
    must_end(s, Phase.LANDING, within_s=20.0)
    return s.noted(Failsafe.MISSING), 6.0


def alone() -> tuple[float, float]:
    s = scene(change=brief)
    s.begin()
    s.ls.partition({1}, {2})
    must_end(s, Phase.DETACHED, within_s=10.0)
    s.ls.partition()
    until(s.ls, 20.0, lambda: s.ls.all_in(Phase.WAITING))
    return s.noted(Failsafe.ALONE), 4.2 + 3.0


def alone_for_long() -> tuple[float, float]:
    s = scene(change=brief)
    s.ls.partition({1}, {2})
    until(s.ls, 10.0, lambda: s.phase is Phase.DETACHED)
    s.began_s = first(s.ls, "waiting -> detached", 1)
    must_end(s, Phase.LANDED)
    return s.noted(Failsafe.ALONE_FOR_LONG), 4.0


def apart_for_long() -> tuple[float, float]:
    def patient(tables: dict[str, Any]) -> None:
        tables["peers"]["wait_s"] = 6.0

    s = scene(change=patient)
    s.ls.partition({1}, {2})
    peer_says(s, revision=3)
    s.tamper(49)
    s.inject(FaultKind.ESTIMATOR_RESET)
    must_end(s, Phase.LANDING, within_s=9.0)
    return s.noted(Failsafe.DETACHED_FOR_LONG), 6.1


def lost(s: Scene, within_s: float) -> float:
    agent = s.ls.vehicles[1].agent
    until(s.ls, within_s, lambda: agent.peers.phases()[2] is None)
    wait(s.ls, 0.5)
    assert "2" not in str([n.vehicle_id for n in agent.neighbours if n.in_formation])
    (n,) = (n for n in agent.neighbours if n.vehicle_id == 2)
    assert n.last_seen_ned_m is not None
    assert not n.shares_avoidance
    return s.ls.now_ns * 1e-9 - s.began_s - 0.5


def peer_gone() -> tuple[float, float]:
    s = scene(3)
    s.begin()
    s.ls.kill(2)
    noticed = lost(s, 2.0)
    must_go_on(s, Phase.WAITING)
    return noticed, 0.2


def peer_silent() -> tuple[float, float]:
    s = scene(3, change=brief)
    s.begin()
    s.ls.partition({1, 3}, {2})
    noticed = lost(s, 6.0)
    assert s.phase is Phase.WAITING
    return noticed, 4.3


def not_used(s: Scene, failsafe: Failsafe) -> None:
    assert s.count(failsafe) >= 1
    wait(s.ls, 0.1)
    places = [n for n in s.ls.vehicles[1].agent.neighbours if n.vehicle_id == 2]
    assert places
    assert not any(n.in_formation or n.shares_avoidance for n in places)
    must_go_on(s, Phase.MOVING)


def peer_frozen() -> tuple[float, float]:
    s = scene(moving=True)
    s.ls.partition({1}, {2})
    s.begin()
    for k in range(6):
        peer_says(s, 1000 + k, velocity_ned_m_s=Ned(1.0, 0.0, 0.0))
        wait(s.ls, 0.11)
    noticed = s.ls.now_ns * 1e-9 - s.began_s
    not_used(s, Failsafe.PEER_FROZEN)
    return noticed, 0.7


def peer_lies() -> tuple[float, float]:
    s = scene(moving=True)
    s.begin()
    sample = s.ls.vehicles[1].agent.peers.sample(2)
    assert sample is not None
    p = sample.position_ned_m
    s.ls.partition({1}, {2})
    peer_says(s, position_ned_m=p._replace(east=p.east + 60.0))
    not_used(s, Failsafe.PEER_LIES)
    return 0.0, 0.0


def peer_clock() -> tuple[float, float]:
    s = scene()
    before = s.ls.vehicles[1].agent.peers.sample(2)
    s.begin()
    peer_says(s, 1000, time_ns=s.ls.now.fleet_ns + 1_100_000_000)
    peer_says(s, 1001, time_ns=s.ls.now.fleet_ns - 21_100_000_000)
    agent = s.ls.vehicles[1].agent
    assert agent.peers.rejected == {"from the future": 1, "too old on arrival": 1}
    assert agent.peers.sample(2) is before
    must_go_on(s, Phase.WAITING)
    return 0.0, 0.0


def two_sources() -> tuple[float, float]:
    s = scene(moving=True)
    s.begin()
    s.ls.add_twin(2)
    until(s.ls, 12.0, lambda: s.count(Failsafe.TWO_SOURCES) > 0)
    not_used(s, Failsafe.TWO_SOURCES)
    # The first hears the second, and says again where it is.
    return s.after(Failsafe.TWO_SOURCES.value), 3.0


def own_id() -> tuple[float, float]:
    s = scene(moving=True)
    wait(s.ls, 1.0)
    s.begin()
    sent = s.ls.vehicles[1].agent.publisher.messages_sent
    for _ in range(20):
        s.ls.inject_peer("fleet/1/state", b"whatever", 1)
        wait(s.ls, 0.05)
    assert s.count(Failsafe.OWN_ID) == 20
    assert 2 <= s.ls.vehicles[1].agent.publisher.messages_sent - sent <= 3
    must_go_on(s, Phase.MOVING)
    return s.after(Failsafe.OWN_ID.value), 0.0


def deaf() -> tuple[float, float]:
    s = scene(4, change=brief)
    s.begin()
    s.ls.drop_topic("state")
    until(s.ls, 9.0, lambda: all(p in (Phase.DETACHED, Phase.LANDING) for p in s.ls.phases().values()))
    noticed = s.noted(Failsafe.DEAF)
    s.ls.restore_topics()
    until(s.ls, 20.0, lambda: s.ls.all_in(Phase.WAITING))
    assert distances(truth(s.ls, s.began_s)).min() > 3.0
    return noticed, 4.2 + 3.0


def battery_low() -> tuple[float, float]:
    s = scene(moving=True)
    s.inject(FaultKind.LOW_BATTERY, 0.2)
    until(s.ls, 10.0, lambda: s.ls.all_in(Phase.RETURNING))
    until(s.ls, 80.0, lambda: s.ls.all_in(Phase.LANDED))
    assert distances(truth(s.ls, s.began_s)).min() > 1.2
    return s.noted(Failsafe.BATTERY_LOW), 4.1


def battery_critical() -> tuple[float, float]:
    s = scene()
    s.inject(FaultKind.LOW_BATTERY, 0.1)
    must_end(s, Phase.LANDING, within_s=5.0)
    assert s.ls.phases()[2] is Phase.WAITING
    must_end(s, Phase.LANDED)
    return s.noted(Failsafe.BATTERY_CRITICAL), 4.1


def battery_unknown() -> tuple[float, float]:
    s = scene()
    s.silence(1, lambda autopilot: autopilot.health_ns)
    s.ls.vehicles[1].autopilot.inject(Fault(FaultKind.LOW_BATTERY, 0.5))
    wait(s.ls, 6.0)
    assert s.count(Failsafe.BATTERY_UNKNOWN) == 1
    assert s.ls.vehicles[1].agent.status(s.ls.now).battery_percent == -1
    must_go_on(s, Phase.WAITING)
    return s.after(Failsafe.BATTERY_UNKNOWN.value), 5.0


def loop_late() -> tuple[float, float]:
    s = scene()
    s.begin()
    s.ls.stall(1, LATE_S + 0.1)
    wait(s.ls, 1.0)
    assert s.count(Failsafe.LOOP_LATE) == 1
    must_go_on(s, Phase.WAITING)
    return next(x for x in s.setpoints if x > s.began_s) - s.began_s, LATE_S + 0.1


def noticed_by_the_process(failsafe: Failsafe) -> tuple[float, float]:
    s = scene()
    s.begin()
    s.ls.notice(1, failsafe)
    must_go_on(s, Phase.WAITING)
    assert s.count(failsafe) == 1
    return s.after(failsafe.value), 0.1


def killed() -> tuple[float, float]:
    s = scene()
    s.begin()
    s.ls.kill(1)
    until(s.ls, 2.0, lambda: s.ls.vehicles[1].autopilot.truth().custom_mode == Px4Mode.AUTO_LAND)
    noticed = s.ls.now_ns * 1e-9 - s.began_s
    s.ls.restart(1)
    wait(s.ls, 1.5)
    assert s.phase is Phase.IDLE
    assert s.quiet_between(0.1, 10.0)
    answer = json.loads(s.ls.command(b'{"verb":"land"}', 1)[1])
    assert answer["reason"] == "it flies without this companion: resume first, or take it over"
    return noticed, 1.2


def stopped() -> tuple[float, float]:
    s = scene()
    s.begin()
    s.ls.vehicles[1].agent.stop(s.ls.now)
    until(s.ls, 1.0, lambda: s.ls.vehicles[1].agent.stopped)
    assert s.phase is Phase.LANDING
    must_end(s, Phase.LANDED)
    return 0.0, 0.0


def operator() -> tuple[float, float]:
    ls = launch(fleet(2, legs=straight(2.0)), seed=5)
    until_formed(ls)
    until_landed(ls)
    assert not [n for _, _, n in ls.notes if n.startswith("failsafe")]
    return 0.0, 0.0


def not_finite() -> tuple[float, float]:
    s = scene()
    s.begin()
    agent = s.ls.vehicles[1].agent
    boot_ms = agent.autopilot.boot.last_boot_ms + 1
    message = dialect.MAVLink_local_position_ned_message(boot_ms, float("nan"), 0.0, 0.0, 0.0, 0.0, 0.0)
    agent.receive_mavlink(bytes(message.pack(WORLD)), s.ls.now)
    assert agent.status(s.ls.now).rejected["not finite"] == 1
    must_go_on(s, Phase.WAITING)
    return 0.0, 0.0


SCENARIOS: dict[Failsafe, Callable[[], tuple[float, float]]] = {
    Failsafe.POSITION_STALE: position_stale, Failsafe.POSITION_FROZEN: position_frozen,
    Failsafe.POSITION_LOST: position_lost, Failsafe.POSITION_JUMPED: position_jumped,
    Failsafe.POSITION_JUMPS: position_jumps, Failsafe.COVARIANCE: covariance,
    Failsafe.NOT_FOLLOWED: not_followed, Failsafe.HEARTBEAT: heartbeat,
    Failsafe.PILOT: pilot, Failsafe.AUTOPILOT: autopilot, Failsafe.NOT_ARMED: not_armed,
    Failsafe.NO_TAKE_OFF: no_take_off, Failsafe.ALTITUDE: altitude, Failsafe.MISSING: missing, Failsafe.ALONE: alone,
    Failsafe.ALONE_FOR_LONG: alone_for_long, Failsafe.DETACHED_FOR_LONG: apart_for_long, Failsafe.PEER_GONE: peer_gone,
    Failsafe.PEER_SILENT: peer_silent, Failsafe.PEER_FROZEN: peer_frozen, Failsafe.PEER_LIES: peer_lies,
    Failsafe.TWO_SOURCES: two_sources, Failsafe.OWN_ID: own_id, Failsafe.DEAF: deaf,
    Failsafe.PEER_CLOCK: peer_clock, Failsafe.BATTERY_LOW: battery_low, Failsafe.BATTERY_CRITICAL: battery_critical,
    Failsafe.BATTERY_UNKNOWN: battery_unknown, Failsafe.LOOP_LATE: loop_late,
    Failsafe.DISK_FULL: lambda: noticed_by_the_process(Failsafe.DISK_FULL),
    Failsafe.CONFIGURATION: lambda: noticed_by_the_process(Failsafe.CONFIGURATION), Failsafe.KILLED: killed,
    Failsafe.STOPPED: stopped, Failsafe.OPERATOR: operator, Failsafe.NOT_FINITE: not_finite,
}  # fmt: skip


EARLIER = {Failsafe.PILOT, Failsafe.AUTOPILOT}
"""rows whose limit is a message's period: it may come at once"""


@pytest.mark.parametrize("failsafe", FAILSAFES, ids=lambda f: f.name.lower())
def test_each_failsafe_is_noticed_in_time_and_does_what_the_table_says(failsafe: Failsafe) -> None:
    row = FAILSAFES[failsafe]
    noticed_s, latest_s = SCENARIOS[failsafe]()
    assert noticed_s <= latest_s + TICK_S
    if row.limit_s is not None and failsafe not in EARLIER:
        assert noticed_s >= row.limit_s - TICK_S


def test_actions_are_what_the_scenarios_check() -> None:
    landing = {f for f, row in FAILSAFES.items() if row.action is Action.LAND}
    assert landing == {
        Failsafe.POSITION_JUMPS, Failsafe.COVARIANCE, Failsafe.NOT_FOLLOWED, Failsafe.NO_TAKE_OFF, Failsafe.ALTITUDE,
        Failsafe.MISSING,
        Failsafe.ALONE_FOR_LONG, Failsafe.DETACHED_FOR_LONG, Failsafe.BATTERY_CRITICAL, Failsafe.STOPPED,
    }  # fmt: skip
    assert {f for f, row in FAILSAFES.items() if row.action is Action.RETURN} == {Failsafe.BATTERY_LOW}
    assert {f for f, row in FAILSAFES.items() if row.action is Action.LEAVE_FORMATION} == {
        Failsafe.POSITION_JUMPED, Failsafe.ALONE, Failsafe.DEAF,
    }  # fmt: skip


def test_an_estimator_that_says_nothing_any_more_counts_as_uncertain() -> None:
    s = scene()
    s.silence(230, lambda autopilot: autopilot.estimator_ns)
    must_end(s, Phase.LANDING, within_s=10.0)
    assert STATUS_S + UNCERTAIN_S <= s.noted(Failsafe.COVARIANCE) <= STATUS_S + UNCERTAIN_S + 2 * TICK_S


@pytest.mark.parametrize("when", ["disarmed", "armed on the ground"])
def test_a_position_that_jumps_on_the_ground_is_no_failsafe_in_the_air(when: str) -> None:
    # PX4's estimator resets its position on the ground, seconds before it may be armed.
    ls = Lockstep(fleet(2), seed=8)
    ls.run_until_ready(10.0)
    s = Scene(ls, [])
    if when == "armed on the ground":
        ls.command(b'{"verb":"takeoff"}')
        until(ls, 5.0, lambda: ls.vehicles[1].autopilot.truth().armed)
    assert ls.vehicles[1].autopilot.truth().landed_state == ON_GROUND
    s.tamper(49)
    s.inject(FaultKind.ESTIMATOR_RESET)
    wait(ls, 0.5)
    assert s.ls.vehicles[1].agent.supervisor.flight.positions.jumps == 1
    s.tamper()
    if when == "disarmed":
        wait(ls, 2.0)
        ls.command(b'{"verb":"takeoff"}')
    until_formed(ls)
    assert failsafes(ls) == []
    assert not any("-> detached" in note for _, _, note in ls.notes)
    formation, _ = errors(ls, truth(ls, ls.now_ns * 1e-9 - 0.5), [1, 2])
    assert formation.max() < 0.5, "its new origin is known"
