"""What every study shares: its set-up file, pieces per seed that survive an interruption, tables and figures."""

import csv
import importlib
import inspect
import json
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from hashlib import blake2s
from multiprocessing import get_context
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.stats import beta

from companion.config.file import read_text, tables_of
from companion.config.law_tables import LAWS
from companion.config.registry import Origin
from companion.errors import ConfigError
from sim.study import FLOWN, FLOWN_STUDIES, STUDIES
from sim.study.own_setup import same_tables
from sim.swarm.setup import Setup, connected, setup_from
from sim.swarm.swarm import Run, kernels

Floats = npt.NDArray[np.float64]
Record = dict[str, Any]
"""values that JSON can hold"""

FLYING_CODE = tuple(
    sorted(p for folder in ("companion", "sim") for p in (Path(__file__).parents[2] / folder).rglob("*.py"))
)
"""everything that flies in those: their finished seeds are run anew when any of it changes"""

# Payloads as `companion.wire.peer` lays them out (bytes); the published intent carries c, g, w, e, e' instead of p, v.
MESSAGE_BYTES = 59
DIGEST_ENTRY_BYTES = 38
INTENT_EXTRA_BYTES = 36
TOLD_BYTES = 4
"""of each number that a law adds to each sample, and a byte of a message for their count"""


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table."""

    key: str
    title: str
    digits: int = 3


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of values under columns; written as CSV and shown in the report."""

    name: str
    title: str
    columns: tuple[Column, ...]
    rows: list[Record]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure and what it shows."""

    name: str
    caption: str
    drawing: Any
    """matplotlib figure"""


@dataclass(slots=True)
class Outcome:
    """What a study found."""

    tables: list[Table] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)
    findings: list[str] = field(default_factory=list)
    """sentences for the report"""
    values: Record = field(default_factory=dict)
    """what NAME.json holds besides"""
    broken: str = ""
    """which rule that must hold did not, and where; ends the command with status 1"""


@dataclass(frozen=True, slots=True)
class Config:
    """A study's set-up file."""

    name: str
    text: str
    values: Mapping[str, Any]
    file: str = ""
    """the user's own; empty: the shipped one"""

    @property
    def where(self) -> str:
        """The file, for messages."""
        return self.file or f"{self.name}.toml"

    @property
    def base(self) -> Setup:
        """The set-up that every case starts from."""
        return setup_from(self.values.get("base", {}), f"{self.where}: $.base")

    def cases(self, table: str = "cases") -> dict[str, Setup]:
        """Named set-ups of one table, each on top of the base."""
        return {
            name: setup_from(given, f"{self.where}: $.{table}.{name}", self.base)
            for name, given in self.values.get(table, {}).items()
        }

    def on(self, setup: Setup, table: str) -> dict[str, Setup]:
        """Named changes of one table, each on top of `setup`."""
        return {
            name: setup_from(given, f"{self.where}: $.{table}.{name}", setup)
            for name, given in self.values.get(table, {}).items()
        }

    def one(self, table: str) -> Setup:
        """The base changed by one table of the file."""
        return setup_from(self.values[table], f"{self.where}: $.{table}", self.base)

    @property
    def published(self) -> Mapping[str, Any]:
        """What the paper prints."""
        return dict(self.values.get("published", {}))


T = TypeVar("T")


def table_of(config: Config, name: str, kind: type[T]) -> T:
    """One table of a set-up as a dataclass's value; a missing or unknown key is refused."""
    given = dict(config.values.get(name, {}))
    known = set(inspect.signature(kind).parameters)
    if set(given) != known:
        wrong = ", ".join(sorted(set(given) ^ known))
        raise ConfigError(f"{config.where}: $.{name} must have the keys {', '.join(sorted(known))}; wrong: {wrong}")
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in given.items()})


def load_config(name: str, path: Path | None = None) -> Config:
    """The set-up beside the study's code, or the user's own in `path`."""
    shipped = Path(__file__).with_name(f"{name}.toml")
    text = read_text(path or shipped)
    values = tables_of(text, path or shipped)
    if path is not None:
        same_tables(values, tables_of(read_text(shipped), shipped), path, shipped)
    config = Config(name, text, values, "" if path is None else str(path))
    for setup in [config.base, *config.cases().values()]:
        if not connected(setup.formation.slots(), setup.range_m):
            raise ConfigError(
                f"{config.where}: the formation is not connected at range_m = {setup.range_m:g} m: "
                "raise range_m or bring the slots closer together"
            )
    return config


