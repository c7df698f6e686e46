"""The neighbour list of a large swarm, compiled: agents sorted into cells, and for each those within reach."""

import math

from sim.swarm.compiled import kernel
from sim.swarm.state import Floats, Ints


@kernel
def cells(x: Floats, low: Floats, width: float, shape: Ints, cell: Ints, count: Ints, order: Ints) -> None:
    """Counting sort of agents into cells: `order` lists agents by cell, `count` becomes each cell's first place."""
    n = x.shape[0]
    count[:] = 0
    for i in range(n):
        a = min(int((x[i, 0] - low[0]) / width), shape[0] - 1)
        b = min(int((x[i, 1] - low[1]) / width), shape[1] - 1)
        c = min(int((x[i, 2] - low[2]) / width), shape[2] - 1)
        cell[i] = (a * shape[1] + b) * shape[2] + c
        count[cell[i] + 1] += 1
    for k in range(1, count.shape[0]):
        count[k] += count[k - 1]
    place = count.copy()
    for i in range(n):
        order[place[cell[i]]] = i
        place[cell[i]] += 1


@kernel
def listed(
    x: Floats, low: Floats, width: float, shape: Ints, count: Ints, order: Ints, reach: float, start: Ints, column: Ints
) -> int:
    """The list: row i holds all j != i within `reach`. Returns the entries needed, even if `column` is too short."""
    n = x.shape[0]
    total = 0
    reach2 = reach * reach
    for i in range(n):
        start[i] = total
        a = min(int((x[i, 0] - low[0]) / width), shape[0] - 1)
        b = min(int((x[i, 1] - low[1]) / width), shape[1] - 1)
        c = min(int((x[i, 2] - low[2]) / width), shape[2] - 1)
        for aa in range(max(a - 1, 0), min(a + 2, shape[0])):
            for bb in range(max(b - 1, 0), min(b + 2, shape[1])):
                # cells along the last axis lie next to each other: one run
                base = (aa * shape[1] + bb) * shape[2]
                for p in range(count[base + max(c - 1, 0)], count[base + min(c + 1, shape[2] - 1) + 1]):
                    j = order[p]
                    d = (x[i, 0] - x[j, 0]) ** 2 + (x[i, 1] - x[j, 1]) ** 2 + (x[i, 2] - x[j, 2]) ** 2
                    if d <= reach2 and j != i:
                        if total < column.shape[0]:
                            column[total] = j
                        total += 1
    start[n] = total
    return total


@kernel
def largest_shift(x: Floats, then: Floats) -> float:
    """The largest displacement since the list was built, the mean drift taken out."""
    n = x.shape[0]
    m0, m1, m2 = 0.0, 0.0, 0.0
    for i in range(n):
        m0 += x[i, 0] - then[i, 0]
        m1 += x[i, 1] - then[i, 1]
        m2 += x[i, 2] - then[i, 2]
    m0, m1, m2 = m0 / n, m1 / n, m2 / n
    largest = 0.0
    for i in range(n):
        d = (x[i, 0] - then[i, 0] - m0) ** 2 + (x[i, 1] - then[i, 1] - m1) ** 2 + (x[i, 2] - then[i, 2] - m2) ** 2
        largest = max(largest, d)
    return math.sqrt(largest)
