"""Reading an autopilot's parameters on the ground: in rounds, a few at a time, since others may set them."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

PARAMETER_TRIES = 6
PARAMETER_RETRY_S = 0.5
PARAMETERS_AT_ONCE = 3
"""requests on the way at a time: a serial line carries the positions too"""
PARAMETER_PERIOD_NS = 5_000_000_000
"""how often all are read anew on the ground, since a ground station may set them"""


@dataclass(slots=True)
class ParameterReader:
    """Reads the parameters that preflight looks at, in rounds; one that never comes is missing until it does.

    Of the names of one setting the one that has answered is read on, and the others are not asked for.
    """

    names: tuple[str, ...]
    same_setting: Callable[[str], Iterable[str]]
    """all names of a name's setting, its own included"""
    values: dict[str, float | int] = field(default_factory=dict)
    missing: set[str] = field(default_factory=set)
    """asked for, and never came"""
    _open: dict[str, tuple[int, int]] = field(init=False)
    """still wanted in this round: (tries so far, when the next is due)"""
    _round_ns: int = 0
    """when the next round begins"""

    def __post_init__(self) -> None:
        self._open = dict.fromkeys(self.names, (0, 0))

    def restart(self) -> None:
        """Forget: the autopilot has booted anew."""
        self.values.clear()
        self.missing.clear()
        self._open = dict.fromkeys(self.names, (0, 0))

    def take(self, name: str, value: float | int) -> None:
        """A value that came, asked for or not."""
        if name in self.names:
            self.values[name] = value
            for other in self.same_setting(name):
                self.missing.discard(other)
                self._open.pop(other, None)

    def refused(self, name: str) -> None:
        """The autopilot says that it has none of that name: it is not asked for again in this round."""
        if self._open.pop(name, None) is not None:
            self.values.pop(name, None)
            self.missing.add(name)

    def due(self, now_ns: int) -> list[str]:
        """Names to ask for now."""
        if not self._open and now_ns >= self._round_ns:
            known = self.values.keys()
            wanted = [n for n in self.names if n in known or known.isdisjoint(self.same_setting(n))]
            self._open = dict.fromkeys(wanted, (0, 0))
        asked = []
        for name, (tries, next_ns) in list(self._open.items())[:PARAMETERS_AT_ONCE]:
            if now_ns < next_ns:
                continue
            if tries >= PARAMETER_TRIES:
                del self._open[name]
                self.values.pop(name, None)
                self.missing.add(name)
            else:
                self._open[name] = (tries + 1, now_ns + round(PARAMETER_RETRY_S * 1e9))
                asked.append(name)
        self._round_ns = now_ns + PARAMETER_PERIOD_NS if self._open else self._round_ns
        return asked

    def next_deadline_ns(self) -> int:
        """When `due` next has something to say (monotonic ns)."""
        waiting = list(self._open.values())[:PARAMETERS_AT_ONCE]
        return min((next_ns for _, next_ns in waiting), default=self._round_ns)
