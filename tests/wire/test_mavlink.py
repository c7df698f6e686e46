"""The companion's MAVLink: what it says as any other parser reads it, and what it makes of anything it hears."""

import random
import struct
from collections.abc import Iterable
from math import inf, isfinite, nan
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as dialect

from companion.core.frames import Geodetic, Ned
from companion.wire import mavlink as wire
from companion.wire import px4
from companion.wire.mavlink import MavlinkCodec
from companion.wire.mavlink_frames import Layout
from companion.wire.px4 import Px4Mode, Software, mode_name

SYSTEM_ID = 7


def autopilot(system_id: int = SYSTEM_ID, component_id: int = 1) -> Any:
    """The other end: pymavlink as it comes, packing as the autopilot."""
    return dialect.MAVLink(None, srcSystem=system_id, srcComponent=component_id)


def packed(message: Any, sender: Any = None) -> bytes:
    return bytes(message.pack(autopilot() if sender is None else sender))


def read(datagram: bytes) -> Any:
    """One datagram as an independent parser reads it."""
    messages = dialect.MAVLink(None).parse_buffer(bytearray(datagram))
    assert messages is not None
    assert len(messages) == 1
    return messages[0]


def local_position(*numbers: float, boot_ms: int = 1000) -> Any:
    return dialect.MAVLink_local_position_ned_message(boot_ms, *numbers)


POSITION = (1.0, -2.0, -10.0, 0.5, 0.25, -0.125)
HEARD: list[tuple[Any, wire.Event]] = [
    (local_position(*POSITION), wire.LocalPosition(1000, Ned(1.0, -2.0, -10.0), Ned(0.5, 0.25, -0.125))),
    (
        dialect.MAVLink_heartbeat_message(2, 12, 128 | 1, int(Px4Mode.OFFBOARD), 4, 3),
        wire.Heartbeat(12, 2, True, int(Px4Mode.OFFBOARD)),
    ),
    (
        dialect.MAVLink_heartbeat_message(2, 3, 81, 4, 3, 3),
        wire.Heartbeat(3, 2, False, 4),
    ),
    (dialect.MAVLink_current_mode_message(0, int(Px4Mode.AUTO_LAND), 0), wire.CurrentMode(int(Px4Mode.AUTO_LAND), 0)),
    (dialect.MAVLink_extended_sys_state_message(0, 2), wire.LandedState(2)),
    (
        dialect.MAVLink_gps_global_origin_message(473977420, 85455940, 488000, 0),
        wire.GlobalOrigin(Geodetic(473977420 * 1e-7, 85455940 * 1e-7, 488.0)),
    ),
    (
        dialect.MAVLink_estimator_status_message(0, 0x33F, 0, 0, 0, 0, 0, 0, 0.5, 0.25),
        wire.EstimatorHealth(0x33F, 0.5),
    ),
    (
        dialect.MAVLink_estimator_status_message(0, 1, 0, 0, 0, 0, 0, 0, nan, inf),
        wire.EstimatorHealth(1, inf),
    ),
    (dialect.MAVLink_sys_status_message(0, 0, 5, 0, 0, 0, 80, 0, 0, 0, 0, 0, 0), wire.SystemHealth(5, 80)),
    (dialect.MAVLink_command_ack_message(176, 0, 0, 0, SYSTEM_ID, 191), wire.CommandAnswer(176, 0)),
]


# -- what the companion says -------------------------------------------------------------------------------------------


def test_a_setpoint_is_altitude_by_position_and_the_level_by_velocity_and_acceleration() -> None:
    link = MavlinkCodec(SYSTEM_ID)
    datagram = link.setpoint(123_456, -10.5, Ned(1.0, -2.0, 0.25), (3.0, -4.0), 0.5)
    message = read(datagram)
    assert message.get_type() == "SET_POSITION_TARGET_LOCAL_NED"
    assert datagram[0] == 0xFD
    assert (message.get_srcSystem(), message.get_srcComponent()) == (SYSTEM_ID, 191)
    assert (message.target_system, message.target_component) == (SYSTEM_ID, 1)
    assert message.coordinate_frame == dialect.MAV_FRAME_LOCAL_NED
    assert message.time_boot_ms == 123_456
    assert message.type_mask == 0x903
    assert (message.z, message.vx, message.vy, message.vz) == (-10.5, 1.0, -2.0, 0.25)
    assert (message.afx, message.afy, message.yaw) == (3.0, -4.0, 0.5)
    ignored = [bit for bit in range(16) if message.type_mask >> bit & 1]
    assert ignored == [0, 1, 8, 11]
    assert (message.x, message.y, message.afz, message.yaw_rate) == (0.0, 0.0, 0.0, 0.0)


