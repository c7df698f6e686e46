"""What raises in the handling of an input is counted, told once, and ends no flight; the replay meets it alike."""

import json
from pathlib import Path

from companion.config import FleetConfig, load
from companion.core.failsafe import Failsafe
from companion.core.values import Instant
from companion.io.recording import Entry
from companion.io.replay import OUTPUTS, replay
from companion.vehicle.agent import Agent
from companion.vehicle.autopilot.port import NOTHING, Heard
from companion.vehicle.guard import ADVANCE_LIMIT_S, Guard
from companion.vehicle.outputs import Outputs

CONFIG = load(Path(__file__).resolve().parents[2] / "fleet.toml", lambda t: t.update(vehicle=t["vehicle"][:2]))
UTC_NS = 1_790_000_000_000_000_000


class Fragile(Agent):
    """An agent with a bug: whatever says so makes it raise."""

    def __init__(self, config: FleetConfig, vehicle_id: int, boot_id: int) -> None:
        super().__init__(config, vehicle_id, boot_id)
        self.ill = False

    def receive_mavlink(self, datagram: bytes, now: Instant) -> Heard:
        if datagram == b"bug":
            raise ZeroDivisionError("float division by zero")
        return super().receive_mavlink(datagram, now)

    def receive_peer(self, key: str, payload: bytes, now: Instant) -> None:
        if payload == b"bug":
            raise OverflowError("cannot convert float infinity to integer")
        if payload == b"ill":
            self.ill = True
        super().receive_peer(key, payload, now)

    def receive_presence(self, vehicle_id: int, alive: bool, now: Instant) -> None:
        raise IndexError("list index out of range")

    def receive_command(self, payload: bytes, now: Instant) -> bytes:
        if payload == b"bug":
            raise KeyError("motion")
        return super().receive_command(payload, now)

    def notice(self, failsafe: Failsafe, now: Instant) -> None:
        raise ValueError("notice")

    def stop(self, now: Instant) -> None:
        raise ValueError("stop")

    def advance(self, now: Instant) -> Outputs:
        if self.ill:
            raise ArithmeticError("ill")
        return super().advance(now)


def at(seconds: float) -> Instant:
    return Instant(round(seconds * 1e9), UTC_NS + round(seconds * 1e9))


def test_every_kind_of_input_that_raises_is_counted_by_kind_and_error_and_told_once() -> None:
    guard = Guard(Fragile(CONFIG, 1, 7))
    for k in range(3):
        now = at(k * 0.1)
        assert guard.receive_mavlink(b"bug", now) == NOTHING
        guard.receive_peer("fleet/2/plan", b"bug", now)
        guard.receive_presence(2, True, now)
        answer = json.loads(guard.receive_command(b"bug", now))
        assert (answer["vehicle"], answer["accepted"]) == (1, False)
        assert "failed in this vehicle" in answer["reason"]
        guard.notice(Failsafe.DISK_FULL, now)
        guard.stop(now)
        assert guard.reply("status", lambda: json.dumps({}[1]).encode()) is None
    kinds = [
        "mavlink: ZeroDivisionError", "peer: OverflowError", "presence: IndexError", "command: KeyError",
        "notice: ValueError", "stop: ValueError", "status: KeyError",
    ]  # fmt: skip
    assert guard.raised == dict.fromkeys(kinds, 3)
    assert [note.split(" in ")[0] for note in guard.notes] == kinds
    assert all(".py:" in note for note in guard.notes)


def test_what_does_not_raise_passes_unchanged() -> None:
    guard, agent = Guard(Agent(CONFIG, 1, 7)), Agent(CONFIG, 1, 7)
    for k in range(20):
        now = at(k * 0.05)
        assert guard.receive_command(b"{}", now) == agent.receive_command(b"{}", now)
        assert guard.advance(now) == agent.advance(now)
        assert guard.next_deadline_ns() == agent.next_deadline_ns()
    assert guard.reply("status", lambda: b"fine") == b"fine"
    assert not guard.raised
    assert not guard.lost(at(100.0).monotonic_ns)


def test_a_tick_that_raises_is_tried_again_and_given_up_before_the_autopilot_would_notice() -> None:
    guard = Guard(Fragile(CONFIG, 1, 7))
    guard.advance(at(1.0))
    guard.receive_peer("fleet/2/plan", b"ill", at(1.0))
    first = at(1.1)
    assert guard.advance(first) == Outputs()
    assert first.monotonic_ns < guard.next_deadline_ns() < first.monotonic_ns + 20_000_000
    assert not guard.lost(at(1.1 + ADVANCE_LIMIT_S - 0.01).monotonic_ns)
    guard.advance(at(1.1 + ADVANCE_LIMIT_S))
    assert guard.lost(at(1.1 + ADVANCE_LIMIT_S).monotonic_ns)
    assert CONFIG.preflight.offboard_loss_limit_s > ADVANCE_LIMIT_S


def test_one_tick_that_raises_between_others_is_flown_on_from() -> None:
    agent = Fragile(CONFIG, 1, 7)
    guard = Guard(agent)
    for k in range(200):
        agent.ill = k % 2 == 1
        guard.advance(at(k * 0.02))
        assert not guard.lost(at(k * 0.02).monotonic_ns)
    assert guard.raised == {"advance: ArithmeticError": 100}


def test_the_replay_of_a_recording_meets_what_raised_alike() -> None:
    guard = Guard(Fragile(CONFIG, 1, 7))
    entries = []
    for k in range(100):
        now = at(k * 0.05)
        if k % 7 == 3:
            entries.append(Entry("input/peer", now, b"fleet/2/plan\0bug"))
            guard.receive_peer("fleet/2/plan", b"bug", now)
        if k == 50:
            entries.append(Entry("input/presence", now, bytes((2, 1))))
            guard.receive_presence(2, True, now)
        if k == 90:
            entries.append(Entry("input/peer", now, b"fleet/2/plan\0ill"))
            guard.receive_peer("fleet/2/plan", b"ill", now)
        entries.append(Entry("advance", now, b""))
        out = guard.advance(now)
        entries += [Entry("output/mavlink", now, d) for d in out.mavlink]
        entries += [Entry("output/peer", now, t.encode() + b"\0" + p) for t, p in out.peers]
    assert len(guard.raised) == 3
    result = replay(Fragile(CONFIG, 1, 7), entries)
    assert result.same, result.sentence()
    assert result.outputs == sum(e.channel in OUTPUTS for e in entries) > 0