def parse_seeds(text: str) -> tuple[int, ...]:
    """Seeds from "0..19", "3" or "0,4,7"; both ends of a range are meant."""
    seeds: list[int] = []
    for part in filter(None, (p.strip() for p in text.split(","))):
        first, dots, last = part.partition("..")
        if not (first.strip().isdigit() and (last.strip().isdigit() if dots else True)):
            raise ConfigError(f"--seeds must look like 0..19 or 0,3,5, got {text!r}")
        seeds += range(int(first), int(last) + 1) if dots else [int(first)]
    if not seeds:
        raise ConfigError(f"--seeds names no seed: give at least one, as in 0..19; got {text!r}")
    return tuple(dict.fromkeys(seeds))


def writable_folder(out: Path) -> Path:
    """The output folder, made if it is missing; a sentence if nothing can be written there."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = out / ".writable"
        probe.write_text("", encoding="utf-8")
        probe.unlink()
    except OSError as error:
        raise ConfigError(
            f"--out {out}: nothing can be written there ({error.strerror}); name another folder"
        ) from error
    return out


def study_module(name: str) -> ModuleType:
    """The code of a study: `piece(config, seed)` and `finish(config, pieces, seeds)`."""
    if name not in STUDIES + FLOWN:
        raise ConfigError(f"there is no study {name!r}; known are {', '.join(STUDIES + FLOWN_STUDIES)} and all")
    return importlib.import_module(f"sim.study.{name}")


def fingerprint(config: Config) -> str:
    """Names a set-up together with the code that runs it: a piece of one is never taken for a piece of another."""
    digest = blake2s(digest_size=8)
    digest.update(config.text.encode())
    if config.name not in FLOWN:
        kernels()
        from sim.swarm.compiled import source_hash

        digest.update(source_hash().encode())
        digest.update(json.dumps(foreign_laws(config.values)).encode())
    module = study_module(config.name)
    for path in (module.__file__, *getattr(module, "SOURCES", ())):
        digest.update(Path(str(path)).read_bytes())
    return digest.hexdigest()


def foreign_laws(values: Any) -> list[Origin]:
    """The laws of other packages that a set-up names, wherever in it."""
    if not isinstance(values, Mapping):
        return []
    name = values.get("law")
    found = {o for v in values.values() for o in foreign_laws(v)}
    if isinstance(name, str) and LAWS.table(name) is not None and (origin := LAWS.origin(name)) is not None:
        found.add(origin)
    return sorted(found)


def _piece(config: Config, seed: int) -> Record:
    return dict(study_module(config.name).piece(config, seed))


def pieces(config: Config, seeds: Sequence[int], out: Path, jobs: int, advance: Callable[[], None]) -> list[Record]:
    """One record per seed, in order; those already finished under the same set-up and code are read back."""
    folder = out / "pieces"
    folder.mkdir(exist_ok=True)
    mark = fingerprint(config)
    paths = {seed: folder / f"{config.name}-{mark}-{seed}.json" for seed in seeds}
    done: dict[int, Record] = {}
    for seed, path in paths.items():
        if path.exists():
            done[seed] = json.loads(path.read_text(encoding="utf-8"))
            advance()
    missing = [seed for seed in seeds if seed not in done]
    if jobs <= 1 or len(missing) <= 1:
        results: Iterable[Record] = (_piece(config, seed) for seed in missing)
        for seed, record in zip(missing, results, strict=True):
            done[seed] = _keep(paths[seed], record)
            advance()
    else:
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            waiting = {pool.submit(_piece, config, seed): seed for seed in missing}
            try:
                for future in as_completed(waiting):
                    seed = waiting[future]
                    done[seed] = _keep(paths[seed], future.result())
                    advance()
            except BaseException:
                # The pool waits for what it has begun, not for all that it was given.
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    return [done[seed] for seed in seeds]


def _keep(path: Path, record: Record) -> Record:
    half = path.with_suffix(f".{os.getpid()}.part")
    half.write_text(json.dumps(record), encoding="utf-8")
    half.replace(path)
    return record


def write_outcome(config: Config, outcome: Outcome, seeds: Sequence[int], out: Path) -> None:
    """NAME.json, a CSV for each table, a PNG and an SVG for each figure."""
    document = {
        "study": config.name,
        "seeds": list(seeds),
        "setup": config.values,
        "foreign": [o._asdict() for o in foreign_laws(config.values)],
        **outcome.values,
        "tables": {t.name: t.rows for t in outcome.tables},
        "findings": outcome.findings,
    }
    (out / f"{config.name}.json").write_text(json.dumps(_plain(document), indent=1) + "\n", encoding="utf-8")
    for table in outcome.tables:
        with (out / f"{table.name}.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, [c.key for c in table.columns], extrasaction="ignore")
            writer.writeheader()
            writer.writerows(_plain(table.rows))
    for figure in outcome.figures:
        figure.drawing.savefig(out / f"{figure.name}.png", dpi=160)
        figure.drawing.savefig(out / f"{figure.name}.svg", metadata={"Date": None})


def _plain(value: Any) -> Any:
    """The value as strict JSON: no numpy, no infinities."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def payload_bytes(run: Run) -> int:
    """Payload of every message of a run, digests included."""
    entries = run.samples_sent - run.messages
    extra = INTENT_EXTRA_BYTES if run.setup.law == "intent" else 0
    table = run.setup.law_table()
    fields = 0 if table is None else len(table.law(run.setup.r0_m).fields)
    told = TOLD_BYTES * fields
    return run.messages * (MESSAGE_BYTES + extra + told + bool(fields)) + entries * (DIGEST_ENTRY_BYTES + extra + told)


