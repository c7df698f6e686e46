"""What a command line may change of fleet.toml before it is validated: how many vehicles, which legs."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from companion.config.bounds import NOTICE_LOST_S
from companion.config.derived import FleetConfig
from companion.config.file import parse, read_tables
from companion.errors import ConfigError
from companion.shipped import FLEET_FILE, shipped

DEFAULT_FILE = Path("fleet.toml")
LEG_FORM = "hold:S, velocity:N:E:S, turn:DEG_S[:DEG], goto:N:E[:M_S] or none"
LEG_KEYS = {
    "hold": ("duration_s",),
    "velocity": ("north_m_s", "east_m_s", "duration_s"),
    "turn": ("rate_deg_s", "angle_deg"),
    "goto": ("north_m", "east_m", "speed_m_s"),
}
REHEARSAL = "-rehearsal"
NAME_MOST = 32
"""letters of a fleet's name"""
OPTIONAL_LEG_KEYS = frozenset({"angle_deg", "speed_m_s"})


def fleet_tables(
    path: Path, vehicles: int | None = None, change: Callable[[dict[str, Any]], None] | None = None
) -> dict[str, Any]:
    """The raw tables of a fleet.toml with so many vehicles (None: the file's), then edited by `change`."""

    def edit(tables: dict[str, Any]) -> None:
        if vehicles is not None:
            resize(tables, vehicles)
        if change is not None:
            change(tables)

    return read_tables(existing_file(path), edit)


def fleet_config(path: Path, vehicles: int | None = None) -> FleetConfig:
    """A fleet.toml with so many vehicles, validated."""
    return parse(fleet_tables(path, vehicles), str(existing_file(path)))


def existing_file(path: Path) -> Path:
    """fleet.toml of this folder, or the one beside the packages when this folder has none."""
    return shipped(FLEET_FILE) if path == DEFAULT_FILE and not path.exists() else path


def resize(tables: dict[str, Any], count: int) -> None:
    """The first `count` vehicles of the file, and new ones after the last."""
    listed = tables.get("vehicle", [])
    if not isinstance(listed, list) or not all(isinstance(v, dict) for v in listed):
        return  # the validation says what is wrong
    taken = {v.get("id") for v in listed}
    free = (i for i in range(1, 251) if i not in taken)
    tables["vehicle"] = [*listed[:count], *({"id": next(free)} for _ in range(count - len(listed)))]


def on_this_computer(tables: dict[str, Any]) -> None:
    """Give every vehicle this computer's lines and network instead of its own: a hardware file, rehearsed.

    Nobody holds a transmitter here, so none is demanded. The fleet has a name of its own: no verb that is meant for the
    vehicles reaches the rehearsal, nor the other way round.
    """
    fleet = tables.get("fleet")
    if isinstance(fleet, dict) and isinstance(fleet.get("name"), str):
        fleet["name"] = f"{fleet['name'][: NAME_MOST - len(REHEARSAL)]}{REHEARSAL}"
    preflight = tables.setdefault("preflight", {})
    if isinstance(preflight, dict):
        preflight["require_rc"] = False
    peers = tables.setdefault("peers", {})
    if isinstance(peers, dict) and peers.get("network") in NOTICE_LOST_S:
        peers.setdefault("notice_lost_s", NOTICE_LOST_S[peers["network"]])
        peers["network"] = "laptop"
    rows = tables.get("vehicle", [])
    for row in rows if isinstance(rows, list) else []:
        if isinstance(row, dict):
            row.pop("mavlink", None)
            row.pop("zenoh", None)


def plan_legs(text: str) -> list[dict[str, Any]]:
    """Legs from the command line: `hold:10,velocity:1:0:20,turn:6:90,goto:40:0:1.5`, or `none`.

    hold:SECONDS  velocity:NORTH:EAST:SECONDS (m/s)  turn:DEG_PER_S[:DEG]  goto:NORTH:EAST[:M_PER_S] (m)
    """
    return [] if text == "none" else [_leg(part) for part in text.split(",")]


def _leg(part: str) -> dict[str, Any]:
    kind, *values = part.split(":")
    keys = LEG_KEYS.get(kind)
    if keys is None:
        raise ConfigError(f"--plan: leg {part!r} must be one of {LEG_FORM}")
    required = [key for key in keys if key not in OPTIONAL_LEG_KEYS]
    if not len(required) <= len(values) <= len(keys):
        raise ConfigError(f"--plan: leg {part!r} must be {LEG_FORM}")
    try:
        numbers = [float(v) for v in values]
    except ValueError:
        raise ConfigError(f"--plan: leg {part!r} must have numbers after its kind ({LEG_FORM})") from None
    return {"kind": kind, **dict(zip(keys, numbers, strict=False))}
