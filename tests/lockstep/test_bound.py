"""The bound on predictions in flight, at every control tick of every receiver, while nothing is lost."""

import pytest
from flights import fleet, launch, straight, until, wait

from companion.core.values import Phase
from sim.lockstep.bound_count import BoundCount
from sim.lockstep.lockstep import Lockstep
from sim.lockstep.network import NetworkParameters

LEGS = [*straight(4.0), {"kind": "turn", "rate_deg_s": 6.0, "angle_deg": 90.0}]


def flying(lag_s: float = 0.15, delay_s: float = 0.002, gust_m_s2: float = 0.3) -> Lockstep:
    """Three in a V that have just begun their plan."""

    def change(tables: dict[str, dict[str, object]]) -> None:
        tables["stub"].update(lag_s=lag_s, gust_m_s2=gust_m_s2)
        tables["limits"]["gust_m_s2"] = gust_m_s2

    ls = launch(fleet(3, legs=LEGS, change=change), seed=201, network=NetworkParameters(delay_s=delay_s))
    until(ls, 90.0, lambda: ls.all_in(Phase.MOVING))
    return ls


@pytest.mark.parametrize(
    ("lag_s", "delay_s", "gust_m_s2"),
    [
        (0.15, 0.002, 0.3),
        pytest.param(0.3, 0.03, 0.3, marks=pytest.mark.long),
        pytest.param(0.15, 0.03, 1.0, marks=pytest.mark.long),
    ],
)
def test_no_prediction_in_flight_is_farther_from_the_truth_than_its_bound(
    lag_s: float, delay_s: float, gust_m_s2: float
) -> None:
    """Forming, flying straight and turning; the delay is within the one that the bound counts on."""
    ls = flying(lag_s, delay_s, gust_m_s2)
    wait(ls, 12.0)
    assert ls.bound.looks > 3 * 2 * 50 * 12
    assert ls.bound.exceeded == 0
    assert 0.0 < ls.bound.quantile_m(0.999) <= ls.bound.error_max_m + 1e-3 < ls.config.prediction_error_m


def test_what_is_farther_than_its_bound_is_counted() -> None:
    count = BoundCount()
    for error_m in (0.19, 0.2, 0.21, 0.4):
        count.see(error_m, 0.2)
    assert (count.looks, count.exceeded) == (4, 2)
    assert count.worst == pytest.approx(2.0)


def test_a_quantile_of_the_errors_is_the_one_below_which_so_many_lie() -> None:
    count = BoundCount()
    for k in range(100):
        count.see(0.01 * k + 0.0005, 2.0)
    assert count.quantile_m(0.5) == pytest.approx(0.491)
    assert count.quantile_m(1.0) == pytest.approx(0.991)