def fewer_percent(messages: float, setup: Setup) -> float:
    """How many messages fewer than everybody's 20 a second (%)."""
    return 100.0 * (1.0 - messages / (setup.formation.count * setup.duration_s * 20.0))


def measured(run: Run, after_s: float = 8.0) -> Record:
    """The figures that every study's table may show of one run."""
    setup = run.setup
    gaps = run.intervals_s()
    late = run.time_s > after_s
    v = run.velocity_m_s[:, run.healthy()].mean(axis=1)
    tail = run.time_s > run.time_s[-1] - min(20.0, setup.duration_s / 4)
    formation = run.formation_error_m()
    place = run.place_error_m()
    return {
        "messages": run.messages,
        "fewer_percent": fewer_percent(run.messages, setup),
        "payload_bytes": payload_bytes(run),
        "bytes_fewer_percent": 100.0
        * (1.0 - payload_bytes(run) / (MESSAGE_BYTES * setup.formation.count * setup.duration_s * 20.0)),
        "f_m": float(np.sqrt((formation[late] ** 2).mean())) if late.any() else math.nan,
        "formation_rmse_m": float(np.sqrt((place**2).mean())),
        "formation_rmse_centred_m": float(np.sqrt((formation**2).mean())),
        "velocity_rmse_m_s": float(
            np.sqrt(((run.velocity_m_s - run.reference[:, :, 3:])[:, run.healthy()] ** 2).sum(axis=2).mean())
        ),
        "velocity_consensus_rmse_m_s": float(np.sqrt((run.velocity_error_m_s() ** 2).mean())),
        "mean_interval_s": float(gaps.mean()) if gaps.size else math.nan,
        "minimum_interval_s": float(gaps.min()) if gaps.size else math.nan,
        "speed_end_m_s": float(np.linalg.norm(v[-1])),
        "mean_velocity_off_m_s": float(np.linalg.norm(v[tail].mean(axis=0) - v[0])),
        "mean_velocity_worst_off_m_s": float(np.linalg.norm(v - v[0], axis=1).max()),
        "minimum_distance_m": run.measures["minimum_distance_m"],
        "peak_command_m_s2": run.measures["peak_command_m_s2"],
        "bound_samples": run.measures["bound_samples"],
        "bound_violations": run.measures["bound_violations"],
        "bound_worst_ratio": run.measures["bound_worst_ratio"],
    }


def same_number(setup: Setup, messages: int) -> Setup:
    """A periodic set-up with the period at which all send so many messages, each one's first included."""
    n = setup.formation.count
    return replace(setup, period_s=n * setup.duration_s / max(messages - n, 0.5))


def statistics(values: Sequence[float]) -> Record:
    """Mean, spread (sample standard deviation), median, quartiles and range over seeds."""
    a = np.asarray(values, dtype=float)
    return {
        "mean": float(a.mean()),
        "sd": float(a.std(ddof=1)) if a.size > 1 else 0.0,
        "median": float(np.median(a)),
        "q1": float(np.percentile(a, 25)),
        "q3": float(np.percentile(a, 75)),
        "min": float(a.min()),
        "max": float(a.max()),
    }


def over_seeds(records: Sequence[Record], keys: Iterable[str]) -> Record:
    """Mean of each key under its own name; spread, median, quartiles and range under NAME_sd, NAME_median and so on."""
    row: Record = {}
    for key in keys:
        s = statistics([r[key] for r in records])
        row[key] = s.pop("mean")
        row |= {f"{key}_{name}": value for name, value in s.items()}
    return row


def proportion_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Clopper-Pearson interval of a proportion."""
    tail = (1.0 - confidence) / 2.0
    low = 0.0 if successes == 0 else float(beta.ppf(tail, successes, trials - successes + 1))
    high = 1.0 if successes == trials else float(beta.ppf(1.0 - tail, successes + 1, trials - successes))
    return low, high


def proportion_text(successes: int, trials: int) -> str:
    """As in "none of 20 (95 % interval 0-17 %)"."""
    low, high = proportion_interval(successes, trials)
    count = "none" if successes == 0 else str(successes)
    ends = (f"{100 * x:.2g}" if x < 0.095 else f"{100 * x:.0f}" for x in (low, high))
    return f"{count} of {trials} (95 % interval {'–'.join(ends)} %)"
