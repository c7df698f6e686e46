"""A fault of one value, as pydantic reports it, as a sentence: where, what is allowed, what came."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import annotated_types
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from companion.config.law_tables import LAWS
from companion.config.registry import Registry
from companion.config.schema import FleetTables, GotoLegTable, HoldLegTable, TurnLegTable, VelocityLegTable
from companion.config.trigger_tables import TRIGGERS

_UNITS = {
    "_m_s3": "m/s^3", "_m_s2": "m/s^2", "_m_s": "m/s", "_deg_s": "deg/s", "_per_s": "1/s", "_s2": "s^2", "_deg": "deg",
    "_m": "m", "_s": "s", "_hz": "Hz", "_percent": "%",
}  # fmt: skip


def sentence(error: Any, tables: Mapping[str, Any]) -> str:
    """One fault of the raw tables as a sentence: where, what is allowed, what came."""
    loc = [p for k, p in enumerate(error["loc"]) if not (p in _LEGS and k >= 3 and error["loc"][0] == "plan")]
    if "slot" in loc:
        # The two kinds of value that a slot may have are two faults to the validator.
        loc = loc[: loc.index("slot") + 1]
    path = "$" + "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in loc)
    came = error["input"]
    match error["type"]:
        case "extra_forbidden":
            return f"{path} is not a known key; known here: {', '.join(sorted(_place(error['loc'][:-1], tables)[0]))}"
        case "kind":
            return f"{path}.kind must be one of {error['ctx']['known']}, got {error['ctx']['came']!r}"
        case "too_short":
            return f"{path} must have at least {error['ctx']['min_length']}, got {error['ctx']['actual_length']}"
        case "missing":
            return f"{path} is required"
        case "string_pattern_mismatch":
            return f"{path} must match {error['ctx']['pattern']}, got {came!r}"
        case "union_tag_invalid" | "union_tag_not_found":
            return f"{path}.kind must be one of hold, velocity, turn, goto, got {came!r}"
    unit = next((u for s, u in _UNITS.items() if str(loc[-1]).endswith(s)), "") if loc[-1] != "k_s" else ""
    allowed = _allowed(tuple(loc) if "slot" in loc else error["loc"], tables)
    message = error["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    rule = f"must be {allowed} {unit}".rstrip() if allowed else f"must be {message}"
    return f"{path} {rule}, got {came!r}"


_LEGS: Mapping[str, type[BaseModel]] = {
    "hold": HoldLegTable, "velocity": VelocityLegTable, "turn": TurnLegTable, "goto": GotoLegTable
}  # fmt: skip


_REGISTRIES: Mapping[str, Registry[Any]] = {"law": LAWS, "trigger": TRIGGERS}


def _place(loc: Sequence[str | int], tables: Mapping[str, Any]) -> tuple[Mapping[str, FieldInfo], FieldInfo | None]:
    """The fields of the table at a place of the file, and the field that the place itself is."""
    fields: Mapping[str, FieldInfo] = FleetTables.model_fields
    field: FieldInfo | None = None
    for part in loc:
        if isinstance(part, int):
            continue
        if part in fields:
            field = fields[part]
            table = _inner(field.annotation)
            fields = {} if table is None else table.model_fields
            if part in _REGISTRIES:
                fields = _REGISTRIES[part].fields(tables[part])
        elif part in _LEGS:
            fields = _LEGS[part].model_fields
        else:
            return {}, None
    return fields, field


def _inner(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        found = _inner(argument)
        if found is not None:
            return found
    return None


def _scalars(annotation: Any) -> Iterator[Any]:
    """The types inside an annotation, each with what restricts it: (type, restrictions)."""
    if annotation is float or annotation is int:
        yield annotation, ()
    elif hasattr(annotation, "__metadata__"):
        for scalar, _ in _scalars(annotation.__origin__):
            yield scalar, annotation.__metadata__
    else:
        for argument in getattr(annotation, "__args__", ()):
            yield from _scalars(argument)


def _allowed(loc: Sequence[str | int], tables: Mapping[str, Any]) -> str:
    """The range of a numeric field, as 'a finite number > 0'."""
    _, field = _place(loc, tables)
    if field is None:
        return ""
    scalars = list(_scalars(field.annotation))
    if not scalars:
        return ""
    kind, restrictions = scalars[0]
    items = [*field.metadata, *restrictions]
    bounds = []
    for item in [*items, *(m for i in items for m in getattr(i, "metadata", ()))]:
        match item:
            case annotated_types.Gt():
                bounds.append(f"> {item.gt:g}")
            case annotated_types.Ge():
                bounds.append(f">= {item.ge:g}")
            case annotated_types.Lt():
                bounds.append(f"< {item.lt:g}")
            case annotated_types.Le():
                bounds.append(f"<= {item.le:g}")
    name = "a whole number" if kind is int else "a finite number"
    text = " ".join([name, " and ".join(dict.fromkeys(bounds))]).rstrip()
    return f'{text}, or "auto"' if "auto" in str(field.annotation) else text
