"""What Linux offers a launcher and Python does not name: whose child an orphan becomes, what a parent's death does."""

import ctypes
import os
from pathlib import Path

PR_SET_PDEATHSIG = 1
PR_SET_CHILD_SUBREAPER = 36


def _prctl(option: int, value: int) -> None:
    if ctypes.CDLL(None, use_errno=True).prctl(option, value, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def adopt_orphans() -> None:
    """Descendants whose parent ends become this process's children, so that it learns how they end."""
    _prctl(PR_SET_CHILD_SUBREAPER, 1)


def signal_at_parents_death(number: int) -> None:
    """Have the kernel send this process a signal whenever its parent ends; lasts through exec, not through fork."""
    _prctl(PR_SET_PDEATHSIG, number)


def show_as(words: list[str]) -> None:
    """What `ps` and /proc show as this process's command line; cut to the room that its own arguments took."""
    stat = Path("/proc/self/stat").read_text()
    fields = stat[stat.rindex(")") + 2 :].split()
    begin, end = int(fields[45]), int(fields[46])  # arg_start, arg_end
    room = end - begin
    text = "\0".join(words).encode()[: room - 1]
    ctypes.memmove(begin, text.ljust(room, b"\0"), room)
