"""Flights as they should be: ten vehicles from take-off to landing, the same again from the same seed, and replayed."""

import json
from collections import Counter
from dataclasses import dataclass

import numpy as np
import pytest
from flights import (
    READY_S,
    Tape,
    check_setpoint,
    distances,
    errors,
    failsafes,
    first,
    fleet,
    last,
    launch,
    straight,
    truth,
    until_formed,
    until_landed,
)

from companion.config import FleetConfig
from companion.core.values import Instant, Phase
from companion.io.replay import replay
from companion.vehicle.agent import Agent
from companion.wire.operator import Status, decode, encode
from companion.wire.peer import decode_motion, encode_motion
from sim.launch.summary.flight import Flight, Put
from sim.launch.summary.summarise import summarise
from sim.lockstep.clockwork import UTC_AT_START_NS
from sim.lockstep.lockstep import Lockstep
from sim.lockstep.network import NetworkParameters

pytestmark = pytest.mark.timeout(600)
"""a flight is simulated within a test, on whatever machine"""

TEN = fleet(
    10,
    legs=[
        *straight(6.0),
        {"kind": "turn", "rate_deg_s": 12.0, "angle_deg": 90.0},
    ],
)
REPLAYED = 4


@dataclass
class Recorded:
    """A flight and what was seen of it."""

    ls: Lockstep
    tape: Tape
    config: FleetConfig
    setpoints: Counter[int]

    @property
    def steady(self) -> tuple[float, float]:
        return last(self.ls, "-> formed") + 3.0, first(self.ls, "-> landing")


@pytest.fixture(scope="module")
def ten() -> Recorded:
    tape = Tape(frozenset({REPLAYED}))
    setpoints: Counter[int] = Counter()

    def record(i: int, channel: str, now: Instant, body: bytes) -> None:
        tape(i, channel, now, body)
        if channel == "output/mavlink":
            setpoints[i] += check_setpoint(body, TEN)

    ls = launch(TEN, seed=3, record=record)
    until_formed(ls)
    until_landed(ls, 90.0)
    return Recorded(ls, tape, TEN, setpoints)


def test_ten_vehicles_take_off_form_fly_their_plan_and_land_without_a_failsafe(ten: Recorded) -> None:
    assert failsafes(ten.ls) == []
    assert set(ten.ls.phases().values()) == {Phase.LANDED}
    end = truth(ten.ls)
    assert not end.armed[-1].any()
    assert (end.landed_state[-1] == 1).all()
    for i in ten.ls.vehicles:
        passed = [n.split(":")[0] for _, v, n in ten.ls.notes if v == i and " -> " in n]
        assert passed == [
            "idle -> preflight", "preflight -> armed", "armed -> climbing", "climbing -> waiting",
            "waiting -> forming", "forming -> formed", "formed -> moving", "moving -> landing", "landing -> landed",
        ]  # fmt: skip


def test_the_v_stands_within_a_minute_of_the_command(ten: Recorded) -> None:
    assert last(ten.ls, "-> formed") - READY_S <= 60.0


def test_the_formation_keeps_its_shape_and_place_through_the_turn(ten: Recorded) -> None:
    t = truth(ten.ls, *ten.steady)
    assert len(t.times_ns) > 750
    formation, centroid = errors(ten.ls, t, t.ids)
    assert np.sqrt(np.square(formation).mean()) <= 0.12
    assert np.sqrt(np.square(centroid).mean()) <= 0.5


def test_nobody_comes_closer_than_allowed_after_take_off(ten: Recorded) -> None:
    assert distances(truth(ten.ls, READY_S)).min() >= 1.2


def test_vehicles_say_a_hundredth_of_what_twenty_states_a_second_would(ten: Recorded) -> None:
    begin, end = ten.steady
    puts = [s for s in ten.ls.sent if begin <= s.time_ns * 1e-9 <= end]
    assert len(puts) / len(ten.ls.vehicles) / (end - begin) <= 0.01 * 20.0


def test_all_fly_the_same_motions(ten: Recorded) -> None:
    motions = {encode_motion(v.agent.history.newest) for v in ten.ls.vehicles.values()}
    assert len(motions) == 1
    orders = {tuple(m.order for m in v.agent.history.motions) for v in ten.ls.vehicles.values()}
    assert len(orders) == 1


def test_every_setpoint_was_finite_and_within_limits_and_none_was_missed(ten: Recorded) -> None:
    assert min(ten.setpoints.values()) > 1000
    assert dict(ten.setpoints) == {i: v.agent.setpoints_sent for i, v in ten.ls.vehicles.items()}
    assert max(v.autopilot.truth().setpoint_gap_max_s for v in ten.ls.vehicles.values()) <= 0.1


