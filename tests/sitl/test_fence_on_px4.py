"""The fence on real PX4 instances, by the simulator's truth: a broken law, and an operator's motion without end."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from fleet_process import Fleet, all_in, eventually, operator_of, run, started, truth, wait_status
from px4_fleet import PATIENCE_S, flying, sitl_fleet

from companion.core.safety.filter import COLLISION_DISTANCE_M
from companion.operator.client import Operator, PreflightError

RADIUS_M, MARGIN_M = 30.0, 2.0
FENCE: dict[str, Any] = {"radius_m": RADIUS_M, "margin_m": MARGIN_M, "floor_m": 2.0, "ceiling_m": 8.0}
BEYOND_M = 1.5
"""beyond the margin at most, half a metre inside the edge: the stubs' bound"""
SPEED_MAX_M_S = 4.0
WANTED_M_S = 8.0
"""by the broken law: the filter's speed limit ends it"""
LITTLE_DRAG = "SIH_KDV=0.2"
"""N/(m/s) at 1 kg, as the stub's; PX4's 1.0 would keep the vehicle below the speed limit, and brake it"""
MOVE_M_S = 3.0
"""the fastest that an operator may ask for at that speed limit"""
IN_THE_AIR = ("waiting", "detached")
PRESSING_S = 30.0
"""of which ten bring it to the fence"""
REST_S = 10.0
REST_M_S = 1.0
"""outward, at the fence in the end: the estimate wanders, and the vehicle with it"""

Property = Callable[[str, object], None]
"""pytest's record_property: the figures go into --junitxml"""
Array = npt.NDArray[Any]


def outward(rows: Array) -> tuple[Array, Array]:
    """True distance from the fence's centre on the level (m), and its rate (m/s)."""
    p, v = rows["position_ned_m"][:, :2], rows["velocity_ned_m_s"][:, :2].astype(float)
    distance = np.linalg.norm(p, axis=1)
    return distance, (p * v).sum(axis=1) / np.maximum(distance, 1.0)


@contextmanager
def broken(fleet: Fleet, build: Path) -> Iterator[tuple[subprocess.Popen[bytes], Operator]]:
    """One vehicle in the air, whose law has not broken yet."""
    file = str(fleet.file)
    host = ("sim", "sitl", "--fleet", file, "--px4", str(build), "--truth", str(fleet.folder / "truth.bin"),
            "--parameter", LITTLE_DRAG)  # fmt: skip
    script = str(Path(__file__).with_name("broken_companion.py"))
    with (
        started(*host, folder=fleet.folder, name="sitl", stdin=subprocess.PIPE) as sitl,
        (fleet.folder / "companion.log").open("wb") as log,
        subprocess.Popen(
            [sys.executable, "-P", script, file, "1", str(WANTED_M_S)], stdin=subprocess.PIPE, stdout=log, stderr=log
        ) as companion,
        operator_of(fleet) as operator,
    ):
        try:

            def taken_off() -> bool:
                assert companion.poll() is None, (fleet.folder / "companion.log").read_text()
                try:
                    return operator.take_off().all_accepted
                except PreflightError:
                    return False

            assert eventually(taken_off, PATIENCE_S)
            wait_status(operator, all_in([1], *IN_THE_AIR), PATIENCE_S)
            yield companion, operator
            operator.land()
            assert eventually(lambda: not truth(fleet.folder / "truth.bin", 1)["armed"][-1], 60.0)
        finally:
            companion.terminate()
            with suppress(subprocess.TimeoutExpired):
                companion.wait(10.0)
            companion.kill()
            sitl.signal(signal.SIGTERM)
            sitl.wait(15.0)


