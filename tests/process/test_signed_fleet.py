"""A fleet whose links are signed, among impostors; and how an autopilot is given its key."""

import json
import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from fleet_process import STUB_PORT_OFFSET, Fleet, flight_folder, make_fleet, operator_of, run, started, wait_status

from companion.errors import ConfigError
from companion.io.signing_key import make_key, read_key
from companion.wire.mavlink import COMMAND_LONG
from companion.wire.px4 import Px4Mode, mode_parameters
from companion.wire.signing import signed, ticks_at

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]
PLAN = {"then": "land", "legs": [{"kind": "velocity", "north_m_s": 1.0, "duration_s": 4.0}]}
SIGNED_STUB = {"px4": "1.18", "signing": True}
DAY = 86_400 * 100_000


def land(vehicle: int, key: bytes | None, ticks: int) -> bytes:
    command, *parameters = mode_parameters(Px4Mode.AUTO_LAND)
    values = (*parameters, *[0.0] * (7 - len(parameters)), command, vehicle, 1, 0)
    frame = COMMAND_LONG.pack(values, 0, vehicle, 191)
    return frame if key is None else signed(key, frame, COMMAND_LONG.extra, 1, ticks)


def stolen(fleet: Fleet, vehicle: int) -> bytes:
    """A vehicle's key, as soon as the launcher has written it."""
    for file in fleet.folder.glob(f"flights/*/vehicle-{vehicle}.key"):
        with suppress(ConfigError):  # half of it is there
            return read_key(file)
    return bytes(32)


@contextmanager
def impostor(fleet: Fleet) -> Iterator[dict[int, int]]:
    """Commands both autopilots and companions to land, 200 times a second each: unsigned, by a key of its own (now, and
    from the future), and by the fleet's with a time stamp of yesterday, as a replay has; yields how many it sent."""
    sent: dict[int, int] = {}
    ended = threading.Event()

    def flood() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
            while not ended.wait(0.005):
                now = ticks_at(time.time_ns())
                for k, i in enumerate(fleet.ids):
                    own = stolen(fleet, i)
                    kinds = ((None, 0), (bytes(range(32)), now), (bytes(range(32)), now + DAY), (own, now - DAY))
                    for to in (fleet.port + k + STUB_PORT_OFFSET, fleet.port + k):
                        s.sendto(land(i, *kinds[sent.get(i, 0) % 4]), ("127.0.0.1", to))
                    sent[i] = sent.get(i, 0) + 1

    thread = threading.Thread(target=flood, daemon=True)
    thread.start()
    try:
        yield sent
    finally:
        ended.set()
        thread.join()


def test_a_signed_fleet_flies_among_impostors_and_each_of_their_frames_is_refused_and_counted(tmp_path: Path) -> None:
    fleet = make_fleet(tmp_path, 2, plan=PLAN, stub=SIGNED_STUB)
    (tmp_path / "flights").mkdir()
    up = ("sim", "up", "--fleet", str(fleet.file), "--out", str(tmp_path / "flights"), "--json")
    with impostor(fleet) as sent, started(*up, folder=tmp_path, name="up") as flight:
        assert flight.wait(240.0) == 0, flight.out + flight.err
    summary: dict[str, Any] = json.loads(flight.out)
    assert summary["passed"]
    assert summary["failsafes"] == []
    assert all(n > 1000 for n in sent.values())
    folder = flight_folder(tmp_path / "flights")
    log = (folder / "autopilots.log").read_text()
    for i in fleet.ids:
        told = re.search(rf"vehicle {i}: frames not believed: (.*)", log)
        assert told is not None, log
        counts = {why: int(n) for n, why in re.findall(r"(\d+) ([a-z ]+)", told[1])}
        counts.pop("signed too long ago", 0)  # before the companion had spoken
        assert set(counts) == {"unsigned", "wrong signature", "replayed"}
        assert all(n > 100 for n in counts.values())
    assert oct((folder / "vehicle-1.key").stat().st_mode & 0o777) == "0o600"


def test_an_autopilot_is_given_a_key_another_in_its_place_and_a_lost_one_shows(tmp_path: Path) -> None:
    fleet = make_fleet(tmp_path, 1, stub={"px4": "1.18"})
    first, second = tmp_path / "first.key", tmp_path / "second.key"

    def companion(*words: str) -> Any:
        return run("companion", *words, folder=tmp_path)

    def give(key: Path, *more: str) -> Any:
        where = ("--vehicle", "1", "--fleet", str(fleet.file), "--signing-key", str(key))
        return companion("signing", "give", *where, "--yes", *more)

    with started("sim", "stub", "--fleet", str(fleet.file), folder=tmp_path, name="stub"):
        for key in (first, second):
            assert companion("signing", "make", str(key)).returncode == 0
        given = give(first)
        assert given.returncode == 0, given.stderr
        assert f"vehicle 1 signs by {first}" in given.stdout + given.stderr
        refused = give(second)
        assert refused.returncode == 1
        assert "another only with --old" in refused.stderr
        rotated = give(second, "--old", str(first))
        assert rotated.returncode == 0, rotated.stderr
        check = ("check", "--vehicle", "1", "--fleet", str(fleet.file), "--seconds", "3", "--json", "--signing-key")
        rows = {r["name"]: r for r in json.loads(companion(*check, str(second)).stdout)["checks"]}
        assert rows["signing"]["passed"]
        assert rows["PX4 version"]["value"] == "1.18.0"
        lost = {r["name"]: r for r in json.loads(companion(*check, str(first)).stdout)["checks"]}
        assert not lost["signing"]["passed"]
        assert "another key" in lost["signing"]["message"]


def test_a_key_is_not_given_to_a_vehicle_that_is_armed(tmp_path: Path) -> None:
    fleet = make_fleet(tmp_path, 1, stub={"px4": "1.18"}, plan={"legs": [], "then": "land"})
    key = tmp_path / "one.key"
    make_key(key)
    with started("sim", "stub", "--fleet", str(fleet.file), folder=tmp_path, name="stub"):
        with (
            started("companion", "run", "--vehicle", "1", "--fleet", str(fleet.file), folder=tmp_path) as flight,
            operator_of(fleet) as operator,
        ):
            wait_status(operator, lambda said: 1 in said and said[1].ready == [])
            assert operator.take_off().all_accepted
            wait_status(operator, lambda said: 1 in said and said[1].armed)
            flight.popen.kill()
            flight.popen.wait()
        where = ("--vehicle", "1", "--fleet", str(fleet.file), "--signing-key", str(key))
        done = run("companion", "signing", "give", *where, "--yes", folder=tmp_path)
    assert done.returncode == 1
    assert "is armed: an autopilot takes no key then" in done.stderr
