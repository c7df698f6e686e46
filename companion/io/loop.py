"""The companion process: one loop around one Agent.

It waits for the autopilot's datagrams, the peers' messages, the operator's requests and the next deadline, hands them
to the agent with their times, and sends what the agent answers. Setpoints go out right after the position that they
follow from; what can wait (records, replies) is done after them.
"""

import gc
import os
import secrets
import select
import signal
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from companion.config import FleetConfig
from companion.core.failsafe import CONFIGURATION_S, Failsafe
from companion.core.values import Instant
from companion.errors import CompanionError
from companion.io.clock import FleetClock
from companion.io.link import open_link
from companion.io.recorder import Recorder
from companion.io.systemd import Notifier
from companion.io.traffic import tcp_bytes_sent
from companion.io.zenoh_peers import PeerMessage, PeerNetwork, PeerNetworkSettings, PresenceChange, Request
from companion.vehicle.agent import Agent
from companion.vehicle.guard import Guard
from companion.vehicle.outputs import Outputs
from companion.wire.events import encode_event
from companion.wire.operator import CLOCK_QUESTION, ClockReading, encode

TICK_RECORD = struct.Struct("<qqqff?6f")
"""body of the "tick" channel: lateness ns, sensor-to-setpoint latency ns (-1 for a timer's tick), CPU ns of the loop so
far, position error m, nearest neighbour m, whether a setpoint was sent, own position (m) and velocity (m/s) as believed
(fleet frame, NED)"""
TRAFFIC_RECORD = struct.Struct("<q")
"""body of the "traffic" channel: bytes that this process's TCP connections have sent so far"""
STATUS_LASTS_NS = 50_000_000
"""a status this old is told again: making one takes a good part of a control period; a command makes it anew"""
LANDING_GRACE_S = 3.0
"""how long an ending companion waits for its autopilot to confirm landing"""
LOST = 4
"""exit status of a companion whose control ticks do nothing but raise"""
ABANDONED_GRACE_S = 1.0
"""the same when whoever launched it is gone"""


@dataclass(frozen=True, slots=True)
class RunSettings:
    """How to run one companion."""

    vehicle_id: int
    record: Path | None = None
    """MCAP file for every input and output"""
    stop_fd: int | None = None
    """a file descriptor whose end of file means that the launcher is gone"""
    log: Callable[[str], None] = print
    configuration: Path | None = None
    """the file that the configuration was read from: a change of it in flight is noted"""


def network_settings(config: FleetConfig, vehicle_id: int | None) -> PeerNetworkSettings:
    """The Zenoh session of a vehicle, or of an operator's client (None)."""
    listen: tuple[str, ...] = ()
    own = None if vehicle_id is None else config.by_id(vehicle_id).zenoh
    if own is not None:
        listen = (own,)
    connect = tuple(v.zenoh for v in config.vehicles if v.zenoh is not None and v.id != vehicle_id)
    return PeerNetworkSettings(
        fleet_name=config.fleet.name,
        vehicle_id=vehicle_id,
        profile=config.peers.network,
        listen=listen,
        connect=connect,
        scouting_port=config.peers.scouting_port,
    )


