"""Companions that come, go and come again, each a process of its own beside stubs that fly on."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from fleet_process import (
    SETTLED,
    Fleet,
    Process,
    all_in,
    eventually,
    make_fleet,
    minimum_distance_m,
    operator_of,
    run,
    started,
    truth,
    wait_status,
)
from strangers import datagrams, failsafes, rejected, send

from companion.io.zenoh.configuration import (
    scouting_port,
)
from companion.operator.client import Operator
from companion.wire.operator import Status
from companion.wire.px4 import Px4Mode

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]
ON_GROUND = 1


# -- companions one by one -------------------------------------------------------------------------------------------


@dataclass(slots=True)
class Single:
    """Three vehicles whose processes the test starts and ends itself, beside a fleet of another name."""

    fleet: Fleet
    truth: Path
    before_autopilot: dict[int, Status] = field(default_factory=dict)
    waiting: dict[int, Status] = field(default_factory=dict)
    """two companions there, the third vehicle's not; another fleet has a vehicle 3"""
    refused: subprocess.CompletedProcess[str] | None = None
    other: dict[int, Status] = field(default_factory=dict)
    """what the other fleet's vehicle 3 said meanwhile"""
    busy: subprocess.CompletedProcess[str] | None = None
    flying: dict[int, Status] = field(default_factory=dict)
    restarted: dict[int, Status] = field(default_factory=dict)
    """after vehicle 3's companion was killed and started again"""
    terminated_status: int = -1
    terminated_after_s: float = 0.0
    mode_after_termination: int = 0
    ended: list[int] = field(default_factory=list)
    stub_status: int = -1
    stub_err: str = ""


class Companions:
    """Starts companions of one fleet and keeps them until the end."""

    def __init__(self, stack: ExitStack, fleet: Fleet) -> None:
        self._stack, self._fleet = stack, fleet
        self._numbers = itertools.count()

    def start(self, vehicle_id: int) -> Process:
        arguments = ("companion", "run", "--vehicle", str(vehicle_id), "--fleet", str(self._fleet.file))
        name = f"companion-{vehicle_id}-{next(self._numbers)}"
        return self._stack.enter_context(started(*arguments, folder=self._fleet.folder, name=name))


def ready_but_for(said: dict[int, Status], ids: list[int], reasons: list[str]) -> bool:
    return all(i in said and said[i].ready == reasons for i in ids)


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Single]:
    """Late, restarted and terminated companions on one stub process."""
    folder = tmp_path_factory.mktemp("single")
    port = scouting_port(f"test-{os.getpid()}")
    plan = {"legs": [{"kind": "velocity", "north_m_s": 0.5, "duration_s": 3600.0}]}
    fleet = make_fleet(folder, 3, scouting=port, plan=plan)
    foreign = make_fleet(folder, 3, scouting=port)
    single = Single(fleet, folder / "truth.bin")
    with ExitStack() as stack:
        mine, theirs = Companions(stack, fleet), Companions(stack, foreign)
        operator = stack.enter_context(operator_of(fleet))
        first, second = mine.start(1), mine.start(2)
        theirs.start(3)
        wait_status(operator, lambda said: sorted(said) == [1, 2])
        send(fleet.port, datagrams(1))
        single.before_autopilot = wait_status(
            operator, lambda said: 1 in said and sum(said[1].rejected.values()) >= len(datagrams(1)) - 1
        )
        stub = stack.enter_context(
            started("sim", "stub", "--fleet", str(fleet.file), "--truth", str(single.truth), folder=folder, name="stub")
        )
        stack.enter_context(started("sim", "stub", "--fleet", str(foreign.file), folder=folder, name="foreign"))
        with operator_of(foreign) as other:
            single.other = wait_status(other, lambda said: ready_but_for(said, [3], ["not heard: vehicle 1, 2"]))
        single.waiting = wait_status(operator, lambda said: ready_but_for(said, [1, 2], ["not heard: vehicle 3"]))
        single.refused = run("sim", "takeoff", "--fleet", str(fleet.file), folder=folder)
        third = mine.start(3)
        single.busy = run("companion", "run", "--vehicle", "1", "--fleet", str(fleet.file), folder=folder)
        wait_status(operator, lambda said: ready_but_for(said, [1, 2, 3], []))
        assert operator.take_off().all_accepted
        single.flying = wait_status(operator, all_in(fleet.ids, *SETTLED, revision=2))
        third.signal(signal.SIGKILL)
        third.wait()
        again = mine.start(3)
        single.restarted = wait_status(
            operator, lambda said: len(said) == 3 and said[3].revision == 2 and not said[3].armed
        )
        before = time.monotonic()
        second.signal(signal.SIGTERM)
        single.terminated_status = second.wait()
        single.terminated_after_s = time.monotonic() - before
        assert eventually(lambda: truth(single.truth, 2)["custom_mode"][-1] == Px4Mode.AUTO_LAND, 2.0)
        _land(operator, single, first)
        single.ended = [_end(p) for p in (first, again)]
        stub.signal(signal.SIGINT)
        single.stub_status = stub.wait()
        single.stub_err = stub.err
        yield single


