"""The exchange of trajectories: what is adopted, what is refused, what is told on, and what is proposed."""

import json
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest

from companion.config import load
from companion.core.counts import Counts, RefusalKind
from companion.core.events import MotionAdopted
from companion.core.neighbours.table import PeerTable
from companion.core.trajectory.fleet import FleetTrajectory
from companion.core.trajectory.history import TrajectoryHistory
from companion.core.trajectory.legs import VelocityLeg
from companion.core.trajectory.successors import with_legs
from companion.core.values import ZERO, Instant, PeerMessage, PeerSample, Phase
from companion.errors import WireError
from companion.vehicle.agreement import Agreement
from companion.vehicle.autopilot.px4 import Px4Autopilot
from companion.vehicle.plan_exchange import PROPOSAL_DELAY_NS, PROPOSAL_SPREAD_NS, REJECTED, PlanExchange
from companion.vehicle.publisher import Publisher, spread_ns
from companion.vehicle.supervisor import Supervisor
from companion.wire.peer import decode_motion, encode_motion

CONFIG = load(Path(__file__).resolve().parents[2] / "fleet.toml", lambda t: t.update(vehicle=t["vehicle"][:3]))
SECOND_NS = 1_000_000_000
NOW_NS = 10 * SECOND_NS
UTC_NS = 1_790_000_000_000_000_000
SPREAD_NS = spread_ns(3)


def at(monotonic_ns: int) -> Instant:
    return Instant(monotonic_ns, UTC_NS + monotonic_ns)


def as_json(motion: FleetTrajectory) -> object:
    return json.loads(encode_motion(motion))


class One:
    """Vehicle 1's exchange among peers 2 and 3."""

    def __init__(self, seed: int = 1) -> None:
        self.history = TrajectoryHistory([CONFIG.first_motion])
        self.peers = PeerTable(1, frozenset({2, 3}), CONFIG.peer_limits, self.history)
        random = Random(seed)
        autopilot = Px4Autopilot(CONFIG, CONFIG.by_id(1))
        self.supervisor = Supervisor(CONFIG, autopilot, self.history, self.peers, lambda: None)
        self.publisher = Publisher(CONFIG, 1, 7, CONFIG.trigger_rule, self.history, self.peers, random)
        self.rejected = Counts(REJECTED)
        self.exchange = PlanExchange(
            CONFIG, 1, self.history, self.peers, self.supervisor, self.publisher, Agreement(CONFIG, 1, self.peers),
            random, self.rejected,
        )  # fmt: skip

    def fly(self, phase: Phase, now: Instant, revision: int | None = None) -> None:
        """This vehicle and both peers are in a phase, and say so."""
        self.supervisor.flight.phase = phase
        for i in (2, 3):
            self.hear(i, phase, now, revision)

    def hear(self, i: int, phase: Phase, now: Instant, revision: int | None = None) -> None:
        newest = self.history.newest
        known = newest.revision if revision is None else revision
        p = newest.reference(i, now.fleet_ns).position_ned_m
        sample = PeerSample(i, now.fleet_ns, p, ZERO, known, phase)
        message = PeerMessage(100 + i, 1, newest.start_ns, newest.issuer, sample, ())
        assert self.peers.accept(message, now) is None
        self.exchange.on_state(message, now)

    def propose_for(self, seconds: float, began_ns: int = NOW_NS) -> list[FleetTrajectory]:
        """Ticks; what was adopted in them."""
        for k in range(round(seconds / 0.02)):
            self.exchange.propose(at(began_ns + k * 20_000_000))
        return [e.motion for e in self.exchange.events if isinstance(e, MotionAdopted)]


def formed(start_ns: int = UTC_NS + NOW_NS + SECOND_NS, issuer: int = 2) -> FleetTrajectory:
    return CONFIG.motion_into("v", CONFIG.first_motion, start_ns, issuer)


def test_a_newer_sound_trajectory_is_adopted_and_announced_but_told_by_its_issuer_only() -> None:
    one, motion = One(), formed()
    one.exchange.on_plan(2, encode_motion(motion), at(NOW_NS))
    assert one.history.newest == motion
    assert [e.motion for e in one.exchange.events if isinstance(e, MotionAdopted)] == [motion]
    assert one.publisher.announces
    assert one.exchange.next_deadline_ns() is None
    assert not one.rejected


@pytest.mark.parametrize("order", [(2, 3), (3, 2)])
def test_of_two_proposals_of_one_revision_all_take_the_same_in_whatever_order_they_come(order: tuple[int, int]) -> None:
    one = One()
    for issuer in order:
        one.exchange.on_plan(issuer, encode_motion(formed(issuer=issuer)), at(NOW_NS))
    assert one.history.newest.issuer == 3


def test_bytes_that_are_no_trajectory_are_refused_by_the_codec_for_whoever_handed_them_in() -> None:
    with pytest.raises(WireError):
        One().exchange.on_plan(2, b"{}", at(NOW_NS))


def test_a_stranger_is_not_examined() -> None:
    one = One()
    one.exchange.on_plan(None, encode_motion(formed()), at(NOW_NS))
    assert one.rejected == {"plan: foreign id": 1}


def test_what_was_refused_for_what_it_is_is_not_examined_again() -> None:
    one = One()
    endless = replace(formed(), legs_start_ns=UTC_NS - 90_000 * SECOND_NS, legs=(VelocityLeg(ZERO, 1.0),))
    payload = encode_motion(endless)
    for _ in range(3):
        one.exchange.on_plan(2, payload, at(NOW_NS))
    assert one.rejected == {f"plan: {RefusalKind.TOO_LONG}": 1, "plan: refused before": 2}
    assert one.history.newest.revision == 0


