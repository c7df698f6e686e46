"""Where PX4's versions differ in what a companion reads or asks: one table for each kind of difference.

A companion does not ask for PX4's version: of names that mean one setting, whichever answers counts.
"""

from typing import NamedTuple


class Renamed(NamedTuple):
    """A setting that has another name, and maybe another meaning, since a version."""

    before: str
    after: str
    since: str
    """PX4's version"""


RENAMED = (
    Renamed("COM_RC_OVERRIDE", "MAN_OVERRIDE_SPD", since="1.18"),  # bit 1: sticks end OFFBOARD -> their least speed
)


def same_setting(name: str) -> tuple[str, ...]:
    """All names of a parameter's setting, its own included."""
    return next(((r.before, r.after) for r in RENAMED if name in (r.before, r.after)), (name,))
