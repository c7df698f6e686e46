"""One flight of a name: a lock that its launcher holds as long as it lives, and a look for companions that run."""

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from companion.config import FleetConfig
from companion.errors import CompanionError
from companion.io.network import operator_link

LOOK_S = 0.3
"""how long companions that run are looked for: on a machine's loopback they are found while the session opens"""


@contextmanager
def only_flight(fleet_name: str, folder: Path | None = None) -> Iterator[None]:
    """Hold the name; CompanionError if a launcher of this machine flies a fleet of it.

    The kernel lets go of the lock with the process, however it ends: a file that is left behind locks nobody out.
    """
    path = (Path(tempfile.gettempdir()) if folder is None else folder) / f"starling-fleet-{fleet_name}.lock"
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        try:
            # Another user's file may be locked, and not be opened for creation, in a folder that all share.
            fd = os.open(path, flags)
        except FileNotFoundError:
            fd = os.open(path, flags | os.O_CREAT, 0o644)
    except OSError as error:
        raise CompanionError(f"cannot open the lock {path} of fleet {fleet_name!r}: {error.strerror}") from error
    try:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise CompanionError(
                f"a fleet of the name {fleet_name!r} is flown on this machine already (its launcher holds {path}): "
                "wait for its end, or give one of the two another fleet.name"
            ) from None
        yield
    finally:
        os.close(fd)


def refuse_companions(config: FleetConfig) -> None:
    """CompanionError if companions of this fleet run already, whoever started them."""
    with operator_link(config) as link:
        there = link.wait_alive({v.id for v in config.vehicles}, LOOK_S)
    if there:
        raise CompanionError(
            f"companions of fleet {config.fleet.name!r} run already (vehicle {', '.join(map(str, sorted(there)))}): "
            "end them, or give one of the two fleets another fleet.name"
        )
