"""The operator's port of one vehicle: commands in their order, answers, the preflight report, the status."""

import json
from pathlib import Path
from typing import Any

import pytest

from companion.config import load
from companion.core.values import Instant, Phase
from companion.vehicle.agent import Agent
from companion.wire.operator import encode
from companion.wire.peer import encode_motion

CONFIG = load(Path(__file__).resolve().parents[2] / "fleet.toml", lambda t: t.update(vehicle=t["vehicle"][:2]))
NOW = Instant(10_000_000_000, 1_790_000_000_000_000_000)


def agent() -> Agent:
    return Agent(CONFIG, 1, 7)


def command(a: Agent, verb: str, id_: str = "1", **fields: Any) -> dict[str, Any]:
    order = {"verb": verb, "id": id_, "issuer": "x", "after": {"1": [[*a.operator.place]]}, **fields}
    answer: dict[str, Any] = json.loads(a.receive_command(json.dumps(order).encode(), NOW))
    return answer


def test_a_vehicle_that_is_not_ready_refuses_to_take_off_with_every_reason() -> None:
    a = agent()
    answer = command(a, "takeoff")
    assert not answer["accepted"]
    assert answer["in_order"]
    assert answer["reason"] == "; ".join(a.operator.unready(NOW))
    assert "not heard: vehicle 2" in answer["reason"]
    assert a.phase is Phase.IDLE


def test_the_same_bytes_again_get_the_same_answer_and_change_nothing() -> None:
    a = agent()
    order = json.dumps({"verb": "land", "id": "1", "issuer": "x", "after": {"1": [[*a.operator.place]]}}).encode()
    first = a.receive_command(order, NOW)
    place = a.operator.place
    assert a.receive_command(order, NOW) == first
    assert a.operator.place == place


def test_a_command_for_another_place_is_refused_and_counted() -> None:
    a = agent()
    order = {"verb": "takeoff", "id": "1", "issuer": "x", "after": {"1": [[8, 0, 0]]}}
    answer = json.loads(a.receive_command(json.dumps(order).encode(), NOW))
    assert not answer["in_order"]
    assert "another companion" in answer["reason"]
    assert a.rejected == {"command: not in order": 1}


@pytest.mark.parametrize("payload", [b"", b"[]", b"{}", b'{"verb":"fly"}', b"\xff"])
def test_what_is_no_command_is_answered_and_counted(payload: bytes) -> None:
    a = agent()
    answer = json.loads(a.receive_command(payload, NOW))
    assert not answer["accepted"]
    assert sum(a.rejected.values()) == 1


def test_a_kill_needs_its_confirmation() -> None:
    a = agent()
    assert command(a, "kill")["reason"] == "kill needs its confirmation"
    assert command(a, "kill", "2", confirm=True)["accepted"]


def test_a_commanded_trajectory_goes_to_the_exchange_and_its_answer_tells_the_revision() -> None:
    a = agent()
    motion = CONFIG.motion_into("v", a.history.newest, NOW.fleet_ns + 1_000_000_000, 0)
    answer = command(a, "motion", motion=json.loads(encode_motion(motion)))
    assert answer["accepted"], answer
    assert answer["revision"] == 1
    assert a.history.newest == motion


def test_the_report_and_the_status_tell_the_same_of_one_vehicle() -> None:
    a = agent()
    a.advance(NOW)
    later = Instant(NOW.monotonic_ns + 2_000_000_000, NOW.fleet_ns + 2_000_000_000)
    report, status = a.operator.preflight_report(later), a.status(later)
    assert (report.vehicle, report.boot_id, report.configuration) == (1, 7, CONFIG.shared_hash)
    assert status.configuration == report.configuration
    assert status.ready == [c.message for c in report.checks if not c.passed]
    assert set(status.unfit) <= set(status.ready)
    assert status.up_s == 2.0
    assert status.place == (7, 0, 0)
    assert json.loads(encode(status))["motion"] == json.loads(encode_motion(a.history.newest))
