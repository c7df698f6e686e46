"""What people see of a flight: the live table, the status, the summary."""

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Literal, Self

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from companion.operator.preflight import Report
from companion.vehicle.preflight import Check
from sim.launch.processes import how_it_ended
from sim.launch.watch import Progress

PLAIN_INTERVAL_S = 5.0
REMARKS_LEAST = 24
"""columns without which the remarks stand below the table only"""
GAP = 2
Vehicles = Mapping[int, Mapping[str, Any] | None]
PHASE_STYLES = {
    **dict.fromkeys(("formed", "moving", "holding"), "green"), "detached": "yellow",
    **dict.fromkeys(("released", "killed", "silent"), "red"),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Column:
    """One column of the live table."""

    header: str
    width: int
    rank: int
    """of columns for which there is no room, the one of the largest rank is left out first"""
    cell: Callable[[Mapping[str, Any], float | None], str]
    """what it shows of a vehicle's status and its messages a second"""
    justify: Literal["left", "right"] = "right"


COLUMNS = (
    _Column("\nphase", 9, 0, lambda s, _: phase_of(s), "left"),
    _Column("\nmode", 12, 8, lambda s, _: _text(s.get("mode")).lower(), "left"),
    _Column("slot\nerror m", 7, 1, lambda s, _: _number(s.get("position_error_m"), 2)),
    _Column("neigh-\nbours", 6, 6, lambda s, _: _number(s.get("neighbours"), 0)),
    _Column("nearest\nm", 7, 2, lambda s, _: _number(s.get("nearest_m"), 2)),
    _Column("messages\n/s", 8, 5, lambda _, rate: _number(rate, 2)),
    _Column("oldest\ns", 6, 3, lambda s, _: _number(s.get("oldest_age_s"), 1)),
    _Column("late\nms", 6, 4, lambda s, _: _number(s.get("lateness_ms"), 1)),
    _Column("battery\n%", 7, 7, lambda s, _: _number(s.get("battery_percent"), 0, least=0)),
)


def phase_of(status: Mapping[str, Any] | None) -> str:
    """A vehicle's phase as people are told it: "silent" where it says nothing, "killed" whatever its phase."""
    if status is None:
        return "silent"
    return "killed" if status.get("killed") else _text(status.get("phase"))


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
        remarks = Text("; ".join(_remarks(s)) if s is not None else "", style="yellow")
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
        lines.append(Text(f"and {len(rest)} more: {_phases(rest)}", no_wrap=True, overflow="ellipsis"))
    return Group(*lines)


def _text(value: object) -> str:
    """On one line and without control characters, whatever a vehicle says."""
    return " ".join("".join(c if c.isprintable() else " " for c in str(value)).split()) if value is not None else "-"


def _texts(value: object) -> list[str]:
    return [_text(x) for x in value] if isinstance(value, list) else []


def _remarks(status: Mapping[str, Any]) -> list[str]:
    waiting = status.get("phase") in ("idle", "landed") and not status.get("armed")
    counts = status.get("rejected")
    rejected = sum(n for n in counts.values() if isinstance(n, int)) if isinstance(counts, dict) else 0
    return [
        *([_text(status["killed"])] if status.get("killed") else []),
        *_texts(status.get("failsafes")),
        *(_texts(status.get("ready")) if waiting else []),
        *([f"{rejected} rejected"] if rejected else []),
    ]


def _worst(vehicles: Vehicles, count: int) -> Vehicles:
    """So many of them: the silent and killed, those with failsafes, those behind the others, then by id."""
    common = Counter(phase_of(s) for s in vehicles.values() if s is not None).most_common(1)

    def rank(item: tuple[int, Mapping[str, Any] | None]) -> tuple[int, int]:
        i, s = item
        if s is None or s.get("killed"):
            return 0, i
        return 1 if s.get("failsafes") else 2 if phase_of(s) != common[0][0] else 3, i

    return dict(sorted(vehicles.items(), key=rank)[:count])


def _nearest(vehicles: Vehicles) -> str:
    """The closest pair as the vehicles believe it."""
    told = [None if s is None else s.get("nearest_m") for s in vehicles.values()]
    distances = [d for d in told if isinstance(d, int | float)]
    return f", nearest pair {min(distances):.2f} m" if distances else ""


def _number(value: object, digits: int, least: float = -math.inf) -> str:
    return f"{value:.{digits}f}" if isinstance(value, int | float) and value >= least else "-"


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
            sent = None if s is None else s.get("messages")
            if isinstance(sent, int):
                then, before = self._sent.setdefault(i, (progress.elapsed_s, sent))
                if progress.elapsed_s - then >= PLAIN_INTERVAL_S:
                    self._rates[i] = (sent - before) / (progress.elapsed_s - then)
                    self._sent[i] = (progress.elapsed_s, sent)
        fleet = progress.vehicles
        head = f"{progress.elapsed_s:6.1f} s  {progress.doing}: {_phases(fleet)}{_nearest(fleet)}"
        ended = [f"companion {i}, {how_it_ended(s)}" for i, s in sorted(progress.ended.items())]
        ended += [f"vehicle {i}: {how}" for i, how in sorted(progress.autopilots_ended.items())]
        lines = [head, *([f"ended: {', '.join(ended)}"] if ended else [])]
        if self._live is not None:
            width, height = self._console.size
            table = status_table(progress.vehicles, self._rates, width=width, height=height - 1 - len(lines))
            heads = [Text(line, no_wrap=True, overflow="ellipsis") for line in lines]
            self._live.update(Group(*heads, table), refresh=True)
        elif progress.elapsed_s - self._told_s >= PLAIN_INTERVAL_S or (progress.doing, ended) != self._news:
            self._told_s, self._news = progress.elapsed_s, (progress.doing, ended)
            self._console.print("; ".join(lines), highlight=False, soft_wrap=True, markup=False)


def _phases(vehicles: Vehicles) -> str:
    counts: dict[str, int] = {}
    for s in vehicles.values():
        name = phase_of(s)
        counts[name] = counts.get(name, 0) + 1
    return ", ".join(f"{n} {name}" for name, n in counts.items())


def show_status(vehicles: Vehicles) -> None:
    """The status of a fleet, once."""
    console = Console()
    console.print(status_table(vehicles, width=console.width))


def show_preflight(report: Report, explain: bool) -> None:
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
                str(c.vehicle) if c.vehicle else "fleet", c.name, _value(c), c.limit,
                Text("met", style="green") if c.passed else Text("NOT MET", style="red"),
            )  # fmt: skip
        console.print(table)
    for fault in report.faults:
        console.print(fault, style="red", highlight=False, soft_wrap=True, markup=False)
    fit = f"fit for take-off: {len(report.checks)} checks met"
    console.print(fit if report.fit else f"not fit for take-off: {len(report.faults)} of {len(report.checks)} checks")