def test_boot_time_in_a_setpoint_runs_round_the_counter() -> None:
    link = MavlinkCodec(SYSTEM_ID)
    assert read(link.setpoint(-1, 0.0, Ned(0.0, 0.0, 0.0), (0.0, 0.0), 0.0)).time_boot_ms == 2**32 - 1


def test_the_heartbeat_is_that_of_an_onboard_controller_of_the_same_system() -> None:
    message = read(MavlinkCodec(SYSTEM_ID).heartbeat())
    assert (message.get_srcSystem(), message.get_srcComponent()) == (SYSTEM_ID, 191)
    assert (message.type, message.autopilot) == (18, 8)
    assert (message.base_mode, message.system_status, message.mavlink_version) == (0, 4, 3)


def test_sequence_numbers_rise_by_one_with_every_datagram() -> None:
    link = MavlinkCodec(SYSTEM_ID)
    sequence = [
        read(d).get_seq() for _ in range(100) for d in (link.heartbeat(), link.command(400, 1.0), link.heartbeat())
    ]
    assert sequence == [k % 256 for k in range(300)]


@pytest.mark.parametrize(
    ("parameters", "command", "values"),
    [
        (px4.arm_parameters(True), 400, (1.0, 0, 0, 0, 0, 0, 0)),
        (px4.arm_parameters(False), 400, (0.0, 0, 0, 0, 0, 0, 0)),
        (px4.mode_parameters(Px4Mode.OFFBOARD), 176, (1.0, 6.0, 0.0, 0, 0, 0, 0)),
        (px4.mode_parameters(Px4Mode.AUTO_LAND), 176, (1.0, 4.0, 6.0, 0, 0, 0, 0)),
        (px4.interval_parameters(32, 50.0), 511, (32.0, 20_000.0, 0, 0, 0, 0, 0)),
        (px4.interval_parameters(30, 0.0), 511, (30.0, -1.0, 0, 0, 0, 0, 0)),
        (px4.request_message_parameters(49), 512, (49.0, 0, 0, 0, 0, 0, 0)),
        (px4.takeoff_parameters(498.0), 22, (nan, 0.0, 0.0, nan, nan, nan, 498.0)),
    ],
    ids=["arm", "disarm", "offboard", "land", "stream on", "stream off", "request", "take-off"],
)  # fmt: skip
def test_a_command_reaches_the_own_autopilot_with_its_parameters(
    parameters: tuple[float, ...], command: int, values: Iterable[float]
) -> None:
    number, *rest = parameters
    message = read(MavlinkCodec(SYSTEM_ID).command(int(number), *rest))
    assert message.get_type() == "COMMAND_LONG"
    assert (message.target_system, message.target_component, message.confirmation) == (SYSTEM_ID, 1, 0)
    assert message.command == command
    came = [getattr(message, f"param{k}") for k in range(1, 8)]
    assert came == pytest.approx(list(values), nan_ok=True)


# -- what it hears -----------------------------------------------------------------------------------------------------


def test_a_parameter_is_a_float_or_an_integer_bytewise_in_one() -> None:
    link = MavlinkCodec(SYSTEM_ID)
    number = struct.unpack("<f", struct.pack("<i", 3))[0]
    real = dialect.MAVLink_param_value_message(b"MPC_XY_P", 0.75, dialect.MAV_PARAM_TYPE_REAL32, 1, 0)
    integer = dialect.MAVLink_param_value_message(b"COM_RC_OVERRIDE", number, dialect.MAV_PARAM_TYPE_INT32, 1, 0)
    assert link.decode(packed(real)) == [wire.ParameterValue("MPC_XY_P", 0.75)]
    assert link.decode(packed(integer)) == [wire.ParameterValue("COM_RC_OVERRIDE", 3)]


@pytest.mark.parametrize(("message", "event"), HEARD, ids=[type(e).__name__ for _, e in HEARD])
def test_what_the_autopilot_says_is_understood(message: Any, event: wire.Event) -> None:
    link = MavlinkCodec(SYSTEM_ID)
    assert link.decode(packed(message)) == [event]
    assert not link.rejected


def test_several_messages_of_one_datagram_are_all_read() -> None:
    link, sender = MavlinkCodec(SYSTEM_ID), autopilot()
    datagram = b"".join(packed(message, sender) for message, _ in HEARD)
    assert link.decode(datagram) == [event for _, event in HEARD]
    assert not link.rejected


