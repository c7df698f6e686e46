"""Which fleets this user flies on this computer: a launcher notes the file that its flight's vehicles have, so that a
verb without `--fleet` reaches the flight and not a file that lies about.
"""

import fcntl
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from companion.config.file import read_tables
from companion.config.overrides import DEFAULT_FILE
from companion.errors import ConfigError

SUFFIX = ".flying"


def _folder() -> Path | None:
    """This user's own, made if it is not there: notes in a folder that all share could be anybody's. None if it cannot
    be had, or if somebody else has put something in its place."""
    folder = Path(tempfile.gettempdir()) / f"starling-fleet-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return None
    ours = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
    return folder if ours else None


@contextmanager
def noted(fleet_name: str, file: Path) -> Iterator[None]:
    """Note a flight by its fleet's name as long as it lasts.

    The note is locked: the kernel lets go of it with the process, and what is left behind by one that was killed names
    nobody. A folder that cannot be had costs the note, not the flight.
    """
    folder = _folder()
    if folder is None:
        yield
        return
    note = folder / f"{fleet_name}{SUFFIX}"
    with ExitStack() as held:
        with suppress(OSError):
            fd = os.open(note, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
            held.callback(os.close, fd)
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            held.callback(note.unlink, missing_ok=True)
            os.ftruncate(fd, 0)
            os.write(fd, os.fsencode(file.resolve()))
        yield


def flying_files() -> dict[str, Path]:
    """The files of the flights that go on, by their fleets' names."""
    folder = _folder()
    notes = [] if folder is None else sorted(folder.glob(f"*{SUFFIX}"))
    files = {note.stem: _read(note) for note in notes}
    return {name: file for name, file in files.items() if file is not None and file.is_file()}


def _read(note: Path) -> Path | None:
    """The file that a note names, or None if nobody holds it any longer."""
    try:
        fd = os.open(note, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return Path(os.fsdecode(os.read(fd, 4096)))
    finally:
        os.close(fd)
    return None


def operated_file(asked: Path | None) -> Path:
    """The file of the fleet that a verb is for: the one asked for; else that of this computer's flight of the name that
    `./fleet.toml` has, or where there is no such file of its only flight; else `./fleet.toml`, or the shipped one.

    ConfigError where several fly and nothing says which is meant.
    """
    if asked is not None:
        return asked
    flying = flying_files()
    if DEFAULT_FILE.exists():
        table = read_tables(DEFAULT_FILE).get("fleet")
        name = table.get("name") if isinstance(table, dict) else None
        return flying.get(name, DEFAULT_FILE) if isinstance(name, str) else DEFAULT_FILE
    if len(flying) > 1:
        listed = "; ".join(f"{name}: --fleet {file}" for name, file in flying.items())
        raise ConfigError(f"several fleets fly on this computer, say which is meant: {listed}")
    return next(iter(flying.values()), DEFAULT_FILE)
