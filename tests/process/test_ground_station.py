"""The stubs on a ground station, as QGroundControl would see them, and in PX4's 3D viewer."""

import socket
import time
from dataclasses import replace

import pytest
from pymavlink.dialects.v20 import development as mavlink
from stub_process import fleet, launched

pytestmark = pytest.mark.process


def bound(port: int) -> socket.socket:
    s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        s.bind(("127.0.0.1", port))
    except OSError:
        s.close()
        pytest.skip(f"UDP port {port} is taken: a ground station or another fleet runs on this machine")
    s.settimeout(0.2)
    return s


def test_ground_station_sees_every_vehicle_and_gets_answers() -> None:
    settings = fleet(2)
    settings = replace(
        settings,
        ground=True,
        vehicles=tuple(replace(v, instance=k) for k, v in enumerate(settings.vehicles)),
    )
    parser = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    parser.robust_parsing = True
    with bound(14550) as station, bound(19411) as viewer, launched(settings):
        seen: dict[int, set[str]] = {v.system_id: set() for v in settings.vehicles}
        answered: set[int] = set()
        asked: set[int] = set()
        end_s = time.monotonic() + 20.0
        wanted = {"HEARTBEAT", "ATTITUDE", "GLOBAL_POSITION_INT", "SYS_STATUS"}
        while time.monotonic() < end_s and not (all(s >= wanted for s in seen.values()) and answered == set(seen)):
            try:
                data, sender = station.recvfrom(4096)
            except TimeoutError:
                continue
            for message in parser.parse_buffer(data) or ():
                system = message.get_srcSystem()
                seen[system].add(message.get_type())
                if system not in asked:
                    asked.add(system)
                    request = mavlink.MAVLink_param_request_read_message(system, 1, b"COM_OBL_RC_ACT", -1)
                    station.sendto(request.pack(parser), sender)
                if message.get_type() == "PARAM_VALUE" and message.param_id == "COM_OBL_RC_ACT":
                    answered.add(system)
        assert answered == set(seen)
        assert all(s >= wanted for s in seen.values())
        truths = [m for m in parser.parse_buffer(viewer.recv(4096)) or () if m.get_type() == "HIL_STATE_QUATERNION"]
        assert truths
        assert truths[0].get_srcSystem() == settings.vehicles[1].system_id
        assert abs(truths[0].lat * 1e-7 - settings.fleet_origin.latitude_deg) < 0.001