@contextmanager
def _signals(stop: Callable[[], None]) -> Iterator[None]:
    previous = {s: signal.signal(s, lambda *_: stop()) for s in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for s, handler in previous.items():
            signal.signal(s, handler)


class Companion:
    """One companion's resources and its loop."""

    def __init__(self, config: FleetConfig, settings: RunSettings, metadata: dict[str, str]) -> None:
        self.settings = settings
        self.boot_id = secrets.randbits(32)
        self.agent = Agent(config, settings.vehicle_id, self.boot_id)
        self.guard = Guard(self.agent)
        self.clock = FleetClock()
        self._wake_read, self._wake_write = socket.socketpair()
        self._wake_read.setblocking(False)
        self._wake_write.setblocking(False)
        self._resources = ExitStack()
        self._resources.callback(self._wake_read.close)
        self._resources.callback(self._wake_write.close)
        self._notifier = Notifier()
        self._resources.callback(self._notifier.close)
        try:
            self.link = open_link(self.agent.vehicle)
            self._resources.callback(self.link.close)
            self.recorder: Recorder | None = None
            if settings.record is not None:
                facts = {**metadata, "vehicle_id": str(settings.vehicle_id), "boot_id": str(self.boot_id)}
                try:
                    self.recorder = Recorder(settings.record, facts)
                except OSError as error:
                    raise CompanionError(f"--record {settings.record}: cannot be written: {error.strerror}") from error
                self._resources.callback(self.recorder.close)
            self.network = PeerNetwork(network_settings(config, settings.vehicle_id), self._wake)
            self._resources.callback(self.network.close)
            self.network.open()
        except BaseException:
            self._resources.close()
            raise
        self._file = self._configuration()
        self._file_due_ns = 0
        self._noticed: set[Failsafe] = set()
        self._stop_by_ns: int | None = None
        self._last_ns = 0
        self._second_ns = 0
        self._driver_ns: int | None = None
        """when the position that the next tick follows from was received"""
        self.lateness_ns = 0
        self._status: bytes | None = None
        self._status_ns = 0

    def _wake(self) -> None:
        with suppress(OSError):  # full: the loop wakes anyway; closed: it has ended
            self._wake_write.send(b"\0")

    def _configuration(self) -> bytes | None:
        try:
            return None if self.settings.configuration is None else self.settings.configuration.read_bytes()
        except OSError:
            return None

    def _notice(self, failsafe: Failsafe, now_ns: int) -> None:
        """Tell the agent, once, what only the process can see."""
        if failsafe not in self._noticed:
            self._noticed.add(failsafe)
            now = self._instant(now_ns)
            self._record("input/notice", now, failsafe.name.encode())
            self.guard.notice(failsafe, now)

    def close(self) -> None:
        """Release everything, the Zenoh session first."""
        self._resources.close()

    def stop(self, grace_s: float = LANDING_GRACE_S) -> None:
        """Land, and end once the autopilot has taken over or the grace is over; a second call may shorten the grace."""
        now = self._instant(time.monotonic_ns())
        stop_by_ns = now.monotonic_ns + round(grace_s * 1e9)
        if self._stop_by_ns is None:
            self._record("input/stop", now, b"")
            self.guard.stop(now)
            self._stop_by_ns = stop_by_ns
            self._notifier.stopping()
        self._stop_by_ns = min(self._stop_by_ns, stop_by_ns)

    def run(self) -> int:
        """Run until stopped; 0 if the vehicle was safe then, 3 if it still flew without a confirmed landing.

        4 at once if control ticks do nothing but raise (`guard`): the autopilot's failsafe has the vehicle then.
        """
        asked: list[bool] = []
        waiting: list[Any] = [self.link, self._wake_read]
        if self.settings.stop_fd is not None:
            waiting.append(self.settings.stop_fd)

        def ask() -> None:
            asked.append(True)
            self._wake()

        gc.collect()
        gc.freeze()
        sys.setswitchinterval(0.0005)
        with _signals(ask):
            self._notifier.ready()
            while True:
                deadline_ns = min(self.guard.next_deadline_ns(), self._second_ns)
                ready, _, _ = select.select(waiting, [], [], max(deadline_ns - time.monotonic_ns(), 0) * 1e-9)
                requests = self._receive(ready)
                if asked:
                    asked.pop()
                    self.stop(LANDING_GRACE_S if self._stop_by_ns is None else 0.0)
                stop_fd = self.settings.stop_fd
                if stop_fd is not None and stop_fd in ready and not os.read(stop_fd, 4096):
                    waiting.remove(stop_fd)
                    self.stop(ABANDONED_GRACE_S)
                self._advance(deadline_ns)
                for request in sorted(requests, key=lambda r: r.kind != "command"):
                    self._reply(request)
                now_ns = time.monotonic_ns()
                self._tell_raised(now_ns)
                if self.guard.lost(now_ns):
                    return LOST
                if now_ns >= self._second_ns:
                    self._each_second(now_ns)
                if self._stop_by_ns is not None and (self.agent.stopped or now_ns >= self._stop_by_ns):
                    return 0 if self.agent.stopped else 3

    def _instant(self, monotonic_ns: int) -> Instant:
        """Times handed to the agent never go back, though the kernel's stamps may by a little."""
        self._last_ns = max(self._last_ns, monotonic_ns)
        return self.clock.at(self._last_ns)

    def _record(self, channel: str, now: Instant, body: bytes) -> None:
        if self.recorder is not None:
            self.recorder.record(channel, now, body)

    def _receive(self, ready: list[Any]) -> list[Request]:
        if self.link in ready:
            for datagram, received_ns, address in self.link.receive():
                if not self.link.admits(address, received_ns):
                    continue
                now = self._instant(received_ns)
                self._record("input/mavlink", now, datagram)
                heard = self.guard.receive_mavlink(datagram, now)
                if heard.autopilot:
                    self.link.confirm(address, received_ns)
                if heard.position and self._driver_ns is None:
                    self._driver_ns = received_ns
        if self._wake_read in ready:
            self._wake_read.recv(4096)
        requests = []
        for event in self.network.drain():
            now = self._instant(event.received_monotonic_ns)
            match event:
                case PeerMessage():
                    self._record("input/peer", now, event.key.encode() + b"\0" + event.payload)
                    self.guard.receive_peer(event.key, event.payload, now)
                case PresenceChange():
                    self._record("input/presence", now, bytes((event.vehicle_id, event.alive)))
                    self.guard.receive_presence(event.vehicle_id, event.alive, now)
                case Request():
                    requests.append(event)
        return requests

    def _advance(self, deadline_ns: int) -> None:
        if self.guard.next_deadline_ns() > time.monotonic_ns():
            return
        now = self._instant(time.monotonic_ns())
        self._record("advance", now, b"")
        out = self.guard.advance(now)
        for datagram in out.mavlink:
            self.link.send(datagram)
        sent_ns = time.monotonic_ns()
        for topic, payload in out.peers:
            self.network.publish(topic, payload)
        self._notifier.loop_turned(sent_ns)
        self._after(out, now, sent_ns, deadline_ns)

    def _tell_raised(self, now_ns: int) -> None:
        """Log and record what was raised for the first time."""
        notes, self.guard.notes = self.guard.notes, []
        for note in notes:
            self._record("note", self._instant(now_ns), f"raised: {note}".encode())
            with suppress(OSError):
                self.settings.log(f"raised: {note}")

    def _after(self, out: Outputs, now: Instant, sent_ns: int, deadline_ns: int) -> None:
        for datagram in out.mavlink:
            self._record("output/mavlink", now, datagram)
        for topic, payload in out.peers:
            self._record("output/peer", now, topic.encode() + b"\0" + payload)
        for event in out.events:
            self._record("event", now, encode_event(event))
        for note in out.notes:
            self._record("note", now, note.encode())
            with suppress(OSError):  # a full disk must not end a flight; the recording counts its own losses
                self.settings.log(note)
        driver_ns, self._driver_ns = self._driver_ns, None
        if out.tick is not None:
            latency_ns = -1 if driver_ns is None else sent_ns - driver_ns
            self.lateness_ns = sent_ns - deadline_ns if driver_ns is None else latency_ns
            tick = out.tick
            self._record("tick", now, TICK_RECORD.pack(
                self.lateness_ns, latency_ns, time.thread_time_ns(), tick.position_error_m, tick.nearest_m,
                tick.steered, *tick.position_ned_m, *tick.velocity_ned_m_s,
            ))  # fmt: skip

    def _reply(self, request: Request) -> None:
        now = self._instant(time.monotonic_ns())
        if request.kind == "command":
            self._record("input/command", now, request.payload)
            answer = self.guard.receive_command(request.payload, now)
            self._record("output/answer", now, answer)
            self._status = None
            request.reply(answer)
            return
        if request.kind == "preflight":
            told = self.guard.reply("preflight", lambda: self._preflight(request, now))
        else:
            if self._status is None or now.monotonic_ns - self._status_ns > STATUS_LASTS_NS:
                self._status, self._status_ns = (
                    self.guard.reply("status", lambda: self._make_status(now)),
                    now.monotonic_ns,
                )
            told = self._status
        if told is not None:
            request.reply(told)

    def _make_status(self, now: Instant) -> bytes:
        status = self.agent.status(now)
        counters = self.network.counters
        elsewhere = {
            "mavlink: another address than the autopilot's": self.link.foreign_datagrams,
            "mavlink: could not be sent": self.link.send_failures,
            "peer: malformed": counters.malformed,
        }
        rejected = {kind: count for kind, count in elsewhere.items() if count}
        rejected |= {f"raised: {kind}": count for kind, count in self.guard.raised.items()}
        return encode(
            replace(
                status,
                rejected=status.rejected | rejected,
                lateness_ms=self.lateness_ns * 1e-6,
                dropped=counters.dropped,
                recorder_lost=0 if self.recorder is None else self.recorder.lost,
            )
        )

    def _preflight(self, request: Request, now: Instant) -> bytes:
        if request.payload == CLOCK_QUESTION:
            received_ns = self.clock.at(request.received_monotonic_ns).fleet_ns
            answered_ns = self.clock.now().fleet_ns
            reading = ClockReading(boot_id=self.boot_id, received_ns=received_ns, answered_ns=answered_ns)
            return encode(reading)
        return encode(self.agent.operator.preflight_report(now))

    def _each_second(self, now_ns: int) -> None:
        self._second_ns = now_ns + 1_000_000_000
        self.clock.discipline(latched=self.agent.autopilot.armed)
        if self.recorder is not None and self.recorder.failure is not None:
            self._notice(Failsafe.DISK_FULL, now_ns)
        if now_ns >= self._file_due_ns:
            self._file_due_ns = now_ns + round(CONFIGURATION_S * 1e9)
            if self._configuration() != self._file:
                self._notice(Failsafe.CONFIGURATION, now_ns)
        self._record("traffic", self._instant(now_ns), TRAFFIC_RECORD.pack(tcp_bytes_sent()))
