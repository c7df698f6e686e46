"""What people see of a flight: the live table, the status, the summary."""

from collections import Counter
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from companion.preflight import Check
from companion.preflight_fleet import Report
from sim.launch import Progress

PLAIN_INTERVAL_S = 5.0


NARROW = 100
"""columns of a terminal below which mode and battery are left out"""
Vehicles = Mapping[int, Mapping[str, Any] | None]
PHASE_STYLES = {
    **dict.fromkeys(("formed", "moving", "holding"), "green"), "apart": "yellow", "released": "red"
}  # fmt: skip


def status_table(
    vehicles: Vehicles, rates: Mapping[int, float] | None = None, *, width: int = 120, height: int | None = None
) -> RenderableType:
    """One row a vehicle, never more than `height` lines; whoever is in trouble is shown first of all."""
    narrow = width < NARROW
    shown = vehicles if height is None or len(vehicles) + 2 <= height else _worst(vehicles, max(height - 3, 1))
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 1 if narrow else 2, 0, 0))
    table.add_column("\nvehicle", justify="right", min_width=7)
    table.add_column("\nphase", min_width=8)
    if not narrow:
        table.add_column("\nmode", min_width=12)
    names = ["slot\nerror m", "neigh-\nbours", "nearest\nm", "messages\n/s", "oldest\ns", "late\nms"]
    for name in names if narrow else [*names, "battery\n%"]:
        table.add_column(name, justify="right", min_width=max(len(part) for part in name.split("\n")))
    table.add_column("\nremarks", no_wrap=True, overflow="ellipsis")
    for i, s in sorted(shown.items()):
        if s is None:
            table.add_row(str(i), Text("silent", style="red"))
            continue
        style = PHASE_STYLES.get(s["phase"], "")
        table.add_row(
            str(i),
            Text(s["phase"], style=style),
            *([] if narrow else [s["mode"].lower()]),
            _number(s["position_error_m"], 2),
            str(s["neighbours"]),
            _number(s["nearest_m"], 2),
            _number(None if rates is None else rates.get(i), 2),
            _number(s["oldest_age_s"], 1),
            _number(s.get("lateness_ms"), 1),
            *([] if narrow else [_number(s["battery_percent"], 0) if s["battery_percent"] >= 0 else "-"]),
            Text("; ".join(_remarks(s)), style="yellow"),
        )
    rest = {i: s for i, s in vehicles.items() if i not in shown}
    return Group(table, Text(f"and {len(rest)} more: {_phases(rest)}")) if rest else table


def _remarks(status: Mapping[str, Any]) -> list[str]:
    waiting = status["phase"] in ("idle", "landed") and not status["armed"]
    rejected = sum(status["rejected"].values())
    return [
        *status["failsafes"],
        *(status["ready"] if waiting else []),
        *([f"{rejected} rejected"] if rejected else []),
    ]


def _worst(vehicles: Vehicles, count: int) -> Vehicles:
    """So many of them: the silent, those with failsafes, those behind the others, then by id."""
    common = Counter(s["phase"] for s in vehicles.values() if s is not None).most_common(1)

    def rank(item: tuple[int, Mapping[str, Any] | None]) -> tuple[int, int]:
        i, s = item
        if s is None:
            return 0, i
        return 1 if s["failsafes"] else 2 if s["phase"] != common[0][0] else 3, i

    return dict(sorted(vehicles.items(), key=rank)[:count])


def _nearest(vehicles: Vehicles) -> str:
    """The closest pair as the vehicles believe it."""
    distances = [s["nearest_m"] for s in vehicles.values() if s is not None and s["nearest_m"] is not None]
    return f", nearest pair {min(distances):.2f} m" if distances else ""


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


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
        self._doing = ""

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
                then, before = self._sent.get(i, (progress.elapsed_s, s["messages"]))
                if progress.elapsed_s - then >= PLAIN_INTERVAL_S:
                    self._rates[i] = (s["messages"] - before) / (progress.elapsed_s - then)
                    self._sent[i] = (progress.elapsed_s, s["messages"])
                else:
                    self._sent.setdefault(i, (progress.elapsed_s, s["messages"]))
        fleet = progress.vehicles
        head = f"{progress.elapsed_s:6.1f} s  {progress.doing}: {_phases(fleet)}{_nearest(fleet)}"
        if progress.ended:
            head += "; ended: " + ", ".join(f"companion {i} (status {s})" for i, s in sorted(progress.ended.items()))
        if self._live is not None:
            width, height = self._console.size
            table = status_table(progress.vehicles, self._rates, width=width, height=height - 2)
            self._live.update(Group(Text(head, no_wrap=True, overflow="ellipsis"), table), refresh=True)
        elif progress.elapsed_s - self._told_s >= PLAIN_INTERVAL_S or progress.doing != self._doing:
            self._told_s, self._doing = progress.elapsed_s, progress.doing
            self._console.print(head, highlight=False, soft_wrap=True)


def _phases(vehicles: Vehicles) -> str:
    counts: dict[str, int] = {}
    for s in vehicles.values():
        name = "silent" if s is None else s["phase"]
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
                Text("met", style="green") if c.met else Text("NOT MET", style="red"),
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
        ("failsafes", "; ".join(summary["failsafes"]) or "none"),
        ("lost companions", ", ".join(str(i) for i in summary["lost"]) or "none"),
        ("rejected", ", ".join(f"{k} {v}" for k, v in summary["rejected"].items()) or "none"),
        ("folder", summary.get("folder", "-")),
    ]
    for name, value in rows:
        table.add_row(name, str(value))
    console = Console()
    console.print(table)
    for c in summary["criteria"]:
        if not c["met"]:
            console.print(f"not met: {c['what']} {c['limit']}, got {c['value']}", style="red", highlight=False)
    console.print("passed" if summary["passed"] else "not passed", style="green" if summary["passed"] else "red")


def _unit(value: Any, unit: str) -> str:
    return "-" if value is None else f"{value} {unit}"


def _pair(p: Mapping[str, Any]) -> str:
    return "-" if p["p50"] is None else f"{p['p50']}, {p['p99']} ms"
