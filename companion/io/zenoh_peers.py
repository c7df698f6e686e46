"""The fleet's network: a Zenoh session whose callbacks only enqueue.

Keys, all below the fleet's namespace (its name):

    fleet/<id>/state     best effort, express, real-time priority; the last sample is kept for late joiners
    fleet/<id>/plan      reliable; the last sample is kept for late joiners (so with any further topic)
    fleet/<id>/alive     liveliness token, there as long as the process lives
    fleet/<id>/command   queryable: an operator's command, answered by the vehicle's loop
    fleet/<id>/status    queryable: the vehicle's status
    fleet/<id>/preflight queryable: its own checks and what a comparison needs; asked for "clock", its time alone

Nothing here may hold up the control loop. Every put and reply uses congestion control DROP, `plan` as well: BLOCK would
wait up to five seconds for one stalled link. A lost plan is healed by the agent, which repeats it, as it must anyway: a
cut shorter than the lease loses the last sample on every transport, reliable or not.

Callbacks run in Zenoh's receiving threads (`indirect=False`), which saves one Python thread per declaration and one hop
per message; they append to a bounded queue, call `wake` and return. Sessions are peers, also the operator's: peers do
not relay, so a client would hear the one vehicle that it is connected to.
"""

from __future__ import annotations

import ipaddress
import json
import re
import threading
import time
import zlib
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any, Final, Literal, Self, assert_never

import zenoh
import zenoh.ext
from zenoh.handlers import Callback

from companion.errors import CompanionError, ConfigError
from companion.io.mailbox import BOUNDS, Mailbox

__all__ = [
    "Event",
    "NetworkCounters",
    "OperatorLink",
    "PeerMessage",
    "PeerNetwork",
    "PeerNetworkError",
    "PeerNetworkSettings",
    "PresenceChange",
    "Request",
    "mesh_endpoints",
    "scouting_port",
    "zenoh_configuration",
]

VEHICLE_ID_MAX: Final = 250
STATE_TOPIC: Final = "state"
PLAN_TOPIC: Final = "plan"
TOPICS: Final = (STATE_TOPIC, PLAN_TOPIC)
"""what vehicles publish and hear from each other"""
REQUEST_KINDS: Final = ("command", "status", "preflight")

PAYLOAD_MAX_BYTES: Final = 65_536
"""larger payloads are counted as malformed and not delivered"""
STATE_MAX_BYTES: Final = 16_384
"""above the largest state with a digest of 255 entries"""
QUESTION_MAX_BYTES: Final = 1024
"""of a question that is no command"""
PLANS_HZ: Final = 20.0
"""how often a session hears a plan from one other session at most; the rest is left out before Python sees it. Not so
for states: of what a stalled link delivers at once the oldest alone would be heard, and nobody repeats a state soon"""
REQUESTS_HZ: Final = 50.0
"""the same for each kind of question"""
ASK_INTERVAL_S: Final = 0.03
"""an operator asks the same kind of question no more often, so that none of its own is left out"""
MESSAGE_MAX_BYTES: Final = 1 << 20
"""what a session reassembles from fragments at most"""

ANSWERS_MAX: Final = 8
"""answers to one question: more than one is a fault already"""

_SCOUTING_ADDRESS: Final = "224.0.0.224"
_SCOUTING_PORTS: Final = range(20_000, 24_000)
"""below Linux' ephemeral ports and clear of MAVLink's: 14540-14789, 18570-18819, 24540-24789, 25540-25789"""
_RETRY: Final = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5}
_FLEET_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_LIVELINESS_TIMEOUT_S: Final = 1.0
_ALIVE_POLL_S: Final = 0.02


class PeerNetworkError(CompanionError):
    """The fleet's network could not be opened."""


