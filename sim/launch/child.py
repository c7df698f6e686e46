"""A process that does not outlive its launcher: `python -m sim.launch.child PACKAGE ARGUMENTS...`

The launcher holds the writing end of its standard input and writes nothing. Whoever sees that end close finishes by
itself: lands, and says good-bye to its peers. This watches beside it from before the first slow import on, so that a
process that still starts, or hangs, is gone in time as well.
"""

import importlib
import os
import select
import sys
import threading
import time

END_WITHIN_S = 1.6
ABANDONED = 70
"""exit status of a process that did not finish by itself"""


def _watch(fd: int) -> None:
    poll = select.poll()
    poll.register(fd, select.POLLHUP)
    while not any(events & (select.POLLHUP | select.POLLERR) for _, events in poll.poll()):
        pass
    time.sleep(END_WITHIN_S)
    os._exit(ABANDONED)


def main() -> None:
    """Run the command of another package under watch."""
    threading.Thread(target=_watch, args=(sys.stdin.fileno(),), name="launcher watch", daemon=True).start()
    package = sys.argv[1]
    sys.argv = [package, *sys.argv[2:]]
    importlib.import_module(f"{package}.__main__").main()


if __name__ == "__main__":
    main()
