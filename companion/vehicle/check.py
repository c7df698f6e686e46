"""A row of preflight."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import isfinite
from typing import Annotated

from pydantic import Field

_Text = Annotated[str, Field(max_length=4000)]


@dataclass(frozen=True, slots=True)
class Check:
    """One row: what was looked at, what it was, what it may be."""

    name: _Text
    value: float | Annotated[int, Field(ge=-(1 << 63), lt=1 << 63)] | _Text | None
    """None: not known"""
    limit: _Text
    """what is allowed, with its unit"""
    passed: bool
    message: _Text
    """the fault as a sentence; of no meaning when passed"""
    permanent: bool = False
    """whether it cannot come right by waiting"""
    vehicle: int = 0
    """whose; 0: the fleet's"""

    def sentence(self) -> str:
        """The fault with the name of whose it is."""
        return f"vehicle {self.vehicle}: {self.message}" if self.vehicle else self.message


def tidy(value: float | int | None) -> float | int | str | None:
    """A number as rows and JSON carry it."""
    if value is None or isinstance(value, int):
        return value
    return round(value, 4) if isfinite(value) else str(value)


def unmet(checks: Iterable[Check]) -> list[Check]:
    """The rows that are not met."""
    return [c for c in checks if not c.passed]
