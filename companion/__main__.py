"""Command `companion`: one vehicle's companion process."""

import json
import sys
from dataclasses import asdict
from pathlib import Path
from time import process_time
from typing import Annotated

import typer

from companion.errors import CompanionError, libraries_of
from companion.operator import verbs
from companion.terminal import tell, tolerate_any_encoding

app = typer.Typer(
    no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, help="One vehicle's companion process."
)
operator_app = typer.Typer(no_args_is_help=True, help="Command and ask a running fleet, without the simulator.")
verbs.mount(operator_app)
app.add_typer(operator_app, name="operator")
DIFFERENT = 1
"""a replay that differs, a check that is not met"""


@app.command()
def run(
    vehicle: Annotated[int, typer.Option(min=1, max=250, help="This vehicle's id in fleet.toml.")],
    fleet: Annotated[Path, typer.Option(help="The fleet's configuration.")] = Path("fleet.toml"),
    record: Annotated[Path | None, typer.Option(help="MCAP file for every input and output.")] = None,
    launched: Annotated[
        bool, typer.Option("--launched", help="End (and land) when standard input closes: for launchers.")
    ] = False,
) -> None:
    """Fly one vehicle: read its autopilot, hear and tell its peers, send setpoints. Ctrl-C lands it and ends.

    Exit status: 0 ended with the vehicle landed or landing, 1 its line, network or recording could not be opened,
    2 wrong usage or configuration, 3 ended while the autopilot had not confirmed landing, 4 could do nothing any more
    (a fault of ours; the autopilot's failsafe has the vehicle).
    """
    from companion.config.file import parse_text, read_text
    from companion.io.process import fly_vehicle

    text = read_text(fleet)
    config = parse_text(text, fleet)
    stop_fd = sys.stdin.fileno() if launched else None
    raise typer.Exit(fly_vehicle(config, vehicle, fleet, text, record=record, stop_fd=stop_fd))


@app.command()
def check(
    vehicle: Annotated[int, typer.Option(min=1, max=250, help="This vehicle's id in fleet.toml.")],
    fleet: Annotated[Path, typer.Option(help="The fleet's configuration.")] = Path("fleet.toml"),
    seconds: Annotated[float, typer.Option(min=1, max=600, help="How long to listen to the autopilot.")] = 6.0,
    folder: Annotated[Path, typer.Option(help="Where recordings will go.")] = Path(),
    as_json: Annotated[bool, typer.Option("--json", help="Every row as JSON.")] = False,
) -> None:
    """Look the companion computer over: link, autopilot and its parameters, clock, network, disk. Flies nothing.

    Needs the vehicle's link for itself: stop its companion first. Exit status: 0 all met, 1 a row is not met, 2 wrong
    usage or configuration.
    """
    from companion.config import load
    from companion.io.check import hardware_checks
    from companion.wire.operator import unmet

    config = load(fleet)
    rows = []
    for row in hardware_checks(config, config.by_id(vehicle), seconds, folder):
        rows.append(row)
        if not as_json:
            value = "-" if row.value is None else row.value
            tell(f"{'ok' if row.passed else 'FAULT':5}  {row.name:20}  {value!s:>20}  {row.limit}")
    faults = unmet(rows)
    if as_json:
        typer.echo(json.dumps({"fit": not faults, "checks": [asdict(r) for r in rows]}))
    else:
        for fault in faults:
            tell(fault.message)
    raise typer.Exit(DIFFERENT if faults else 0)


@app.command()
def replay(
    file: Annotated[Path, typer.Argument(help="A companion's recording (MCAP).")],
) -> None:
    """Run the agent on a recording's inputs and compare its outputs byte for byte.

    Needs the extra replay. Exit status: 0 the same, 1 different, or entries are missing (the first is shown), 2 no
    recording, or a damaged one.
    """
    with libraries_of("replay"):
        from companion.io.replay import replay_file

    began_s = process_time()
    result = replay_file(file)
    spent_s = process_time() - began_s
    tell(result.sentence())
    if result.same and result.ticks:
        tell(f"{1e3 * spent_s / result.ticks:.2f} ms of CPU a control tick, reading and decoding included")
    raise typer.Exit(0 if result.same else DIFFERENT)


def main() -> None:
    """Entry point: errors that a user can act on end with a sentence, not a traceback."""
    tolerate_any_encoding()
    try:
        app(standalone_mode=True)
    except CompanionError as error:
        tell(f"companion: {error}", error=True)
        raise SystemExit(error.exit_status) from None


if __name__ == "__main__":
    main()
