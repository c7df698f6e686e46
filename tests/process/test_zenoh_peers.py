"""Vehicles and operators on a real Zenoh mesh of this machine's loopback."""

from __future__ import annotations

import itertools
import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import pytest
import zenoh
from zenoh.handlers import Callback
from zenoh_child import child

from companion.errors import ConfigError
from companion.io.mailbox import BOUNDS, Bound
from companion.io.transport import PAYLOAD_MAX_BYTES, Event, PresenceChange, ReceivedSample, Request, TransportError
from companion.io.zenoh.configuration import (
    PLANS_HZ,
    REQUESTS_HZ,
    STATE_MAX_BYTES,
    SessionSettings,
    scouting_port,
    zenoh_configuration,
)
from companion.io.zenoh.operator import ASK_INTERVAL_S, ZenohOperatorLink
from companion.io.zenoh.vehicle import ZenohTransport

T = TypeVar("T")
PATIENCE_S = 10.0
"""how long a test waits for what must come; far above what it takes"""

_numbers = itertools.count()


def mesh_endpoints(host: str, port: int = 7447) -> tuple[str]:
    """The endpoint of one vehicle in the field."""
    return (f"tcp/{host}:{port}",)


@pytest.fixture
def fleet() -> str:
    """A name, and so a namespace and a scouting port, that no other test run uses."""
    return f"test-{os.getpid()}-{next(_numbers)}"


