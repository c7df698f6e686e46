"""One companion as a process: signals, the garbage collector, the interpreter's switching, around the loop."""

import gc
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from companion.config import FleetConfig
from companion.io.loop import Companion, RunSettings

SWITCH_INTERVAL_S = 0.0005
"""how long the recorder or a network callback may keep the interpreter from the loop"""


def run_companion(config: FleetConfig, settings: RunSettings, metadata: dict[str, str]) -> int:
    """Fly until SIGTERM, SIGINT or the launcher's end; returns the exit status. Main thread only."""
    companion = Companion(config, settings, metadata)
    try:
        return run_in_process(companion)
    finally:
        companion.close()


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
