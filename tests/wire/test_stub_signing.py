"""The stub demands signed MAVLink as PX4 does since v1.18."""

from typing import Any

import pytest
from autopilot_flight import UTC_OFFSET_NS, Flight, mavlink

from companion.wire.mavlink import COMMAND_LONG, SET_POSITION_TARGET_LOCAL_NED
from companion.wire.signing import Refused, signed, ticks_at
from sim.autopilot.modes import Mode

KEY, NEW = bytes(range(1, 33)), bytes(range(2, 34))
NOW = ticks_at(UTC_OFFSET_NS)
ARM = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 400, 1, 1, 0)


class SignedFlight(Flight):
    """What is sent is signed by `key`, or not at all."""

    def __init__(self, key: bytes | None, **more: Any) -> None:
        super().__init__(px4="1.18", **more)
        self.key = key
        self.stamp = NOW
        self._parser.signing.secret_key = key
        self._parser.signing.allow_unsigned_callback = None

    def send(self, message: Any, *, system: int = 1, component: int = 191) -> None:
        if self.key is None:
            super().send(message, system=system, component=component)
            return
        self.stamp += 1
        self._sender.srcSystem, self._sender.srcComponent = system, component
        frame = bytes(message.pack(self._sender))
        extra = bytes((message.crc_extra,))
        self.autopilot.receive(signed(self.key, frame, extra, 1, self.stamp), self.now_ns)


def flying(key: bytes | None = KEY) -> SignedFlight:
    flight = SignedFlight(key, signing_key=KEY)
    flight.run(5.0)
    return flight


def arm(key: bytes | None, ticks: int, layout: Any = COMMAND_LONG) -> bytes:
    frame = layout.pack(ARM, 0, 1, 191)
    return frame if key is None else signed(key, frame, layout.extra, 1, ticks)


def test_a_signed_companion_flies_it_from_take_off_to_offboard() -> None:
    flight = flying()
    flight.take_off()
    flight.go_offboard()
    assert flight.mode is Mode.OFFBOARD
    assert flight.autopilot.signing.rejected == {}
    assert all(d[2] & 1 for d in flight.datagrams), "it signs all that it says"


@pytest.mark.parametrize(
    ("datagram", "why"),
    [
        (arm(None, 0), Refused.UNSIGNED),
        (arm(NEW, NOW + 100), Refused.WRONG_SIGNATURE),
        (arm(NEW, NOW + 10**9), Refused.WRONG_SIGNATURE),
        (arm(KEY, NOW), Refused.REPLAYED),
    ],
    ids=["unsigned", "wrong key", "wrong key, from the future", "replayed"],
)
def test_what_an_impostor_sends_is_not_obeyed_and_counted_and_the_owner_is_heard_on(
    datagram: bytes, why: Refused
) -> None:
    flight = flying()
    assert flight.set_mode(Mode.LOITER) == 0
    flight.autopilot.receive(datagram, flight.now_ns)
    flight.run(1.5)
    assert not flight.armed
    assert flight.autopilot.signing.rejected == {why: 1}
    assert flight.arm() == 0


def test_forged_setpoints_do_not_keep_offboard_alive() -> None:
    flight = flying()
    flight.take_off()
    flight.go_offboard()
    fields = [0] * len(SET_POSITION_TARGET_LOCAL_NED.fields.unpack(bytes(SET_POSITION_TARGET_LOCAL_NED.fields.size)))
    fields[12:16] = [0x9C7, 1, 1, 1]
    for _ in range(150):
        flight.autopilot.receive(SET_POSITION_TARGET_LOCAL_NED.pack(tuple(fields), 0, 1, 191), flight.now_ns)
        flight.run(0.02)
    assert flight.mode is not Mode.OFFBOARD
    assert flight.autopilot.signing.rejected[Refused.UNSIGNED] == 150


def setup(key: bytes, ticks: int) -> Any:
    return mavlink.MAVLink_setup_signing_message(1, 1, list(key), ticks)


def test_a_key_is_taken_from_anybody_while_there_is_none_and_then_from_its_owner_alone() -> None:
    flight = SignedFlight(None)
    flight.run(5.0)
    assert flight.arm() == 0
    flight.send(setup(KEY, NOW))
    assert not flight.autopilot.signing.active, "never while armed"
    assert flight.autopilot.rejected["signing while armed"] == 1
    assert flight.disarm() == 0
    flight.send(setup(KEY, NOW))
    assert flight.autopilot.signing.active
    flight.send(setup(NEW, NOW))
    assert flight.autopilot.signing.rejected == {Refused.UNSIGNED: 1}
    flight.key = flight._parser.signing.secret_key = KEY
    assert flight.arm() == 0
    assert flight.disarm() == 0
    flight.send(setup(NEW, NOW))
    flight.key = flight._parser.signing.secret_key = NEW
    assert flight.arm() == 0
    assert flight.disarm() == 0
    flight.send(setup(bytes(32), 0))
    assert not flight.autopilot.signing.active, "a blank one, signed, ends it"


def test_a_heartbeat_needs_no_signature() -> None:
    flight = flying(None)
    flight.send(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
    assert flight.autopilot.signing.rejected == {}


def test_a_boot_keeps_the_key() -> None:
    flight = flying()
    flight.autopilot.reboot()
    flight.run(5.0)
    assert flight.autopilot.signing.active
    assert flight.arm() == 0


def test_a_version_that_signs_nothing_takes_no_key() -> None:
    with pytest.raises(ValueError, match="signs nothing"):
        Flight(px4="1.17", signing_key=KEY)
    flight = Flight(px4="1.16")
    flight.run(5.0)
    flight.send(setup(KEY, NOW))
    assert not flight.autopilot.signing.active
