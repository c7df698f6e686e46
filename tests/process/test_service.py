"""A real companion beside a stub, with the test as its service manager."""

from __future__ import annotations

import secrets
import select
import signal
import socket
import time
from pathlib import Path

import pytest
from fleet_process import PATIENCE_S, make_fleet, started

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]

WATCHDOG_S = 1.5


def hear(manager: socket.socket, seconds: float) -> list[str]:
    """What comes within a time."""
    found = []
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        if select.select([manager], [], [], left)[0]:
            found.append(manager.recv(4096).decode())
    return found


def await_word(manager: socket.socket, word: str) -> None:
    end = time.monotonic() + PATIENCE_S
    while (left := end - time.monotonic()) > 0:
        if select.select([manager], [], [], left)[0] and manager.recv(4096).decode() == word:
            return
    pytest.fail(f"{word} never came")


@pytest.mark.parametrize("abstract", [False, True], ids=["path", "abstract"])
def test_the_watchdog_is_fed_while_the_loop_turns_and_not_while_it_is_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, abstract: bool
) -> None:
    name = f"@starling-test-{secrets.token_hex(8)}" if abstract else str(tmp_path / "notify")
    fleet = make_fleet(tmp_path, 1)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind("\0" + name[1:] if abstract else name)
        monkeypatch.setenv("NOTIFY_SOCKET", name)
        monkeypatch.setenv("WATCHDOG_USEC", str(round(WATCHDOG_S * 1e6)))
        monkeypatch.delenv("WATCHDOG_PID", raising=False)
        arguments = ("companion", "run", "--vehicle", "1", "--fleet", str(fleet.file))
        with (
            started("sim", "stub", "--fleet", str(fleet.file), folder=tmp_path, name="stub"),
            started(*arguments, folder=tmp_path, name="companion") as companion,
        ):
            await_word(manager, "READY=1")
            # The journal's first line tells what it is, and what it waits for.
            name_of_fleet, line = fleet.config.fleet.name, fleet.config.by_id(1).mavlink
            assert companion.out.startswith(f"vehicle 1: started: waits for its autopilot on {line}, for its peers of ")
            assert f"fleet {name_of_fleet} on the laptop network; records nothing" in companion.out.splitlines()[0]
            await_word(manager, "WATCHDOG=1")
            await_word(manager, "WATCHDOG=1")
            companion.signal(signal.SIGSTOP)
            hear(manager, 0.5)
            assert hear(manager, 2 * WATCHDOG_S) == []
            companion.signal(signal.SIGCONT)
            await_word(manager, "WATCHDOG=1")
            companion.signal(signal.SIGTERM)
            await_word(manager, "STOPPING=1")
            assert companion.wait() == 0
