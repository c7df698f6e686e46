"""The operator's verbs on the command line: `fleet land` beside the simulator's commands, `companion operator land`
where the flight part alone is installed.

A verb asks every vehicle, prints one line of what they said, and ends with 0 if all took it, 1 if one refused or is
silent, or where the network cannot be opened, 2 for wrong usage or configuration. Whatever costs time is imported
inside of a verb: help is read often.
"""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from companion.errors import ConfigError, RefusedError
from companion.terminal import tell

if TYPE_CHECKING:
    from companion.operator.client import Answers, Operator

FAILED = 1
FOUND_WITHIN_S = 2.0
"""how long a verb waits for companions of whom nothing is known yet"""
PANEL = "Command and ask a running fleet"

FleetFile = Annotated[Path, typer.Option("--fleet", help="The fleet's configuration: the same file as the vehicles'.")]
OperatedFile = Annotated[
    Path | None,
    typer.Option(
        "--fleet", help="The vehicles' file; left out: that of the flight on this computer, else ./fleet.toml."
    ),
]
Vehicles = Annotated[int | None, typer.Option(min=1, max=250, help="So many vehicles, whatever the file lists.")]
OneVehicle = Annotated[int | None, typer.Option(min=1, max=250, help="This vehicle's id alone; without it, all.")]
Both = Annotated[
    bool, typer.Option("--both", help="Also where two companions answer as one vehicle: command both of them.")
]
FLEET_TOML = Path("fleet.toml")


def mount(app: typer.Typer) -> None:
    """Add every verb to a command, and `init`."""
    app.command()(init)
    for verb in (status, preflight, takeoff, land, rtl, hold, form, move, scare, release, resume, kill):
        app.command(rich_help_panel=PANEL)(verb)


def init(
    folder: Annotated[Path, typer.Argument(help="Where the files go.")] = Path(),
    vehicles: Annotated[int | None, typer.Option(min=1, max=250, help="So many vehicles; left out: ten.")] = None,
    name: Annotated[str | None, typer.Option(help="The fleet's name: a-z, 0-9 and -.")] = None,
    network: Annotated[
        str, typer.Option(help="laptop, or field: a computer and an address for each vehicle.")
    ] = "laptop",
    first_address: Annotated[
        str | None,
        typer.Option(help="With --network field: IPv4 address of the first vehicle (10.0.0.11); the others' follow."),
    ] = None,
    line: Annotated[
        str | None,
        typer.Option(help="With --network field: each computer's line (serial:///dev/autopilot:921600)."),
    ] = None,
) -> None:
    """Write a commented fleet.toml and the companion's systemd unit, to be edited. Asks nothing, overwrites nothing.

    Example: init my-fleet --vehicles 6 --network field --first-address 192.168.1.11
    """
    from companion.config.new_file import new_fleet_text
    from companion.shipped import write_shipped

    text = new_fleet_text(vehicles, name, network, first_address, line)
    for path in write_shipped(folder, text):
        tell(f"written: {path}")


@contextmanager
def connected(fleet: Path | None, vehicles: int | None, *, both: bool = False) -> "Iterator[Operator]":
    """An operator whose network is open."""
    from companion.config.overrides import fleet_config
    from companion.io.network import operator_link
    from companion.operator.client import Operator
    from companion.operator.flying import operated_file

    config = fleet_config(operated_file(fleet), vehicles)
    with operator_link(config) as link:
        operator = Operator(config, link, both=both)
        link.wait_alive(operator.ids, FOUND_WITHIN_S)
        yield operator


def command(
    fleet: Path | None, vehicles: int | None, verb: str, act: "Callable[[Operator], Answers]", *, both: bool = False
) -> None:
    """Command the fleet, tell what it said, and end."""
    with connected(fleet, vehicles, both=both) as operator:
        answers = act(operator)
    tell(f"{answers.sentence(verb)} ({operator.roster.reached})")
    raise typer.Exit(0 if answers.all_accepted else FAILED)


