"""The publisher: which of its causes sends a state message, when, and what the message says."""

from itertools import pairwise
from pathlib import Path
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config import load
from companion.core.frames import Ned
from companion.core.neighbours.table import PeerTable
from companion.core.trajectory.history import TrajectoryHistory
from companion.core.values import ZERO, Instant, PeerMessage, Phase
from companion.vehicle.publisher import (
    CATCH_UP_NS,
    CAUSES,
    OWN_ID_ANSWER_NS,
    REPEATS_NS,
    OwnState,
    Publisher,
    spread_ns,
)
from companion.wire.peer import decode_state

CONFIG = load(Path(__file__).resolve().parents[2] / "fleet.toml", lambda t: t.update(vehicle=t["vehicle"][:3]))
UTC_NS = 1_790_000_000_000_000_000
TICK_NS = 20_000_000
T_MAX_S = CONFIG.trigger.t_max_s


def at(monotonic_ns: int) -> Instant:
    return Instant(monotonic_ns, UTC_NS + monotonic_ns)


class One:
    """A publisher of vehicle 1, driven tick by tick."""

    def __init__(self, seed: int = 1) -> None:
        self.history = TrajectoryHistory([CONFIG.first_motion])
        peers = PeerTable(1, frozenset({2, 3}), CONFIG.peer_limits, self.history)
        self.publisher = Publisher(CONFIG, 1, 7, CONFIG.trigger_rule, self.history, peers, Random(seed))
        self.now_ns = 1_000_000_000
        self.sent: list[tuple[int, PeerMessage]] = []

    @property
    def now(self) -> Instant:
        return at(self.now_ns)

    def tick(self, off_m: float = 0.0, phase: Phase = Phase.FORMED, outdated: bool = False) -> PeerMessage | None:
        """One tick with the vehicle so far north of its slot."""
        reference = self.history.reference(1, self.now.fleet_ns)
        p = reference.position_ned_m
        own = OwnState(phase, p._replace(north=p.north + off_m), ZERO, reference, ZERO, UTC_NS, (), outdated)
        payload = self.publisher.publish(own, self.now)
        message = None if payload is None else decode_state(payload)
        if message is not None:
            self.sent.append((self.now_ns, message))
        self.now_ns += TICK_NS
        return message

    def run(self, seconds: float, phase: Phase = Phase.FORMED, outdated: bool = False) -> list[int]:
        """Ticks in the slot; when messages went out, after now (ns)."""
        began_ns, known = self.now_ns, len(self.sent)
        for _ in range(round(seconds / 0.02)):
            self.tick(phase=phase, outdated=outdated)
        return [t - began_ns for t, _ in self.sent[known:]]

    def counted(self, cause: str) -> int:
        return self.publisher.sent_because[cause]


def settled() -> One:
    """One that has said who it is, with its repeats."""
    one = One()
    one.run(2.0)
    assert one.counted("first") == 1
    assert one.counted("announced") == len(REPEATS_NS)
    assert not one.publisher.announces
    return one


def test_the_first_message_is_sent_at_once_and_repeated() -> None:
    assert One().run(2.0) == [0, 260_000_000, 1_000_000_000]


def test_who_stays_where_it_is_foreseen_speaks_only_before_the_longest_silence_is_over() -> None:
    one = settled()
    gaps = one.run(60.0)
    assert one.counted("heartbeat") == len(gaps) > 0
    times = [t for t, _ in one.sent[-len(gaps) :]]
    assert all(0.8 * T_MAX_S <= (b - a) * 1e-9 <= T_MAX_S + 0.02 for a, b in pairwise(times))


def test_who_leaves_what_is_foreseen_speaks_at_once_and_then_no_closer_than_t_min() -> None:
    one = settled()
    assert one.tick(off_m=1.0) is not None
    assert one.counted("triggered") == 1
    later = [one.tick(off_m=3.0) is not None for _ in range(3)]
    assert later == [False, False, True], "20, 40 and 60 ms later; t_min is 50 ms"


@pytest.mark.parametrize(
    ("before", "after", "within_ns"),
    [
        (Phase.WAITING, Phase.LANDING, 0),
        (Phase.WAITING, Phase.FORMING, spread_ns(3)),
        (Phase.MOVING, Phase.HOLDING, None),
    ],
)
def test_a_new_phase_is_announced_at_once_spread_or_not_at_all(
    before: Phase, after: Phase, within_ns: int | None
) -> None:
    one = settled()
    one.publisher.on_phase(before, one.now)
    one.run(3.0)
    one.publisher.on_phase(after, one.now)
    told = one.run(3.0)
    if within_ns is None:
        assert told == []
    else:
        assert told
        assert told[0] <= within_ns + TICK_NS


def test_a_phase_that_stays_is_announced_once() -> None:
    one = settled()
    for _ in range(100):
        one.publisher.on_phase(Phase.LANDING, one.now)
        one.tick(phase=Phase.LANDING)
    assert one.counted("announced") == 2 * len(REPEATS_NS) + 1


def test_who_lacks_a_newer_trajectory_says_so_once_a_second() -> None:
    one = settled()
    told = one.run(5.0, outdated=True)
    assert 4 <= len(told) <= 6
    assert all(b - a >= CATCH_UP_NS for a, b in pairwise(told))


def test_somebody_else_under_the_own_id_is_contradicted_soon_but_not_for_each_word() -> None:
    one = settled()
    assert not one.publisher.own_id_heard(one.now)
    began = len(one.sent)
    for _ in range(100):
        one.publisher.on_own_id(one.now)
        one.tick()
    assert one.publisher.own_id_heard(one.now)
    assert 2 <= len(one.sent) - began <= 2_000_000_000 // OWN_ID_ANSWER_NS + 1


@given(st.integers(min_value=0, max_value=60))
def test_however_many_peers_appear_at_once_few_messages_answer_them(peers: int) -> None:
    one = settled()
    for _ in range(peers):
        one.publisher.on_new_peer(one.now)
    told = one.run(3.0)
    assert len(told) <= min(peers, 8)
    assert bool(told) is bool(peers)
    assert all(t <= spread_ns(3) + TICK_NS for t in told)


def test_messages_are_counted_by_cause_and_numbered_without_a_gap() -> None:
    one = settled()
    one.publisher.near.named(one.now_ns)
    one.run(1.5)
    one.tick(off_m=2.0)
    assert set(one.publisher.sent_because) == set(CAUSES)
    assert sum(one.publisher.sent_because.values()) == one.publisher.messages_sent == len(one.sent)
    assert [m.sequence for _, m in one.sent] == list(range(1, len(one.sent) + 1))
    assert {m.boot_id for _, m in one.sent} == {7}


def test_who_was_named_near_speaks_at_the_rate_of_near_mode_and_promises_the_next() -> None:
    one = settled()
    one.publisher.near.named(one.now_ns)
    told = one.run(1.0)
    assert 9 <= len(told) <= 11
    assert all(m.due_soon for _, m in one.sent[-len(told) :])
    one.run(3.0)
    assert not one.publisher.near.promised


def test_a_new_trajectory_is_compared_under_and_announced() -> None:
    one = settled()
    one.publisher.on_trajectory(one.now)
    assert one.publisher.announces
    assert one.run(3.0)[0] <= spread_ns(3) + TICK_NS
    assert one.sent[-1][1].sample.position_ned_m != Ned(0.0, 0.0, 0.0)
