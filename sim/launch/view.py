"""What people see of a flight as it goes on: the live table."""

from types import TracebackType
from typing import Self

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from companion.operator.views import Vehicles, phases, status_table
from companion.terminal import one_line, printable
from sim.launch.processes import how_it_ended
from sim.launch.watch import Progress

PLAIN_INTERVAL_S = 5.0


def _nearest(vehicles: Vehicles) -> str:
    """The closest pair as the vehicles believe it."""
    distances = [s.nearest_m for s in vehicles.values() if s is not None and s.nearest_m is not None]
    return f", nearest pair {min(distances):.2f} m" if distances else ""


class FlightView:
    """The live table on a terminal; a line every five seconds elsewhere; nothing when quiet."""

    def __init__(self, quiet: bool) -> None:
        self._console = Console(stderr=True, quiet=quiet)
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

    def show(self, progress: Progress) -> None:
        """Show the fleet as it is now."""
        for i, s in progress.vehicles.items():
            if s is not None:
                sent = s.messages
                then, before = self._sent.setdefault(i, (progress.elapsed_s, sent))
                if progress.elapsed_s - then >= PLAIN_INTERVAL_S:
                    self._rates[i] = (sent - before) / (progress.elapsed_s - then)
                    self._sent[i] = (progress.elapsed_s, sent)
        fleet = progress.vehicles
        head = f"{progress.elapsed_s:6.1f} s  {progress.doing}: {phases(fleet)}{_nearest(fleet)}"
        ended = [f"companion {i}, {how_it_ended(s)}" for i, s in sorted(progress.ended.items())]
        ended += [f"vehicle {i}: {one_line(how)}" for i, how in sorted(progress.autopilots_ended.items())]
        ended += [f"vehicle {i}: {one_line(s.killed)}" for i, s in sorted(fleet.items()) if s and s.killed]
        lines = [head, *([f"ended: {', '.join(ended)}"] if ended else [])]
        if self._live is not None:
            width, height = self._console.size
            table = status_table(progress.vehicles, self._rates, width=width, height=height - 1 - len(lines))
            heads = [Text(printable(line), no_wrap=True, overflow="ellipsis") for line in lines]
            self._live.update(Group(*heads, table), refresh=True)
        elif progress.elapsed_s - self._told_s >= PLAIN_INTERVAL_S or (progress.doing, ended) != self._news:
            self._told_s, self._news = progress.elapsed_s, (progress.doing, ended)
            self._console.print(Text(printable("; ".join(lines))), soft_wrap=True)
