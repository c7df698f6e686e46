"""Starts a fleet's processes: imports once, freezes, and forks; `python -m sim.launch.fork_server SOCKET ROOM`.

A companion in an interpreter of its own spends most of its start, and most of its memory, on the same imports and the
same file. Here each is a fork of one process that has them, and runs what `companion run` runs (`jobs`).

Nothing opens a network or starts a thread before the fork: neither survives one. A forked process takes the place of
one that was started: a session, standard files, a title for `ps` and a niceness of its own. It is an orphan at once and
so the launcher's child (`linux.adopt_orphans`): the server may end in flight, and nobody would notice.

Nothing outlives the launcher. It holds the writing end of a pipe that is everybody's standard input, and writes
nothing. Whoever sees that end close finishes by itself: lands, and says good-bye to its peers. A thread watches beside
it, so that a process that hangs is gone in time as well; and the kernel wakes whoever was stopped.
"""

import errno
import gc
import importlib
import json
import os
import select
import signal
import socket
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

from companion.errors import CompanionError
from companion.terminal import tell
from sim.launch.jobs import LIFELINE, FleetFiles, Job, decode
from sim.launch.linux import show_as, signal_at_parents_death

END_WITHIN_S = 1.6
ABANDONED = 70
"""exit status of a process that did not finish by itself"""
PRELOADED = ("companion.io.zenoh.vehicle",)
"""what the jobs import when they run, and not before"""
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""environment of the server: numeric libraries start their threads when they are imported"""
MESSAGE_MAX_BYTES = 65_536


def serve(control: socket.socket, files: FleetFiles) -> Job | None:
    """Fork for every job that comes, with its standard input and its log beside it; None once the launcher is gone.

    Returns the job in the forked process, far from the server's frames, to be run there.
    """
    while True:
        message, fds, flags, _ = socket.recv_fds(control, MESSAGE_MAX_BYTES, 2)
        if not message:
            return None
        job, niceness = decode(message)
        try:
            if len(fds) < 2 or flags & socket.MSG_CTRUNC:
                raise OSError(0, "too many open files in the companions' server")
            if job.fleet is not None:
                files.read(Path(job.fleet))
            pid = _fork_orphan()
        except CompanionError as error:
            answer: dict[str, object] = {"error": str(error)}
        except OSError as error:
            answer = {"error": error.strerror}
        else:
            if pid == 0:
                control.close()
                _take_place(job.title, niceness, *fds)
                return job
            answer = {"pid": pid}
        for fd in fds:
            os.close(fd)  # the forked process has its own
        control.send(json.dumps(answer).encode())


def _fork_orphan() -> int:
    """Fork twice, so that the second process has no living parent; its id, and 0 within it. OSError if one fails."""
    reading, writing = os.pipe()
    try:
        between = os.fork()
        if between != 0:
            os.close(writing)
            writing = -1
            told = os.read(reading, 64)
            os.waitpid(between, 0)
            pid, fault = map(int, told.split())
            if fault:
                raise OSError(fault, os.strerror(fault))
            return pid
        try:
            told = b"0 0"
            pid = os.fork()
            if pid == 0:
                return 0
            told = b"%d 0" % pid
        except OSError as error:
            told = b"0 %d" % (error.errno or errno.EAGAIN)
        os.write(writing, told)
        os._exit(0)
    finally:
        os.close(reading)
        if writing >= 0:
            os.close(writing)


def _take_place(title: list[str], niceness: int, lifeline: int, log: int) -> None:
    """Become the job's process in all that exec would have set."""
    os.setsid()
    signal_at_parents_death(signal.SIGCONT)
    for fd, standard in ((lifeline, 0), (log, 1), (log, 2)):
        os.dup2(fd, standard)
    for fd in (lifeline, log):
        os.close(fd)
    if niceness:
        os.setpriority(os.PRIO_PROCESS, 0, niceness)
        # Where the kernel groups processes by session, niceness counts within a group only, and each group has its own.
        with suppress(OSError):
            Path("/proc/self/autogroup").write_text(str(niceness))
    show_as(title)


def _watch(fd: int) -> None:
    poll = select.poll()
    poll.register(fd, select.POLLHUP)
    while not any(events & (select.POLLHUP | select.POLLERR) for _, events in poll.poll()):
        pass
    time.sleep(END_WITHIN_S)
    os._exit(ABANDONED)


def main() -> None:
    """Serve; in a forked process, run its job."""
    control = socket.socket(fileno=int(sys.argv[1]))
    show_as(["fleet", "companions' server"])
    signal_at_parents_death(signal.SIGCONT)
    for name in PRELOADED:
        importlib.import_module(name)
    if len(os.listdir("/proc/self/task")) > 1:
        tell("something has started a thread, which the forked processes will not have", error=True)
    gc.collect()
    gc.freeze()
    files = FleetFiles()
    job = serve(control, files)
    if job is None:
        return
    threading.Thread(target=_watch, args=(LIFELINE,), name="launcher watch", daemon=True).start()
    try:
        status = job.run(files)
    except CompanionError as error:
        tell(f"{job.program}: {error}", error=True)
        status = error.exit_status
    sys.exit(status)


if __name__ == "__main__":
    main()
