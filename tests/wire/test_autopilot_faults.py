"""Faults on command: what the vehicle then reports, and what it does."""

import math

import pytest
from autopilot_flight import ORIGIN, Flight, mavlink

from companion.core.frames import Geodetic, Ned, geodetic_to_ned
from companion.vehicle.autopilot.px4_versions import VERSIONS, Px4Version
from sim.autopilot.dynamics_parameters import DynamicsParameters
from sim.autopilot.faults import OF_PX4_ALONE, Fault, FaultKind, decode_order, encode_order
from sim.autopilot.modes import Mode


def flying(*streams: str, **parameters: float | int) -> Flight:
    """In OFFBOARD at 5 m, the named streams at 50 Hz."""
    flight = Flight(parameters=parameters)
    flight.take_off()
    for name in streams:
        flight.autopilot.set_interval_us(getattr(mavlink, f"MAVLINK_MSG_ID_{name}"), 20_000)
    flight.go_offboard()
    flight.stream(flight.setpoint(), 1.0)
    return flight


def test_lost_gps_shows_everywhere_and_ends_the_offboard_flight_after_5_s() -> None:
    flight = flying("GPS_RAW_INT", "ESTIMATOR_STATUS", "GLOBAL_POSITION_INT", "LOCAL_POSITION_NED")
    flight.autopilot.inject(Fault(FaultKind.GPS_LOST))
    flight.stream(flight.setpoint(), 4.0)
    assert flight.last("GPS_RAW_INT").fix_type == 0
    assert not flight.last("SYS_STATUS").onboard_control_sensors_health & 1 << 5
    assert flight.last("ESTIMATOR_STATUS").pos_horiz_accuracy > 1.5
    assert flight.mode is Mode.OFFBOARD
    flight.stream(flight.setpoint(), 1.5)
    lost_s = flight.now_s
    flight.stream(flight.setpoint(), 1.0)
    assert flight.mode is not Mode.OFFBOARD
    assert not flight.last("ESTIMATOR_STATUS").flags & (0x8 | 0x10)
    assert flight.of("GLOBAL_POSITION_INT", lost_s) == []
    assert flight.of("LOCAL_POSITION_NED", lost_s)  # sent regardless, as measured


def test_drift_without_gps_moves_the_vehicle_and_a_new_fix_is_a_reset() -> None:
    flight = flying("LOCAL_POSITION_NED", "ODOMETRY")
    begin = flight.position
    before = flight.last("ODOMETRY").reset_counter
    flight.autopilot.inject(Fault(FaultKind.GPS_LOST, magnitude=0.4, duration_s=4.0))
    hold = flight.setpoint(0x9F8, x=begin.north, y=begin.east, z=begin.down)
    flight.stream(hold, 3.9)
    moved = math.hypot(flight.position.north - begin.north, flight.position.east - begin.east)
    assert 0.8 < moved < 1.8
    local = flight.last("LOCAL_POSITION_NED")
    assert math.hypot(local.x - begin.north, local.y - begin.east) < 0.6
    flight.stream(hold, 5.0)
    assert flight.mode is Mode.OFFBOARD
    assert flight.last("ODOMETRY").reset_counter == before + 1
    assert flight.position == pytest.approx(begin, abs=0.1)


def test_frozen_position_repeats_itself_with_fresh_time_stamps_while_the_vehicle_flies_on() -> None:
    flight = flying("LOCAL_POSITION_NED", "GLOBAL_POSITION_INT")
    flight.autopilot.inject(Fault(FaultKind.POSITION_FROZEN, duration_s=3.0))
    since_s = flight.now_s
    flight.stream(flight.setpoint(vx=2.0), 2.9)
    reports = flight.of("LOCAL_POSITION_NED", since_s)
    assert len({(m.x, m.y, m.z) for m in reports}) == 1
    assert len({m.time_boot_ms for m in reports}) == len(reports)
    assert len({(m.lat, m.lon) for m in flight.of("GLOBAL_POSITION_INT", since_s)}) == 1
    assert reports[-1].vx == pytest.approx(2.0, abs=0.2)
    assert flight.position.north > 3.0
    flight.stream(flight.setpoint(), 1.0)
    assert flight.last("LOCAL_POSITION_NED").x == pytest.approx(flight.position.north, abs=0.1)


