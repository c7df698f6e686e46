"""A new fleet file: the shipped one for other vehicles and another network, its comments kept, or a refusal."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config.file import parse_text
from companion.config.new_file import new_fleet_text
from companion.errors import ConfigError

FILE = Path(__file__).resolve().parents[2] / "fleet.toml"


def test_without_wishes_it_is_the_shipped_file() -> None:
    assert new_fleet_text(None, None, "laptop", None, None) == FILE.read_text(encoding="utf-8")


@settings(max_examples=20)
@given(vehicles=st.integers(1, 50), name=st.from_regex(r"[a-z0-9][a-z0-9-]{0,31}", fullmatch=True))
def test_it_is_a_fleet_of_so_many_vehicles_of_that_name_with_every_comment(vehicles: int, name: str) -> None:
    text = new_fleet_text(vehicles, name, "laptop", None, None)
    config = parse_text(text, FILE)
    assert ([v.id for v in config.vehicles], config.fleet.name) == (list(range(1, vehicles + 1)), name)
    comments = [line.partition("#")[2] for line in FILE.read_text(encoding="utf-8").splitlines()[1:] if "#" in line]
    assert [line.partition("#")[2] for line in text.splitlines()[1:] if "#" in line] == comments


def test_in_the_field_each_vehicle_has_its_computer() -> None:
    config = parse_text(new_fleet_text(3, None, "field", "192.168.1.254", "udp://0.0.0.0:14540"), FILE)
    assert [(v.mavlink, v.zenoh) for v in config.vehicles] == [
        ("udp://0.0.0.0:14540", "tcp/192.168.1.254:7447"),
        ("udp://0.0.0.0:14540", "tcp/192.168.1.255:7447"),
        ("udp://0.0.0.0:14540", "tcp/192.168.2.0:7447"),
    ]


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ((3, None, "mesh", None, None), "--network must be laptop or field, got 'mesh'"),
        ((3, None, "laptop", "10.0.0.1", None), "--first-address belongs to --network field, got it with laptop"),
        ((3, None, "laptop", None, "udp://:14540"), "--line belongs to --network field, got it with laptop"),
        ((3, None, "field", "host-1", None), "--first-address must be an IPv4 address as 10.0.0.11, got 'host-1'"),
        ((3, None, "field", "255.255.255.254", None), "--first-address must be an IPv4 address"),
        ((3, None, "field", None, "/dev/ttyACM0"), "--line must be udp://HOST:PORT or serial:///dev/NAME:BAUD"),
        ((3, 'A "b', "laptop", None, None), "$.fleet.name must be at most 32 of a-z"),
        ((3, "a\nb", "laptop", None, None), "is not valid TOML"),
    ],
)
def test_what_cannot_be_a_fleet_is_refused(asked: tuple[int, str, str, str, str], said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        new_fleet_text(*asked)
    assert said in str(caught.value)
