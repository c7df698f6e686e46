"""The seeded network: what is lost, what is late, who is cut off; and the same again from the same seed."""

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.lockstep.network import Network, NetworkParameters

MESSAGES = 4000
PERIOD_NS = 10_000_000


def arrivals(parameters: NetworkParameters, seed: int = 1, messages: int = MESSAGES) -> list[int | None]:
    """Delay of each message of one link (ns), None if it was lost."""
    network = Network(parameters, seed)
    delays = []
    for k in range(messages):
        arrival = network.arrival_ns(1, 2, k * PERIOD_NS)
        delays.append(None if arrival is None else arrival - k * PERIOD_NS)
    return delays


def test_a_perfect_network_loses_nothing_and_delays_by_what_it_says() -> None:
    delays = arrivals(NetworkParameters(delay_s=0.05, jitter_s=0.0))
    assert set(delays) == {50_000_000}


def test_delays_stay_between_the_delay_and_the_delay_with_its_jitter() -> None:
    delays = [d for d in arrivals(NetworkParameters(delay_s=0.01, jitter_s=0.03)) if d is not None]
    assert min(delays) >= 10_000_000
    assert max(delays) <= 40_000_000
    assert sum(delays) / len(delays) == pytest.approx(25_000_000, rel=0.05)


def test_jitter_beyond_the_period_lets_messages_overtake_each_other() -> None:
    network = Network(NetworkParameters(delay_s=0.0, jitter_s=0.05), 3)
    times = [network.arrival_ns(1, 2, k * PERIOD_NS) for k in range(200)]
    assert any(b < a for a, b in itertools.pairwise(t for t in times if t is not None))


@pytest.mark.parametrize("loss", [0.1, 0.3, 0.8])
@pytest.mark.parametrize("burst_s", [0.0, 0.1])
def test_the_share_of_losses_is_the_one_asked_for(loss: float, burst_s: float) -> None:
    delays = arrivals(NetworkParameters(loss=loss, burst_s=burst_s), messages=5 * MESSAGES)
    assert sum(d is None for d in delays) / len(delays) == pytest.approx(loss, abs=0.04)


def test_bursts_last_as_long_as_they_should_on_average() -> None:
    delays = arrivals(NetworkParameters(loss=0.2, burst_s=0.2), messages=10 * MESSAGES)
    bursts = [len(list(run)) for lost, run in itertools.groupby(delays, lambda d: d is None) if lost]
    assert sum(bursts) / len(bursts) * PERIOD_NS * 1e-9 == pytest.approx(0.2, rel=0.25)


def test_links_lose_messages_of_their_own() -> None:
    network = Network(NetworkParameters(loss=0.5, burst_s=1.0), 5)
    one, other = ([network.arrival_ns(a, b, k * PERIOD_NS) is None for k in range(500)] for a, b in ((1, 2), (2, 1)))
    assert one != other


def test_who_is_cut_off_hears_and_is_heard_within_its_part_only() -> None:
    network = Network(NetworkParameters(), 1)
    network.partitions = (frozenset({1, 2}), frozenset({3, 4}))
    heard = {(a, b) for a, b in itertools.permutations(range(1, 6), 2) if network.arrival_ns(a, b, 0) is not None}
    assert heard == {(1, 2), (2, 1), (3, 4), (4, 3)}
    network.partitions = ()
    assert network.arrival_ns(1, 3, 0) is not None


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.floats(0.0, 0.9), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_the_same_seed_gives_the_same_network(seed: int, loss: float, burst_s: float, jitter_s: float) -> None:
    parameters = NetworkParameters(loss=loss, burst_s=burst_s, jitter_s=jitter_s)
    assert arrivals(parameters, seed, 50) == arrivals(parameters, seed, 50)


def test_another_seed_gives_another_network() -> None:
    parameters = NetworkParameters(loss=0.5)
    assert arrivals(parameters, 1) != arrivals(parameters, 2)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("delay_s", -0.1), ("jitter_s", float("nan")), ("burst_s", float("inf")),
        ("loss", 1.0), ("loss", -0.1), ("loss", float("nan")),
    ],
)  # fmt: skip
def test_parameters_that_are_no_network_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        NetworkParameters(**{name: value})
