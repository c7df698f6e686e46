"""The processes of one flight: started, watched, ended; none outlives this one."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from companion.errors import CompanionError
from sim.launch.fork_server import ONE_THREAD
from sim.launch.jobs import Job, encode
from sim.launch.linux import adopt_orphans

END_TIMEOUT_S = 5.0
SERVER_TIMEOUT_S = 30.0
"""for its imports, on a machine that is busy with other things"""
POLL_S = 0.01
LAST_LINES = 5
TITLE_ROOM = 1024
"""characters that a forked process' command line may have in `ps`"""


def how_it_ended(status: int) -> str:
    """An exit status as people read it; negative: the signal that ended it."""
    if status >= 0:
        return f"status {status}"
    with suppress(ValueError):
        return f"status {status} ({signal.Signals(-status).name})"
    return f"status {status}"


class Child(Protocol):
    """What the launcher needs of a process: `subprocess.Popen` and `Forked` have it."""

    @property
    def pid(self) -> int:
        """Its number."""

    def poll(self) -> int | None:
        """Its exit status once it has ended; negative: the signal that ended it."""

    def send_signal(self, sig: int) -> None:
        """Nothing if it has ended."""


@dataclass(slots=True)
class Forked:
    """A process that the server has forked, and that is this one's child since."""

    pid: int
    _status: int | None = None

    def poll(self) -> int | None:
        """Its exit status once it has ended; negative: the signal that ended it."""
        if self._status is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self._status = os.waitstatus_to_exitcode(status)
        return self._status

    def send_signal(self, sig: int) -> None:
        """Nothing if it has ended: its number may be somebody else's by then."""
        if self.poll() is None:
            os.kill(self.pid, sig)


class ForkServer:
    """The process that imports once and forks (`sim.launch.fork_server`). It imports while others go on."""

    def __init__(self, log: Path) -> None:
        adopt_orphans()
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._control.settimeout(SERVER_TIMEOUT_S)
        self._log = log
        with theirs, log.open("wb") as output:
            # -P: the user's folder holds no modules for it.
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-m", "sim.launch.fork_server", str(theirs.fileno()), "-" * TITLE_ROOM],
                stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT, start_new_session=True,
                pass_fds=[theirs.fileno()], env={**os.environ, **ONE_THREAD},
            )  # fmt: skip

    def start(self, job: Job, niceness: int, lifeline: int, log: int) -> Forked:
        """Fork a process for a job; CompanionError says why there is none."""
        try:
            socket.send_fds(self._control, [encode(job, niceness)], [lifeline, log])
            answer = self._control.recv(4096)
        except TimeoutError:
            raise CompanionError(f"the companions' server has not answered for {SERVER_TIMEOUT_S:.0f} s") from None
        except OSError:
            answer = b""
        if not answer:
            how = how_it_ended(self.process.wait())
            raise CompanionError("\n".join((f"the companions' server ended with {how}:", *last_lines(self._log))))
        told = json.loads(answer)
        if "pid" not in told:
            raise CompanionError(told["error"])
        return Forked(told["pid"])

    def close(self) -> None:
        """It ends by itself once nobody can ask it for more; one that does not is killed."""
        self._control.close()
        try:
            self.process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def last_lines(log: Path) -> list[str]:
    """The last lines that a process printed."""
    with suppress(OSError):
        return log.read_text(errors="replace").strip().splitlines()[-LAST_LINES:]
    return []


@dataclass(slots=True)
class FleetProcesses:
    """The children, by name. Each ends by itself when its standard input closes, so none outlives this process."""

    folder: Path
    children: dict[str, Child] = field(default_factory=dict)
    _stack: ExitStack = field(default_factory=ExitStack)
    _server: ForkServer | None = None
    _lifeline: int = -1
    """reading end of a pipe to which nobody ever writes; its other end is held here alone"""

    def open(self) -> None:
        """Start the server."""
        self._lifeline, held = os.pipe()
        for fd in (self._lifeline, held):
            self._stack.callback(os.close, fd)
        self._server = ForkServer(self.folder / "server.log")
        self._stack.callback(self._server.close)

    def fork(self, name: str, job: Job, niceness: int = 0) -> None:
        """Start a job from the server, with its output in NAME.log."""
        assert self._server is not None
        try:
            with (self.folder / f"{name}.log").open("wb") as log:
                self.children[name] = self._server.start(job, niceness, self._lifeline, log.fileno())
        except (CompanionError, OSError) as error:
            raise CompanionError(f"{name} cannot be started: {error}") from error

    def spawn(self, name: str, *command: str) -> None:
        """Start a command of a package in an interpreter of its own: for what takes longer to end than a forked one."""
        with (self.folder / f"{name}.log").open("wb") as log:
            self.children[name] = subprocess.Popen(
                [sys.executable, "-P", "-m", *command], stdin=self._lifeline, stdout=log, stderr=subprocess.STDOUT,
                start_new_session=True,
            )  # fmt: skip

    def exit_status(self, name: str) -> int | None:
        """Exit status of a child that has ended, else None."""
        return self.children[name].poll()

    def why_ended(self, name: str, when: str) -> str:
        """What to say of a child that has ended: how, and the last lines that it printed."""
        status = self.exit_status(name)
        how = "is there" if status is None else f"ended {when} with {how_it_ended(status)}:"
        return "\n".join((f"{name} {how}", *last_lines(self.folder / f"{name}.log")))

    def stop(self, name: str, seconds: float) -> None:
        """Have a child stand still for a while."""
        pid = self.children[name].pid

        def go_on() -> None:
            with suppress(ProcessLookupError):  # it has ended meanwhile
                os.kill(pid, signal.SIGCONT)

        self.children[name].send_signal(signal.SIGSTOP)
        timer = threading.Timer(seconds, go_on)
        timer.daemon = True
        timer.start()

    def end(self, names: list[str], timeout_s: float, how: int = signal.SIGTERM) -> None:
        """A signal to each, and SIGKILL to whoever is still there after the timeout; whoever stands still goes on."""
        for name in names:
            self.children[name].send_signal(how)
            self.children[name].send_signal(signal.SIGCONT)
        deadline_s = time.monotonic() + timeout_s
        waiting = set(names)
        while waiting:
            waiting = {name for name in waiting if self.exit_status(name) is None}
            if waiting and time.monotonic() > deadline_s:
                for name in waiting:
                    self.children[name].send_signal(signal.SIGKILL)
            time.sleep(POLL_S if waiting else 0.0)

    def close(self) -> None:
        """End whatever still runs."""
        try:
            self.end(list(self.children), END_TIMEOUT_S)
        finally:
            self._stack.close()
