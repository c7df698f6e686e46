"""The agent's mailbox: what each input brings, and what is refused at the door."""

from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import development as dialect

from companion.config import load
from companion.core.failsafe import Failsafe
from companion.core.values import Instant
from companion.vehicle.agent import Agent
from companion.vehicle.autopilot.port import NOTHING, Heard

CONFIG = load(Path(__file__).resolve().parents[2] / "fleet.toml", lambda t: t.update(vehicle=t["vehicle"][:2]))


def at(seconds: float) -> Instant:
    return Instant(round(seconds * 1e9), 1_790_000_000_000_000_000 + round(seconds * 1e9))


def packed(message: Any, system_id: int = 1) -> bytes:
    return bytes(message.pack(dialect.MAVLink(None, srcSystem=system_id, srcComponent=1)))


def heartbeat() -> Any:
    return dialect.MAVLink_heartbeat_message(2, 12, 1, 0, 3, 3)


def position(boot_ms: int) -> Any:
    return dialect.MAVLink_local_position_ned_message(boot_ms, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def origin() -> Any:
    where = CONFIG.origin
    return dialect.MAVLink_gps_global_origin_message(
        round(where.latitude_deg * 1e7), round(where.longitude_deg * 1e7), round(where.altitude_amsl_m * 1e3), 0
    )


def test_a_datagram_says_whether_our_autopilot_spoke_and_whether_a_position_came() -> None:
    agent = Agent(CONFIG, 1, 7)
    assert agent.receive_mavlink(packed(heartbeat()), at(1.0)) == Heard(autopilot=True, position=False)
    agent.receive_mavlink(packed(origin()), at(1.0))
    assert agent.receive_mavlink(packed(position(1000)), at(1.01)) == Heard(autopilot=True, position=True)
    assert agent.receive_mavlink(packed(position(1000)), at(1.02)) == Heard(autopilot=True, position=False), "repeated"
    assert agent.receive_mavlink(packed(position(1040), system_id=9), at(1.03)) == NOTHING
    assert agent.receive_mavlink(b"noise", at(1.04)) == NOTHING


def test_a_position_makes_the_next_tick_due_at_once() -> None:
    agent = Agent(CONFIG, 1, 7)
    agent.receive_mavlink(packed(heartbeat()), at(1.0))
    agent.receive_mavlink(packed(origin()), at(1.0))
    agent.advance(at(1.0))
    assert agent.next_deadline_ns() > at(1.0).monotonic_ns
    agent.receive_mavlink(packed(position(1000)), at(1.01))
    assert agent.next_deadline_ns() <= at(1.01).monotonic_ns
    tick = agent.advance(at(1.01)).tick
    assert tick is not None
    assert not tick.steered
    assert agent.advance(at(1.02)).tick is None
    assert agent.advance(at(1.2)).tick is not None, "without a position the time makes one due"


@pytest.mark.parametrize(
    ("key", "name"),
    [
        ("fleet/2/other", "peer: unknown topic"),
        ("state", "state: version"),
        ("fleet/1/state", Failsafe.OWN_ID.value),
        ("fleet/9/plan", "plan: foreign id"),
    ],
)
def test_what_comes_under_a_wrong_key_is_counted_by_what_is_wrong(key: str, name: str) -> None:
    agent = Agent(CONFIG, 1, 7)
    agent.receive_peer(key, b"", at(1.0))
    assert sum(agent.rejected.values()) == 1
    assert agent.rejected[name] == 1


def test_who_hears_its_own_id_notes_it_once() -> None:
    agent = Agent(CONFIG, 1, 7)
    for k in range(20):
        agent.receive_peer("fleet/1/state", b"", at(1.0 + 0.1 * k))
    noted = agent.advance(at(3.0)).notes
    assert noted == [f"{Failsafe.OWN_ID.value}: it says where it is itself"]
