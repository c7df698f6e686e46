"""The operator's questions, answered by the vehicle's loop once what cannot wait is done."""

from collections.abc import Callable

from companion.core.values import Instant
from companion.io.clock import FleetClock
from companion.io.transport import Request
from companion.vehicle.guard import Guard
from companion.wire.operator import CLOCK_QUESTION, ClockReading, Status, encode

STATUS_LASTS_NS = 50_000_000
"""a status this old is told again: making one takes a good part of a control period; a command makes it anew"""


class Answers:
    """`complete` adds to a status what the process around the agent knows."""

    def __init__(
        self,
        guard: Guard,
        clock: FleetClock,
        complete: Callable[[Status], Status],
        record: Callable[[str, Instant, bytes], None],
    ) -> None:
        self._guard = guard
        self._clock = clock
        self._complete = complete
        self._record = record
        self._status: bytes | None = None
        self._status_ns = 0

    def answer(self, request: Request, now: Instant) -> None:
        """Answer one question; one that raises stays without an answer, and whoever asked asks again."""
        match request.kind:
            case "command":
                answer: bytes | None = self._command(request.payload, now)
            case "preflight":
                answer = self._guard.reply("preflight", lambda: self._preflight(request, now))
            case _:
                answer = self._recent_status(now)
        if answer is not None:
            request.reply(answer)

    def _command(self, payload: bytes, now: Instant) -> bytes:
        self._record("input/command", now, payload)
        answer = self._guard.receive_command(payload, now)
        self._record("output/answer", now, answer)
        self._status = None
        return answer

    def _preflight(self, request: Request, now: Instant) -> bytes:
        agent = self._guard.agent
        if request.payload != CLOCK_QUESTION:
            return encode(agent.operator.preflight_report(now))
        received_ns = self._clock.at(request.received_monotonic_ns).fleet_ns
        answered_ns = self._clock.now().fleet_ns
        return encode(ClockReading(boot_id=agent.boot_id, received_ns=received_ns, answered_ns=answered_ns))

    def _recent_status(self, now: Instant) -> bytes | None:
        if self._status is None or now.monotonic_ns - self._status_ns > STATUS_LASTS_NS:
            self._status = self._guard.reply("status", lambda: self._make_status(now))
            self._status_ns = now.monotonic_ns
        return self._status

    def _make_status(self, now: Instant) -> bytes:
        return encode(self._complete(self._guard.agent.status(now)))
