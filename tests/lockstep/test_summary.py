"""The summary of a flight against the same figures computed straight from truth, by their definitions."""

import itertools
import json
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import dist, sqrt
from typing import Any

import numpy as np
import pytest
from flights import Tape, fleet, launch, straight, until, until_formed, until_landed, wait

from companion.config import FleetConfig
from companion.core.frames import Ned
from companion.core.trajectory.fleet import FleetTrajectory
from companion.core.trajectory.history import TrajectoryHistory
from companion.core.trajectory.legs import VelocityLeg
from companion.core.trajectory.successors import with_legs
from companion.core.values import Phase
from companion.wire.peer import encode_motion
from companion.wire.px4 import Px4Mode
from sim.autopilot.faults import Fault, FaultKind
from sim.launch.summary.flight import POSITION, TICK_ROWS, VELOCITY, Flight
from sim.launch.summary.summarise import summarise
from sim.lockstep.clockwork import UTC_AT_START_NS
from sim.lockstep.lockstep import Lockstep

ON_GROUND = 1
COUNT = 3


@dataclass
class Flown:
    """A flight in lockstep with everything that a summary reads."""

    ls: Lockstep
    tape: Tape
    takeoff_ns: int
    dead: dict[int, int] = field(default_factory=dict)
    """vehicle -> when its autopilot ended (fleet time, ns)"""
    nearer_ns: int | None = None
    """when vehicle 2 is 0.4 m north of vehicle 1 for a tenth of a second, whatever it flew"""

    believed: bool = False
    """whether companions' own accounts are there"""
    astray_m: float = 0.0
    """all vehicles are truly off what they are by up to so much north and back, together: an error of all estimates"""

    @property
    def rows(self) -> Any:
        rows = self.ls.truth()
        rows["position_ned_m"][:, 0] += self.astray_m * np.sin(1e-9 * (rows["time_unix_ns"] - UTC_AT_START_NS))
        if self.nearer_ns is not None:
            then = (rows["time_unix_ns"] >= self.nearer_ns) & (rows["time_unix_ns"] < self.nearer_ns + 100_000_000)
            first = rows["position_ned_m"][then & (rows["vehicle_id"] == 1)]
            rows["position_ned_m"][then & (rows["vehicle_id"] == 2)] = first + np.array([0.4, 0.0, 0.0], np.float32)
        for i, ended_ns in self.dead.items():
            rows = rows[(rows["vehicle_id"] != i) | (rows["time_unix_ns"] <= ended_ns)]
        return rows

    def summary(self) -> dict[str, Any]:
        lost = frozenset(i for i, v in self.ls.vehicles.items() if not v.alive)
        flight = Flight(
            self.ls.config, 1, self.rows, self.takeoff_ns, lost=lost,
            autopilots_lost=dict.fromkeys(self.dead, "PX4 ended with status -9"),
        )  # fmt: skip
        for i in self.ls.vehicles:
            flight.read(i, self.tape.entries[i])
            if self.believed:
                flight.ticks[i] = self.ticks(i)
        return summarise(flight)

    def ticks(self, i: int) -> Any:
        """What a companion would have recorded of itself: an estimate with an error of its own of 0.01 m."""
        rows = self.ls.truth()
        rows = rows[rows["vehicle_id"] == i]
        ticks = np.zeros(len(rows), TICK_ROWS)
        ticks["fleet_ns"] = rows["time_unix_ns"]
        noise = np.random.default_rng(i).normal(0.0, 0.01, (len(rows), 3))
        for k, (place, speed) in enumerate(zip(POSITION, VELOCITY, strict=True)):
            ticks[place] = rows["position_ned_m"][:, k] + noise[:, k]
            ticks[speed] = rows["velocity_ned_m_s"][:, k]
        return ticks

    def end_autopilot(self, i: int) -> None:
        """As a simulated autopilot whose process is killed: nothing more is told, by it or of it."""
        self.ls.vehicles[i].autopilot.inject(Fault(FaultKind.MUTE, None, float("inf")))
        self.dead[i] = self.ls.now.fleet_ns


