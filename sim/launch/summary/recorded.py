"""A flight read from its companions' recordings alone, whatever flew: stubs, SITL, vehicles in the field."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from companion.about import PACKAGE
from companion.config import FleetConfig
from companion.core.events import MotionAdopted, PhaseChanged
from companion.core.values import FLYING_PHASES, Phase
from companion.errors import ConfigError
from companion.io.recording import Recording, read_recording
from companion.io.replay import made_from
from sim.autopilot.stubs import TRUTH_DTYPE
from sim.launch.reference_loop import read_reference_loop
from sim.launch.summary.flight import CENTROID_GPS_M, CENTROID_M, TICK_ROWS, TRAFFIC_ROWS, Array, Flight

ON_GROUND = (Phase.IDLE, Phase.LANDED)
LONGEST_NS = 24 * 3600 * 10**9
"""beyond it the figures, ten a second, would not fit into a computer"""
NOT_GIVEN = "no recording of it was given"


def recordings_of(paths: Sequence[Path]) -> list[Path]:
    """The recordings that were named: files, and all that lie in folders; ConfigError if there are none."""
    found: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = sorted(path.glob("*.mcap"))
            if not inside:
                raise ConfigError(f"{path}: no recording (*.mcap) is in this folder")
            found += inside
        else:
            found.append(path)
    return list(dict.fromkeys(found))


def recorded_flight(paths: Sequence[Path], number: int | None = None) -> tuple[Flight, dict[int, str]]:
    """One flight of the vehicles whose recordings these are, and the vehicles of the fleet that have none, with why.

    `number` counts the flights (take-off commands that somebody obeyed) from 1; None: the last. ConfigError where the
    recordings are of different fleets, or hold no such flight; RecordingError for a file that is none.
    """
    by_vehicle: dict[int, list[tuple[int, Recording]]] = defaultdict(list)
    seen: dict[tuple[int, int], Path] = {}
    configs: list[tuple[Path, FleetConfig]] = []
    software: set[str] = set()
    for path in recordings_of(paths):
        recording = read_recording(path)
        config, vehicle_id, boot_id = made_from(recording)
        _same_fleet(configs, path, config)
        if (same := seen.setdefault((vehicle_id, boot_id), path)) != path:
            raise ConfigError(f"{path}: is of the same companion's life as {same}: give one of the two")
        first = next(iter(recording.entries), None)
        if first is not None:
            by_vehicle[vehicle_id].append((first.instant.fleet_ns, recording))
        software.add(recording.metadata.get("version", "unknown"))
    config = configs[0][1]
    missing = {v.id: NOT_GIVEN for v in config.vehicles if v.id not in by_vehicle}
    if len(missing) == len(config.vehicles):
        raise ConfigError("these recordings hold no entry: nobody has flown")
    flight = Flight(
        config=_without(config, frozenset(missing)),
        seed=0,
        truth=_truth(paths),
        takeoff_ns=0,
        centroid_limit_m=CENTROID_GPS_M if any(list(path.glob("px4-*")) for path in paths) else CENTROID_M,
        versions={PACKAGE: ", ".join(sorted(software))},
    )
    unclosed = set()
    for i, recorded in sorted(by_vehicle.items()):
        in_order = [r for _, r in sorted(recorded, key=lambda one: one[0])]
        flight.read_files(i, [r.path for r in in_order])
        if not in_order[-1].complete:
            unclosed.add(i)
    for path in paths:
        if path.is_dir() and (file := path / "reference.bin").exists():
            flight.reference_lateness_ns = read_reference_loop(file)[:, 1].astype(float)
    return one_of(flight, number, unclosed), missing


def _same_fleet(configs: list[tuple[Path, FleetConfig]], path: Path, config: FleetConfig) -> None:
    if configs and (keys := configs[0][1].differing(config.shared_digests)):
        raise ConfigError(
            f"{path}: is of another fleet file than {configs[0][0]}: {', '.join(keys)} differ; give recordings of one "
            "flight"
        )
    configs.append((path, config))


def _without(config: FleetConfig, missing: frozenset[int]) -> FleetConfig:
    """The same file with the vehicles disabled that are not there; slots come from the motions that were flown."""
    if not missing:
        return config
    rows = tuple(v.model_copy(update={"enabled": v.enabled and v.id not in missing}) for v in config.vehicle)
    fields = {name: getattr(config, name) for name in type(config).model_fields}
    return FleetConfig.model_construct(**{**fields, "vehicle": rows})


def _truth(paths: Sequence[Path]) -> Array:
    """What a simulator knew, where a flight's folder was given."""
    files = [path / "truth.bin" for path in paths if path.is_dir() and (path / "truth.bin").exists()]
    return np.concatenate([np.fromfile(f, TRUTH_DTYPE) for f in files]) if files else np.zeros(0, TRUTH_DTYPE)


def takeoffs_ns(flight: Flight) -> list[int]:
    """When each flight began: the take-off commands that somebody obeyed."""
    return sorted(c.time_ns for c in flight.commands.values() if c.order.verb == "takeoff" and c.accepted)


def one_of(flight: Flight, number: int | None, unclosed: set[int]) -> Flight:
    """What belongs to one flight of all that was recorded.

    Of the `unclosed` recordings those that end in the air are of companions that were lost in flight.
    """
    begins = takeoffs_ns(flight)
    if not begins:
        raise ConfigError("these recordings hold no take-off: nobody has flown")
    chosen = len(begins) if number is None else number
    if not 1 <= chosen <= len(begins):
        raise ConfigError(f"--flight must be 1 to {len(begins)}: so many take-offs are recorded, got {chosen}")
    begin = begins[chosen - 1]
    latest = max((int(rows["fleet_ns"].max()) for rows in flight.ticks.values() if len(rows)), default=begin)
    end = begins[chosen] if chosen < len(begins) else latest + 1
    if end - begin > LONGEST_NS:
        raise ConfigError(
            f"the flight would last {(end - begin) * 1e-9 / 3600:.0f} hours, may last {LONGEST_NS * 1e-9 / 3600:.0f}: "
            "a clock was set in between, or a recording is damaged; leave that one out"
        )

    def within(rows: Array) -> Array:
        return rows[(rows["fleet_ns"] >= begin) & (rows["fleet_ns"] < end)]

    events = [e for e in flight.events if begin <= e[0] < end or (isinstance(e[2], MotionAdopted) and e[0] < end)]
    last: dict[int, Phase] = {}
    for _, i, event in sorted(events, key=lambda e: e[0]):
        if isinstance(event, PhaseChanged):
            last[i] = event.after
    return replace(
        flight,
        takeoff_ns=begin,
        lost=frozenset(i for i in unclosed if last.get(i) in FLYING_PHASES),
        truth=flight.truth[(flight.truth["time_unix_ns"] >= begin) & (flight.truth["time_unix_ns"] < end)],
        disarmed={i: phase in ON_GROUND for i, phase in last.items()},
        commands={k: c for k, c in flight.commands.items() if begin <= c.time_ns < end},
        puts=[p for p in flight.puts if begin <= p.time_ns < end],
        events=events,
        ticks={i: within(rows) if len(rows) else np.zeros(0, TICK_ROWS) for i, rows in flight.ticks.items()},
        traffic={i: within(rows) if len(rows) else np.zeros(0, TRAFFIC_ROWS) for i, rows in flight.traffic.items()},
    )
