"""The door to the fleet's network: what a vehicle and an operator need of whatever carries their bytes.

Keys, all within one fleet:

    fleet/<id>/state     what a vehicle tells of itself; may be lost; the last one reaches late joiners
    fleet/<id>/plan      the motion that it follows; the last one reaches late joiners
    fleet/<id>/command   an operator's command, answered by the vehicle's loop
    fleet/<id>/status    a question for the vehicle's account of itself
    fleet/<id>/preflight a question for its own checks and what a comparison needs; asked for "clock", its time alone

An adapter is one class for each end. It never blocks the vehicle's loop, it hands nobody its own samples, and it puts
what comes in into an `Inbox`, whose bounds and counts are then the same for every transport. `io.network` chooses the
adapter; tests/process/test_transports.py says what every one of them must do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol, Self

from companion.errors import CompanionError

VEHICLE_ID_MAX: Final = 250
STATE_TOPIC: Final = "state"
PLAN_TOPIC: Final = "plan"
TOPICS: Final = (STATE_TOPIC, PLAN_TOPIC)
"""what vehicles publish and hear from each other"""
REQUEST_KINDS: Final = ("command", "status", "preflight")
PAYLOAD_MAX_BYTES: Final = 65_536
"""larger payloads are counted as malformed and not delivered"""


class TransportError(CompanionError):
    """The fleet's network could not be opened or used."""


@dataclass(frozen=True, slots=True)
class ReceivedSample:
    """What a vehicle published."""

    key: str
    """`fleet/<id>/<topic>`, id in 1..250; our own only when somebody else speaks under it"""
    payload: bytes
    received_monotonic_ns: int


@dataclass(frozen=True, slots=True)
class PresenceChange:
    """Another vehicle's process appeared or vanished."""

    vehicle_id: int
    alive: bool
    received_monotonic_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Request:
    """An operator's question; unanswered, it simply ends, and the operator asks again."""

    kind: str
    """one of `REQUEST_KINDS`"""
    payload: bytes
    reply: Callable[[bytes], None]
    """answers once, from any thread; an operator who has gone is counted, a second answer raises RuntimeError"""
    received_monotonic_ns: int


Event = ReceivedSample | PresenceChange | Request


class Sent(NamedTuple):
    """What was put on the wire."""

    packets: int
    bytes: int
    """headers included"""


@dataclass(slots=True)
class TransportCounters:
    """What went wrong so far, as counts."""

    dropped: int = 0
    """events that the loop was too slow to take, oldest first"""
    malformed: int = 0
    """samples with a foreign key, a deletion, or an oversized payload"""
    publish_failures: int = 0
    reply_failures: int = 0


class PeerTransport(Protocol):
    """A vehicle's end: `publish` sends, `drain` takes what came in. Neither blocks.

    Its constructor gets a function `wake`, which it calls from whatever thread after something came in.
    """

    def open(self) -> None:
        """Join the fleet: hear every topic, answer every kind of request, be present. TransportError if it cannot."""

    def publish(self, topic: str, payload: bytes) -> None:
        """Send to all peers and keep for late joiners; a failure is counted, not raised."""

    def drain(self) -> list[Event]:
        """What came in since the last call, in the order of reception, no more than one turn of the loop can bear.

        Of what is left the loop is woken again at once. A vehicle's presence is told once, as it is now, however often
        it changed in between.
        """

    @property
    def counters(self) -> TransportCounters:
        """A copy of the counts so far."""

    def sent(self) -> Sent:
        """What this end has put on the wire so far; none where there is no wire."""

    def close(self) -> None:
        """Leave the fleet: the others see this vehicle vanish. May be called again."""


class OperatorLink(Protocol):
    """An operator's end: who is there, and questions to vehicles with their answers."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def open(self) -> None:
        """Connect to the fleet. TransportError if it cannot."""

    def alive(self) -> frozenset[int]:
        """Ids of the vehicles that this link sees now; just after opening not all are connected, see `wait_alive`."""

    def wait_alive(self, vehicle_ids: Iterable[int], timeout_s: float) -> frozenset[int]:
        """Wait until all of these are alive, at most `timeout_s`; returns who is alive then."""

    def ask(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, tuple[bytes, ...]]:
        """Ask these vehicles at once; silent ones again every `retry_s` until `timeout_s`. (): never answered.

        More than one answer: several companions answer under one id. A vehicle may see a question more than once, so a
        command has to carry an id of its own.
        """

    def ask_timed(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, tuple[bytes, int, int] | None]:
        """Each one's first answer, with when it was first asked and when it answered (this machine's UTC, ns)."""

    def wait(self, seconds: float) -> None:
        """Let time pass, in which the link may find more companions."""

    def close(self) -> None:
        """Leave; may be called again."""


Connect = Callable[[Callable[[], None]], PeerTransport]
"""makes a vehicle's end, not open yet, from the loop's `wake`"""


def vehicle_id_of(key: str) -> int | None:
    """The id in `fleet/<id>/<topic>`, None when the key is not of that form."""
    parts = key.split("/")
    if len(parts) != 3 or parts[0] != "fleet":
        return None
    digits = parts[1]
    if not (digits.isascii() and digits.isdigit()) or digits[0] == "0" or len(digits) > 3:
        return None
    vehicle_id = int(digits)
    return vehicle_id if vehicle_id <= VEHICLE_ID_MAX else None
