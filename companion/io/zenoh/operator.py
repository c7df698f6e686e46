"""An operator's end of the fleet over Zenoh: who is there, and questions with everybody's answers."""

from __future__ import annotations

import time
from collections.abc import Iterable
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Final, Self

import zenoh
from zenoh.handlers import Callback

from companion.io.transport import TransportError, vehicle_id_of
from companion.io.zenoh.configuration import SessionSettings
from companion.io.zenoh.session import close_session, open_session

ASK_INTERVAL_S: Final = 0.03
"""an operator asks the same kind of question no more often, so that none of its own is left out"""
ANSWERS_MAX: Final = 8
"""answers to one question: more than one is a fault already"""
_LIVELINESS_TIMEOUT_S: Final = 1.0
_ALIVE_POLL_S: Final = 0.02
SETTLED_S: Final = 0.2
"""a session is settled once it has found nobody new for so long. Just after it opens, vehicles of one machine are found
within 30 ms of each other: who asks before that hears one of two companions and takes it for the only one"""


class ZenohOperatorLink:
    """`OperatorLink` over one session."""

    def __init__(self, settings: SessionSettings) -> None:
        if settings.vehicle_id is not None:
            raise ValueError(f"a ZenohOperatorLink has no vehicle id, got {settings.vehicle_id}")
        self._settings = settings
        self._asked_s: dict[str, float] = {}
        """kind -> when it was last asked"""
        self._session: zenoh.Session | None = None

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self) -> None:
        """Connect to the fleet; raises TransportError when the endpoints cannot be used."""
        if self._session is not None:
            raise RuntimeError("a ZenohOperatorLink is opened once")
        self._session = open_session(self._settings)

    def close(self) -> None:
        """Leave; may be called again."""
        close_session(self._session)

    def alive(self) -> frozenset[int]:
        """Ids of the vehicles that this link sees now; just after opening not all are connected, see `wait_alive`."""
        replies = self._opened().liveliness().get("fleet/*/alive", timeout=_LIVELINESS_TIMEOUT_S)
        found = set()
        for reply in replies:
            if (sample := reply.ok) is not None and (vehicle_id := vehicle_id_of(str(sample.key_expr))) is not None:
                found.add(vehicle_id)
        return frozenset(found)

    def wait_alive(self, vehicle_ids: Iterable[int], timeout_s: float) -> frozenset[int]:
        """Wait until all of these are alive and the session is settled, at most `timeout_s` for the first; returns who
        is alive then."""
        expected = frozenset(vehicle_ids)
        deadline_s = time.monotonic() + timeout_s
        while not expected <= self.alive() and time.monotonic() < deadline_s:
            time.sleep(_ALIVE_POLL_S)
        self._settle()
        return self.alive()

    def _settle(self) -> None:
        """Wait until nobody new has been found for SETTLED_S, at most for ten times that."""
        info = self._opened().info
        known, since_s = frozenset(map(str, info.peers_zid())), time.monotonic()
        deadline_s = since_s + 10.0 * SETTLED_S
        while (now_s := time.monotonic()) < min(since_s + SETTLED_S, deadline_s):
            time.sleep(_ALIVE_POLL_S)
            found = frozenset(map(str, info.peers_zid()))
            if not found <= known:
                known, since_s = known | found, now_s

    def ask(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, tuple[bytes, ...]]:
        """Ask these vehicles at once; silent ones again every `retry_s` until `timeout_s`. (): never answered.

        More than one answer: several companions answer under one id. A vehicle may see a question more than once, so a
        command has to carry an id of its own.
        """
        answers = self._ask(vehicle_ids, kind, payload, timeout_s, retry_s)
        return {i: tuple(payload for payload, _, _ in found) for i, found in answers.items()}

    def ask_timed(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, tuple[bytes, int, int] | None]:
        """Each one's first answer, with when it was first asked and when it answered (this machine's UTC, ns)."""
        answers = self._ask(vehicle_ids, kind, payload, timeout_s, retry_s)
        return {i: found[0] if found else None for i, found in answers.items()}

    def wait(self, seconds: float) -> None:
        """Let time pass, in which the session may find more companions."""
        time.sleep(seconds)

    def _ask(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, list[tuple[bytes, int, int]]]:
        """By vehicle, all answers to the first of its questions that everybody who heard it has answered."""
        if not retry_s > 0:
            raise ValueError(f"retry_s must be > 0 s, got {retry_s}")
        session = self._opened()
        questions: dict[int, list[_Question]] = {i: [] for i in vehicle_ids}
        answered: dict[int, _Question] = {}
        inbox: SimpleQueue[_Question] = SimpleQueue()
        cancellation = zenoh.CancellationToken()
        now_s = self._wait_turn(kind)
        deadline_s = now_s + timeout_s
        next_round_s = now_s
        try:
            while len(answered) < len(questions) and now_s < deadline_s:
                if now_s >= next_round_s:
                    self._asked_s[kind] = now_s
                    for vehicle_id in sorted(questions.keys() - answered.keys()):
                        question = _Question(vehicle_id, inbox)
                        questions[vehicle_id].append(question)
                        session.get(
                            f"fleet/{vehicle_id}/{kind}",
                            Callback(question.take, question.ended, indirect=False),
                            # Everybody who answers under this id, and all that they say: not the nearest one alone.
                            target=zenoh.QueryTarget.ALL,
                            consolidation=zenoh.ConsolidationMode.NONE,
                            payload=payload,
                            timeout=deadline_s - now_s,
                            congestion_control=zenoh.CongestionControl.DROP,
                            priority=zenoh.Priority.INTERACTIVE_HIGH,
                            express=True,
                            cancellation_token=cancellation,
                        )
                    next_round_s = now_s + retry_s
                with suppress(Empty):
                    question = inbox.get(timeout=max(0.0, min(next_round_s, deadline_s) - now_s))
                    if question.answers:
                        answered.setdefault(question.vehicle_id, question)
                now_s = time.monotonic()
        except zenoh.ZError as error:
            raise TransportError(f"fleet {self._settings.fleet_name!r}: {error}") from error
        finally:
            cancellation.cancel()  # type: ignore[no-untyped-call]
        found: dict[int, list[tuple[bytes, int, int]]] = {}
        for i, asked in questions.items():
            # Where somebody who heard it never answers, what the others said by now counts.
            best = answered.get(i) or next((q for q in asked if q.answers), None)
            found[i] = [] if best is None else [(a, asked[0].asked_ns, ns) for a, ns in tuple(best.answers)]
        return found

    def _wait_turn(self, kind: str) -> float:
        """Let ASK_INTERVAL_S pass since the last question of a kind; returns the time then (monotonic, s)."""
        wait_s = self._asked_s.get(kind, -ASK_INTERVAL_S) + ASK_INTERVAL_S - time.monotonic()
        if wait_s > 0:
            time.sleep(min(wait_s, ASK_INTERVAL_S))
        return time.monotonic()

    def _opened(self) -> zenoh.Session:
        if self._session is None:
            raise RuntimeError("the link is not open")
        return self._session


class _Question:
    """One question on its way to everybody who answers under an id, with the answers so far."""

    def __init__(self, vehicle_id: int, inbox: SimpleQueue[_Question]) -> None:
        self.vehicle_id = vehicle_id
        self.asked_ns = time.time_ns()
        self.answers: list[tuple[bytes, int]] = []
        """each with its time of arrival (UTC, ns)"""
        self._inbox = inbox

    def take(self, reply: zenoh.Reply) -> None:
        """Called by Zenoh with each answer."""
        if (sample := reply.ok) is not None and len(self.answers) < ANSWERS_MAX:
            self.answers.append((sample.payload.to_bytes(), time.time_ns()))

    def ended(self) -> None:
        """Called by Zenoh once no further answer follows."""
        self._inbox.put(self)
