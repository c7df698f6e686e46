"""Rows of a check as a person reads them, one as it comes, or as JSON for programs."""

import json
from collections.abc import Iterable
from dataclasses import asdict

import typer

from companion.terminal import one_line, tell
from companion.wire.operator import Check, unmet, warnings


def show_rows(rows: Iterable[Check], as_json: bool) -> bool:
    """Show every row, then what is worth a word and what is at fault; whether all are met."""
    seen = []
    for row in rows:
        seen.append(row)
        if not as_json:
            met = ("see" if row.warns else "ok") if row.passed else "FAULT"
            value = "-" if row.value is None else one_line(str(row.value))
            tell(f"{met:5}  {row.name:22}  {value:>20}  {row.limit}")
    faults = unmet(seen)
    if as_json:
        typer.echo(json.dumps({"fit": not faults, "checks": [asdict(row) for row in seen]}))
    else:
        for row in (*warnings(seen), *faults):
            tell(one_line(row.message))
    return not faults
