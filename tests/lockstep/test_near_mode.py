"""Near mode in flight: who is near speaks at 10 Hz and stays within its bound, and whoever is not pays nothing."""

from collections import Counter
from collections.abc import Iterable

import pytest
from flights import fleet, launch, until, wait

from companion.config import FleetConfig
from companion.core.safety.filter import COLLISION_DISTANCE_M
from companion.core.trigger.near import NearMode
from companion.core.values import Phase
from companion.vehicle.publisher import CAUSES
from sim.lockstep.lockstep import Lockstep
from sim.lockstep.network import NetworkParameters
from sim.study import headon, messages
from sim.study.common import load_config

MEETING = headon.meeting_of(load_config("headon"))


def counted(ls: Lockstep) -> Counter[str]:
    total: Counter[str] = Counter()
    for v in ls.vehicles.values():
        total.update(v.agent.publisher.sent_because)
    return total


def tight(shape: str, count: int = 4) -> FleetConfig:
    """At the smallest spacing that is not refused, to the centimetre."""

    def change(tables: dict[str, object]) -> None:
        tables["formation"]["spacing_m"] = 1.70  # type: ignore[index]
        tables["plan"]["legs"] = [  # type: ignore[index]
            {"kind": "velocity", "north_m_s": 1.0, "duration_s": 8.0},
            {"kind": "turn", "rate_deg_s": 6.0, "angle_deg": 90.0},
        ]

    config = fleet(count, shape=shape, change=change)
    assert config.spacing_min_m > 1.68
    return config


@pytest.mark.parametrize("seed", [120, 121])
@pytest.mark.parametrize(("loss", "delay_s", "least_m"), [(0.3, 0.2, 0.9), (0.5, 0.1, 0.7)])
def test_two_sent_head_on_keep_their_distance_and_their_bounds_though_messages_are_lost(
    seed: int, loss: float, delay_s: float, least_m: float
) -> None:
    met = headon.meet(MEETING, seed, lag_s=0.3, delay_s=delay_s, loss=loss)
    assert met["minimum_distance_m"] >= least_m
    assert met["passed"]
    assert met["bound_looks"] > 100
    assert met["bound_exceeded"] == 0


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("loss", "delay_s", "least_m"), [(0.3, 0.1, 0.9), (0.5, 0.1, 0.7)])
def test_of_fifty_meetings_under_loss_none_comes_near_a_collision_and_without_near_mode_some_do(
    loss: float, delay_s: float, least_m: float
) -> None:
    near, off = (
        [headon.meet(MEETING, s, lag_s=0.3, delay_s=delay_s, loss=loss, near=mode) for s in range(120, 170)]
        for mode in ("10 Hz", "off")
    )
    assert min(m["minimum_distance_m"] for m in near) >= least_m
    assert sum(m["bound_exceeded"] for m in near) == 0
    assert any(m["minimum_distance_m"] < COLLISION_DISTANCE_M for m in off)


def two_over_their_pads() -> Lockstep:
    """Two that stand 4 m apart, east of each other, and do nothing by themselves."""

    def change(tables: dict[str, object]) -> None:
        tables["plan"]["automatic"] = False  # type: ignore[index]

    ls = launch(fleet(2, change=change))
    until(ls, 30.0, lambda: ls.all_in(Phase.WAITING))
    wait(ls, 3.0)
    assert counted(ls)["near"] == 0, "neither on the ground nor climbing nor at rest 4 m apart"
    return ls


def throw(ls: Lockstep, i: int, east_m_s: float) -> None:
    """A gust that no law would fly, into the other one's direction."""
    ls.vehicles[i].autopilot.vehicle.velocity_east_m_s += east_m_s


def test_two_of_which_one_is_thrown_at_the_other_speak_at_10_hz_until_they_are_apart() -> None:
    ls = two_over_their_pads()
    throw(ls, 1, 2.5)
    wait(ls, 0.3)
    assert all(v.agent.publisher.near.promised for v in ls.vehicles.values()), "both, within 0.3 s"
    early = {i: v.agent.publisher.messages_sent for i, v in ls.vehicles.items()}
    wait(ls, 1.0)
    for i, v in ls.vehicles.items():
        assert 9 <= v.agent.publisher.messages_sent - early[i] <= 20, "10 Hz, and what the trigger fires"
    wait(ls, 10.0)
    assert not any(v.agent.publisher.near.promised for v in ls.vehicles.values())
    before = counted(ls)
    wait(ls, 10.0)
    assert counted(ls)["near"] == before["near"]
    assert ls.near_bound.looks > 100
    assert ls.near_bound.exceeded == 0


