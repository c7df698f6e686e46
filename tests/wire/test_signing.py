"""MAVLink 2 signing beside pymavlink's: what is believed, what is not, and what is learned from neither."""

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as dialect

from companion.wire.mavlink import COMMAND_LONG, HEARTBEAT, SENT, SET_POSITION_TARGET_LOCAL_NED
from companion.wire.signing import (
    AHEAD_LIMIT_S,
    EPOCH_UNIX_NS,
    NEW_STREAM_LIMIT_S,
    STREAMS_MOST,
    TICKS_PER_S,
    Refused,
    SigningClock,
    Verifier,
    extras_of,
    signed,
    ticks_at,
)

KEY, OTHER = bytes(range(32)), bytes(range(1, 33))
NOW_NS = 1_790_000_000_000_000_000
NOW = ticks_at(NOW_NS)
EXTRAS = extras_of(*SENT)


def frame(system: int = 1, component: int = 191, sequence: int = 0) -> bytes:
    return COMMAND_LONG.pack((1, 0, 0, 0, 0, 0, 0, 400, 1, 1, 0), sequence, system, component)


def by(key: bytes, ticks: int, link: int = 1, **more: int) -> bytes:
    return signed(key, frame(**more), COMMAND_LONG.extra, link, ticks)


def verifier(ahead_s: float | None = None, wall_ns: int = NOW_NS) -> Verifier:
    return Verifier(KEY, SigningClock(lambda: wall_ns), ahead_s)


def with_key(key: bytes, ticks: int, link: int = 1) -> Any:
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=191)
    mav.signing.secret_key = key
    mav.signing.link_id = link
    mav.signing.sign_outgoing = True
    mav.signing.timestamp = ticks
    return mav


@given(st.binary(min_size=32, max_size=32), st.integers(1, (1 << 48) - 1), st.integers(0, 255), st.integers(0, 255))
def test_a_signature_is_the_one_that_pymavlink_makes(key: bytes, ticks: int, link: int, sequence: int) -> None:
    mav = with_key(key, ticks, link)
    mav.seq = sequence
    theirs = bytes(dialect.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0).pack(mav))
    assert signed(key, frame(sequence=sequence), COMMAND_LONG.extra, link, ticks) == theirs


@pytest.mark.parametrize("layout", SENT, ids=lambda layout: str(layout.message_id))
def test_every_message_of_ours_is_read_by_pymavlink_with_the_key_and_by_nobody_else(layout: Any) -> None:
    values = [0] * len(layout.fields.unpack(bytes(layout.fields.size)))
    values = [b"" if isinstance(x, bytes) else 0 for x in layout.fields.unpack(bytes(layout.fields.size))]
    datagram = signed(KEY, layout.pack(tuple(values), 7, 1, 191), EXTRAS[layout.key], 1, NOW)
    for key, believed in ((KEY, True), (OTHER, False)):
        reader = with_key(key, 1)
        reader.robust_parsing = True
        (message,) = reader.parse_buffer(datagram)
        assert (message.get_type() != "BAD_DATA") == believed


def test_what_is_genuine_is_believed_once_and_in_order() -> None:
    one = verifier()
    assert one.judge(by(KEY, NOW)) is None
    assert one.judge(by(KEY, NOW)) is Refused.REPLAYED
    assert one.judge(by(KEY, NOW - 1)) is Refused.REPLAYED
    assert one.judge(by(KEY, NOW + 1)) is None
    assert one.judge(frame()) is Refused.UNSIGNED
    assert one.judge(by(OTHER, NOW + 2)) is Refused.WRONG_SIGNATURE
    assert one.judge(by(KEY, NOW, link=2)) is None, "another link has a time of its own"


@given(st.data())
@settings(max_examples=300)
def test_any_bit_that_is_changed_is_noticed(data: st.DataObject) -> None:
    datagram = bytearray(by(KEY, NOW))
    at = data.draw(st.integers(1, len(datagram) - 1))
    datagram[at] ^= 1 << data.draw(st.integers(0, 7))
    assert verifier().judge(bytes(datagram)) in (Refused.WRONG_SIGNATURE, Refused.UNSIGNED)


def test_a_forged_frame_from_the_future_does_not_shut_out_the_genuine_stream() -> None:
    one = verifier()
    assert one.judge(by(KEY, NOW)) is None
    assert one.judge(by(OTHER, NOW + 1000 * TICKS_PER_S)) is Refused.WRONG_SIGNATURE
    assert one.judge(by(KEY, NOW + 1)) is None


@pytest.mark.parametrize(("behind", "why"), [(0, None), (NEW_STREAM_LIMIT_S * TICKS_PER_S, None),
                                             (NEW_STREAM_LIMIT_S * TICKS_PER_S + 1, Refused.TOO_OLD)])  # fmt: skip
def test_a_stream_that_is_new_may_begin_a_minute_behind_and_no_more(behind: int, why: Refused | None) -> None:
    assert verifier().judge(by(KEY, NOW - behind)) is why


@pytest.mark.parametrize(("ahead", "why"), [(0, None), (AHEAD_LIMIT_S * TICKS_PER_S, None),
                                            (AHEAD_LIMIT_S * TICKS_PER_S + 1, Refused.AHEAD)])  # fmt: skip
def test_a_companion_believes_nothing_that_is_dated_far_ahead_and_px4_does(ahead: int, why: Refused | None) -> None:
    assert verifier(AHEAD_LIMIT_S).judge(by(KEY, NOW + ahead)) is why
    assert verifier().judge(by(KEY, NOW + ahead)) is None


def test_streams_are_bounded() -> None:
    one = verifier()
    assert [one.judge(by(KEY, NOW, system=k + 1)) for k in range(STREAMS_MOST)] == [None] * STREAMS_MOST
    assert one.judge(by(KEY, NOW, system=200)) is Refused.STREAMS
    assert one.judge(by(KEY, NOW + 1, system=1)) is None


@given(st.lists(st.tuples(st.integers(-(10**12), 10**12), st.integers(0, 10**9)), min_size=1, max_size=60))
def test_a_number_is_never_given_twice_nor_before_what_was_heard(steps: list[tuple[int, int]]) -> None:
    wall = [NOW_NS]
    clock = SigningClock(lambda: wall[0], 5)
    last = 5
    for jump_ns, heard in steps:
        wall[0] += jump_ns
        given_ = clock.next()
        assert given_ > last
        clock.heard(NOW + heard)
        assert clock.now() >= NOW + heard
        last = max(given_, NOW + heard)


def test_time_begins_in_2015_and_never_before() -> None:
    assert ticks_at(EPOCH_UNIX_NS + 1_000_000_000) == TICKS_PER_S
    assert ticks_at(0) == 0


@given(st.binary(max_size=60))
def test_whatever_is_no_frame_is_not_believed_and_raises_nothing(junk: bytes) -> None:
    assert junk == b"" or verifier().judge(junk.ljust(3, b"\0")) is not None


def test_layouts_of_what_is_sent_have_extras_of_their_own() -> None:
    assert len(EXTRAS) == len(SENT)
    assert EXTRAS[HEARTBEAT.key] == HEARTBEAT.extra
    assert EXTRAS[SET_POSITION_TARGET_LOCAL_NED.key] == SET_POSITION_TARGET_LOCAL_NED.extra
