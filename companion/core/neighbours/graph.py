"""Who heeds whom: the graph of alignment, cohesion and agreement, and how near it is to falling apart.

It is undirected: whom one vehicle heeds, that one heeds it. So "nearest" is taken between slots, which all know alike,
and not between places, of which each knows its own: two are joined if one of their slots is among the `count` nearest
of the other's. Separation and safety filter heed everybody, whatever the graph.

lambda_2 is the second smallest eigenvalue of the graph's Laplacian: 0 where it has fallen apart, and the slowest rate
with which those that are joined come to agree, in units of one neighbour's.
"""

from collections.abc import Generator, Mapping, Set
from math import dist, fsum, sqrt
from typing import Literal, NamedTuple, cast

from companion.core.frames import Ned

NeighbourKind = Literal["all", "range", "nearest"]
Graph = Mapping[int, Set[int]]
"""vehicle -> whom it is joined with, both ways"""
INVERSE_STEPS = 40
"""of the iteration for lambda_2: it is told to a few per cent, and never too small"""


class Connectivity(NamedTuple):
    """How well a graph holds together."""

    lambda2: float
    edge: int
    """the vehicle at its edge: the loosest of those that the fewest joints hold"""
    breaks: bool
    """it has fallen apart, or the loss of one vehicle would split it"""


def mutual_nearest(slots: Mapping[int, Ned], count: int) -> dict[int, frozenset[int]]:
    """Each vehicle's nearest by slots, and those whose nearest it is; of equals the smaller id."""
    joined: dict[int, set[int]] = {i: set() for i in slots}
    for i, place in slots.items():
        # Rounded, so that the last bit of a sine does not decide between equals.
        others = sorted((round(dist(place, other), 3), j) for j, other in slots.items() if j != i)
        for _, j in others[:count]:
            joined[i].add(j)
            joined[j].add(i)
    return {i: frozenset(others) for i, others in joined.items()}


def among(graph: Graph, ids: Set[int]) -> dict[int, frozenset[int]]:
    """The part of a graph that some vehicles are."""
    return {i: frozenset(graph[i] & ids) for i in sorted(ids)}


def connectivity(graph: Graph) -> Connectivity:
    """lambda_2 of a graph of at least two vehicles, who is at its edge, and whether one loss would split it."""
    work = connectivity_in_steps(graph)
    while True:
        try:
            next(work)
        except StopIteration as done:
            return cast(Connectivity, done.value)


def connectivity_in_steps(graph: Graph) -> Generator[None, None, Connectivity]:
    """The same, to be gone on with a step at a time: in all it costs a control period for fifty vehicles, a step of
    it some hundredths of one."""
    ids = sorted(graph)
    whole = _connected(graph, None)
    # A start that is across no vector of a regular graph.
    x = _across({i: (k * k * 0.6180339887498949) % 1.0 for k, i in enumerate(ids, 1)})
    # Inverse iteration across the common mode: what is left is the second smallest eigenvalue and its vector.
    for _ in range(INVERSE_STEPS if whole else 0):
        yield
        y = _across(_solved(graph, x))
        norm = sqrt(fsum(v * v for v in y.values()))
        x = {i: v / norm for i, v in y.items()}
    lx = _laplacian(graph, x)
    lambda2 = fsum(x[i] * lx[i] for i in ids) if whole else 0.0
    breaks = not whole
    for i in ids if len(ids) > 2 else ():
        if breaks:
            break
        yield
        breaks = not _connected(graph, i)
    return Connectivity(lambda2, min(ids, key=lambda i: (len(graph[i]), -abs(x[i]), i)), breaks)


def _across(x: Mapping[int, float]) -> dict[int, float]:
    """Without its mean."""
    mean = fsum(x.values()) / len(x)
    return {i: v - mean for i, v in x.items()}


def _laplacian(graph: Graph, x: Mapping[int, float]) -> dict[int, float]:
    return {i: len(graph[i]) * v - fsum(x[j] for j in graph[i]) for i, v in x.items()}


def _solved(graph: Graph, b: Mapping[int, float]) -> dict[int, float]:
    """L y = b by conjugate gradients, for b without mean and a connected graph."""
    y, r = dict.fromkeys(b, 0.0), dict(b)
    p, rr = dict(r), fsum(v * v for v in r.values())
    least = 1e-16 * rr
    for _ in range(len(b)):
        if rr <= least:
            break
        lp = _laplacian(graph, p)
        step = rr / fsum(p[i] * lp[i] for i in p)
        y = {i: v + step * p[i] for i, v in y.items()}
        r = {i: v - step * lp[i] for i, v in r.items()}
        before, rr = rr, fsum(v * v for v in r.values())
        p = {i: v + rr / before * p[i] for i, v in r.items()}
    return y


def _connected(graph: Graph, without: int | None) -> bool:
    """Whether all are joined with all, over others, one vehicle left out."""
    left = {i for i in graph if i != without}
    reached = {min(left)} if left else set()
    fringe = list(reached)
    while fringe:
        found = {j for i in fringe for j in graph[i]} & left - reached
        reached |= found
        fringe = list(found)
    return reached == left
