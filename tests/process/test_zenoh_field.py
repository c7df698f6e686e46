"""The field's network between real sessions, each at an address of the loopback interface of its own."""

from __future__ import annotations

import itertools
import os
import signal
import socket
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import pytest
from test_zenoh_peers import PATIENCE_S, Vehicle, eventually, read
from zenoh_child import child

from companion.config import FleetConfig
from companion.config.file import parse
from companion.io.zenoh.configuration import (
    SessionSettings,
    session_settings,
)
from companion.io.zenoh.operator import ZenohOperatorLink

_numbers = itertools.count()
LOST_S = 1.0
"""the least `peers.notice_lost_s`: the tests wait for it"""


def free_port(hosts: Sequence[str]) -> int:
    """A port that is free by TCP and UDP at each of the hosts."""
    for port in range(17_447 + 40 * (os.getpid() % 200), 30_000):
        try:
            with ExitStack() as opened:
                for host, kind in itertools.product(hosts, (socket.SOCK_STREAM, socket.SOCK_DGRAM)):
                    opened.enter_context(socket.socket(socket.AF_INET, kind)).bind((host, port))
        except OSError:
            continue
        return port
    raise OSError("no free port")


def field_fleet(ids: Sequence[int], notice_lost_s: float | None = LOST_S, network: str = "field") -> FleetConfig:
    """A fleet whose vehicle k listens on 127.0.0.k."""
    hosts = {i: f"127.0.0.{i}" for i in ids}
    port = free_port([*hosts.values()])
    peers = {"network": network} | ({} if notice_lost_s is None else {"notice_lost_s": notice_lost_s})
    tables = {
        "fleet": {"name": f"field-{os.getpid()}-{next(_numbers)}", "frame": "local"},
        "peers": peers,
        "vehicle": [{"id": i, "zenoh": f"tcp/{host}:{port}"} for i, host in hosts.items()],
    }
    return parse(tables, "fleet.toml")


def of(config: FleetConfig, vehicle_id: int) -> Vehicle:
    return Vehicle(session_settings(config, vehicle_id))


def own_sockets(protocol: str, state: str) -> int:
    """How many sockets of this process are in a state, as the kernel lists them."""
    inodes = set()
    for fd in Path("/proc/self/fd").iterdir():
        try:
            inodes.add(os.readlink(fd).removeprefix("socket:[").removesuffix("]"))
        except OSError:
            continue
    rows = [line.split() for line in Path(f"/proc/net/{protocol}").read_text().splitlines()[1:]]
    return sum(row[3] == state and row[9] in inodes for row in rows)


# -- what is generated -----------------------------------------------------------------------------------------------


def test_in_the_field_the_larger_id_connects_to_the_smaller_ones_and_an_operator_to_all() -> None:
    config = field_fleet([1, 2, 5], notice_lost_s=None)
    endpoints = {v.id: str(v.zenoh) for v in config.vehicles}
    for i, others in {1: [], 2: [1], 5: [1, 2], None: [1, 2, 5]}.items():
        settings = session_settings(config, i)
        assert settings.listen == (() if i is None else (endpoints[i],))
        assert settings.connect == tuple(endpoints[other] for other in others)
        assert read(settings, "scouting/gossip/enabled") is False
        assert read(settings, "transport/unicast/max_links") == 1


@pytest.mark.parametrize(
    ("network", "notice_s", "lease_ms", "keep_alives"),
    [("field", None, 2000, 2), ("laptop", None, 4000, 4), ("field", 4.0, 4000, 2), ("laptop", 10.0, 10_000, 4),
     ("field", 1.0, 1000, 2)],
)  # fmt: skip
def test_lease_and_keep_alives_follow_from_one_number(
    network: str, notice_s: float | None, lease_ms: int, keep_alives: int
) -> None:
    config = field_fleet([1, 2], notice_s, network)
    for i in (1, 2, None):
        assert read(session_settings(config, i), "transport/link/tx/lease") == lease_ms
        assert read(session_settings(config, i), "transport/link/tx/keep_alive") == keep_alives
    assert config.notice_lost_s == lease_ms * 1e-3
    assert config.keep_alive_s == pytest.approx(lease_ms * 1e-3 / keep_alives)


