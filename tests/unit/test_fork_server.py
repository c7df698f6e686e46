"""The server that forks a fleet's processes: what they are, how they end, what becomes of them without launcher or
server."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from companion.errors import CompanionError
from sim.launch.fork_server import ABANDONED, END_WITHIN_S
from sim.launch.jobs import CompanionJob, FleetFiles, ReferenceJob, StubsJob, decode, encode
from sim.launch.processes import FleetProcesses, Forked, how_it_ended

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 60.0
NICENESS = 19


def eventually(condition: Callable[[], bool], timeout_s: float = PATIENCE_S) -> bool:
    until_s = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < until_s:
        time.sleep(0.01)
    return condition()


def stat(pid: int) -> list[str]:
    """The fields of /proc/PID/stat behind the name: state, parent, group, session, ..."""
    text = Path(f"/proc/{pid}/stat").read_text()
    return text[text.rindex(")") + 2 :].split()


def gone(pid: int) -> bool:
    """Whether a process has ended, be it as somebody's zombie."""
    try:
        return stat(pid)[0] == "Z"
    except OSError:
        return True


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[FleetProcesses]:
    found = FleetProcesses(tmp_path)
    found.open()
    yield found
    found.close()
    assert all(child.poll() is not None for child in found.children.values())


def idle(processes: FleetProcesses, name: str = "idle", niceness: int = 0) -> Forked:
    """A process that does nothing but write a line of a file every 20 ms."""
    file = processes.folder / f"{name}.bin"
    processes.fork(name, ReferenceJob(str(file)), niceness)
    child = processes.children[name]
    assert isinstance(child, Forked)
    assert eventually(lambda: child.poll() is not None or file.exists())
    assert child.poll() is None, processes.why_ended(name, "at once")
    return child


def server_pid(processes: FleetProcesses) -> int:
    (pid,) = (p for p in children(os.getpid()) if "companions' server" in cmdline(p))
    return pid


def children(pid: int) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and not gone(int(entry.name)) and int(stat(int(entry.name))[1]) == pid:
            found.append(int(entry.name))
    return found


def cmdline(pid: int) -> str:
    return Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ").strip()


def test_a_forked_process_is_ours_and_what_an_executed_one_would_be(processes: FleetProcesses) -> None:
    child = idle(processes, niceness=NICENESS)
    _, parent, _, session = stat(child.pid)[:4]
    assert int(parent) == os.getpid()
    assert int(session) == child.pid
    assert os.getpriority(os.PRIO_PROCESS, child.pid) == NICENESS
    assert cmdline(child.pid) == f"fleet reference loop {processes.folder / 'idle.bin'}"
    links = {int(e.name): os.readlink(e) for e in Path(f"/proc/{child.pid}/fd").iterdir()}
    assert links[1] == links[2] == str(processes.folder / "idle.log")
    assert links[0].startswith("pipe:")
    assert not any(link.startswith("socket:") for link in links.values()), "the server's socket stays the server's"


def test_the_server_has_no_thread_that_a_fork_would_lose(processes: FleetProcesses) -> None:
    idle(processes)
    assert len(os.listdir(f"/proc/{server_pid(processes)}/task")) == 1
    assert (processes.folder / "server.log").read_text() == ""


def test_how_a_process_ended_is_known_by_status_and_by_the_signals_name(processes: FleetProcesses) -> None:
    child = idle(processes)
    os.kill(child.pid, signal.SIGKILL)
    assert eventually(lambda: processes.exit_status("idle") == -signal.SIGKILL)
    assert processes.why_ended("idle", "in flight") == "idle ended in flight with status -9 (SIGKILL):"
    processes.fork("wrong", CompanionJob(99, str(ROOT / "fleet.toml")))
    assert eventually(lambda: processes.exit_status("wrong") == 2)
    assert processes.why_ended("wrong", "before take-off") == (
        "wrong ended before take-off with status 2:\ncompanion: vehicle 99 is not an enabled vehicle of this fleet; "
        "there are 1, 2, 3, 4, 5, 6, 7, 8, 9, 10"
    )
    assert how_it_ended(-11) == "status -11 (SIGSEGV)"
    assert how_it_ended(-200) == "status -200"


def test_a_file_that_no_vehicle_could_fly_by_is_refused_before_there_is_a_process(processes: FleetProcesses) -> None:
    with pytest.raises(CompanionError, match=r"^lost cannot be started: nowhere\.toml: cannot be read: No such file"):
        processes.fork("lost", CompanionJob(1, "nowhere.toml"))


def test_a_file_that_has_changed_is_read_anew_and_else_once(tmp_path: Path) -> None:
    file, files = tmp_path / "fleet.toml", FleetFiles()
    text = (ROOT / "fleet.toml").read_text()
    file.write_text(text)
    told, config = files.read(file)
    assert told == text
    assert files.read(file)[1] is config
    file.write_text(text.replace('name = "starling"', 'name = "other"'))
    assert files.read(file)[1].fleet.name == "other"
    file.write_text("nonsense")
    with pytest.raises(CompanionError):
        files.read(file)


def test_every_job_survives_the_servers_socket() -> None:
    for job in (CompanionJob(3, "f.toml", "r.mcap"), StubsJob("f.toml", 7, "t.bin", True), ReferenceJob("out")):
        assert decode(encode(job, 5)) == (job, 5)