def flown(config: FleetConfig, seed: int = 1) -> Flown:
    tape = Tape(keep=frozenset(v.id for v in config.vehicles))
    ls = launch(config, seed, record=tape)
    return Flown(ls, tape, ls.now.fleet_ns)


# -- the oracle: definitions, in plain loops -------------------------------------------------------------------------


@dataclass(frozen=True)
class State:
    """One vehicle's true state at one time."""

    place: tuple[float, float, float]
    armed: bool
    grounded: bool
    mode: int


def at_times(rows: Any) -> dict[int, dict[int, State]]:
    """time -> vehicle -> its true state."""
    states: dict[int, dict[int, State]] = defaultdict(dict)
    columns = (rows[n].tolist() for n in ("time_unix_ns", "vehicle_id", "position_ned_m", "armed", "landed_state"))
    for t, i, place, armed, landed, mode in zip(*columns, rows["custom_mode"].tolist(), strict=True):
        states[t][i] = State(tuple(place), bool(armed), landed == ON_GROUND, mode)
    return states


def minimum_distance_m(rows: Any, takeoff_ns: int) -> tuple[float, float] | None:
    """Smallest distance of two vehicles of which one is in the air, and when (s after the take-off command)."""
    states = at_times(rows)
    lowest: dict[int, float] = {}
    for state in states.values():
        for i, s in state.items():
            lowest[i] = max(s.place[2], lowest.get(i, s.place[2]))
    found = []
    for t, state in states.items():
        aloft = {i: not s.grounded or lowest[i] - s.place[2] > 0.3 for i, s in state.items()}
        for i, j in itertools.combinations(state, 2):
            if t >= takeoff_ns and (aloft[i] or aloft[j]):
                found.append((dist(state[i].place, state[j].place), (t - takeoff_ns) * 1e-9))
    return min(found, default=None)


def formation_error_m(f: Flown, history: TrajectoryHistory) -> float | None:
    """RMS distance from the slots about the common centre, while all that stay are formed, steered and in the air."""
    staying = [i for i, v in f.ls.vehicles.items() if v.alive]

    def when(i: int, *words: str) -> list[int]:
        return [
            round(s * 1e9) + UTC_AT_START_NS for s, k, note in f.ls.notes if k == i and any(w in note for w in words)
        ]

    formed_ns = max(when(i, "-> formed")[0] for i in staying)
    ends = ("-> landing", "-> returning", "-> released", "-> landed")
    left_ns = min((t for i in staying for t in when(i, *ends) if t > formed_ns), default=1 << 63)
    changes = [m for m in history.motions[1:] if m.blend_start_ns == m.start_ns]
    squares = []
    for t, state in at_times(f.rows).items():
        flying = all(
            i in state and state[i].armed and not state[i].grounded and state[i].mode == Px4Mode.OFFBOARD
            for i in staying
        )
        if not flying or not formed_ns + 3e9 <= t < left_ns:
            continue
        if any(m.start_ns <= t <= m.blend_end_ns + 3e9 for m in changes):
            continue
        slots = [history.reference(i, t).position_ned_m for i in staying]
        e = np.array([state[i].place for i in staying]) - np.array(slots)
        squares += [float(x) for x in ((e - e.mean(axis=0)) ** 2).sum(axis=1)]
    return sqrt(sum(squares) / len(squares)) if squares else None


def check(f: Flown, history: TrajectoryHistory | None = None) -> dict[str, Any]:
    """The summary, once its figures are those of the definitions."""
    summary = f.summary()
    alive = next(i for i, v in f.ls.vehicles.items() if v.alive and i not in f.dead)
    wanted = formation_error_m(f, history or f.ls.vehicles[alive].agent.history)
    assert summary["steady"]["formation_error_rms_m"] == (None if wanted is None else pytest.approx(wanted, abs=6e-5))
    nearest = minimum_distance_m(f.rows, f.takeoff_ns)
    told = (summary["minimum_distance_m"], summary["minimum_distance_at_s"])
    assert told == ((None, None) if nearest is None else pytest.approx(nearest, abs=6e-5))
    assert json.loads(json.dumps(summary, allow_nan=False))["passed"] == all(c["met"] for c in summary["criteria"])
    return summary


