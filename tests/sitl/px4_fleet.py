"""Fleets of real PX4 instances for tests: how to start one, look on, and interfere."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from fleet_process import Fleet, Process, flight_folder, make_fleet, operator_of, started, wait_status
from pymavlink.dialects.v20 import development as dialect

from companion.core.trajectory.history import TrajectoryHistory
from companion.io.recording import read_recording
from companion.operator.client import Operator
from companion.wire.operator import Status
from companion.wire.px4 import Px4Mode, mode_parameters
from sim.autopilot.stubs import TRUTH_DTYPE
from sim.launch.summary.flight import Flight as FlightRecord

PATIENCE_S = 180.0
ALTITUDE_M = 5.0
DISTANCE_MIN_M, FORMATION_ERROR_MAX_M = 2.5, 0.30
"""by truth"""
GROUND_STATION = (255, 190)
GCS_PORT = 18570
SETPOINT = dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED


def sitl_fleet(folder: Path, count: int, *, only: int | None = None, **more: Any) -> Fleet:
    """A file for `count` instances on PX4's own ports, of which perhaps only the one of that id is enabled."""
    vehicles = [{"id": i, "enabled": only in (None, i)} for i in range(1, count + 1)]
    tables = {"formation": {"shape": "v", "altitude_m": ALTITUDE_M}, "vehicle": vehicles}
    return make_fleet(folder, count, **(tables | more))


@dataclass(frozen=True, slots=True)
class Flying:
    """A fleet that `fleet up` flies."""

    fleet: Fleet
    up: Process
    operator: Operator

    @property
    def folder(self) -> Path:
        return flight_folder(self.fleet.folder / "flights")

    @property
    def summary(self) -> dict[str, Any]:
        """What the launcher has written at the flight's end."""
        summary: dict[str, Any] = json.loads((self.folder / "summary.json").read_text())
        return summary

    def wait(self, phase: str, *ids: int) -> None:
        """Until these vehicles (or all) are in that phase; who moves or holds has formed."""
        phases = ("formed", "moving", "holding") if phase == "formed" else (phase,)
        wanted = ids or tuple(self.fleet.ids)

        def enough(said: dict[int, Status]) -> bool:
            assert self.up.popen.poll() is None, self.up.err
            return all(i in said and said[i].phase in phases for i in wanted)

        wait_status(self.operator, enough, PATIENCE_S)

    def wait_speed(self, vehicle_id: int, speed_m_s: float) -> None:
        """Until a vehicle truly flies at least so fast on the level."""
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s:
            rows = self.truth(vehicle_id)[-25:]
            if len(rows) and np.linalg.norm(rows["velocity_ned_m_s"][:, :2], axis=1).min() >= speed_m_s:
                return
            time.sleep(0.2)
        raise AssertionError(f"vehicle {vehicle_id} does not reach {speed_m_s} m/s")

    def truth(self, vehicle_id: int) -> npt.NDArray[Any]:
        """What a vehicle has truly done so far; its modes are CURRENT_MODE's at 20 Hz."""
        rows = np.fromfile(self.folder / "truth.bin", TRUTH_DTYPE)
        mine: npt.NDArray[Any] = rows[rows["vehicle_id"] == vehicle_id]
        return mine[np.argsort(mine["time_unix_ns"], kind="stable")]

    def left_offboard_ns(self, vehicle_id: int, after_ns: int) -> tuple[int, int]:
        """When PX4 first told another mode than OFFBOARD (UTC, ns), and which; waits for it."""
        deadline_s = time.monotonic() + 10.0
        while time.monotonic() < deadline_s:
            rows = self.truth(vehicle_id)
            rows = rows[(rows["time_unix_ns"] > after_ns) & (rows["custom_mode"] != int(Px4Mode.OFFBOARD))]
            if len(rows):
                return int(rows["time_unix_ns"][0]), int(rows["custom_mode"][0])
            time.sleep(0.2)
        raise AssertionError(f"vehicle {vehicle_id} stays in OFFBOARD")

    def setpoints_ns(self, vehicle_id: int) -> list[int]:
        """When a companion sent its setpoints (UTC, ns)."""
        entries = read_recording(self.folder / f"vehicle-{vehicle_id}.mcap").entries
        return [
            e.instant.fleet_ns
            for e in entries
            if e.channel == "output/mavlink" and e.body[7] | e.body[8] << 8 | e.body[9] << 16 == SETPOINT
        ]

    def history(self) -> TrajectoryHistory:
        """The motions that the vehicles followed, from their recordings; after the flight's end."""
        account = FlightRecord(self.fleet.config, seed=0, truth=np.zeros(0), takeoff_ns=0)
        for i in self.fleet.ids:
            account.read(i, read_recording(self.folder / f"vehicle-{i}.mcap").entries)
        return account.history()

    def pilot(self, vehicle_id: int, mode: Px4Mode) -> int:
        """A ground station changes the mode; returns when (UTC, ns)."""
        instance = self.fleet.config.by_id(vehicle_id).instance
        sender: Any = dialect.MAVLink(None, srcSystem=GROUND_STATION[0], srcComponent=GROUND_STATION[1])
        command, *parameters = mode_parameters(mode)
        message = dialect.MAVLink_command_long_message(vehicle_id, 1, command, 0, *parameters, 0, 0, 0, 0)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
            now_ns = time.time_ns()
            s.sendto(message.pack(sender), ("127.0.0.1", GCS_PORT + instance))
        return now_ns

    def minimum_distance_m(self, ids: list[int], since_ns: int) -> float:
        """Smallest true distance of these vehicles since then (m)."""
        tracks = [self.truth(i) for i in ids]
        times = np.arange(since_ns, min(int(t["time_unix_ns"][-1]) for t in tracks), 20_000_000)
        p = np.stack(
            [
                np.stack([np.interp(times, t["time_unix_ns"], t["position_ned_m"][:, k]) for k in range(3)], axis=1)
                for t in tracks
            ],
            axis=1,
        )
        i, j = np.triu_indices(len(ids), 1)
        return float(np.linalg.norm(p[:, i] - p[:, j], axis=2).min())


def judged(summary: dict[str, Any], record_property: Callable[[str, object], None]) -> dict[str, Any]:
    """The steady part of a whole flight by its summary, whose figures go into --junitxml: judged by truth, nobody near
    another, no failsafe, all landed."""
    steady: dict[str, Any] = {k: v for k, v in summary["steady"].items() if k != "windows"}
    record_property("steady", steady)
    record_property("believed", summary["believed"])
    record_property("minimum_distance_m", summary["minimum_distance_m"])
    assert summary["judged_by"] == "truth"
    assert summary["failsafes"] == []
    assert all(summary["landed"].values())
    assert summary["minimum_distance_m"] >= DISTANCE_MIN_M
    assert steady["formation_error_rms_m"] <= FORMATION_ERROR_MAX_M
    return steady


@contextmanager
def flying(fleet: Fleet, build: Path, *more: str, shown: bool = False) -> Iterator[Flying]:
    """`fleet up --autopilot px4`, from its start to its end; shown as to people, or its summary alone as JSON."""
    out = fleet.folder / "flights"
    out.mkdir()
    arguments = ("sim", "up", "--fleet", str(fleet.file), "--out", str(out), *(() if shown else ("--json",)))
    how = more or ("--autopilot", "px4", "--px4", str(build))
    with started(*arguments, *how, folder=fleet.folder, name="up") as up, operator_of(fleet) as operator:
        yield Flying(fleet, up, operator)
