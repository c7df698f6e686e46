"""Published intent as it is flown: the intended place, its hold, and what the peers make of it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import exp, hypot, sqrt
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from companion.config import FleetConfig, load
from companion.core.counts import Counts
from companion.core.frames import Ned
from companion.core.law.intent import FAR_M, FIELDS, START_M, TO_PLAN_PER_S, IntentGains, IntentHold, IntentLaw
from companion.core.neighbours.table import PeerTable
from companion.core.prediction import Held, HoldBounds, PlainHold
from companion.core.trajectory.fleet import Reference
from companion.core.trajectory.history import TrajectoryHistory
from companion.core.trigger.base import Situation
from companion.core.trigger.error import ErrorTrigger
from companion.core.values import ZERO, Instant, Neighbour, PeerMessage, PeerSample, Phase, VehicleState
from companion.vehicle.guest import GUESTS, HOLD_FAILED, GuestHold
from companion.vehicle.publisher import OwnState, Publisher
from companion.wire.peer import decode_state, encode_state

PROPERTY = settings(deadline=None, max_examples=60)
GAINS = IntentGains(4.0, 4.0, 2.0, 1.0, 1.0, 1.0)
A_MAX_M_S2, DAMPING_S = 5.0, 0.7
HOLD = IntentHold(GAINS, A_MAX_M_S2, DAMPING_S)
UTC_NS = 1_790_000_000_000_000_000
DT_S = 0.02

gains = st.builds(IntentGains, st.floats(0.1, 20.0), st.floats(0.0, 20.0), st.floats(0.1, 10.0), st.floats(0.01, 5.0),
                  st.just(1.0), st.just(1.0))  # fmt: skip
small = st.floats(-0.5, 0.5)
metres = st.floats(-30.0, 30.0)
speeds = st.floats(-5.0, 5.0)
ages_s = st.floats(0.0, 12.0)


def sample(place: Ned, velocity: Ned, told: tuple[float, ...], phase: Phase = Phase.MOVING) -> PeerSample:
    return PeerSample(2, UTC_NS, place, velocity, 0, phase, None, told)


def standing(place: Ned = ZERO) -> Reference:
    return Reference(place, ZERO, ZERO, 0.0)


# -- the hold ----------------------------------------------------------------------------------------------------------


@PROPERTY
@given(st.builds(Ned, metres, metres, metres), st.builds(Ned, speeds, speeds, speeds), metres, metres, small, small)
def test_a_sample_from_now_is_taken_as_it_is(
    place: Ned, velocity: Ned, q_north: float, q_east: float, g_north: float, g_east: float
) -> None:
    held = HOLD.at(sample(place, velocity, (q_north, q_east, g_north, g_east)), (ZERO, ZERO), standing(), 0.0)
    assert held.position_ned_m == pytest.approx(place, abs=1e-9)
    assert held.velocity_ned_m_s == pytest.approx(velocity, abs=1e-9)
    assert held.told == pytest.approx((q_north, q_east, g_north, g_east), abs=1e-9)


@settings(deadline=None, max_examples=20)
@given(small, small, small, st.floats(0.0, 6.0))
def test_within_the_laws_budget_the_hold_is_what_the_law_flies(e_m: float, rate: float, g: float, tau_s: float) -> None:
    """The plan's motion, an anchor that comes to rest, and the loop of the law about it; nothing saturates."""
    v_d, q = 0.8, 3.0

    def flown(t: float, y: np.ndarray) -> list[float]:
        p, v, place, speed = y
        asked = -GAINS.k_d * (v - v_d - speed) - GAINS.k_p * (p - place) - GAINS.c_g * speed
        return [v, asked, v_d + speed, -GAINS.c_g * speed]

    scale = min(1.0, 4.9 / max(GAINS.k_p * abs(e_m) + sqrt(GAINS.k_d**2 + GAINS.k_p) * abs(rate), 1e-9))
    e_m, rate = scale * e_m, scale * rate
    start = [q + e_m, v_d + g + rate, q, g]
    p, v, place, speed = solve_ivp(flown, (0.0, tau_s), start, rtol=1e-9, atol=1e-9).y[:, -1]
    held = HOLD.at(
        sample(Ned(q + e_m, 0.0, 0.0), Ned(v_d + g + rate, 0.0, 0.0), (q, 0.0, g, 0.0)),
        (ZERO, Ned(v_d, 0.0, 0.0)), Reference(Ned(v_d * tau_s, 0.0, 0.0), Ned(v_d, 0.0, 0.0), ZERO, 0.0), tau_s,
    )  # fmt: skip
    assert (held.position_ned_m.north, held.velocity_ned_m_s.north) == pytest.approx((p, v), abs=1e-5)
    assert held.told == pytest.approx((place, 0.0, speed, 0.0), abs=1e-6)


