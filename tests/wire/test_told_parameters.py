"""A PX4's parameter is the same number to the companion and to the launcher, for every four bytes that it may be."""

import struct

from hypothesis import example, given
from hypothesis import strategies as st
from test_mavlink import SYSTEM_ID, read

from companion.wire import mavlink as wire
from companion.wire.mavlink import MavlinkCodec
from companion.wire.px4 import PARAMETER_INT32, PARAMETER_REAL32
from sim.launch.sitl import told_value


def agree(raw: bytes, kind: int, value: float | int) -> None:
    frame = wire.PARAM_VALUE.pack((raw, 1, 0, b"COM_ANY", kind), 0, SYSTEM_ID, 1)
    assert MavlinkCodec(SYSTEM_ID).decode(frame) == [wire.ParameterValue("COM_ANY", value)]
    told = told_value(read(frame))
    assert (told, type(told)) == (value, type(value))


@given(st.integers(-(1 << 31), (1 << 31) - 1))
@example(-1)
@example(-8_388_607)  # its bytes are a signalling NaN's
@example(2_139_095_041)  # likewise
def test_an_integer_comes_bytewise_in_a_float(value: int) -> None:
    agree(struct.pack("<i", value), PARAMETER_INT32, value)


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_a_float_comes_as_it_is(value: float) -> None:
    agree(struct.pack("<f", value), PARAMETER_REAL32, value)
