"""The guard between the process and the agent: what raises in the handling of an input ends no flight.

Nothing that others send should raise, and in lockstep, where agents are called directly, it does: tests see our bugs.
In a process (and in the replay of its recording, which meets the same inputs) every input passes here. What raises is
counted by the kind of input and of error, told once per kind, and the loop flies on. What the input had changed until
it raised stays changed; the replay's agent does the same.

A tick that raises sends no setpoint; the next one may, 20 ms later. A loop whose ticks have raised for ADVANCE_LIMIT_S
without one that did not is of no more use: its process ends, with a status of its own, before the autopilot's own
patience (COM_OF_LOSS_T, 1 s) is over, and the autopilot's failsafe for lost setpoints lands the vehicle. To command the
landing from here would take the very agent that fails.
"""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from traceback import extract_tb
from typing import TypeVar

from companion.core.failsafe import Failsafe
from companion.core.values import Instant
from companion.vehicle.agent import Agent
from companion.vehicle.autopilot.port import NOTHING, Heard
from companion.vehicle.outputs import Outputs
from companion.wire.operator import Answer, encode

T = TypeVar("T")
ADVANCE_LIMIT_S = 0.5
RETRY_NS = 5_000_000
"""a tick that raised is tried again no sooner"""


class Guard:
    """An agent's inputs, none of which raises."""

    def __init__(self, agent: Agent) -> None:
        self.agent = agent
        self.raised: Counter[str] = Counter()
        """by kind of input and of error: as many names as there are handlers and kinds of exception"""
        self.notes: list[str] = []
        """the first of each kind, for the log and the recording"""
        self._failing_since_ns: int | None = None
        self._retry_ns = 0

    def _guarded(self, kind: str, handle: Callable[[], T], otherwise: T) -> T:
        try:
            return handle()
        except Exception as error:  # noqa: BLE001 - the one place that catches whatever comes
            self._count(kind, error)
            return otherwise

    def _count(self, kind: str, error: Exception) -> None:
        """Count what was raised, and note the first of its kind with the place."""
        name = f"{kind}: {type(error).__name__}"
        self.raised[name] += 1
        if self.raised[name] == 1:
            place = extract_tb(error.__traceback__)[-1]
            self.notes.append(f"{name} in {Path(place.filename).name}:{place.lineno}, flown on: {error!s:.100}")

    def receive_mavlink(self, datagram: bytes, now: Instant) -> Heard:
        """`Agent.receive_mavlink`."""
        return self._guarded("mavlink", lambda: self.agent.receive_mavlink(datagram, now), NOTHING)

    def receive_peer(self, key: str, payload: bytes, now: Instant) -> None:
        """`Agent.receive_peer`."""
        self._guarded("peer", lambda: self.agent.receive_peer(key, payload, now), None)

    def receive_presence(self, vehicle_id: int, alive: bool, now: Instant) -> None:
        """`Agent.receive_presence`."""
        self._guarded("presence", lambda: self.agent.receive_presence(vehicle_id, alive, now), None)

    def receive_command(self, payload: bytes, now: Instant) -> bytes:
        """`Agent.receive_command`; one that raised is answered as refused."""
        reason = "it failed in this vehicle: see `rejected` in its status"
        refused = encode(Answer(vehicle=self.agent.id, accepted=False, reason=reason))
        return self._guarded("command", lambda: self.agent.receive_command(payload, now), refused)

    def notice(self, failsafe: Failsafe, now: Instant) -> None:
        """`Agent.notice`."""
        self._guarded("notice", lambda: self.agent.notice(failsafe, now), None)

    def stop(self, now: Instant) -> None:
        """`Agent.stop`."""
        self._guarded("stop", lambda: self.agent.stop(now), None)

    def transport(self, what: str, call: Callable[[], T], otherwise: T) -> T:
        """A call of the transport to the peers: one that fails leaves the vehicle alone for that turn, and flying."""
        return self._guarded(f"transport {what}", call, otherwise)

    def reply(self, kind: str, answer: Callable[[], bytes]) -> bytes | None:
        """An answer to a question of that kind, or None: whoever asked asks again."""
        return self._guarded(kind, answer, None)

    def next_deadline_ns(self) -> int:
        """`Agent.next_deadline_ns`, but no sooner than a tick that raised may be tried again."""
        return max(self.agent.next_deadline_ns(), self._retry_ns)

    def advance(self, now: Instant) -> Outputs:
        """`Agent.advance`; nothing if it raised."""
        try:
            out = self.agent.advance(now)
        except Exception as error:  # noqa: BLE001 - the one place that catches whatever comes
            self._count("advance", error)
            self._retry_ns = now.monotonic_ns + RETRY_NS
            if self._failing_since_ns is None:
                self._failing_since_ns = now.monotonic_ns
            return Outputs()
        self._failing_since_ns = None
        return out

    def lost(self, monotonic_ns: int) -> bool:
        """Whether ticks have raised for too long."""
        since_ns = self._failing_since_ns
        return since_ns is not None and monotonic_ns - since_ns >= ADVANCE_LIMIT_S * 1e9
