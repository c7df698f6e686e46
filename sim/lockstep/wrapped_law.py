"""A law within another, for what tests and studies do to a law that flies."""

from dataclasses import dataclass

from companion.core.law.base import Law


@dataclass(slots=True)
class WrappedLaw:
    """What is kept, and what is told to the peers, is the inner law's; a subclass says what it commands."""

    law: Law

    def reset(self) -> None:
        """See `Law`."""
        self.law.reset()

    @property
    def fields(self) -> tuple[str, ...]:
        """See `Law`."""
        return self.law.fields

    def tell(self) -> tuple[float, ...]:
        """See `Law`."""
        return self.law.tell()
