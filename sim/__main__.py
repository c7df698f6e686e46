"""Command `fleet`: a whole fleet on one machine, and the operator's verbs."""

import json
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from companion.config.file import read_tables
from companion.errors import CompanionError, ConfigError, RefusedError

app = typer.Typer(
    no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
    help="A fleet of PX4 vehicles or of stubs: fly it, ask it, command it.",
)  # fmt: skip
FAILED = 1
USAGE_ERROR = 2

FleetFile = Annotated[Path, typer.Option("--fleet", help="The fleet's configuration.")]
Vehicles = Annotated[int | None, typer.Option(min=1, max=250, help="Fly this many, whatever the file lists.")]
OneVehicle = Annotated[int | None, typer.Option(min=1, max=250, help="This vehicle's id alone.")]
Parameters = Annotated[
    list[str] | None, typer.Option(metavar="NAME=VALUE", help="With --autopilot px4: a PX4 parameter, repeatable.")
]
Both = Annotated[
    bool, typer.Option("--both", help="Also where two companions answer as one vehicle: command both of them.")
]
DEFAULT_FILE = Path("fleet.toml")
CROWD_PER_CORE = 8
CROWD_RATE_HZ = 20.0
"""the control rate of a fleet whose companions share one machine, more than CROWD_PER_CORE to each of its cores"""
FAULTS = (
    "gps_lost", "position_frozen", "estimator_reset", "noise", "low_battery", "reboot", "mute", "pilot_takeover",
    "pilot_sticks", "rc_kill", "slow_link",
)  # fmt: skip


def _default_file(path: Path) -> Path:
    """fleet.toml of this folder, or the one beside the packages when this folder has none."""
    shipped = Path(__file__).resolve().parent.parent / "fleet.toml"
    return shipped if path == DEFAULT_FILE and not path.exists() and shipped.exists() else path


def _resize(tables: dict[str, Any], count: int) -> None:
    """The first `count` vehicles of the file, and new ones after the last."""
    listed = tables.get("vehicle", [])
    if not isinstance(listed, list) or not all(isinstance(v, dict) for v in listed):
        return  # the validation says what is wrong
    taken = {v.get("id") for v in listed}
    free = (i for i in range(1, 251) if i not in taken)
    tables["vehicle"] = [*listed[:count], *({"id": next(free)} for _ in range(count - len(listed)))]


def _tables(
    path: Path, vehicles: int | None = None, formation: str | None = None, plan: str | None = None
) -> dict[str, Any]:
    def change(tables: dict[str, Any]) -> None:
        if vehicles is not None:
            _resize(tables, vehicles)
        for table, key, value in (
            ("formation", "shape", formation),
            ("plan", "legs", None if plan is None else plan_legs(plan)),
        ):
            if value is not None and isinstance(tables.setdefault(table, {}), dict):
                tables[table][key] = value

    return read_tables(_default_file(path), change)


def plan_legs(text: str) -> list[dict[str, Any]]:
    """Legs from the command line: `hold:10,velocity:1:0:20,turn:6:90,goto:40:0:1.5`, or `none`.

    hold:SECONDS  velocity:NORTH:EAST:SECONDS (m/s)  turn:DEG_PER_S[:DEG]  goto:NORTH:EAST[:M_PER_S] (m)
    """
    names = {
        "hold": ("duration_s",),
        "velocity": ("north_m_s", "east_m_s", "duration_s"),
        "turn": ("rate_deg_s", "angle_deg"),
        "goto": ("north_m", "east_m", "speed_m_s"),
    }
    optional = {"angle_deg", "speed_m_s"}
    legs: list[dict[str, Any]] = []
    for part in [] if text == "none" else text.split(","):
        kind, *values = part.split(":")
        fields = names.get(kind)
        form = "hold:S, velocity:N:E:S, turn:DEG_S[:DEG], goto:N:E[:M_S] or none"
        if fields is None:
            raise ConfigError(f"--plan: leg {part!r} must be one of {form}")
        required = [f for f in fields if f not in optional]
        if not len(required) <= len(values) <= len(fields):
            raise ConfigError(f"--plan: leg {part!r} must be {form}")
        try:
            numbers = [float(v) for v in values]
        except ValueError:
            raise ConfigError(f"--plan: leg {part!r} must have numbers after its kind ({form})") from None
        legs.append({"kind": kind, **dict(zip(fields, numbers, strict=False))})
    return legs


