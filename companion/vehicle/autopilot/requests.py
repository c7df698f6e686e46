"""Commands on their way to an autopilot over MAVLink: sent, repeated, answered, given up.

An answer (COMMAND_ACK) names only the command, so commands of one number are asked one after another. What a command
has done shows in the next HEARTBEAT, which comes once a second.
"""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from companion.core.counts import Counts
from companion.core.events import Event, RequestRefused, RequestUnanswered
from companion.vehicle.autopilot.port import Outcome
from companion.wire import mavlink as wire
from companion.wire import px4

RETRY_S = 0.5
TRIES = 8
ANSWER_S = 1.0
"""what is asked once is taken for not answered after this; preflight allows a link no such round trip"""
EFFECT_S = 0.2
"""a HEARTBEAT this much later than an answer knows of what was answered: PX4 makes the two in different threads"""
ACCEPTED, TEMPORARILY_REJECTED, IN_PROGRESS = 0, 1, 5
STREAM = "stream"
"""first word of a request for a message's rate: one that is refused is counted, and worth no word"""


@dataclass(slots=True)
class _Request:
    name: str
    make: Callable[[], bytes]
    once: bool = False
    """whether it may have been done though its answer is lost, and must not be done twice"""
    tries: int = 0
    next_ns: int = 0
    withdrawn: bool = False
    """asked, and wanted no longer: it waits for its answer only"""

    @property
    def given_up(self) -> bool:
        """Whether it is not sent again without an answer."""
        return self.withdrawn or self.tries >= (1 if self.once else TRIES)


class Requests:
    """The commands that are asked of one autopilot."""

    def __init__(self, encode: Callable[..., bytes], counts: Counts, events: list[Event]) -> None:
        self._encode = encode
        """(command, *parameters) -> datagram"""
        self._counts, self._events = counts, events
        self.heartbeat_ns: int | None = None
        """when HEARTBEAT last came (monotonic ns)"""
        self.now_ns = 0
        """monotonic"""
        self._queues: dict[int, deque[_Request]] = {}
        """by command number"""
        self._refused: dict[str, int] = {}
        """name of a request -> when it may be asked again after a refusal (monotonic ns)"""
        self._outcomes: dict[str, Outcome] = {}
        self._mode_asked: str | None = None

    def ask(self, name: str, command: int, *parameters: float, once: bool = False) -> None:
        """Ask for a command, retried until answered.

        The same name is not queued twice, nor right after a refusal, nor, once accepted, before a heartbeat could have
        shown what came of it. `once`: it is sent a single time, unless the answer says that it was not done.
        """
        if self.now_ns < self._refused.get(name, 0) or self._effect_is_open(name):
            return
        queue = self._queues.setdefault(command, deque())
        if all(r.name != name for r in queue):
            queue.append(_Request(name, lambda: self._encode(command, *parameters), once))

    def ask_mode(self, name: str, command: int, *parameters: float) -> None:
        """Ask for a flight mode; one asked for before is forgotten."""
        if self._mode_asked is not None and self._mode_asked != name:
            self._queues[command].clear()
            self._outcomes.pop(self._mode_asked, None)
        self._mode_asked = name
        self.ask(name, command, *parameters)

    def outcome(self, name: str) -> Outcome | None:
        """What came of a request, once a heartbeat has come that knows of it; None before, and where it was refused."""
        return None if self._effect_is_open(name) else self._outcomes.get(name)

    def _effect_is_open(self, name: str) -> bool:
        """Whether a request was accepted, or may have been, and no heartbeat that knows of it has come yet."""
        outcome = self._outcomes.get(name)
        if outcome is None or self.heartbeat_ns is None:
            return outcome is not None
        return self.heartbeat_ns < outcome.since_ns + (round(EFFECT_S * 1e9) if outcome.accepted else 0)

    def withdraw(self, names: Iterable[str]) -> None:
        """Ask no more for what is wanted no longer, or was seen to be done though its answer was lost."""
        wanted_no_more = frozenset(names)
        for name in wanted_no_more:
            self._outcomes.pop(name, None)
        for queue in self._queues.values():
            for request in [r for r in queue if r.name in wanted_no_more]:
                if request.tries == 0:
                    queue.remove(request)
                else:
                    request.withdrawn = True

    def cancel(self) -> None:
        """Ask for nothing more."""
        self._queues.clear()
        self._outcomes.clear()
        self._mode_asked = None

    def answered(self, answer: wire.CommandAnswer, now_ns: int) -> None:
        """An answer came."""
        queue = self._queues.get(answer.command)
        if answer.command == px4.REQUEST_MESSAGE:
            return  # asked for again until the message itself comes
        if not queue or queue[0].tries == 0:
            self._counts["answer to nothing asked"] += 1
            return
        request = queue[0]
        if request.withdrawn:
            queue.popleft()
            return
        if request.once and answer.result == TEMPORARILY_REJECTED:
            # It was certainly not done, and may be asked anew.
            queue.popleft()
            self._refused[request.name] = now_ns + round(RETRY_S * 1e9)
            return
        if answer.result in (TEMPORARILY_REJECTED, IN_PROGRESS) and (request.once or request.tries < TRIES):
            request.next_ns = now_ns + round((ANSWER_S if request.once else RETRY_S) * 1e9)
            return
        queue.popleft()
        if answer.result == ACCEPTED:
            self._outcomes[request.name] = Outcome(now_ns, accepted=True)
            return
        self._refused[request.name] = now_ns + round(RETRY_S * 1e9)
        self._counts[f"refused: {request.name.split()[0]}"] += 1
        if not request.name.startswith(STREAM):
            self._events.append(RequestRefused(request.name, answer.result))

    def due(self) -> list[bytes]:
        """Datagrams to send now, retries among them."""
        out = []
        for queue in self._queues.values():
            while queue and queue[0].given_up and self.now_ns >= queue[0].next_ns:
                self._give_up(queue.popleft())
            if queue and self.now_ns >= queue[0].next_ns:
                queue[0].tries += 1
                queue[0].next_ns = self.now_ns + round((ANSWER_S if queue[0].once else RETRY_S) * 1e9)
                out.append(queue[0].make())
        return out

    def _give_up(self, request: _Request) -> None:
        if request.withdrawn:
            return
        if request.once:
            self._outcomes[request.name] = Outcome(self.now_ns, accepted=False)
        self._counts["unanswered"] += 1
        self._events.append(RequestUnanswered(request.name))

    def deadlines_ns(self) -> list[int]:
        """When `due` next has something to say (monotonic), for each command number that waits."""
        return [queue[0].next_ns for queue in self._queues.values() if queue]
