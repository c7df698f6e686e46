"""What every transport must do, asked of each; and a fleet that flies on the one in memory."""

from __future__ import annotations

import itertools
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from fleet_process import SETTLED, all_in, make_fleet, wait_status
from memory_transport import Bus, MemoryOperatorLink, MemoryTransport

from companion.io.loop import Companion, RunSettings
from companion.io.recording import read_recording
from companion.io.replay import replay_file
from companion.io.transport import (
    PAYLOAD_MAX_BYTES,
    Event,
    OperatorLink,
    PeerTransport,
    PresenceChange,
    ReceivedSample,
    Request,
    Sent,
)
from companion.io.zenoh.configuration import SessionSettings
from companion.io.zenoh.operator import ZenohOperatorLink
from companion.io.zenoh.vehicle import ZenohTransport
from companion.operator.client import Operator
from sim.autopilot.stub_fleet import stub_settings
from sim.autopilot.stubs import run_stubs

PATIENCE_S = 10.0
_numbers = itertools.count()


@dataclass
class Loop:
    """What stands behind a vehicle's end: taken as soon as it wakes."""

    transport: PeerTransport
    woken: threading.Event
    events: list[Event] = field(default_factory=list)

    def until(self, enough: Callable[[], bool]) -> bool:
        """Take what comes until there is enough."""
        until_s = time.monotonic() + PATIENCE_S
        while not enough():
            if not self.woken.wait(max(0.0, until_s - time.monotonic())):
                return False
            self.woken.clear()
            self.events += self.transport.drain()
        return True

    @property
    def samples(self) -> list[tuple[str, bytes]]:
        return [(e.key, e.payload) for e in self.events if isinstance(e, ReceivedSample)]

    @property
    def presence(self) -> list[tuple[int, bool]]:
        return [(e.vehicle_id, e.alive) for e in self.events if isinstance(e, PresenceChange)]

    @property
    def requests(self) -> list[Request]:
        return [e for e in self.events if isinstance(e, Request)]


@dataclass
class Network:
    """One fleet's network of one kind."""

    make: Callable[[int, Callable[[], None]], PeerTransport]
    operator: Callable[[], OperatorLink]

    @contextmanager
    def vehicle(self, vehicle_id: int) -> Iterator[Loop]:
        woken = threading.Event()
        transport = self.make(vehicle_id, woken.set)
        transport.open()
        try:
            yield Loop(transport, woken)
        finally:
            transport.close()


def in_memory() -> Network:
    bus = Bus()
    return Network(lambda i, wake: MemoryTransport(bus, i, wake), lambda: MemoryOperatorLink(bus))


def over_zenoh() -> Network:
    name = f"transports-{os.getpid()}-{next(_numbers)}"
    return Network(
        lambda i, wake: ZenohTransport(SessionSettings(name, i), wake),
        lambda: ZenohOperatorLink(SessionSettings(name, None)),
    )


@pytest.fixture(params=[in_memory, pytest.param(over_zenoh, marks=pytest.mark.process)])
def network(request: pytest.FixtureRequest) -> Network:
    made: Network = request.param()
    return made


def test_what_a_vehicle_publishes_reaches_its_peers_once_in_order_and_not_itself(network: Network) -> None:
    with network.vehicle(1) as one, network.vehicle(2) as two:
        assert one.until(lambda: (2, True) in one.presence)
        assert two.until(lambda: (1, True) in two.presence)
        for k in range(5):
            one.transport.publish("state", b"%d" % k)
        one.transport.publish("plan", b"plan")
        assert two.until(lambda: len(two.samples) == 6)
        assert [payload for key, payload in two.samples if key == "fleet/1/state"] == [b"%d" % k for k in range(5)]
        assert ("fleet/1/plan", b"plan") in two.samples
        two.transport.publish("state", b"back")
        assert one.until(lambda: bool(one.samples))
        assert one.samples == [("fleet/2/state", b"back")]
        assert one.transport.counters.dropped == one.transport.counters.malformed == 0
        sent = one.transport.sent()
        assert 0 < sent.packets < sent.bytes