class Vehicle:
    """A ZenohTransport with a loop's mailbox."""

    def __init__(self, settings: SessionSettings, states_waiting: int = 4096) -> None:
        self._woken = threading.Event()
        self.network = ZenohTransport(settings, self._woken.set, BOUNDS | {"state": Bound(states_waiting, 256)})
        self.events: list[Event] = []

    def collect(self, enough: Callable[[list[Event]], bool], timeout_s: float = PATIENCE_S) -> bool:
        """Take events as they come until there are enough; False when the time is up."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            self._woken.clear()
            self.events += self.network.drain()
            if enough(self.events):
                return True
            if not self._woken.wait(max(0.0, deadline_s - time.monotonic())):
                return False

    def messages(self) -> list[tuple[str, bytes]]:
        return [(event.key, event.payload) for event in self.events if isinstance(event, ReceivedSample)]

    def presence(self) -> list[tuple[int, bool]]:
        return [(event.vehicle_id, event.alive) for event in self.events if isinstance(event, PresenceChange)]

    def requests(self) -> list[Request]:
        return [event for event in self.events if isinstance(event, Request)]

    def wait_message(self, key: str, payload: bytes) -> None:
        assert self.collect(lambda _: (key, payload) in self.messages()), self.events

    def wait_presence(self, vehicle_id: int, alive: bool) -> None:
        assert self.collect(lambda _: (vehicle_id, alive) in self.presence()), self.events


@contextmanager
def vehicle(fleet: str, vehicle_id: int, states_waiting: int = 4096) -> Iterator[Vehicle]:
    it = Vehicle(SessionSettings(fleet, vehicle_id), states_waiting)
    with it.network:
        yield it


def eventually(condition: Callable[[], bool]) -> bool:
    """Whether a count that wakes nobody reaches its value."""
    deadline_s = time.monotonic() + PATIENCE_S
    pause = threading.Event()
    while not condition() and time.monotonic() < deadline_s:
        pause.wait(0.005)
    return condition()


def paced(items: Iterable[T]) -> Iterator[T]:
    """Each at a time of its own, so that no plan among them is left out as one too many."""
    pause = threading.Event()
    for item in items:
        yield item
        pause.wait(2.0 / PLANS_HZ)


# Configuration


@pytest.mark.parametrize("name", ["", "a/b", "a*", "*", "@fleet", "a$b", "-a", "a b", "a?b", "a#b", "x" * 65])
def test_a_fleet_name_that_is_no_single_key_chunk_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match="fleet name"):
        SessionSettings(name, 1)


@pytest.mark.parametrize("vehicle_id", [0, -1, 251])
def test_a_vehicle_id_outside_its_range_is_refused(vehicle_id: int) -> None:
    with pytest.raises(ConfigError, match="vehicle id"):
        SessionSettings("fleet", vehicle_id)


@pytest.mark.parametrize("port", [0, 1023, 65_536])
def test_a_privileged_or_impossible_scouting_port_is_refused(port: int) -> None:
    with pytest.raises(ConfigError, match="scouting port"):
        SessionSettings("fleet", 1, scouting_port=port)


@pytest.mark.parametrize(
    "endpoint", ["tcp/0.0.0.0:7447", "tcp/192.0.2.1:7447", "udp/[::]:7447", "tcp/example.org:1", "x"]
)
def test_a_laptop_refuses_endpoints_beyond_loopback(endpoint: str) -> None:
    with pytest.raises(ConfigError, match="loopback"):
        SessionSettings("fleet", 1, listen=(endpoint,))
    with pytest.raises(ConfigError, match="loopback"):
        SessionSettings("fleet", 1, connect=(endpoint,))


@pytest.mark.parametrize(
    "endpoint", ["tcp/127.0.0.1:7447", "udp/127.0.0.9:1?rel=0", "tcp/[::1]:0", "tcp/localhost:1", "unixsock-stream/f"]
)
def test_a_laptop_accepts_endpoints_on_loopback(endpoint: str) -> None:
    assert SessionSettings("fleet", 1, listen=(endpoint,)).listen == (endpoint,)


def test_a_vehicle_in_the_field_needs_endpoints_to_listen_on_and_an_operator_does_not() -> None:
    with pytest.raises(ConfigError, match="listens on"):
        SessionSettings("fleet", 1, profile="field", connect=mesh_endpoints("10.0.0.2"))
    with pytest.raises(ConfigError, match="needs endpoints"):
        SessionSettings("fleet", None, profile="field")
    assert SessionSettings("fleet", None, profile="field", connect=mesh_endpoints("10.0.0.2")).connect


def test_a_network_belongs_to_a_vehicle_and_a_link_to_an_operator() -> None:
    with pytest.raises(ValueError, match="ZenohOperatorLink"):
        ZenohTransport(SessionSettings("fleet", None), lambda: None)
    with pytest.raises(ValueError, match="no vehicle id"):
        ZenohOperatorLink(SessionSettings("fleet", 1))


def test_the_scouting_port_depends_on_the_name_alone_and_avoids_mavlink_and_ephemeral_ports() -> None:
    assert scouting_port("starling") == scouting_port("starling") == 23_924
    ports = {scouting_port(f"fleet-{number}") for number in range(1000)}
    assert len(ports) > 800
    assert all(20_000 <= port < 24_000 for port in ports)


def read(settings: SessionSettings, key: str) -> object:
    return json.loads(zenoh_configuration(settings).get_json(key))


def test_a_laptop_scouts_on_loopback_only_under_the_fleets_name() -> None:
    settings = SessionSettings("starling", 3)
    assert read(settings, "namespace") == "starling"
    assert read(settings, "mode") == "peer"
    assert read(settings, "scouting/multicast/enabled") is True
    assert read(settings, "scouting/multicast/interface") == "lo"
    assert read(settings, "scouting/multicast/ttl") == 0
    assert read(settings, "scouting/multicast/address") == "224.0.0.224:23924"
    assert read(settings, "scouting/gossip/enabled") is False
    assert read(settings, "listen/endpoints") == ["tcp/127.0.0.1:0"]
    assert read(settings, "transport/shared_memory/enabled") is False
    assert read(settings, "timestamping/enabled") is True
    assert read(SessionSettings("starling", 3, scouting_port=9999), "scouting/multicast/address") == "224.0.0.224:9999"


def test_the_field_listens_where_told_retries_forever_and_never_multicasts() -> None:
    settings = SessionSettings(
        "starling", 3, profile="field", listen=mesh_endpoints("10.0.0.3"), connect=mesh_endpoints("10.0.0.4")
    )
    assert read(settings, "listen/endpoints") == ["tcp/10.0.0.3:7447"]
    assert read(settings, "connect/endpoints") == ["tcp/10.0.0.4:7447"]
    assert read(settings, "connect/timeout_ms") == -1
    assert read(settings, "connect/exit_on_failure") is False
    assert read(settings, "connect/retry") == {
        "period_init_ms": 200,
        "period_max_ms": 1000,
        "period_increase_factor": 1.5,
    }
    assert read(settings, "scouting/multicast/enabled") is False
    assert read(settings, "scouting/gossip/enabled") is False
    assert read(settings, "transport/unicast/max_links") == 1
    assert read(settings, "transport/unicast/open_timeout") == 1000
    assert read(settings, "transport/unicast/accept_timeout") == 1000
    assert read(settings, "transport/link/tx/lease") == 2000
    assert read(settings, "transport/link/tx/keep_alive") == 2


# Vehicles among themselves


@pytest.mark.process
def test_what_a_vehicle_publishes_reaches_its_peers_and_not_itself(fleet: str) -> None:
    with vehicle(fleet, 1) as one, vehicle(fleet, 2) as two:
        one.wait_presence(2, True)
        two.wait_presence(1, True)
        sent_ns = time.monotonic_ns()
        one.network.publish("state", b"state of 1")
        one.network.publish("plan", b"plan of 1")
        two.wait_message("fleet/1/state", b"state of 1")
        two.wait_message("fleet/1/plan", b"plan of 1")
        two.network.publish("state", b"state of 2")
        one.wait_message("fleet/2/state", b"state of 2")
        assert one.messages() == [("fleet/2/state", b"state of 2")]
        assert one.presence() == [(2, True)]
        assert all(e.received_monotonic_ns > sent_ns for e in two.events if isinstance(e, ReceivedSample))
        counters = one.network.counters
        assert (counters.dropped, counters.malformed, counters.publish_failures) == (0, 0, 0)


@pytest.mark.process
def test_a_late_joiner_gets_the_last_state_and_the_last_plan_of_everybody(fleet: str) -> None:
    with vehicle(fleet, 1) as one, vehicle(fleet, 2) as two:
        for payload in (b"old", b"last"):
            one.network.publish("state", payload)
            two.network.publish("plan", payload)
            two.network.publish("state", payload)
            one.network.publish("plan", payload)
        with vehicle(fleet, 3) as three:
            everything = {(f"fleet/{i}/{topic}", b"last") for i in (1, 2) for topic in ("state", "plan")}
            assert three.collect(lambda _: set(three.messages()) >= everything), three.events
            assert set(three.messages()) == everything


@pytest.mark.process
def test_two_fleets_of_different_names_on_one_port_do_not_hear_each_other(fleet: str) -> None:
    port = scouting_port(fleet)
    mine = Vehicle(SessionSettings(fleet + "-a", 1, scouting_port=port))
    friend = Vehicle(SessionSettings(fleet + "-a", 2, scouting_port=port))
    stranger = Vehicle(SessionSettings(fleet + "-b", 3, scouting_port=port))
    operator = ZenohOperatorLink(SessionSettings(fleet + "-a", None, scouting_port=port))
    with mine.network, friend.network, stranger.network, operator:
        mine.wait_presence(2, True)
        stranger.network.publish("state", b"strange")
        friend.network.publish("state", b"familiar")
        mine.wait_message("fleet/2/state", b"familiar")
        mine.network.publish("state", b"mine")
        assert operator.wait_alive([1, 2], PATIENCE_S) == {1, 2}
        assert operator.ask([3], "status", b"", timeout_s=0.2, retry_s=0.1) == {3: ()}
        assert not stranger.collect(bool, timeout_s=0.3)
        assert {key for key, _ in mine.messages()} == {"fleet/2/state"}
        assert mine.presence() == [(2, True)]
        assert mine.network.counters.malformed == stranger.network.counters.malformed == 0


@pytest.mark.process
def test_a_killed_process_is_seen_to_vanish_within_a_second(fleet: str) -> None:
    with vehicle(fleet, 1) as one, child(SessionSettings(fleet, 2)) as process:
        one.wait_presence(2, True)
        one.wait_message("fleet/2/state", b"child")
        killed_ns = time.monotonic_ns()
        process.send_signal(signal.SIGKILL)
        one.wait_presence(2, False)
        assert one.events[-1].received_monotonic_ns - killed_ns < 1_000_000_000


@pytest.mark.process
def test_endpoints_given_on_a_laptop_connect_without_scouting_and_in_any_order_of_start(
    fleet: str, tmp_path: Path
) -> None:
    endpoints = [f"unixsock-stream/{tmp_path}/{number}" for number in (1, 2)]
    settings = [
        SessionSettings(fleet, index + 1, listen=(endpoints[index],), connect=(endpoints[1 - index],))
        for index in (0, 1)
    ]
    assert read(settings[0], "scouting/multicast/enabled") is False
    one, two = Vehicle(settings[0]), Vehicle(settings[1])
    with one.network, two.network:
        one.wait_presence(2, True)
        two.wait_presence(1, True)
        one.network.publish("state", b"said")
        two.wait_message("fleet/1/state", b"said")


@pytest.mark.process
def test_an_endpoint_in_use_is_an_error_with_a_sentence(fleet: str, tmp_path: Path) -> None:
    endpoint = f"unixsock-stream/{tmp_path}/1"
    with Vehicle(SessionSettings(fleet, 1, listen=(endpoint,))).network:
        again = ZenohTransport(SessionSettings(fleet, 2, listen=(endpoint,)), lambda: None)
        with pytest.raises(TransportError, match=fleet):
            again.open()
        again.close()


@pytest.mark.process
def test_foreign_keys_deletions_and_oversized_payloads_are_counted_and_not_delivered(fleet: str) -> None:
    with vehicle(fleet, 1) as one, zenoh.open(zenoh_configuration(SessionSettings(fleet, None))) as stranger:
        block = zenoh.CongestionControl.BLOCK
        assert eventually(lambda: len(list(stranger.liveliness().get("fleet/1/alive"))) == 1)
        for name in ("abc", "0", "007", "251", "-2", "2.0", "1e1", "²"):
            stranger.put(f"fleet/{name}/state", b"x", congestion_control=block)
        for size in (STATE_MAX_BYTES + 1, STATE_MAX_BYTES):
            stranger.put("fleet/3/state", bytes(size), congestion_control=block)
        for size in paced((PAYLOAD_MAX_BYTES + 1, PAYLOAD_MAX_BYTES)):
            stranger.put("fleet/2/plan", bytes(size), congestion_control=block)
        stranger.delete("fleet/2/state", congestion_control=block)
        stranger.put("fleet/2/state", b"good", congestion_control=block)
        one.wait_message("fleet/2/state", b"good")
        assert one.messages() == [
            ("fleet/3/state", bytes(STATE_MAX_BYTES)),
            ("fleet/2/plan", bytes(PAYLOAD_MAX_BYTES)),
            ("fleet/2/state", b"good"),
        ]
        assert one.network.counters.malformed == 9
        token = stranger.liveliness().declare_token("fleet/nobody/alive")
        good = stranger.liveliness().declare_token("fleet/9/alive")
        one.wait_presence(9, True)
        assert one.presence() == [(9, True)]
        assert one.network.counters.malformed == 10
        del token, good  # held until here: a token that goes is one more sample


@pytest.mark.process
def test_somebody_else_speaking_under_our_id_is_told_to_the_agent(fleet: str) -> None:
    with vehicle(fleet, 1) as one, vehicle(fleet, 1) as double, vehicle(fleet, 2) as two:
        two.wait_presence(1, True)
        one.wait_presence(2, True)
        double.wait_presence(2, True)
        double.network.publish("state", b"false")
        two.network.publish("state", b"true")
        one.wait_message("fleet/2/state", b"true")
        one.wait_message("fleet/1/state", b"false")
        assert sorted(one.messages()) == [("fleet/1/state", b"false"), ("fleet/2/state", b"true")]


@pytest.mark.process
def test_a_loop_that_does_not_drain_keeps_the_newest_messages_and_every_presence(fleet: str) -> None:
    with vehicle(fleet, 1, states_waiting=4) as one, vehicle(fleet, 2) as two:
        two.wait_presence(1, True)
        for number in range(12):
            two.network.publish("state", b"%d" % number)
        assert eventually(lambda: one.network.counters.dropped == 8)
        one.wait_message("fleet/2/state", b"11")
        assert one.messages() == [("fleet/2/state", b"%d" % number) for number in range(8, 12)]
        assert one.presence() == [(2, True)]


@pytest.mark.process
def test_a_flood_of_one_session_is_thinned_before_it_is_heard_and_others_are_heard_meanwhile(fleet: str) -> None:
    pause = threading.Event()
    with (
        vehicle(fleet, 1) as one,
        vehicle(fleet, 2) as two,
        zenoh.open(zenoh_configuration(SessionSettings(fleet, None))) as stranger,
    ):
        two.wait_presence(1, True)
        one.wait_presence(2, True)
        assert eventually(lambda: len(list(stranger.liveliness().get("fleet/1/alive"))) == 1)
        begin_s = time.monotonic()
        for number in range(600):
            stranger.put("fleet/3/plan", b"%d" % number)
            stranger.get(
                "fleet/1/status", Callback(lambda _: None, indirect=False), payload=b"%d" % number, timeout=0.5
            )
            if number % 100 == 50:
                two.network.publish("state", b"%d" % number)
            pause.wait(0.001)
        spent_s = time.monotonic() - begin_s
        for number in range(50, 600, 100):
            one.wait_message("fleet/2/state", b"%d" % number)
        heard = [key for key, _ in one.messages()]
        assert 0 < heard.count("fleet/3/plan") <= PLANS_HZ * spent_s + 2
        assert 0 < len(one.requests()) <= REQUESTS_HZ * spent_s + 2
        assert one.network.counters.malformed == 0


def test_a_question_too_many_for_a_vehicle_is_one_that_an_operator_does_not_ask() -> None:
    assert ASK_INTERVAL_S > 1.0 / REQUESTS_HZ


@pytest.mark.process
def test_an_operators_questions_in_quick_succession_are_all_answered_without_a_retry(fleet: str) -> None:
    with (
        vehicle(fleet, 1) as one,
        ZenohOperatorLink(SessionSettings(fleet, None)) as operator,
        answering(one, echo),
    ):
        assert operator.wait_alive([1], PATIENCE_S) == {1}
        for _ in range(10):
            assert operator.ask([1], "preflight", b"clock", timeout_s=PATIENCE_S, retry_s=PATIENCE_S)[1] is not None
        assert len(one.requests()) == 10


# Operators


@contextmanager
def answering(it: Vehicle, answer: Callable[[Request], None]) -> Iterator[None]:
    """A vehicle's loop that answers requests."""
    done = threading.Event()

    def run() -> None:
        answered = 0
        while not done.is_set():
            it.collect(lambda _: len(it.requests()) > answered, timeout_s=0.01)  # noqa: B023
            for request in it.requests()[answered:]:
                answered += 1
                answer(request)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def echo(request: Request) -> None:
    request.reply(request.kind.encode() + b":" + request.payload)