@pytest.mark.parametrize("fence", [True, False])
def test_a_broken_law_at_the_speed_limit_stays_inside_on_px4_and_without_the_fence_it_leaves(
    tmp_path: Path, build: Path, record_property: Property, fence: bool
) -> None:
    plan = {"automatic": False, "then": "stay", "legs": []}
    fleet = sitl_fleet(tmp_path, 1, **({"plan": plan, "fence": FENCE} if fence else {"plan": plan}))
    assert fleet.config.limits.speed_max_m_s == SPEED_MAX_M_S
    with broken(fleet, build) as (companion, operator):
        companion.send_signal(signal.SIGUSR1)
        began_ns = time.time_ns()
        time.sleep(PRESSING_S)
        said = operator.status()[1]
        rows = truth(tmp_path / "truth.bin", 1)
        rows = rows[rows["time_unix_ns"] >= began_ns]
    assert said is not None
    distance, rate = outward(rows)
    last = rows["time_unix_ns"] >= rows["time_unix_ns"][-1] - round(REST_S * 1e9)
    record_property("fastest outward (m/s)", rate.max())
    record_property("farthest (m)", distance.max())
    record_property("beyond the margin (m)", distance.max() - (RADIUS_M - MARGIN_M))
    record_property("fastest outward in the last 10 s (m/s)", rate[last].max())
    assert rate.max() > 0.9 * SPEED_MAX_M_S
    if fence:
        assert RADIUS_M - MARGIN_M - 1.0 < distance.max() < RADIUS_M - MARGIN_M + BEYOND_M
        assert rate[last].max() < REST_M_S
        assert said.limited["fence"] > 100
    else:
        assert distance.max() > RADIUS_M + 20.0


def test_a_move_for_ever_ends_at_the_fence_on_px4(tmp_path: Path, build: Path, record_property: Property) -> None:
    """Three in a V; the motion that they follow is far outside in the end."""
    fleet = sitl_fleet(tmp_path, 3, plan={"then": "stay", "legs": []}, fence=FENCE)
    with flying(fleet, build) as flight:
        flight.wait("formed")
        answer = run("sim", "move", "--velocity", str(MOVE_M_S), "0", "0", "--fleet", str(fleet.file), folder=tmp_path)
        assert answer.returncode == 0, answer.stderr
        began_ns = time.time_ns()
        time.sleep(PRESSING_S)
        ended_ns = time.time_ns()
        said = flight.operator.status()
        tracks = {i: flight.truth(i) for i in fleet.ids}
        nearest_m = flight.minimum_distance_m(fleet.ids, began_ns)
        flight.up.signal(signal.SIGINT)
        flight.up.wait(120.0)
        planned = flight.history().at(ended_ns).state_at(ended_ns).centre.position
    farthest_m, fastest_m_s, rest_m_s = {}, {}, {}
    for i, rows in tracks.items():
        flown = rows[(rows["time_unix_ns"] >= began_ns) & (rows["time_unix_ns"] <= ended_ns)]
        distance, rate = outward(flown)
        last = flown["time_unix_ns"] >= ended_ns - round(REST_S * 1e9)
        farthest_m[i], fastest_m_s[i] = float(distance.max()), float(rate.max())
        rest_m_s[i] = float(rate[last].max())
    record_property("the plan's centre, north (m)", planned.north)
    record_property("farthest (m)", farthest_m)
    record_property("beyond the margin (m)", max(farthest_m.values()) - (RADIUS_M - MARGIN_M))
    record_property("fastest outward (m/s)", fastest_m_s)
    record_property("fastest outward in the last 10 s (m/s)", rest_m_s)
    record_property("minimum distance (m)", nearest_m)
    assert planned.north > RADIUS_M + 10.0
    assert max(fastest_m_s.values()) > 0.8 * MOVE_M_S
    assert RADIUS_M - MARGIN_M - 1.0 < max(farthest_m.values()) < RADIUS_M - MARGIN_M + BEYOND_M
    assert max(rest_m_s.values()) < REST_M_S
    assert nearest_m > COLLISION_DISTANCE_M
    assert any(s is not None and s.limited["fence"] > 100 for s in said.values())
