"""The commands that read a flight's recordings: `fleet summary`, `fleet report`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from companion.errors import CompanionError, ConfigError
from companion.terminal import tell

if TYPE_CHECKING:
    from sim.launch.summary.flight import Flight

FAILED = 1
PAGE = "report.html"

Recordings = Annotated[
    list[Path], typer.Argument(help="Recordings (MCAP), or folders of them: a flight's, a vehicle's.")
]
WhichFlight = Annotated[
    int | None, typer.Option("--flight", min=1, help="Which take-off, from 1; left out: the last one recorded.")
]


log_app = typer.Typer(no_args_is_help=True, help="Recordings: what they hold, and as tables for other tools.")


def mount(app: typer.Typer) -> None:
    """Add them to a command."""
    app.command()(summary)
    app.command()(report)
    app.command()(compare)
    app.add_typer(log_app, name="log")


def _read(paths: list[Path], number: int | None) -> "tuple[Flight, dict[str, Any]]":
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


def draw(flight: "Flight", figures: dict[str, Any], folder: Path) -> None:
    """The page of a flight that has just ended; that it cannot be drawn is told, and is no fault of the flight."""
    from sim.report.page import write_page

    try:
        write_page(flight, figures, folder / PAGE)
    except CompanionError as error:
        tell(f"no report: {error}", error=True)
    else:
        tell(f"report: {folder / PAGE}")


def compare(
    paths: Annotated[list[Path], typer.Argument(help="Two or more flights: a folder, or a recording, of each.")],
    as_json: Annotated[bool, typer.Option("--json", help="Each flight's figures as JSON.")] = False,
) -> None:
    """Set the figures of flights side by side, the last take-off of each.

    Exit status: 0 shown, 2 no recordings, or fewer than two flights.
    """
    from sim.launch.summary.view import show_side_by_side

    if len(paths) < 2:
        raise ConfigError(f"compare needs two flights or more, got {len(paths)}")
    figures = [_read([path], None)[1] for path in paths]
    if as_json:
        typer.echo(json.dumps({str(path): one for path, one in zip(paths, figures, strict=True)}))
    else:
        show_side_by_side([str(path) for path in paths], figures)


@log_app.command("info")
def log_info(paths: Recordings) -> None:
    """What each recording holds: vehicle, time, entries of each channel, what is missing."""
    from sim.launch.summary.recorded import recordings_of
    from sim.report.export import info

    for path in recordings_of(paths):
        for what, value in info(path):
            tell(f"{what:18}  {value}")


@log_app.command("export")
def log_export(
    paths: Recordings,
    out: Annotated[Path, typer.Option(help="Folder for ticks.csv, messages.csv and events.csv.")],
    flight: WhichFlight = None,
) -> None:
    """Write a flight's ticks, messages and events as CSV, one row each, times since take-off and UTC."""
    from sim.report.export import write_tables

    recorded, _ = _read(paths, flight)
    for path in write_tables(recorded, out):
        tell(f"written: {path}")