@pytest.mark.process
def test_an_operator_sees_who_is_alive_and_asks_all_at_once(fleet: str) -> None:
    with (
        vehicle(fleet, 1) as one,
        vehicle(fleet, 2) as two,
        ZenohOperatorLink(SessionSettings(fleet, None)) as operator,
        answering(one, echo),
        answering(two, echo),
    ):
        assert operator.wait_alive([1, 2], PATIENCE_S) == {1, 2} == operator.alive()
        assert operator.wait_alive([1, 2, 3], timeout_s=0.1) == {1, 2}
        begin_s = time.monotonic()
        assert operator.ask([1, 2], "status", b"?", timeout_s=PATIENCE_S, retry_s=1.0) == {
            1: (b"status:?",),
            2: (b"status:?",),
        }
        assert operator.ask([2], "command", b"land", timeout_s=PATIENCE_S, retry_s=1.0) == {2: (b"command:land",)}
        assert time.monotonic() - begin_s < 1.0
        assert one.presence() == [(2, True)]
        assert {request.kind for request in one.requests()} == {"status"}


@pytest.mark.process
def test_a_silent_vehicle_is_asked_again_and_one_that_is_absent_is_reported_after_the_timeout(fleet: str) -> None:
    heard: list[Request] = []

    def answer_the_third(request: Request) -> None:
        heard.append(request)
        if len(heard) == 3:
            request.reply(b"at last")

    with (
        vehicle(fleet, 1) as one,
        ZenohOperatorLink(SessionSettings(fleet, None)) as operator,
        answering(one, answer_the_third),
    ):
        begin_s = time.monotonic()
        assert operator.ask([1, 7], "command", b"c", timeout_s=0.8, retry_s=0.1) == {1: (b"at last",), 7: ()}
        assert 0.8 <= time.monotonic() - begin_s < 1.5
        assert len(heard) == 3


