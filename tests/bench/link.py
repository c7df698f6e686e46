"""CPU of the companion's link beside mavsdk's: `python -m tests.bench.link [--rounds N] [--seconds S]`.

A stub autopilot speaks over UDP as PX4 does, some 400 messages a second of which 50 are positions. A client hears them
and answers each position with a velocity setpoint. The clients take turns, each in a process of its own that says what
CPU all its threads took while positions came: the companion's link (socket and codec) first as it meets the stub, then
as a companion sets it up (streams that nobody reads turned off); mavsdk with callbacks; mavsdk with asyncio.
"""

import argparse
import asyncio
import json
import select
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[2]
WARM_UP_S = 3.0
"""for connecting and for what is asked once"""
OURS, OURS_QUIET = "companion", "companion, streams set up"
CALLBACKS, ASYNCIO = "mavsdk, callbacks", "mavsdk, asyncio"


class Meter:
    """Counts positions after the warm-up, and the CPU of the process meanwhile."""

    def __init__(self, seconds: float) -> None:
        self.begin_s = time.monotonic() + WARM_UP_S
        self.end_s = self.begin_s + seconds
        self._cpu_ns: int | None = None
        self._positions = 0

    def heard(self) -> None:
        """A position came and was answered."""
        if self._cpu_ns is None and time.monotonic() >= self.begin_s:
            self._cpu_ns, self._positions = time.process_time_ns(), 0
        self._positions += 1

    @property
    def over(self) -> bool:
        """Whether the time is up."""
        return time.monotonic() >= self.end_s

    def report(self) -> None:
        """What a position cost, for the parent."""
        assert self._cpu_ns is not None, "no position came"
        cpu_ns = time.process_time_ns() - self._cpu_ns
        print(json.dumps({"cpu_s": cpu_ns * 1e-9, "positions": self._positions}))  # noqa: T201


def companion(port: int, meter: Meter, quiet: bool) -> None:
    """The companion's socket and codec."""
    from companion.core.frames import Ned
    from companion.io.link import UdpLink
    from companion.wire import px4
    from companion.wire.mavlink import LocalPosition, MavlinkCodec

    link, codec = UdpLink("127.0.0.1", port), MavlinkCodec(1)
    streams = px4.streams_hz(50.0) if quiet else {px4.POSITION_MESSAGE_ID: 50.0}
    asked, next_s = list(streams.items()), 0.0
    while not meter.over:
        ready, _, _ = select.select([link], [], [], 0.5)
        for datagram, received_ns, address in link.receive() if ready else ():
            for event in codec.decode(datagram):
                if isinstance(event, LocalPosition):
                    link.confirm(address, received_ns)
                    link.send(codec.setpoint(event.boot_ms, -10.0, Ned(1.0, 0.0, 0.0), (0.0, 0.0), 0.0))
                    meter.heard()
            if asked:
                link.confirm(address, received_ns)
                link.send(codec.command(*px4.interval_parameters(*asked.pop())))
        if time.monotonic() >= next_s:
            next_s = time.monotonic() + 1.0
            link.send(codec.heartbeat())
    link.close()


def callbacks(port: int, meter: Meter) -> None:
    """mavsdk, whose threads call back."""
    from mavsdk import ComponentType, Configuration, Mavsdk
    from mavsdk.plugins.offboard import Offboard, VelocityNedYaw
    from mavsdk.plugins.telemetry import Telemetry

    configuration = Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER)
    with Mavsdk(configuration) as mavsdk:
        mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = mavsdk.first_autopilot(10.0)
        assert system is not None
        telemetry, offboard = Telemetry(system), Offboard(system)
        telemetry.set_rate_position_velocity_ned(50.0)

        def heard(_: Any, __: Any) -> None:
            offboard.set_velocity_ned(VelocityNedYaw(1.0, 0.0, 0.0, 0.0))
            meter.heard()

        telemetry.subscribe_position_velocity_ned(heard)
        while not meter.over:
            time.sleep(0.2)
        meter.report()
        sys.stdout.flush()


async def asynchronous(port: int, meter: Meter) -> None:
    """mavsdk under asyncio."""
    from mavsdk import ComponentType
    from mavsdk.asyncio import Mavsdk
    from mavsdk.asyncio.mavsdk import Configuration
    from mavsdk.asyncio.plugins.offboard import OffboardAsync, VelocityNedYaw
    from mavsdk.asyncio.plugins.telemetry import TelemetryAsync

    configuration = Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER)
    async with Mavsdk(configuration) as mavsdk:
        await mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = await mavsdk.first_autopilot(10.0)
        assert system is not None
        telemetry, offboard = TelemetryAsync(system), OffboardAsync(system)
        await telemetry.set_rate_position_velocity_ned(50.0)
        async for _ in telemetry.subscribe_position_velocity_ned():
            await offboard.set_velocity_ned(VelocityNedYaw(1.0, 0.0, 0.0, 0.0))
            meter.heard()
            if meter.over:
                break
        meter.report()


CLIENTS: dict[str, Callable[[int, Meter], Any]] = {
    OURS: lambda port, meter: (companion(port, meter, False), meter.report()),
    OURS_QUIET: lambda port, meter: (companion(port, meter, True), meter.report()),
    CALLBACKS: callbacks,
    ASYNCIO: lambda port, meter: asyncio.run(asynchronous(port, meter)),
}


def microseconds(client: str, seconds: float) -> tuple[float, float]:
    """CPU per position (us) of one client's round, beside a stub of its own, and positions a second."""
    sys.path.insert(0, str(HERE / "tests" / "process"))
    from stub_process import fleet, running, wait_until_bound

    settings = fleet(1)
    vehicle = settings.vehicles[0]
    with running(settings):
        wait_until_bound(vehicle.autopilot_port)
        arguments = ["--client", client, "--port", str(vehicle.companion_port), "--seconds", str(seconds)]
        done = subprocess.run(
            [sys.executable, "-m", "tests.bench.link", *arguments], cwd=HERE, check=True, capture_output=True,
            text=True, timeout=seconds + WARM_UP_S + 60.0,
        )  # fmt: skip
    told = json.loads([line for line in done.stdout.splitlines() if line.startswith("{")][-1])
    return 1e6 * told["cpu_s"] / told["positions"], told["positions"] / seconds


def main() -> None:
    """Measure in turns, and print each client's median and our ratio to it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--client", choices=CLIENTS, help=argparse.SUPPRESS)
    parser.add_argument("--port", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.client is not None:
        CLIENTS[options.client](options.port, Meter(options.seconds))
        return
    rounds = [{client: microseconds(client, options.seconds) for client in CLIENTS} for _ in range(options.rounds)]
    for client in CLIENTS:
        cost_us = statistics.median(r[client][0] for r in rounds)
        rate_hz = statistics.median(r[client][1] for r in rounds)
        share = ""
        if client not in (OURS, OURS_QUIET):
            ratios = [statistics.median(r[ours][0] / r[client][0] for r in rounds) for ours in (OURS, OURS_QUIET)]
            share = "   ours of it {:.2f}, streams set up {:.2f}".format(*ratios)
        print(  # noqa: T201
            f"{client:27} {cost_us:6.0f} us a position, {cost_us * 50e-4:5.2f} % of a core at 50 Hz"
            f" ({rate_hz:.0f} a second came){share}"
        )


if __name__ == "__main__":
    main()
