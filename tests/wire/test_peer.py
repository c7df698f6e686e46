"""Peer messages: what goes in comes out, and whatever else comes in is refused in one way."""

import json
import struct
from dataclasses import replace
from math import inf, nan, pi
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from companion.core.frames import Ned
from companion.core.law.base import FIELDS_MAX
from companion.core.trajectory.fleet import FleetTrajectory
from companion.core.trajectory.goto import GOTO_MIN_S
from companion.core.trajectory.legs import FreeLeg, GotoLeg, Leg, TurnLeg, VelocityLeg
from companion.core.trajectory.slots import BLEND_MIN_S, SlotChange
from companion.core.trajectory_check import (
    DURATION_MAX_S,
    MOTION_BYTES_MAX,
    PLACE_MAX_M,
    TURN_ANGLE_MAX_RAD,
    TURN_ANGLE_MIN_RAD,
    TURN_RATE_MAX_RAD_S,
    TURN_RATE_MIN_RAD_S,
    VELOCITY_MAX_M_S,
)
from companion.core.values import CommonMotion, PeerMessage, PeerSample, Phase
from companion.errors import WireError
from companion.wire.peer import (
    COMMON,
    COMMON_MAX,
    PLAUSIBLE_MAX,
    VERSION,
    decode_motion,
    decode_state,
    encode_motion,
    encode_state,
)

bytes_8 = st.integers(0, 255)
words = st.integers(0, 2**32 - 1)
times = st.integers(-(2**63), 2**63 - 1)
singles = st.floats(-PLAUSIBLE_MAX, PLAUSIBLE_MAX, width=32)
vectors = st.builds(Ned, singles, singles, singles)
rates_and_speeds = st.floats(-COMMON_MAX, COMMON_MAX, width=32)
commons = st.none() | st.builds(CommonMotion, *[rates_and_speeds] * 4)
samples = st.builds(PeerSample, bytes_8, times, vectors, vectors, words, st.sampled_from(Phase), commons)


def with_numbers(message: PeerMessage, numbers: list[float]) -> PeerMessage:
    """A message of a fleet whose law tells so many numbers with each sample, not the same of each."""
    own, *others = (
        s._replace(told=tuple(numbers[-k % len(numbers) :] + numbers[: -k % len(numbers)]) if numbers else ())
        for k, s in enumerate((message.sample, *message.digest))
    )
    return replace(message, sample=own, digest=tuple(others))


near_ids = st.sets(bytes_8, max_size=12).map(lambda ids: tuple(sorted(ids)))
messages = st.builds(
    with_numbers,
    st.builds(
        PeerMessage, words, words, times, bytes_8, samples, st.lists(samples, max_size=6).map(tuple), near_ids,
        st.booleans(),
    ),
    st.lists(singles, max_size=FIELDS_MAX),
)  # fmt: skip

metres = st.floats(-PLACE_MAX_M, PLACE_MAX_M)
places = st.builds(Ned, metres, metres, metres)
speeds = st.floats(-VELOCITY_MAX_M_S, VELOCITY_MAX_M_S)
velocities = st.builds(Ned, speeds, speeds, speeds)
turning = st.floats(-TURN_RATE_MAX_RAD_S, TURN_RATE_MAX_RAD_S)
rates = turning.filter(lambda rate: abs(rate) >= TURN_RATE_MIN_RAD_S)
seconds = st.floats(0.0, DURATION_MAX_S)
legs: st.SearchStrategy[Leg] = st.one_of(
    st.builds(VelocityLeg, velocities, seconds),
    st.builds(TurnLeg, rates, st.floats(TURN_ANGLE_MIN_RAD, TURN_ANGLE_MAX_RAD) | st.just(inf)),
    st.builds(GotoLeg, places, st.floats(GOTO_MIN_S, DURATION_MAX_S)),
    st.just(FreeLeg()),
)
nanoseconds = st.integers(0, 2**63 - 1)
motions = st.builds(
    FleetTrajectory,
    revision=words, start_ns=nanoseconds, issuer=bytes_8, shape=st.text(max_size=32),
    slots=st.dictionaries(st.integers(1, 250), st.builds(SlotChange, places, places), min_size=1, max_size=5),
    blend_start_ns=nanoseconds, blend_s=st.just(0.0) | st.floats(BLEND_MIN_S, DURATION_MAX_S),
    legs_start_ns=nanoseconds,
    centre_ned_m=places, velocity_ned_m_s=velocities, heading_rad=st.floats(-pi, pi),
    heading_rate_rad_s=turning, heading_follows_turns=st.booleans(),
    legs=st.lists(legs, max_size=4).map(tuple), then=st.sampled_from(("stay", "land")),
)  # fmt: skip