def not_met(summary: dict[str, Any]) -> set[str]:
    return {c["what"] for c in summary["criteria"] if not c["met"]}


# -- flights ---------------------------------------------------------------------------------------------------------


def test_a_plain_flight_passes_with_the_figures_of_the_definitions() -> None:
    f = flown(fleet(COUNT, legs=straight(15.0)))
    until_formed(f.ls)
    until_landed(f.ls)
    summary = check(f)
    assert not_met(summary) == set()
    assert summary["steady"]["seconds"] > 10
    assert summary["killed"] == {}
    assert 0.3 < summary["touchdown_max_m_s"] < 1.5
    (command,) = summary["commands"]
    assert (command["verb"], command["issuer"], command["accepted"]) == ("takeoff", "lockstep", [1, 2, 3])


def test_errors_that_all_estimates_share_are_told_and_what_the_formation_would_be_without_that() -> None:
    f = flown(fleet(COUNT, legs=straight(15.0)))
    until_formed(f.ls)
    until_landed(f.ls)
    f.believed = True
    own, own_f_m = f.summary()["estimates"], f.summary()["steady"]["formation_error_rms_m"]
    assert abs(own["pair_correlation"]) < 0.5
    assert own["error_rms_m"] < 0.15
    f.astray_m = 0.5
    shared, shared_f_m = f.summary()["estimates"], f.summary()["steady"]["formation_error_rms_m"]
    assert shared["pair_correlation"] > 0.9
    assert shared["error_rms_m"] > 0.3
    assert shared_f_m == pytest.approx(own_f_m, abs=1e-3), "copies cancel"
    assert shared["formation_error_decorrelated_rms_m"] > 2.0 * shared_f_m
    assert own["formation_error_decorrelated_rms_m"] == pytest.approx(own_f_m, abs=0.01)


def command(ls: Lockstep, motion: FleetTrajectory) -> list[bool]:
    payload = json.dumps({"verb": "motion", "motion": json.loads(encode_motion(motion))}).encode()
    return [json.loads(a)["accepted"] for a in ls.command(payload).values()]


@pytest.mark.parametrize("refused_first", [True, False])
def test_a_refused_motion_of_the_same_revision_shape_and_issuer_as_a_flown_one_is_not_flown(
    refused_first: bool,
) -> None:
    f = flown(fleet(COUNT, legs=straight(600.0)))
    until(f.ls, 60.0, lambda: f.ls.all_in(Phase.MOVING))
    newest = f.ls.vehicles[1].agent.history.newest

    def motion(north_m_s: float, ahead_s: float) -> FleetTrajectory:
        start_ns = f.ls.now.fleet_ns + round(ahead_s * 1e9)
        return with_legs(newest, at_ns=start_ns, issuer=0, legs=(VelocityLeg(Ned(north_m_s, 0.0, 0.0), 0.0),))

    # Of the two the one that is refused would win: it starts later or sooner, whichever the order prefers.
    refused = {ahead_s: motion(50.0, ahead_s) for ahead_s in (1.0, 5.0)}
    sound = motion(0.5, 2.0)
    assert {m.revision for m in (*refused.values(), sound)} == {3}
    if refused_first:
        assert [command(f.ls, m) for m in refused.values()] == [[False] * COUNT] * 2
    assert command(f.ls, sound) == [True] * COUNT
    wait(f.ls, 15.0)
    if not refused_first:
        late = replace(refused[5.0], start_ns=f.ls.now.fleet_ns + 10**9)
        assert command(f.ls, late) == [False] * COUNT
    f.ls.command(b'{"verb":"land"}')
    until_landed(f.ls)
    summary = check(f)
    assert not_met(summary) == set()
    assert summary["steady"]["formation_error_rms_m"] < 0.2
    verbs = [(c["verb"], len(c["accepted"]), len(c["refused"])) for c in summary["commands"]]
    refusals = [("motion", 0, COUNT)] * (2 if refused_first else 1)
    flew = [("motion", COUNT, 0)]
    motions = refusals + flew if refused_first else flew + refusals
    assert verbs == [("takeoff", COUNT, 0), *motions, ("land", COUNT, 0)]


