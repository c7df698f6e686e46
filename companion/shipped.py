"""Files that come with the package: the shipped fleet.toml and the systemd unit.

In a checkout they stand where they are edited; an installed wheel has them among its data files.
"""

import sys
from pathlib import Path

from companion.errors import ConfigError

FLEET_FILE = "fleet.toml"
SERVICE_FILE = "starling-companion@.service"
_FOLDERS = {FLEET_FILE: "", SERVICE_FILE: "deploy"}


def shipped(name: str) -> Path:
    """Where a shipped file is; ConfigError if this installation lacks it."""
    packages = Path(__file__).resolve().parents[1]
    installed = Path("share", "starling-fleet", name)
    for path in (packages / _FOLDERS[name] / name, packages / installed, Path(sys.prefix) / installed):
        if path.exists():
            return path
    raise ConfigError(f"{name} did not come with this installation; install the package anew")


def write_shipped(folder: Path) -> list[Path]:
    """Write both files to a folder; ConfigError, and nothing written, if one is there already."""
    if not folder.is_dir():
        raise ConfigError(f"{folder} is not a folder")
    targets = {folder / name: shipped(name) for name in _FOLDERS}
    there = [str(target) for target in targets if target.exists()]
    if there:
        raise ConfigError(f"{', '.join(there)} is there already: name another folder, or move it away")
    try:
        for target, source in targets.items():
            target.write_bytes(source.read_bytes())
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written: {error.strerror}") from error
    return list(targets)
