"""Word that a vehicle's autopilot has ended, left for the launcher in the flight's folder."""

import json
from contextlib import suppress
from pathlib import Path

ENDED_FILE = "autopilots-ended.jsonl"
"""a line [vehicle id, how] for each autopilot that has ended in flight"""


def tell_ended(folder: Path, vehicle_id: int, how: str) -> None:
    """Leave word for the launcher that a vehicle's autopilot has ended."""
    with suppress(OSError), (folder / ENDED_FILE).open("a", encoding="utf-8") as file:
        file.write(json.dumps([vehicle_id, how]) + "\n")


def read_ended(folder: Path) -> dict[int, str]:
    """Vehicle -> how its autopilot has ended, as told so far."""
    try:
        lines = (folder / ENDED_FILE).read_text(encoding="utf-8").splitlines(keepends=True)
    except OSError:
        return {}
    return dict(json.loads(line) for line in lines if line.endswith("\n"))