def status(
    fleet: OperatedFile = None,
    vehicles: Vehicles = None,
    as_json: Annotated[bool, typer.Option("--json", help="Each vehicle's own account as JSON.")] = False,
    watched: Annotated[bool, typer.Option("--watch", help="Once a second, until Ctrl-C.")] = False,
) -> None:
    """Each vehicle's account of itself: phase, slot error, neighbours, battery, failsafes.

    Exit status 1 if one is silent or cannot be read; 0 where it was watched.
    """
    if watched and as_json:
        raise ConfigError("status needs --watch or --json, got both")
    with connected(fleet, vehicles) as operator:
        if watched:
            from companion.operator.live import watch

            watch(operator.status, operator.config.fleet.name)
            return
        statuses = operator.status()
    roster = operator.roster
    if as_json:
        from companion.wire.operator import as_json as plain

        typer.echo(json.dumps({i: None if s is None else plain(s) for i, s in statuses.items()}))
    else:
        from companion.operator.views import show_status

        tell(roster.reached)
        show_status(statuses)
    for sentence in (*roster.left_out, *roster.two_companions):
        tell(sentence, error=True)
    raise typer.Exit(0 if all(s is not None for s in statuses.values()) else FAILED)


def preflight(
    fleet: OperatedFile = None,
    vehicles: Vehicles = None,
    explain: Annotated[bool, typer.Option("--explain", help="Every check with its value and its limit.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Every check as JSON.")] = False,
) -> None:
    """Whether the fleet may take off: each vehicle's own checks, and what they say compared.

    Exit status: 0 it may, 1 it may not (each fault is named), 2 wrong usage or configuration.
    """
    with connected(fleet, vehicles) as operator:
        report = operator.preflight()
    if as_json:
        typer.echo(json.dumps(report.as_json()))
    else:
        from companion.operator.views import show_preflight

        show_preflight(report, explain)
    raise typer.Exit(0 if report.fit else FAILED)


def takeoff(fleet: OperatedFile = None, vehicles: Vehicles = None) -> None:
    """Arm and climb, after a preflight across the fleet; whoever is at fault is named and nobody takes off."""
    command(fleet, vehicles, "take-off", lambda o: o.take_off())


def land(fleet: OperatedFile = None, vehicles: Vehicles = None, vehicle: OneVehicle = None, both: Both = False) -> None:
    """Land every vehicle, or one, where it is."""
    command(fleet, vehicles, "land", lambda o: o.land(vehicle), both=both)


def rtl(fleet: OperatedFile = None, vehicles: Vehicles = None) -> None:
    """Fly back over the pads, each vehicle over its own, and land there."""
    command(fleet, vehicles, "rtl", lambda o: o.rtl(time.time_ns()))


def hold(fleet: OperatedFile = None, vehicles: Vehicles = None) -> None:
    """Stop the formation where it is; it stays there until it is commanded on."""
    command(fleet, vehicles, "hold", lambda o: o.hold(time.time_ns))


def form(
    shape: Annotated[str, typer.Argument(help="v, line, column, circle, grid, spiral, sphere or custom.")],
    fleet: OperatedFile = None,
    vehicles: Vehicles = None,
) -> None:
    """Change the formation; its motion goes on. Example: form line."""
    command(fleet, vehicles, f"form {shape}", lambda o: o.form(shape, time.time_ns()))


def move(
    velocity: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="NORTH EAST UP", help="Constant velocity (m/s) until commanded on; UP must be 0."),
    ] = None,
    turn: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="DEG_S DEG", help="Turn at a rate (deg/s, positive right) through an angle; 0: for ever."),
    ] = None,
    goto: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="NORTH EAST", help="Fly the centre to a point (m from the fleet origin) and stop."),
    ] = None,
    altitude: Annotated[float | None, typer.Option(min=1, max=500, help="With --goto: altitude (m).")] = None,
    speed: Annotated[float, typer.Option(min=0.1, max=8, help="With --goto: greatest speed (m/s).")] = 1.0,
    free: Annotated[
        bool,
        typer.Option("--free", help="No shared motion: the vehicles agree on one. With --vehicle: forget its wish."),
    ] = False,
    vehicle: Annotated[
        list[int] | None,
        typer.Option(min=1, max=250, help="Tell this vehicle alone, and again for others: the rest follow unasked."),
    ] = None,
    fleet: OperatedFile = None,
    vehicles: Vehicles = None,
) -> None:
    """Change the formation's motion: one of --velocity, --turn, --goto, --free.

    With --vehicle only those named know it, in a fleet that flies without a shared motion.
    Examples: move --velocity 1 0 0; move --turn 6 90; move --goto 40 0 --speed 1.5; move --vehicle 3 --velocity 1 0 0.
    """
    from companion.operator.client import turn_leg, velocity_leg

    ways = (("velocity", velocity), ("turn", turn), ("goto", goto), ("free", free))
    given = [f"--{name}" for name, value in ways if value]
    if len(given) != 1:
        came = " and ".join(given) or "none"
        raise ConfigError(f"move needs exactly one of --velocity, --turn, --goto, --free, got {came}")
    if turn is not None and turn[0] == 0:
        raise ConfigError("move --turn: the rate must not be 0 deg/s, got 0; to stop the formation, use hold")
    if goto is None and altitude is not None:
        raise ConfigError(f"move --altitude belongs to --goto, got it with {given[0]}")
    if goto is not None and vehicle:
        raise ConfigError("move --goto is for all: a place is shared, and with --vehicle nobody shares one")

    def act(operator: "Operator") -> "Answers":
        now_ns = time.time_ns()
        if goto is None:
            leg = velocity_leg(*velocity) if velocity else turn_leg(turn[0], turn[1] or None) if turn else None
            if vehicle:
                return operator.wish(leg, vehicle)
            return operator.free(now_ns) if leg is None else operator.move(leg, now_ns)
        return operator.goto(*goto, altitude, speed, now_ns)

    command(fleet, vehicles, "move", act)