def test_a_flight_without_faults_counts_next_to_nothing_as_rejected(ten: Recorded) -> None:
    for v in ten.ls.vehicles.values():
        status = v.agent.status(ten.ls.now)
        assert decode(Status, encode(status)) == status
        assert not set(status.rejected) - {"refused: stream", "position repeated", "answer to nothing asked"}, status


def test_the_summary_says_what_the_true_states_say(ten: Recorded) -> None:
    ls = ten.ls
    flight = Flight(ten.config, 3, ls.truth(), round(READY_S * 1e9) + UTC_AT_START_NS)
    flight.events = ls.events
    flight.puts = [Put(s.time_ns + UTC_AT_START_NS, s.vehicle_id, s.topic, s.size) for s in ls.sent]
    summary = summarise(flight)
    assert summary["passed"], summary["criteria"]
    assert summary["minimum_distance_m"] == pytest.approx(distances(truth(ls, READY_S)).min(), abs=2e-4)
    assert summary["formed_after_s"] == pytest.approx(last(ls, "-> formed") - READY_S, abs=0.03)
    t = truth(ls, *ten.steady)
    formation, centroid = errors(ls, t, t.ids)
    steady = summary["steady"]
    assert steady["formation_error_rms_m"] == pytest.approx(np.sqrt(np.square(formation).mean()), rel=0.02)
    assert steady["centroid_error_rms_m"] == pytest.approx(np.sqrt(np.square(centroid).mean()), rel=0.02)
    assert steady["reduction_vs_20hz_percent"] >= 99.0
    json.dumps(summary, allow_nan=False)


def test_shape_and_place_are_told_apart(ten: Recorded) -> None:
    """The same flight with all of it carried off by a metre: its shape stands as before, its place is nobody's."""
    ls = ten.ls
    told = []
    for off_m in (0.0, 1.0):
        rows = ls.truth()
        rows["position_ned_m"][:, 0] += off_m
        flight = Flight(ten.config, 3, rows, round(READY_S * 1e9) + UTC_AT_START_NS)
        flight.events = ls.events
        told.append(summarise(flight))
    here, carried_off = told
    assert 0.0 < here["place_taken_after_s"] <= here["formed_after_s"] + 1.0
    assert 0.0 < here["shape_formed_after_s"] <= here["formed_after_s"] + 1.0
    assert carried_off["shape_formed_after_s"] == here["shape_formed_after_s"]
    assert carried_off["place_taken_after_s"] is None


def test_replaying_a_vehicles_recorded_inputs_gives_the_recorded_outputs_byte_for_byte(ten: Recorded) -> None:
    agent = Agent(TEN, REPLAYED, ten.ls.vehicles[REPLAYED].agent.boot_id)
    result = replay(agent, iter(ten.tape.entries[REPLAYED]))
    assert result.same, result.sentence()
    assert result.outputs > 1000
    assert agent.status(ten.ls.now) == ten.ls.vehicles[REPLAYED].agent.status(ten.ls.now)


def test_replay_notices_one_changed_bit(ten: Recorded) -> None:
    entries = list(ten.tape.entries[REPLAYED])
    k = next(k for k, e in enumerate(entries) if e.channel == "output/mavlink" and k > 2000)
    body = bytearray(entries[k].body)
    body[20] ^= 1
    entries[k] = type(entries[k])(entries[k].channel, entries[k].instant, bytes(body))
    result = replay(Agent(TEN, REPLAYED, ten.ls.vehicles[REPLAYED].agent.boot_id), iter(entries))
    assert not result.same
    assert "recorded output/mavlink" in (result.difference or "")


def digest_of(seed: int) -> str:
    tape = Tape()
    network = NetworkParameters(delay_s=0.02, jitter_s=0.02, loss=0.1)
    ls = launch(fleet(3, legs=straight(2.0)), seed, network, tape)
    ls.run_until(READY_S + 14.0)
    assert ls.all_in(Phase.FORMING, Phase.FORMED)
    return str(tape.digest.hexdigest())


def test_the_same_seed_gives_the_same_bits_and_another_seed_others() -> None:
    once = digest_of(7)
    assert digest_of(7) == once
    assert digest_of(8) != once


def test_motions_told_on_the_network_are_those_that_were_flown(ten: Recorded) -> None:
    told = [
        decode_motion(e.body.partition(b"\0")[2])
        for e in ten.tape.entries[REPLAYED]
        if e.channel == "input/peer" and b"/plan\0" in e.body[:24]
    ]
    newest = max(told, key=lambda m: m.order)
    assert newest.order <= ten.ls.vehicles[REPLAYED].agent.history.newest.order
