"""One autopilot as its companion sees it: clock, requests, origin, readiness."""

import struct
from math import inf
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as dialect

from companion.config import load
from companion.core.events import AutopilotIdentified, RequestRefused, RequestUnanswered
from companion.core.frames import Geodetic, Ned, ned_to_geodetic
from companion.core.values import Instant
from companion.vehicle.autopilot.boot_clock import LATENCY_WINDOW_NS, BootClock
from companion.vehicle.autopilot.parameter_reader import (
    PARAMETER_PERIOD_NS,
    PARAMETER_TRIES,
    PARAMETERS_AT_ONCE,
)
from companion.vehicle.autopilot.port import LAND, OFFBOARD, FlightMode, Verb
from companion.vehicle.autopilot.px4 import Px4Autopilot
from companion.vehicle.autopilot.px4_parameters import PARAMETERS
from companion.vehicle.autopilot.requests import RETRY_S, TRIES
from companion.wire import px4 as px4_wire
from companion.wire.px4 import Px4Mode, arm_parameters, streams_hz, takeoff_parameters

SYSTEM_ID = 7
FLEET = Geodetic(47.397742, 8.545594, 488.0)
FILE = Path(__file__).resolve().parents[2] / "fleet.toml"
DELAY_S = 0.001
ESTIMATOR_OK = 1 | 2 | 4 | 8 | 16


def at(seconds: float) -> Instant:
    return Instant(round(seconds * 1e9), 1_700_000_000_000_000_000 + round(seconds * 1e9))