@PROPERTY
@given(gains, metres, metres, speeds, speeds, speeds, speeds, st.floats(0.0, 4.0))
def test_whatever_a_peer_tells_its_prediction_brakes_no_harder_than_the_bound_counts_on(
    g: IntentGains, e_north: float, e_east: float, v_north: float, v_east: float, g_north: float, g_east: float,
    tau_s: float,
) -> None:  # fmt: skip
    hold, step_s = IntentHold(g, A_MAX_M_S2, DAMPING_S), 1e-4
    said = sample(ZERO, Ned(v_north, v_east, 0.0), (-e_north, -e_east, g_north, g_east))
    a, b = (hold.at(said, (ZERO, ZERO), standing(), t).velocity_ned_m_s for t in (tau_s, tau_s + step_s))
    braking = hypot(b.north - a.north, b.east - a.east) / step_s
    speed = hypot(v_north, v_east)
    bounds = hold.bounds(speed + g.c_max)
    assert braking <= bounds.braking_m_s2 * 1.01 + 1e-6
    assert hypot(a.north, a.east) <= speed + g.c_max + bounds.gained_m_s + 1e-9


def test_the_vertical_is_held_damped() -> None:
    said = sample(Ned(1.0, 2.0, -10.0), Ned(0.3, 0.2, -0.5), (1.0, 2.0, 0.0, 0.0))
    plain = PlainHold("damped", DAMPING_S).at(said, (ZERO, ZERO), standing(), 1.3)
    held = HOLD.at(said, (ZERO, ZERO), standing(), 1.3)
    assert held.position_ned_m.down == plain.position_ned_m.down
    assert held.velocity_ned_m_s.down == plain.velocity_ned_m_s.down


# -- sender and receiver -----------------------------------------------------------------------------------------------

FLEET = Path(__file__).resolve().parents[2] / "fleet.toml"


def intent(tables: dict[str, Any]) -> None:
    tables["law"]["kind"] = "intent"
    tables["vehicle"] = tables["vehicle"][:3]


CONFIG: FleetConfig = load(FLEET, intent)


@PROPERTY
@given(small, small, small, small, ages_s, st.booleans())
def test_receivers_predict_what_the_sender_compares_with_from_it_and_from_a_digest(
    off: float, drift: float, anchor: float, rate: float, age_s: float, passed_on: bool
) -> None:
    history = TrajectoryHistory([CONFIG.first_motion])
    sender, receiver = (
        PeerTable(i, frozenset({1, 2, 3}) - {i}, CONFIG.peer_limits, history) for i in (2, 1)
    )  # fmt: skip
    r = history.reference(2, UTC_NS)
    p = r.position_ned_m
    said = PeerSample(
        2, UTC_NS, p._replace(north=p.north + off), Ned(drift, 0.0, 0.0), 0, Phase.FORMED, None,
        (p.north + anchor, p.east - anchor, rate, -rate),
    )  # fmt: skip
    other = history.reference(3, UTC_NS).position_ned_m
    by_third = PeerSample(3, UTC_NS, other, ZERO, 0, Phase.FORMED, None, (other.north, other.east, 0.0, 0.0))
    message = PeerMessage(7, 1, 0, 0, by_third, (said,)) if passed_on else PeerMessage(7, 1, 0, 0, said, ())
    assert receiver.accept(decode_state(encode_state(message)), Instant(0, UTC_NS)) is None
    later = UTC_NS + round(age_s * 1e9)
    expected = sender.foresight.under(history.reference(2, later), said, (p, r.velocity_ned_m_s), later)
    moment = history.at(later).state_at(later)
    found = receiver.predict(ZERO, Instant(round(age_s * 1e9), later), moment, False)
    (n,) = (n for n in found if n.vehicle_id == 2)
    assert n.position_ned_m == pytest.approx(expected.position_ned_m, abs=1e-4)
    assert n.velocity_ned_m_s == pytest.approx(expected.velocity_ned_m_s, abs=1e-4)
    assert n.told == pytest.approx(expected.told, abs=1e-4)


def situation(**changed: float) -> Situation:
    return Situation(0.0, 0.0, 0.0, 0.0, 0, 0)._replace(**changed)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("off_m", "residual_m", "fires"),
    [(0.0, 0.0, False), (0.0049, 0.0, False), (0.0051, 0.0, True), (0.079, 0.1, False), (0.081, 0.1, True)],
)
def test_an_intended_place_that_is_off_fires_by_the_larger_of_its_thresholds(
    off_m: float, residual_m: float, fires: bool
) -> None:
    trigger = ErrorTrigger(0.3, 0.1, 0.3, 0.03, 0.005, 0.8)
    assert trigger.fires(situation(error_told_m=off_m, mean_residual_2=residual_m**2)) is fires