def test_one_sender_that_rages_is_examined_no_more_than_its_budget_and_silences_nobody() -> None:
    one = One()
    for n in range(4000):
        fence = formed(start_ns=UTC_NS + NOW_NS + n)
        one.exchange.on_plan(2, encode_motion(replace(fence, shape="line")), at(NOW_NS))
    assert one.rejected["plan: more than can be examined"] > 0
    one.exchange.on_plan(3, encode_motion(formed(issuer=3)), at(NOW_NS))
    assert one.history.newest == formed(issuer=3)


def test_a_peer_that_lacks_the_newest_is_told_within_the_spread_unless_two_others_were_quicker() -> None:
    one, motion = One(), formed()
    one.exchange.on_plan(2, encode_motion(motion), at(NOW_NS))
    one.hear(3, Phase.WAITING, at(NOW_NS), revision=0)
    due_ns = one.exchange.next_deadline_ns()
    assert due_ns is not None
    assert NOW_NS <= due_ns < NOW_NS + SPREAD_NS
    assert one.exchange.due(at(due_ns - 1)) is None
    told = one.exchange.due(at(due_ns))
    assert told is not None
    assert decode_motion(told) == motion
    assert one.exchange.due(at(due_ns + 1)) is None, "once"
    one.hear(3, Phase.WAITING, at(due_ns + 1), revision=0)
    for _ in range(2):
        one.exchange.on_plan(2, encode_motion(motion), at(due_ns + 2))
    assert one.exchange.next_deadline_ns() is None


def test_whether_a_peer_holds_a_newer_one_is_told_to_the_supervisor() -> None:
    one = One()
    one.hear(2, Phase.WAITING, at(NOW_NS), revision=4)
    assert one.supervisor.flight.outdated
    one.hear(2, Phase.WAITING, at(NOW_NS + SECOND_NS))
    assert not one.supervisor.flight.outdated


def test_who_comes_late_is_told_the_plan_once_there_is_one() -> None:
    one = One()
    one.exchange.on_new_peer(at(NOW_NS))
    assert one.exchange.next_deadline_ns() is None
    one.exchange.on_plan(2, encode_motion(formed()), at(NOW_NS))
    one.exchange.on_new_peer(at(NOW_NS))
    assert one.exchange.next_deadline_ns() is not None


def test_all_that_are_up_form_and_all_that_have_formed_fly_the_plan() -> None:
    one = One()
    one.fly(Phase.WAITING, at(NOW_NS))
    (first,) = one.propose_for(PROPOSAL_SPREAD_NS * 3e-9 + 0.1)
    assert (first.revision, first.shape, first.issuer) == (1, "v", 1)
    assert NOW_NS + PROPOSAL_DELAY_NS <= first.start_ns - UTC_NS < NOW_NS + PROPOSAL_DELAY_NS + SECOND_NS
    assert one.exchange.due(at(NOW_NS + SECOND_NS)) == encode_motion(first), "its issuer tells it at once"
    later_ns = first.blend_end_ns - UTC_NS
    one.fly(Phase.FORMED, at(later_ns))
    _, second = one.propose_for(0.5, later_ns)
    assert len(second.legs) == len(CONFIG.plan.legs)
    assert second.then == CONFIG.plan.then


def test_nobody_proposes_while_a_peer_is_on_the_ground_or_before_its_own_wait_is_over() -> None:
    one = One()
    one.fly(Phase.WAITING, at(NOW_NS))
    one.hear(3, Phase.CLIMBING, at(NOW_NS + 1))
    assert one.propose_for(2.0) == []
    one.hear(3, Phase.WAITING, at(NOW_NS + 2))
    one.exchange.propose(at(NOW_NS + 3))
    assert not one.exchange.events, "each waits a time of its own first"


def test_a_vehicle_that_does_not_fly_proposes_nothing() -> None:
    one = One()
    one.fly(Phase.WAITING, at(NOW_NS))
    one.supervisor.flight.phase = Phase.RELEASED
    assert one.propose_for(2.0) == []


def test_who_wants_the_fleet_back_proposes_it_until_somebody_wants_something_else() -> None:
    one = One()
    one.exchange.on_plan(2, encode_motion(formed()), at(NOW_NS))
    one.fly(Phase.FORMED, at(NOW_NS))
    one.supervisor.return_wanted = True
    back = one.propose_for(1.0)[-1]
    assert back.returns
    other = with_legs(back, at_ns=back.start_ns + SECOND_NS, issuer=0, legs=(VelocityLeg(ZERO, 1.0),))
    assert one.exchange.on_command(as_json(replace(other, then="stay")), at(NOW_NS + SECOND_NS)) is None
    assert not one.supervisor.return_wanted


def test_a_commanded_trajectory_is_adopted_or_refused_with_its_reason() -> None:
    one = One()
    assert one.exchange.on_command({"revision": 1}, at(NOW_NS)) is not None
    assert one.rejected == {"command: motion": 1}
    old = one.exchange.on_command(as_json(replace(formed(issuer=0), revision=0)), at(NOW_NS))
    assert old == "revision 0 is not newer than 0"
    assert one.exchange.on_command(as_json(formed(issuer=0)), at(NOW_NS)) is None
    assert one.exchange.on_command(as_json(formed(issuer=0)), at(NOW_NS)) is None, "the same again is no fault"
    assert one.history.newest.issuer == 0