class Px4:
    """The other end of the link, by hand."""

    def __init__(self, client: Px4Autopilot) -> None:
        self.client = client
        self.mav: Any = dialect.MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=1)
        self.asked: list[tuple[float, Any]] = []

    def says(self, message: Any, seconds: float) -> bool:
        return self.client.receive(bytes(message.pack(self.mav)), at(seconds)).position

    def heartbeat(self, seconds: float, armed: bool = False, mode: int = 0, kind: int = 12, type_: int = 2) -> None:
        self.says(dialect.MAVLink_heartbeat_message(type_, kind, 128 * armed | 1, int(mode), 3, 3), seconds)

    def position(self, seconds: float, *numbers: float, boot_ms: int | None = None) -> bool:
        values = numbers or (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        boot = round((seconds - DELAY_S) * 1000) if boot_ms is None else boot_ms
        return self.says(dialect.MAVLink_local_position_ned_message(boot, *values), seconds)

    def origin(self, seconds: float, ned_m: Ned = Ned(0.0, 0.0, 0.0)) -> None:  # noqa: B008 (a value)
        where = ned_to_geodetic(ned_m, FLEET)
        self.says(
            dialect.MAVLink_gps_global_origin_message(
                round(where.latitude_deg * 1e7), round(where.longitude_deg * 1e7), round(where.altitude_amsl_m * 1e3), 0
            ),
            seconds,
        )  # fmt: skip

    def version(self, seconds: float, number: int = 0x011000FF) -> None:
        zeros = [0] * 8
        message = dialect.MAVLink_autopilot_version_message(0, number, 0, 0, 0, zeros, zeros, zeros, 0, 0, 0)
        self.says(message, seconds)

    def answer(self, command: int, result: int, seconds: float) -> None:
        self.says(dialect.MAVLink_command_ack_message(command, result, 0, 0, SYSTEM_ID, 191), seconds)

    def hear(self, seconds: float) -> list[Any]:
        """What the client sends now."""
        out = []
        for datagram in self.client.due(at(seconds)):
            parsed = dialect.MAVLink(None).parse_buffer(bytearray(datagram))
            assert parsed is not None
            out += parsed
        self.asked += [(seconds, m) for m in out if m.get_type() == "COMMAND_LONG"]
        return out

    def times_of(self, command: int, first: float | None = None) -> list[float]:
        return [t for t, m in self.asked if m.command == command and (first is None or m.param1 == first)]

    def run(self, start_s: float, end_s: float, period_s: float = 0.05) -> None:
        """Let the client ask for a while, without an answer."""
        for k in range(round((end_s - start_s) / period_s)):
            self.hear(start_s + k * period_s)


def px4(frame: str = "global") -> Px4:
    def change(tables: dict[str, Any]) -> None:
        tables["fleet"]["frame"] = frame
        if frame == "local":
            del tables["fleet"]["origin"]

    config = load(FILE, change)
    return Px4(Px4Autopilot(config, config.by_id(SYSTEM_ID)))


def ready(at_s: float = 10.0) -> Px4:
    """An autopilot that may take off at `at_s`."""
    one = px4()
    one.heartbeat(at_s)
    one.origin(at_s)
    one.position(at_s)
    one.says(dialect.MAVLink_estimator_status_message(0, ESTIMATOR_OK, 0, 0, 0, 0, 0, 0, 0.5, 0.5), at_s)
    one.version(at_s)
    one.client.events.clear()
    return one


# -- clock -------------------------------------------------------------------------------------------------------------


@given(st.lists(st.floats(0.0, 0.4), min_size=1, max_size=25))
def test_the_least_delayed_message_tells_the_offset_and_the_others_their_delay(delays: list[float]) -> None:
    clock = BootClock()
    least = 1.0
    for k, delay in enumerate(delays):
        made_s = k * 0.02
        arrived_ns = round((100.0 + made_s + delay) * 1e9)
        least = min(least, delay)
        made_ns = clock.arrived(round(made_s * 1000), arrived_ns)
        assert (arrived_ns - made_ns) * 1e-9 == pytest.approx(delay - least, abs=1e-6)


def test_an_old_minimum_is_forgotten_after_its_window() -> None:
    clock = BootClock()
    clock.arrived(0, 0)
    for k in range(1, 20):
        made = clock.arrived(k * 100, k * 100_000_000 + 50_000_000)
        expected = 50_000_000 if k * 100_000_000 + 50_000_000 <= LATENCY_WINDOW_NS else 0
        assert k * 100_000_000 + 50_000_000 - made == expected


def test_a_position_is_carried_on_by_its_age() -> None:
    one = ready(10.0)
    for k in range(20):
        one.position(10.02 + 0.02 * k, 1.0, 2.0, -3.0, 1.0, -2.0, 0.5)
    one.position(10.52, 1.0, 2.0, -3.0, 1.0, -2.0, 0.5, boot_ms=round(10.45 * 1000) - 1)
    state = one.client.state(at(10.55))
    assert state is not None
    position, velocity = state
    assert velocity == (1.0, -2.0, 0.5)
    assert position == pytest.approx((1.1, 1.8, -2.95), abs=0.002)


def test_a_position_is_stale_half_a_second_after_it_was_made() -> None:
    one = ready(10.0)
    assert one.client.state(at(10.499)) is not None
    assert one.client.state(at(10.501)) is None


def test_a_position_that_comes_twice_or_late_is_counted_and_changes_nothing() -> None:
    one = ready(10.0)
    assert one.position(10.02, 5.0, 0.0, 0.0, 0.0, 0.0, 0.0, boot_ms=10_100)
    assert not one.position(10.04, 6.0, 0.0, 0.0, 0.0, 0.0, 0.0, boot_ms=10_100)
    assert not one.position(10.06, 7.0, 0.0, 0.0, 0.0, 0.0, 0.0, boot_ms=9_500)
    assert one.client.position_ned_m.north == pytest.approx(5.0, abs=0.02)
    assert one.client.counts["position repeated"] == 2


def test_a_reboot_forgets_clock_and_origin_and_sets_the_streams_up_anew() -> None:
    one = ready(100.0)
    one.hear(100.0)
    before = len(one.times_of(511))
    assert not one.position(110.0, boot_ms=2_000)
    assert one.client.counts["autopilot reboot"] == 1
    assert one.client.facts(at(110.0)).origin is None
    assert one.client.facts(at(110.0)).position_ned_m is None
    one.origin(110.1)
    assert one.position(110.2, boot_ms=2_200)
    one.hear(110.2)
    assert len(one.times_of(511)) > before
    assert one.client.state(at(110.2)) is not None


LAST_MS = (1 << 32) - 1


@pytest.mark.parametrize("gap_s", [0.02, 1.5, 30.0])
def test_a_time_since_boot_that_goes_round_goes_on_and_a_reboot_after_it_is_noticed(gap_s: float) -> None:
    one = ready(10.0)
    clock = one.client.boot
    clock.restart()
    one.position(20.0, boot_ms=LAST_MS - 9)
    assert one.position(20.0 + gap_s, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, boot_ms=round(gap_s * 1000) - 10)
    assert one.client.counts["autopilot reboot"] == 0
    state = one.client.state(at(20.0 + gap_s))
    assert state is not None
    assert one.position(20.1 + gap_s, boot_ms=round(gap_s * 1000) + 90)
    assert not one.position(20.2 + gap_s, boot_ms=round(gap_s * 1000) + 90), "repeated"
    one.position(80.0, boot_ms=60_000)
    one.position(85.0, boot_ms=1_700)
    assert one.client.counts["autopilot reboot"] == 1


def test_a_reboot_days_before_the_time_would_go_round_is_noticed() -> None:
    one = ready(10.0)
    one.client.boot.restart()
    one.position(20.0, boot_ms=LAST_MS - 86_400_000)
    one.position(25.0, boot_ms=1_700)
    assert one.client.counts["autopilot reboot"] == 1


# -- requests ----------------------------------------------------------------------------------------------------------


def test_nothing_but_heartbeats_is_sent_before_the_autopilot_is_heard() -> None:
    one = px4()
    heard = [m.get_type() for k in range(60) for m in one.hear(0.05 * k)]
    assert heard == ["HEARTBEAT"] * 3


def test_a_heartbeat_goes_out_every_second() -> None:
    one = ready()
    beats = [0.05 * k for k in range(200) if any(m.get_type() == "HEARTBEAT" for m in one.hear(10.0 + 0.05 * k))]
    assert len(beats) == 10


def test_the_streams_are_asked_for_one_after_the_other() -> None:
    one = px4()
    one.heartbeat(0.0)
    wanted = [*streams_hz(50.0)]
    for k, message_id in enumerate(wanted):
        now = 0.01 * k
        one.hear(now)
        assert one.times_of(511, message_id) == [now]
        assert len(one.times_of(511)) == k + 1
        one.answer(511, 0, now)


def test_a_request_is_repeated_until_it_is_answered() -> None:
    one = ready()
    one.client.requests.ask("arming", *arm_parameters(True))
    one.run(10.0, 11.2)
    assert one.times_of(400) == pytest.approx([10.0, 10.5, 11.0])
    one.answer(400, 0, 11.2)
    one.run(11.2, 14.0)
    assert len(one.times_of(400)) == 3


def test_a_request_that_is_never_answered_is_given_up_and_noted() -> None:
    one = ready()
    one.client.requests.ask("arming", *arm_parameters(True))
    one.run(10.0, 10.0 + TRIES * RETRY_S + 1.0)
    assert len(one.times_of(400)) == TRIES
    assert RequestUnanswered("arming") in one.client.events


def test_the_same_request_is_not_queued_twice() -> None:
    one = ready()
    for _ in range(50):
        one.client.requests.ask("arming", *arm_parameters(True))
    one.hear(10.0)
    one.answer(400, 0, 10.01)
    one.run(10.05, 12.0)
    assert one.times_of(400) == [10.0]


def test_a_refusal_is_noted_and_the_request_not_repeated_at_once() -> None:
    one = ready()
    for k in range(100):
        now = 10.0 + 0.02 * k
        one.client.requests.ask("arming", *arm_parameters(True))
        if any(m.get_type() == "COMMAND_LONG" and m.command == 400 for m in one.hear(now)):
            one.answer(400, 2, now + 0.001)
    assert 3 <= len(one.times_of(400)) <= 5
    assert one.client.counts["refused: arming"] == len(one.times_of(400))
    assert one.client.events[0] == RequestRefused("arming", 2)


@pytest.mark.parametrize("result", [1, 5], ids=["temporarily rejected", "in progress"])
def test_an_answer_that_decides_nothing_leaves_the_request_open(result: int) -> None:
    one = ready()
    one.client.requests.ask("arming", *arm_parameters(True))
    one.hear(10.0)
    one.answer(400, result, 10.1)
    one.run(10.1, 11.0)
    assert one.times_of(400) == pytest.approx([10.0, 10.6])
    assert not one.client.events


def test_an_answer_to_nothing_asked_is_counted() -> None:
    one = ready()
    one.answer(400, 0, 10.0)
    one.client.requests.ask("arming", *arm_parameters(True))
    one.answer(400, 0, 10.0)
    one.hear(10.0)
    assert one.times_of(400) == [10.0]
    assert one.client.counts["answer to nothing asked"] == 2


def test_a_new_mode_takes_the_place_of_the_one_before() -> None:
    one = ready()
    one.client.engage()
    one.hear(10.0)
    one.client.land()
    one.run(10.05, 12.0)
    modes = [(m.param2, m.param3) for _, m in one.asked if m.command == 176]
    assert modes[0] == (6.0, 0.0)
    assert set(modes[1:]) == {(4.0, 6.0)}


def test_what_is_withdrawn_is_not_repeated_and_its_late_answer_is_no_surprise() -> None:
    one = ready()
    one.client.requests.ask("take-off", *takeoff_parameters(498.0))
    one.hear(10.0)
    one.client.withdraw(Verb.TAKE_OFF, Verb.ARM)
    one.run(10.05, 10.4)
    one.answer(22, 2, 10.4)
    one.run(10.4, 16.0)
    assert one.times_of(22) == [10.0]
    assert one.client.counts["answer to nothing asked"] == 0
    assert one.client.counts["refused: take-off"] == 0
    assert RequestUnanswered("take-off") not in one.client.events


def test_what_is_withdrawn_before_it_was_sent_is_never_sent() -> None:
    one = ready()
    one.client.requests.ask("arming", *arm_parameters(True))
    one.client.withdraw(Verb.ARM)
    one.run(10.0, 12.0)
    assert one.times_of(400) == []


def test_after_cancelling_nothing_but_heartbeats_is_sent() -> None:
    one = ready()
    one.client.requests.ask("arming", *arm_parameters(True))
    one.client.engage()
    one.client.cancel()
    one.run(10.0, 15.0)
    assert one.asked == []


def test_the_next_deadline_is_when_something_is_due() -> None:
    one = ready()
    one.run(10.0, 20.0)
    one.client.requests.ask("arming", *arm_parameters(True))
    deadlines = []
    now_ns = at(20.0).monotonic_ns
    for _ in range(30):
        now_ns = max(now_ns, one.client.next_deadline_ns())
        deadlines.append(now_ns)
        one.client.due(Instant(now_ns, 0))
        assert one.client.next_deadline_ns() > now_ns or one.client.next_deadline_ns() == 0
        now_ns += 1
    assert deadlines == sorted(deadlines)
    assert deadlines[-1] > at(24.0).monotonic_ns


# -- origin and frame --------------------------------------------------------------------------------------------------


def test_the_origin_is_asked_for_each_second_until_it_comes() -> None:
    one = px4()
    one.heartbeat(0.0)
    one.run(0.0, 3.0)
    assert len(one.times_of(512, 49)) == 3
    one.origin(3.0)
    one.run(3.0, 8.0)
    assert len(one.times_of(512, 49)) == 3


def test_positions_are_those_of_the_fleet_frame_once_the_origin_is_known() -> None:
    one = px4()
    assert not one.position(1.0, 1.0, 2.0, -3.0, 0.0, 0.0, 0.0)
    one.origin(1.5, Ned(10.0, -20.0, 0.5))
    assert one.position(2.0, 1.0, 2.0, -3.0, 0.0, 0.0, 0.0)
    assert one.client.position_ned_m == pytest.approx((11.0, -18.0, -2.5), abs=0.02)


def test_an_origin_that_moves_moves_the_frame_and_is_noted() -> None:
    one = ready()
    one.origin(11.0, Ned(4.0, -3.0, 0.5))
    one.position(11.1, 1.0, 1.0, -1.0, 0.0, 0.0, 0.0)
    assert one.client.position_ned_m == pytest.approx((5.0, -2.0, -0.5), abs=0.02)
    assert one.client.counts["estimator origin moved"] == 1
    one.origin(12.0, Ned(4.0, -3.0, 0.5))
    assert one.client.counts["estimator origin moved"] == 1


def test_in_a_local_frame_the_autopilots_frame_is_the_fleets() -> None:
    one = px4("local")
    one.heartbeat(0.0)
    assert one.position(1.0, 1.0, 2.0, -3.0, 0.0, 0.0, 0.0)
    one.origin(1.5, Ned(10.0, -20.0, 0.5))
    assert one.position(2.0, 1.0, 2.0, -3.0, 0.0, 0.0, 0.0)
    assert one.client.position_ned_m == (1.0, 2.0, -3.0)
    one.run(0.0, 3.0)
    assert one.times_of(512, px4_wire.ORIGIN_MESSAGE_ID) == []


def test_it_is_asked_for_its_version_on_the_ground_alone_and_anew_after_a_boot() -> None:
    one = px4()
    one.heartbeat(0.0)
    one.run(0.0, 2.5)
    assert len(one.times_of(512, px4_wire.VERSION_MESSAGE_ID)) == 3
    one.heartbeat(2.5, armed=True)
    one.run(2.5, 6.0)
    assert len(one.times_of(512, px4_wire.VERSION_MESSAGE_ID)) == 3
    one.heartbeat(6.0)
    one.version(6.0, 1 << 24 | 18 << 16 | 255)
    one.version(6.1, 1 << 24 | 18 << 16 | 255)
    assert [e for e in one.client.events if isinstance(e, AutopilotIdentified)] == [AutopilotIdentified("PX4 1.18.0")]
    one.run(6.1, 10.0)
    assert len(one.times_of(512, px4_wire.VERSION_MESSAGE_ID)) == 3
    one.position(10.0, boot_ms=9000)
    one.position(10.1, boot_ms=100)
    one.run(10.1, 10.6)
    assert len(one.times_of(512, px4_wire.VERSION_MESSAGE_ID)) == 4


# -- facts -------------------------------------------------------------------------------------------------------------


def test_the_facts_are_what_the_autopilot_has_said() -> None:
    assert px4().client.facts(at(0.0)).heartbeat_age_s is None
    one = ready()
    one.origin(10.0, Ned(3.0, 4.0, 0.0))
    one.says(dialect.MAVLink_sys_status_message(0, 0, 1 << 16, 0, 0, 0, 55, 0, 0, 0, 0, 0, 0), 10.0)
    one.says(dialect.MAVLink_home_position_message(0, 0, 489_500, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0), 10.0)
    facts = one.client.facts(at(10.4))
    assert facts.heartbeat_age_s == pytest.approx(0.4)
    assert facts.position_age_s == pytest.approx(0.4, abs=0.002)
    assert [(c.value, c.passed) for c in facts.identity] == [(12, True), (2, True)]
    assert (facts.estimate.flags, facts.estimate.accuracy_m) == (ESTIMATOR_OK, 0.5)
    assert facts.estimate.certain
    assert (facts.battery_percent, facts.rc_healthy) == (55, True)
    assert facts.home_altitude_amsl_m == pytest.approx(489.5)
    assert facts.origin is not None
    assert facts.clock_ahead_s is None


def test_positions_are_counted_over_the_last_two_seconds() -> None:
    one = ready(10.0)
    for k in range(1, 151):
        one.position(10.0 + 0.02 * k)
    assert one.client.facts(at(13.0)).position_rate_hz == pytest.approx(50.0, abs=0.5)
    assert one.client.facts(at(14.0)).position_rate_hz == pytest.approx(25.0, abs=0.5)
    assert one.client.facts(at(15.1)).position_rate_hz == 0.0


def test_an_autopilot_of_another_system_id_is_named() -> None:
    one = px4()
    one.mav.srcSystem = 9
    one.heartbeat(1.0)
    assert one.client.facts(at(1.0)).foreign_system_id == 9
    assert one.client.facts(at(1.0)).heartbeat_age_s is None
    assert one.client.facts(at(4.0)).foreign_system_id == 9
    assert one.client.facts(at(4.1)).foreign_system_id is None


def test_an_autopilot_of_another_system_id_beside_the_own_one_is_named() -> None:
    one = px4()
    one.heartbeat(1.0)
    assert one.client.facts(at(1.0)).foreign_system_id is None
    one.mav.srcSystem = 9
    one.heartbeat(1.2)
    assert one.client.facts(at(1.2)).foreign_system_id == 9


def test_what_estimator_and_battery_said_is_unknown_once_it_is_old() -> None:
    one = ready(10.0)
    one.says(dialect.MAVLink_sys_status_message(0, 0, 1 << 16, 0, 0, 0, 55, 0, 0, 0, 0, 0, 0), 10.0)
    fresh, old = one.client.facts(at(15.0)), one.client.facts(at(15.01))
    assert (fresh.estimate.flags, fresh.estimate.accuracy_m) == (ESTIMATOR_OK, 0.5)
    assert (fresh.battery_percent, fresh.rc_healthy) == (55, True)
    assert (old.estimate.flags, old.estimate.accuracy_m) == (0, inf)
    assert (old.battery_percent, old.rc_healthy) == (-1, False)
    assert one.client.battery(at(15.01)) == -1


# -- parameters --------------------------------------------------------------------------------------------------------


def asked_for(messages: list[Any]) -> list[str]:
    return [m.param_id for m in messages if m.get_type() == "PARAM_REQUEST_READ"]


def tells(one: Px4, name: str, value: float | int, seconds: float) -> None:
    whole = isinstance(value, int)
    wire_value = struct.unpack("<f", struct.pack("<i", value))[0] if whole else value
    kind = 6 if whole else 9
    one.says(dialect.MAVLink_param_value_message(name.encode(), wire_value, kind, 900, 1), seconds)


def answered(one: Px4, start_s: float, end_s: float, silent: frozenset[str] = frozenset()) -> list[tuple[float, str]]:
    """Let the client ask; every request is answered a millisecond later, INT32 for whole values."""
    asked = []
    for k in range(round((end_s - start_s) / 0.01)):
        now = start_s + 0.01 * k
        for name in asked_for(one.hear(now)):
            asked.append((now, name))
            if name not in silent:
                tells(one, name, 1.0 if name.startswith(("MPC", "COM_OF")) else 4, now + 0.001)
    return asked


OF_1_16 = tuple(name for name in PARAMETERS if name != "MAN_OVERRIDE_SPD")
OF_1_18 = tuple(name for name in PARAMETERS if name != "COM_RC_OVERRIDE")


def test_of_the_names_of_one_setting_the_one_that_answers_is_read_and_the_other_left_alone() -> None:
    one = ready(10.0)
    gone = frozenset({"COM_RC_OVERRIDE"})
    first_round = answered(one, 10.0, 11.5, gone)
    assert sum(name in gone for _, name in first_round) <= 2
    assert set(one.client.parameters.values) == set(OF_1_18)
    assert one.client.parameters.missing == set()
    assert [name for _, name in answered(one, 11.5, 20.0, gone)] == list(OF_1_18)


def test_all_parameters_are_read_within_a_second_a_few_at_a_time() -> None:
    one = ready(10.0)
    asked = answered(one, 10.0, 11.0)
    assert [name for _, name in asked] == list(OF_1_16)
    assert set(one.client.parameters.values) == set(OF_1_16)
    assert one.client.parameters.values["COM_OBL_RC_ACT"] == 4
    assert max(sum(t == now for t, _ in asked) for now, _ in asked) <= PARAMETERS_AT_ONCE


def test_whole_parameters_come_bytewise() -> None:
    one = ready(10.0)
    tells(one, "COM_RCL_EXCEPT", 4, 10.0)
    tells(one, "NAV_RCL_ACT", -1, 10.0)
    tells(one, "COM_OF_LOSS_T", 0.5, 10.0)
    tells(one, "SYS_AUTOSTART", 4001, 10.0)
    parameters = one.client.parameters.values
    assert parameters == {"COM_RCL_EXCEPT": 4, "NAV_RCL_ACT": -1, "COM_OF_LOSS_T": 0.5}


def test_a_parameter_that_never_comes_is_missing_and_the_others_are_read() -> None:
    one = ready(10.0)
    asked = answered(one, 10.0, 14.5, frozenset({"GF_ACTION"}))
    times = [t for t, name in asked if name == "GF_ACTION"]
    assert times == pytest.approx([times[0] + RETRY_S * k for k in range(PARAMETER_TRIES)], abs=0.011)
    assert one.client.parameters.missing == {"GF_ACTION"}
    assert set(one.client.parameters.values) == set(OF_1_16) - {"GF_ACTION"}
    tells(one, "GF_ACTION", 2, 14.6)
    assert one.client.parameters.missing == set()


def says_error(one: Px4, name: str, seconds: float, component: int = 191, error: int = 1) -> None:
    one.says(dialect.MAVLink_param_error_message(1, component, name.encode(), -1, error), seconds)


def test_a_parameter_that_px4_says_it_has_not_is_missing_at_once_and_not_asked_for_again() -> None:
    one = ready(10.0)
    asked = answered(one, 10.0, 10.4, frozenset({"GF_ACTION"}))
    for component, error in ((42, 1), (191, 0)):
        says_error(one, "GF_ACTION", 10.4, component, error)  # somebody else's, and no error
        assert one.client.parameters.missing == set()
    says_error(one, "GF_ACTION", 10.45)
    assert one.client.parameters.missing == {"GF_ACTION"}
    asked += answered(one, 10.5, 14.0, frozenset({"GF_ACTION"}))
    assert len([name for _, name in asked if name == "GF_ACTION"]) == 1
    says_error(one, "COM_OF_LOSS_T", 14.0)  # asked for no more: it was read, and stays
    assert "COM_OF_LOSS_T" in one.client.parameters.values


@pytest.mark.parametrize("error_first", [True, False])
def test_an_error_for_one_name_of_a_setting_is_no_fault_where_the_other_answers(error_first: bool) -> None:
    one = ready(10.0)
    gone = "COM_RC_OVERRIDE"
    for k in range(150):
        now = 10.0 + 0.01 * k
        for name in sorted(asked_for(one.hear(now)), key=lambda n: (n == gone) is not error_first):
            if name == gone:
                says_error(one, name, now + 0.001)
            else:
                tells(one, name, 1.0 if name.startswith(("MPC", "COM_OF", "MAN")) else 4, now + 0.001)
    assert one.client.parameters.missing == set()
    assert set(one.client.parameters.values) == set(OF_1_18)


def test_parameters_are_read_anew_on_the_ground_and_left_alone_in_flight() -> None:
    one = ready(10.0)
    answered(one, 10.0, 12.0)
    again = answered(one, 12.0, 20.0)
    assert [name for _, name in again] == list(OF_1_16)
    assert again[0][0] >= 10.0 + PARAMETER_PERIOD_NS * 1e-9
    one.heartbeat(20.0, armed=True)
    flown = [m.get_type() for k in range(1000) for m in one.hear(20.0 + 0.01 * k)]
    assert {"PARAM_REQUEST_READ", "TIMESYNC"}.isdisjoint(flown)
    one.heartbeat(30.0)
    assert len(answered(one, 30.0, 31.0)) == len(OF_1_16)


def test_a_reboot_forgets_the_parameters() -> None:
    one = ready(100.0)
    answered(one, 100.0, 101.0)
    one.position(110.0, boot_ms=2_000)
    assert one.client.parameters.values == {}


def test_a_descent_without_a_position_is_a_landing_like_any_other() -> None:
    """PX4 v1.19 tells it as a mode of its own; one that was commanded to land is not taken over by it."""
    one = ready(10.0)
    one.heartbeat(10.1, armed=True, mode=Px4Mode.AUTO_DESCEND)
    assert one.client.mode == LAND
    assert one.client.mode_name == "AUTO_DESCEND"


# -- round trip and the autopilot's clock ------------------------------------------------------------------------------


def time_request(messages: list[Any]) -> int | None:
    return next((m.ts1 for m in messages if m.get_type() == "TIMESYNC"), None)


def test_the_round_trip_is_the_median_of_the_last_answers() -> None:
    one = ready(10.0)
    for k, delay_s in enumerate((0.010, 0.500, 0.012, 0.011, 0.013, 0.011)):
        asked_ns = time_request(one.hear(11.0 + k))
        assert asked_ns == at(11.0 + k).monotonic_ns
        one.says(dialect.MAVLink_timesync_message(5_000_000_000, asked_ns), 11.0 + k + delay_s)
    trip = one.client.facts(at(16.5)).round_trip_s
    assert trip == pytest.approx(0.012)
    assert one.client.facts(at(20.0)).round_trip_s is None, "no answer of late"


def test_a_time_answer_counts_once_and_only_if_it_was_asked_for() -> None:
    one = ready(10.0)
    asked_ns = time_request(one.hear(11.0))
    one.says(dialect.MAVLink_timesync_message(0, 13_332_000_000), 11.0)
    assert one.client.facts(at(11.0)).round_trip_s is None, "the autopilot's own request is none"
    one.says(dialect.MAVLink_timesync_message(5, 10_999_000_000), 11.0)
    one.says(dialect.MAVLink_timesync_message(5, asked_ns), 11.1)
    one.says(dialect.MAVLink_timesync_message(5, asked_ns), 11.9)
    assert one.client.facts(at(12.0)).round_trip_s == pytest.approx(0.1)
    assert one.client.counts["time answer to nothing asked"] == 2


def test_the_autopilots_clock_is_read_from_its_least_delayed_message() -> None:
    one = ready(10.0)
    for k, delay_s in enumerate((0.3, 0.002, 0.1)):
        made_us = at(11.0 + k).fleet_ns // 1000 + 1_500_000
        one.says(dialect.MAVLink_system_time_message(made_us, 1000), 11.0 + k + delay_s)
    assert one.client.facts(at(14.0)).clock_ahead_s == pytest.approx(1.498, abs=0.001)


def test_an_autopilot_without_utc_has_no_clock() -> None:
    one = ready(10.0)
    one.says(dialect.MAVLink_system_time_message(14_000_000, 14_000), 11.0)
    assert one.client.facts(at(11.0)).clock_ahead_s is None


def test_state_of_the_autopilot_is_what_it_last_said() -> None:
    one = ready()
    one.heartbeat(10.0, armed=True, mode=int(Px4Mode.OFFBOARD))
    one.says(dialect.MAVLink_extended_sys_state_message(0, 2), 10.0)
    one.says(dialect.MAVLink_sys_status_message(0, 0, 0, 0, 0, 0, 55, 0, 0, 0, 0, 0, 0), 10.0)
    client = one.client
    assert (client.armed, client.mode, client.mode_name) == (True, OFFBOARD, "OFFBOARD")
    assert (client.on_ground, client.battery_percent) == (False, 55)
    one.says(dialect.MAVLink_current_mode_message(0, int(Px4Mode.POSCTL), 0), 10.1)
    assert client.mode == FlightMode("POSCTL")
    assert client.acts_by_itself