SAMPLE = PeerSample(3, 1_700_000_000_000_000_000, Ned(1.0, 2.0, -10.0), Ned(0.5, 0.25, 0.0), 2, Phase.FORMED)
MESSAGE = PeerMessage(7, 9, 1_700_000_000_000_000_000, 4, SAMPLE, (SAMPLE, SAMPLE), (2, 4), True)
FLAGS_AT = 25
MOTION = FleetTrajectory(
    revision=2, start_ns=5, issuer=3, shape="v", slots={1: SlotChange(Ned(0, 4, 0), Ned(0, 4, 0))}, blend_start_ns=1,
    blend_s=8.0, legs_start_ns=5, centre_ned_m=Ned(0.0, 0.0, -10.0), velocity_ned_m_s=Ned(0.0, 0.0, 0.0),
    heading_rad=0.1, heading_rate_rad_s=0.0, heading_follows_turns=False,
    legs=(VelocityLeg(Ned(1.0, 0.0, 0.0), 5.0), TurnLeg(0.1, inf), GotoLeg(Ned(1.0, 2.0, -9.0), 30.0)), then="land",
)  # fmt: skip


# -- states ------------------------------------------------------------------------------------------------------------


@given(messages)
def test_a_state_survives_the_wire_to_the_bit(message: PeerMessage) -> None:
    assert decode_state(encode_state(message)) == message


@given(st.builds(Ned, *[st.floats(-1e5, 1e5)] * 3))
def test_a_state_on_the_wire_is_the_nearest_single(position: Ned) -> None:
    sample = PeerSample(1, 0, position, position, 0, Phase.IDLE)
    sent = decode_state(encode_state(PeerMessage(0, 0, 0, 0, sample, ()))).sample
    assert tuple(sent.position_ned_m) == tuple(float(np.float32(x)) for x in position)


def test_a_state_costs_what_is_said_of_it() -> None:
    alone = len(encode_state(PeerMessage(0, 0, 0, 0, SAMPLE, ())))
    assert alone == 59
    assert len(encode_state(MESSAGE)) == alone + 2 * 38 + 2


def test_a_common_motion_costs_17_bytes_a_sample_and_one_for_all() -> None:
    told = SAMPLE._replace(common=CommonMotion(1.0, 0.0, 0.5, 0.0))
    message = replace(MESSAGE, sample=told, digest=(SAMPLE, told))
    assert len(encode_state(message)) == len(encode_state(MESSAGE)) + 1 + 2 * 17


def test_a_laws_numbers_cost_4_bytes_each_a_sample_and_one_for_all() -> None:
    told = SAMPLE._replace(told=(1.0, 2.0))
    message = replace(MESSAGE, sample=told, digest=(told, told))
    assert len(encode_state(message)) == len(encode_state(MESSAGE)) + 1 + 3 * 8


@pytest.mark.parametrize(
    ("tail", "kind"),
    [
        (b"\x00", "length"),
        (b"\x04" + 4 * struct.pack("<B4f", 0, 0.0, 0.0, 0.0, 0.0), "length"),
        (b"\x01" + struct.pack("<B4f", 3, 0.0, 0.0, 0.0, 0.0), "common"),
        (b"\x02" + 2 * struct.pack("<B4f", 1, 0.0, 0.0, 0.0, 0.0), "common"),
        (b"\x01" + struct.pack("<B4f", 0, nan, 0.0, 0.0, 0.0), "not finite"),
        (b"\x01" + struct.pack("<B4f", 0, 20.1, 0.0, 0.0, 0.0), "out of range"),
        (b"\x01" + struct.pack("<B4f", 0, 1.0, 0.0, 0.0, 0.0) + b"\x00", "length"),
    ],
)
def test_a_damaged_common_motion_is_refused(tail: bytes, kind: str) -> None:
    payload = bytearray(encode_state(MESSAGE))
    payload[FLAGS_AT] |= COMMON
    with pytest.raises(WireError) as refused:
        decode_state(bytes(payload) + tail)
    assert refused.value.kind == kind


@pytest.mark.parametrize("near", [(4, 2), (2, 2)])
def test_near_ids_out_of_order_or_twice_are_refused(near: tuple[int, ...]) -> None:
    with pytest.raises(WireError, match="near ids"):
        decode_state(encode_state(replace(MESSAGE, near_ids=near)))


def test_a_flag_that_nobody_knows_is_refused() -> None:
    payload = bytearray(encode_state(MESSAGE))
    assert payload[FLAGS_AT] == 1
    payload[FLAGS_AT] = 1 | 8
    with pytest.raises(WireError, match="flags"):
        decode_state(bytes(payload))


@pytest.mark.parametrize("count", [0, 2, 4, FIELDS_MAX + 1, 255])
def test_numbers_of_a_law_that_are_not_as_many_as_they_say_are_refused(count: int) -> None:
    payload = bytearray(encode_state(replace(MESSAGE, sample=SAMPLE._replace(told=(1.0, 2.0, 3.0)), digest=())))
    payload[-13] = count
    with pytest.raises(WireError, match="length"):
        decode_state(bytes(payload))