def test_estimator_reset_moves_origin_and_local_position_but_nothing_true() -> None:
    flight = flying("LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "ODOMETRY")
    before, true_before = flight.last("LOCAL_POSITION_NED"), flight.position
    resets = flight.last("ODOMETRY").reset_counter
    where = flight.last("GLOBAL_POSITION_INT")
    flight.autopilot.inject(Fault(FaultKind.ESTIMATOR_RESET, offset_ned_m=Ned(3.0, -2.0, 0.5)))
    flight.run(0.05)
    after = flight.last("LOCAL_POSITION_NED")
    assert (after.x - before.x, after.y - before.y, after.z - before.z) == pytest.approx((-3.0, 2.0, -0.5), abs=0.02)
    assert flight.position == pytest.approx(true_before, abs=0.02)
    assert flight.last("ODOMETRY").reset_counter == resets + 1
    there = flight.last("GLOBAL_POSITION_INT")
    assert (there.lat, there.lon, there.alt) == pytest.approx((where.lat, where.lon, where.alt), abs=20)
    origin = flight.last("GPS_GLOBAL_ORIGIN")
    moved = geodetic_to_ned(Geodetic(origin.latitude / 1e7, origin.longitude / 1e7, origin.altitude / 1e3), ORIGIN)
    assert moved == pytest.approx((3.0, -2.0, 0.5), abs=0.02)


def test_noise_grows_what_is_reported_and_ends() -> None:
    flight = flying("LOCAL_POSITION_NED")
    flight.autopilot.inject(Fault(FaultKind.NOISE, magnitude=0.4, duration_s=4.0))
    since_s = flight.now_s
    flight.stream(flight.setpoint(), 4.0)
    speeds = [m.vx for m in flight.of("LOCAL_POSITION_NED", since_s)]
    assert 0.25 < math.sqrt(sum(v * v for v in speeds) / len(speeds)) < 0.6
    flight.stream(flight.setpoint(), 3.0)
    assert flight.last("LOCAL_POSITION_NED").vx == pytest.approx(flight.velocity.north, abs=1e-6)


@pytest.mark.parametrize(
    ("action", "fraction", "mode"),
    [
        (0, 0.06, Mode.OFFBOARD),
        (2, 0.06, Mode.LAND),
        (3, 0.06, Mode.RTL),
        (3, 0.04, Mode.LAND),
        (2, 0.10, Mode.OFFBOARD),
    ],
)
def test_low_battery_shows_and_acts_as_com_low_bat_act_says(action: int, fraction: float, mode: Mode) -> None:
    flight = flying(COM_LOW_BAT_ACT=action)
    flight.autopilot.inject(Fault(FaultKind.LOW_BATTERY, magnitude=fraction))
    flight.stream(flight.setpoint(), 1.2)
    assert flight.last("SYS_STATUS").battery_remaining == round(100 * fraction)
    assert flight.mode is mode
    assert flight.last("HEARTBEAT").system_status == (4 if mode is Mode.OFFBOARD else 5)


def test_reboot_in_flight_is_silent_then_begins_anew_on_the_ground() -> None:
    flight = flying("LOCAL_POSITION_NED")
    flight.autopilot.inject(Fault(FaultKind.REBOOT))
    since_s = flight.now_s
    flight.run(1.5)
    assert [m for t, m in flight.received if t > since_s + 0.01] == []
    assert not flight.armed
    flight.run(4.0)
    assert flight.position.down == pytest.approx(0.0, abs=1e-6)
    assert flight.last("LOCAL_POSITION_NED").time_boot_ms < 6000
    assert flight.of("GPS_GLOBAL_ORIGIN", since_s)
    assert flight.arm() == 0


def test_mute_autopilot_hears_but_says_nothing() -> None:
    flight = flying("LOCAL_POSITION_NED")
    flight.autopilot.inject(Fault(FaultKind.MUTE, duration_s=2.0))
    since_s = flight.now_s
    flight.stream(flight.setpoint(vx=1.0), 1.9)
    assert [m for t, m in flight.received if t > since_s + 0.01] == []
    assert flight.velocity.north > 0.7
    flight.stream(flight.setpoint(vx=1.0), 0.5)
    assert flight.of("LOCAL_POSITION_NED", since_s + 1.9)


def test_pilot_takes_over_by_a_mode_change_and_keeps_it() -> None:
    flight = flying()
    flight.autopilot.inject(Fault(FaultKind.PILOT_TAKEOVER))
    flight.stream(flight.setpoint(vx=2.0), 2.5)
    assert flight.mode is Mode.POSCTL
    assert flight.velocity.north == pytest.approx(0.0, abs=0.05)
    assert flight.last("HEARTBEAT").base_mode == 209
    assert flight.last("HEARTBEAT").system_status == 4
    current = flight.last("CURRENT_MODE")
    assert current.custom_mode == current.intended_custom_mode == Mode.POSCTL.custom_mode


@pytest.mark.parametrize(("override", "mode"), [(1, Mode.OFFBOARD), (3, Mode.POSCTL)])
def test_sticks_take_over_from_offboard_only_with_bit_1_of_com_rc_override(override: int, mode: Mode) -> None:
    flight = flying(COM_RC_OVERRIDE=override)
    flight.autopilot.inject(Fault(FaultKind.PILOT_STICKS))
    flight.stream(flight.setpoint(), 0.5)
    assert flight.mode is mode


@pytest.mark.parametrize(("speed", "mode"), [(-1.0, Mode.OFFBOARD), (0.0, Mode.POSCTL), (1.0, Mode.POSCTL)])
def test_since_1_18_sticks_take_over_unless_man_override_spd_is_negative(speed: float, mode: Mode) -> None:
    flight = Flight(parameters={"MAN_OVERRIDE_SPD": speed}, px4="1.18")
    assert "COM_RC_OVERRIDE" not in flight.autopilot.parameters
    flight.take_off()
    flight.go_offboard()
    flight.autopilot.inject(Fault(FaultKind.PILOT_STICKS))
    flight.stream(flight.setpoint(), 0.5)
    assert flight.mode is mode


def test_kill_switch_drops_the_vehicle_and_disarms_5_s_later() -> None:
    flight = flying()
    flight.autopilot.inject(Fault(FaultKind.RC_KILL))
    flight.stream(flight.setpoint(), 1.5)
    assert flight.position.down == 0.0
    assert flight.last("HEARTBEAT").system_status == 8
    assert flight.armed
    flight.stream(flight.setpoint(), 3.6)
    assert not flight.armed
    assert flight.arm() == 1


def test_slow_link_delivers_late_and_drops_the_rest() -> None:
    flight = Flight(quiet=False)
    flight.run(5.0)
    flight.autopilot.inject(Fault(FaultKind.SLOW_LINK, magnitude=5760.0, duration_s=5.0))
    since_s = flight.now_s
    before = len(flight.datagrams)
    flight.run(4.9)
    size = sum(map(len, flight.datagrams[before:]))
    assert size == pytest.approx(4.9 * 5760.0, rel=0.05)
    delays = [t - m.time_boot_ms / 1e3 for t, m in flight.received if t > since_s + 1.0 and m.get_type() == "ATTITUDE"]
    assert 0.3 < max(delays) < 0.6
    flight.run(2.0)
    recovered = [t - m.time_boot_ms / 1e3 for t, m in flight.received[-50:] if m.get_type() == "ATTITUDE"]
    assert max(recovered) < 0.02


def test_a_wind_pushes_while_it_lasts_and_a_boot_ends_it() -> None:
    flight = Flight(dynamics=DynamicsParameters(drag_per_s=1.0))
    flight.take_off()
    flight.go_offboard()
    flight.autopilot.inject(Fault(FaultKind.WIND, duration_s=3.0, wind_ned_m_s=Ned(0.0, 4.0, 0.0)))
    before = flight.position.east
    flight.stream(flight.setpoint(), 1.0)
    assert flight.velocity.east > 0.2
    assert flight.position.east > before
    flight.stream(flight.setpoint(), 20.0)
    assert abs(flight.velocity.east) < 0.1, "over, and the loops have it again"
    assert flight.autopilot.vehicle.parameters.wind_east_m_s == 0.0
    flight.autopilot.inject(Fault(FaultKind.WIND, wind_ned_m_s=Ned(0.0, 4.0, 0.0)))
    assert flight.autopilot.vehicle.parameters.wind_east_m_s == 4.0
    flight.autopilot.reboot()
    assert flight.autopilot.vehicle.parameters.wind_east_m_s == 0.0


def test_a_lost_link_carries_nothing_either_way_and_comes_back() -> None:
    flight = flying()
    assert flight.mode is Mode.OFFBOARD
    flight.autopilot.inject(Fault(FaultKind.LINK_LOST, duration_s=2.0))
    heard = len(flight.received)
    flight.stream(flight.setpoint(), 1.9)
    assert len(flight.received) == heard
    flight.stream(flight.setpoint(), 1.5)
    assert len(flight.received) > heard
    assert flight.last("CURRENT_MODE").intended_custom_mode == Mode.OFFBOARD.custom_mode


@pytest.mark.parametrize("kind", sorted(OF_PX4_ALONE))
def test_what_a_stub_does_not_play_it_refuses_with_who_does(kind: FaultKind) -> None:
    with pytest.raises(ValueError, match=f"{kind} is for --autopilot px4"):
        Flight().autopilot.inject(Fault(kind))


@pytest.mark.parametrize("version", VERSIONS, ids=lambda v: v.name)
def test_without_a_position_it_comes_down_in_the_mode_that_its_version_has_for_that(version: Px4Version) -> None:
    flight = Flight(px4=version.name)
    flight.take_off()
    flight.autopilot.inject(Fault(FaultKind.GPS_LOST))
    flight.run(8.0)
    assert flight.mode is (Mode.DESCEND if version.descend_mode else Mode.LAND)
    flight.run_while(lambda: flight.armed, 40.0)
    assert flight.set_mode(Mode.DESCEND) == 1, "nobody can choose it"


def test_fault_of_no_duration_ends_one_that_lasts() -> None:
    flight = flying("LOCAL_POSITION_NED")
    flight.autopilot.inject(Fault(FaultKind.MUTE))
    flight.stream(flight.setpoint(), 0.5)
    flight.autopilot.inject(Fault(FaultKind.MUTE, duration_s=0.0))
    since_s = flight.now_s
    flight.stream(flight.setpoint(), 0.5)
    assert flight.of("LOCAL_POSITION_NED", since_s)


@pytest.mark.parametrize(
    "fault",
    [
        Fault(FaultKind.MUTE),
        Fault(FaultKind.GPS_LOST, 0.2, 8.0),
        Fault(FaultKind.ESTIMATOR_RESET, offset_ned_m=Ned(1.0, 2.0, -0.5)),
    ],
)
def test_order_of_a_fault_survives_its_line(fault: Fault) -> None:
    assert decode_order(encode_order(7, fault)) == (7, fault)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (b"[]", "JSON object"),
        (b'{"vehicle": 1, "kind": "sulk"}', "kind must be one of gps_lost, .*, got 'sulk'"),
        (b'{"vehicle": "1", "kind": "mute"}', "vehicle must be a whole number, got '1'"),
        (b'{"vehicle": 1, "kind": "mute", "for": 3}', r"unknown keys \['for'\]"),
        (b"nonsense", "Expecting value"),
    ],
)
def test_order_that_cannot_be_understood_is_refused(line: bytes, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        decode_order(line)


def test_faults_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match="duration_s must be >= 0 s, got -1"):
        Fault(FaultKind.MUTE, duration_s=-1.0)
    with pytest.raises(ValueError, match="magnitude must be >= 0, got nan"):
        Fault(FaultKind.NOISE, magnitude=math.nan)