def test_mavlink_1_is_read_as_well() -> None:
    message = local_position(*POSITION)
    datagram = bytes(message.pack(autopilot(), force_mavlink1=True))
    assert datagram[0] == 0xFE
    assert MavlinkCodec(SYSTEM_ID).decode(datagram) == [HEARD[0][1]]


@pytest.mark.parametrize(("system_id", "component_id"), [(8, 1), (255, 190), (SYSTEM_ID, 191), (SYSTEM_ID, 0)])
def test_strangers_are_counted_and_not_heeded(system_id: int, component_id: int) -> None:
    link = MavlinkCodec(SYSTEM_ID)
    for message, _ in HEARD:
        assert link.decode(packed(message, autopilot(system_id, component_id))) == []
    assert link.rejected == {"foreign system": len(HEARD)}


def test_answers_to_somebody_elses_commands_are_none_of_ours() -> None:
    link = MavlinkCodec(SYSTEM_ID)
    assert link.decode(packed(dialect.MAVLink_command_ack_message(176, 0, 0, 0, 255, 190))) == []
    assert link.decode(packed(dialect.MAVLink_command_ack_message(176, 0))) == [wire.CommandAnswer(176, 0)]


@pytest.mark.parametrize("value", [nan, inf, -inf, 3e38, -1.1e6])
@pytest.mark.parametrize("at", range(6))
def test_a_position_that_is_not_finite_or_absurd_is_counted_and_dropped(value: float, at: int) -> None:
    link = MavlinkCodec(SYSTEM_ID)
    numbers = list(POSITION)
    numbers[at] = value
    assert link.decode(packed(local_position(*numbers))) == []
    assert sum(link.rejected.values()) == 1


@pytest.mark.parametrize(("latitude", "longitude"), [(900_000_001, 0), (-2_147_483_648, 0), (0, 1_800_000_001)])
def test_an_origin_that_is_nowhere_on_earth_is_counted_and_dropped(latitude: int, longitude: int) -> None:
    link = MavlinkCodec(SYSTEM_ID)
    assert link.decode(packed(dialect.MAVLink_gps_global_origin_message(latitude, longitude, 0, 0))) == []
    assert link.rejected == {"out of range": 1}


def test_messages_that_nobody_reads_are_left_undecoded() -> None:
    link, sender = MavlinkCodec(SYSTEM_ID), autopilot()
    attitude = dialect.MAVLink_attitude_message(0, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0)
    datagram = bytearray(packed(attitude, sender))
    assert link.decode(bytes(datagram)) == []
    # Their checksum is not even looked at: that is what makes them cheap.
    datagram[-1] ^= 0xFF
    assert link.decode(bytes(datagram)) == []
    assert link.not_read == 2
    assert not link.rejected


