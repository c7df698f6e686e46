"""Who takes which slot: the assignment of least cost, and of several such the lexicographically smallest.

Every vehicle computes the assignment for itself and all must find the same. A library's solver finds *an* optimum;
symmetrical shapes have many, and which of them it returns follows from its own order of search. So the costs here are
integers, their sums exact, and the answer is defined without regard to how it is found: the first vehicle has the
lowest slot that it has in any optimum, then the second, and so on.
"""

from collections.abc import Mapping, Sequence

from companion.core.frames import Ned

VERSION = 2
"""of this rule; preflight compares it across the fleet. 1: ties as scipy 1.x breaks them"""


def assign(origins: Sequence[Ned], slots: Sequence[Ned], pinned: Mapping[int, int] | None = None) -> tuple[int, ...]:
    """Slot of each vehicle: the assignment with the least sum of squared distances; of equal ones the smallest tuple.

    `pinned` fixes the slots of some (index of the origin -> index of the slot). As many slots as origins.

    Both lists are nominal (pads or slots of the last formation, and slots of the next, about one common centre), never
    measured: every vehicle must come to the same result. Squared distances make straight paths flown together keep
    apart. Costs are whole square millimetres, so that the last bit of a sine cannot decide between two equals.
    """
    found = dict(pinned or {})
    rows = [row for row in range(len(origins)) if row not in found]
    columns = sorted(set(range(len(slots))) - set(found.values()))
    costs = [[_cost_mm2(origins[row], slots[column]) for column in columns] for row in rows]
    found |= {row: columns[k] for row, k in zip(rows, _Assignment(costs).smallest(), strict=True)}
    return tuple(found[row] for row in range(len(origins)))


def _cost_mm2(a: Ned, b: Ned) -> int:
    return round(1e6 * ((a.north - b.north) ** 2 + (a.east - b.east) ** 2 + (a.down - b.down) ** 2))


_UNREACHED = 1 << 200


class _Assignment:
    """A least-cost assignment of rows to as many columns, with the dual prices that prove it.

    Shortest augmenting paths (Jonker and Volgenant 1987): row by row, Dijkstra over what a column costs beyond the
    prices. At the end cost = row price + column price for every pair assigned, and >= for all others; so exactly the
    perfect matchings within the pairs where it is equal are optimal. About n^3: 0.1 ms for ten, 3 ms for fifty.
    """

    def __init__(self, costs: Sequence[Sequence[int]]) -> None:
        n = len(costs)
        self.row_prices = [0] * n
        self.column_prices = [min(column) for column in zip(*costs, strict=True)]
        self.column_of = [-1] * n
        self.row_of = [-1] * n
        for row in range(n):
            self._add(row, costs)
        self._tight = [
            [k for k, price in enumerate(self.column_prices) if line[k] == row_price + price]
            for line, row_price in zip(costs, self.row_prices, strict=True)
        ]

    def _add(self, first: int, costs: Sequence[Sequence[int]]) -> None:
        """Assign one more row, along the cheapest way to a free column."""
        n = len(costs)
        ways = [_UNREACHED] * n
        came_from = [-1] * n
        left, passed = list(range(n)), []
        row, way = first, 0
        while True:
            line, base, column, nearest = costs[row], way - self.row_prices[row], -1, _UNREACHED
            for k in left:
                beyond = base + line[k] - self.column_prices[k]
                if beyond < ways[k]:
                    ways[k], came_from[k] = beyond, row
                if ways[k] < nearest:
                    column, nearest = k, ways[k]
            way = nearest
            left.remove(column)
            if self.row_of[column] < 0:
                break
            passed.append(column)
            row = self.row_of[column]
        self.row_prices[first] += way
        for k in passed:
            gain = way - ways[k]
            self.column_prices[k] -= gain
            self.row_prices[self.row_of[k]] += gain
        self._hand_on(first, column, came_from)

    def _hand_on(self, first: int, column: int, came_from: Sequence[int] | Mapping[int, int]) -> None:
        """Give `column` to the row that reached it, that row's column to the one before, until `first` has one."""
        row = -1
        while row != first:
            row = came_from[column]
            self.row_of[column] = row
            self.column_of[row], column = column, self.column_of[row]

    def smallest(self) -> tuple[int, ...]:
        """The column of each row in the lexicographically smallest optimum."""
        for row, choices in enumerate(self._tight):
            for column in choices:
                if column == self.column_of[row] or self._give(row, column):
                    break
        return tuple(self.column_of)

    def _give(self, first: int, column: int) -> bool:
        """Give a row this column by exchanges at no cost among the rows behind it; False if there are none."""
        goal = self.column_of[first]
        came_from, waiting = {column: first}, [column]
        while waiting:
            row = self.row_of[waiting.pop()]
            if row < first:
                continue
            for k in self._tight[row]:
                if k not in came_from:
                    came_from[k] = row
                    waiting.append(k)
        if goal not in came_from:
            return False
        self._hand_on(first, goal, came_from)
        return True
