"""A flight's summary as a person reads it."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from companion.terminal import LINE_MAX, one_line


def show_summary(summary: Mapping[str, Any]) -> None:
    """The flight's figures and whether it met its criteria."""
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column()
    table.add_column()
    for name, value in summary_rows(summary):
        table.add_row(name, Text(one_line(str(value), LINE_MAX)))
    console = Console()
    console.print(table)
    for c in summary["criteria"]:
        if not c["met"]:
            said = one_line(f"not met: {c['what']} {c['limit']}, got {c['value']}")
            console.print(Text(said, style="red"))
    console.print("passed" if summary["passed"] else "not passed", style="green" if summary["passed"] else "red")


def show_side_by_side(names: Sequence[str], summaries: Sequence[Mapping[str, Any]]) -> None:
    """The figures of several flights, a column each; what commands there were is each flight's own."""
    table = Table(box=None, pad_edge=False)
    table.add_column("")
    for name in names:
        table.add_column(one_line(name), overflow="fold")
    columns = [dict(row for row in summary_rows(s) if row[0] not in ("", "commands", "folder")) for s in summaries]
    for name in columns[0]:
        table.add_row(name, *(Text(one_line(str(column[name]), LINE_MAX)) for column in columns))
    table.add_row("", *(Text("passed" if s["passed"] else "not passed") for s in summaries))
    Console().print(table)


def summary_rows(summary: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """The figures as a person reads them, name and value."""
    steady = summary["steady"]
    known = summary["judged_by"] == "truth"
    errors = steady if known else summary["believed"]
    return [
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
            f"{_unit(steady['payload_bytes_per_vehicle_s'], 'B/s')}, "
            f"{_unit(steady['wire_bytes_per_vehicle_s'], 'B/s')}",
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
        *([("folder", summary["folder"])] if "folder" in summary else []),
    ]


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
