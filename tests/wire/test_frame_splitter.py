"""A serial line's bytes become frames, however they are cut and whatever lies between them."""

from itertools import pairwise
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as dialect

from companion.wire.mavlink import Heartbeat, LocalPosition, MavlinkCodec
from companion.wire.mavlink_frames import FrameSplitter

SYSTEM_ID = 7


def frames(count: int) -> list[bytes]:
    """Positions and heartbeats as PX4 packs them: zeros at the end cut off, so that lengths differ."""
    sender: Any = dialect.MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=1)
    made = []
    for k in range(count):
        message = dialect.MAVLink_local_position_ned_message(1000 + k, k, -k, -10.0, 0.5, 0.0, 0.25 * (k % 2))
        made.append(bytes(message.pack(sender)))
        sender.seq = (sender.seq + 1) % 256
        if k % 5 == 0:
            made.append(bytes(dialect.MAVLink_heartbeat_message(2, 12, 81, 65536, 3, 3).pack(sender)))
    return made


def pieces(stream: bytes, cuts: list[int]) -> list[bytes]:
    """The stream cut at those places."""
    places = sorted({0, len(stream), *(c % (len(stream) + 1) for c in cuts)})
    return [stream[a:b] for a, b in pairwise(places)]


@given(st.integers(1, 20), st.lists(st.integers(0, 10_000), max_size=60))
def test_frames_come_out_as_they_went_in_wherever_the_reads_are_cut(count: int, cuts: list[int]) -> None:
    sent = frames(count)
    splitter = FrameSplitter()
    assert [f for piece in pieces(b"".join(sent), cuts) for f in splitter.split(piece)] == sent
    assert splitter.dropped == 0


@given(st.binary(max_size=300), st.lists(st.integers(0, 10_000), max_size=20))
def test_after_noise_the_frames_are_found_again(noise: bytes, cuts: list[int]) -> None:
    """A frame that noise pretends is at most 280 bytes long, so eight positions later it is over."""
    sent = frames(40)
    splitter = FrameSplitter()
    got = [f for piece in pieces(noise + b"".join(sent), cuts) for f in splitter.split(piece)]
    assert got[-25:] == sent[-25:]


@given(st.integers(0, 1500), st.integers(0, 255), st.lists(st.integers(0, 10_000), max_size=20))
def test_a_damaged_byte_costs_few_frames_and_none_is_read_wrongly(at: int, value: int, cuts: list[int]) -> None:
    sent = frames(40)
    stream = bytearray(b"".join(sent))
    stream[at] = value
    splitter, link = FrameSplitter(), MavlinkCodec(SYSTEM_ID)
    got = [f for piece in pieces(bytes(stream), cuts) for f in splitter.split(piece)]
    events = [e for f in got for e in link.decode(f)]
    genuine = [e for f in sent for e in MavlinkCodec(SYSTEM_ID).decode(f)]
    assert all(e in genuine for e in events)
    assert len(events) >= len(genuine) - 9


def test_mavlink_1_is_read_too_as_px4_begins_with_it_on_a_serial_line() -> None:
    sender: Any = dialect.MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=1)
    heartbeat = bytes(dialect.MAVLink_heartbeat_message(2, 12, 81, 65536, 3, 3).pack(sender, force_mavlink1=True))
    assert heartbeat[0] == 0xFE
    splitter, link = FrameSplitter(), MavlinkCodec(SYSTEM_ID)
    got = splitter.split(heartbeat + frames(1)[0])
    events = [e for f in got for e in link.decode(f)]
    assert [type(e) for e in events] == [Heartbeat, LocalPosition]
    assert not link.rejected


def test_nothing_grows_while_noise_goes_on() -> None:
    splitter = FrameSplitter()
    for _ in range(100):
        splitter.split(b"\x55" * 1000)
    assert splitter.dropped >= 99_990
    assert splitter.split(frames(1)[0])[:1] == frames(1)[:1]
