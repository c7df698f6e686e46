"""Floods from one session on the fleet's network, while two vehicles fly: what they do to the control loops."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from fleet_process import SETTLED, all_in, eventually, flight_folder, make_fleet, operator_of, started, wait_status
from zenoh.handlers import Callback

from companion.io.recording import read_recording
from companion.io.records import TickRecord
from companion.io.zenoh.configuration import SessionSettings, zenoh_configuration
from sim.launch.reference_loop import read_reference_loop

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]

FLOOD_S = 4.0
RATE_HZ = 2000.0
QUIET = "quiet"


@dataclass
class Flooded:
    """A flight under floods, one after the other."""

    folder: Path = Path()
    summary: dict[str, Any] = field(default_factory=dict)
    windows: dict[str, tuple[int, int]] = field(default_factory=dict)
    """flood -> from when to when (UTC, ns)"""
    answered: dict[str, float] = field(default_factory=dict)
    """flood -> how long a command took that was given meanwhile (s)"""
    sent: dict[str, int] = field(default_factory=dict)

    def gap_s(self, window: str) -> float:
        """Longest time between two control ticks with a setpoint, of any vehicle."""
        begin, end = self.windows[window]
        longest = 0.0
        for i in (1, 2):
            ticks = [
                e.instant.fleet_ns
                for e in read_recording(self.folder / f"vehicle-{i}.mcap").entries
                if e.channel == "tick" and TickRecord.unpack(e.body).steered and begin <= e.instant.fleet_ns <= end
            ]
            longest = max(longest, float(np.diff(ticks).max()) * 1e-9)
        return longest

    def machine_s(self, window: str) -> float:
        """Longest lateness of an empty loop meanwhile."""
        begin, end = self.windows[window]
        rows = read_reference_loop(self.folder / "reference.bin")
        inside = rows[(rows[:, 0] >= begin) & (rows[:, 0] <= end)]
        return float(inside[:, 1].max()) * 1e-9


@pytest.fixture(scope="module")
def flooded(tmp_path_factory: pytest.TempPathFactory) -> Flooded:
    fleet = make_fleet(tmp_path_factory.mktemp("flooded"), 2)
    flooded = Flooded()
    out = fleet.folder / "flights"
    arguments = ("sim", "up", "--json", "--fleet", str(fleet.file), "--out", str(out), "--plan", "velocity:0.5:0:3600")
    settings = SessionSettings(fleet.config.fleet.name, None, scouting_port=fleet.config.peers.scouting_port)
    pause = threading.Event()
    with started(*arguments, folder=fleet.folder, name="up") as up, operator_of(fleet) as operator:
        wait_status(operator, all_in(fleet.ids, *SETTLED, revision=2))
        stranger = zenoh.open(zenoh_configuration(settings))
        ignored = Callback(lambda _: None, indirect=False)
        floods = {
            QUIET: lambda _: None,
            "status": lambda _: stranger.get("fleet/1/status", ignored, timeout=1.0),
            "preflight": lambda _: stranger.get("fleet/1/preflight", ignored, timeout=1.0),
            "command": lambda n: stranger.get(
                "fleet/1/command", ignored, payload=b'{"verb":"fly","n":%d}' % n, timeout=1.0
            ),
            "state": lambda n: stranger.put("fleet/9/state", b"\x02" + bytes(80) + b"%d" % n),
            "plan": lambda n: stranger.put("fleet/2/plan", b'{"version":2,"revision":%d}' % n),
        }
        try:
            assert eventually(lambda: len(stranger.info.peers_zid()) >= 2)
            for name, send in floods.items():
                begin_ns, begin_s = time.time_ns(), time.monotonic()
                count = 0
                asked_s = None
                while (since_s := time.monotonic() - begin_s) < FLOOD_S:
                    due = int(since_s * RATE_HZ)
                    for number in range(count, due):
                        send(number)
                    count = due
                    if asked_s is None and since_s > 0.5 * FLOOD_S:
                        asked_s = time.monotonic()
                        # Whether it is accepted is the flight's affair: a vehicle whose autopilot this machine has held
                        # up is released by then.
                        assert not operator.command("resume").silent
                        flooded.answered[name] = time.monotonic() - asked_s
                    pause.wait(0.002)
                flooded.windows[name] = begin_ns, time.time_ns()
                flooded.sent[name] = count
        finally:
            stranger.close()  # type: ignore[no-untyped-call]
        assert operator.land().all_accepted
        up.wait()
        flooded.summary = json.loads(up.out)
    flooded.folder = flight_folder(out)
    return flooded


@pytest.mark.parametrize("flood", ["status", "preflight", "command", "state", "plan"])
def test_a_flood_of_two_thousand_a_second_holds_no_loop_up(flooded: Flooded, flood: str, record_property: Any) -> None:
    quiet_s, gap_s = flooded.gap_s(QUIET), flooded.gap_s(flood)
    machine_s = flooded.machine_s(flood)
    record_property("gap_s", {"quiet": quiet_s, flood: gap_s, "machine": machine_s, "sent": flooded.sent[flood]})
    assert gap_s <= 0.1 + max(quiet_s, machine_s), (quiet_s, gap_s, machine_s)


@pytest.mark.parametrize("flood", ["status", "command", "state", "plan"])
def test_a_command_is_answered_meanwhile(flooded: Flooded, flood: str) -> None:
    assert flooded.answered[flood] < 2.0


def test_the_flight_is_not_touched_by_the_floods(flooded: Flooded) -> None:
    failed = {c["what"] for c in flooded.summary["criteria"] if not c["met"]}
    assert not failed & {"failsafes", "companions lost", "vehicles not landed and disarmed", "minimum_distance_m"}
