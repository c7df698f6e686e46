"""Which PX4 an autopilot is: asked of it on the ground, and judged by what this software was flown on."""

from collections.abc import Container

from companion.vehicle.autopilot.px4_versions import NEWEST, OLDEST, STICKS, VERSIONS, Px4Version, version_of
from companion.wire.operator import Check
from companion.wire.px4 import Software

TRIES = 8
RETRY_NS = 1_000_000_000
NEVER_NS = 1 << 63
LIMIT = f"v{OLDEST.number[0]}.{OLDEST.number[1]} or newer"
VERIFIED = "; ".join(v.flown for v in VERSIONS if v.flown)
"""on what this software was flown"""
ROW = "PX4 version"


class Px4Identity:
    """Asks for AUTOPILOT_VERSION until it comes, or has not come in TRIES requests."""

    def __init__(self) -> None:
        self.told: Software | None = None
        self._tries = 0
        self._next_ns = 0

    def restart(self) -> None:
        """The autopilot has booted anew, with another firmware maybe."""
        self.told = None
        self._tries = self._next_ns = 0

    def take(self, told: Software) -> bool:
        """What came; whether it is news."""
        news = told != self.told
        self.told = told
        return news

    def ask(self, now_ns: int) -> bool:
        """Whether to ask now."""
        if self.told is not None or self._tries >= TRIES or now_ns < self._next_ns:
            return False
        self._tries += 1
        self._next_ns = now_ns + RETRY_NS
        return True

    def deadline_ns(self) -> int:
        """When `ask` next has something to say (monotonic)."""
        return NEVER_NS if self.told is not None or self._tries >= TRIES else self._next_ns

    @property
    def silent(self) -> bool:
        """Whether it was asked often enough, and did not answer."""
        return self.told is None and self._tries >= TRIES

    def row(self, there: Container[str]) -> Px4Version:
        """The table's row that holds for it; `there`: its parameters, as far as they have come."""
        return version_of(self.told, there)

    def check(self, there: Container[str]) -> Check:
        """Its version as a row of preflight: too old is a fault, what nobody has flown is worth a word."""
        told, row = self.told, self.row(there)
        if told is None:
            if not self.silent:
                return Check(ROW, None, LIMIT, False, "PX4's version is not told yet")
            return Check(ROW, None, LIMIT, True, f"PX4 does not tell its version: {_taken(row)}", warns=True)
        if (0, 0) < told.number < OLDEST.number:
            says = f"PX4 is v{told}, must be {LIMIT}: older ones do not tell a failsafe of their own in flight"
            return Check(ROW, str(told), LIMIT, False, says, permanent=True)
        says = ""
        if told.number == (0, 0):
            says = f"PX4 tells v{told}, as a build without tags does: {_taken(row)}"
        elif told.number > NEWEST.number:
            says = f"PX4 v{told} is newer than any that was verified ({VERIFIED}): {_taken(row)}"
        elif row is not (by_number := version_of(told, STICKS)):
            others = "newer" if row.number > by_number.number else "older"
            says = f"PX4 tells v{told} and has {row.sticks}, as v{_dotted(row)} and {others} have: {_taken(row)}"
        return Check(ROW, str(told), LIMIT, True, says, warns=bool(says))


def _dotted(row: Px4Version) -> str:
    return ".".join(map(str, row.number))


def _taken(row: Px4Version) -> str:
    flown = f"flown on {row.flown}" if row.flown else "whose differences were read in its source, and not flown"
    return f"it is taken for v{_dotted(row)}, {flown}"
