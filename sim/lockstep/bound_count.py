"""How wrong predictions are in truth, beside the bounds that their receivers take them to have."""

from collections import Counter
from dataclasses import dataclass, field


@dataclass(slots=True)
class BoundCount:
    """How the true error of predictions compares with what their receivers take it to be at most."""

    looks: int = 0
    """predictions, one a control tick and pair"""
    exceeded: int = 0
    """of those, how many are farther from the truth than their bound"""
    worst: float = 0.0
    """largest error as a part of its bound"""
    error_max_m: float = 0.0
    millimetres: Counter[int] = field(default_factory=Counter)
    """how many predictions were wrong by so many"""

    def see(self, error_m: float, bound_m: float) -> None:
        """Take one prediction."""
        self.looks += 1
        self.exceeded += not error_m <= bound_m
        self.worst = max(self.worst, error_m / bound_m)
        self.error_max_m = max(self.error_max_m, error_m)
        self.millimetres[int(error_m * 1e3)] += 1

    def quantile_m(self, share: float) -> float:
        """The error that this share of all predictions does not exceed (m), to the millimetre."""
        below = 0
        for millimetres, count in sorted(self.millimetres.items()):
            below += count
            if below >= share * self.looks:
                return 1e-3 * (millimetres + 1)
        return 0.0