@app.command()
def up(
    vehicles: Vehicles = None,
    fleet: FleetFile = DEFAULT_FILE,
    formation: Annotated[str | None, typer.Option(help="Shape instead of the file's.")] = None,
    plan: Annotated[
        str | None,
        typer.Option(help="Legs instead of the file's, as velocity:1:0:20,turn:6:90,hold:5 (none: stay in place)."),
    ] = None,
    duration: Annotated[
        float | None, typer.Option("--for", min=1, help="Seconds from take-off to the landing command.")
    ] = None,
    autopilot: Annotated[str, typer.Option(help="What flies: stub, px4 (SITL) or external (runs already).")] = "stub",
    px4: Annotated[Path | None, typer.Option(help="With --autopilot px4: PX4's build folder.")] = None,
    parameter: Parameters = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of gusts, noise and estimator origins.")] = 0,
    calm: Annotated[bool, typer.Option("--calm", help="No gusts and no sensor noise.")] = False,
    gcs: Annotated[
        bool, typer.Option("--gcs", help="Show the stubs to a ground station on UDP 14550 and to PX4's 3D viewer.")
    ] = False,
    scenario: Annotated[
        Path | None, typer.Option(help="Faults of the stubs: a TOML file with tables [[fault]].")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the flight's folder.")] = Path("flights"),
    allow_missing: Annotated[
        bool, typer.Option("--allow-missing", help="Fly without the vehicles that have not come after 15 s.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Only summary.json on standard output.")] = False,
) -> None:
    """Start stub autopilots and companions, take off, form, fly the plan, land, and sum up.

    Ctrl-C lands the fleet. Exit status: 0 the flight met its criteria, 1 it did not, 2 wrong usage or configuration.
    """
    from sim.autopilot.stub_fleet import check_stub_links
    from sim.launch.faults import load_scenario
    from sim.launch.launch import FlightOptions, flight_folder, fly
    from sim.launch.lock import only_flight, refuse_companions
    from sim.launch.px4_instance import check_build, parse_parameters
    from sim.launch.view import FlightView, show_summary

    if autopilot not in ("stub", "px4", "external"):
        raise ConfigError(f"--autopilot must be stub, px4 or external, got {autopilot!r}")
    if (autopilot == "px4") != (px4 is not None):
        raise ConfigError(
            "--autopilot px4 needs --px4 BUILD_DIR (get PX4-Autopilot v1.16 from its project, run "
            "`make px4_sitl_default` and pass build/px4_sitl_default), and --px4 needs --autopilot px4"
        )
    parse_parameters(parameter or ())
    if parameter and px4 is None:
        raise ConfigError("--parameter is for the instances of --autopilot px4")
    if px4 is not None:
        px4 = check_build(px4)
    tables = _tables(fleet, vehicles, formation, plan)
    if calm:
        tables.setdefault("stub", {}).update(position_noise_m=0.0, velocity_noise_m_s=0.0, gust_m_s2=0.0)
    from companion.config.file import parse

    config = parse(tables, fleet.name)
    if len(config.vehicles) > CROWD_PER_CORE * len(os.sched_getaffinity(0)):
        tables.setdefault("limits", {}).setdefault("control_rate_hz", CROWD_RATE_HZ)
        config = parse(tables, fleet.name)
    if autopilot == "stub":
        check_stub_links(config)
    elif gcs or scenario is not None:
        raise ConfigError("--gcs and --scenario are for --autopilot stub: a PX4 speaks to the ground station by itself")
    faults = () if scenario is None else load_scenario(scenario, config)
    interrupted = _interrupts()
    with only_flight(config.fleet.name):
        refuse_companions(config)
        options = FlightOptions(
            flight_folder(out),
            seed,
            duration,
            px4,
            tuple(parameter or ()),
            autopilot == "external",
            gcs,
            faults,
            allow_missing,
        )
        with FlightView(quiet=as_json) as view:
            summary = fly(tables, options, view.show, interrupted, lambda line: typer.echo(line, err=True))
    if as_json:
        typer.echo(json.dumps(summary))
    else:
        show_summary(summary)
    raise typer.Exit(0 if summary["passed"] else FAILED)


def _interrupts() -> Callable[[], bool]:
    """Whether SIGINT or SIGTERM came; the launcher lands its fleet then instead of dying."""
    came: list[int] = []
    for s in (signal.SIGINT, signal.SIGTERM):
        signal.signal(s, lambda number, _: came.append(number))
    return lambda: bool(came)


@app.command()
def stub(
    vehicles: Vehicles = None,
    fleet: FleetFile = DEFAULT_FILE,
    seed: Annotated[int, typer.Option(min=0, help="Seed of gusts, noise and estimator origins.")] = 0,
    truth: Annotated[Path | None, typer.Option(help="File for every vehicle's true motion at 50 Hz.")] = None,
    gcs: Annotated[
        bool, typer.Option("--gcs", help="Speak to a ground station on UDP 14550 and to PX4's 3D viewer too.")
    ] = False,
    launched: Annotated[
        bool, typer.Option("--launched", help="End when standard input closes: for launchers.")
    ] = False,
) -> None:
    """Run stub autopilots alone until interrupted: autopilot i at UDP 14580+i, its companion at 14540+i.

    A vehicle's own `mavlink` URL moves both: the stub sends to that port, from 40 above it (1000 from the eleventh on).
    """
    from companion.config.file import parse
    from sim.autopilot.stub_fleet import check_stub_links, stub_settings
    from sim.autopilot.stubs import run_stubs

    config = parse(_tables(fleet, vehicles), fleet.name)
    check_stub_links(config)
    if not launched:
        for v in config.vehicles:
            typer.echo(f"vehicle {v.id}: system id {v.system_id}, speaks to {v.mavlink}", err=True)
    run_stubs(
        stub_settings(
            config, seed=seed, truth_path=truth, stop_fd=sys.stdin.fileno() if launched else None,
            grace_s=1.3 if launched else 0.0, ground=gcs,
        )
    )  # fmt: skip


@app.command()
def fault(
    vehicle: Annotated[int, typer.Argument(min=1, max=250, help="The vehicle's id.")],
    kind: Annotated[str, typer.Argument(help=", ".join(FAULTS))],
    magnitude: Annotated[float | None, typer.Option(min=0, help="Strength, in the fault's own unit.")] = None,
    duration: Annotated[
        float | None, typer.Option("--for", min=0, help="Seconds that a lasting fault lasts; 0 ends it.")
    ] = None,
    fleet: FleetFile = DEFAULT_FILE,
    vehicles: Vehicles = None,
) -> None:
    """Have a stub autopilot of a running fleet suffer a fault; exit status 1 if it does not answer."""
    from companion.config.file import parse
    from sim.autopilot.faults import Fault, FaultKind
    from sim.launch.faults import order_fault

    if kind not in FAULTS:
        raise ConfigError(f"fault must be one of {', '.join(FAULTS)}, got {kind!r}")
    config = parse(_tables(fleet, vehicles), fleet.name)
    order_fault(config, vehicle, Fault(FaultKind(kind), magnitude, float("inf") if duration is None else duration))
    typer.echo(f"vehicle {vehicle}: {kind}")


@app.command(hidden=True)
def sitl(
    px4: Annotated[Path, typer.Option()],
    truth: Annotated[Path, typer.Option()],
    fleet: FleetFile = DEFAULT_FILE,
    parameter: Parameters = None,
    ready: Annotated[Path | None, typer.Option(help="A file to make once every parameter is read back.")] = None,
) -> None:
    """Run PX4 SITL instances until standard input closes: for launchers."""
    from companion.config.file import parse
    from sim.launch.px4_instance import check_build, parse_parameters
    from sim.launch.sitl import SitlHost, SitlSettings

    config = parse(_tables(fleet), fleet.name)
    parameters = parse_parameters(parameter or ())
    settings = SitlSettings(check_build(px4), truth.parent, truth, sys.stdin.fileno(), parameters, ready)
    SitlHost(config, settings).run(grace_s=1.5)


@app.command(hidden=True)
def reference_loop(out: Annotated[Path, typer.Option()]) -> None:
    """An empty 50 Hz loop, to measure the machine beside a flight; ends when standard input closes."""
    from sim.launch.reference_loop import run_reference_loop

    run_reference_loop(out, sys.stdin.fileno())


@app.command()
def study(
    name: Annotated[
        str,
        typer.Argument(
            help="example1, example2, table3, readings, pareto, faults, scale, theory, all; "
            "or headon, messages, campaign."
        ),
    ],
    seeds: Annotated[
        str | None, typer.Option(help="As in 0..19 (the default) or 0,3,5; without it, all takes 20..39.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for tables, figures and the report.")] = Path("studies"),
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    setup: Annotated[Path | None, typer.Option(help="Your own copy of the study's TOML file.")] = None,
) -> None:
    """Reproduce the paper's results and compare ours: tables, figures, a report. Finished seeds are not run again.

    Needs the extra: pip install 'starling-fleet[study]'.
    """
    from sim.study.run import study as run

    run(name, seeds, out, jobs, setup)


# -- the operator's verbs --------------------------------------------------------------------------------------------


def _operate(fleet: Path, vehicles: int | None, verb: str, act: Callable[[Any], Any], both: bool = False) -> None:
    from companion.config.file import parse
    from companion.io.network import operator_link
    from companion.operator.client import Operator

    config = parse(_tables(fleet, vehicles), fleet.name)
    with operator_link(config) as link:
        operator = Operator(config, link, both=both)
        link.wait_alive(operator.ids, 2.0)
        answers = act(operator)
    typer.echo(f"{answers.sentence(verb)} ({operator.reached})")
    raise typer.Exit(0 if answers.all_accepted else FAILED)


@app.command()
def status(
    fleet: FleetFile = DEFAULT_FILE,
    vehicles: Vehicles = None,
    as_json: Annotated[bool, typer.Option("--json", help="Each vehicle's own account as JSON.")] = False,
) -> None:
    """Each vehicle's account of itself. Exit status 1 if one is silent."""
    from companion.config.file import parse
    from companion.io.network import operator_link
    from companion.operator.client import Operator
    from sim.launch.view import show_status

    config = parse(_tables(fleet, vehicles), fleet.name)
    with operator_link(config) as link:
        operator = Operator(config, link)
        link.wait_alive(operator.ids, 2.0)
        answers = operator.status()
    if as_json:
        typer.echo(json.dumps(answers))
    else:
        typer.echo(operator.reached)
        show_status(answers)
    for sentence in (*operator.left_out, *operator.two_companions):
        typer.echo(sentence, err=True)
    raise typer.Exit(0 if all(s is not None for s in answers.values()) else FAILED)


@app.command()
def preflight(
    fleet: FleetFile = DEFAULT_FILE,
    vehicles: Vehicles = None,
    explain: Annotated[bool, typer.Option("--explain", help="Every check with its value and its limit.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Every check as JSON.")] = False,
) -> None:
    """Whether the fleet may take off: each vehicle's own checks, and what they say compared.

    Exit status: 0 it may, 1 it may not (each fault is named), 2 wrong usage or configuration.
    """
    from companion.config.file import parse
    from companion.io.network import operator_link
    from companion.operator.client import Operator
    from sim.launch.view import show_preflight

    config = parse(_tables(fleet, vehicles), fleet.name)
    with operator_link(config) as link:
        operator = Operator(config, link)
        link.wait_alive(operator.ids, 2.0)
        report = operator.preflight()
    if as_json:
        typer.echo(json.dumps(report.as_json()))
    else:
        show_preflight(report, explain)
    raise typer.Exit(0 if report.fit else FAILED)


@app.command()
def takeoff(fleet: FleetFile = DEFAULT_FILE, vehicles: Vehicles = None) -> None:
    """Arm and climb, after a preflight across the fleet; whoever is at fault is named and nobody takes off."""
    _operate(fleet, vehicles, "take-off", lambda o: o.take_off())


@app.command()
def land(
    fleet: FleetFile = DEFAULT_FILE, vehicles: Vehicles = None, vehicle: OneVehicle = None, both: Both = False
) -> None:
    """Land every vehicle, or one, where it is."""
    _operate(fleet, vehicles, "land", lambda o: o.land(vehicle), both)


@app.command()
def rtl(fleet: FleetFile = DEFAULT_FILE, vehicles: Vehicles = None) -> None:
    """Fly back over the pads, each vehicle over its own, and land there."""
    _operate(fleet, vehicles, "rtl", lambda o: o.rtl(time.time_ns()))


@app.command()
def release(
    fleet: FleetFile = DEFAULT_FILE, vehicles: Vehicles = None, vehicle: OneVehicle = None, both: Both = False
) -> None:
    """Give every vehicle, or one, to the pilot: its companion sends no setpoint, its autopilot holds."""
    _operate(fleet, vehicles, "release", lambda o: o.release(vehicle), both)


@app.command()
def resume(fleet: FleetFile = DEFAULT_FILE, vehicles: Vehicles = None, vehicle: OneVehicle = None) -> None:
    """Steer again what was released, or was in the air when its companion started: it stands, then comes back."""
    _operate(fleet, vehicles, "resume", lambda o: o.resume(vehicle))


@app.command()
def kill(
    fleet: FleetFile = DEFAULT_FILE,
    vehicles: Vehicles = None,
    vehicle: OneVehicle = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
    both: Both = False,
) -> None:
    """Stop the motors of every vehicle, or of one, at once: in the air it falls."""
    whom = "every vehicle" if vehicle is None else f"vehicle {vehicle}"
    if not yes and input(f"{whom} falls from the air. Type kill to do it: ").strip() != "kill":
        raise RefusedError("kill was not confirmed")
    _operate(fleet, vehicles, "kill", lambda o: o.kill(vehicle), both)


@app.command()
def hold(fleet: FleetFile = DEFAULT_FILE, vehicles: Vehicles = None) -> None:
    """Stop the formation where it is."""
    _operate(fleet, vehicles, "hold", lambda o: o.hold(time.time_ns))


@app.command()
def form(
    shape: Annotated[str, typer.Argument(help="v, line, column, circle, grid, spiral, sphere or custom.")],
    fleet: FleetFile = DEFAULT_FILE,
    vehicles: Vehicles = None,
) -> None:
    """Change the formation; its motion goes on."""
    _operate(fleet, vehicles, f"form {shape}", lambda o: o.form(shape, time.time_ns()))


@app.command()
def move(
    velocity: Annotated[
        tuple[float, float, float] | None, typer.Option(metavar="NORTH EAST UP", help="Constant velocity (m/s).")
    ] = None,
    turn: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="DEG_S DEG", help="Turn at a rate (deg/s, positive right) through an angle; 0: for ever."),
    ] = None,
    goto: Annotated[
        tuple[float, float] | None, typer.Option(metavar="NORTH EAST", help="Fly the centre to a point (m).")
    ] = None,
    altitude: Annotated[float | None, typer.Option(min=1, max=500, help="With --goto: altitude (m).")] = None,
    speed: Annotated[float, typer.Option(min=0.1, max=8, help="With --goto: greatest speed (m/s).")] = 1.0,
    fleet: FleetFile = DEFAULT_FILE,
    vehicles: Vehicles = None,
) -> None:
    """Change the formation's motion: one of --velocity, --turn, --goto."""
    from companion.operator.client import turn_leg, velocity_leg

    if sum(x is not None for x in (velocity, turn, goto)) != 1:
        raise ConfigError("fleet move needs exactly one of --velocity, --turn, --goto")
    if turn is not None and turn[0] == 0:
        raise ConfigError("fleet move --turn: the rate must not be 0 deg/s")

    def act(operator: Any) -> Any:
        now_ns = time.time_ns()
        if velocity is not None:
            return operator.move(velocity_leg(*velocity), now_ns)
        if turn is not None:
            return operator.move(turn_leg(turn[0], turn[1] or None), now_ns)
        assert goto is not None
        return operator.goto(*goto, altitude, speed, now_ns)

    _operate(fleet, vehicles, "move", act)


def main() -> None:
    """Entry point: errors that a user can act on end with a sentence, not a traceback."""
    try:
        app(standalone_mode=True)
    except CompanionError as error:
        typer.echo(f"fleet: {error}", err=True)
        raise SystemExit(USAGE_ERROR if isinstance(error, ConfigError) else FAILED) from None


if __name__ == "__main__":
    main()
