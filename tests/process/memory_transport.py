"""A fleet's network in the memory of one process: what a transport is, in its smallest form."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Self

from companion.io.inbox import Inbox
from companion.io.transport import TOPICS, Event, Request, Sent, TransportCounters


@dataclass
class Bus:
    """Who is there, and the last sample on each key."""

    lock: threading.RLock = field(default_factory=threading.RLock)
    vehicles: list[MemoryTransport] = field(default_factory=list)
    last: dict[str, tuple[MemoryTransport, bytes]] = field(default_factory=dict)


class MemoryTransport:
    """`PeerTransport` on a bus."""

    def __init__(self, bus: Bus, vehicle_id: int, wake: Callable[[], None]) -> None:
        self.id = vehicle_id
        self.inbox = Inbox(vehicle_id, wake)
        self._bus = bus
        self._sent = Sent(0, 0)

    def open(self) -> None:
        now_ns = time.monotonic_ns()
        with self._bus.lock:
            for key, (_, payload) in self._bus.last.items():
                self.inbox.put_sample(key, payload, now_ns)
            for other in self._bus.vehicles:
                self.inbox.put_presence(f"fleet/{other.id}/alive", True, now_ns)
                other.inbox.put_presence(f"fleet/{self.id}/alive", True, now_ns)
            self._bus.vehicles.append(self)

    def publish(self, topic: str, payload: bytes) -> None:
        if topic not in TOPICS:
            raise ValueError(f"topic must be one of {', '.join(TOPICS)}, got {topic!r}")
        with self._bus.lock:
            if self not in self._bus.vehicles:
                self.inbox.count("publish_failures")
                return
            key, now_ns = f"fleet/{self.id}/{topic}", time.monotonic_ns()
            self._bus.last[key] = self, payload
            for other in self._bus.vehicles:
                if other is not self:
                    self._sent = Sent(self._sent.packets + 1, self._sent.bytes + len(payload))
                    other.inbox.put_sample(key, payload, now_ns)

    def drain(self) -> list[Event]:
        return self.inbox.drain()

    @property
    def counters(self) -> TransportCounters:
        return self.inbox.counters

    def sent(self) -> Sent:
        return self._sent

    def close(self) -> None:
        self.inbox.close()
        with self._bus.lock:
            if self not in self._bus.vehicles:
                return
            self._bus.vehicles.remove(self)
            for key in [k for k, (whose, _) in self._bus.last.items() if whose is self]:
                del self._bus.last[key]
            for other in self._bus.vehicles:
                other.inbox.put_presence(f"fleet/{self.id}/alive", False, time.monotonic_ns())


class _Answer:
    """The one answer to one request."""

    def __init__(self, vehicle_id: int, inbox: SimpleQueue[tuple[int, bytes, int]]) -> None:
        self._vehicle_id, self._inbox, self._given = vehicle_id, inbox, False

    def send(self, payload: bytes) -> None:
        if self._given:
            raise RuntimeError("a request is answered once")
        self._given = True
        self._inbox.put((self._vehicle_id, payload, time.time_ns()))


class MemoryOperatorLink:
    """`OperatorLink` on a bus."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None: ...

    def open(self) -> None: ...

    def close(self) -> None: ...

    def wait(self, seconds: float) -> None:
        time.sleep(seconds)

    def alive(self) -> frozenset[int]:
        with self._bus.lock:
            return frozenset(v.id for v in self._bus.vehicles)

    def wait_alive(self, vehicle_ids: Iterable[int], timeout_s: float) -> frozenset[int]:
        wanted, until_s = frozenset(vehicle_ids), time.monotonic() + timeout_s
        while not wanted <= self.alive() and time.monotonic() < until_s:
            time.sleep(0.01)
        return self.alive()

    def _ask(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, list[tuple[bytes, int]]]:
        answers: dict[int, list[tuple[bytes, int]]] = {i: [] for i in vehicle_ids}
        given: SimpleQueue[tuple[int, bytes, int]] = SimpleQueue()
        now_s = time.monotonic()
        until_s, again_s = now_s + timeout_s, now_s
        waiting = 0
        while now_s < until_s and (waiting > 0 or not all(answers.values())):
            if now_s >= again_s:
                again_s = now_s + retry_s
                with self._bus.lock:
                    asked = [v for v in self._bus.vehicles if v.id in answers and not answers[v.id]]
                waiting = len(asked)
                for v in asked:
                    v.inbox.put_request(Request(kind, payload, _Answer(v.id, given).send, time.monotonic_ns()))
            try:
                i, answer, at_ns = given.get(timeout=max(0.0, min(again_s, until_s) - time.monotonic()))
                answers[i].append((answer, at_ns))
                waiting -= 1
            except Empty:
                waiting = 0
            now_s = time.monotonic()
        return answers

    def ask(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, tuple[bytes, ...]]:
        found = self._ask(vehicle_ids, kind, payload, timeout_s, retry_s)
        return {i: tuple(payload for payload, _ in answers) for i, answers in found.items()}

    def ask_timed(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, tuple[bytes, int, int] | None]:
        asked_ns = time.time_ns()
        found = self._ask(vehicle_ids, kind, payload, timeout_s, retry_s)
        return {i: (answers[0][0], asked_ns, answers[0][1]) if answers else None for i, answers in found.items()}
