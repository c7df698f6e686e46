"""Whoever disarms a vehicle just after its companion has armed it has the last word; and each request is made once."""

import json
from collections import Counter
from collections.abc import Iterable
from typing import Any

import pytest
from flights import failsafes, fleet, launch, parse, until, until_formed, until_landed, wait
from pymavlink.dialects.v20 import development as dialect

from companion.core.values import Instant, Phase
from companion.wire.px4 import FORCE, Px4Mode
from sim.lockstep.lockstep import Lockstep

GROUND_STATION: Any = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
ARM, ACK = 400, 77
COMMAND_LONG = 76
DELAYS_S = (0.0, 0.1, 0.2, 0.35, 0.5, 0.7, 0.9, 1.0, 1.1, 1.3, 1.6, 2.0)


class Forgetful(Lockstep):
    """A link on which the autopilot's answers to commands are lost."""

    def _to_companion(self, i: int, datagrams: Iterable[bytes]) -> None:
        super()._to_companion(i, [d for d in datagrams if int.from_bytes(d[7:10], "little") != ACK])


def disarm(ls: Lockstep) -> None:
    """The pilot's disarm, wherever the vehicle is."""
    message = dialect.MAVLink_command_long_message(1, 1, ARM, 0, 0.0, FORCE, 0.0, 0.0, 0.0, 0.0, 0.0)
    ls.vehicles[1].autopilot.receive(bytes(message.pack(GROUND_STATION)), ls.now_ns)


def armed(ls: Lockstep) -> bool:
    return ls.vehicles[1].autopilot.truth().armed


def arms(ls: Lockstep, limit_s: float) -> bool:
    """Whether the vehicle is armed within that time, to a millisecond."""
    for _ in range(round(limit_s * 1000)):
        if armed(ls):
            return True
        wait(ls, 0.001)
    return armed(ls)


@pytest.mark.parametrize("delay_s", DELAYS_S)
@pytest.mark.parametrize("kind", [Lockstep, Forgetful], ids=["answered", "answers lost"])
def test_a_vehicle_that_its_pilot_disarms_just_after_arming_stays_disarmed(
    kind: type[Lockstep], delay_s: float
) -> None:
    # Heartbeats come once a second: what the companion knows depends on where between two of them the arming falls.
    for k in range(5):
        ls = kind(fleet(1, altitude_m=6.0))
        ls.run_until(6.0 + 0.2 * k)
        assert json.loads(ls.command(b'{"verb":"takeoff"}')[1])["accepted"]
        assert arms(ls, 2.0)
        wait(ls, delay_s)
        disarm(ls)
        assert not armed(ls)
        assert not arms(ls, 3.0), (delay_s, k)
        assert ls.phases()[1] in (Phase.IDLE, Phase.LANDED)
        wait(ls, 12.0)
        assert not armed(ls)
        assert ls.positions()[1].down > -0.5
        assert ls.vehicles[1].autopilot.truth().custom_mode == Px4Mode.AUTO_LOITER, "a later arming takes off nowhere"


def test_the_pilots_disarm_is_told_and_a_new_command_takes_off() -> None:
    ls = launch(fleet(1))
    assert arms(ls, 2.0)
    disarm(ls)
    until(ls, 2.0, lambda: ls.phases()[1] is Phase.IDLE)
    assert [note for _, note in failsafes(ls)] == [
        "failsafe: autopilot does not arm: disarmed again after it was armed; the take-off is given up: continue"
    ]
    wait(ls, 1.5)
    assert json.loads(ls.command(b'{"verb":"takeoff"}')[1])["accepted"]
    until_formed(ls)


def test_a_flight_without_faults_asks_for_each_thing_once_and_hears_no_answer_to_nothing_asked() -> None:
    asked: Counter[tuple[int, int, str]] = Counter()

    def record(i: int, channel: str, now: Instant, body: bytes) -> None:
        if channel == "output/mavlink" and int.from_bytes(body[7:10], "little") == COMMAND_LONG:
            m = parse(body)
            what = f"{m.param1:g} {m.param2:g} {m.param3:g}"
            asked[i, m.command, what] += 1

    ls = Lockstep(fleet(3, legs=[{"kind": "hold", "duration_s": 2.0}]), seed=5, record=record)
    ls.run_until(6.0)  # earlier an autopilot rejects the arming for now, and is asked again
    ls.command(b'{"verb":"takeoff"}')
    until_formed(ls)
    until_landed(ls)
    wait(ls, 2.0)
    assert max(asked.values()) == 1, asked.most_common(5)
    counts = sum((v.agent.autopilot.counts for v in ls.vehicles.values()), Counter())
    assert counts["answer to nothing asked"] == 0
    assert {i: n for (i, command, _), n in asked.items() if command == ARM} == {1: 1, 2: 1, 3: 1}
    assert failsafes(ls) == []


def test_an_arming_whose_answer_is_lost_still_takes_off() -> None:
    ls = Forgetful(fleet(1))
    ls.run_until(6.0)
    assert json.loads(ls.command(b'{"verb":"takeoff"}')[1])["accepted"]
    until(ls, 20.0, lambda: ls.phases()[1] is Phase.FORMED)


def test_a_kill_is_asked_for_until_a_heartbeat_says_that_the_motors_stand() -> None:
    ls = launch(fleet(1))
    until_formed(ls)
    kills: list[float] = []

    def record(i: int, channel: str, now: Instant, body: bytes) -> None:
        if channel == "output/mavlink" and int.from_bytes(body[7:10], "little") == COMMAND_LONG:
            kills.extend([now.monotonic_ns * 1e-9] * (parse(body).command == ARM))

    ls.record = record
    ls.command(b'{"verb":"kill","confirm":true}')
    until(ls, 2.0, lambda: ls.phases()[1] is Phase.LANDED)
    wait(ls, 3.0)
    assert len(kills) == 1
