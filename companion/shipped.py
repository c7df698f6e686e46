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


def write_shipped(folder: Path, fleet_text: str) -> list[Path]:
    """Write both files, with this text for the fleet's, to a folder; one that is not there is made.

    ConfigError, and nothing written, if one of the files is there already.
    """
    targets = {
        folder / FLEET_FILE: fleet_text.encode(),
        folder / SERVICE_FILE: shipped(SERVICE_FILE).read_bytes(),
    }
    there = [str(target) for target in targets if target.exists()]
    if there:
        raise ConfigError(f"{', '.join(there)} is there already: name another folder, or move it away")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for target, content in targets.items():
            target.write_bytes(content)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written: {error.strerror}") from error
    return list(targets)
