"""An empty 50 Hz loop: what lateness costs on this machine before anybody does anything."""

import select
import time
from pathlib import Path

import numpy as np

PERIOD_NS = 20_000_000


def run_reference_loop(path: Path, stop_fd: int) -> None:
    """Wake every 20 ms until `stop_fd` ends; append each wake-up as (UTC ns, lateness ns), two int64, to `path`."""
    deadline_ns = time.monotonic_ns() + PERIOD_NS
    with path.open("wb") as file:
        while True:
            wait_s = max(deadline_ns - time.monotonic_ns(), 0) * 1e-9
            if select.select([stop_fd], [], [], wait_s)[0]:
                return
            now_ns = time.monotonic_ns()
            file.write(np.array([time.time_ns(), now_ns - deadline_ns], np.int64).tobytes())
            deadline_ns += PERIOD_NS * (1 + (now_ns - deadline_ns) // PERIOD_NS)


def read_reference_loop(path: Path) -> np.ndarray:
    """Rows of (UTC ns, lateness ns), shape (n, 2)."""
    data = np.fromfile(path, np.int64) if path.exists() else np.zeros(0, np.int64)
    return data[: len(data) // 2 * 2].reshape(-1, 2)
