"""The table of a fleet as it goes on: redrawn on a terminal, a line every few seconds elsewhere."""

import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Self

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from companion.interrupts import interrupts
from companion.operator.views import Vehicles, phases, status_table
from companion.terminal import one_line, printable

PLAIN_INTERVAL_S = 5.0
ASKED_EVERY_S = 1.0
STOPPED_WITHIN_S = 0.1


class LiveTable:
    """Shows what vehicles say of themselves; nothing when quiet."""

    def __init__(self, *, quiet: bool = False, to_error: bool = False) -> None:
        self._console = Console(stderr=to_error, quiet=quiet)
        # Redrawn when there is news, and by nobody else: a thread less, and no half-drawn table.
        on_terminal = self._console.is_terminal and not quiet
        self._live = Live(console=self._console, auto_refresh=False) if on_terminal else None
        self._sent: dict[int, tuple[float, int]] = {}
        self._rates: dict[int, float] = {}
        self._told_s = -PLAIN_INTERVAL_S
        self._news: tuple[str, list[str]] = ("", [])
        """what was told at once: what is being done, and who has ended"""

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, vehicles: Vehicles, elapsed_s: float, doing: str, news: Sequence[str] = ()) -> None:
        """Show the fleet as it is now; `news` is told at once."""
        for i, s in vehicles.items():
            if s is not None:
                then, before = self._sent.setdefault(i, (elapsed_s, s.messages))
                if elapsed_s - then >= PLAIN_INTERVAL_S:
                    self._rates[i] = (s.messages - before) / (elapsed_s - then)
                    self._sent[i] = (elapsed_s, s.messages)
        ended = [*news, *(f"vehicle {i}: {one_line(s.killed)}" for i, s in sorted(vehicles.items()) if s and s.killed)]
        lines = [f"{elapsed_s:6.1f} s  {doing}: {phases(vehicles)}{_nearest(vehicles)}"]
        lines += [f"ended: {', '.join(ended)}"] if ended else []
        if self._live is not None:
            width, height = self._console.size
            table = status_table(vehicles, self._rates, width=width, height=height - 1 - len(lines))
            heads = [Text(printable(line), no_wrap=True, overflow="ellipsis") for line in lines]
            self._live.update(Group(*heads, table), refresh=True)
        elif elapsed_s - self._told_s >= PLAIN_INTERVAL_S or (doing, ended) != self._news:
            self._told_s, self._news = elapsed_s, (doing, ended)
            self._console.print(Text(printable("; ".join(lines))), soft_wrap=True)


def _nearest(vehicles: Vehicles) -> str:
    """The closest pair as the vehicles believe it."""
    distances = [s.nearest_m for s in vehicles.values() if s is not None and s.nearest_m is not None]
    return f", nearest pair {min(distances):.2f} m" if distances else ""


def watch(ask: Callable[[], Vehicles], name: str) -> None:
    """Show what `ask` returns of a fleet of that name, once a second, until SIGINT or SIGTERM. Main thread only."""
    interrupted = interrupts()
    began_s = time.monotonic()
    with LiveTable() as table:
        while not interrupted():
            asked_s = time.monotonic()
            table.show(ask(), asked_s - began_s, name)
            while not interrupted() and time.monotonic() < asked_s + ASKED_EVERY_S:
                time.sleep(STOPPED_WITHIN_S)
