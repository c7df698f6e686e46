"""Near mode that never begins: the null model beside it in studies. No configuration can fly it."""

from collections.abc import Iterable

from companion.core.trigger.near import NearMode


class NeverNear(NearMode):
    """Give it to an agent as its `near`."""

    def see(self, ids: Iterable[int], now_ns: int) -> None:
        """Nobody is near."""

    def named(self, now_ns: int) -> None:
        """Nor does it matter who says so."""
