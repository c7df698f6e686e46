"""A seeded network between vehicles: loss, delay, reorder and partition, on bytes."""

from dataclasses import dataclass
from math import exp
from random import Random


@dataclass(frozen=True, slots=True)
class NetworkParameters:
    """What the network does to each message from one vehicle to one other."""

    delay_s: float = 0.002
    jitter_s: float = 0.001
    """added to the delay, uniform; messages closer together than this may overtake each other"""
    loss: float = 0.0
    """share of messages lost, 0 to 1"""
    burst_s: float = 0.0
    """mean length of a burst of losses; 0: losses are independent"""

    def __post_init__(self) -> None:
        for name in ("delay_s", "jitter_s", "burst_s"):
            if not 0.0 <= getattr(self, name) < 3600.0:
                raise ValueError(f"{name} must be >= 0 s, got {getattr(self, name)}")
        if not 0.0 <= self.loss < 1.0:
            raise ValueError(f"loss must be in [0, 1), got {self.loss}")


class Network:
    """Decides for each message whether and when it arrives. One link per ordered pair, each with its own state."""

    def __init__(self, parameters: NetworkParameters, seed: int) -> None:
        self.parameters = parameters
        self.partitions: tuple[frozenset[int], ...] = ()
        """vehicles in different sets do not hear each other; empty: all do"""
        self._random = Random(seed)
        self._bad: dict[tuple[int, int], tuple[int, bool]] = {}

    def arrival_ns(self, sender: int, receiver: int, now_ns: int) -> int | None:
        """When a message sent now arrives, or None if it is lost."""
        p = self.parameters
        if any((sender in part) != (receiver in part) for part in self.partitions):
            return None
        if self._lost(sender, receiver, now_ns):
            return None
        return now_ns + round((p.delay_s + p.jitter_s * self._random.random()) * 1e9)

    def _lost(self, sender: int, receiver: int, now_ns: int) -> bool:
        p = self.parameters
        if p.loss == 0.0:
            return False
        if p.burst_s == 0.0:
            return self._random.random() < p.loss
        # Two states with mean times burst_s (bad) and burst_s (1 - loss)/loss (good), sampled at the messages.
        since_ns, bad = self._bad.get((sender, receiver), (now_ns, self._random.random() < p.loss))
        rate = 1.0 / (p.burst_s * (1.0 - p.loss))
        keep = exp(-(now_ns - since_ns) * 1e-9 * rate)
        chance = p.loss + ((1.0 if bad else 0.0) - p.loss) * keep
        bad = self._random.random() < chance
        self._bad[sender, receiver] = (now_ns, bad)
        return bad