def test_a_late_joiner_gets_the_last_state_and_plan_of_who_is_there(network: Network) -> None:
    with network.vehicle(1) as one:
        for payload in (b"old", b"last"):
            one.transport.publish("state", payload)
            one.transport.publish("plan", payload)
        with network.vehicle(2) as two:
            assert two.until(lambda: len(two.samples) >= 2)
            assert sorted(two.samples) == [("fleet/1/plan", b"last"), ("fleet/1/state", b"last")]


def test_who_leaves_is_told_to_the_others_and_sends_no_more(network: Network) -> None:
    with network.vehicle(1) as one, network.vehicle(2) as two:
        assert one.until(lambda: (2, True) in one.presence)
        two.transport.close()
        two.transport.close()
        assert one.until(lambda: (2, False) in one.presence)
        two.transport.publish("state", b"nobody hears this")
        assert two.transport.counters.publish_failures == 1
        assert two.transport.drain() == []


def test_somebody_else_under_our_id_is_heard(network: Network) -> None:
    with network.vehicle(1) as one, network.vehicle(1) as double, network.vehicle(2) as two:
        assert two.until(lambda: (1, True) in two.presence)
        assert double.until(lambda: (2, True) in double.presence)
        assert one.until(lambda: (2, True) in one.presence)
        double.transport.publish("state", b"false")
        assert one.until(lambda: ("fleet/1/state", b"false") in one.samples)


def test_a_payload_beyond_the_limit_is_nobodys(network: Network) -> None:
    with network.vehicle(1) as one, network.vehicle(2) as two:
        assert two.until(lambda: (1, True) in two.presence)
        one.transport.publish("plan", bytes(PAYLOAD_MAX_BYTES + 1))
        time.sleep(0.1)  # a transport may leave out what follows at once
        one.transport.publish("plan", b"good")
        assert two.until(lambda: bool(two.samples))
        assert two.samples == [("fleet/1/plan", b"good")]


def test_an_unknown_topic_is_our_own_bug(network: Network) -> None:
    with network.vehicle(1) as one, pytest.raises(ValueError, match="topic"):
        one.transport.publish("stat", b"")


def test_an_operator_sees_who_is_there_and_each_answers_once(network: Network) -> None:
    answers: dict[int, tuple[bytes, ...]] = {}
    with network.vehicle(1) as one, network.vehicle(2) as two, network.operator() as operator:
        assert operator.wait_alive([1, 2], PATIENCE_S) == {1, 2}
        asking = threading.Thread(
            target=lambda: answers.update(operator.ask([1, 2, 3], "status", b"?", timeout_s=2.0, retry_s=5.0))
        )
        asking.start()
        for loop in (one, two):
            assert loop.until(lambda: bool(loop.requests))  # noqa: B023
            (request,) = loop.requests
            assert (request.kind, request.payload) == ("status", b"?")
            request.reply(b"yes")
            with pytest.raises(RuntimeError, match="once"):
                request.reply(b"again")
        asking.join()
        assert answers == {1: (b"yes",), 2: (b"yes",), 3: ()}
        assert operator.ask_timed([3], "status", b"?", timeout_s=0.1, retry_s=1.0) == {3: None}


class FailingTransport(MemoryTransport):
    """Raises so many times in each of its parts, when it is told to."""

    def __init__(self, bus: Bus, vehicle_id: int, wake: Callable[[], None]) -> None:
        super().__init__(bus, vehicle_id, wake)
        self.failing: dict[str, int] = {}

    def _fail(self, part: str) -> None:
        if self.failing.get(part, 0) > 0:
            self.failing[part] -= 1
            raise RuntimeError(part)

    def drain(self) -> list[Event]:
        self._fail("drain")
        return super().drain()

    def publish(self, topic: str, payload: bytes) -> None:
        self._fail("publish")
        super().publish(topic, payload)

    def sent(self) -> Sent:
        self._fail("sent")
        return super().sent()


