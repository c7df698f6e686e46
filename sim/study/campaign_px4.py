"""Fault campaign on real PX4 in SITL: whole flights of real processes, one to three faults each, drawn by the seed.

Judged as the flights in lockstep are (`campaign_judge`). A flight takes a minute or two, on real clocks: a seed that is
flown again meets the same faults, and not the same milliseconds.
"""

import hashlib
import json
import os
import re
import shutil
import tempfile
import time
import tomllib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import numpy.typing as npt

from companion.core.frames import Ned
from companion.core.values import FLYING_PHASES, Phase
from companion.errors import CompanionError, ConfigError
from companion.wire.mavlink import ON_GROUND
from sim.autopilot.faults import Fault, FaultKind
from sim.autopilot.stubs import TRUTH_DTYPE
from sim.launch.faults import CompanionFault, CompanionFaultKind, ScheduledFault
from sim.launch.launch import FlightOptions, Flown, fly
from sim.launch.lock import only_flight
from sim.launch.px4_build import build_version, find_build, has_parameter
from sim.launch.sitl_faults import kinds_of
from sim.launch.summary.truth import ALOFT_M
from sim.launch.watch import Progress
from sim.study.campaign import campaign_tables
from sim.study.campaign_faults import HANDED_OVER, Drawn, Flight, drawn_faults
from sim.study.campaign_judge import Seen, judged, tables_of
from sim.study.common import FLYING_CODE, Config, Outcome, Record, load_config, table_of

TITLE = "Fault campaign on real PX4: flights with one to three faults each"
SOURCES = FLYING_CODE
STEP_S = 0.02
UNHEARD_S = 0.5
"""truth that is older is none"""
CALM_AFTER_S = 4.0
"""a flight is over once all have been settled for so long, and every fault has come"""
LANDING_S = 20.0
"""the operator waits no longer for those who are somebody else's"""
STALLED_MOST_S = 3.0
AT_REST_M_S = 0.05
FIRST_INSTANCE, INSTANCES_APART = 40, 10
"""beside whatever else flies on this machine"""
SLOTS = 8
"""flights at a time, each with instance numbers of its own"""
TRIES = 3
"""a flight that does not come up, or in which the machine stalled, is flown again, and counted; the last one counts"""
MACHINE_LATE_MOST_S = 0.25
"""an empty 50 Hz loop that was so late shows a machine that flew nobody in real time: PX4 waits 1 s for setpoints"""
RAISED = re.compile(r"[a-z ]+: \w*(Error|Exception|Warning|Interrupt)")
"""what a companion's guard counts"""
AUTOPILOT_KINDS = {
    "gps_lost": FaultKind.GPS_LOST, "gps_stuck": FaultKind.GPS_STUCK, "gps_wrong": FaultKind.GPS_WRONG,
    "battery_empty": FaultKind.LOW_BATTERY, "wind": FaultKind.WIND, "link_lost": FaultKind.LINK_LOST,
    "pilot_takeover": FaultKind.PILOT_TAKEOVER, "px4_restarted": FaultKind.REBOOT,
}  # fmt: skip
COMPANION_KINDS = {
    "killed": CompanionFaultKind.KILLED, "restarted": CompanionFaultKind.RESTARTED,
    "stalled": CompanionFaultKind.STOPPED,
}  # fmt: skip
KINDS = (*AUTOPILOT_KINDS, *COMPANION_KINDS)


def with_build(config: Config, build: Path) -> Config:
    """The set-up for one build of PX4: flights of another are none of it."""
    digest = hashlib.sha256((build / "bin" / "px4").read_bytes()).hexdigest()[:16]
    version = build_version(build).name
    text = (
        f'{config.text}\n[px4]\nbuild = {json.dumps(str(build))}\nlike = {json.dumps(version)}\ndigest = "{digest}"\n'
    )
    return Config(config.name, text, tomllib.loads(text), config.file)


def build_of(config: Config) -> Path:
    """PX4's build folder, which `with_build` has noted."""
    return find_build(Path(config.values["px4"]["build"]) if "px4" in config.values else None)


def flight_of(config: Config, build: Path) -> Flight:
    """The set-up's flight, with the kinds that the build can suffer; a kind that there is not is refused."""
    flight = table_of(config, "flight", Flight)
    if unknown := sorted(set(flight.kinds) - set(KINDS)):
        raise ConfigError(
            f"{config.where}: $.flight.kinds: there is no {', '.join(unknown)}; known are {', '.join(KINDS)}"
        )
    suffers = kinds_of(lambda name: has_parameter(build, name))
    wanted = flight.kinds or KINDS
    known = tuple(k for k in wanted if AUTOPILOT_KINDS.get(k, FaultKind.REBOOT) in suffers)
    return Flight(**{name: getattr(flight, name) for name in Flight.__slots__} | {"kinds": known})