def scare(
    at: Annotated[
        tuple[float, float],
        typer.Option(metavar="NORTH EAST", help="Where the threat is now (m from the fleet origin), 10 000 m at most."),
    ],
    velocity: Annotated[
        tuple[float, float],
        typer.Option(metavar="NORTH EAST", help="How it goes on (m/s), 30 m/s at most each way; left out: it stands."),
    ] = (0.0, 0.0),
    radius: Annotated[
        float, typer.Option(min=1, max=50, help="Who is nearer than this to its way of the next 2 s flees (m).")
    ] = 10.0,
    lasts: Annotated[float, typer.Option("--for", min=0.5, max=60, help="For so long it is there (s).")] = 10.0,
    fleet: OperatedFile = None,
    vehicles: Vehicles = None,
) -> None:
    """Have vehicles flee a point, in a fleet that flies without a shared motion.

    Those near it fly away from its way; the others see no threat and follow what these do. Once it has gone they come
    back into formation. Fence, distances and speed limits hold as ever. To end it at once: hold.
    Examples: scare --at 0 0; scare --at -40 5 --velocity 6 0 --radius 12 --for 15.
    """
    from companion.wire.operator import THREAT_PLACE_MAX_M, THREAT_SPEED_MAX_M_S, Scare

    for name, pair, most, unit in (
        ("at", at, THREAT_PLACE_MAX_M, "m"), ("velocity", velocity, THREAT_SPEED_MAX_M_S, "m/s"),
    ):  # fmt: skip
        if not all(abs(x) <= most for x in pair):
            came = " ".join(f"{x:g}" for x in pair)
            raise ConfigError(f"scare --{name}: each number must be within {most:g} {unit}, got {came}")

    def act(operator: "Operator") -> "Answers":
        now_ns = time.time_ns()
        threat = Scare(
            begins_ns=now_ns, north_m=at[0], east_m=at[1], north_m_s=velocity[0], east_m_s=velocity[1],
            radius_m=radius, lasts_s=lasts,
        )  # fmt: skip
        return operator.scare(threat, now_ns)

    command(fleet, vehicles, "scare", act)


def release(
    fleet: OperatedFile = None, vehicles: Vehicles = None, vehicle: OneVehicle = None, both: Both = False
) -> None:
    """Give every vehicle, or one, to the pilot: its companion sends no setpoint, its autopilot holds."""
    command(fleet, vehicles, "release", lambda o: o.release(vehicle), both=both)


def resume(fleet: OperatedFile = None, vehicles: Vehicles = None, vehicle: OneVehicle = None) -> None:
    """Steer again what was released, or was in the air when its companion started: it stands, then comes back."""
    command(fleet, vehicles, "resume", lambda o: o.resume(vehicle))


def kill(
    fleet: OperatedFile = None,
    vehicles: Vehicles = None,
    vehicle: OneVehicle = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
    both: Both = False,
) -> None:
    """Stop the motors of every vehicle, or of one, at once: in the air it falls. Asks first."""
    whom = "every vehicle" if vehicle is None else f"vehicle {vehicle}"
    if not yes and _typed(f"{whom} falls from the air. Type kill to do it: ") != "kill":
        raise RefusedError("kill was not confirmed: type kill when it asks, or give --yes")
    command(fleet, vehicles, "kill", lambda o: o.kill(vehicle), both=both)


def _typed(question: str) -> str:
    """A line from the terminal; empty where there is none."""
    try:
        return input(question).strip()
    except EOFError:
        return ""
