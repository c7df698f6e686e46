"""What a service manager hears of a companion: over a real datagram socket."""

import os
import secrets
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from companion.io.systemd import Notifier

SECOND_NS = 1_000_000_000


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[socket.socket, str]]:
    """The manager's socket and its name as NOTIFY_SOCKET carries it."""
    name = str(tmp_path / "notify")
    if request.param == "abstract":
        name = f"@starling-test-{secrets.token_hex(8)}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as s:
        s.bind("\0" + name[1:] if name.startswith("@") else name)
        s.setblocking(False)
        yield s, name


def heard(s: socket.socket) -> list[str]:
    found = []
    while True:
        try:
            found.append(s.recv(4096).decode())
        except BlockingIOError:
            return found


def test_readiness_and_the_end_are_told(manager: tuple[socket.socket, str]) -> None:
    s, name = manager
    notifier = Notifier({"NOTIFY_SOCKET": name})
    notifier.ready()
    notifier.loop_turned(SECOND_NS)
    notifier.stopping()
    notifier.close()
    assert heard(s) == ["READY=1", "STOPPING=1"]


def test_the_watchdog_is_fed_three_times_within_its_limit_and_only_by_turns(manager: tuple[socket.socket, str]) -> None:
    s, name = manager
    notifier = Notifier({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "3000000", "WATCHDOG_PID": str(os.getpid())})
    fed = []
    for k in range(300):
        notifier.loop_turned(SECOND_NS + k * SECOND_NS // 50)
        fed += [k / 50] * len(heard(s))
    assert fed == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    notifier.close()


def test_a_watchdog_meant_for_another_process_is_not_fed(manager: tuple[socket.socket, str]) -> None:
    s, name = manager
    notifier = Notifier({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "3000000", "WATCHDOG_PID": "1"})
    notifier.loop_turned(SECOND_NS)
    notifier.close()
    assert heard(s) == []


@pytest.mark.parametrize(
    "environment", [{}, {"NOTIFY_SOCKET": ""}, {"NOTIFY_SOCKET": "relative"}, {"NOTIFY_SOCKET": "/none/there"}]
)
def test_without_a_manager_nothing_happens(environment: dict[str, str]) -> None:
    notifier = Notifier({**environment, "WATCHDOG_USEC": "word"})
    notifier.ready()
    notifier.loop_turned(SECOND_NS)
    notifier.stopping()
    notifier.close()
    notifier.stopping()