@pytest.mark.process
def test_a_request_is_answered_once_and_an_answer_that_nobody_awaits_does_no_harm(fleet: str) -> None:
    with vehicle(fleet, 1) as one:
        with ZenohOperatorLink(SessionSettings(fleet, None)) as operator:
            assert operator.ask([1], "status", b"", timeout_s=0.1, retry_s=0.06) == {1: ()}
        assert one.collect(lambda _: len(one.requests()) == 2)
        after_the_operator_left, after_the_vehicle_left = one.requests()
        after_the_operator_left.reply(b"too late")
        with pytest.raises(RuntimeError, match="once"):
            after_the_operator_left.reply(b"again")
        one.network.close()
        after_the_vehicle_left.reply(b"much too late")


# Leaving


@pytest.mark.process
def test_closing_tells_the_others_and_may_be_repeated(fleet: str) -> None:
    with vehicle(fleet, 1) as one, vehicle(fleet, 2) as two:
        one.wait_presence(2, True)
        begin_s = time.monotonic()
        two.network.close()
        two.network.close()
        assert time.monotonic() - begin_s < 1.0
        one.wait_presence(2, False)
        assert two.network.drain() == []
        two.network.publish("state", b"nobody hears this")
        assert two.network.counters.publish_failures == 1
        with pytest.raises(RuntimeError, match="opened once"):
            two.network.open()