def test_any_single_bit_may_flip_and_the_next_datagram_is_read() -> None:
    whole = packed(local_position(*POSITION))
    for bit in range(8 * len(whole)):
        link = MavlinkCodec(SYSTEM_ID)
        flipped = bytearray(whole)
        flipped[bit // 8] ^= 1 << bit % 8
        assert link.decode(bytes(flipped)) == [], bit
        assert sum(link.rejected.values()) + link.not_read == 1, bit
        assert link.decode(whole) == [HEARD[0][1]], bit


def test_a_truncated_datagram_is_counted_and_takes_nothing_of_the_next() -> None:
    whole = packed(local_position(*POSITION))
    for cut in range(len(whole)):
        link = MavlinkCodec(SYSTEM_ID)
        assert link.decode(whole[:cut]) == []
        assert link.rejected == {"malformed": 1}
        assert link.decode(whole) == [HEARD[0][1]]


def test_a_message_that_is_cut_off_behind_a_whole_one_takes_nothing_of_the_next_datagram() -> None:
    whole = packed(local_position(*POSITION))
    for cut in range(1, len(whole)):
        link = MavlinkCodec(SYSTEM_ID)
        assert link.decode(whole + whole[:cut]) == [HEARD[0][1]]
        assert link.rejected == {"malformed": 1}
        assert link.decode(whole) == [HEARD[0][1]]


def test_a_message_with_flags_that_nobody_knows_is_dropped_as_the_protocol_demands() -> None:
    sender = autopilot()
    message = local_position(*POSITION)
    datagram = bytearray(packed(message, sender))
    datagram[2] |= 2
    checksum = dialect.x25crc(datagram[1:-2])
    checksum.accumulate(struct.pack("B", message.crc_extra))
    struct.pack_into("<H", datagram, len(datagram) - 2, checksum.crc)
    link = MavlinkCodec(SYSTEM_ID)
    assert link.decode(bytes(datagram)) == []
    assert link.rejected == {"malformed": 1}


def resigned(message_id: int, crc_extra: int, payload: bytes, sender: tuple[int, int]) -> bytes:
    """A frame with a right checksum around any payload."""
    head = bytes((len(payload), 0, 0, 0, *sender)) + message_id.to_bytes(3, "little")
    checksum = dialect.x25crc(head + payload)
    checksum.accumulate(bytes((crc_extra,)))
    return b"\xfd" + head + payload + struct.pack("<H", checksum.crc)


READ_IDS = sorted({0, 1, 22, 32, 49, 77, 230, 245, 436})


@settings(max_examples=400, deadline=None)
@given(st.sampled_from(READ_IDS), st.binary(min_size=1, max_size=80), st.sampled_from([(7, 1), (8, 1), (7, 191)]))
def test_any_payload_under_a_right_checksum_is_read_or_counted(
    message_id: int, payload: bytes, sender: tuple[int, int]
) -> None:
    link = MavlinkCodec(SYSTEM_ID)
    crc_extra = dialect.mavlink_map[message_id].crc_extra
    events = link.decode(resigned(message_id, crc_extra, payload, sender))
    for event in events:
        if isinstance(event, wire.LocalPosition):
            assert all(abs(x) <= 1e6 for x in (*event.position_local_ned_m, *event.velocity_ned_m_s))
    assert len(events) + sum(link.rejected.values()) + link.not_read <= 1
    assert link.decode(packed(local_position(*POSITION))) == [HEARD[0][1]]


@settings(max_examples=300, deadline=None)
@given(st.lists(st.binary(max_size=300) | st.sampled_from([packed(m) for m, _ in HEARD]), max_size=5))
def test_any_bytes_are_counted_or_read_and_never_raise(datagrams: list[bytes]) -> None:
    link = MavlinkCodec(SYSTEM_ID)
    for datagram in datagrams:
        link.decode(datagram)
        link.decode(b"\xfd" + datagram)
    assert link.decode(packed(local_position(*POSITION))) == [HEARD[0][1]]


def test_thousands_of_mutated_datagrams_are_counted_or_read_and_never_raise() -> None:
    noise = random.Random(5)
    whole = [packed(m) for m, _ in HEARD]
    link = MavlinkCodec(SYSTEM_ID)
    for _ in range(3000):
        datagram = bytearray(noise.choice(whole) + noise.choice(whole))
        for _ in range(noise.randrange(1, 6)):
            datagram[noise.randrange(len(datagram))] = noise.randrange(256)
        link.decode(bytes(datagram[noise.randrange(8) :]))
    assert link.decode(whole[0]) == [HEARD[0][1]]
    assert link.rejected["malformed"] > 1000


@pytest.mark.parametrize("mode", Px4Mode)
def test_every_mode_has_a_name_and_is_asked_for_by_its_numbers(mode: Px4Mode) -> None:
    assert mode_name(int(mode)) == mode.name
    _, _, main, sub = px4.mode_parameters(mode)
    assert int(main) << 16 | int(sub) << 24 == mode


def test_an_unknown_mode_is_named_by_its_number() -> None:
    assert mode_name(0x12340000) == "0x12340000"


# -- beside pymavlink --------------------------------------------------------------------------------------------------


def as_pymavlink_reads(message: Any) -> list[wire.Event]:
    """What a message of the own autopilot means, from pymavlink's object."""
    match message.get_type():
        case "LOCAL_POSITION_NED":
            six = (message.x, message.y, message.z, message.vx, message.vy, message.vz)
            told = wire.LocalPosition(message.time_boot_ms, Ned(*six[:3]), Ned(*six[3:]))
            return [told] if all(abs(x) <= 1e6 for x in six) else []
        case "CURRENT_MODE":
            return [wire.CurrentMode(message.custom_mode, message.intended_custom_mode)]
        case "EXTENDED_SYS_STATE":
            return [wire.LandedState(message.landed_state)]
        case "HEARTBEAT":
            armed = bool(message.base_mode & 128)
            told_of = wire.Heartbeat(message.autopilot, message.type, armed, message.custom_mode)
            return [told_of] if message.autopilot != dialect.MAV_AUTOPILOT_INVALID else []
        case "GPS_GLOBAL_ORIGIN":
            north, east = message.latitude, message.longitude
            some = (north, east) != (0, 0) and abs(north) <= 900_000_000 and abs(east) <= 1_800_000_000
            return [wire.GlobalOrigin(Geodetic(north * 1e-7, east * 1e-7, message.altitude * 1e-3))] if some else []
        case "ESTIMATOR_STATUS":
            accuracy = message.pos_horiz_accuracy
            return [wire.EstimatorHealth(message.flags, accuracy if 0.0 < accuracy < inf else inf)]
        case "SYS_STATUS":
            charge = message.battery_remaining
            return [wire.SystemHealth(message.onboard_control_sensors_health, charge if 0 <= charge <= 100 else -1)]
        case "COMMAND_ACK":
            ours = message.target_component in (0, 191)
            return [wire.CommandAnswer(message.command, message.result)] if ours else []
        case "TIMESYNC":
            return [wire.TimeAnswer(message.ts1)] if message.tc1 else []
        case "SYSTEM_TIME":
            return [wire.SystemTime(message.time_unix_usec)] if message.time_unix_usec > wire.UTC_KNOWN_US else []
        case "HOME_POSITION":
            return [wire.HomePosition(message.altitude * 1e-3)]
        case "PARAM_VALUE" if message.param_type == dialect.MAV_PARAM_TYPE_REAL32:
            return [wire.ParameterValue(message.param_id, message.param_value)] if isfinite(message.param_value) else []
        case "PARAM_VALUE" if message.param_type == dialect.MAV_PARAM_TYPE_INT32:
            return [wire.ParameterValue(message.param_id, int.from_bytes(message.get_msgbuf()[10:14], "little"))]
        case "AUTOPILOT_VERSION":
            git = (
                bytes(reversed(message.flight_custom_version)).hex()[:10] if any(message.flight_custom_version) else ""
            )
            return [Software(*message.flight_sw_version.to_bytes(4, "big"), git)]
        case "PARAM_ERROR":
            ours = message.target_component in (0, 191) and message.error
            return [wire.ParameterError(message.param_id)] if ours else []
    return []


ALL_READ = (0, 1, 2, 22, 32, 49, 77, 111, 148, 230, 242, 245, 345, 436)


@settings(max_examples=1000, deadline=None)
@given(
    st.sampled_from(ALL_READ), st.binary(max_size=255), st.sampled_from(["2", "2, signed", "1"]), st.integers(0, 255)
)  # fmt: skip
def test_any_payload_in_any_frame_means_what_pymavlink_makes_of_it(
    message_id: int, payload: bytes, version: str, sequence: int
) -> None:
    kind = dialect.mavlink_map[message_id]
    if message_id == 22:
        # The sort of a parameter decides how its value is read; a whole number is compared where it is positive.
        payload = payload.ljust(25, b"\0")[:24] + bytes((payload[24] % 2 * 3 + 6 if len(payload) > 24 else 9,))
        payload = payload[:3] + bytes((payload[3] & 0x7F,)) + payload[4:]
    if version == "1" and message_id > 255:
        version = "2"
    datagram = framed(message_id, kind.crc_extra, payload, version, sequence)
    (message,) = dialect.MAVLink(None).parse_buffer(bytearray(datagram)) or (None,)
    assert message is not None
    if message_id == 22 and version == "1":
        return  # the reference looks for the number at another place
    link = MavlinkCodec(SYSTEM_ID)
    events = link.decode(datagram)
    told = as_pymavlink_reads(message)
    assert repr(events) == repr(told)
    assert [type(e) for e in events] == [type(e) for e in told]
    assert link.rejected["malformed"] == 0
    damaged = bytearray(datagram)
    damaged[len(datagram) - (14 if version == "2, signed" else 1)] ^= 1
    assert link.decode(bytes(damaged)) == []
    assert link.rejected["malformed"] == 1


def framed(message_id: int, crc_extra: int, payload: bytes, version: str, sequence: int) -> bytes:
    """A frame of the own autopilot with a right checksum; a signature is any thirteen bytes, as nobody verifies it."""
    if version == "1":
        head = bytes((len(payload), sequence, SYSTEM_ID, 1, message_id))
    else:
        head = bytes((len(payload), int("signed" in version), 0, sequence, SYSTEM_ID, 1))
        head += message_id.to_bytes(3, "little")
    checksum = dialect.x25crc(head + payload + bytes((crc_extra,))).crc
    mark = b"\xfe" if version == "1" else b"\xfd"
    return mark + head + payload + struct.pack("<H", checksum) + (b"\xfd" * 13 if "signed" in version else b"")


floats32 = st.floats(width=32)


@settings(max_examples=500, deadline=None)
@given(
    st.integers(0, 2**40), st.tuples(*[floats32] * 7), st.integers(0, 255), st.integers(1, 255)
)  # fmt: skip
def test_a_setpoint_is_to_the_byte_what_pymavlink_packs(
    boot_ms: int, numbers: tuple[float, ...], sequence: int, system_id: int
) -> None:
    down, *velocity, a_north, a_east, yaw = numbers
    link, other = MavlinkCodec(system_id), dialect.MAVLink(None, srcSystem=system_id, srcComponent=191)
    for _ in range(sequence):
        link.heartbeat()
    other.seq = sequence
    message = dialect.MAVLink_set_position_target_local_ned_message(
        boot_ms % 2**32, system_id, 1, dialect.MAV_FRAME_LOCAL_NED, 0x903, 0.0, 0.0, down, *velocity,
        a_north, a_east, 0.0, yaw, 0.0,
    )  # fmt: skip
    assert link.setpoint(boot_ms, down, Ned(*velocity), (a_north, a_east), yaw) == bytes(message.pack(other))


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2**16 - 1), st.lists(floats32, max_size=7), st.text("ABC_1", max_size=16), st.integers(0, 2**62))
def test_whatever_else_is_sent_is_to_the_byte_what_pymavlink_packs(
    command: int, parameters: list[float], name: str, now_ns: int
) -> None:
    link, other = MavlinkCodec(SYSTEM_ID), dialect.MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=191)
    seven = [*parameters, *[0.0] * (7 - len(parameters))]
    sent = [
        (link.heartbeat(), dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)),
        (link.command(command, *parameters), dialect.MAVLink_command_long_message(SYSTEM_ID, 1, command, 0, *seven)),
        (link.read_parameter(name), dialect.MAVLink_param_request_read_message(SYSTEM_ID, 1, name.encode(), -1)),
        (link.time_request(now_ns), dialect.MAVLink_timesync_message(0, now_ns)),
    ]
    for sequence, (datagram, message) in enumerate(sent):
        other.seq = sequence
        assert datagram == bytes(message.pack(other))


