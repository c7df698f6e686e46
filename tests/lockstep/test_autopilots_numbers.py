"""Numbers of the autopilot that mean nothing, or go round: what a flight makes of them."""

from collections.abc import Iterable
from typing import Any

import pytest
from flights import failsafes, fleet, launch, until, until_formed, wait
from pymavlink.dialects.v20 import development as dialect

from companion.core.values import Phase
from sim.autopilot.faults import Fault, FaultKind
from sim.lockstep.lockstep import Lockstep

POSITION, ORIGIN, ESTIMATOR, STATUS = 32, 49, 230, 1
AUTOPILOT: Any = dialect.MAVLink(None, srcSystem=1, srcComponent=1)


class Altered(Lockstep):
    """A link on which fields of the autopilot's messages are others: message id -> what changes it."""

    def alter(self, message: Any) -> Any:
        return message

    def _to_companion(self, i: int, datagrams: Iterable[bytes]) -> None:
        super()._to_companion(i, [self._altered(d) for d in datagrams])

    def _altered(self, datagram: bytes) -> bytes:
        (message,) = dialect.MAVLink(None).parse_buffer(bytearray(datagram)) or [None]
        changed = None if message is None else self.alter(message)
        return datagram if changed is None else bytes(changed.pack(AUTOPILOT))


class LongUp(Altered):
    """An autopilot whose 32 bit of milliseconds are over 20 s after the start, 49.7 days after its boot."""

    def alter(self, message: Any) -> Any:
        if message.get_msgId() != POSITION:
            return None
        message.time_boot_ms = (message.time_boot_ms - 20_000) % (1 << 32)
        return message


def test_a_time_since_boot_that_goes_round_is_no_reboot() -> None:
    ls = LongUp(fleet(1, legs=[{"kind": "hold", "duration_s": 30.0}]))
    ls.run_until(8.0)
    ls.command(b'{"verb":"takeoff"}')
    until(ls, 30.0, lambda: ls.phases()[1] in (Phase.FORMED, Phase.MOVING, Phase.HOLDING))
    ls.run_until(max(ls.now_ns * 1e-9, 24.0))
    wait(ls, 3.0)
    agent = ls.vehicles[1].agent
    assert ls.now_ns > 24_000_000_000
    assert agent.autopilot.counts["autopilot reboot"] == 0
    assert failsafes(ls) == []
    assert ls.vehicles[1].autopilot.truth().setpoint_gap_max_s < 0.1


class Creeping(Altered):
    """An origin that moves by `step_m` north each second in flight, and positions that know nothing of it."""

    step_m = 0.3
    begin_s = 1e9

    def alter(self, message: Any) -> Any:
        if message.get_msgId() == ORIGIN:
            message.latitude += round(self.shift_m / 1.113e-2)
            return message
        return None

    @property
    def shift_m(self) -> float:
        return self.step_m * max(int(self.now_ns * 1e-9 - self.begin_s), 0)


@pytest.mark.parametrize("step_m", [0.05, 0.3, 0.45])
def test_an_origin_that_creeps_is_a_position_that_nobody_knows(step_m: float) -> None:
    ls = Creeping(fleet(1, altitude_m=5.0, change=lambda t: t["plan"].update(then="stay")))
    ls.step_m = step_m
    ls.run_until(6.0)
    ls.command(b'{"verb":"takeoff"}')
    until_formed(ls)
    ls.begin_s = ls.now_ns * 1e-9
    for _ in range(60):
        ls.vehicles[1].autopilot.schedule.send_one(ORIGIN)
        wait(ls, 1.0)
        if ls.phases()[1] not in (Phase.FORMED, Phase.HOLDING, Phase.DETACHED):
            break
    assert ls.phases()[1] in (Phase.LANDING, Phase.LANDED)
    assert ls.shift_m <= 2.0, "before the vehicle is two metres from where it believes to be"
    assert any("own position uncertain: estimator's origin has crept" in note for _, note in failsafes(ls))


def test_an_origin_that_moves_with_its_positions_once_is_no_creep() -> None:
    ls = launch(fleet(1, altitude_m=5.0, change=lambda t: t["plan"].update(then="stay")))
    until_formed(ls)
    ls.vehicles[1].autopilot.inject(Fault(FaultKind.ESTIMATOR_RESET))
    wait(ls, 10.0)
    assert ls.phases()[1] in (Phase.FORMED, Phase.HOLDING)
    assert failsafes(ls) == []


class NoAccuracy(Altered):
    """An estimator whose accuracy is a number that is none, from a time on."""

    accuracy_m = -150.0
    begin_s = 0.0

    def alter(self, message: Any) -> Any:
        if message.get_msgId() != ESTIMATOR or self.now_ns < self.begin_s * 1e9:
            return None
        message.pos_horiz_accuracy = self.accuracy_m
        return message


@pytest.mark.parametrize("accuracy_m", [-150.0, -1e-3, 0.0, float("nan"), float("inf"), 150.0])
def test_an_accuracy_that_is_none_takes_nobody_off_and_lands_who_flies(accuracy_m: float) -> None:
    ls = NoAccuracy(fleet(1))
    ls.accuracy_m = accuracy_m
    ls.run_until(6.0)
    assert any(says.startswith("position uncertain by") for says in ls.vehicles[1].agent.operator.unready(ls.now))
    ls.begin_s = 1e9
    wait(ls, 3.0)
    ls.command(b'{"verb":"takeoff"}')
    until_formed(ls)
    ls.begin_s = 0.0
    until(ls, 6.0, lambda: ls.phases()[1] is Phase.LANDING)
    assert any("own position uncertain" in note for _, note in failsafes(ls))