@dataclass(frozen=True, slots=True)
class PeerNetworkSettings:
    """What a session needs to know; `zenoh_configuration` turns it into Zenoh's own configuration."""

    fleet_name: str
    """Zenoh namespace: fleets of different names on one network do not hear each other"""
    vehicle_id: int | None
    """1..250; None for an operator's client"""
    profile: Literal["laptop", "field"] = "laptop"
    listen: tuple[str, ...] = ()
    """Zenoh endpoints, `tcp/127.0.0.1:7450`; on a laptop they switch scouting off, in the field they are required"""
    connect: tuple[str, ...] = ()
    """Zenoh endpoints of the others; all of them: peers do not relay"""
    scouting_port: int | None = None
    """UDP port of the laptop's scouting; None: derived from the fleet's name"""

    def __post_init__(self) -> None:
        if not _FLEET_NAME.fullmatch(self.fleet_name):
            raise ConfigError(
                "fleet name must be 1..64 of A-Z a-z 0-9 _ . - beginning with a letter or digit,"
                f" got {self.fleet_name!r}"
            )
        if self.vehicle_id is not None and not 1 <= self.vehicle_id <= VEHICLE_ID_MAX:
            raise ConfigError(f"vehicle id must be in 1..{VEHICLE_ID_MAX}, got {self.vehicle_id}")
        if self.scouting_port is not None and not 1024 <= self.scouting_port <= 65_535:
            raise ConfigError(f"scouting port must be in 1024..65535, got {self.scouting_port}")
        match self.profile:
            case "laptop":
                for endpoint in (*self.listen, *self.connect):
                    if not _is_loopback(endpoint):
                        raise ConfigError(
                            f"a laptop's endpoints must be on loopback, got {endpoint!r}; or use profile field"
                        )
            case "field":
                if not self.connect and not self.listen:
                    raise ConfigError("profile field needs endpoints to listen on or to connect to, got none")
                if self.vehicle_id is not None and not self.listen:
                    raise ConfigError("profile field needs the endpoints a vehicle listens on, got none")
            case _:
                assert_never(self.profile)


def scouting_port(fleet_name: str) -> int:
    """The UDP port on which a fleet of this name scouts; stable across machines and versions."""
    return _SCOUTING_PORTS[zlib.crc32(fleet_name.encode()) % len(_SCOUTING_PORTS)]


def mesh_endpoints(host: str, port: int = 7447) -> tuple[str, str]:
    """The pair of endpoints of one vehicle in the field: reliable traffic over TCP, best effort over UDP."""
    return f"tcp/{host}:{port}?rel=1", f"udp/{host}:{port}?rel=0"


def zenoh_configuration(settings: PeerNetworkSettings) -> zenoh.Config:
    """Zenoh's configuration for these settings."""
    match settings.profile:
        case "laptop":
            specific = _laptop(settings)
        case "field":
            specific = _field(settings)
        case _:
            assert_never(settings.profile)
    tree = {"mode": "peer", "namespace": settings.fleet_name, "timestamping": {"enabled": True}, **specific}
    tree["transport"]["shared_memory"] = {"enabled": False}
    link = tree["transport"]["link"]
    link["rx"] = {"max_message_size": MESSAGE_MAX_BYTES}
    # An express message fills a whole batch, and of the default's two batches a link the third message within a
    # millisecond is dropped when the machine is busy. Smaller batches keep the memory of thirty links small.
    link["tx"] |= {"batch_size": 8192, "queue": {"size": {"real_time": 16, "interactive_high": 16}}}
    if settings.vehicle_id is not None:
        tree |= _flood_limits(settings.fleet_name, settings.vehicle_id)
    return zenoh.Config.from_json5(json.dumps(tree))


def _flood_limits(fleet_name: str, vehicle_id: int) -> dict[str, Any]:
    """What Zenoh leaves out of what comes in, for each session that is connected.

    It does so in the receiving thread, without the interpreter's lock. These keys have the namespace in front; rules
    with any others do nothing, and nobody says so.
    """

    def topic(name: str) -> str:
        return f"{fleet_name}/fleet/*/{name}"

    def question(kind: str) -> str:
        return f"{fleet_name}/fleet/{vehicle_id}/{kind}"

    puts = [{"key_expr": topic(PLAN_TOPIC), "freq": PLANS_HZ}]
    queries = [{"key_expr": question(kind), "freq": REQUESTS_HZ} for kind in REQUEST_KINDS]
    sizes = [
        ("state", ["put", "reply"], [topic(STATE_TOPIC)], STATE_MAX_BYTES),
        ("plan", ["put", "reply"], [topic(PLAN_TOPIC)], PAYLOAD_MAX_BYTES),
        ("command", ["query"], [question("command")], PAYLOAD_MAX_BYTES),
        ("question", ["query"], [question("status"), question("preflight")], QUESTION_MAX_BYTES),
    ]
    return {
        "downsampling": [
            {"id": name, "messages": messages, "flows": ["ingress"], "rules": rules}
            for name, messages, rules in (("puts", ["put", "delete"], puts), ("queries", ["query"], queries))
        ],
        "low_pass_filter": [
            {"id": name, "messages": messages, "flows": ["ingress"], "key_exprs": keys, "size_limit": size}
            for name, messages, keys, size in sizes
        ],
    }


