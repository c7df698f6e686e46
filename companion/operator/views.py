"""What an operator sees on a terminal: each vehicle's status, and the rows of preflight."""

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from companion.operator.preflight import FleetReport
from companion.terminal import one_line, printable
from companion.wire.operator import Check, Status

REMARKS_LEAST = 24
"""columns without which the remarks stand below the table only"""
REMARKS_MAX = 4000
"""characters of one vehicle's remarks"""
GAP = 2
Vehicles = Mapping[int, Status | None]
PHASE_STYLES = {
    **dict.fromkeys(("formed", "moving", "holding"), "green"), "detached": "yellow",
    **dict.fromkeys(("released", "killed", "silent"), "red"),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Column:
    """One column of the status table."""

    header: str
    width: int
    rank: int
    """of columns for which there is no room, the one of the largest rank is left out first"""
    cell: Callable[[Status, float | None], str]
    """what it shows of a vehicle's status and its messages a second"""
    justify: Literal["left", "right"] = "right"


COLUMNS = (
    _Column("\nphase", 9, 0, lambda s, _: phase_of(s), "left"),
    _Column("\nmode", 12, 8, lambda s, _: one_line(s.mode).lower(), "left"),
    _Column("slot\nerror m", 7, 1, lambda s, _: _number(s.position_error_m, 2)),
    _Column("neigh-\nbours", 6, 6, lambda s, _: _number(s.neighbours, 0)),
    _Column("nearest\nm", 7, 2, lambda s, _: _number(s.nearest_m, 2)),
    _Column("messages\n/s", 8, 5, lambda _, rate: _number(rate, 2)),
    _Column("packets\n/s", 7, 9, lambda s, _: _number(s.packets_hz, 1)),
    _Column("oldest\ns", 6, 3, lambda s, _: _number(s.oldest_age_s, 1)),
    _Column("late\nms", 6, 4, lambda s, _: _number(s.lateness_ms, 1)),
    _Column("battery\n%", 7, 7, lambda s, _: _number(s.battery_percent, 0, least=0)),
)


def phase_of(status: Status | None) -> str:
    """A vehicle's phase as people are told it: "silent" where it says nothing, "killed" whatever its phase."""
    if status is None:
        return "silent"
    return "killed" if status.killed else one_line(status.phase)


def status_table(
    vehicles: Vehicles, rates: Mapping[int, float] | None = None, *, width: int = 120, height: int | None = None
) -> RenderableType:
    """One row a vehicle, never more than `height` lines; whoever is in trouble is shown first of all.

    Every column has a width of its own and those that find no room are left out, so that nothing that a vehicle says
    can take the others' place. Remarks that do not fit beside the rest stand below it, whole if there are no limits.
    """
    id_width = max(7, *(len(str(i)) for i in vehicles), 0) if vehicles else 7
    shown = vehicles if height is None or len(vehicles) + 2 <= height else _worst(vehicles, max(height - 3, 1))
    columns = list(COLUMNS)
    while columns and id_width + sum(GAP + c.width for c in columns) > width:
        columns.remove(max(columns, key=lambda c: c.rank))
    room = width - id_width - sum(GAP + c.width for c in columns) - GAP
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, GAP, 0, 0))
    table.add_column("\nvehicle", justify="right", width=min(id_width, width))
    for c in columns:
        table.add_column(c.header, justify=c.justify, width=c.width, no_wrap=True, overflow="ellipsis")
    if room >= REMARKS_LEAST:
        table.add_column("\nremarks", width=room, no_wrap=True, overflow="ellipsis")
    below: list[Text] = []
    for i, s in sorted(shown.items()):
        cells = [Text(str(i))]
        for c in columns:
            text = c.cell(s, None if rates is None else rates.get(i)) if s is not None else ""
            style = PHASE_STYLES.get(phase_of(s), "") if c.rank == 0 else ""
            cells.append(Text(phase_of(s) if s is None and c.rank == 0 else text, style=style))
        remarks = Text(_remarks(s) if s is not None else "", style="yellow")
        if room >= REMARKS_LEAST:
            cells.append(remarks)
        table.add_row(*cells)
        if remarks.cell_len > (room if room >= REMARKS_LEAST else 0):
            below.append(Text.assemble(f"{i}: ", remarks))
    rest = {i: s for i, s in vehicles.items() if i not in shown}
    lines: list[RenderableType] = [table]
    left = None if height is None else height - 2 - len(shown) - bool(rest)
    for line in below if left is None else below[: max(left, 0)]:
        line.no_wrap, line.overflow = left is not None, "fold" if left is None else "ellipsis"
        lines.append(line)
    if rest:
        lines.append(Text(f"and {len(rest)} more: {phases(rest)}", no_wrap=True, overflow="ellipsis"))
    return Group(*lines)


