"""The stubs' frames are pymavlink's to the byte."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as dialect
from test_mavlink import HEARD, SYSTEM_ID, autopilot, packed, read, resigned

from sim.autopilot import packing


@pytest.mark.parametrize("message", [message for message, _ in HEARD], ids=lambda m: str(m.get_type()))
def test_frames_are_packed_to_the_byte_as_pymavlink_packs_them(message: Any) -> None:
    sender = autopilot()
    for sequence in (0, 255):
        sender.seq = sequence
        assert packing.packed(message, sender) == packed(message, sender)


@given(st.binary(max_size=255), st.sampled_from([32, 84, 245, 436]))
def test_a_frames_fields_are_unpacked_as_pymavlink_unpacks_them(payload: bytes, message_id: int) -> None:
    kind = dialect.mavlink_map[message_id]
    datagram = resigned(message_id, kind.crc_extra, payload, (SYSTEM_ID, 1))
    values = packing.unpacked(kind, datagram)
    told = read(datagram)
    assert values is not None
    assert repr(values) == repr(tuple(getattr(told, name) for name in kind.ordered_fieldnames))
    damaged = bytearray(datagram)
    damaged[-1] ^= 1
    assert packing.unpacked(kind, bytes(damaged)) is None
