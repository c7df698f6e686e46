"""The parameters that a vehicle is set to: what QGroundControl loads is what preflight wants, of every version."""

from pathlib import Path
from typing import Any

import pytest

from companion.config import FleetConfig, load
from companion.vehicle.autopilot.px4_parameters import PARAMETERS, parameter_checks
from companion.vehicle.autopilot.px4_params_file import hardware_parameters, params_file
from companion.vehicle.autopilot.px4_versions import VERSIONS, Px4Version, same_setting
from companion.wire.operator import unmet
from sim.autopilot.parameters import defaults

FILE = Path(__file__).resolve().parents[2] / "fleet.toml"


def fleet(**preflight: Any) -> FleetConfig:
    return load(FILE, lambda tables: tables["preflight"].update(preflight))


@pytest.mark.parametrize("version", VERSIONS, ids=lambda v: v.name)
@pytest.mark.parametrize("pilot", [False, True])
@pytest.mark.parametrize("longest_s", [0.5, 1.0, 5.0])
def test_what_is_loaded_meets_preflight_on_top_of_px4s_defaults(
    version: Px4Version, pilot: bool, longest_s: float
) -> None:
    config = fleet(require_rc=pilot, offboard_loss_limit_s=longest_s)
    values = {**defaults(version), **hardware_parameters(config, version)}
    missing = {name for name in PARAMETERS if name not in values}
    assert all(set(same_setting(name)) - missing for name in missing)
    assert unmet(parameter_checks(values, missing, config, version)) == []
    if not pilot:
        assert unmet(parameter_checks(defaults(version), missing, config, version)) != [], "PX4's defaults alone do not"


@pytest.mark.parametrize("version", VERSIONS, ids=lambda v: v.name)
def test_the_file_has_a_line_for_each_with_its_type_and_a_reason(version: Px4Version) -> None:
    config = fleet()
    lines = list(params_file(config, version))
    rows = [line.split("\t") for line in lines if not line.startswith("#")]
    values = hardware_parameters(config, version)
    assert [row[2] for row in rows] == list(values)
    for _, component, name, value, kind in rows:
        assert component == "1"
        assert (kind, float(value)) == ("6" if isinstance(values[name], int) else "9", float(values[name]))
        assert any(line.startswith(f"# {name}: ") for line in lines)
    assert version.sticks_way in lines[1]