def _laptop(settings: PeerNetworkSettings) -> dict[str, Any]:
    explicit = bool(settings.listen or settings.connect)
    multicast: dict[str, Any] = {"enabled": False}
    if not explicit:
        port = scouting_port(settings.fleet_name) if settings.scouting_port is None else settings.scouting_port
        # "greater-zid" would leave every second late joiner unconnected until the others' next scouting round, up to
        # eight seconds; with "always" both sides try and one of the two links is refused.
        multicast = {
            "enabled": True,
            "address": f"{_SCOUTING_ADDRESS}:{port}",
            "interface": "lo",
            "ttl": 0,
            "autoconnect": {"peer": ["router", "peer"]},
            "autoconnect_strategy": {"peer": "always"},
        }
    return {
        "listen": {"endpoints": list(settings.listen) or ["tcp/127.0.0.1:0"]},
        "connect": _connect(settings),
        "scouting": {"multicast": multicast, "gossip": {"enabled": False}},
        # One keep-alive a second and link: they are most of an idle mesh's CPU (30 processes on two cores: 31 % of one
        # core in all, 74 % with four a second), and a killed process shows by its closed connection, not by the lease.
        "transport": {"link": {"tx": {"lease": 4000, "keep_alive": 4}}},
    }


def _field(settings: PeerNetworkSettings) -> dict[str, Any]:
    return {
        "listen": {"endpoints": list(settings.listen)},
        "connect": _connect(settings),
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": True}},
        "transport": {
            "link": {"tx": {"lease": 2000, "keep_alive": 8}},
            "unicast": {"max_links": 2, "open_timeout": 1000, "accept_timeout": 1000},
        },
    }


def _connect(settings: PeerNetworkSettings) -> dict[str, Any]:
    return {"endpoints": list(settings.connect), "timeout_ms": -1, "exit_on_failure": False, "retry": _RETRY}


def _is_loopback(endpoint: str) -> bool:
    """Whether a Zenoh endpoint `protocol/host:port?metadata` stays on this machine."""
    protocol, _, rest = endpoint.partition("/")
    if protocol.startswith("unix"):
        return True
    host = re.split(r"[?#]", rest, maxsplit=1)[0].rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True, slots=True)
class PeerMessage:
    """What another vehicle published."""

    key: str
    """`fleet/<id>/<topic>`, id in 1..250 and not our own"""
    payload: bytes
    received_monotonic_ns: int


@dataclass(frozen=True, slots=True)
class PresenceChange:
    """Another vehicle's process appeared or vanished, as its liveliness token tells."""

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
    """answers once, from any thread; an operator who has gone is counted, a second answer raises"""
    received_monotonic_ns: int


Event = PeerMessage | PresenceChange | Request


@dataclass(slots=True)
class NetworkCounters:
    """What went wrong so far, as counts."""

    dropped: int = 0
    """events that the loop was too slow to take, oldest first"""
    malformed: int = 0
    """samples with a foreign key, a deletion, or an oversized payload"""
    own_id_heard: int = 0
    """samples that somebody else published under this vehicle's id"""
    publish_failures: int = 0
    reply_failures: int = 0


