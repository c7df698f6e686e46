"""One companion as a process: signals, the garbage collector, the interpreter's switching, around the loop."""

import gc
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import version
from pathlib import Path

from companion.config import FleetConfig
from companion.io.loop import Companion, RunSettings
from companion.terminal import one_line

SWITCH_INTERVAL_S = 0.0005
"""how long the recorder or a network callback may keep the interpreter from the loop"""


def fly_vehicle(
    config: FleetConfig, vehicle_id: int, file: Path, text: str, *, record: Path | None, stop_fd: int | None,
    signing_key: Path | None = None,
) -> int:  # fmt: skip
    """Fly until SIGTERM, SIGINT or the end of `stop_fd`; returns the exit status. Main thread only.

    `text` is what the file of the configuration held when it was read; `signing_key` goes before the file's own.
    """

    def log(line: str) -> None:
        # Not through a buffer, which on a full disk would fail again at the end and change the exit status.
        os.write(1, log_line(vehicle_id, line))

    key = signing_key or config.by_id(vehicle_id).signing_key_beside(file)
    settings = RunSettings(vehicle_id, record, stop_fd, log, key, file)
    companion = Companion(config, settings, {"config": text, "version": product_version()})
    if stop_fd is None:
        log(_started(config, vehicle_id, record))
    try:
        return run_in_process(companion)
    finally:
        companion.close()


def _started(config: FleetConfig, vehicle_id: int, record: Path | None) -> str:
    """What somebody who started it by hand, or reads the journal, wants to know first."""
    one = config.by_id(vehicle_id)
    where = "" if one.zenoh is None else f" at {one.zenoh}"
    return (
        f"started: waits for its autopilot on {one.mavlink}, for its peers of fleet {config.fleet.name} on the "
        f"{config.peers.network} network{where}; {'records nothing' if record is None else f'records into {record}'}"
    )


def log_line(vehicle_id: int, note: str) -> bytes:
    """A note as the log has it."""
    return f"vehicle {vehicle_id}: {one_line(note)}\n".encode()


@cache
def product_version() -> str:
    """Of this package, as installed."""
    return version("starling-fleet")


def run_in_process(companion: Companion) -> int:
    """The loop with this process at its service."""
    # What is there by now stays: the collector need not look through it in flight.
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    with _signals(companion.ask_to_stop):
        return companion.run()


@contextmanager
def _signals(stop: Callable[[], None]) -> Iterator[None]:
    previous = {s: signal.signal(s, lambda *_: stop()) for s in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for s, handler in previous.items():
            signal.signal(s, handler)
