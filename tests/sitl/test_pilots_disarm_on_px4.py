"""A pilot's disarm just after the companion has armed a real PX4: it stays disarmed."""

import json
import socket
from pathlib import Path
from typing import Any

import pytest
from agent_on_link import AgentOnLink
from px4_fleet import GCS_PORT, GROUND_STATION
from pymavlink.dialects.v20 import development as dialect

from companion.config import FleetConfig, load
from companion.core.values import Phase
from companion.wire.px4 import FORCE
from sim.launch.px4_build import sitl_parameters
from sim.launch.px4_instance import Px4Instance

DELAYS_S = (0.1, 0.3, 0.6, 0.9, 1.2, 1.6, 2.0)
ARM = dialect.MAV_CMD_COMPONENT_ARM_DISARM
COMPANION_PORT, AUTOPILOT_PORT = 14540, 14580


def one_vehicle() -> FleetConfig:
    return load(Path(__file__).resolve().parents[2] / "fleet.toml", lambda t: t.update(vehicle=t["vehicle"][:1]))


def disarm(port: int = GCS_PORT) -> None:
    """The pilot's, from the ground station's link; by force, since at two seconds the vehicle may be in the air."""
    sender: Any = dialect.MAVLink(None, srcSystem=GROUND_STATION[0], srcComponent=GROUND_STATION[1])
    message = dialect.MAVLink_command_long_message(1, 1, ARM, 0, 0.0, FORCE, 0.0, 0.0, 0.0, 0.0, 0.0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.sendto(message.pack(sender), ("127.0.0.1", port))


def arming_is_accepted(message: Any) -> bool:
    return bool(message.get_type() == "COMMAND_ACK" and message.command == ARM and message.result == 0)


def says(armed: bool) -> Any:
    def heartbeat(message: Any) -> bool:
        return message.get_type() == "HEARTBEAT" and bool(message.base_mode & 128) is armed

    return heartbeat


def check_one_disarm(vehicle: AgentOnLink, delay_s: float, port: int = GCS_PORT) -> None:
    """Take-off, arming, disarm after a while: it stays disarmed until it is commanded again."""
    agent = vehicle.agent
    vehicle.run_while(lambda: bool(agent.operator.unready(vehicle.now)), 60.0)
    boot, begun, obeyed = agent.status(vehicle.now).place
    order = {"verb": "takeoff", "id": f"{delay_s}", "issuer": "test", "after": {"1": [[boot, begun, obeyed]]}}
    answer = json.loads(agent.receive_command(json.dumps(order).encode(), vehicle.now))
    assert answer["accepted"], answer
    assert vehicle.run(10.0, arming_is_accepted), vehicle.notes
    vehicle.run(delay_s)
    disarm(port)
    assert vehicle.run(3.0, says(armed=False)), "the pilot's disarm is obeyed"
    assert not vehicle.run(8.0, says(armed=True)), (delay_s, vehicle.notes)
    assert agent.phase in (Phase.IDLE, Phase.LANDED), vehicle.notes


@pytest.mark.parametrize("delay_s", DELAYS_S)
def test_a_vehicle_that_its_pilot_disarms_just_after_arming_stays_disarmed(
    tmp_path: Path, build: Path, delay_s: float
) -> None:
    config = one_vehicle()
    vehicle = AgentOnLink(config, COMPANION_PORT, AUTOPILOT_PORT)
    instance = Px4Instance(0, config.origin, build, tmp_path / "px4", sitl_parameters(build))
    try:
        check_one_disarm(vehicle, delay_s)
    finally:
        instance.end()
        vehicle.close()
