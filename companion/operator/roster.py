"""What each vehicle last said of itself: who answers, at which place, who cannot be read, who is two companions."""

from collections.abc import Iterable
from typing import Protocol

from companion.config import FleetConfig
from companion.errors import RefusedError, WireError
from companion.terminal import one_line
from companion.wire.operator import ENDING, PLACES_MAX, Place, Status, decode

STATUS_TIMEOUT_S = 1.0
RETRY_S = 0.5
LOOK_AGAIN_S = 0.5
"""a vehicle that hears its own id from elsewhere and answers alone is asked again after so long, as often as that fits
into the time for an answer: a liar delays a kill by no more"""
UP_TOGETHER_S = 30.0
"""companions that began within this are told as one start"""


class Link(Protocol):
    """How questions reach the vehicles (`io.transport.OperatorLink`)."""

    def ask(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, tuple[bytes, ...]]:
        """Answers by vehicle id: none from the silent, more than one where several companions answer under one id."""

    def ask_timed(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, tuple[bytes, int, int] | None]:
        """Each one's first answer, with when it was asked and when it answered (UTC, ns)."""

    def wait(self, seconds: float) -> None:
        """Let time pass, in which the link may find more companions."""


class Roster:
    """The fleet's vehicles as they last answered."""

    def __init__(self, config: FleetConfig, link: Link) -> None:
        self.ids = tuple(v.id for v in config.vehicles)
        self._fleet_name = config.fleet.name
        self._link = link
        self.unreadable: dict[int, str] = {}
        """vehicle id -> what is wrong with its last status"""
        self.doubled: dict[int, str] = {}
        """vehicle id -> which companions answer as this one vehicle"""
        self._places: dict[int, dict[int, Place]] = {}
        """vehicle id -> boot id -> where that companion last said to be"""
        self._seen: dict[int, Status] = {}
        """vehicle id -> its last status"""

    def ask(self, timeout_s: float = STATUS_TIMEOUT_S) -> dict[int, Status | None]:
        """Each vehicle's own account of itself; None from the silent, and from the unreadable, who are named there."""
        answers = dict(self._link.ask(self.ids, "status", b"", timeout_s, RETRY_S))
        for _ in range(round(timeout_s / LOOK_AGAIN_S)):
            # That somebody spoke under an id is no second companion, but may be one that the link has not found yet.
            single = [i for i, told in answers.items() if len(told) == 1 and _hears_own_id(told[0], i)]
            if not single:
                break
            self._link.wait(LOOK_AGAIN_S)
            answers |= self._link.ask(single, "status", b"", timeout_s, RETRY_S)
        return {i: self._take(i, answers.get(i, ())) for i in self.ids}

    def _take(self, i: int, answers: tuple[bytes, ...]) -> Status | None:
        """Keep what one vehicle answered: the first account that can be read counts."""
        read = [_read(answer, i) for answer in answers]
        readable = [s for s in read if isinstance(s, Status)]
        faults = [s for s in read if isinstance(s, str)]
        self.unreadable.pop(i, None)
        if faults:
            self.unreadable[i] = faults[0]
        if answers:
            self._places[i] = {}
            self.note_places(i, [s.place for s in readable])
            self.doubled.pop(i, None)
        runs = [f"one up for {s.up_s:.0f} s" for s in readable] + ["one that cannot be read"] * len(faults)
        if len(runs) > 1:
            self.doubled[i] = " and ".join(runs)
        if not readable:
            return None
        self._seen[i] = readable[0]
        return readable[0]

    def places(self, i: int) -> tuple[Place, ...]:
        """Where a vehicle last said to be, once for each of its companions; at most what a command may name."""
        return tuple(self._places.get(i, {}).values())[-PLACES_MAX:]

    def note_places(self, i: int, places: Iterable[Place | None]) -> None:
        """Keep where a vehicle's companions say to be."""
        self._places.setdefault(i, {}).update({p.boot_id: p for p in places if p is not None})

    def refuse_doubles(self, ids: Iterable[int], verb: str, *, both: bool = False) -> None:
        """RefusedError if one of these is two companions, unless the verb ends a flight and is meant for `both`."""
        if self.doubled.keys().isdisjoint(ids) or (both and verb in ENDING):
            return
        raise RefusedError(
            f"{'; '.join(self.two_companions)}: does another fleet of the name {self._fleet_name!r} fly here? Nobody "
            "was commanded; end one of them (land, release and kill take --both)"
        )

    @property
    def left_out(self) -> tuple[str, ...]:
        """Whoever answers what cannot be read, as sentences."""
        return tuple(f"vehicle {i}'s status cannot be read: {why}" for i, why in sorted(self.unreadable.items()))

    @property
    def two_companions(self) -> tuple[str, ...]:
        """Which vehicles are more than one companion, as sentences."""
        return tuple(f"vehicle {i} is two companions, {runs}" for i, runs in sorted(self.doubled.items()))

    @property
    def reached(self) -> str:
        """Which flight the last statuses were of."""
        if not self._seen:
            return f"fleet {self._fleet_name}: nobody"
        names = sorted({one_line(s.fleet) for s in self._seen.values()})
        shortest, longest = (f(s.up_s for s in self._seen.values()) for f in (min, max))
        since = f"{longest:.0f} s" if longest - shortest < UP_TOGETHER_S else f"{shortest:.0f} to {longest:.0f} s"
        return f"fleet {' and '.join(names)}, companions up for {since}"


def _read(answer: bytes, vehicle_id: int) -> Status | str:
    """A status, or what is wrong with it."""
    try:
        status = decode(Status, answer)
    except WireError as error:
        return error.detail
    return status if status.vehicle == vehicle_id else f"it is vehicle {status.vehicle}'s"


def _hears_own_id(answer: bytes, vehicle_id: int) -> bool:
    status = _read(answer, vehicle_id)
    return isinstance(status, Status) and status.own_id_heard
