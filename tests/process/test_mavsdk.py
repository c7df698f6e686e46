"""MAVSDK, a client that nobody here wrote, flies three stand-in autopilots at once over UDP."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

import pytest
from stub_process import fleet, running

pytest.importorskip("mavsdk")

from mavsdk import ComponentType
from mavsdk.asyncio import Mavsdk, System
from mavsdk.asyncio.mavsdk import Configuration
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.offboard import OffboardAsync, PositionNedYaw, VelocityNedYaw
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync

pytestmark = pytest.mark.process
VEHICLES = 3
RATE_HZ = 50.0


@dataclass
class Vehicle:
    system: System
    action: ActionAsync
    telemetry: TelemetryAsync
    offboard: OffboardAsync
    param: ParamAsync


@asynccontextmanager
async def connected(port: int) -> AsyncIterator[Vehicle]:
    configuration = Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER)
    async with Mavsdk(configuration) as mavsdk:
        await mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = await mavsdk.first_autopilot(10.0)
        assert system is not None
        yield Vehicle(system, ActionAsync(system), TelemetryAsync(system), OffboardAsync(system), ParamAsync(system))


async def wait_for(stream: AsyncIterator[Any], condition: Callable[[Any], bool]) -> Any:
    """The first value of a telemetry stream that meets the condition."""
    async with asyncio.timeout(20.0):
        async for value in stream:
            if condition(value):
                return value
    raise AssertionError("the stream ended")


async def read_and_write_parameters(param: ParamAsync) -> None:
    assert await param.get_param_int("SYS_AUTOSTART") == 10040
    assert await param.get_param_float("COM_OF_LOSS_T") == 5.0
    await param.set_param_int("COM_OBL_RC_ACT", 4)
    assert await param.get_param_int("COM_OBL_RC_ACT") == 4
    await param.set_param_float("MPC_XY_VEL_MAX", 6.0)
    assert await param.get_param_float("MPC_XY_VEL_MAX") == 6.0


async def count_positions(telemetry: TelemetryAsync, seconds: float) -> int:
    received = 0
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            async for _ in telemetry.subscribe_position_velocity_ned():
                received += 1
    return received


async def fly(port: int, system_id: int) -> None:
    async with connected(port) as vehicle:
        telemetry = vehicle.telemetry
        assert await vehicle.system.get_system_id() == system_id
        health = await wait_for(telemetry.subscribe_health(), lambda h: h.is_armable)
        assert health.is_local_position_ok
        assert health.is_global_position_ok
        assert health.is_home_position_ok
        assert await telemetry.health_all_ok()
        await read_and_write_parameters(vehicle.param)
        await telemetry.set_rate_position_velocity_ned(RATE_HZ)

        await vehicle.action.set_takeoff_altitude(2.5)
        await vehicle.action.arm()
        assert await wait_for(telemetry.subscribe_armed(), bool)
        await vehicle.action.takeoff()
        await wait_for(telemetry.subscribe_landed_state(), lambda state: state.name == "TAKING_OFF")
        await wait_for(telemetry.subscribe_position(), lambda p: p.relative_altitude_m > 1.5)
        await wait_for(telemetry.subscribe_flight_mode(), lambda mode: mode.name == "HOLD")

        await vehicle.offboard.set_velocity_ned(VelocityNedYaw(1.5, 0.0, 0.0, 0.0))
        await vehicle.offboard.start()
        moving = await wait_for(
            telemetry.subscribe_position_velocity_ned(), lambda state: state.velocity.north_m_s > 1.2
        )
        assert await vehicle.offboard.is_active()
        assert await count_positions(telemetry, 0.5) == pytest.approx(0.5 * RATE_HZ, rel=0.5)
        here = moving.position
        await vehicle.offboard.set_position_ned(PositionNedYaw(here.north_m, here.east_m, here.down_m, 0.0))
        await wait_for(
            telemetry.subscribe_position_velocity_ned(),
            lambda s: abs(s.position.north_m - here.north_m) < 0.4 and abs(s.velocity.north_m_s) < 0.4,
        )
        assert (await telemetry.flight_mode()).name == "OFFBOARD"

        await vehicle.action.land()
        await wait_for(telemetry.subscribe_landed_state(), lambda state: state.name == "LANDING")
        await wait_for(telemetry.subscribe_landed_state(), lambda state: state.name == "ON_GROUND")
        await wait_for(telemetry.subscribe_armed(), lambda armed: not armed)


async def fly_all(ports: list[int]) -> None:
    async with asyncio.timeout(60.0):
        await asyncio.gather(*(fly(port, i + 1) for i, port in enumerate(ports)))


def test_mavsdk_connects_arms_flies_offboard_and_lands_three_vehicles_at_once() -> None:
    settings = fleet(VEHICLES)
    with running(settings):
        asyncio.run(fly_all([vehicle.companion_port for vehicle in settings.vehicles]))
