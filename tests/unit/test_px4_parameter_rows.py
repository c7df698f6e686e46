"""Preflight's rows of PX4's parameters: made anew when one has changed, and only then."""

from pathlib import Path

import pytest

from companion.config import load
from companion.vehicle.autopilot.px4_identity import Px4Identity
from companion.vehicle.autopilot.px4_parameters import PARAMETERS, ParameterRows
from companion.wire.px4 import Software

FLEET = Path(__file__).resolve().parents[2] / "fleet.toml"


def test_rows_follow_values_and_names_that_change_in_place() -> None:
    rows = ParameterRows(load(FLEET), 3)
    values: dict[str, float | int] = {}
    missing: set[str] = set()
    identity = Px4Identity()
    identity.take(Software(1, 18, 0, 255, ""))
    assert [r.name for r in rows.of(values, missing, identity)] == ["PX4 version", "parameters"]
    assert {r.vehicle for r in rows.of(values, missing, identity)} == {3}
    values["COM_OF_LOSS_T"] = 1.0
    before = rows.of(values, missing, identity)
    assert [r.passed for r in before if r.name == "COM_OF_LOSS_T"] == [True]
    assert rows.of(values, missing, identity) is before
    values["COM_OF_LOSS_T"] = 60.0
    assert [r.passed for r in rows.of(values, missing, identity) if r.name == "COM_OF_LOSS_T"] == [False]
    missing |= set(PARAMETERS) - {"COM_OF_LOSS_T"}
    assert all(not r.passed for r in rows.of(values, missing, identity)[1:])
    before = rows.of(values, missing, identity)
    identity.take(Software(1, 15, 0, 255, ""))
    assert before[0].passed
    assert not rows.of(values, missing, identity)[0].passed, "it has told its version since"
    assert "parameters" not in {r.name for r in rows.of(values, missing, identity)}


def test_rows_that_cannot_be_made_are_not_taken_for_none() -> None:
    rows = ParameterRows(load(FLEET), 1)
    for _ in range(2):
        with pytest.raises(ValueError, match="NaN"):
            rows.of({"COM_RC_OVERRIDE": float("nan")}, set(), Px4Identity())