def _land(operator: Operator, single: Single, first: Process) -> None:
    operator.land()
    wait_status(operator, lambda said: said[1].phase == "landed")
    assert first.popen.poll() is None


def _end(process: Process) -> int:
    process.signal(signal.SIGTERM)
    return process.wait()


def test_what_no_autopilot_may_say_is_counted_by_kind_before_there_is_one(single: Single) -> None:
    status = single.before_autopilot[1]
    assert "no heartbeat from the autopilot" in status.ready
    assert rejected(status, "not finite") == 2
    assert rejected(status, "foreign system") >= 1
    assert rejected(status, "malformed") >= 8
    assert rejected(status, "mavlink: another address than the autopilot's") == 0


def test_fleets_of_different_names_do_not_hear_each_other_on_one_scouting_port(single: Single) -> None:
    assert single.waiting[1].ready == ["not heard: vehicle 3"]
    assert 3 not in single.waiting
    assert single.other[3].phase == "idle"
    assert single.other[3].neighbours == 0
    assert single.other[3].rejected.keys().isdisjoint({"own id", "foreign id", "peer: under our own id"})


def test_take_off_is_refused_while_a_vehicle_is_missing(single: Single) -> None:
    assert single.refused is not None
    assert single.refused.returncode == 1
    assert "vehicle 1: not heard: vehicle 3" in single.refused.stderr
    assert "\n  not heard: vehicle 3\n" in single.refused.stderr


def test_a_companion_that_comes_late_flies_with_the_others(single: Single) -> None:
    assert {s.phase for s in single.flying.values()} <= set(SETTLED)
    assert len(single.flying) == 3


def test_a_second_companion_of_a_vehicle_says_which_port_is_in_use(single: Single) -> None:
    assert single.busy is not None
    assert single.busy.returncode == 1
    assert single.busy.stderr.strip() == (
        f"companion: vehicle 1: cannot listen on UDP 127.0.0.1:{single.fleet.port}: it is in use"
    )


def test_a_companion_restarted_in_flight_gets_the_plan_and_leaves_its_vehicle_to_the_autopilots_landing(
    single: Single,
) -> None:
    third = single.restarted[3]
    assert third.phase == "idle"
    assert third.revision == 2
    assert third.setpoints == 0
    track = truth(single.truth, 3)
    assert Px4Mode.AUTO_LAND in track["custom_mode"]
    assert track["landed_state"][-1] == ON_GROUND


def test_a_companion_restarted_in_flight_does_not_disturb_the_others(single: Single) -> None:
    for i in (1, 2):
        assert single.restarted[i].phase in SETTLED
        assert failsafes(single.restarted[i].failsafes) == []
    assert minimum_distance_m(single.truth) >= 1.2


def test_a_companion_that_is_terminated_in_flight_lands_its_vehicle_and_exits_well(single: Single) -> None:
    assert single.terminated_status == 0
    assert single.terminated_after_s < 4.5
    assert truth(single.truth, 2)["custom_mode"].tolist().count(Px4Mode.AUTO_LAND) > 0
    assert single.ended == [0, 0]


def test_stubs_alone_run_until_interrupted(single: Single) -> None:
    assert single.stub_status == 0
    assert f"vehicle 3: system id 3, speaks to udp://127.0.0.1:{single.fleet.port + 2}" in single.stub_err
    assert "Traceback" not in single.stub_err
