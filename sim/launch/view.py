"""What people see of a flight: the live table, and the summary."""

from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from companion.operator.views import Vehicles, phases, status_table
from companion.terminal import LINE_MAX, one_line, printable
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


def show_summary(summary: Mapping[str, Any]) -> None:
    """The flight's figures and whether it met its criteria."""
    steady = summary["steady"]
    known = summary["judged_by"] == "truth"
    errors = steady if known else summary["believed"]
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column()
    table.add_column()
    rows = [
        ("vehicles", summary["vehicles"]),
        ("judged by", summary["judged_by"]),
        ("formed after", _unit(summary["formed_after_s"], "s")),
        (
            "its shape, its place after",
            f"{_unit(summary['shape_formed_after_s'], 's')}, {_unit(summary['place_taken_after_s'], 's')}",
        ),
        ("minimum distance", _unit((summary if known else errors)["minimum_distance_m"], "m")),
        ("formation error, rms", _unit(errors["formation_error_rms_m"], f"m over {steady['seconds']} s")),
        ("the same, estimates' errors unlike", _unit(summary["estimates"]["formation_error_decorrelated_rms_m"], "m")),
        ("velocity error, rms", _unit(errors["velocity_error_rms_m_s"], "m/s")),
        ("centroid from plan, rms", _unit(errors["centroid_error_rms_m"], "m")),
        ("messages a vehicle", _unit(steady["messages_per_vehicle_hz"], "/s")),
        ("fewer than at 20 Hz", _unit(steady["reduction_vs_20hz_percent"], "%")),
        (
            "packets a vehicle",
            f"{_unit(steady['packets_per_vehicle_hz'], '/s')} ({steady['network']} network), "
            f"{_unit(steady['packets_reduction_vs_20hz_percent'], '%')} fewer than at 20 Hz at least",
        ),
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
        ("rejected", _counts(summary["rejected"])),
        ("folder", summary.get("folder", "-")),
    ]
    for name, value in rows:
        table.add_row(name, Text(one_line(str(value), LINE_MAX)))
    console = Console()
    console.print(table)
    for c in summary["criteria"]:
        if not c["met"]:
            said = one_line(f"not met: {c['what']} {c['limit']}, got {c['value']}")
            console.print(Text(said, style="red"))
    console.print("passed" if summary["passed"] else "not passed", style="green" if summary["passed"] else "red")


def _counts(counts: Mapping[str, int] | None) -> str:
    if counts is None:
        return "not known"
    return ", ".join(f"{k} {v}" for k, v in counts.items()) or "none"


def _of_vehicles(said: Mapping[int, str]) -> str:
    return "; ".join(f"vehicle {i}: {how}" for i, how in said.items()) or "none"


def _command(c: Mapping[str, Any]) -> str:
    parts = [f"{c['at_s']:.1f} s {c['verb']} by {one_line(c['issuer'])}: accepted by {len(c['accepted'])}"]
    parts += [f"vehicle {i} refused: {one_line(why)}" for i, why in c["refused"].items()]
    if c["unanswered"]:
        parts.append(f"no answer: vehicle {', '.join(map(str, c['unanswered']))}")
    return "; ".join(parts)


def _unit(value: Any, unit: str) -> str:
    return "-" if value is None else f"{value} {unit}"


def _pair(p: Mapping[str, Any]) -> str:
    return "-" if p["p50"] is None else f"{p['p50']}, {p['p99']} ms"