@dataclass
class One:
    """A publisher of vehicle 1, which stays in its slot."""

    publisher: Publisher
    history: TrajectoryHistory
    now_ns: int = 1_000_000_000
    sent: int = field(default=0, init=False)

    def run(self, seconds: float, intended_off_m: float, phase: Phase) -> int:
        """How many messages the trigger fires in that time."""
        before = self.publisher.sent_because["triggered"]
        for _ in range(round(seconds / DT_S)):
            now = Instant(self.now_ns, UTC_NS + self.now_ns)
            r = self.history.reference(1, now.fleet_ns)
            p = r.position_ned_m
            told = (p.north + intended_off_m, p.east, 0.0, 0.0)
            self.publisher.publish(OwnState(phase, p, ZERO, r, ZERO, UTC_NS, told), now)
            self.now_ns += round(DT_S * 1e9)
        return self.publisher.sent_because["triggered"] - before


def test_a_vehicle_tells_where_it_intends_to_be_once_that_is_off_and_only_in_formation() -> None:
    history = TrajectoryHistory([CONFIG.first_motion])
    peers = PeerTable(1, frozenset({2, 3}), CONFIG.peer_limits, history)
    one = One(Publisher(CONFIG, 1, 7, CONFIG.trigger_rule, history, peers, Random(1)), history)
    assert one.run(3.0, 0.0, Phase.FORMED) == 0
    assert one.run(1.0, 0.004, Phase.FORMED) == 0
    assert one.run(1.0, 0.02, Phase.FORMED) == 1
    one.run(3.0, 0.02, Phase.DETACHED)
    assert one.run(1.0, 5.0, Phase.DETACHED) == 0


# -- the law -----------------------------------------------------------------------------------------------------------


def law() -> IntentLaw:
    made = CONFIG.law.law(CONFIG.r0_m)
    assert isinstance(made, IntentLaw)
    made.reset()
    return made


def neighbour(vehicle: int, place: Ned, offset: Ned, told: tuple[float, ...], **changed: Any) -> Neighbour:
    return Neighbour(vehicle, place, ZERO, offset, 0.0, True, True, 0.5, None, ZERO, ZERO, told)._replace(**changed)


def at(k: int, place: Ned, velocity: Ned = ZERO) -> VehicleState:
    return VehicleState(UTC_NS + k * round(DT_S * 1e9), place, velocity)


def test_an_anchor_starts_where_the_vehicle_is_but_no_farther_from_its_slot_than_start_m() -> None:
    near, far = law(), law()
    near.command(at(0, Ned(0.2, 0.0, -3.0)), standing(), (), alone=False)
    far.command(at(0, Ned(3.0, 4.0, -3.0)), standing(), (), alone=False)
    back = -TO_PLAN_PER_S
    assert near.tell() == pytest.approx((0.2, 0.0, 0.2 * back, 0.0))
    assert far.tell() == pytest.approx((0.6 * START_M, 0.8 * START_M, 0.6 * START_M * back, 0.8 * START_M * back))
    assert far.fields == FIELDS


def agreeing(shared: bool, drifts: Sequence[float], seconds: float) -> list[tuple[float, ...]]:
    """Three that hear each other at once and begin at different offsets from their slots, in a motion at 1 m/s north;
    what their intended places are off by from a common formation, at the end."""
    slots = [Ned(0.0, 4.0 * i, -3.0) for i in range(3)]
    laws = [law() for _ in slots]
    for k in range(round(seconds / DT_S)):
        told = [(x.tell()[0] + DT_S, *x.tell()[1:]) for x in laws]
        here = Ned(k * DT_S if shared else 0.0, 0.0, 0.0)
        for i, (one, slot, drift) in enumerate(zip(laws, slots, drifts, strict=True)):
            around = [
                neighbour(j, slots[j]._replace(north=k * DT_S), Ned(0.0, slot.east - slots[j].east, 0.0), told[j])
                for j in range(3)
                if j != i and k > 0
            ]
            p = Ned(slot.north + here.north, slot.east, slot.down)
            reference = Reference(p, Ned(1.0, 0.0, 0.0), ZERO, 0.0, shared)
            one.command(at(k, p._replace(north=p.north + drift)), reference, around, alone=False)
    return [(x.tell()[0] - (seconds - DT_S), x.tell()[1] - s.east) for x, s in zip(laws, slots, strict=True)]