def _value(check: Check) -> str:
    if check.value is None:
        return "-"
    return f"{check.value:g}" if isinstance(check.value, float) else str(check.value)


def show_summary(summary: Mapping[str, Any]) -> None:
    """The flight's figures and whether it met its criteria."""
    steady = summary["steady"]
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column()
    table.add_column()
    rows = [
        ("vehicles", summary["vehicles"]),
        ("formed after", _unit(summary["formed_after_s"], "s")),
        ("minimum distance", _unit(summary["minimum_distance_m"], "m")),
        ("formation error, rms", _unit(steady["formation_error_rms_m"], f"m over {steady['seconds']} s")),
        ("velocity error, rms", _unit(steady["velocity_error_rms_m_s"], "m/s")),
        ("centroid from plan, rms", _unit(steady["centroid_error_rms_m"], "m")),
        ("messages a vehicle", _unit(steady["messages_per_vehicle_hz"], "/s")),
        ("fewer than at 20 Hz", _unit(steady["reduction_vs_20hz_percent"], "%")),
        (
            "payload, wire a vehicle",
            f"{steady['payload_bytes_per_vehicle_s']}, {steady['wire_bytes_per_vehicle_s']} B/s",
        ),
        ("sensor to setpoint p50, p99", _pair(summary["latency_ms"])),
        ("loop lateness p50, p99", _pair(summary["loop_lateness_ms"])),
        ("empty loop's p50, p99", _pair(summary["reference_lateness_ms"])),
        ("CPU a tick", _unit(summary["cpu_per_tick_ms"], "ms")),
        ("longest setpoint gap", _unit(summary["setpoint_gap_max_s"], "s")),
        ("fastest touchdown", _unit(summary["touchdown_max_m_s"], "m/s")),
        ("flown without", _of_vehicles(summary.get("missing", {}))),
        ("killed", _of_vehicles(summary["killed"])),
        ("failsafes", "; ".join(summary["failsafes"]) or "none"),
        ("not recorded", _of_vehicles(summary["unrecorded"])),
        ("lost companions", ", ".join(str(i) for i in summary["lost"]) or "none"),
        ("lost autopilots", _of_vehicles(summary["autopilots_lost"])),
        *(("commands" if k == 0 else "", _command(c)) for k, c in enumerate(summary["commands"])),
        ("rejected", ", ".join(f"{k} {v}" for k, v in summary["rejected"].items()) or "none"),
        ("folder", summary.get("folder", "-")),
    ]
    for name, value in rows:
        table.add_row(name, Text(str(value)))
    console = Console()
    console.print(table)
    for c in summary["criteria"]:
        if not c["met"]:
            console.print(f"not met: {c['what']} {c['limit']}, got {c['value']}", style="red", highlight=False)
    console.print("passed" if summary["passed"] else "not passed", style="green" if summary["passed"] else "red")


def _of_vehicles(said: Mapping[int, str]) -> str:
    return "; ".join(f"vehicle {i}: {how}" for i, how in said.items()) or "none"


def _command(c: Mapping[str, Any]) -> str:
    parts = [f"{c['at_s']:.1f} s {c['verb']} by {_text(c['issuer'])}: accepted by {len(c['accepted'])}"]
    parts += [f"vehicle {i} refused: {_text(why)}" for i, why in c["refused"].items()]
    if c["unanswered"]:
        parts.append(f"no answer: vehicle {', '.join(map(str, c['unanswered']))}")
    return "; ".join(parts)


def _unit(value: Any, unit: str) -> str:
    return "-" if value is None else f"{value} {unit}"


def _pair(p: Mapping[str, Any]) -> str:
    return "-" if p["p50"] is None else f"{p['p50']}, {p['p99']} ms"
