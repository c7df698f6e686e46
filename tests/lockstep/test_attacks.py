"""Forged puts of the fault campaign: of valid form, so that it is the vehicles' rules that meet them."""

import json
from random import Random

import pytest
from flights import fleet

from companion.core.frames import Ned
from companion.core.values import PeerMessage, PeerSample, Phase
from companion.wire.peer import decode_state, encode_motion, encode_state
from sim.lockstep.lockstep import Lockstep
from sim.study.attacks import PLANS, SEQUENCE_LEAP, STATES, forged_plan, forged_state

NOW_NS = 1_700_000_010_000_000_000


def state(i: int) -> bytes:
    place = Ned(3.0 * i, 1.0, -3.0)
    sample = PeerSample(i, NOW_NS - 300_000_000, place, Ned(1.0, 0.0, 0.0), 2, Phase.FORMED)
    return encode_state(PeerMessage(40 + i, 100 * i, NOW_NS, 1, sample, ()))


HEARD = {i: state(i) for i in (1, 2, 3)}


@pytest.mark.parametrize("kind", PLANS)
def test_every_forged_plan_is_a_plan_by_its_form(kind: str) -> None:
    newest = fleet(4).first_motion
    plan = json.loads(forged_plan(kind, newest, 2, NOW_NS, Random(0)))
    assert plan.keys() == json.loads(encode_motion(newest)).keys()
    assert plan["issuer"] == 2
    assert plan["revision"] > newest.revision


@pytest.mark.parametrize("kind", STATES)
def test_every_forged_state_is_read_as_a_state_of_now_under_the_liars_id(kind: str) -> None:
    lie = forged_state(kind, HEARD, 2, NOW_NS, Random(0))
    assert lie is not None
    message = decode_state(lie)
    assert message.sample.vehicle_id == 2
    assert message.sample.time_ns == NOW_NS
    assert all(s.vehicle_id != 2 and s.time_ns == NOW_NS for s in message.digest)


def test_a_liar_that_was_never_heard_is_not_imitated() -> None:
    assert forged_state("others landed", HEARD, 4, NOW_NS, Random(0)) is None


def test_a_leaping_sequence_is_the_farthest_that_counts_as_newer() -> None:
    lie = forged_state("sequence leaps", HEARD, 2, NOW_NS, Random(0))
    assert lie is not None
    assert (decode_state(lie).sequence - decode_state(HEARD[2]).sequence) % (1 << 32) == SEQUENCE_LEAP + 1 < 1 << 31


def test_a_second_companion_on_anothers_line_knows_no_position_and_speaks_under_its_id() -> None:
    ls = Lockstep(fleet(3))
    ls.run_until(5.0)
    twin = ls.add_twin(3, line_of=1)
    ls.run_until(8.0)
    assert twin.autopilot.position_ns is None
    assert twin.autopilot.facts(ls.now).foreign_system_id == ls.vehicles[1].agent.vehicle.system_id
    ls.remove_twin(3)
    ls.remove_twin(3)
    ls.run_until(9.0)
