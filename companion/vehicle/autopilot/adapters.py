"""Which adapter flies a vehicle: the one place that knows an autopilot by name."""

from companion.config import FleetConfig
from companion.config.derived import Vehicle
from companion.vehicle.autopilot.port import AutopilotPort
from companion.vehicle.autopilot.px4 import Px4Autopilot


def open_autopilot(config: FleetConfig, vehicle: Vehicle) -> AutopilotPort:
    """The port to a vehicle's autopilot."""
    return Px4Autopilot(config, vehicle)