@pytest.mark.parametrize(("number", "kind"), [(nan, "not finite"), (inf, "not finite"), (2e6, "out of range")])
def test_a_number_of_a_law_that_is_none_is_refused(number: float, kind: str) -> None:
    with pytest.raises(WireError, match=kind):
        decode_state(encode_state(replace(MESSAGE, sample=SAMPLE._replace(told=(0.0, number)), digest=())))


@given(messages, st.data())
def test_a_truncated_state_is_refused(message: PeerMessage, data: st.DataObject) -> None:
    payload = encode_state(message)
    cut = data.draw(st.integers(0, len(payload) - 1))
    with pytest.raises(WireError):
        decode_state(payload[:cut])


@given(messages, st.binary(min_size=1, max_size=80))
def test_a_state_with_something_behind_it_is_refused(message: PeerMessage, more: bytes) -> None:
    with pytest.raises(WireError, match="length"):
        decode_state(encode_state(message) + more)


def check_state(payload: bytes) -> None:
    """A payload is a valid message or a WireError; the valid one is finite and within range."""
    try:
        message = decode_state(payload)
    except WireError:
        return
    for sample in (message.sample, *message.digest):
        assert all(abs(x) <= PLAUSIBLE_MAX for x in (*sample.position_ned_m, *sample.velocity_ned_m_s))
        assert isinstance(sample.phase, Phase)
    assert encode_state(message) == payload


