"""Giving an autopilot its signing key, and seeing that it signs by it."""

from pathlib import Path

from companion.config import FleetConfig
from companion.config.derived import Vehicle
from companion.errors import CompanionError
from companion.io.check import listen
from companion.io.clock import FleetClock
from companion.io.signed_link import open_link
from companion.io.signing_key import SignedTime, read_key
from companion.vehicle.autopilot.adapters import open_autopilot
from companion.wire.mavlink import MavlinkCodec
from companion.wire.signing import ticks_at

HEARD_S = 3.0
LEARNED_S = 0.5
PROVED_S = 4.0
TIMES = 3
"""SETUP_SIGNING has no answer: it is sent so often"""


def give_key(config: FleetConfig, vehicle: Vehicle, key_file: Path, old: Path | None) -> str:
    """Send SETUP_SIGNING over the vehicle's link and listen for signed frames; what to tell, or CompanionError.

    `old`: the key that the autopilot signs by now; PX4 takes a new one from nobody else.
    """
    key, clock = read_key(key_file), FleetClock()
    link = open_link(vehicle, old)
    try:
        autopilot = open_autopilot(config, vehicle)
        listen(link, autopilot, clock, HEARD_S)
        if autopilot.heartbeat_ns is None:
            raise CompanionError(f"vehicle {vehicle.id}: no autopilot is heard on {vehicle.mavlink}")
        if autopilot.armed:
            raise CompanionError(f"vehicle {vehicle.id} is armed: an autopilot takes no key then; disarm it")
        ticks = max(ticks_at(clock.now().fleet_ns), SignedTime(key_file).not_before)
        setup = MavlinkCodec(vehicle.system_id).set_up_signing(key, ticks)
        for _ in range(TIMES if old is None else 1):
            link.send(setup)
        listen(link, autopilot, clock, LEARNED_S)
    finally:
        link.close()
    link = open_link(vehicle, key_file)
    try:
        autopilot = open_autopilot(config, vehicle)
        listen(link, autopilot, clock, PROVED_S)
        told = ", ".join(f"{count} {why}" for why, count in link.refused.items() if count)
    finally:
        link.close()
    if autopilot.position_ns is None:
        raise CompanionError(
            f"vehicle {vehicle.id} does not sign by {key_file} (not believed: {told or 'nothing came'}): PX4 takes "
            "keys since v1.18; one that has a key takes another only with --old (docs/signing.md)"
        )
    return f"vehicle {vehicle.id} signs by {key_file}"
