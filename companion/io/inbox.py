"""What a vehicle has received and not taken yet: filled by a transport's threads, emptied by the loop."""

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from operator import attrgetter
from typing import Literal

from companion.io.mailbox import BOUNDS, Bound, Mailbox
from companion.io.transport import (
    PAYLOAD_MAX_BYTES,
    Event,
    PresenceChange,
    ReceivedSample,
    Request,
    TransportCounters,
    vehicle_id_of,
)

_received = attrgetter("received_monotonic_ns")


class Inbox:
    """Safe for threads. `wake` is called, outside of the lock, after something came in; it must not raise."""

    def __init__(self, vehicle_id: int, wake: Callable[[], None], bounds: Mapping[str, Bound] = BOUNDS) -> None:
        self._vehicle_id = vehicle_id
        self._wake = wake
        self._lock = threading.Lock()
        self._mailbox: Mailbox[ReceivedSample | Request] = Mailbox(dict(bounds))
        self._presence: dict[int, PresenceChange] = {}
        """one entry a vehicle: a flood of messages cannot push out the news that a vehicle has gone"""
        self._counters = TransportCounters()
        self._closed = False

    def put_sample(self, key: str, payload: bytes | None, received_ns: int) -> None:
        """A peer's sample; None for a payload that is no sample's (too large, a deletion)."""
        if vehicle_id_of(key) is None or payload is None or len(payload) > PAYLOAD_MAX_BYTES:
            self.count("malformed")
        else:
            self._put(key.rpartition("/")[2], ReceivedSample(key, payload, received_ns))

    def put_presence(self, key: str, alive: bool, received_ns: int) -> None:
        """A vehicle came or went; our own presence is no news."""
        vehicle_id = vehicle_id_of(key)
        if vehicle_id == self._vehicle_id:
            return
        with self._lock:
            if self._closed:
                return
            if vehicle_id is None:
                self._counters.malformed += 1
                return
            self._presence[vehicle_id] = PresenceChange(vehicle_id, alive, received_ns)
        self._wake()

    def put_request(self, request: Request) -> None:
        """An operator's question."""
        if len(request.payload) > PAYLOAD_MAX_BYTES:
            self.count("malformed")
        else:
            self._put(request.kind, request)

    def _put(self, kind: str, item: ReceivedSample | Request) -> None:
        with self._lock:
            if self._closed:
                return
            self._mailbox.put(kind, item)
        self._wake()

    def count(self, what: Literal["malformed", "publish_failures", "reply_failures"]) -> None:
        """One more of a field of `TransportCounters`."""
        with self._lock:
            setattr(self._counters, what, getattr(self._counters, what) + 1)

    def drain(self) -> list[Event]:
        """`PeerTransport.drain`."""
        with self._lock:
            if not len(self._mailbox) and not self._presence:
                return []
            events: list[Event] = [*self._mailbox.take(), *self._presence.values()]
            if self._presence:
                self._presence.clear()
                events.sort(key=_received)
            more = len(self._mailbox) > 0
        if more:
            self._wake()
        return events

    @property
    def counters(self) -> TransportCounters:
        """A copy of the counts so far."""
        with self._lock:
            return replace(self._counters, dropped=self._mailbox.dropped)

    def close(self) -> None:
        """Forget what waits, and whatever comes from now on."""
        with self._lock:
            self._closed = True
            self._mailbox.clear()
            self._presence.clear()
