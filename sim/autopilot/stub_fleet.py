"""The stub autopilots that a fleet.toml asks for."""

from math import cos, pi, radians, sin
from pathlib import Path
from random import Random

from companion.config import FleetConfig
from companion.config.derived import Vehicle
from companion.config.endpoints import autopilot_port, companion_port, udp_endpoint
from companion.core.frames import Ned
from companion.errors import ConfigError
from companion.io.signing_key import read_key
from companion.vehicle.autopilot.px4_versions import fleet_parameters, version_named
from sim.autopilot.disturbances import GustParameters, NoiseParameters
from sim.autopilot.dynamics_parameters import DynamicsParameters
from sim.autopilot.stubs import StubFleetSettings, StubVehicleSettings


def _ports(vehicle: Vehicle) -> tuple[int, int]:
    """The stub's UDP port and its companion's: the one in the vehicle's URL, and PX4's distance from it."""
    endpoint = udp_endpoint(vehicle.mavlink)
    companion = companion_port(vehicle.instance) if endpoint is None else endpoint[1]
    return autopilot_port(vehicle.instance, companion), companion


def stub_port(vehicle: Vehicle) -> int:
    """The UDP port that the vehicle's stub binds."""
    return _ports(vehicle)[0]


def _signing_key(vehicle: Vehicle, folder: Path) -> bytes:
    file = vehicle.signing_key_beside(folder / "fleet.toml")
    if file is None:
        raise ConfigError(f"vehicle {vehicle.id}: names no signing_key, and [stub] signing demands one")
    return read_key(file)


def check_stub_links(config: FleetConfig) -> None:
    """Raise ConfigError if a vehicle's link cannot be a stub's; lockstep, which has no sockets, does not mind."""
    for v in config.vehicles:
        where = f"vehicle {v.id}: mavlink = {v.mavlink!r}"
        endpoint = udp_endpoint(v.mavlink)
        if endpoint is None or endpoint[0] not in ("0.0.0.0", "127.0.0.1", "localhost"):
            raise ConfigError(f"{where}: a stub speaks to udp://127.0.0.1:PORT only (`fleet up --rehearse`)")
        own, _ = _ports(v)
        if own > 65535:
            raise ConfigError(f"{where}: the stub's own port would be {own}; the companion's must be lower")


def stub_settings(
    config: FleetConfig,
    *,
    seed: int,
    truth_path: Path | None = None,
    stop_fd: int | None = None,
    grace_s: float = 0.0,
    ground: bool = False,
    folder: Path = Path(),
) -> StubFleetSettings:
    """Settings of the stubs; each estimator's origin lies elsewhere, by up to `stub.origin_scatter_m`, after `seed`.

    `folder`: of the fleet's file, beside which keys lie.
    """
    stub = config.stub
    random = Random(f"origins/{seed}")
    parameters = tuple(fleet_parameters(version_named(stub.px4)).items())
    vehicles = []
    for k, v in enumerate(config.vehicles):
        way, angle = stub.origin_scatter_m * random.random(), 2.0 * pi * random.random()
        offset = Ned(way * cos(angle), way * sin(angle), 0.2 * stub.origin_scatter_m * (random.random() - 0.5))
        own, companion = _ports(v)
        vehicles.append(
            StubVehicleSettings(
                vehicle_id=v.id,
                instance=v.instance,
                system_id=v.system_id,
                autopilot_port=own,
                companion_port=companion,
                home_ned_m=Ned(v.pad_north_m, v.pad_east_m, 0.0),
                ekf_origin_offset_m=offset if config.fleet.frame == "global" else Ned(
                    -v.pad_north_m, -v.pad_east_m, 0.0
                ),
                yaw_rad=radians(config.formation.heading_deg),
                booted_before_ns=round(k / len(config.vehicles) * 1e9 / config.limits.control_rate_hz),
                parameters=parameters,
                px4=stub.px4,
                signing_key=_signing_key(v, folder) if stub.signing else None,
            )
        )  # fmt: skip
    return StubFleetSettings(
        vehicles=tuple(vehicles),
        fleet_origin=config.origin,
        dynamics=DynamicsParameters(
            model=stub.dynamics, attitude_lag_s=stub.lag_s, drag_per_s=stub.drag_per_s,
            wind_north_m_s=stub.wind_north_m_s, wind_east_m_s=stub.wind_east_m_s,
        ),
        gust=GustParameters(sigma_m_s2=stub.gust_m_s2),
        noise=NoiseParameters(position_sigma_m=stub.position_noise_m, velocity_sigma_m_s=stub.velocity_noise_m_s),
        seed=seed,
        truth_path=truth_path,
        stop_fd=stop_fd,
        grace_s=grace_s,
        ground=ground,
    )  # fmt: skip