def scheduled(drawn: Drawn, seed: int) -> ScheduledFault:
    """A drawn fault as the launcher carries it out."""
    if drawn.kind in COMPANION_KINDS:
        stalled_s = min(drawn.duration_s, STALLED_MOST_S)
        return ScheduledFault(drawn.at_s, drawn.vehicle_id, CompanionFault(COMPANION_KINDS[drawn.kind], stalled_s))
    wind = Ned(0.0, 0.0, 0.0)
    if drawn.kind == "wind":
        random = Random(f"campaign/{seed}/{drawn.at_s}/wind")
        wind = Ned(random.uniform(-6.0, 6.0), random.uniform(-6.0, 6.0), 0.0)
    return ScheduledFault(
        drawn.at_s, drawn.vehicle_id, Fault(AUTOPILOT_KINDS[drawn.kind], None, drawn.duration_s, wind_ned_m_s=wind)
    )


@dataclass(slots=True)
class _Eye:
    """Who looks on once a second, and says when the flight is over."""

    truth: Path
    ids: list[int]
    last_fault_s: float
    seconds: float
    """whoever is not settled by then is stuck"""
    began_s: float | None = None
    settled_since_s: float | None = None
    stuck: list[list[Any]] = field(default_factory=list)
    over: bool = False
    _last: Progress | None = None

    def look(self, progress: Progress) -> None:
        """Take what the launcher shows."""
        if progress.doing == "starting" or self.over:
            return
        self._last = progress
        now_s = time.monotonic()
        self.began_s = now_s if self.began_s is None else self.began_s
        self.stuck = self._unsettled(progress)
        if self.stuck:
            self.settled_since_s = None
        elif self.settled_since_s is None:
            self.settled_since_s = now_s
        flown_s = now_s - self.began_s
        calm = self.settled_since_s is not None and now_s - self.settled_since_s >= CALM_AFTER_S
        self.over = flown_s >= self.seconds or (calm and flown_s > self.last_fault_s + CALM_AFTER_S)

    def end(self) -> None:
        """The flight has ended by itself: who is settled is told by the last row of truth."""
        if not self.over and self._last is not None:
            self.stuck = self._unsettled(self._last)

    def _unsettled(self, progress: Progress) -> list[list[Any]]:
        """Who is neither on the ground nor handed over, by truth and by the companion's phase."""
        newest = _newest(self.truth)
        phases = {i: None if (s := progress.vehicles.get(i)) is None else Phase[s.phase.upper()] for i in self.ids}
        return [
            [i, "no answer" if phase is None else phase.name.lower()]
            for i, phase in phases.items()
            if not settled(newest.get(i), phase)
        ]


def settled(row: Any, phase: Phase | None) -> bool:
    """Whether a flight is over for a vehicle: on the ground and disarmed, or in somebody else's hands.

    `row` is its last of truth (None: nobody tells), `phase` its companion's (None: that does not answer).
    """
    if row is None or (not row["armed"] and row["landed_state"] == ON_GROUND):
        return True
    if phase is not None and phase in FLYING_PHASES | {Phase.PREFLIGHT}:
        return False
    return int(row["custom_mode"]) in HANDED_OVER or _lies(row)


def _lies(row: Any) -> bool:
    """Whether a vehicle is at rest on the ground by truth.

    A PX4 that does not know where it is does not always notice, and stays armed in its landing.
    """
    return bool(row["position_ned_m"][2] > -ALOFT_M and np.abs(row["velocity_ned_m_s"]).max() < AT_REST_M_S)


