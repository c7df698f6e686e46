"""A vehicle's account of itself as its operator reads it: what is not of this form is nobody else's trouble."""

import json
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

_Number = Annotated[float, Field(allow_inf_nan=False)]
_Count = Annotated[int, Field(ge=0, lt=1 << 63)]
_Text = Annotated[str, Field(max_length=4000)]
_Word = Annotated[str, Field(max_length=64)]


class _Status(BaseModel):
    """What the operator's verbs, tables and launchers rely on; there may be more."""

    model_config = ConfigDict(extra="allow", strict=True)

    vehicle: Annotated[int, Field(ge=1, le=250)]
    fleet: _Word
    up_s: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    """since its companion's start"""
    place: tuple[_Count, _Count, _Count]
    """`orders.Place`"""
    phase: _Word
    mode: _Word
    armed: bool
    ready: list[_Text]
    unfit: list[_Text]
    revision: _Count
    shape: _Word
    motion: dict[str, Any]
    position_error_m: _Number | None
    neighbours: _Count
    nearest_m: _Number | None
    oldest_age_s: _Number | None
    messages: _Count
    battery_percent: Annotated[int, Field(ge=-1, le=100)]
    failsafes: list[_Text]
    rejected: dict[_Text, _Count]
    own_id_heard: bool = False
    """whether its companion hears another one under its own id"""


def read_status(answer: bytes, vehicle_id: int) -> dict[str, Any] | str:
    """A status answer as plain values, or what is wrong with it."""
    try:
        status = _Status.model_validate_json(answer)
    except ValidationError as error:
        first = error.errors()[0]
        return f"{'.'.join(str(p) for p in first['loc']) or 'JSON'}: {first['msg']}"[:200]
    if status.vehicle != vehicle_id:
        return f"it is vehicle {status.vehicle}'s"
    try:
        told: dict[str, Any] = json.loads(answer)
    except ValueError as error:
        return f"JSON: {error}"[:200]
    return told
