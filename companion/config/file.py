"""Reads a fleet.toml and validates it."""

import json
import re
import tomllib
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from companion.config.bounds import t_max_default_s
from companion.config.checks import faults
from companion.config.derived import FleetConfig
from companion.config.messages import sentence
from companion.config.schema import NOTICE_LEAST_S, NOTICE_MOST_S
from companion.errors import ConfigError


def load(path: Path, change: Callable[[dict[str, Any]], None] | None = None) -> FleetConfig:
    """Read and validate a fleet.toml; `change` may edit the raw tables first (command-line overrides).

    Raises ConfigError naming file, place, what came and what is allowed; all faults of the file at once.
    """
    return parse(read_tables(path, change), str(path))


def read_tables(path: Path, change: Callable[[dict[str, Any]], None] | None = None) -> dict[str, Any]:
    """The raw tables of a TOML file, edited by `change`."""
    tables = tables_of(read_text(path), path)
    if change is not None:
        change(tables)
    return tables


def read_text(path: Path) -> str:
    """What a file holds; ConfigError if it cannot be read."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        came = "UTF-16" if content.startswith((BOM_UTF16_LE, BOM_UTF16_BE)) else f"{error.reason} at byte {error.start}"
        raise ConfigError(f"{path}: must be text in UTF-8, got {came}: save it as UTF-8") from error


def parse_text(text: str, path: Path) -> FleetConfig:
    """Validate what the file `path` holds: for whoever keeps the text too, which is then the one that was validated."""
    return parse(tables_of(text, path), str(path))


def tables_of(text: str, path: Path) -> dict[str, Any]:
    """The tables of a TOML text that a file holds; ConfigError if it is none."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: is not valid TOML: {error}") from error


def with_message_period(tables: Mapping[str, Any]) -> Mapping[str, Any]:
    """The tables with `trigger.t_max_s` as it follows from `peers.notice_lost_s` where they leave it out."""
    peers, trigger = tables.get("peers", {}), tables.get("trigger", {})
    notice_s = peers.get("notice_lost_s") if isinstance(peers, Mapping) else None
    if not isinstance(trigger, Mapping) or "t_max_s" in trigger or not isinstance(notice_s, int | float):
        return tables
    if not NOTICE_LEAST_S <= notice_s <= NOTICE_MOST_S:
        return tables  # the validation says so
    return {**tables, "trigger": {**trigger, "t_max_s": t_max_default_s(notice_s)}}


def parse(tables: Mapping[str, Any], name: str) -> FleetConfig:
    """Validate raw tables; `name` is the file's, for messages."""
    try:
        config = FleetConfig.model_validate_json(json.dumps(with_message_period(tables), default=str))
    except ValidationError as error:
        found = list(dict.fromkeys(sentence(e, tables) for e in error.errors()))
        raise _refusal(found, tables, name) from error
    found = faults(config)
    if found:
        raise _refusal(found, tables, name)
    return config


def _refusal(faults: Iterable[str], tables: Mapping[str, Any], name: str) -> ConfigError:
    """All faults of a file, a line each; the places in its list of vehicles with the ids that stand there."""
    vehicles = tables.get("vehicle")
    rows = vehicles if isinstance(vehicles, list) else []

    def ids(fault: str) -> str:
        places = dict.fromkeys(int(k) for k in re.findall(r"\$\.vehicle\[(\d+)\]", fault))
        known = {k: rows[k].get("id") for k in places if k < len(rows) and isinstance(rows[k], dict)}
        said = ", ".join(f"vehicle[{k}] is id {i}" for k, i in known.items() if isinstance(i, int))
        return f" ({said})" if said else ""

    return ConfigError("\n".join(f"{name}: {fault}{ids(fault)}" for fault in faults))