@pytest.mark.process
@pytest.mark.parametrize(
    "ending", ["sys.exit(3)", "raise RuntimeError", "network.close()\nnetwork.close()\nsys.exit(3)"]
)
def test_the_interpreter_exits_at_once_whether_or_not_the_network_was_closed(fleet: str, ending: str) -> None:
    with child(SessionSettings(fleet, 1), ending) as process:
        assert process.wait(PATIENCE_S) in {1, 3}


@pytest.mark.process
def test_an_unknown_topic_is_our_own_bug(fleet: str) -> None:
    with vehicle(fleet, 1) as one, pytest.raises(ValueError, match="topic"):
        one.network.publish("stat", b"")


@pytest.mark.process
@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="reads Linux' socket tables")
def test_a_laptops_vehicle_accepts_connections_on_loopback_only(fleet: str) -> None:
    with child(SessionSettings(fleet, 1)) as process:
        links = [os.readlink(entry) for entry in Path(f"/proc/{process.pid}/fd").iterdir()]
        inodes = {link[8:-1] for link in links if link.startswith("socket:[")}
        listening = [
            fields[1].split(":")[0]
            for table in Path("/proc/net").glob("tcp*")
            for fields in map(str.split, table.read_text().splitlines()[1:])
            if fields[9] in inodes and fields[3] == "0A"
        ]
        assert set(listening) == {"0100007F"}
