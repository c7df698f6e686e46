"""Scenario files: what they hold and what is refused."""

from pathlib import Path

import pytest

from companion.config import FleetConfig, load
from companion.errors import ConfigError
from sim.autopilot.faults import FaultKind
from sim.launch.faults import load_scenario

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def config() -> FleetConfig:
    return load(ROOT / "fleet.toml")


def test_faults_are_read_in_the_order_of_their_times(config: FleetConfig, tmp_path: Path) -> None:
    file = tmp_path / "s.toml"
    file.write_text(
        '[[fault]]\nat_s = 40\nvehicle = 3\nkind = "mute"\nduration_s = 2.5\n'
        '[[fault]]\nat_s = 30.5\nvehicle = 2\nkind = "noise"\nmagnitude = 0.4\n'
    )
    first, second = load_scenario(file, config)
    assert (first.at_s, first.vehicle_id, first.fault.kind, first.fault.strength) == (30.5, 2, FaultKind.NOISE, 0.4)
    assert (second.at_s, second.fault.duration_s) == (40.0, 2.5)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[[fault]]\nat_s = nan\nvehicle = 1\nkind = 'mute'\n", r"\$\.fault\[0\]\.at_s must be .* got nan"),
        ("[[fault]]\nvehicle = 1\nkind = 'mute'\n", r"at_s must be"),
        ("[[fault]]\nat_s = 1\nvehicle = 99\nkind = 'mute'\n", r"vehicle 99 is not an enabled vehicle"),
        ("[[fault]]\nat_s = 1\nvehicle = 1\nkind = 'sulk'\n", r"kind must be one of .* got 'sulk'"),
        ("[[fault]]\nat_s = 1\nvehicle = 1\nkind = 'mute'\nloud = 1\n", r"unknown keys \['loud'\]"),
        ("[[wish]]\nat_s = 1\n", r"must hold tables \[\[fault\]\] alone"),
        ("[[fault]\n", r"is not valid TOML"),
    ],
)
def test_a_scenario_that_is_wrong_is_refused_with_its_place(
    config: FleetConfig, tmp_path: Path, text: str, said: str
) -> None:
    file = tmp_path / "s.toml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=said):
        load_scenario(file, config)
