"""One real PX4 whose link is signed (since v1.18): it flies for its companion and for no impostor."""

import json
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from fleet_process import operator_of, run, started, wait_status
from px4_fleet import sitl_fleet

from companion.core.frames import Ned, ned_to_geodetic
from companion.io.signing_key import make_key, read_key
from companion.wire.mavlink import COMMAND_LONG
from companion.wire.px4 import Px4Mode, mode_parameters
from companion.wire.signing import signed, ticks_at
from sim.launch.px4_build import build_version, sitl_parameters
from sim.launch.px4_instance import Px4Instance

PLAN = {"then": "land", "legs": [{"kind": "velocity", "north_m_s": 1.0, "duration_s": 600.0}]}
HOUR = 3600 * 100_000
GCS_PORT = 18570
Property = Callable[[str, object], None]


def land(key: bytes | None, ticks: int) -> bytes:
    command, *parameters = mode_parameters(Px4Mode.AUTO_LAND)
    frame = COMMAND_LONG.pack((*parameters, *[0.0] * (7 - len(parameters)), command, 1, 1, 0), 0, 255, 190)
    return frame if key is None else signed(key, frame, COMMAND_LONG.extra, 9, ticks)


@contextmanager
def px4(build: Path, folder: Path, fleet: Any) -> Iterator[None]:
    vehicle = fleet.config.vehicles[0]
    home = ned_to_geodetic(Ned(vehicle.pad_north_m, vehicle.pad_east_m, 0.0), fleet.config.origin)
    instance = Px4Instance(0, home, build, folder / "px4", sitl_parameters(build))
    try:
        yield
    finally:
        instance.end()


def test_a_signed_px4_flies_for_its_companion_and_obeys_no_impostor(
    tmp_path: Path, build: Path, record_property: Property
) -> None:
    if not build_version(build).signing:
        pytest.skip("this PX4 signs nothing")
    key = tmp_path / "one.key"
    make_key(key)
    own, other = read_key(key), bytes(range(32))
    fleet = sitl_fleet(tmp_path, 1, plan=PLAN)
    where = ("--vehicle", "1", "--fleet", str(fleet.file), "--signing-key", str(key))
    with px4(build, tmp_path, fleet):
        time.sleep(6.0)
        given = run("companion", "signing", "give", *where, "--yes", folder=tmp_path)
        assert given.returncode == 0, given.stderr
        with (
            started("companion", "run", *where, folder=tmp_path, name="companion"),
            operator_of(fleet) as operator,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s,
        ):
            wait_status(operator, lambda said: 1 in said and said[1].ready == [], 60.0)
            assert operator.take_off().all_accepted
            wait_status(operator, lambda said: 1 in said and said[1].phase in ("formed", "moving"), 90.0)
            now = ticks_at(time.time_ns())
            for forged in (land(None, 0), land(other, now), land(other, now + HOUR), land(own, now - HOUR)):
                for port in (GCS_PORT, 14580):
                    for _ in range(20):
                        s.sendto(forged, ("127.0.0.1", port))
                        time.sleep(0.01)
            time.sleep(3.0)
            said = operator.status()[1]
            assert said is not None
            assert said.mode == "OFFBOARD", "nobody else's landing command was obeyed"
            record_property("rejected", json.dumps(said.rejected))
            assert not any(why in name for name in said.rejected for why in ("wrong signature", "replayed", "unsigned"))
            genuine = land(own, ticks_at(time.time_ns()))
            s.sendto(genuine, ("127.0.0.1", GCS_PORT))
            wait_status(operator, lambda said: 1 in said and said[1].phase == "released", 10.0)
            wait_status(operator, lambda said: 1 in said and not said[1].armed, 60.0)