def test_ending_ends_a_stopped_process_too(processes: FleetProcesses) -> None:
    child = idle(processes)
    os.kill(child.pid, signal.SIGSTOP)
    assert eventually(lambda: stat(child.pid)[0] == "T")
    processes.end(["idle"], 0.2)
    assert child.poll() == -signal.SIGTERM, "it goes on, and ends by itself"
    child.send_signal(signal.SIGTERM)  # a number that may be somebody else's by now


def test_without_its_server_a_process_lives_on_and_its_end_is_known(processes: FleetProcesses) -> None:
    child = idle(processes)
    os.kill(server_pid(processes), signal.SIGKILL)
    with pytest.raises(CompanionError, match=r"late cannot be started: .*server ended with status -9 \(SIGKILL\)"):
        processes.fork("late", ReferenceJob(os.devnull))
    assert child.poll() is None
    processes.end(["idle"], 5.0)
    assert child.poll() == -signal.SIGTERM


def test_a_server_that_cannot_take_more_files_says_so_and_goes_on(processes: FleetProcesses) -> None:
    idle(processes)
    pid = server_pid(processes)
    before = resource.prlimit(pid, resource.RLIMIT_NOFILE)
    open_files = {int(name) for name in os.listdir(f"/proc/{pid}/fd")}
    for free in range(4):  # two files come with a job, and two are a pipe's
        limit = next(n for n in range(1024) if n - len([fd for fd in open_files if fd < n]) == free)
        resource.prlimit(pid, resource.RLIMIT_NOFILE, (limit, before[1]))
        with pytest.raises(CompanionError, match=r"crowded cannot be started: .*[Tt]oo many open files"):
            processes.fork("crowded", ReferenceJob(os.devnull))
    resource.prlimit(pid, resource.RLIMIT_NOFILE, before)
    idle(processes, "again")


LAUNCHER = """
import sys, time
from pathlib import Path
from sim.launch.jobs import ReferenceJob
from sim.launch.processes import FleetProcesses
processes = FleetProcesses(Path(sys.argv[1]))
processes.open()
for name in sys.argv[2:]:
    processes.fork(name, ReferenceJob(str(processes.folder / f"{name}.bin")))
print(*(c.pid for c in processes.children.values()), processes._server.process.pid, flush=True)
time.sleep(600)
"""


@contextmanager
def launcher(folder: Path, *names: str) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [sys.executable, "-c", LAUNCHER, str(folder), *names], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, env={**os.environ, "PYTHONPATH": str(ROOT)}, cwd=ROOT,
    )  # fmt: skip
    with process:
        try:
            yield process
        finally:
            process.kill()


def pids_of(process: subprocess.Popen[str]) -> list[int]:
    assert process.stdout is not None
    return [int(word) for word in process.stdout.readline().split()]


def test_nothing_outlives_a_killed_launcher_not_even_what_was_stopped(tmp_path: Path) -> None:
    with launcher(tmp_path, "one", "two") as process:
        one, two, server = pids_of(process)
        assert eventually(lambda: all((tmp_path / f"{n}.bin").exists() for n in ("one", "two")))
        os.kill(two, signal.SIGSTOP)
        os.kill(server, signal.SIGSTOP)
        assert eventually(lambda: stat(two)[0] == stat(server)[0] == "T")
        process.kill()
        assert eventually(lambda: all(map(gone, (one, two, server))), END_WITHIN_S + 10.0)


def test_nothing_outlives_a_launcher_and_a_server_killed_together(tmp_path: Path) -> None:
    with launcher(tmp_path, "one") as process:
        one, server = pids_of(process)
        os.kill(server, signal.SIGKILL)
        process.kill()
        assert eventually(lambda: all(map(gone, (one, server))), END_WITHIN_S + 10.0)


HANG = """
import os, sys, threading, time
from sim.launch import fork_server
threading.Thread(target=fork_server._watch, args=(0,), daemon=True).start()
print("there", flush=True)
time.sleep(600)
"""


def test_a_process_that_hangs_is_gone_in_time_without_its_launcher() -> None:
    with subprocess.Popen([sys.executable, "-c", HANG], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdout.readline()
        process.stdin.close()
        assert process.wait(END_WITHIN_S + 5.0) == ABANDONED


FULL = """
import os, pwd, resource, socket, sys
from sim.launch import fork_server, jobs
control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
server = os.fork()
if server == 0:
    control.close()
    os.setuid(pwd.getpwnam("nobody").pw_uid)
    resource.setrlimit(resource.RLIMIT_NPROC, (int(sys.argv[1]),) * 2)
    fork_server.serve(theirs, jobs.FleetFiles())
    os._exit(0)
theirs.close()
for _ in range(2):
    socket.send_fds(control, [jobs.encode(jobs.ReferenceJob("/dev/null"), 0)], [0, 1])
    print(control.recv(4096).decode())
control.close()
print(os.waitpid(server, 0)[1])
"""


@pytest.mark.skipif(os.getuid() != 0, reason="needs another user, who has no other processes")
@pytest.mark.parametrize("most", [1, 2], ids=["at the first fork", "at the second"])
def test_a_full_table_of_processes_is_said_each_time_and_the_server_lives_on(most: int) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(most)], capture_output=True, text=True, check=False, cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)}, timeout=PATIENCE_S,
    )  # fmt: skip
    full = '{"error": "Resource temporarily unavailable"}'
    assert done.stdout.splitlines() == [full, full, "0"], done.stderr
