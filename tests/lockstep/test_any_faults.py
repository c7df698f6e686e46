"""Two vehicles in the air, and any faults and commands in any order: what must hold whatever happens."""

import json
from typing import Any

import numpy as np
import pytest
from flights import check_setpoint, distances, fleet, truth
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from companion.core.failsafe import Failsafe
from companion.core.safety.filter import COLLISION_DISTANCE_M
from companion.core.values import FLYING_PHASES, Instant, Phase
from companion.wire.mavlink import ON_GROUND
from companion.wire.px4 import Px4Mode
from sim.autopilot.faults import OF_PX4_ALONE, Fault, FaultKind
from sim.lockstep.clockwork import UTC_AT_START_NS
from sim.lockstep.lockstep import Lockstep
from sim.study.campaign_faults import ESTIMATE_FAULTS

pytestmark = pytest.mark.timeout(600)
"""flights are simulated within a test, on whatever machine"""

IDS = st.sampled_from([1, 2])
BLINDING = [kind for kind in FaultKind if kind.value in ESTIMATE_FAULTS and kind not in OF_PX4_ALONE]
FENCE = {"radius_m": 15.0, "floor_m": 1.0, "ceiling_m": 8.0}
ENDED_S = 120.0


def brief(tables: dict[str, Any]) -> None:
    tables["trigger"]["t_max_s"] = 2.0
    tables["peers"].update(isolated_flight_s=2.0, wait_s=8.0)
    tables["failsafe"]["isolated_hold_s"] = 3.0
    tables["fence"] = FENCE
    tables["plan"].update(then="return", legs=[{"kind": "velocity", "north_m_s": 1.0, "duration_s": 3.0}])


