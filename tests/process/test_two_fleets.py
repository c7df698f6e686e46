"""Two fleets of one name on one machine: whoever starts second is refused, and no verb reaches both unawares."""

import json
from contextlib import ExitStack
from pathlib import Path

import pytest
from fleet_process import Fleet, make_fleet, operator_of, run, started, wait_status

from companion.io.network import operator_link

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]
SESSIONS = 40
"""of sessions that ask as soon as somebody answers, one in nine has not found the second companion"""


def elsewhere(fleet: Fleet, folder: Path) -> Path:
    """The same fleet on other ports: what a second user of the shipped file has."""
    other = make_fleet(folder, 1, name=fleet.config.fleet.name)
    return other.file


def test_a_verb_refuses_where_two_companions_answer_as_one_vehicle_and_ends_both_on_demand(tmp_path: Path) -> None:
    one = tmp_path / "one"
    two = tmp_path / "two"
    one.mkdir()
    two.mkdir()
    fleet = make_fleet(one, 1)
    other = elsewhere(fleet, two)
    arguments = ("--fleet", str(fleet.file))
    with ExitStack() as stack:
        for file, name in ((fleet.file, "a"), (other, "b")):
            stack.enter_context(started("sim", "stub", "--fleet", str(file), folder=tmp_path, name=f"stub-{name}"))
        companion = ("companion", "run", "--vehicle", "1", "--fleet")
        stack.enter_context(started(*companion, str(fleet.file), folder=tmp_path, name="companion-a"))
        operator = stack.enter_context(operator_of(fleet))
        wait_status(operator, lambda said: 1 in said)
        up = run("sim", "up", *arguments, "--out", str(tmp_path / "flights"), folder=tmp_path)
        assert (up.returncode, up.stdout) == (1, "")
        assert f"companions of fleet {fleet.config.fleet.name!r} run already (vehicle 1)" in up.stderr
        assert not (tmp_path / "flights").exists()
        alone = run("sim", "land", *arguments, folder=tmp_path)
        assert alone.returncode == 0, alone.stderr
        assert f"accepted by 1 (fleet {fleet.config.fleet.name}, companions up for" in alone.stdout
        stack.enter_context(started(*companion, str(other), folder=tmp_path, name="companion-b"))
        wait_status(operator, lambda _: 1 in operator.roster.doubled)
        for verb in (("land",), ("hold",), ("kill", "--yes"), ("takeoff",)):
            refused = run("sim", *verb, *arguments, folder=tmp_path)
            assert refused.returncode == 1, refused.stdout
            assert "two companions" in refused.stderr or "another companion speaks under the same id" in refused.stderr
        seen = run("sim", "status", "--json", *arguments, folder=tmp_path)
        assert "vehicle 1 is two companions, one up for" in seen.stderr
        assert list(json.loads(seen.stdout)) == ["1"]
        both = run("sim", "land", "--both", *arguments, folder=tmp_path)
        assert both.returncode == 0, both.stderr
        assert "accepted by 1" in both.stdout


def test_a_launcher_refuses_a_name_that_another_launcher_flies(tmp_path: Path) -> None:
    hover = {"legs": [], "then": "stay"}
    fleet = make_fleet(tmp_path, 1, plan=hover)
    out = ("--out", str(tmp_path / "flights"))
    with started("sim", "up", "--fleet", str(fleet.file), *out, "--json", folder=tmp_path, name="up") as up:
        with operator_of(fleet) as operator:
            wait_status(operator, lambda said: 1 in said)
        (tmp_path / "second").mkdir()
        second = elsewhere(fleet, tmp_path / "second")
        refused = run("sim", "up", "--fleet", str(second), *out, folder=tmp_path)
        assert refused.returncode == 1
        assert "is flown on this machine already" in refused.stderr
        assert up.popen.poll() is None
        assert len(list((tmp_path / "flights").iterdir())) == 1


def test_every_new_session_of_an_operator_finds_both_companions_of_an_id_at_its_first_question(tmp_path: Path) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    one.mkdir()
    two.mkdir()
    fleet = make_fleet(one, 1)
    other = elsewhere(fleet, two)
    with ExitStack() as stack:
        for file, name in ((fleet.file, "a"), (other, "b")):
            run_it = ("companion", "run", "--vehicle", "1", "--fleet", str(file))
            stack.enter_context(started(*run_it, folder=tmp_path, name=f"companion-{name}"))
        operator = stack.enter_context(operator_of(fleet))
        wait_status(operator, lambda _: 1 in operator.roster.doubled)
        answered = []
        for _ in range(SESSIONS):
            with operator_link(fleet.config) as link:
                link.wait_alive([1], 5.0)
                answered.append(len(link.ask([1], "status", b"", 1.0, 0.5)[1]))
    assert answered == [2] * SESSIONS