def test_a_secured_endpoint_is_taken_as_it_is_written() -> None:
    settings = SessionSettings("fleet", 2, "field", listen=("quic/10.0.0.2:7447",), connect=("quic/10.0.0.1:7447",))
    assert read(settings, "listen/endpoints") == ["quic/10.0.0.2:7447"]


# -- what real sessions do -------------------------------------------------------------------------------------------


@pytest.mark.process
@pytest.mark.parametrize("network", ["field", "laptop"])
def test_each_pair_has_one_connection(network: str) -> None:
    config = field_fleet([1, 2, 3, 4], network=network)
    if network == "laptop":
        tables = config.model_dump(mode="json", exclude_none=True)
        for v in tables["vehicle"]:
            del v["zenoh"]
        config = parse(tables, "fleet.toml")
    before = own_sockets("tcp", "01")
    with ExitStack() as opened:
        vehicles = {v.id: of(config, v.id) for v in config.vehicles}
        for one in vehicles.values():
            opened.enter_context(one.network)
        for i, one in vehicles.items():
            for other in vehicles.keys() - {i}:
                one.wait_presence(other, True)
        pairs = len(vehicles) * (len(vehicles) - 1) // 2
        assert eventually(lambda: own_sockets("tcp", "01") - before == 2 * pairs)
        vehicles[1].network.publish("state", b"of 1")
        vehicles[4].network.publish("plan", b"of 4")
        for i, one in vehicles.items():
            if i != 1:
                one.wait_message("fleet/1/state", b"of 1")
            if i != 4:
                one.wait_message("fleet/4/plan", b"of 4")


@pytest.mark.process
@pytest.mark.parametrize(("mine", "killed"), [(1, 2), (2, 1)])
def test_a_killed_process_is_noticed_at_once_by_its_tcp_connection_and_is_back_soon(mine: int, killed: int) -> None:
    config = field_fleet([1, 2], notice_lost_s=10.0)
    one = of(config, mine)
    with one.network:
        with child(session_settings(config, killed)) as process:
            one.wait_presence(killed, True)
            one.wait_message(f"fleet/{killed}/state", b"child")
            killed_ns = time.monotonic_ns()
            process.send_signal(signal.SIGKILL)
            one.wait_presence(killed, False)
            assert one.events[-1].received_monotonic_ns - killed_ns < 2_000_000_000
        one.events.clear()
        with child(session_settings(config, killed)):
            one.wait_message(f"fleet/{killed}/state", b"child")
            one.wait_presence(killed, True)
            assert one.presence()[-1] == (killed, True)


@pytest.mark.process
@pytest.mark.parametrize(("mine", "stopped"), [(1, 2), (2, 1)])
def test_one_whose_radio_is_gone_is_noticed_in_time_and_heard_again_after_it(mine: int, stopped: int) -> None:
    config = field_fleet([1, 2])
    one = of(config, mine)
    with one.network, child(session_settings(config, stopped)) as process:
        one.wait_presence(stopped, True)
        stopped_ns = time.monotonic_ns()
        process.send_signal(signal.SIGSTOP)  # says nothing, and closes nothing
        one.wait_presence(stopped, False)
        noticed_s = (one.events[-1].received_monotonic_ns - stopped_ns) * 1e-9
        assert 0.4 * LOST_S < noticed_s < PATIENCE_S  # the time itself is the bench's: `tests.bench.packets`
        one.events.clear()
        process.send_signal(signal.SIGCONT)
        one.wait_presence(stopped, True)


@pytest.mark.process
def test_late_joiners_of_either_side_are_connected_and_an_operator_sees_all() -> None:
    config = field_fleet([1, 2, 3])
    with ExitStack() as opened:
        vehicles: dict[int, Vehicle] = {}
        for i in (2, 3, 1):
            vehicles[i] = of(config, i)
            opened.enter_context(vehicles[i].network)
            vehicles[i].network.publish("state", b"%d" % i)
            for a, b in itertools.permutations(vehicles, 2):
                vehicles[a].wait_presence(b, True)
                vehicles[a].wait_message(f"fleet/{b}/state", b"%d" % b)
        with ZenohOperatorLink(session_settings(config, None)) as operator:
            assert operator.wait_alive([1, 2, 3], PATIENCE_S) == {1, 2, 3}
