"""The loop around one Agent: what came in, the tick, what goes out.

It waits for the autopilot's datagrams, the peers' samples, the operator's requests and the next deadline, hands them
to the agent with their times, and sends what the agent answers. Setpoints go out right after the position that they
follow from; what can wait (records, answers) is done after them. Every input passes the agent's `Guard`, the one place
that catches what a handler raises.
"""

import json
import os
import secrets
import select
import socket
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from companion.config import FleetConfig
from companion.core.failsafe import CONFIGURATION_S, Failsafe
from companion.core.values import Instant
from companion.errors import CompanionError
from companion.io.answers import Answers
from companion.io.clock import FleetClock
from companion.io.network import peer_transport
from companion.io.recorder import Recorder
from companion.io.records import TickRecord, TrafficRecord, peer_body
from companion.io.signed_link import open_link
from companion.io.systemd import Notifier
from companion.io.transport import Connect, Event, PresenceChange, ReceivedSample, Request, Sent
from companion.vehicle.agent import Agent
from companion.vehicle.guard import Guard
from companion.vehicle.outputs import Outputs
from companion.wire.events import encode_event
from companion.wire.operator import Status

SAFE, STILL_FLYING, LOST = 0, 3, 4
"""exit statuses: landed or landing by its autopilot; ended without a confirmed landing; ticks do nothing but raise"""
LANDING_GRACE_S = 3.0
"""how long an ending companion waits for its autopilot to confirm landing"""
ABANDONED_GRACE_S = 1.0
"""the same when whoever launched it is gone"""

TRAFFIC_SECONDS = 10
"""over so many seconds the status tells packets a second: heartbeats come that far apart"""


@dataclass(frozen=True, slots=True)
class RunSettings:
    """How to run one companion."""

    vehicle_id: int
    record: Path | None = None
    """MCAP file for every input and output"""
    stop_fd: int | None = None
    """a file descriptor whose end of file means that the launcher is gone"""
    log: Callable[[str], None] = print
    signing_key: Path | None = None
    """the file of the link's key; None: nothing is signed"""
    configuration: Path | None = None
    """the file that the configuration was read from: a change of it in flight is noted"""


