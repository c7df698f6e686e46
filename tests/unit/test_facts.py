"""`fleet check`: what it tells of a file is what the file makes the vehicles do."""

import subprocess
import sys
from pathlib import Path

import pytest

from companion.config.file import load, parse, read_tables
from companion.operator.facts import facts

ROOT = Path(__file__).resolve().parents[2]


def told(**tables: object) -> dict[str, str]:
    read = read_tables(ROOT / "fleet.toml")
    for name, more in tables.items():
        if isinstance(more, dict):
            read.setdefault(name, {}).update(more)
        else:
            read.pop(name)
    return {what: f"{value}; {why}" for what, value, why in facts(parse(read, "fleet.toml"))}


def test_the_shipped_files_facts() -> None:
    config = load(ROOT / "fleet.toml")
    said = told()
    assert said["fleet"] == f"starling; global frame, digest {config.shared_hash}"
    assert said["safety radius"].startswith(f"{config.safety_radius_m:.2f} m; ")
    assert said["formation"].startswith(f"v; 4.00 m apart at least, of {config.spacing_min_m:.2f} m needed; 10 m high")
    assert said["plan"] == "4 legs; begins by itself, 62 s, 1.0 m/s at most; ends 35 m north, 28 m east, then: land"
    assert said["messages"] == "error trigger; silent for 10 s at most; a peer that is gone is noticed within 4 s"
    assert said["vehicle 10"] == "udp://127.0.0.1:14549; system id 10, found by scouting, not signed"


@pytest.mark.parametrize(
    ("tables", "row", "text"),
    [
        ({"fence": None}, "fence", "none; nothing keeps a vehicle near"),
        ({"limits": {"barrier": False}}, "safety radius", "off; "),
        ({"plan": {"legs": [], "then": "stay"}}, "plan", "stay; begins by itself"),
        ({"plan": {"automatic": False}}, "plan", "4 legs; begins on command, 62 s"),
        (
            {"plan": {"legs": [{"kind": "turn", "rate_deg_s": 6}], "then": "stay"}},
            "plan",
            "1 legs; begins by itself, never",
        ),
        (
            {"plan": {"kind": "none", "legs": [], "then": "stay"}},
            "plan",
            "none; the vehicles agree on a motion; informed: n",
        ),
        (
            {"peers": {"notice_lost_s": 1.0}},
            "messages",
            "error trigger; silent for 5 s at most; a peer that is gone is ",
        ),
    ],
)
def test_a_changed_key_shows(tables: dict[str, object], row: str, text: str) -> None:
    assert told(**tables)[row].startswith(text)


def test_the_command_tells_them_or_the_fault(tmp_path: Path) -> None:
    def check(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-P", "-m", "sim", "check", *words],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )

    done = check(str(ROOT / "examples" / "six-quads-mesh" / "fleet.toml"))
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.endswith("fleet.toml: fit to fly\n")
    (tmp_path / "mine.toml").write_text("[fleet]\n")
    done = check("mine.toml")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("fleet: mine.toml: $.fleet.name is required")