class PeerNetwork:
    """A vehicle's session: `publish` sends, `drain` takes what came in. Neither blocks.

    `wake` is called from Zenoh's threads after something was enqueued; it must be quick and must not raise.
    """

    def __init__(
        self,
        settings: PeerNetworkSettings,
        wake: Callable[[], None],
        *,
        topics: tuple[str, ...] = TOPICS,
        states_waiting: int = BOUNDS[STATE_TOPIC].waiting,
    ) -> None:
        if settings.vehicle_id is None:
            raise ValueError("a PeerNetwork belongs to a vehicle; an operator uses OperatorLink")
        if not states_waiting > 0:
            raise ValueError(f"states_waiting must be > 0, got {states_waiting}")
        self._settings = settings
        self._vehicle_id = settings.vehicle_id
        self._wake = wake
        self._topics = topics
        self._lock = threading.Lock()
        self._mailbox: Mailbox[PeerMessage | Request] = Mailbox(
            BOUNDS | {STATE_TOPIC: BOUNDS[STATE_TOPIC]._replace(waiting=states_waiting)}
        )
        self._presence: dict[int, PresenceChange] = {}
        self._counters = NetworkCounters()
        self._closed = False
        self._session: zenoh.Session | None = None
        self._publishers: dict[str, zenoh.ext.AdvancedPublisher] = {}
        self._declared: list[object] = []

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def open(self) -> None:
        """Join the fleet; takes up to half a second when nobody else is there yet.

        Raises PeerNetworkError when the endpoints cannot be used.
        """
        if self._session is not None or self._closed:
            raise RuntimeError("a PeerNetwork is opened once")
        self._session = _open_session(self._settings)
        try:
            self._declare(self._session)
        except zenoh.ZError as error:
            self.close()
            raise PeerNetworkError(f"fleet {self._settings.fleet_name!r}: {error}") from error
        except BaseException:
            self.close()
            raise

    def _declare(self, session: zenoh.Session) -> None:
        own = f"fleet/{self._vehicle_id}"
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
        for topic in self._topics:
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
            self._declared.append(
                session.declare_queryable(
                    f"{own}/{kind}", Callback(self._request_handler(kind), indirect=False), complete=True
                )
            )
        liveliness = session.liveliness()
        self._declared.append(
            liveliness.declare_subscriber("fleet/*/alive", Callback(self._on_liveliness, indirect=False), history=True)
        )
        # Last, so that whoever sees this vehicle alive can also hear and ask it.
        self._declared.append(liveliness.declare_token(f"{own}/alive"))

    def _declare_publisher(self, session: zenoh.Session, topic: str) -> zenoh.ext.AdvancedPublisher:
        state = topic == STATE_TOPIC
        return zenoh.ext.declare_advanced_publisher(
            session,
            f"fleet/{self._vehicle_id}/{topic}",
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
            raise ValueError(f"topic must be one of {', '.join(self._topics)} of an open network, got {topic!r}")
        try:
            publisher.put(payload)
        except zenoh.ZError:
            with self._lock:
                self._counters.publish_failures += 1

    def drain(self) -> list[Event]:
        """What has been received since the last call, in the order of reception, no more than one turn can bear.

        Of what is left the loop is woken again at once. A vehicle's presence is told once, as it is now, however often
        it changed in between.
        """
        if not len(self._mailbox) and not self._presence:
            return []
        with self._lock:
            events: list[Event] = [*self._mailbox.take(), *self._presence.values()]
            if self._presence:
                self._presence.clear()
                events.sort(key=_received)
            more = len(self._mailbox) > 0
        if more:
            self._wake()
        return events

    @property
    def counters(self) -> NetworkCounters:
        """A copy of the counts so far."""
        with self._lock:
            counters = self._counters
            return NetworkCounters(
                self._mailbox.dropped,
                counters.malformed,
                counters.own_id_heard,
                counters.publish_failures,
                counters.reply_failures,
            )

    @property
    def dropped(self) -> int:
        """Events lost because the loop did not drain in time."""
        return self._mailbox.dropped

    @property
    def connected_peers(self) -> int:
        """Sessions this one is connected to, operators included."""
        return 0 if self._session is None or self._closed else len(self._session.info.peers_zid())

    def close(self) -> None:
        """Leave the fleet: the others see this vehicle vanish. May be called again."""
        with self._lock:
            self._closed = True
            self._mailbox.clear()
            self._presence.clear()
        if self._session is not None and not self._session.is_closed():
            _close_session(self._session)

    def _enqueue(self, kind: str, event: PeerMessage | Request) -> None:
        with self._lock:
            if self._closed:
                return
            self._mailbox.put(kind, event)
        self._wake()

    def _on_sample(self, sample: zenoh.Sample) -> None:
        received_ns = time.monotonic_ns()
        key = str(sample.key_expr)
        vehicle_id = _vehicle_id(key)
        payload = sample.payload
        if vehicle_id == self._vehicle_id:
            with self._lock:
                self._counters.own_id_heard += 1
        if vehicle_id is None or sample.kind != zenoh.SampleKind.PUT or len(payload) > PAYLOAD_MAX_BYTES:
            with self._lock:
                self._counters.malformed += 1
        else:
            self._enqueue(key.rpartition("/")[2], PeerMessage(key, payload.to_bytes(), received_ns))

    def _on_liveliness(self, sample: zenoh.Sample) -> None:
        received_ns = time.monotonic_ns()
        vehicle_id = _vehicle_id(str(sample.key_expr))
        if vehicle_id == self._vehicle_id:
            return
        with self._lock:
            if self._closed:
                return
            if vehicle_id is None:
                self._counters.malformed += 1
                return
            # One entry per vehicle: a flood of messages cannot push out the news that a vehicle has gone.
            self._presence[vehicle_id] = PresenceChange(vehicle_id, sample.kind == zenoh.SampleKind.PUT, received_ns)
        self._wake()

    def _request_handler(self, kind: str) -> Callable[[zenoh.Query], None]:
        def on_query(query: zenoh.Query) -> None:
            received_ns = time.monotonic_ns()
            payload = query.payload
            if payload is not None and len(payload) > PAYLOAD_MAX_BYTES:
                with self._lock:
                    self._counters.malformed += 1
                return
            body = b"" if payload is None else payload.to_bytes()
            self._enqueue(kind, Request(kind, body, _Reply(query, self._reply_failed).send, received_ns))

        return on_query

    def _reply_failed(self) -> None:
        with self._lock:
            self._counters.reply_failures += 1


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


class OperatorLink:
    """An operator's client: who is there, and questions to vehicles with their answers."""

    def __init__(self, settings: PeerNetworkSettings) -> None:
        if settings.vehicle_id is not None:
            raise ValueError(f"an OperatorLink has no vehicle id, got {settings.vehicle_id}")
        self._settings = settings
        self._asked_s: dict[str, float] = {}
        """kind -> when it was last asked"""
        self._session: zenoh.Session | None = None

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def open(self) -> None:
        """Connect to the fleet; raises PeerNetworkError when the endpoints cannot be used."""
        if self._session is not None:
            raise RuntimeError("an OperatorLink is opened once")
        self._session = _open_session(self._settings)

    def close(self) -> None:
        """Leave; may be called again."""
        if self._session is not None and not self._session.is_closed():
            _close_session(self._session)

    def alive(self) -> frozenset[int]:
        """Ids of the vehicles that this link sees now; just after opening not all are connected, see `wait_alive`."""
        replies = self._opened().liveliness().get("fleet/*/alive", timeout=_LIVELINESS_TIMEOUT_S)
        found = set()
        for reply in replies:
            if (sample := reply.ok) is not None and (vehicle_id := _vehicle_id(str(sample.key_expr))) is not None:
                found.add(vehicle_id)
        return frozenset(found)

    def wait_alive(self, vehicle_ids: Iterable[int], timeout_s: float) -> frozenset[int]:
        """Wait until all of these are alive, at most `timeout_s`; returns who is alive then."""
        expected = frozenset(vehicle_ids)
        deadline_s = time.monotonic() + timeout_s
        while not expected <= (alive := self.alive()) and time.monotonic() < deadline_s:
            time.sleep(_ALIVE_POLL_S)
        return alive

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
            raise PeerNetworkError(f"fleet {self._settings.fleet_name!r}: {error}") from error
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


def _received(event: Event) -> int:
    return event.received_monotonic_ns


def _vehicle_id(key: str) -> int | None:
    """The id in `fleet/<id>/<topic>`, None when the key is not of that form."""
    parts = key.split("/")
    if len(parts) != 3 or parts[0] != "fleet":
        return None
    digits = parts[1]
    if not (digits.isascii() and digits.isdigit()) or digits[0] == "0" or len(digits) > 3:
        return None
    vehicle_id = int(digits)
    return vehicle_id if vehicle_id <= VEHICLE_ID_MAX else None


def _open_session(settings: PeerNetworkSettings) -> zenoh.Session:
    # Zenoh logs to standard output, which belongs to `--json`: only when RUST_LOG asks for it.
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]
    try:
        return zenoh.open(zenoh_configuration(settings))
    except zenoh.ZError as error:
        raise PeerNetworkError(f"fleet {settings.fleet_name!r}: {error}") from error


def _close_session(session: zenoh.Session) -> None:
    session.close()  # type: ignore[no-untyped-call]
