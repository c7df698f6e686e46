"""Who is near whom in a large swarm: a sorted list that is kept until relative motion has used up its skin."""

import numpy as np

from sim.swarm.state import Floats, Ints

SKIN_M = 1.0
"""how much farther than the range the neighbour list reaches"""


class NeighbourList:
    """Who is near whom: compressed rows within range and skin, rebuilt once relative motion has used up the skin."""

    def __init__(self, range_m: float) -> None:
        self.range_m = range_m
        self.start: Ints = np.zeros(1, dtype=np.int64)
        self.column: Ints = np.zeros(0, dtype=np.int64)
        self.rebuilt = 0
        self._then: Floats | None = None

    def update(self, x: Floats) -> bool:
        """Make the list good for positions x, shape (N, 3); returns whether it had to be rebuilt."""
        from sim.swarm import grid

        if self._then is not None and grid.largest_shift(x, self._then) <= SKIN_M / 2:
            return False
        reach = self.range_m + SKIN_M
        low = x.min(axis=0)
        shape = np.maximum(((x.max(axis=0) - low) / reach).astype(np.int64), 1)
        # few huge cells or many empty ones: both are bounded
        shape = np.minimum(shape, 200)
        width = float(max(((x.max(axis=0) - low) / shape).max(), reach))
        count = np.zeros(int(shape.prod()) + 1, dtype=np.int64)
        cell = np.zeros(len(x), dtype=np.int64)
        order = np.zeros(len(x), dtype=np.int64)
        grid.cells(x, low, width, shape, cell, count, order)
        self.start = np.zeros(len(x) + 1, dtype=np.int64)
        column = self.column if self.column.size else np.zeros(64 * len(x), dtype=np.int64)
        while True:
            needed = grid.listed(x, low, width, shape, count, order, reach, self.start, column)
            if needed <= column.size:
                break
            column = np.zeros(int(needed * 1.1), dtype=np.int64)
        self.column = column
        self._then = x.copy()
        self.rebuilt += 1
        return True

    def sorted_order(self, x: Floats) -> Ints:
        """Agents by cell: positions in this order keep neighbours in space close in memory."""
        cell = np.floor((x - x.min(axis=0)) / (self.range_m / 2)).astype(np.int64)
        return np.lexsort((cell[:, 2], cell[:, 1], cell[:, 0])).astype(np.int64)

    def within_range(self, x: Floats) -> float:
        """Mean number of neighbours within the range itself, without the skin."""
        owner = np.repeat(np.arange(len(x)), np.diff(self.start))
        near = np.linalg.norm(x[owner] - x[self.column[: self.start[-1]]], axis=1) <= self.range_m
        return float(near.sum() / len(x))
