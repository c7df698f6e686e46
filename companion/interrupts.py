"""SIGINT and SIGTERM as a question, for whoever has to finish something before it ends."""

import signal
from collections.abc import Callable


def interrupts() -> Callable[[], bool]:
    """Whether SIGINT or SIGTERM came since; they no longer end the process. Main thread only.

    A process that is started in the background ignores SIGINT unless it says otherwise: this does.
    """
    came: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda n, _: came.append(n))
    return lambda: bool(came)