class AnyFaults(RuleBasedStateMachine):
    """Finite setpoints within limits; none to an autopilot that left OFFBOARD by another's will; distance and fence
    kept by whoever may know where it is; an end."""

    def __init__(self) -> None:
        super().__init__()
        self.config = fleet(2, change=brief)
        self.setpoints: dict[int, list[float]] = {1: [], 2: []}
        self.taken: dict[int, float] = {}
        """when the pilot took a vehicle that nobody resumed since (s)"""
        self.blind: dict[int, float] = {}
        """since when nobody can know where a vehicle is (s)"""
        self.falling: dict[int, float] = {}
        """since when a vehicle's motors stand (s)"""

    @initialize(seed=st.integers(0, 5))
    def take_off(self, seed: int) -> None:
        self.ls = Lockstep(self.config, seed=seed, record=self.record)
        self.ls.run_until(4.5)
        self.ls.command(b'{"verb":"takeoff"}')
        self.ls.run_until(12.0)

    def record(self, i: int, channel: str, now: Instant, body: bytes) -> None:
        if channel == "output/mavlink" and check_setpoint(body, self.config):
            self.setpoints[i].append(now.monotonic_ns * 1e-9)

    @property
    def seconds(self) -> float:
        return self.ls.now_ns * 1e-9

    @rule(seconds=st.sampled_from([0.05, 0.3, 1.0, 3.0, 8.0]))
    def wait(self, seconds: float) -> None:
        self.ls.run_until(self.seconds + seconds)

    @rule(
        i=IDS,
        kind=st.sampled_from([*BLINDING, FaultKind.MUTE, FaultKind.LINK_LOST]),
        duration_s=st.sampled_from([0.4, 1.0, 4.0]),
    )
    def break_autopilot(self, i: int, kind: FaultKind, duration_s: float) -> None:
        self.ls.vehicles[i].autopilot.inject(Fault(kind, duration_s=duration_s))
        if kind in BLINDING:
            self.blind.setdefault(i, self.seconds)

    @rule(i=IDS, fraction=st.sampled_from([0.08, 0.2]))
    def drain(self, i: int, fraction: float) -> None:
        self.ls.vehicles[i].autopilot.inject(Fault(FaultKind.LOW_BATTERY, fraction))

    @rule(i=IDS)
    def take_over(self, i: int) -> None:
        v = self.ls.vehicles[i]
        muted = v.agent.autopilot.position_age_s(self.ls.now) > 0.1
        if v.autopilot.truth().custom_mode == Px4Mode.OFFBOARD and v.alive and not muted:
            v.autopilot.inject(Fault(FaultKind.PILOT_TAKEOVER))
            self.taken[i] = self.seconds

    @rule(
        verb=st.sampled_from(["land", "release", "resume", "kill"]),
        i=IDS,
    )
    def command(self, verb: str, i: int) -> None:
        answers = self.ls.command(json.dumps({"verb": verb, "confirm": True}).encode(), i)
        for answer in answers.values():
            accepted = json.loads(answer)["accepted"]
            if verb == "resume" and accepted:
                self.taken.pop(i, None)
            if verb == "kill" and accepted:
                self.falling.setdefault(i, self.seconds)

    @rule(i=IDS)
    def kill_process(self, i: int) -> None:
        if self.ls.vehicles[i].alive:
            self.ls.kill(i)

    @rule(i=IDS)
    def restart_process(self, i: int) -> None:
        if not self.ls.vehicles[i].alive:
            self.ls.restart(i)

    @rule(i=IDS, seconds=st.sampled_from([0.1, 0.5, 1.5]))
    def stall(self, i: int, seconds: float) -> None:
        self.ls.stall(i, seconds)

    @rule(i=IDS, failsafe=st.sampled_from([Failsafe.DISK_FULL, Failsafe.CONFIGURATION]))
    def notice(self, i: int, failsafe: Failsafe) -> None:
        if self.ls.vehicles[i].alive:
            self.ls.notice(i, failsafe)

    @rule(apart=st.booleans())
    def cut(self, apart: bool) -> None:
        self.ls.partition(*([{1}, {2}] if apart else []))

    @invariant()
    def no_setpoint_after_a_takeover(self) -> None:
        for i, taken_s in self.taken.items():
            assert not [s for s in self.setpoints[i] if s > taken_s + 0.2]

    def teardown(self) -> None:
        if not hasattr(self, "ls"):
            return
        ls = self.ls
        # Whoever is not in the pilot's or the autopilot's hands is landed by the rules, or by the plan's end.
        ls.run_until(
            self.seconds + ENDED_S,
            lambda: all(
                v.agent.phase not in FLYING_PHASES | {Phase.PREFLIGHT} for v in ls.vehicles.values() if v.alive
            ),
        )
        for v in ls.vehicles.values():
            if v.alive:
                assert v.agent.phase in (Phase.LANDED, Phase.RELEASED, Phase.IDLE), v.agent.phase
        self.no_setpoint_after_a_takeover()
        self.distance_and_fence_were_kept()

    def distance_and_fence_were_kept(self) -> None:
        t = truth(self.ls)
        assert np.isfinite(t.position_ned_m).all()
        seconds = (t.times_ns - UTC_AT_START_NS) * 1e-9
        aloft = t.landed_state != ON_GROUND
        known = seconds < min(self.blind.values(), default=np.inf)
        assert distances(t)[known & aloft.any(axis=1)].min(initial=np.inf) >= COLLISION_DISTANCE_M
        ours = aloft & (t.mode == Px4Mode.OFFBOARD)
        for k, i in enumerate(t.ids):
            since_s = min(self.blind.get(i, np.inf), self.falling.get(i, np.inf))
            p = t.position_ned_m[ours[:, k] & (seconds < since_s), k]
            assert np.hypot(p[:, 0], p[:, 1]).max(initial=0.0) <= FENCE["radius_m"]
            assert (-p[:, 2]).max(initial=0.0) <= FENCE["ceiling_m"]
            assert (-p[:, 2]).min(initial=np.inf) >= FENCE["floor_m"]


AnyFaults.TestCase.settings = settings(
    max_examples=12,
    stateful_step_count=10,
    deadline=None,
    derandomize=True,
    suppress_health_check=list(HealthCheck),
)
test_whatever_fails_and_whatever_is_commanded_every_vehicle_ends_landed_or_handed_over = AnyFaults.TestCase