class Companion:
    """One companion's resources and its loop.

    `connect` makes its end of the fleet's network; without one, the transport that the configuration asks for.
    """

    def __init__(
        self, config: FleetConfig, settings: RunSettings, metadata: dict[str, str], connect: Connect | None = None
    ) -> None:
        self.settings = settings
        self.agent = Agent(config, settings.vehicle_id, secrets.randbits(32))
        self.guard = Guard(self.agent)
        self.clock = FleetClock()
        self.answers = Answers(self.guard, self.clock, self._complete, self._record)
        self.recorder: Recorder | None = None
        self.lateness_ns = 0
        """of the last tick"""
        self._notifier = Notifier()
        self._stops_asked: list[None] = []
        """one for each time; appended to by signals and threads"""
        self._stop_by_ns: int | None = None
        self._launcher_fd = settings.stop_fd
        self._last_ns = 0
        self._second_ns = 0
        self._sent: deque[tuple[int, Sent]] = deque([(time.monotonic_ns(), Sent(0, 0))], TRAFFIC_SECONDS + 1)
        """when (monotonic ns) the network had sent how much, each second"""
        self._driver_ns: int | None = None
        """when the position that the next tick follows from was received"""
        self._file = self._configuration()
        self._file_due_ns = 0
        self._noticed: set[Failsafe] = set()
        self._fault_told = False
        self._drain_failed = False
        """what waits at the transport is asked for again, though nothing wakes the loop for it"""
        with ExitStack() as stack:
            stack.callback(self._notifier.close)
            self._wake_read, self._wake_write = socket.socketpair()
            for end in (self._wake_read, self._wake_write):
                end.setblocking(False)
                stack.callback(end.close)
            self.link = open_link(self.agent.vehicle, settings.signing_key)
            stack.callback(self.link.close)
            if settings.record is not None:
                self.recorder = self._open_recorder(settings.record, metadata, config)
                stack.callback(self.recorder.close)
            if connect is None:
                self.network = peer_transport(config, settings.vehicle_id, self._wake)
            else:
                self.network = connect(self._wake)
            stack.callback(self.network.close)
            self.network.open()
            self._resources = stack.pop_all()

    def _open_recorder(self, path: Path, metadata: dict[str, str], config: FleetConfig) -> Recorder:
        facts = {**metadata, "vehicle_id": str(self.agent.id), "boot_id": str(self.agent.boot_id)}
        if config.foreign:
            facts["foreign"] = json.dumps([o._asdict() for o in config.foreign])
        try:
            return Recorder(path, facts)
        except OSError as error:
            raise CompanionError(f"--record {path}: cannot be written: {error.strerror}") from error

    def close(self) -> None:
        """Release everything, the network first."""
        self._resources.close()

    # -- from other threads and from signals ----------------------------------------------------------------------

    def _wake(self) -> None:
        with suppress(OSError):  # full: the loop wakes anyway; closed: it has ended
            self._wake_write.send(b"\0")

    def ask_to_stop(self) -> None:
        """Have the loop land the vehicle and end; asked twice, it waits no longer for the landing."""
        self._stops_asked.append(None)
        self._wake()

    # -- the loop -------------------------------------------------------------------------------------------------

    def run(self) -> int:
        """Run until stopped; returns the exit status.

        `SAFE` if the vehicle was safe then, `STILL_FLYING` if it still flew without a confirmed landing, `LOST` at once
        if control ticks do nothing but raise: the autopilot's failsafe has the vehicle then.
        """
        self._notifier.ready()
        while (status := self._turn()) is None:
            pass
        return status

    def _turn(self) -> int | None:
        """Wait for whatever comes first and do what is due; the exit status when it is time to end."""
        deadline_ns = min(self.guard.next_deadline_ns(), self._second_ns)
        ready = self._wait_until(deadline_ns)
        if self.link in ready:
            self._receive_mavlink()
        woken = self._wake_read in ready
        if woken:
            self._wake_read.recv(4096)
        requests = self._receive_from_peers() if woken or self._drain_failed else []
        self._heed_stops(ready)
        self._advance(deadline_ns)
        for request in sorted(requests, key=lambda r: r.kind != "command"):
            self.answers.answer(request, self._instant(time.monotonic_ns()))
        now_ns = time.monotonic_ns()
        self._tell_raised(now_ns)
        if now_ns >= self._second_ns:
            self._each_second(now_ns)
        return self._exit_status(now_ns)

    def _wait_until(self, deadline_ns: int) -> list[Any]:
        waiting: list[Any] = [self.link, self._wake_read]
        if self._launcher_fd is not None:
            waiting.append(self._launcher_fd)
        ready, _, _ = select.select(waiting, [], [], max(deadline_ns - time.monotonic_ns(), 0) * 1e-9)
        return ready

    def _receive_mavlink(self) -> None:
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

    def _receive_from_peers(self) -> list[Request]:
        """Hand on what peers said; returns what the operator asks, to be answered after the tick."""
        requests = []
        events: list[Event] | None = self.guard.transport("drain", self.network.drain, None)
        self._drain_failed = events is None
        for event in events or ():
            now = self._instant(event.received_monotonic_ns)
            match event:
                case ReceivedSample():
                    self._record("input/peer", now, peer_body(event.key, event.payload))
                    self.guard.receive_peer(event.key, event.payload, now)
                case PresenceChange():
                    self._record("input/presence", now, bytes((event.vehicle_id, event.alive)))
                    self.guard.receive_presence(event.vehicle_id, event.alive, now)
                case Request():
                    requests.append(event)
        return requests

    def _advance(self, deadline_ns: int) -> None:
        """The agent's tick, if it is due: setpoints first, then the peers, then the records."""
        if self.guard.next_deadline_ns() > time.monotonic_ns():
            return
        now = self._instant(time.monotonic_ns())
        self._record("advance", now, b"")
        out = self.guard.advance(now)
        for datagram in out.mavlink:
            self.link.send(datagram)
        sent_ns = time.monotonic_ns()
        for topic, payload in out.peers:
            self.guard.transport("publish", partial(self.network.publish, topic, payload), None)
        self._notifier.loop_turned(sent_ns)
        self._record_outputs(out, now)
        self._record_tick(out, now, sent_ns, deadline_ns)

    # -- ending ---------------------------------------------------------------------------------------------------

    def _heed_stops(self, ready: list[Any]) -> None:
        if self._stops_asked:
            self._stops_asked.pop()
            self._stop(LANDING_GRACE_S if self._stop_by_ns is None else 0.0)
        if self._launcher_fd is not None and self._launcher_fd in ready and not os.read(self._launcher_fd, 4096):
            self._launcher_fd = None
            self._stop(ABANDONED_GRACE_S)

    def _stop(self, grace_s: float) -> None:
        """Land, and end once the autopilot has taken over or the grace is over; a second call may shorten the grace."""
        now = self._instant(time.monotonic_ns())
        stop_by_ns = now.monotonic_ns + round(grace_s * 1e9)
        if self._stop_by_ns is None:
            self._record("input/stop", now, b"")
            self.guard.stop(now)
            self._stop_by_ns = stop_by_ns
            self._notifier.stopping()
        self._stop_by_ns = min(self._stop_by_ns, stop_by_ns)

    def _exit_status(self, now_ns: int) -> int | None:
        if self.guard.lost(now_ns):
            return LOST
        if self._stop_by_ns is None:
            return None
        if self.agent.stopped:
            return SAFE
        return STILL_FLYING if now_ns >= self._stop_by_ns else None

    # -- times, records, notices ----------------------------------------------------------------------------------

    def _instant(self, monotonic_ns: int) -> Instant:
        """Times handed to the agent never go back, though the kernel's stamps may by a little."""
        self._last_ns = max(self._last_ns, monotonic_ns)
        return self.clock.at(self._last_ns)

    def _record(self, channel: str, now: Instant, body: bytes) -> None:
        if self.recorder is not None:
            self.recorder.record(channel, now, body)

    def _note(self, now: Instant, note: str) -> None:
        self._record("note", now, note.encode())
        with suppress(OSError):  # a full disk must not end a flight; the recording counts its own losses
            self.settings.log(note)

    def _tell_raised(self, now_ns: int) -> None:
        """Log and record what was raised for the first time."""
        notes, self.guard.notes = self.guard.notes, []
        for note in notes:
            self._note(self._instant(now_ns), f"raised: {note}")

    def _record_outputs(self, out: Outputs, now: Instant) -> None:
        for datagram in out.mavlink:
            self._record("output/mavlink", now, datagram)
        for topic, payload in out.peers:
            self._record("output/peer", now, peer_body(topic, payload))
        for event in out.events:
            self._record("event", now, encode_event(event))
        for note in out.notes:
            self._note(now, note)

    def _record_tick(self, out: Outputs, now: Instant, sent_ns: int, deadline_ns: int) -> None:
        driver_ns, self._driver_ns = self._driver_ns, None
        if out.tick is None:
            return
        latency_ns = -1 if driver_ns is None else sent_ns - driver_ns
        self.lateness_ns = sent_ns - deadline_ns if driver_ns is None else latency_ns
        tick = out.tick
        record = TickRecord(
            self.lateness_ns, latency_ns, time.thread_time_ns(), tick.position_error_m, tick.nearest_m, tick.steered,
            *tick.position_ned_m, *tick.velocity_ned_m_s,
        )  # fmt: skip
        self._record("tick", now, record.pack())

    def _each_second(self, now_ns: int) -> None:
        self._second_ns = now_ns + 1_000_000_000
        self.clock.discipline(latched=self.agent.autopilot.armed)
        if self.recorder is not None and self.recorder.failure is not None:
            self._notice(Failsafe.DISK_FULL, now_ns)
        if now_ns >= self._file_due_ns:
            self._file_due_ns = now_ns + round(CONFIGURATION_S * 1e9)
            if self._configuration() != self._file:
                self._notice(Failsafe.CONFIGURATION, now_ns)
        sent = self.guard.transport("sent", self.network.sent, self._sent[-1][1])
        self._sent.append((now_ns, sent))
        self._record("traffic", self._instant(now_ns), TrafficRecord(*sent).pack())
        if self.link.fault and not self._fault_told:
            self._fault_told = True
            self._note(self._instant(now_ns), f"the time of signing is not kept: {self.link.fault}")

    def _notice(self, failsafe: Failsafe, now_ns: int) -> None:
        """Tell the agent, once, what only the process can see."""
        if failsafe not in self._noticed:
            self._noticed.add(failsafe)
            now = self._instant(now_ns)
            self._record("input/notice", now, failsafe.name.encode())
            self.guard.notice(failsafe, now)

    def _configuration(self) -> bytes | None:
        try:
            return None if self.settings.configuration is None else self.settings.configuration.read_bytes()
        except OSError:
            return None

    def _complete(self, status: Status) -> Status:
        """The agent's account with what the process around it knows."""
        counters = self.network.counters
        elsewhere = {
            "mavlink: another address than the autopilot's": self.link.foreign_datagrams,
            "mavlink: could not be sent": self.link.send_failures,
            "peer: malformed": counters.malformed,
            "peer: could not be sent": counters.publish_failures,
            "operator: could not be answered": counters.reply_failures,
        }
        elsewhere |= {f"mavlink: {why}": count for why, count in self.link.refused.items()}
        rejected = {kind: count for kind, count in elsewhere.items() if count}
        (then_ns, then), (now_ns, sent) = self._sent[0], self._sent[-1]
        seconds = (now_ns - then_ns) * 1e-9
        rejected |= {f"raised: {kind}": count for kind, count in self.guard.raised.items()}
        return replace(
            status,
            rejected=status.rejected | rejected,
            lateness_ms=self.lateness_ns * 1e-6,
            dropped=counters.dropped,
            packets_hz=(sent.packets - then.packets) / seconds if seconds else None,
            bytes_per_s=(sent.bytes - then.bytes) / seconds if seconds else None,
            recorder_lost=0 if self.recorder is None else self.recorder.lost,
        )
