"""The commands that read a flight's recordings: `fleet summary`, `fleet report`."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from companion.terminal import tell

FAILED = 1
PAGE = "report.html"

Recordings = Annotated[
    list[Path], typer.Argument(help="Recordings (MCAP), or folders of them: a flight's, a vehicle's.")
]
WhichFlight = Annotated[
    int | None, typer.Option("--flight", min=1, help="Which take-off, from 1; left out: the last one recorded.")
]


def mount(app: typer.Typer) -> None:
    """Add them to a command."""
    app.command()(summary)
    app.command()(report)


def _read(paths: list[Path], number: int | None) -> tuple[Any, dict[str, Any]]:
    """The flight and its figures."""
    from sim.launch.summary.recorded import recorded_flight
    from sim.launch.summary.summarise import summarise

    flight, missing = recorded_flight(paths, number)
    # What companions refused is in their status, not in their recordings.
    return flight, {**summarise(flight), "missing": missing, "takeoff_ns": flight.takeoff_ns, "rejected": None}


def summary(
    paths: Recordings,
    flight: WhichFlight = None,
    as_json: Annotated[bool, typer.Option("--json", help="The figures as JSON.")] = False,
) -> None:
    """Sum up a flight from its companions' recordings, whatever flew: stubs, SITL, or vehicles in the field.

    Exit status: 0 the flight met its criteria, 1 it did not, 2 no recordings, damaged ones, or of different fleets.
    """
    from sim.launch.summary.view import show_summary

    _, figures = _read(paths, flight)
    if as_json:
        typer.echo(json.dumps(figures))
    else:
        show_summary(figures)
    raise typer.Exit(0 if figures["passed"] else FAILED)


def report(
    paths: Recordings,
    flight: WhichFlight = None,
    out: Annotated[
        Path | None, typer.Option(help="The page's file; left out: report.html beside the first recording.")
    ] = None,
) -> None:
    """Draw a flight as one HTML page that needs no network: paths, errors, distances, messages, criteria.

    Exit status: 0 written, whether the flight met its criteria or not, 2 no recordings, or of different fleets.
    """
    from sim.report.page import write_page

    recorded, figures = _read(paths, flight)
    file = out or (paths[0] if paths[0].is_dir() else paths[0].parent) / PAGE
    write_page(recorded, figures, file)
    tell(f"report: {file}")