def test_one_message_that_arrives_is_enough_for_both_to_speak() -> None:
    """The thrown one hears nothing, and the other learns of it by its messages alone: who is named answers."""
    ls = two_over_their_pads()
    ls.vehicles[2].agent.publisher.near = Deaf(ls.vehicles[2].agent.publisher.near.rate)
    throw(ls, 1, 2.5)
    wait(ls, 0.4)
    assert ls.vehicles[2].agent.publisher.near.promised
    assert ls.vehicles[2].agent.publisher.near.peers(ls.now_ns) == ()


class Deaf(NearMode):
    """One whose own half-planes show nobody near."""

    def see(self, ids: Iterable[int], now_ns: int) -> None:
        """Nobody."""


def test_a_message_that_is_missing_widens_the_distance_kept_and_hearing_narrows_it_again() -> None:
    ls = two_over_their_pads()
    usual = ls.config.prediction_error_m
    one = ls.vehicles[1].agent
    throw(ls, 1, 2.5)
    wait(ls, 0.3)
    assert one.neighbours[0].uncertainty_m == usual
    ls.partition([1], [2])
    wait(ls, 0.4)
    assert one.neighbours[0].uncertainty_m > usual + 0.2
    wait(ls, 0.6)
    assert one.neighbours[0].uncertainty_m == usual + 1.0
    ls.partition()
    wait(ls, 0.5)
    assert one.neighbours[0].uncertainty_m == usual


@pytest.mark.parametrize("shape", ["v", pytest.param("grid", marks=pytest.mark.long),
                                   pytest.param("column", marks=pytest.mark.long),
                                   pytest.param("circle", marks=pytest.mark.long)])  # fmt: skip
def test_a_formation_at_the_smallest_spacing_permitted_is_not_near_itself(shape: str) -> None:
    ls = launch(tight(shape))
    until(ls, 80.0, lambda: ls.all_in(Phase.MOVING))
    wait(ls, 2.0)
    before = counted(ls)
    wait(ls, 20.0)
    sent = counted(ls) - before
    assert sent["near"] == 0
    assert sent.total() <= 0.01 * 20.0 * 20.0 * len(ls.vehicles) + len(ls.vehicles)
    assert set(counted(ls)) <= set(CAUSES)
    assert ls.near_bound.exceeded == 0


def test_vehicles_on_their_pads_are_not_near_however_close_the_pads() -> None:
    def change(tables: dict[str, object]) -> None:
        tables["launch"]["spacing_m"] = 1.5  # type: ignore[index]

    ls = Lockstep(fleet(4, change=change), network=NetworkParameters())
    ls.run_until(30.0)
    sent = counted(ls)
    assert sent["near"] == 0
    assert sent["first"] == 4


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_the_shipped_fleets_flight_costs_less_than_a_hundredth_of_20_hz() -> None:
    config = load_config("messages")
    whole = messages.table_of(config, "fleet", messages.Fleet)
    flown = messages.fly(whole, messages.Case("near", near=True, periodic=False), 1)
    assert flown["steady_percent"] >= messages.BAR_PERCENT
    assert flown["least_m"] > 2.0


def test_a_period_that_control_does_not_divide_is_kept_on_average() -> None:
    """20 Hz by a loop at 50 Hz: with t_min = 50 ms and a clock that starts at each message it is 16.7 Hz."""

    def change(tables: dict[str, object]) -> None:
        tables["trigger"].update(kind="periodic", period_s=0.05)  # type: ignore[attr-defined]

    ls = launch(fleet(2, change=change))
    before = sum(counted(ls).values())
    wait(ls, 10.0)
    # An announcement stands for the period's own message, or comes beside it.
    assert (sum(counted(ls).values()) - before) / 2 == pytest.approx(200, abs=12)
