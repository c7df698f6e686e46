"""Command `companion`: one vehicle's companion process."""

import json
import sys
from pathlib import Path
from time import process_time
from typing import Annotated

import typer

from companion.about import COMMAND, with_version
from companion.errors import CompanionError, ConfigError, libraries_of
from companion.operator import verbs
from companion.terminal import tell, tolerate_any_encoding

app = typer.Typer(help="One vehicle's companion process.", **COMMAND)
app.callback()(with_version)
operator_app = typer.Typer(no_args_is_help=True, help="Command and ask a running fleet, without the simulator.")
verbs.mount(operator_app)
app.add_typer(operator_app, name="operator")
signing_app = typer.Typer(no_args_is_help=True, help="Keys by which a vehicle's MAVLink link is signed.")
app.add_typer(signing_app, name="signing")
SigningKey = Annotated[
    Path | None, typer.Option("--signing-key", help="File of the link's key, before fleet.toml's signing_key.")
]
DIFFERENT = 1
"""a replay that differs, a check that is not met"""


@app.command()
def run(
    vehicle: Annotated[int, typer.Option(min=1, max=250, help="This vehicle's id in fleet.toml.")],
    fleet: Annotated[Path, typer.Option(help="The fleet's configuration.")] = Path("fleet.toml"),
    record: Annotated[Path | None, typer.Option(help="MCAP file for every input and output.")] = None,
    signing_key: SigningKey = None,
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
    raise typer.Exit(fly_vehicle(config, vehicle, fleet, text, record=record, stop_fd=stop_fd, signing_key=signing_key))


@app.command()
def check(
    vehicle: Annotated[int, typer.Option(min=1, max=250, help="This vehicle's id in fleet.toml.")],
    fleet: Annotated[Path, typer.Option(help="The fleet's configuration.")] = Path("fleet.toml"),
    seconds: Annotated[float, typer.Option(min=1, max=600, help="How long to listen to the autopilot.")] = 6.0,
    folder: Annotated[Path, typer.Option(help="Where recordings will go.")] = Path(),
    signing_key: SigningKey = None,
    as_json: Annotated[bool, typer.Option("--json", help="Every row as JSON.")] = False,
) -> None:
    """Look the companion computer over: link, autopilot and its parameters, clock, network, disk. Flies nothing.

    Needs the vehicle's link for itself: stop its companion first. Exit status: 0 all met, 1 a row is not met, 2 wrong
    usage or configuration.
    """
    from companion.config import load
    from companion.io.check import hardware_checks
    from companion.operator.rows import show_rows

    config = load(fleet)
    one = config.by_id(vehicle)
    rows = hardware_checks(config, one, seconds, folder, signing_key or one.signing_key_beside(fleet))
    raise typer.Exit(0 if show_rows(rows, as_json) else DIFFERENT)


@signing_app.command("make")
def signing_make(file: Annotated[Path, typer.Argument(help="The key's new file.")]) -> None:
    """Write a new random key, readable by this user alone; a file that is there is left as it is."""
    from companion.io.signing_key import make_key

    make_key(file)
    tell(f"{file}: a new key. `companion signing give --vehicle N --signing-key {file}` has the autopilot learn it")


@signing_app.command("give")
def signing_give(
    vehicle: Annotated[int, typer.Option(min=1, max=250, help="The vehicle's id in fleet.toml.")],
    fleet: Annotated[Path, typer.Option(help="The fleet's configuration.")] = Path("fleet.toml"),
    signing_key: SigningKey = None,
    old: Annotated[Path | None, typer.Option(help="File of the key that the autopilot has now, to replace it.")] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask whether the link may be trusted.")] = False,
) -> None:
    """Have the autopilot sign, and demand signatures, by a key (SETUP_SIGNING). Disarmed only, over a cable.

    The key travels in the clear: whoever hears this link has it. Exit status 1 if the autopilot does not sign by it.
    """
    from companion.config import load
    from companion.io.signing_setup import give_key

    config = load(fleet)
    one = config.by_id(vehicle)
    key_file = signing_key or one.signing_key_beside(fleet)
    if key_file is None:
        raise ConfigError(f"vehicle {vehicle} names no signing_key in {fleet}, and no --signing-key is given")
    if not yes and not typer.confirm(f"The key goes over {one.mavlink} in the clear. Is it a cable that nobody taps?"):
        raise typer.Exit(DIFFERENT)
    tell(give_key(config, one, key_file, old))


@app.command("px4-params")
def px4_params(
    file: Annotated[Path, typer.Argument(help="The file to write, as px4.params.")],
    px4: Annotated[str, typer.Option(help="PX4's version: 1.16, 1.17, 1.18 or main.")],
    fleet: Annotated[Path, typer.Option(help="The fleet's configuration.")] = Path("fleet.toml"),
) -> None:
    """Write the PX4 parameters that this fleet wants of each vehicle, as a file that QGroundControl loads."""
    from companion.config import load
    from companion.vehicle.autopilot.px4_params_file import params_file
    from companion.vehicle.autopilot.px4_versions import version_named

    lines = list(params_file(load(fleet), version_named(px4)))
    try:
        file.write_text("\n".join((*lines, "")), encoding="utf-8")
    except OSError as error:
        raise CompanionError(f"cannot write {file}: {error.strerror}") from error
    tell(f"{file}: {sum(not line.startswith('#') for line in lines)} parameters for PX4 {px4}, with reasons")


@app.command()
def replay(
    file: Annotated[Path, typer.Argument(help="A companion's recording (MCAP).")],
    config: Annotated[
        Path | None, typer.Option(help="Another fleet file: what would its law, trigger and limits have said?")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="With --config: the differences as JSON.")] = False,
) -> None:
    """Run the agent on a recording's inputs and compare its outputs byte for byte.

    With --config an agent of other settings sees the same inputs, and the differences are summed up: messages by cause,
    setpoints, failsafes. The vehicle flew by its own settings: this compares decisions and predicts no flight.
    Needs the extra replay. Exit status: 0 the same, 1 different, or entries are missing (the first is shown), 2 no
    recording, or a damaged one.
    """
    if as_json and config is None:
        raise ConfigError("replay --json belongs to --config FILE")
    with libraries_of("replay"):
        from companion.io.replay import replay_file
        from companion.io.what_if import replay_with

    if config is not None:
        compared = replay_with(file, config)
        if as_json:
            typer.echo(json.dumps(compared.as_json()))
        else:
            for line in compared.sentences():
                tell(line)
        return
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
