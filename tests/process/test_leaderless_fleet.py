"""A fleet of processes over Zenoh without a shared motion: one is told where to go, the others follow."""

import json
from pathlib import Path

import pytest
from fleet_process import all_in, flight_folder, make_fleet, operator_of, run, started, wait_status

from companion.io.replay import replay_file
from companion.wire.operator import Status

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]


@pytest.mark.parametrize("law", ["starling", "intent"])
def test_four_follow_the_one_that_is_told_and_hold_where_they_are_by_then(tmp_path: Path, law: str) -> None:
    fleet = make_fleet(tmp_path, 4, plan={"kind": "none"}, law={"kind": law})
    out = fleet.folder / "flights"

    def drawn(said: dict[int, Status]) -> bool:
        told = [s.centre for s in said.values()]
        return len(told) == 4 and all(c is not None and c.velocity_ned_m_s[0] > 0.4 for c in told)

    with started("sim", "up", "--json", "--fleet", str(fleet.file), "--out", str(out), folder=fleet.folder) as up:
        with operator_of(fleet) as operator:
            wait_status(operator, all_in(fleet.ids, "moving"))
            asked = run(
                "sim", "move", "--vehicle", "3", "--velocity", "0.5", "0", "0", "--fleet", str(fleet.file),
                folder=fleet.folder,
            )  # fmt: skip
            assert asked.returncode == 0, asked.stderr
            assert "accepted by 1" in asked.stdout
            said = wait_status(operator, drawn)
            assert {i: s.informed for i, s in said.items()} == {1: False, 2: False, 3: True, 4: False}
            assert run("sim", "hold", "--fleet", str(fleet.file), folder=fleet.folder).returncode == 0
            said = wait_status(operator, all_in(fleet.ids, "holding", revision=3))
            assert not any(s.informed for s in said.values())
            assert run("sim", "land", "--fleet", str(fleet.file), folder=fleet.folder).returncode == 0
        up.wait()
        summary = json.loads(up.out)
    assert summary["landed"] == {str(i): True for i in fleet.ids}
    assert summary["minimum_distance_m"] >= 1.2
    for recording in flight_folder(out).glob("*.mcap"):
        assert replay_file(recording).same
