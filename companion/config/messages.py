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
    path = _path(loc)
    came = error["input"]
    match error["type"]:
        case "extra_forbidden":
            return f"{path} is not a known key; known here: {', '.join(sorted(_place(error['loc'][:-1], tables)[0]))}"
        case "kind":
            return f"{path}.kind must be one of {error['ctx']['known']}, got {error['ctx']['came']!r}"
        case "too_short":
            return f"{path} must have at least {error['ctx']['min_length']}, got {error['ctx']['actual_length']}"
        case "missing" if isinstance(loc[-1], int):
            return f"{_path(loc[:-1])} must be {_list_of(loc)}, got {came!r}"
        case "missing":
            return f"{path} is required{_HEADINGS.get(path, '')}"
        case "string_pattern_mismatch":
            return f"{path} must be {_PATTERNS.get(path, 'as ' + error['ctx']['pattern'])}, got {came!r}"
        case "union_tag_invalid" | "union_tag_not_found":
            kind = repr(came["kind"]) if isinstance(came, Mapping) and "kind" in came else "none"
            return f"{path}.kind must be one of {', '.join(_LEGS)}, got {kind}"
        case "tuple_type" | "list_type" if path == "$.vehicle":
            return f"{path} must be a list of tables, each headed [[vehicle]] with two brackets, got {came!r}"
        case "tuple_type" | "list_type":
            return f"{path} must be {_list_of(loc)}, got {came!r}"
        case "bool_type" | "bool_parsing":
            return f"{path} must be true or false, got {came!r}"
        case "model_type" | "model_attributes_type" | "dict_type":
            return f"{path} must be a table{_TABLES.get(str(loc[-1]), ' { key = value, ... }')}, got {came!r}"
    unit = next((u for s, u in _UNITS.items() if str(loc[-1]).endswith(s)), "") if loc[-1] != "k_s" else ""
    allowed = _allowed(tuple(loc) if "slot" in loc else error["loc"], tables)
    message = error["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    rule = f"must be {allowed} {unit}".rstrip() if allowed else f"must be {message}"
    return f"{path} {rule}, got {came!r}"


def _path(loc: Sequence[str | int]) -> str:
    return "$" + "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in loc)


def _list_of(loc: Sequence[str | int]) -> str:
    """What the innermost named list of a place holds."""
    return _VECTORS.get(next(p for p in reversed(loc) if isinstance(p, str)), "a list")


_HEADINGS = {"$.fleet": ": a table headed [fleet] with its name", "$.vehicle": ": a table headed [[vehicle]] for each"}
_PATTERNS = {"$.fleet.name": "at most 32 of a-z, 0-9 and -, the first no -"}
_VECTORS = {
    "custom_m": "[forward, right, down] in metres for each vehicle", "pad_m": "[north, east] in metres",
    "centre_m": "[north, east] in metres", "polygon_m": "[north, east] in metres for each corner",
    "legs": "a list of legs: [{ kind = ... }, ...]", "informed": "a list of vehicles' ids",
}  # fmt: skip
_TABLES = {"origin": " { latitude_deg = ..., longitude_deg = ..., altitude_amsl_m = ... }"}
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