@pytest.mark.parametrize("shared", [True, False])
def test_intended_places_agree_on_their_mean_with_a_plan_and_without(shared: bool) -> None:
    """Without one the references do not move with the vehicles; the intended places do, by the common velocity. With
    one the mean comes back to the plan."""
    left = exp(-6.0 * TO_PLAN_PER_S) if shared else 1.0
    for place in agreeing(shared, (0.25, -0.1, 0.0), 6.0):
        assert place == pytest.approx((0.05 * left, 0.0), abs=1e-3)


def test_whoever_was_apart_takes_the_mean_of_what_it_hears_and_draws_nobody() -> None:
    one = law()
    around = [neighbour(j, Ned(3.0, 4.0 * j, 0.0), Ned(0.0, -4.0 * j, 0.0), (0.2, 4.0 * j, 0.0, 0.0)) for j in (1, 2)]
    one.command(at(0, Ned(2.0, 1.0, 0.0)), standing(Ned(2.0, 1.0, 0.0)), around, alone=True)
    assert one.tell() == pytest.approx((2.0, 1.0, 0.0, 0.0))
    wanted = one.command(at(1, ZERO), standing(), around, alone=False)
    assert one.tell() == pytest.approx((0.2, 0.0, -0.2 * TO_PLAN_PER_S, 0.0))
    assert wanted.residual_ned_m == pytest.approx((0.0, 0.0, 0.0))


@pytest.mark.parametrize("alone", [True, False])
def test_who_tells_of_a_place_that_it_cannot_intend_is_not_heeded(alone: bool) -> None:
    one = law()
    liar = neighbour(2, Ned(0.0, 4.0, 0.0), Ned(0.0, -4.0, 0.0), (FAR_M + 0.1, 4.0, 0.0, 0.0))
    one.command(at(0, ZERO), standing(), [liar], alone=alone)
    one.command(at(1, ZERO), standing(), [liar], alone=False)
    assert one.tell() == pytest.approx((0.0, 0.0, 0.0, 0.0))
    one.command(at(2, ZERO), standing(), [liar._replace(told=(FAR_M - 0.1, 4.0, 0.0, 0.0))], alone=False)
    assert one.tell()[2] > 0.5


def test_whoever_is_not_in_formation_is_kept_apart_from_and_not_agreed_with() -> None:
    one, alone = law(), law()
    for x in (one, alone):
        x.command(at(0, ZERO), standing(), (), alone=False)
    stranger = neighbour(2, Ned(1.0, 0.0, 0.0), Ned(-4.0, 0.0, 0.0), (9.0, 9.0, 0.0, 0.0), in_formation=False)
    pushed = one.command(at(1, ZERO), standing(), [stranger], alone=False)
    free = alone.command(at(1, ZERO), standing(), (), alone=False)
    assert pushed.acceleration_ned_m_s2.north < free.acceleration_ned_m_s2.north - 1.0
    assert one.tell() == alone.tell()


# -- holds of other packages -------------------------------------------------------------------------------------------


@dataclass
class Bad:
    """A hold that goes wrong."""

    way: str

    def at(self, sample: PeerSample, then: tuple[Ned, Ned], now: Reference, tau_s: float) -> Held:
        if self.way == "raises":
            raise SystemExit(3)
        return Held(Ned(float("nan"), 0.0, 0.0), ZERO, sample.told)

    def told_error_m(self, foreseen: tuple[float, ...], tells: tuple[float, ...]) -> float:
        raise ValueError("no")

    def bounds(self, speed_max_m_s: float) -> HoldBounds:
        return HoldBounds(0.0, 0.0, 0.0)


@pytest.mark.parametrize("way", ["raises", "nan"])
def test_for_a_foreign_hold_that_fails_the_damped_one_stands_and_it_is_counted(way: str) -> None:
    counts, plain = Counts(GUESTS), PlainHold("damped", DAMPING_S)
    guest = GuestHold(Bad(way), plain, counts)
    said = sample(Ned(1.0, 2.0, -3.0), Ned(0.5, 0.0, 0.0), (1.0,))
    assert guest.at(said, (ZERO, ZERO), standing(), 2.0) == plain.at(said, (ZERO, ZERO), standing(), 2.0)
    assert counts[HOLD_FAILED] == 1
    assert ErrorTrigger(0.3, 0.1, 0.3).fires(situation(error_told_m=guest.told_error_m((1.0,), (1.0,))))


def test_the_prediction_bound_counts_in_what_the_laws_own_hold_does() -> None:
    starling = load(FLEET)
    assert CONFIG.peer_motion.deviation_m_s2 == starling.peer_motion.deviation_m_s2 + A_MAX_M_S2 + 2.0 * 1.0
    assert isinstance(CONFIG.peer_limits.hold, IntentHold)