def _remarks(status: Status) -> str:
    waiting = status.phase in ("idle", "landed") and not status.armed
    rejected = sum(status.rejected.values())
    flees = ["flees"] if status.flees else []
    said = [*([status.killed] if status.killed else []), *flees, *status.failsafes, *(status.ready if waiting else [])]
    return one_line("; ".join([*said, *([f"{rejected} rejected"] if rejected else [])]), REMARKS_MAX)


def _worst(vehicles: Vehicles, count: int) -> Vehicles:
    """So many of them: the silent and killed, those with failsafes, those behind the others, then by id."""
    common = Counter(phase_of(s) for s in vehicles.values() if s is not None).most_common(1)

    def rank(item: tuple[int, Status | None]) -> tuple[int, int]:
        i, s = item
        if s is None or s.killed:
            return 0, i
        return 1 if s.failsafes else 2 if phase_of(s) != common[0][0] else 3, i

    return dict(sorted(vehicles.items(), key=rank)[:count])


def _number(value: float | None, digits: int, least: float = -math.inf) -> str:
    return f"{value:.{digits}f}" if value is not None and value >= least else "-"


def phases(vehicles: Vehicles) -> str:
    """How many are in which phase."""
    counts: dict[str, int] = {}
    for s in vehicles.values():
        name = phase_of(s)
        counts[name] = counts.get(name, 0) + 1
    return ", ".join(f"{n} {name}" for name, n in counts.items())


def show_status(vehicles: Vehicles) -> None:
    """The status of a fleet, once."""
    console = Console()
    console.print(status_table(vehicles, width=console.width))


def show_preflight(report: FleetReport, explain: bool) -> None:
    """The faults as sentences, and every row if asked for."""
    console = Console()
    if explain:
        table = Table(box=None, pad_edge=False, header_style="bold")
        table.add_column("vehicle", justify="right")
        table.add_column("check", no_wrap=True)
        table.add_column("value", justify="right", overflow="fold")
        table.add_column("limit", overflow="fold")
        table.add_column("")
        for c in report.checks:
            table.add_row(
                str(c.vehicle) if c.vehicle else "fleet", *(Text(one_line(t)) for t in (c.name, _value(c), c.limit)),
                Text("see below", style="yellow") if c.passed and c.warns else
                Text("met", style="green") if c.passed else Text("NOT MET", style="red"),
            )  # fmt: skip
        console.print(table)
    for fault in report.faults:
        console.print(Text(printable(fault), style="red"), soft_wrap=True)
    for warning in report.warnings:
        console.print(Text(printable(f"warning: {warning}"), style="yellow"), soft_wrap=True)
    fit = f"fit for take-off: {len(report.checks)} checks met"
    console.print(fit if report.fit else f"not fit for take-off: {len(report.faults)} of {len(report.checks)} checks")


def _value(check: Check) -> str:
    if check.value is None:
        return "-"
    return f"{check.value:g}" if isinstance(check.value, float) else str(check.value)
