"""Wrong fleet files, as people write them: each is refused with where, what came and what is allowed."""

import re
from codecs import BOM_UTF8
from pathlib import Path

import pytest

from companion.config.file import load
from companion.errors import ConfigError

FILE = Path(__file__).resolve().parents[2] / "fleet.toml"
TEXT = FILE.read_text(encoding="utf-8")


def instead(old: str, new: str) -> bytes:
    """The shipped file with its first `old` replaced."""
    assert old in TEXT
    return TEXT.replace(old, new, 1).encode()


def vehicle(line: str) -> bytes:
    """The shipped file with a line more for vehicle 2."""
    return instead("id = 2\n", f"id = 2\n{line}\n")


def without_table(name: str, first: str = "") -> bytes:
    """The shipped file without a table, and `first` before all others."""
    shorter = re.sub(rf"\[{name}\].*?\n\n", "", TEXT, flags=re.DOTALL)
    assert shorter != TEXT
    return f"{first}\n{shorter}".encode()


TABLES = TEXT.split("[[vehicle]]")[0]
IDS = "(vehicle[1] is id 2)"
WRONG: dict[str, tuple[bytes, str]] = {
    # the text
    "UTF-16": (TEXT.encode("utf-16"), "must be text in UTF-8, got UTF-16: save it as UTF-8"),
    "no text": (bytes(range(256)), "must be text in UTF-8, got invalid start byte at byte 128"),
    "Latin 1": (instead("metres", "m\u00e8tres").decode().encode("latin-1"), "must be text in UTF-8, got"),
    "decimal comma": (instead("spacing_m = 4.0", "spacing_m = 4,0"), "is not valid TOML: Expected newline"),
    "table twice": (TEXT.encode() + b"\n[fleet]\nname = 'x'\n", "Cannot declare ('fleet',) twice"),
    "key twice": (instead("heading_deg = 0.0", "heading_deg = 0.0\nheading_deg = 1.0"), "Cannot overwrite a value"),
    "quote left open": (instead('name = "starling"', 'name = "starling'), "is not valid TOML: Illegal character"),
    "JSON": (b'{"fleet": {"name": "x"}}', "is not valid TOML: Invalid statement (at line 1"),
    "nothing": (b"", "$.fleet is required: a table headed [fleet] with its name"),
    # tables
    "no vehicles": (TABLES.encode(), "$.vehicle is required: a table headed [[vehicle]] for each"),
    "one bracket": (
        f"{TABLES}[vehicle]\nid = 1\n".encode(),
        "each headed [[vehicle]] with two brackets, got {'id': 1}",
    ),
    "all disabled": (
        f"{TABLES}[[vehicle]]\nid = 1\nenabled = false\n".encode(),
        "at least one vehicle must be enabled",
    ),
    "law a word": (
        without_table("law", 'law = "starling"'),
        "$.law must be a table { key = value, ... }, got 'starling'",
    ),
    "formation a list": (without_table("formation", "formation = [1]"), "$.formation must be a table"),
    "unknown table": (
        instead("[peers]", "[[fault]]\nat_s = 3\n\n[peers]"),
        "$.fault is not a known key; known here: failsafe",
    ),
    "unknown key": (
        instead("spacing_m = 4.0", "spacing = 4.0"),
        "$.formation.spacing is not a known key; known here: alt",
    ),
    "no name": (instead('name = "starling"', "#"), "$.fleet.name is required"),
    "name in capitals": (
        instead('"starling"', '"Starling 1"'),
        "at most 32 of a-z, 0-9 and -, the first no -, got 'Sta",
    ),
    "no origin": (instead("origin =", "# origin ="), '$.fleet.origin is required with frame = "global" (latitude_deg'),
    "origin a list": (
        re.sub(r"origin = \{.*?\}", "origin = [47, 8, 488]", TEXT).encode(),
        "$.fleet.origin must be a table { latitude_deg = ..., longitude_deg = ..., altitude_amsl_m = ... }, got [47, 8",
    ),
    "latitude": (
        instead("47.397742", "147.4"),
        "$.fleet.origin.latitude_deg must be a finite number >= -90 and <= 90 deg",
    ),
    "frame": (instead('frame = "global"', 'frame = "ned"'), "$.fleet.frame must be 'global' or 'local', got 'ned'"),
    # numbers
    "number in quotes": (
        instead("spacing_m = 4.0", 'spacing_m = "4"'),
        "must be a finite number > 0 and <= 1000 m, got '4'",
    ),
    "negative": (instead("spacing_m = 4.0", "spacing_m = -4"), "$.formation.spacing_m must be a finite number > 0 and"),
    "zero": (instead("spacing_m = 4.0", "spacing_m = 0"), "<= 1000 m, got 0"),
    "not a number": (instead("spacing_m = 4.0", "spacing_m = nan"), "<= 1000 m, got nan"),
    "infinite": (instead("spacing_m = 4.0", "spacing_m = 1e400"), "<= 1000 m, got inf"),
    "a date": (instead("spacing_m = 4.0", "spacing_m = 2026-01-01"), "got '2026-01-01'"),
    "a list": (instead("spacing_m = 4.0", "spacing_m = [4.0]"), "got [4.0]"),
    "yes": (instead("automatic = true", 'automatic = "yes"'), "$.plan.automatic must be true or false, got 'yes'"),
    "altitude": (
        instead("altitude_m = 10.0", "altitude_m = 0.5"),
        "must be a finite number >= 1 and <= 500 m, got 0.5",
    ),
    "rate": (instead("# control_rate_hz = 50.0", "control_rate_hz = 200"), ">= 20 and <= 50 Hz, got 200"),
    "jerk": (instead("jerk_max_m_s3 = 100.0", "jerk_max_m_s3 = 1"), ">= 5 and <= 1000 m/s^3, got 1"),
    # formation and plan
    "shape": (instead('shape = "v"', 'shape = "vee"'), "$.formation.shape must be one of v, line, column"),
    "too few slots": (
        instead('shape = "v"', 'shape = "custom"\ncustom_m = [[0, 0, 0], [4, 0, 0]]'),
        "$.formation.custom_m must have one slot for each of the 10 enabled vehicles, got 2",
    ),
    "slots on end": (
        instead('shape = "v"', 'shape = "custom"\ncustom_m = [0, 0, 0]'),
        "$.formation.custom_m[0] must be [forward, right, down] in metres for each vehicle, got 0",
    ),
    "level slots": (
        instead('shape = "v"', 'shape = "custom"\ncustom_m = [[0, 0], [4, 0]]'),
        "$.formation.custom_m[1] must be [forward, right, down] in metres for each vehicle, got [4, 0]",
    ),
    "leg of no kind": (
        instead('kind = "velocity", ', ""),
        "legs[0].kind must be one of hold, velocity, turn, goto, got none",
    ),
    "leg of a wrong kind": (instead('kind = "velocity"', 'kind = "fly"'), "hold, velocity, turn, goto, got 'fly'"),
    "leg a word": (
        instead("legs = [", 'legs = [ "hold", '),
        "$.plan.legs[0] must be a table { key = value, ... }, got",
    ),
    "legs a table": (
        re.sub(r"legs = \[.*?\n\]", 'legs = { kind = "hold" }', TEXT, flags=re.DOTALL).encode(),
        "$.plan.legs must be a list of legs: [{ kind = ... }, ...], got",
    ),
    "leg's other key": (
        instead("rate_deg_s = 6.0", "rate = 6.0"),
        "$.plan.legs[1].rate is not a known key; known here: angl",
    ),
    "too fast": (
        instead("north_m_s = 1.0", "north_m_s = 3.5"),
        "speed must be <= 3 m/s (3/4 of $.limits.speed_max_m_s), got",
    ),
    "then": (instead('then = "land"', 'then = "rtl"'), "$.plan.then must be 'stay', 'land' or 'return', got 'rtl'"),
    "out of the fence": (
        instead("duration_s = 25.0", "duration_s = 500.0"),
        "must stay inside the fence by its margin, got",
    ),
    "informed": (
        instead("automatic = true", "automatic = true\ninformed = 3"),
        "must be a list of vehicles' ids, got 3",
    ),
    # law, trigger, network
    "law's kind": (
        instead('kind = "starling"', 'kind = "flock"'),
        "$.law.kind must be one of starling, paper, intent, got",
    ),
    "paper's law, damped": (
        instead('kind = "starling"', 'kind = "paper"\nhold = "damped"'),
        '$.law.hold must be "zero" (the paper\'s) or "first" with $.law.kind = "paper", got "damped"',
    ),
    "trigger's kind": (
        instead('kind = "error" ', 'kind = "errors" '),
        "must be one of error, switching, periodic, got 'err",
    ),
    "network": (
        instead('network = "laptop"', 'network = "mesh"'),
        "$.peers.network must be 'laptop' or 'field', got 'mesh'",
    ),
    "field without addresses": (instead('network = "laptop"', 'network = "field"'), "zenoh must be tcp/HOST:PORT with"),
    "stub's PX4": (
        instead('dynamics = "px4"', 'px4 = "1.15"'),
        "$.stub.px4 must be '1.16', '1.17', '1.18' or 'main', got",
    ),
    # fence
    "corners on end": (
        instead("radius_m = 200.0", "polygon_m = [1, 2, 3]"),
        "$.fence.polygon_m[0] must be [north, east] in metres for each corner, got 1",
    ),
    "two edges": (instead("radius_m = 200.0", "radius_m = 200.0\npolygon_m = [[0, 0], [9, 0], [0, 9]]"), "got both"),
    "crossed fence": (
        instead("radius_m = 200.0", "polygon_m = [[-50, -50], [50, 50], [50, -50], [-50, 50]]"),
        "$.fence.polygon_m must not cross or touch itself",
    ),
    "low ceiling": (instead("ceiling_m = 50.0", "ceiling_m = 2.5"), "$.fence.ceiling_m must be at least 1 m (twice"),
    # vehicles
    "id a word": (instead("id = 2\n", 'id = "two"\n'), "must be a whole number >= 1 and <= 250, got 'two'"),
    "id too large": (
        instead("id = 2\n", "id = 251\n"),
        "must be a whole number >= 1 and <= 250, got 251 (vehicle[1] is id",
    ),
    "id twice": (
        instead("id = 2\n", "id = 1\n"),
        "$.vehicle[1].id must be unique, got 1 as in $.vehicle[0] (vehicle[1] is",
    ),
    "device": (
        vehicle('mavlink = "/dev/ttyACM0"'),
        f"must be udp://HOST:PORT or serial:///dev/NAME:BAUD, got '/dev/ttyACM0' {IDS}",
    ),
    "port alone": (
        vehicle('mavlink = "udp:14540"'),
        f"must be udp://HOST:PORT or serial:///dev/NAME:BAUD, got 'udp:14540' {IDS}",
    ),
    "address alone": (
        vehicle('zenoh = "10.0.0.1:7447"'),
        "PROTOCOL/HOST:PORT with tcp, udp, tls or quic, got '10.0.0.1:7447'",
    ),
    "short pad": (vehicle("pad_m = [1]"), f"$.vehicle[1].pad_m must be [north, east] in metres, got [1] {IDS}"),
    "pad a number": (vehicle("pad_m = 3"), f"$.vehicle[1].pad_m must be [north, east] in metres, got 3 {IDS}"),
    "slot": (
        vehicle('slot = "first"'),
        "$.vehicle[1].slot must be a whole number >= 0 and <= 249, or \"auto\", got 'first'",
    ),
    "pads close": (
        instead("spacing_m = 4.0\nheading", "spacing_m = 1.0\nheading"),
        "pads must be at least the safety radius",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_file_is_refused_with_its_path_the_place_what_came_and_what_is_allowed(
    name: str, tmp_path: Path
) -> None:
    content, said = WRONG[name]
    path = tmp_path / "mine.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        load(path)
    assert said in str(caught.value)
    assert all(line.startswith(f"{path}: ") for line in str(caught.value).splitlines())


@pytest.mark.parametrize(
    "content", [BOM_UTF8 + TEXT.encode(), TEXT.replace("\n", "\r\n").encode()], ids=["BOM", "CRLF"]
)
def test_a_file_that_another_system_wrote_is_read(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_bytes(content)
    assert load(path) == load(FILE)


def test_a_folder_and_no_file_are_named(tmp_path: Path) -> None:
    for path, said in ((tmp_path, "Is a directory"), (tmp_path / "none.toml", "No such file")):
        with pytest.raises(ConfigError, match=f"{re.escape(str(path))}: cannot be read: {said}"):
            load(path)
