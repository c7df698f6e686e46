"""A companion whose law breaks on SIGUSR1: from then on it flies north at a speed, whatever plan and peers say.

`python broken_companion.py FLEET_FILE VEHICLE_ID SPEED_M_S`; all but the law is the real process, the filter included.
"""

import signal
import sys
from pathlib import Path

from companion.config import load
from companion.core.frames import Ned
from companion.io.loop import Companion, RunSettings
from companion.io.process import run_in_process
from sim.study.broken_law import BrokenLaw


def main() -> int:
    file, vehicle_id, speed_m_s = Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
    config = load(file)
    companion = Companion(config, RunSettings(vehicle_id, stop_fd=sys.stdin.fileno()), {})
    broken = companion.agent.law = BrokenLaw(companion.agent.law)

    def break_law(*_: object) -> None:
        broken.velocity_ned_m_s = Ned(speed_m_s, 0.0, 0.0)

    signal.signal(signal.SIGUSR1, break_law)
    try:
        return run_in_process(companion)
    finally:
        companion.close()


if __name__ == "__main__":
    sys.exit(main())
