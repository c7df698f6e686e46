"""`fleet study NAME`: check what was asked, run it with a progress bar, write tables, figures and a report."""

from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from companion.errors import CompanionError, ConfigError
from sim.study import FLOWN, STUDIES
from sim.study.common import (
    Config,
    Outcome,
    load_config,
    parse_seeds,
    pieces,
    study_module,
    writable_folder,
    write_outcome,
)  # fmt: skip
from sim.study.own_setup import flown_as
from sim.study.report import write_report
from sim.swarm.swarm import kernels

DEFAULT_SEEDS = "0..19"
JUDGED_SEEDS = "20..39"


def study(
    name: str,
    seeds: str | None = None,
    out: Path = Path("study"),
    jobs: int = 1,
    setup: Path | None = None,
    console: Console | None = None,
    px4: Path | None = None,
) -> Path:
    """Run one study, or `all`; returns the report's path. `px4`: PX4's build folder, for what flies on one.

    Raises ConfigError with a sentence for what is refused, CompanionError after the report is written if a rule that
    must hold was broken.
    """
    names = STUDIES if name == "all" else (name,)
    for each in names:
        study_module(each)
    if setup is not None and name == "all":
        raise ConfigError("--setup belongs to one study: name it instead of all")
    if jobs < 1:
        raise ConfigError(f"--jobs must be at least 1, got {jobs}")
    chosen = parse_seeds((JUDGED_SEEDS if name == "all" else DEFAULT_SEEDS) if seeds is None else seeds)
    configs = [load_config(each, setup) for each in names]
    if px4 is not None:
        configs = [study_module(each.name).with_build(each, px4) for each in configs]
    folder = writable_folder(out)
    if not set(names) <= set(FLOWN):
        kernels()
    console = console or Console()
    done: list[tuple[Config, Outcome]] = []
    bar = Progress(
        TextColumn("{task.description:<10}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        TimeRemainingColumn(), console=console,
    )  # fmt: skip
    with bar:
        for config in configs:
            module = study_module(config.name)
            used = tuple(module.seeds_used(chosen)) if hasattr(module, "seeds_used") else chosen
            task = bar.add_task(config.name, total=len(used))
            with flown_as(setup, config.name):
                results = pieces(config, used, folder, jobs, lambda task=task: bar.advance(task))  # type: ignore[misc]
                outcome: Outcome = module.finish(config, results, used)
            write_outcome(config, outcome, used, folder)
            done.append((config, outcome))
    report = write_report(folder, name, done, seeds=chosen)
    console.print(
        f"{report}: {sum(len(o.tables) for _, o in done)} tables, {sum(len(o.figures) for _, o in done)} figures"
    )
    for finding in (f for _, o in done for f in o.findings):
        console.print(finding)
    if broken := [o.broken for _, o in done if o.broken]:
        raise CompanionError(f"{'; '.join(broken)}: {report}")
    return report