def test_every_layout_is_the_one_in_pymavlinks_dialect() -> None:
    layouts = [value for value in vars(wire).values() if isinstance(value, Layout)]
    assert {layout.message_id for layout in layouts} == {*ALL_READ, 20, 76, 84, 256}
    for layout in layouts:
        kind = dialect.mavlink_map[layout.message_id]
        assert layout.extra == bytes((kind.crc_extra,))
        # A parameter's value is looked at as bytes; what nobody reads at a message's end is left out.
        assert kind.unpacker.format.startswith(
            layout.fields.format.replace("4s", "f").replace("8s", "8B").replace("32s", "32B")
        )


@pytest.mark.parametrize(("told", "means"), [(0, 0), (55, 55), (100, 100), (-1, -1), (-5, -1), (101, -1), (127, -1)])
def test_a_charge_that_is_none_is_unknown(told: int, means: int) -> None:
    link = MavlinkCodec(SYSTEM_ID)
    message = dialect.MAVLink_sys_status_message(0, 0, 0, 0, 0, 0, told, 0, 0, 0, 0, 0, 0)
    (event,) = link.decode(bytes(message.pack(autopilot())))
    assert event == wire.SystemHealth(0, means)


def test_an_origin_at_zero_zero_is_none() -> None:
    link = MavlinkCodec(SYSTEM_ID)
    assert link.decode(bytes(dialect.MAVLink_gps_global_origin_message(0, 0, 488_000, 0).pack(autopilot()))) == []
    assert link.rejected["out of range"] == 1
    (event,) = link.decode(bytes(dialect.MAVLink_gps_global_origin_message(1, 0, 0, 0).pack(autopilot())))
    assert isinstance(event, wire.GlobalOrigin)


def test_a_heartbeat_of_what_is_no_autopilot_says_nothing_of_arming_or_mode() -> None:
    link = MavlinkCodec(SYSTEM_ID)
    invalid = dialect.MAVLink_heartbeat_message(6, dialect.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
    assert link.decode(bytes(invalid.pack(autopilot()))) == []
    assert link.rejected["heartbeat of no autopilot"] == 1