def test_a_motion_that_one_vehicle_alone_adopted_is_not_the_formations() -> None:
    f = flown(fleet(COUNT, legs=straight(600.0)))
    until(f.ls, 60.0, lambda: f.ls.all_in(Phase.MOVING))
    before = f.ls.vehicles[1].agent.history.newest
    wait(f.ls, 5.0)
    f.ls.partition([1, 2], [3])
    motion = with_legs(
        before, at_ns=f.ls.now.fleet_ns + 2_000_000_000, issuer=0, legs=(VelocityLeg(Ned(-1.0, 0.0, 0.0), 0.0),)
    )
    payload = json.dumps({"verb": "motion", "motion": json.loads(encode_motion(motion))}).encode()
    assert json.loads(f.ls.command(payload, 3)[3])["accepted"]
    wait(f.ls, 8.0)
    f.ls.command(b'{"verb":"land"}')
    until_landed(f.ls)
    summary = check(f, f.ls.vehicles[1].agent.history)
    assert summary["passed"] is False
    assert summary["commands"][1]["accepted"] == [3]


def kill_by_command(f: Flown) -> None:
    payload = b'{"verb":"kill","confirm":true}'
    assert json.loads(f.ls.command(payload, 3)[3])["accepted"]


def kill_by_the_pilot(f: Flown) -> None:
    f.ls.vehicles[3].autopilot.inject(Fault(FaultKind.RC_KILL, None, 0.0))


@pytest.mark.parametrize(
    ("kill", "cause"),
    [(kill_by_command, "killed by command"), (kill_by_the_pilot, "its motors stopped in the air")],
)
def test_a_vehicle_killed_in_the_air_fails_the_flight_and_is_shown_as_killed(
    kill: Callable[[Flown], None], cause: str
) -> None:
    f = flown(fleet(COUNT, altitude_m=8.0, legs=straight(600.0)))
    until(f.ls, 60.0, lambda: f.ls.all_in(Phase.MOVING))
    wait(f.ls, 6.0)
    kill(f)
    until(f.ls, 20.0, lambda: f.ls.vehicles[3].agent.phase is Phase.LANDED)
    wait(f.ls, 3.0)
    assert f.ls.vehicles[3].agent.status(f.ls.now).killed == cause
    # Disarmed, its mode is OFFBOARD again, in which it was before.
    mine = f.rows[f.rows["vehicle_id"] == 3]
    assert (mine["custom_mode"][-1], mine["armed"][-1]) == (Px4Mode.OFFBOARD, 0)
    f.ls.command(b'{"verb":"land"}')
    until_landed(f.ls)
    summary = check(f)
    assert {"vehicles killed", "touchdown_max_m_s"} <= not_met(summary)
    assert summary["killed"] == {3: cause}
    assert summary["touchdown_max_m_s"] > 10.0
    assert summary["passed"] is False
    if kill is kill_by_command:
        assert summary["steady"]["formation_error_rms_m"] < 0.2


def test_a_vehicle_that_is_killed_where_it_stands_disarmed_is_not_killed() -> None:
    f = flown(fleet(1, legs=straight(3.0)))
    until_landed(f.ls)
    f.ls.command(b'{"verb":"kill","confirm":true}')
    wait(f.ls, 3.0)
    assert f.ls.vehicles[1].agent.status(f.ls.now).killed is None
    assert check(f)["killed"] == {}