def _newest(path: Path) -> dict[int, Any]:
    """The last row of truth of each vehicle."""
    with suppress(OSError), path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        rows = min(size // TRUTH_DTYPE.itemsize, 2000)
        file.seek((size // TRUTH_DTYPE.itemsize - rows) * TRUTH_DTYPE.itemsize)
        last = np.fromfile(file, TRUTH_DTYPE, rows)
        return {int(row["vehicle_id"]): row for row in last}
    return {}


def seen_of(truth: npt.NDArray[Any], ids: list[int], events: Sequence[Any], takeoff_ns: int) -> Seen:
    """Truth on one grid of times: positions between two rows, states as last told, nothing where nobody tells."""
    times = np.arange(takeoff_ns, int(truth["time_unix_ns"].max()), round(STEP_S * 1e9))
    rows = np.zeros((len(times), len(ids)), TRUTH_DTYPE)
    for k, i in enumerate(ids):
        mine = truth[truth["vehicle_id"] == i]
        mine = mine[np.argsort(mine["time_unix_ns"], kind="stable")]
        at = np.clip(np.searchsorted(mine["time_unix_ns"], times, side="right") - 1, 0, len(mine) - 1)
        for name in ("armed", "landed_state", "custom_mode"):
            rows[name][:, k] = mine[name][at]
        for axis in range(3):
            rows["position_ned_m"][:, k, axis] = np.interp(times, mine["time_unix_ns"], mine["position_ned_m"][:, axis])
        after = np.clip(at + 1, 0, len(mine) - 1)
        gap_s = np.maximum(times - mine["time_unix_ns"][at], 0) * 1e-9
        unheard = (gap_s > UNHEARD_S) | ((mine["time_unix_ns"][after] - mine["time_unix_ns"][at]) * 1e-9 > UNHEARD_S)
        rows["position_ned_m"][unheard, k] = np.nan
    told = [((ns - takeoff_ns) * 1e-9, i, e) for ns, i, e in events]
    return Seen(ids, (times - takeoff_ns) * 1e-9, rows, told)


def fly_px4(flight: Flight, seed: int, build: Path, slot: int = 0, keep: Path | None = None) -> Record:
    """One flight in a folder of its own, which is kept where `keep` says."""
    missing = Random(f"campaign/{seed}/missing").choice(("land", "continue"))
    faults = drawn_faults(flight, seed)
    tables = campaign_tables(flight, missing)
    tables["fleet"]["name"] = f"campaign-px4-{os.getpid()}-{slot}"
    tables["launch"] = {"first_instance": FIRST_INSTANCE + slot * INSTANCES_APART}
    tables["limits"] = {}
    ids = [v["id"] for v in tables["vehicle"]]
    with tempfile.TemporaryDirectory(prefix="campaign-") as scratch:
        folder = Path(scratch) / "flight"
        folder.mkdir()
        eye = _Eye(folder / "truth.bin", ids, max(f.at_s for f in faults), flight.seconds)
        options = FlightOptions(
            folder, seed=seed, px4=build, faults=tuple(scheduled(f, seed) for f in faults), landing_s=LANDING_S
        )
        said: list[str] = []
        try:
            with only_flight(tables["fleet"]["name"]):
                flown = fly(tables, options, eye.look, lambda: eye.over, said.append)
            eye.end()
            record = _record(flight, faults, flown, eye)
        finally:
            if keep is not None:
                shutil.copytree(folder, keep, dirs_exist_ok=True)
    return {**record, "said": said}


def _record(flight: Flight, faults: Sequence[Drawn], flown: Flown, eye: _Eye) -> Record:
    account, summary = flown
    seen = seen_of(account.truth, eye.ids, sorted(account.events, key=lambda e: e[0]), account.takeoff_ns)
    raised = [name for name in summary["rejected"] if RAISED.fullmatch(name)]
    killed = {f.vehicle_id for f in faults if f.kind == "killed"}
    ended = {int(i): s for i, s in summary["exit_status"].items() if s not in (0, None) and int(i) not in killed}
    raised += [f"companion {i} ended with status {status}" for i, status in ended.items()]
    return {
        **judged(seen, faults, flight),
        "raised": "; ".join(raised),
        "operator_landed": False,
        "stuck": eye.stuck,
        "left_in_hold": [i for i, on_ground in summary["landed"].items() if not on_ground],
        "ended_after_s": float(seen.seconds[-1]),
        "faults_refused": summary["faults_refused"],
        "machine_late_s": (summary["reference_lateness_ms"]["max"] or 0.0) * 1e-3,
    }


def piece(config: Config, seed: int) -> Record:
    """One seed's flight; one that does not come up is tried once more."""
    build = build_of(config)
    flight = flight_of(config, build)
    with _slot() as slot:
        for attempt in range(1, TRIES + 1):
            try:
                record = fly_px4(flight, seed, build, slot)
            except CompanionError as error:
                if attempt == TRIES:
                    raise CompanionError(f"seed {seed} does not come up, tried {TRIES} times: {error}") from error
                continue
            if record["machine_late_s"] <= MACHINE_LATE_MOST_S or attempt == TRIES:
                return {**record, "tries": attempt}
    raise AssertionError


class _slot:  # noqa: N801 - used as a function
    """A place among the flights of this machine, with instance numbers of its own."""

    def __enter__(self) -> int:
        for slot in range(SLOTS):
            lock = only_flight(f"campaign-slot-{slot}")
            try:
                lock.__enter__()
            except CompanionError:
                continue
            self._lock = lock
            return slot
        raise CompanionError(f"{SLOTS} flights of a campaign are on this machine already")

    def __exit__(self, *error: object) -> None:
        self._lock.__exit__(None, None, None)


def finish(config: Config, pieces: Sequence[Record], seeds: Sequence[int]) -> Outcome:
    """What happened in how many of the flights, with intervals; every flight in which something did, by its seed."""
    how = f"Real companions on real PX4 in SITL (like {build_version(build_of(config)).name})"
    outcome = tables_of(flight_of(config, build_of(config)), how, pieces, seeds)
    again = sum(p["tries"] > 1 for p in pieces)
    late = sum(p["machine_late_s"] > MACHINE_LATE_MOST_S for p in pieces)
    refused = sum(len(p["faults_refused"]) for p in pieces)
    outcome.findings.append(
        f"{again} flights were flown again, since the machine had stalled or PX4 had not come up; in {late} it stalled "
        f"the last time too. {refused} faults were not carried out."
    )
    return outcome


if __name__ == "__main__":
    # One flight alone, its folder kept: PX4_BUILD=... python -m sim.study.campaign_px4 SEED FOLDER
    import sys

    number, kept = sys.argv[1:]
    setup = load_config("campaign_px4")
    chosen = build_of(setup)
    told = fly_px4(flight_of(setup, chosen), int(number), chosen, keep=Path(kept))
    sys.stdout.write(f"{json.dumps(told, indent=1)}\n")
