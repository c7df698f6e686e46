"""Thousands of inputs that decoders let through, put on real Zenoh while five vehicles fly: nobody falls over.

    flock LOCK python -m pytest -m long -s tests/process/test_flood.py

STARLING_FLOOD_INPUTS sets another number. The same flight is flown without the flood first: what the machine does to a
loop by itself is known from it, and from an empty loop of 50 Hz that runs beside each flight.
"""

import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import zenoh
from fleet_process import SETTLED, Fleet, all_in, eventually, flight_folder, make_fleet, operator_of, started, truth
from fleet_process import wait_status as wait_for
from fuzz_inputs import Inputs

from companion.core.trajectory.fleet import FleetTrajectory
from companion.io.recording import read_recording
from companion.io.records import TickRecord
from companion.io.replay import replay_file
from companion.io.zenoh.configuration import session_settings, zenoh_configuration
from companion.operator.client import Operator
from companion.wire.peer import motion_from_json
from companion.wire.px4 import Px4Mode
from sim.launch.reference_loop import read_reference_loop

pytestmark = [pytest.mark.process, pytest.mark.long, pytest.mark.timeout(900)]

RATE_HZ = 100.0
INPUTS = int(os.environ.get("STARLING_FLOOD_INPUTS", "2500"))
GAP_S, BUSY_S = 0.1, 0.05
FENCE = {"radius_m": 150.0, "floor_m": 0.5, "ceiling_m": 50.0}


@dataclass(frozen=True)
class Seen:
    """What was seen of one flight, between two times."""

    folder: Path
    gaps_s: dict[int, float]
    """vehicle -> the longest time between two turns of its loop"""
    cpu_s: float
    """the most CPU that a loop took between two control ticks"""
    machine_s: float
    """how late the empty loop beside them woke at most"""
    offboard: dict[int, bool]
    """vehicle -> whether it was in OFFBOARD all the time, in truth"""
    running: list[int]
    """vehicles whose companions answered at the end"""
    rejected: dict[str, int]


def newest_of(operator: Operator) -> FleetTrajectory:
    motions = [motion_from_json(s.motion) for s in operator.status().values() if s is not None]
    return max(motions, key=lambda m: m.order)


def flood(fleet: Fleet, operator: Operator) -> int:
    """INPUTS inputs at RATE_HZ, puts to all and questions to one; how many."""
    inputs, given = Inputs(fleet.config, seed=2), 0
    session = zenoh.open(zenoh_configuration(session_settings(fleet.config, None)))
    try:
        assert eventually(lambda: len(session.info.peers_zid()) >= len(fleet.ids))
        newest, next_s = newest_of(operator), time.monotonic()
        while given < INPUTS:
            one = inputs.one(newest, time.time_ns())
            if one.kind in ("plan", "state"):
                session.put(one.key, one.payload)
            elif one.kind == "presence":
                continue
            else:
                session.get(
                    f"fleet/{fleet.ids[given % 5]}/{one.kind}", lambda _: None, payload=one.payload, timeout=2.0
                )
            given += 1
            if given % 200 == 0:
                newest = newest_of(operator)
            next_s = max(next_s + 1.0 / RATE_HZ, time.monotonic() - 0.1)
            time.sleep(max(next_s - time.monotonic(), 0.0))
    finally:
        session.close()  # type: ignore[no-untyped-call]
    return given


def flown(folder: Path, flooded: bool) -> Seen:
    formation = {"shape": "v", "altitude_m": 10.0}
    fleet = make_fleet(folder, 5, fence=FENCE, plan={"then": "stay"}, formation=formation)
    out = fleet.folder / "flights"
    arguments = (
        "sim",
        "up",
        "--json",
        "--fleet",
        str(fleet.file),
        "--out",
        str(out),
        "--plan",
        "velocity:0.5:0:10,turn:3",
    )
    with started(*arguments, folder=folder, name="up") as up, operator_of(fleet) as operator:
        wait_for(operator, all_in(fleet.ids, *SETTLED, revision=2))
        begin_ns = time.time_ns()
        if flooded:
            assert flood(fleet, operator) == INPUTS
        else:
            time.sleep(INPUTS / RATE_HZ)
        end_ns = time.time_ns()
        said = {i: s for i, s in operator.status(3.0).items() if s is not None}
        operator.land()
        up.wait()
    seen = flight_folder(out)
    gaps, offboard, cpu_s = {}, {}, 0.0
    for i in fleet.ids:
        entries = list(read_recording(seen / f"vehicle-{i}.mcap").entries)
        turns = [e.instant.fleet_ns for e in entries if e.channel == "advance"]
        spent = [
            TickRecord.unpack(e.body).cpu_ns
            for e in entries
            if e.channel == "tick" and begin_ns <= e.instant.fleet_ns <= end_ns
        ]
        cpu_s = max(cpu_s, float(np.diff(spent).max()) * 1e-9)
        within = np.array([t for t in turns if begin_ns <= t <= end_ns])
        gaps[i] = float(np.diff(within).max()) * 1e-9
        rows = truth(seen / "truth.bin", i)
        rows = rows[(rows["time_unix_ns"] >= begin_ns) & (rows["time_unix_ns"] <= end_ns)]
        offboard[i] = bool((rows["custom_mode"] == Px4Mode.OFFBOARD).all())
    reference = read_reference_loop(seen / "reference.bin")
    within = reference[(reference[:, 0] >= begin_ns) & (reference[:, 0] <= end_ns), 1]
    return Seen(seen, gaps, cpu_s, float(within.max()) * 1e-9, offboard, sorted(said), said[fleet.ids[0]].rejected)


def test_a_flood_of_inputs_ends_no_companion_stops_no_loop_and_takes_nobody_out_of_offboard(tmp_path: Path) -> None:
    (tmp_path / "calm").mkdir()
    (tmp_path / "flooded").mkdir()
    calm, flooded = flown(tmp_path / "calm", flooded=False), flown(tmp_path / "flooded", flooded=True)
    for name, seen in (("calm", calm), ("flooded", flooded)):
        sys.stdout.write(
            f"{name}: longest gaps of the loops {[round(1e3 * g) for g in seen.gaps_s.values()]} ms, "
            f"most CPU between two ticks {1e3 * seen.cpu_s:.0f} ms, "
            f"empty loop late by {1e3 * seen.machine_s:.0f} ms at most, "
            f"in OFFBOARD {seen.offboard}, running {seen.running}\n"
        )
    sys.stdout.write(f"rejected by the first vehicle: {flooded.rejected}\n")
    assert flooded.running == [1, 2, 3, 4, 5]
    assert all(flooded.offboard.values())
    assert not [kind for kind in flooded.rejected if kind.startswith("raised")]
    assert sum(flooded.rejected.values()) > INPUTS / 4
    assert flooded.cpu_s < GAP_S
    # What the machine does to a loop is what it does to an empty one, and to the loops of the flight without the flood;
    # one that is late by more than BUSY_S for a single empty loop tells nothing of five.
    machine_s = max(flooded.machine_s, calm.machine_s, max(calm.gaps_s.values()) - 0.05)
    assert max(flooded.gaps_s.values()) < GAP_S + machine_s or flooded.machine_s > BUSY_S
    for i in flooded.running:
        result = replay_file(flooded.folder / f"vehicle-{i}.mcap")
        assert result.same, result.sentence()