def test_a_vehicle_killed_as_it_takes_off_is_killed_until_its_next_take_off_and_the_summary_remembers() -> None:
    f = flown(fleet(1, legs=straight(3.0)))
    until(f.ls, 10.0, lambda: f.ls.all_in(Phase.CLIMBING))
    f.ls.command(b'{"verb":"kill","confirm":true}')
    until(f.ls, 10.0, lambda: not f.ls.vehicles[1].autopilot.truth().armed and f.ls.all_in(Phase.LANDED, Phase.IDLE))
    wait(f.ls, 12.0)
    assert f.ls.vehicles[1].agent.status(f.ls.now).killed == "killed by command"
    assert json.loads(f.ls.command(b'{"verb":"takeoff"}')[1])["accepted"]
    wait(f.ls, 1.0)
    assert f.ls.vehicles[1].agent.status(f.ls.now).killed is None
    until(f.ls, 60.0, lambda: f.ls.all_in(Phase.MOVING))
    until_landed(f.ls)
    summary = check(f)
    assert summary["killed"] == {1: "killed by command"}
    assert not_met(summary) == {"vehicles killed"}


def test_a_vehicle_that_landed_while_the_others_were_still_forming_ends_what_is_steady() -> None:
    f = flown(fleet(COUNT, legs=straight(600.0)))
    until(f.ls, 60.0, lambda: f.ls.all_in(Phase.FORMING, Phase.FORMED) and not f.ls.all_in(Phase.FORMING))
    (first, *_) = [i for i, p in f.ls.phases().items() if p is Phase.FORMED]
    f.ls.command(b'{"verb":"land"}', first)
    until(f.ls, 60.0, lambda: f.ls.vehicles[first].agent.phase is Phase.LANDED)
    wait(f.ls, 5.0)
    f.ls.command(b'{"verb":"land"}')
    until_landed(f.ls)
    summary = check(f)
    assert summary["steady"]["seconds"] == 0
    assert summary["steady"]["formation_error_rms_m"] is None
    assert summary["passed"] is False


def test_what_the_others_do_after_an_autopilots_end_is_judged() -> None:
    f = flown(fleet(COUNT, legs=straight(600.0)))
    until(f.ls, 60.0, lambda: f.ls.all_in(Phase.MOVING))
    wait(f.ls, 5.0)
    f.end_autopilot(3)
    until(f.ls, 10.0, lambda: f.ls.vehicles[3].agent.phase is Phase.RELEASED)
    f.ls.command(b'{"verb":"land"}', 1, 2)
    until(f.ls, 60.0, lambda: f.ls.phases()[1] is f.ls.phases()[2] is Phase.LANDED)
    before = check(f)
    assert before["landed"] == {1: True, 2: True, 3: False}
    assert before["autopilots_lost"] == {3: "PX4 ended with status -9"}
    assert not_met(before) == {"autopilots lost", "failsafes", "vehicles not landed and disarmed"}
    f.believed = True
    assert check(f)["estimates"]["error_rms_m"] < 0.15, "a truth that ends leaves no figure without a number"
    # The same flight, but that the other two touch each other after that end.
    f.nearer_ns = f.dead[3] + 1_000_000_000
    after = check(f)
    assert after["minimum_distance_m"] < 0.5
    assert not_met(after) - not_met(before) == {"minimum_distance_m"}


def test_a_vehicle_of_which_nothing_is_known_hides_nothing_of_the_others() -> None:
    f = flown(fleet(COUNT, legs=straight(10.0)))
    f.dead[2] = 0
    until_landed(f.ls)
    summary = f.summary()
    assert summary["judged_by"] == "truth"
    nearest = minimum_distance_m(f.rows, f.takeoff_ns)
    assert nearest is not None
    assert summary["minimum_distance_m"] == pytest.approx(nearest[0], abs=6e-5)
    assert summary["landed"][2] is False
    assert summary["passed"] is False


def test_a_loop_that_stalls_for_longer_than_half_a_second_fails_the_flight() -> None:
    f = flown(fleet(2, legs=straight(20.0)))
    until(f.ls, 60.0, lambda: f.ls.all_in(Phase.MOVING))
    wait(f.ls, 4.0)
    f.ls.stall(1, 0.85)
    until_landed(f.ls)
    summary = check(f)
    assert not_met(summary) == {"setpoint_gap_max_s"}
    assert 0.8 < summary["setpoint_gap_max_s"] < 1.0
    assert summary["passed"] is False
