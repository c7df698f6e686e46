"""A vehicle's end of the fleet over Zenoh: a session whose callbacks only enqueue.

    fleet/<id>/state     best effort, express, real-time priority; the last sample is kept for late joiners
    fleet/<id>/plan      reliable; the last sample is kept for late joiners
    fleet/<id>/alive     liveliness token, there as long as the process lives
    fleet/<id>/command, status, preflight   queryables

Nothing here may hold up the control loop. Every put and reply uses congestion control DROP, `plan` as well: BLOCK would
wait up to five seconds for one stalled link. A lost plan is healed by the agent, which repeats it, as it must anyway: a
cut shorter than the lease loses the last sample on every transport, reliable or not.

Callbacks run in Zenoh's receiving threads (`indirect=False`), which saves one Python thread per declaration and one hop
per message.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Self

import zenoh
import zenoh.ext
from zenoh.handlers import Callback

from companion.io.inbox import Inbox
from companion.io.mailbox import BOUNDS, Bound
from companion.io.transport import (
    PAYLOAD_MAX_BYTES,
    REQUEST_KINDS,
    STATE_TOPIC,
    TOPICS,
    Event,
    Request,
    Sent,
    TransportCounters,
    TransportError,
)
from companion.io.zenoh.configuration import SessionSettings
from companion.io.zenoh.session import close_session, open_session
from companion.io.zenoh.traffic import TcpTraffic


class ZenohTransport:
    """`PeerTransport` over one session."""

    def __init__(
        self, settings: SessionSettings, wake: Callable[[], None], bounds: Mapping[str, Bound] = BOUNDS
    ) -> None:
        if settings.vehicle_id is None:
            raise ValueError("a ZenohTransport belongs to a vehicle; an operator uses ZenohOperatorLink")
        self._settings = settings
        self._own = f"fleet/{settings.vehicle_id}"
        self._inbox = Inbox(settings.vehicle_id, wake, bounds)
        self._session: zenoh.Session | None = None
        self._traffic = TcpTraffic()
        self._closed = False
        self._publishers: dict[str, zenoh.ext.AdvancedPublisher] = {}
        self._declared: list[object] = []
        """kept: what nobody refers to is undeclared"""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self) -> None:
        """Join the fleet; takes up to half a second when nobody else is there yet.

        Raises TransportError when the endpoints cannot be used.
        """
        if self._session is not None or self._closed:
            raise RuntimeError("a ZenohTransport is opened once")
        self._session = open_session(self._settings)
        try:
            self._declare(self._session)
        except zenoh.ZError as error:
            self.close()
            raise TransportError(f"fleet {self._settings.fleet_name!r}: {error}") from error
        except BaseException:
            self.close()
            raise

    def _declare(self, session: zenoh.Session) -> None:
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
        for topic in TOPICS:
            # One subscriber a topic: an AdvancedSubscriber drops what is older than the last sample it delivered from
            # the same session, whatever the key, so one on `fleet/*/*` would lose a state sent before the plan.
            self._declared.append(
                zenoh.ext.declare_advanced_subscriber(
                    session,
                    f"fleet/*/{topic}",
                    Callback(self._on_sample, indirect=False),
                    allowed_origin=zenoh.Locality.REMOTE,
                    history=history,
                )
            )
            self._publishers[topic] = self._declare_publisher(session, topic)
        for kind in REQUEST_KINDS:
            answer = Callback(self._request_handler(kind), indirect=False)
            self._declared.append(session.declare_queryable(f"{self._own}/{kind}", answer, complete=True))
        liveliness = session.liveliness()
        presence = Callback(self._on_liveliness, indirect=False)
        self._declared.append(liveliness.declare_subscriber("fleet/*/alive", presence, history=True))
        # Last, so that whoever sees this vehicle alive can also hear and ask it.
        self._declared.append(liveliness.declare_token(f"{self._own}/alive"))

    def _declare_publisher(self, session: zenoh.Session, topic: str) -> zenoh.ext.AdvancedPublisher:
        state = topic == STATE_TOPIC
        return zenoh.ext.declare_advanced_publisher(
            session,
            f"{self._own}/{topic}",
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME if state else zenoh.Priority.INTERACTIVE_HIGH,
            express=True,
            reliability=zenoh.Reliability.BEST_EFFORT if state else zenoh.Reliability.RELIABLE,
            allowed_destination=zenoh.Locality.REMOTE,
            cache=zenoh.ext.CacheConfig(max_samples=1),
            publisher_detection=True,
        )

    def publish(self, topic: str, payload: bytes) -> None:
        """Send to all peers and keep for late joiners; a failure is counted, not raised."""
        publisher = self._publishers.get(topic)
        if publisher is None:
            raise ValueError(f"topic must be one of {', '.join(TOPICS)} of an open network, got {topic!r}")
        try:
            publisher.put(payload)
        except zenoh.ZError:
            self._inbox.count("publish_failures")

    def drain(self) -> list[Event]:
        """`PeerTransport.drain`."""
        return self._inbox.drain()

    @property
    def counters(self) -> TransportCounters:
        """A copy of the counts so far."""
        return self._inbox.counters

    def sent(self) -> Sent:
        """Over all TCP connections of this process: nothing else in it opens any."""
        return self._traffic.sent()

    def close(self) -> None:
        """Leave the fleet: the others see this vehicle vanish. May be called again."""
        self._closed = True
        self._inbox.close()
        close_session(self._session)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        received_ns = time.monotonic_ns()
        payload = sample.payload
        usable = sample.kind == zenoh.SampleKind.PUT and len(payload) <= PAYLOAD_MAX_BYTES
        self._inbox.put_sample(str(sample.key_expr), payload.to_bytes() if usable else None, received_ns)

    def _on_liveliness(self, sample: zenoh.Sample) -> None:
        alive = sample.kind == zenoh.SampleKind.PUT
        self._inbox.put_presence(str(sample.key_expr), alive, time.monotonic_ns())

    def _request_handler(self, kind: str) -> Callable[[zenoh.Query], None]:
        def on_query(query: zenoh.Query) -> None:
            received_ns = time.monotonic_ns()
            body = b"" if query.payload is None else query.payload.to_bytes()
            self._inbox.put_request(Request(kind, body, _Reply(query, self._reply_failed).send, received_ns))

        return on_query

    def _reply_failed(self) -> None:
        self._inbox.count("reply_failures")


class _Reply:
    """The one answer to one query."""

    def __init__(self, query: zenoh.Query, failed: Callable[[], None]) -> None:
        self._query: zenoh.Query | None = query
        self._failed = failed

    def send(self, payload: bytes) -> None:
        query, self._query = self._query, None
        if query is None:
            raise RuntimeError("a request is answered once")
        try:
            query.reply(query.key_expr, payload)  # with the query's own priority and congestion control
            query.drop()  # type: ignore[no-untyped-call]  # the asker learns at once that no further answer follows
        except zenoh.ZError:
            self._failed()