@pytest.mark.process
@pytest.mark.timeout(60)
def test_what_waits_at_a_transport_that_failed_is_asked_for_again_though_nothing_more_comes(tmp_path: Path) -> None:
    fleet, bus = make_fleet(tmp_path, 1), Bus()
    settings = RunSettings(1, log=lambda _: None)
    with ExitStack() as stack:
        alone = Companion(fleet.config, settings, {}, lambda wake: FailingTransport(bus, 1, wake))
        thread = threading.Thread(target=alone.run)
        for at_last in (alone.close, thread.join, alone.ask_to_stop, alone.ask_to_stop):
            stack.callback(at_last)
        thread.start()
        operator = MemoryOperatorLink(bus)
        assert operator.ask_timed([1], "status", b"", timeout_s=5.0, retry_s=5.0)[1], "it runs"
        alone.network.failing.update(drain=3)  # type: ignore[attr-defined]
        asked = operator.ask_timed([1], "status", b"", timeout_s=5.0, retry_s=100.0)
        assert asked[1] is not None
        assert alone.guard.raised["transport drain: RuntimeError"] == 3


@pytest.mark.process
@pytest.mark.timeout(200)
def test_three_companions_in_one_process_fly_on_the_transport_in_memory(tmp_path: Path) -> None:
    """The loop itself: no process, signal or Zenoh session around it, stubs for autopilots."""
    fleet = make_fleet(tmp_path, 3)
    bus = Bus()
    statuses: dict[int, int] = {}
    end_read, end_write = os.pipe()

    def companion(i: int) -> Companion:
        settings = RunSettings(i, tmp_path / f"{i}.mcap", log=lambda _: None)
        metadata = {"config": fleet.file.read_text()}
        return Companion(fleet.config, settings, metadata, lambda wake: FailingTransport(bus, i, wake))

    with ExitStack() as stack:
        stack.callback(os.close, end_read)
        stubs = threading.Thread(target=run_stubs, args=(stub_settings(fleet.config, seed=1, stop_fd=end_read),))
        stack.callback(stubs.join)
        stack.callback(os.close, end_write)
        stubs.start()
        flying = {i: companion(i) for i in fleet.ids}
        threads = [threading.Thread(target=lambda i=i, c=c: statuses.update({i: c.run()})) for i, c in flying.items()]
        for c, thread in zip(flying.values(), threads, strict=True):
            stack.callback(c.close)
            stack.callback(thread.join)
            stack.callback(c.ask_to_stop)
            thread.start()
        operator = Operator(fleet.config, MemoryOperatorLink(bus))
        wait_status(operator, lambda said: len(said) == 3 and not any(s.ready for s in said.values()))
        assert operator.take_off().all_accepted
        said = wait_status(operator, all_in(fleet.ids, *SETTLED))
        assert all(s.neighbours == 2 and (s.nearest_m or 0.0) > 1.0 for s in said.values())
        flying[1].network.inbox.count("publish_failures")  # type: ignore[attr-defined]
        flying[1].network.inbox.count("reply_failures")  # type: ignore[attr-defined]
        told = wait_status(operator, lambda said: "peer: could not be sent" in said[1].rejected)[1].rejected
        assert (told["peer: could not be sent"], told["operator: could not be answered"]) == (1, 1)
        flying[2].network.failing.update(drain=20, publish=1, sent=1)  # type: ignore[attr-defined]
        raised = {f"raised: transport {part}: RuntimeError" for part in ("drain", "publish", "sent")}
        said = wait_status(operator, lambda said: 2 in said and raised <= said[2].rejected.keys())
        assert said[2].phase in SETTLED
        assert all((s.packets_hz or 0.0) > 0.0 and (s.bytes_per_s or 0.0) > 0.0 for s in said.values())
        assert operator.land().all_accepted
        wait_status(operator, all_in(fleet.ids, "landed"))
    assert statuses == dict.fromkeys(fleet.ids, 0)
    for i in fleet.ids:
        assert any(e.channel == "input/peer" for e in read_recording(tmp_path / f"{i}.mcap").entries)
        assert replay_file(tmp_path / f"{i}.mcap").same
