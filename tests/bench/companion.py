"""What one lone companion costs: `python -m tests.bench.companion [--rounds N] [--against PATH]`.

A stub autopilot flies nothing; beside it `companion run` starts, as from the command line. Printed are medians over the
rounds: CPU until the control loop runs (it says READY=1 as to systemd), memory some seconds later, CPU of `--help`.
`--against` is the folder of another version; the rounds alternate and the ratios follow.
"""

import argparse
import contextlib
import os
import resource
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parents[2]
SETTLED_S = 4.0
"""how long after its start the memory is read: requests to the autopilot are answered, the timers have all run"""
READY_S = 60.0
UNITS = {
    "CPU until the loop runs": "s",
    "Private_Dirty": "MB",
    "PSS": "MB",
    "CPU of companion --help": "s",
    "CPU of fleet --help": "s",
}


def environment(tree: Path, folder: Path) -> dict[str, str]:
    """With the tree's modules first, their byte code kept as an installed package's is."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    return {**kept, "PYTHONPATH": str(tree), "PYTHONPYCACHEPREFIX": str(folder / "cache")}


@contextlib.contextmanager
def child(arguments: list[str], tree: Path, folder: Path, **more: str) -> Iterator[subprocess.Popen[bytes]]:
    """A process of the tree that ends with its standard input."""
    process = subprocess.Popen(
        [sys.executable, "-m", *arguments, "--launched"],
        cwd=folder, env={**environment(tree, folder), **more}, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        yield process
    finally:
        assert process.stdin is not None
        process.stdin.close()
        try:
            process.wait(10.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def cpu_s(pid: int) -> float:
    """User and system time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory_mb(pid: int) -> dict[str, float]:
    """Private_Dirty and PSS."""
    rows = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:])
    return {
        name: int(rows[row].split()[0]) / 1024 for name, row in (("Private_Dirty", "Private_Dirty"), ("PSS", "Pss"))
    }


def help_cpu_s(module: str, tree: Path, folder: Path) -> float:
    """CPU of `python -m MODULE --help`."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, "-m", module, "--help"], cwd=folder, env=environment(tree, folder), check=True,
        stdout=subprocess.DEVNULL,
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def free_port() -> int:
    """A port of the loopback interface whose stub's, 40 above, is free as well."""
    for port in range(26_000, 32_000, 100):
        with contextlib.suppress(OSError), contextlib.ExitStack() as opened:
            for p in (port, port + 40):
                opened.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)).bind(("127.0.0.1", p))
            return port
    raise SystemExit("no free UDP port between 26000 and 32000")


def measure(tree: Path, folder: Path) -> dict[str, float]:
    """One round of a tree."""
    name = f"bench-{os.getpid()}"
    (folder / "fleet.toml").write_text(
        f'[fleet]\nname = "{name}"\n'
        "origin = { latitude_deg = 47.397742, longitude_deg = 8.545594, altitude_amsl_m = 488.0 }\n"
        f'[peers]\nscouting_port = 26999\n[[vehicle]]\nid = 1\nmavlink = "udp://127.0.0.1:{free_port()}"\n'
    )
    figures = {}
    with contextlib.ExitStack() as opened:
        opened.enter_context(child(["sim", "stub"], HERE, folder))
        notified = opened.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        path = folder / f"notify-{time.monotonic_ns()}"
        notified.bind(str(path))
        notified.settimeout(READY_S)
        arguments = ["companion", "run", "--vehicle", "1"]
        process = opened.enter_context(child(arguments, tree, folder, NOTIFY_SOCKET=str(path)))
        while b"READY=1" not in notified.recv(4096):
            pass
        figures["CPU until the loop runs"] = cpu_s(process.pid)
        time.sleep(SETTLED_S)
        figures |= memory_mb(process.pid)
    for module, command in (("companion", "companion"), ("sim", "fleet")):
        figures[f"CPU of {command} --help"] = help_cpu_s(module, tree, folder)
    return figures


def main() -> None:
    """Measure, and print a row for each figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--against", type=Path, default=None, help="folder of another version")
    options = parser.parse_args()
    trees = [HERE] if options.against is None else [HERE, options.against.resolve()]
    with contextlib.ExitStack() as opened:
        folders = [Path(opened.enter_context(tempfile.TemporaryDirectory())) for _ in trees]
        for tree, folder in zip(trees, folders, strict=True):
            measure(tree, folder)  # the first makes the byte code
        rounds = [
            [measure(tree, folder) for tree, folder in zip(trees, folders, strict=True)] for _ in range(options.rounds)
        ]
    for name, unit in UNITS.items():
        ours, *theirs = (statistics.median(r[k][name] for r in rounds) for k in range(len(trees)))
        beside = "".join(f"   against {other:6.2f} {unit:2}   ratio {ours / other:.2f}" for other in theirs)
        print(f"{name:26} {ours:6.2f} {unit:2}{beside}")  # noqa: T201


if __name__ == "__main__":
    main()
