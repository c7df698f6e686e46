"""One vehicle's PX4 in SITL: its process and the next one after a reboot, its sockets, what it has said."""

import socket
from collections.abc import Callable, Container, Mapping
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import development as mavlink

from companion.config import FleetConfig
from companion.config.derived import Vehicle
from companion.config.endpoints import autopilot_port, companion_port
from companion.core.frames import Ned, ned_to_geodetic
from companion.errors import CompanionError
from companion.io.link import SO_TIMESTAMPNS
from companion.wire.px4 import interval_parameters
from sim.launch.px4_build import has_parameter, sitl_parameters
from sim.launch.px4_instance import STATE_PORT, Px4Instance
from sim.launch.relay import LinkRelay
from sim.launch.sitl_faults import ORDER_PORT, WIND, InstanceFaults

TRUTH_PORT = 19410
PX4_PORTS = 10
"""instances for which PX4's own scripts open an offboard link of their own"""
RECEIVE_BUFFER_BYTES = 1 << 20
CURRENT_MODE = 436
MODE_RATE_HZ = 20.0


def bind(port: int, whose: str) -> socket.socket:
    """A socket whose datagrams carry the time at which the kernel got them; CompanionError names whose it would be."""
    s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    s.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    s.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
    try:
        s.bind(("127.0.0.1", port))
    except OSError as error:
        s.close()
        raise CompanionError(f"cannot listen on UDP 127.0.0.1:{port} for {whose}: {error.strerror}") from error
    s.setblocking(False)
    return s


class SitlVehicle:
    """One vehicle's PX4 with its sockets for truth and orders, and what it has said (`sitl_faults.Sufferer`)."""

    def __init__(
        self, config: FleetConfig, vehicle: Vehicle, build: Path, folder: Path, given: Mapping[str, float | int],
        send_to: Callable[[Any, int], None], *, logs: bool, relayed: bool,
    ) -> None:  # fmt: skip
        """`given`: parameters beyond the launcher's own; `send_to`: a message to the state link of an instance;
        `relayed`: its companion's link can be cut."""
        self.vehicle = vehicle
        self.index = vehicle.instance
        self.system_id = vehicle.system_id
        if vehicle.system_id != self.index + 1:
            raise CompanionError(
                f"vehicle {vehicle.id}: PX4 instance {self.index} has system id {self.index + 1}, "
                f"fleet.toml says {vehicle.system_id}"
            )
        self.parameters = {**sitl_parameters(build, logs=logs), **given}
        self._build, self._folder, self._send_to = build, folder, send_to
        self._home = ned_to_geodetic(Ned(vehicle.pad_north_m, vehicle.pad_east_m, 0.0), config.origin)
        self._boots = 0
        port = companion_port(self.index)
        self.relay = LinkRelay(autopilot_port(self.index), port) if relayed else None
        self._link_to = port if self.relay is None else self.relay.port
        self._needs_link = relayed or self.index >= PX4_PORTS
        self.truth_socket = bind(TRUTH_PORT + self.index, f"vehicle {vehicle.id}'s truth")
        try:
            self.orders = bind(ORDER_PORT + self.index, f"vehicle {vehicle.id}'s faults")
        except BaseException:
            self.truth_socket.close()
            raise
        calm = tuple(float(self.parameters.get(name, 0.0)) for name in WIND)
        self.faults = InstanceFaults(vehicle.id, self, lambda name: has_parameter(build, name), (calm[0], calm[1]))
        self.clock: list[tuple[float, float]] = []
        """(UTC s, the simulation's s), first and latest"""
        try:
            self._boot()
        except BaseException:
            self._close_sockets()
            raise

    def _boot(self) -> None:
        self._boots += 1
        name = f"px4-{self.vehicle.id}" + (f"-{self._boots}" if self._boots > 1 else "")
        self.px4 = Px4Instance(self.index, self._home, self._build, self._folder / name, self.parameters)
        self.armed = False
        self.custom_mode = 0
        self.landed_state = 1
        self.checked: dict[str, float | int] = {}
        self.mode_streamed = False
        self.missed = False
        """whether its early end has been told"""
        self._link_opened = False
        self.clock.clear()
        self.faults.forget()

    @property
    def sockets(self) -> tuple[socket.socket, ...]:
        """All that the host watches."""
        ends = () if self.relay is None else self.relay.sockets
        return self.truth_socket, self.orders, *ends

    def serve_relay(self, ready: Container[Any]) -> None:
        """Pass on what waits in the companion's link."""
        for end in () if self.relay is None else self.relay.sockets:
            if end in ready and self.relay is not None:
                self.relay.serve(end)

    def close(self) -> None:
        """End the process that runs; no truth and no orders any more."""
        self.px4.end()
        self._close_sockets()

    def _close_sockets(self) -> None:
        self.truth_socket.close()
        self.orders.close()
        if self.relay is not None:
            self.relay.close()

    # -- coming up -----------------------------------------------------------------------------------------------------

    @property
    def not_as_set(self) -> dict[str, float | int | None]:
        """Parameters that were not read back as set, with what was read."""
        return {
            name: self.checked.get(name)
            for name, value in self.parameters.items()
            if name not in self.checked or not abs(self.checked[name] - value) <= 1e-6
        }

    @property
    def up(self) -> bool:
        """Whether it tells its mode, has every parameter as set, and a link of its own where it needs one."""
        return self.mode_streamed and not self.not_as_set and (self._link_opened or not self._needs_link)

    def bring_up(self, states_port: int) -> None:
        """Ask for whatever is missing; to be called again every half second until `up`."""
        if not self.px4.open_state_link(states_port):
            return
        if not self.mode_streamed:
            command, *interval = interval_parameters(CURRENT_MODE, MODE_RATE_HZ)
            self.send(mavlink.MAVLink_command_long_message(self.system_id, 1, command, 0, *interval, 0, 0, 0, 0, 0))
        for name in self.not_as_set:
            self.send(mavlink.MAVLink_param_request_read_message(self.system_id, 1, name.encode(), -1))
        if self._needs_link and not self._link_opened and self.mode_streamed:
            self.px4.open_offboard_link(self._link_to)
            self._link_opened = True

    def ran_at(self) -> float | None:
        """Simulated per real time so far."""
        if len(self.clock) < 2:
            return None
        (real0, sim0), (real1, sim1) = self.clock
        return (sim1 - sim0) / max(real1 - real0, 1e-9)

    # -- what faults do ------------------------------------------------------------------------------------------------

    def send(self, message: Any) -> None:
        """A MAVLink message as a ground station's."""
        self._send_to(message, STATE_PORT + self.index)

    def cut_link(self, cut: bool) -> None:
        """Nothing passes the companion's link, or all does again; CompanionError where nobody stands between."""
        if self.relay is None:
            raise CompanionError("its link is not relayed: name link_lost in the scenario of `fleet up`")
        self.relay.cut = cut

    def reboot(self) -> None:
        """End the process at once; another takes its place, at its pad."""
        self.px4.kill()
        self._boot()