def test_any_single_bit_of_a_state_may_flip_without_another_error() -> None:
    payload = encode_state(MESSAGE)
    for bit in range(8 * len(payload)):
        flipped = bytearray(payload)
        flipped[bit // 8] ^= 1 << bit % 8
        check_state(bytes(flipped))


@given(st.binary(max_size=400))
def test_any_bytes_are_a_state_or_refused(payload: bytes) -> None:
    check_state(payload)
    check_state(bytes([VERSION]) + payload)


@pytest.mark.parametrize("version", [0, 1, 2, 255])
def test_a_state_of_another_version_is_refused_as_such(version: int) -> None:
    with pytest.raises(WireError, match="version"):
        decode_state(bytes([version]) + encode_state(MESSAGE)[1:])


@pytest.mark.parametrize("entries", [0, 1, 3, 255])
def test_a_digest_that_lies_about_its_length_is_refused(entries: int) -> None:
    payload = bytearray(encode_state(MESSAGE))
    payload[3] = entries
    with pytest.raises(WireError, match="length"):
        decode_state(bytes(payload))


@pytest.mark.parametrize("phase", [len(Phase), 100, 255])
def test_an_unknown_phase_is_refused_in_the_sample_and_in_the_digest(phase: int) -> None:
    for at in (2, 60):
        payload = bytearray(encode_state(MESSAGE))
        payload[at] = phase
        with pytest.raises(WireError, match="phase"):
            decode_state(bytes(payload))


@pytest.mark.parametrize(("value", "reason"), [(nan, "finite"), (inf, "finite"), (-inf, "finite"), (3e38, "range")])
@pytest.mark.parametrize("at", [*range(35, 59, 4), *range(73, 97, 4)])
def test_a_number_that_is_not_finite_or_absurd_is_refused_wherever_it_stands(
    value: float, reason: str, at: int
) -> None:
    payload = bytearray(encode_state(MESSAGE))
    struct.pack_into("<f", payload, at, value)
    with pytest.raises(WireError, match=reason):
        decode_state(bytes(payload))


# -- motions -----------------------------------------------------------------------------------------------------------


@given(motions)
def test_a_motion_survives_the_wire_to_the_bit(motion: FleetTrajectory) -> None:
    assert decode_motion(encode_motion(motion)) == motion


def test_a_motion_is_json_that_a_person_can_read() -> None:
    read = json.loads(encode_motion(MOTION))
    assert read["version"] == VERSION
    assert [leg["kind"] for leg in read["legs"]] == ["velocity", "turn", "goto"]
    assert read["legs"][1]["angle_rad"] is None


def check_motion(payload: bytes) -> None:
    """A payload is a valid motion, whose reference can be computed at any time, or a WireError."""
    try:
        motion = decode_motion(payload)
    except WireError:
        return
    decode_motion(encode_motion(motion))
    for time_ns in (0, motion.start_ns, motion.legs_start_ns, motion.end_ns or 0, 2**63):
        moment = motion.state_at(time_ns)
        for slots in motion.slots.values():
            for vector in moment.slot(slots)[:3]:
                assert all(abs(x) < 1e20 for x in vector), (time_ns, vector)


@settings(deadline=None)
@given(motions)
def test_a_motion_that_is_taken_has_a_finite_reference_at_every_time(motion: FleetTrajectory) -> None:
    check_motion(encode_motion(motion))


def test_any_truncation_and_any_single_bit_of_a_motion_makes_it_valid_or_refused() -> None:
    payload = encode_motion(MOTION)
    for cut in range(len(payload)):
        with pytest.raises(WireError):
            decode_motion(payload[:cut])
    for bit in range(8 * len(payload)):
        flipped = bytearray(payload)
        flipped[bit // 8] ^= 1 << bit % 8
        check_motion(bytes(flipped))


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)
NUMBERS = [
    ("revision",), ("start_ns",), ("issuer",), ("blend_start_ns",), ("blend_s",), ("legs_start_ns",),
    ("centre_ned_m", 0), ("velocity_ned_m_s", 1), ("heading_rad",), ("heading_rate_rad_s",),
    ("slots", "1", 0, 2), ("slots", "1", 1, 0),
    ("legs", 0, "velocity_ned_m_s", 0), ("legs", 0, "duration_s"), ("legs", 1, "rate_rad_s"), ("legs", 1, "angle_rad"),
    ("legs", 2, "target_ned_m", 1), ("legs", 2, "duration_s"),
]  # fmt: skip
FIELDS = [*NUMBERS, ("version",), ("shape",), ("slots",), ("slots", "1"), ("legs",), ("legs", 0), ("legs", 0, "kind"),
          ("heading_follows_turns",), ("then",), ("colour",)]  # fmt: skip


def with_value(path: tuple[str | int, ...], value: object) -> bytes:
    tree: Any = json.loads(encode_motion(MOTION))
    place = tree
    for part in path[:-1]:
        place = place[part]
    place[path[-1]] = value
    return json.dumps(tree).encode()


@settings(max_examples=400, deadline=None)
@given(st.sampled_from(FIELDS), json_values)
@example(("legs", 2, "duration_s"), 1e-300)
@example(("legs", 0, "duration_s"), 1e300)
@example(("heading_rate_rad_s",), 1e308)
@example(("legs", 1, "rate_rad_s"), 5e-324)
@example(("velocity_ned_m_s", 1), 1e200)
def test_a_motion_with_anything_in_one_place_is_valid_or_refused(path: tuple[str | int, ...], value: object) -> None:
    check_motion(with_value(path, value))


@pytest.mark.parametrize("path", NUMBERS)
@pytest.mark.parametrize("value", [nan, inf, -inf, 1e300, -1e300, "1", True, [], None])
def test_a_motions_number_that_is_none_is_refused(path: tuple[str | int, ...], value: object) -> None:
    if path == ("legs", 1, "angle_rad") and value is None:
        assert decode_motion(with_value(path, value)).legs[1] == TurnLeg(0.1, inf)
        return
    with pytest.raises(WireError, match="motion: "):
        decode_motion(with_value(path, value))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("version",), 1), (("colour",), 1), (("then",), "hover"), (("shape",), "x" * 33),
        (("slots", "1"), [[0, 0, 0]]), (("slots", "one"), [[0, 0, 0], [0, 0, 0]]),
        (("legs", 0, "kind"), "loop"), (("legs", 1, "rate_rad_s"), 0.0), (("legs", 1, "rate_rad_s"), 1e-5),
        (("legs", 1, "angle_rad"), 5e-324), (("legs", 2, "duration_s"), 0.5), (("blend_s",), 1e-200),
        (("slots",), {}), (("slots", "0"), [[0, 0, 0], [0, 0, 0]]), (("heading_rate_rad_s",), 1.1),
        (("legs", 0, "velocity_ned_m_s", 0), 12.1), (("centre_ned_m", 0), 1.1e5), (("legs", 0, "duration_s"), 86_401),
        (("legs",), [{"kind": "velocity", "velocity_ned_m_s": [0, 0, 0], "duration_s": 1}] * 101),
    ],
)  # fmt: skip
def test_a_motion_of_another_make_is_refused(path: tuple[str | int, ...], value: object) -> None:
    with pytest.raises(WireError, match="motion: "):
        decode_motion(with_value(path, value))


@pytest.mark.parametrize("payload", [b"", b"{}", b"null", b"[]", b"\xff\xfe", b"[" * 100_000, b'{"a":' * 100_000])
def test_bytes_that_are_no_motion_are_refused(payload: bytes) -> None:
    with pytest.raises(WireError, match="motion"):
        decode_motion(payload)


def test_a_motion_of_more_bytes_than_any_needs_is_refused_before_it_is_read() -> None:
    payload = encode_motion(MOTION)
    assert decode_motion(payload + b" " * (MOTION_BYTES_MAX - len(payload))) == MOTION
    with pytest.raises(WireError, match="bytes, may have"):
        decode_motion(payload + b" " * (MOTION_BYTES_MAX - len(payload) + 1))
