"""Command `fleet`: a whole fleet on one machine, and the operator's verbs (`companion.operator.verbs`)."""

import json
import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from companion.about import COMMAND, with_version
from companion.errors import CompanionError, ConfigError, MissingLibraryError, libraries_of
from companion.interrupts import interrupts
from companion.operator import verbs
from companion.operator.verbs import FAILED, FLEET_TOML, FleetFile, OperatedFile, Vehicles
from companion.terminal import tell, tolerate_any_encoding
from sim.autopilot.faults import Fault, FaultKind
from sim.report import commands as recorded
from sim.study import FLOWN_STUDIES, STUDIES

app = typer.Typer(help="A fleet of PX4 vehicles or of stubs: fly it, ask it, command it.", **COMMAND)
app.callback()(with_version)

Parameters = Annotated[
    list[str] | None, typer.Option(metavar="NAME=VALUE", help="With --autopilot px4: a PX4 parameter, repeatable.")
]
CROWD_PER_CORE = 8
CROWD_RATE_HZ = 20.0
"""the control rate of a fleet whose companions share one machine, more than CROWD_PER_CORE to each of its cores"""


@app.command()
def up(
    vehicles: Vehicles = None,
    fleet: FleetFile = FLEET_TOML,
    formation: Annotated[str | None, typer.Option(help="Shape instead of the file's.")] = None,
    plan: Annotated[
        str | None,
        typer.Option(help="Legs instead of the file's, as velocity:1:0:20,turn:6:90,hold:5 (none: stay in place)."),
    ] = None,
    duration: Annotated[
        float | None, typer.Option("--for", min=1, help="Seconds from take-off to the landing command.")
    ] = None,
    autopilot: Annotated[str, typer.Option(help="What flies: stub, px4 (SITL) or external (runs already).")] = "stub",
    px4: Annotated[
        Path | None, typer.Option(help="With --autopilot px4: its build folder, or /opt/px4; else looked for.")
    ] = None,
    parameter: Parameters = None,
    logs: Annotated[
        bool, typer.Option("--logs", help="With --autopilot px4: keep each PX4's flight log (ULog, 25 MB a minute).")
    ] = False,
    first_instance: Annotated[
        int | None,
        typer.Option(min=0, max=200, help="PX4 instance number of the first vehicle: for a second fleet beside one."),
    ] = None,
    rehearse: Annotated[
        bool, typer.Option("--rehearse", help="Fly a hardware file here, by this computer's lines and network.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of gusts, noise and estimator origins.")] = 0,
    calm: Annotated[bool, typer.Option("--calm", help="No gusts, no wind and no sensor noise.")] = False,
    gcs: Annotated[
        bool, typer.Option("--gcs", help="Show the stubs to a ground station on UDP 14550 and to PX4's 3D viewer.")
    ] = False,
    scenario: Annotated[
        Path | None, typer.Option(help="Faults of autopilots and companions: a TOML file with tables \\[[fault]].")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the flight's folder.")] = Path("flights"),
    allow_missing: Annotated[
        bool, typer.Option("--allow-missing", help="Fly without the vehicles that have not come after 15 s.")
    ] = False,
    report: Annotated[bool, typer.Option(help="Write the flight's page, report.html; with --json none is.")] = True,
    as_json: Annotated[bool, typer.Option("--json", help="Only summary.json on standard output.")] = False,
) -> None:
    """Start stub autopilots and companions, take off, form, fly the plan, land, and sum up.

    Ctrl-C lands the fleet. Exit status: 0 the flight met its criteria, 1 it did not, 2 wrong usage or configuration.
    """
    from companion.config.checks import refuse_shared_lines
    from companion.config.file import parse
    from companion.config.overrides import existing_file, fleet_tables, on_this_computer, plan_legs
    from sim.autopilot.stub_fleet import check_stub_links
    from sim.launch.faults import load_scenario
    from sim.launch.launch import FlightOptions, flight_folder, fly
    from sim.launch.lock import only_flight, refuse_companions
    from sim.launch.px4_build import find_build
    from sim.launch.px4_instance import parse_parameters
    from sim.launch.summary.view import show_summary
    from sim.launch.view import FlightView

    if autopilot not in ("stub", "px4", "external"):
        raise ConfigError(f"--autopilot must be stub, px4 or external, got {autopilot!r}")
    if rehearse and autopilot == "external":
        raise ConfigError("--rehearse is for stubs and SITL: vehicles that run already are no rehearsal")
    if px4 is not None and autopilot != "px4":
        raise ConfigError(f"--px4 needs --autopilot px4, got --autopilot {autopilot}")
    parse_parameters(parameter or ())
    if parameter and autopilot != "px4":
        raise ConfigError("--parameter is for the instances of --autopilot px4")
    if logs and autopilot != "px4":
        raise ConfigError("--logs is for the instances of --autopilot px4: companions record whatever flies")
    if autopilot == "px4":
        px4 = find_build(px4)

    def change(tables: dict[str, Any]) -> None:
        if rehearse:
            on_this_computer(tables)
        for table, key, value in (
            ("formation", "shape", formation),
            ("plan", "legs", None if plan is None else plan_legs(plan)),
            ("launch", "first_instance", first_instance),
        ):
            if value is not None and isinstance(tables.setdefault(table, {}), dict):
                tables[table][key] = value

    file = existing_file(fleet)
    tables = fleet_tables(file, vehicles, change)
    for row in tables.get("vehicle", ()):
        if isinstance(row, dict) and isinstance(row.get("signing_key"), str):
            # The flight's own copy of the file lies elsewhere.
            row["signing_key"] = str((file.parent / row["signing_key"]).resolve())
    if calm:
        tables.setdefault("stub", {}).update(
            position_noise_m=0.0, velocity_noise_m_s=0.0, gust_m_s2=0.0, wind_north_m_s=0.0, wind_east_m_s=0.0
        )
    config = parse(tables, str(file))
    if len(config.vehicles) > CROWD_PER_CORE * len(os.sched_getaffinity(0)):
        tables.setdefault("limits", {}).setdefault("control_rate_hz", CROWD_RATE_HZ)
        config = parse(tables, str(file))
    refuse_shared_lines(config)
    if autopilot == "stub":
        check_stub_links(config)
    elif gcs:
        raise ConfigError("--gcs is for --autopilot stub: a PX4 speaks to the ground station by itself")
    elif scenario is not None and autopilot == "external":
        raise ConfigError("--scenario is for --autopilot stub or px4: nobody here can harm what runs elsewhere")
    faults = () if scenario is None else load_scenario(scenario, config)
    interrupted = interrupts()
    with only_flight(config.fleet.name):
        refuse_companions(config)
        options = FlightOptions(
            flight_folder(out), seed, duration, px4, tuple(parameter or ()), autopilot == "external", gcs, faults,
            allow_missing, logs=logs,
        )  # fmt: skip
        if rehearse:
            where = options.folder / "fleet.toml"
            tell(f"rehearsed as fleet {config.fleet.name}: verbs reach it with --fleet {where}", error=True)
        with FlightView(quiet=as_json) as view:
            flown = fly(tables, options, view.show_progress, interrupted, lambda line: tell(line, error=True))
    if as_json:
        typer.echo(json.dumps(flown.summary))
    else:
        show_summary(flown.summary)
        if report:
            recorded.draw(*flown, options.folder)
    raise typer.Exit(0 if flown.summary["passed"] else FAILED)


@app.command()
def stub(
    vehicles: Vehicles = None,
    fleet: FleetFile = FLEET_TOML,
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
    from companion.config.checks import refuse_shared_lines
    from companion.config.overrides import fleet_config
    from sim.autopilot.stub_fleet import check_stub_links, stub_settings
    from sim.autopilot.stubs import run_stubs

    config = fleet_config(fleet, vehicles)
    refuse_shared_lines(config)
    check_stub_links(config)
    if not launched:
        for v in config.vehicles:
            tell(f"vehicle {v.id}: system id {v.system_id}, speaks to {v.mavlink}", error=True)
    run_stubs(
        stub_settings(
            config, seed=seed, truth_path=truth, stop_fd=sys.stdin.fileno() if launched else None,
            grace_s=1.3 if launched else 0.0, ground=gcs, folder=fleet.parent,
        )
    )  # fmt: skip


@app.command()
def fault(
    vehicle: Annotated[int, typer.Argument(min=1, max=250, help="The vehicle's id.")],
    kind: Annotated[str, typer.Argument(help=", ".join(FaultKind))],
    magnitude: Annotated[float | None, typer.Option(min=0, help="Strength, in the fault's own unit.")] = None,
    duration: Annotated[
        float | None, typer.Option("--for", min=0, help="Seconds that a lasting fault lasts; 0 ends it.")
    ] = None,
    wind: Annotated[
        tuple[float, float], typer.Option(help="Of a wind: where the air flows to, north and east, m/s.")
    ] = (0.0, 0.0),
    fleet: OperatedFile = None,
    vehicles: Vehicles = None,
) -> None:
    """Have a stub or a simulated PX4 of a running fleet suffer a fault; exit status 1 if it does not answer."""
    from companion.config.overrides import fleet_config
    from companion.core.frames import Ned
    from companion.operator.flying import operated_file
    from sim.launch.faults import order_fault

    if kind not in tuple(FaultKind):
        raise ConfigError(f"fault must be one of {', '.join(FaultKind)}, got {kind!r}")
    config = fleet_config(operated_file(fleet), vehicles)
    lasts_s = float("inf") if duration is None else duration
    try:
        ordered = Fault(FaultKind(kind), magnitude, lasts_s, wind_ned_m_s=Ned(*wind, 0.0))
    except ValueError as error:
        raise ConfigError(str(error)) from None
    order_fault(config, vehicle, ordered)
    tell(f"vehicle {vehicle}: {kind}")


@app.command()
def doctor(
    fleet: FleetFile = FLEET_TOML,
    vehicles: Vehicles = None,
    as_json: Annotated[bool, typer.Option("--json", help="Every row as JSON.")] = False,
) -> None:
    """Look this machine over before a fleet flies on it: Python, libraries, ports, multicast, clock, PX4.

    Exit status: 0 all met, 1 a row is not met, 2 wrong usage or configuration.
    """
    from companion.config.overrides import fleet_config
    from companion.operator.rows import show_rows
    from sim.launch.doctor import doctor_checks

    raise typer.Exit(0 if show_rows(doctor_checks(fleet_config(fleet, vehicles)), as_json) else FAILED)


@app.command()
def check(
    file: Annotated[Path, typer.Argument(help="The fleet's configuration; without it ./fleet.toml.")] = FLEET_TOML,
    vehicles: Vehicles = None,
) -> None:
    """Read a fleet file as the vehicles do, and tell what follows from it. Exit status: 0 fit to fly, 2 it is not."""
    from companion.config.overrides import existing_file, fleet_config
    from companion.operator.facts import facts

    for what, value, why in facts(fleet_config(file, vehicles)):
        tell(f"{what:13}  {value:30}  {why}")
    tell(f"{existing_file(file)}: fit to fly")


@app.command(hidden=True)
def sitl(
    px4: Annotated[Path, typer.Option()],
    truth: Annotated[Path, typer.Option()],
    fleet: FleetFile = FLEET_TOML,
    parameter: Parameters = None,
    ready: Annotated[Path | None, typer.Option(help="A file to make once every parameter is read back.")] = None,
    logs: Annotated[bool, typer.Option("--logs", help="Have the instances write their flight logs.")] = False,
    relay: Annotated[list[int] | None, typer.Option(help="A vehicle whose link can be cut.")] = None,
) -> None:
    """Run PX4 SITL instances until standard input closes: for launchers."""
    from companion.config.overrides import fleet_config
    from sim.launch.px4_build import find_build
    from sim.launch.px4_instance import parse_parameters
    from sim.launch.sitl import SitlHost, SitlSettings

    config = fleet_config(fleet)
    parameters = parse_parameters(parameter or ())
    settings = SitlSettings(
        find_build(px4),
        truth.parent,
        truth,
        sys.stdin.fileno(),
        parameters,
        logs=logs,
        relayed=frozenset(relay or ()),
        ready_path=ready,
    )
    SitlHost(config, settings).run(grace_s=1.5)


@app.command()
def study(
    name: Annotated[
        str,
        typer.Argument(help=f"{', '.join(STUDIES)}, all; or {', '.join(FLOWN_STUDIES)}."),
    ],
    seeds: Annotated[
        str | None, typer.Option(help="As in 0..19 (the default) or 0,3,5; without it, all takes 20..39.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for tables, figures and the report.")] = Path("studies"),
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    setup: Annotated[Path | None, typer.Option(help="Your own copy of the study's TOML file.")] = None,
    autopilot: Annotated[str, typer.Option(help="What flies the campaign: stub, or px4 (SITL).")] = "stub",
    px4: Annotated[
        Path | None, typer.Option(help="With --autopilot px4: its build folder, or /opt/px4; else looked for.")
    ] = None,
) -> None:
    """Reproduce the paper's results and compare ours: tables, figures, a report. Finished seeds are not run again.

    Needs the extra `study` of starling-fleet.
    """
    from sim.launch.px4_build import find_build
    from sim.study.run import study as run

    if autopilot not in ("stub", "px4"):
        raise ConfigError(f"--autopilot must be stub or px4, got {autopilot!r}")
    if autopilot == "px4" and name != "campaign":
        raise ConfigError(f"--autopilot px4 is for the campaign alone, got the study {name!r}")
    if px4 is not None and autopilot != "px4":
        raise ConfigError("--px4 needs --autopilot px4")
    if autopilot == "px4":
        run("campaign_px4", seeds, out, jobs, setup, px4=find_build(px4))
    else:
        run(name, seeds, out, jobs, setup)


law = typer.Typer(no_args_is_help=True, help="Laws, ours and those of installed packages.")
app.add_typer(law, name="law")


@law.callback()
def _laws() -> None:
    """Laws, ours and those of installed packages."""


@law.command("check")
def law_check(
    name: Annotated[str, typer.Argument(help="Its kind, as law.kind in fleet.toml says it.")],
    fleet: Annotated[Path | None, typer.Option(help="Take the law's parameters from this file.")] = None,
) -> None:
    """Look a law over before it flies: finite, the same twice, quick, apart when it sends two head-on.

    Real agents on stub autopilots in lockstep. Exit status: 0 all met, 1 a row is not met, 2 wrong usage, or no law.
    """
    from companion.config.file import read_tables
    from sim.lockstep.law_check import check

    passed = True
    for row in check(name, {} if fleet is None else read_tables(fleet).get("law", {})):
        tell(f"{'ok' if row.passed else 'FAULT':5}  {row.name:40}  {row.value:>14}  {row.limit}")
        passed = passed and row.passed
    raise typer.Exit(0 if passed else FAILED)


recorded.mount(app)
verbs.mount(app)


def main() -> None:
    """Entry point: errors that a user can act on end with a sentence, not a traceback."""
    tolerate_any_encoding()
    try:
        with libraries_of("sim"):
            app(standalone_mode=True)
    except MissingLibraryError as error:
        tell(f"fleet: {error}. The operator's verbs (status, land, kill, ...) need no extra", error=True)
        raise SystemExit(error.exit_status) from None
    except CompanionError as error:
        tell(f"fleet: {error}", error=True)
        raise SystemExit(error.exit_status) from None


if __name__ == "__main__":
    main()
