"""A fleet in lockstep, as tests and studies drive it: an operator's commands, time that passes, and what may fail."""

import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from random import Random

import numpy as np

from companion.core.failsafe import Failsafe
from companion.core.frames import Ned
from companion.core.values import Phase
from companion.errors import CompanionError
from companion.vehicle.agent import Agent
from sim.autopilot.stubs import TRUTH_DTYPE
from sim.lockstep.clockwork import Clockwork

FOR_EVER_S = 1e9
READY_S, CLIMB_S = 200.0, 30.0
"""how long a take-off waits for all to be ready, and then for all to be in the air; on the ground they speak every 8 to
10 seconds, so that at 50 % loss it takes a while until all have heard each other"""


@dataclass(slots=True)
class Lockstep(Clockwork):
    """A fleet in lockstep. Drive it with `run_until`, `take_off`, `command`, and the faults."""

    _orders: int = 0
    """commands so far that came without a place"""

    def command(self, payload: bytes, *ids: int) -> dict[int, bytes]:
        """An operator's command to every companion that runs, or to those named; their answers.

        One without a place is given at each vehicle's own.
        """
        payload = self._in_order(payload)
        answers = {}
        for i, v in self.vehicles.items():
            if v.alive and (not ids or i in ids):
                self._log(i, "input/command", payload)
                answers[i] = v.agent.receive_command(payload, self.now)
                self._log(i, "output/answer", answers[i])
        return answers

    def run_until_ready(self, time_s: float) -> None:
        """Let time pass until no companion knows a reason against its take-off, or until `time_s` from the start."""
        self.run_until(time_s, lambda: not any(v.agent.operator.unready(self.now) for v in self.vehicles.values()))

    def take_off(self) -> None:
        """Take off by command once all are ready, and let all come to wait in the air for the operator's next command;
        CompanionError if some do not."""
        self.run_until_ready(READY_S)
        self.command(b'{"verb":"takeoff"}')
        self.run_until(self.now_ns * 1e-9 + CLIMB_S, lambda: self.all_in(Phase.WAITING))
        if not self.all_in(Phase.WAITING):
            raise CompanionError(f"lockstep: not all are in the air {CLIMB_S:g} s after the command: {self.notes}")

    def _in_order(self, payload: bytes) -> bytes:
        try:
            order = json.loads(payload)
        except (ValueError, RecursionError):
            return payload
        if not isinstance(order, dict) or "after" in order:
            return payload
        self._orders += 1
        after = {i: [v.agent.operator.place] for i, v in self.vehicles.items()}
        return json.dumps({"issuer": "lockstep", **order, "id": f"{self._orders}", "after": after}).encode()

    def stall(self, i: int, seconds: float) -> None:
        """Keep a companion's loop from running for a while; what arrives meanwhile waits in its agent."""
        self._stalled_until_ns[i] = self.now_ns + round(seconds * 1e9)
        self._touched.add(i)

    def notice(self, i: int, failsafe: Failsafe) -> None:
        """Tell a companion's agent what only its process can see."""
        self._log(i, "input/notice", failsafe.name.encode())
        self.vehicles[i].agent.notice(failsafe, self.now)

    def kill(self, i: int) -> None:
        """End a companion without a word, as kill -9 does; its autopilot flies on."""
        self.vehicles[i].alive = False
        self._announce_presence(i, False)

    def restart(self, i: int, line_dead_s: float = 0.0) -> None:
        """Start a killed companion anew, with nothing of its memory; the line to its autopilot may be dead for a while.

        An infinite time means that it stays dead.
        """
        v = self.vehicles[i]
        if line_dead_s > 0.0:
            self.cut_line(i, line_dead_s)
        self.vehicles[i] = replace(
            v, agent=Agent(self.config, i, boot_id=Random(f"{self.seed}/{i}/{self.now_ns}").getrandbits(32)), alive=True
        )
        self._announce_presence(i, True)

    def partition(self, *parts: Iterable[int]) -> None:
        """Cut the network into parts that do not hear each other; no parts: it is whole again."""
        self._net.partitions = tuple(frozenset(p) for p in parts)

    def cut_line(self, i: int, seconds: float) -> None:
        """Let nothing pass between a vehicle's autopilot and its companion for a while, or for ever (infinite)."""
        self._line_dead_until_ns[i] = self.now_ns + round(min(seconds, FOR_EVER_S) * 1e9)

    def drop_topic(self, topic: str, *receivers: int) -> None:
        """Lose every put of one topic ("state", "plan") on its way to some vehicles, or to all; presence is kept."""
        self._dropped.update((topic, j) for j in receivers or self.vehicles)

    def restore_topics(self) -> None:
        """Every topic arrives again."""
        self._dropped.clear()

    def inject_peer(self, key: str, payload: bytes, *receivers: int) -> None:
        """A put of somebody else's under that key, heard at once by some vehicles, or by all but the key's own."""
        own = key.split("/")[-2]
        for j in receivers or [j for j in self.vehicles if str(j) != own]:
            self._to_peer(j, key, payload)

    def add_twin(self, i: int, line_of: int | None = None) -> Agent:
        """A second companion under vehicle i's id, on the same autopilot's line, as behind a MAVLink router.

        Or on the line of another vehicle's autopilot, as when it is started on the wrong vehicle's computer.
        """
        self._twin_line[i] = i if line_of is None else line_of
        self._twins[i] = Agent(self.config, i, boot_id=Random(f"{self.seed}/{i}/twin/{self.now_ns}").getrandbits(32))
        return self._twins[i]

    def remove_twin(self, i: int) -> None:
        """The second companion ends."""
        self._twins.pop(i, None)
        self._twin_line.pop(i, None)

    def phases(self) -> dict[int, Phase]:
        """Each running companion's phase."""
        return {i: v.agent.phase for i, v in self.vehicles.items() if v.alive}

    def all_in(self, *phases: Phase) -> bool:
        """Whether every running companion is in one of the phases."""
        return all(p in phases for p in self.phases().values())

    def truth(self) -> np.ndarray:
        """Every vehicle's true state at 50 Hz, as TRUTH_DTYPE records."""
        return np.frombuffer(bytearray().join(self._truth), TRUTH_DTYPE)

    def positions(self) -> dict[int, Ned]:
        """True positions now (fleet frame, m)."""
        return {i: v.autopilot.truth().position_ned_m for i, v in self.vehicles.items()}
