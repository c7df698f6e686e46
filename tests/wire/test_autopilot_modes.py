"""Flights of the stub in PX4's own modes: take-off, hold, landing, arming and disarming by itself."""

import pytest
from autopilot_flight import Flight, mavlink

from sim.autopilot.disturbances import GustParameters, NoiseParameters
from sim.autopilot.dynamics_parameters import DynamicsParameters
from sim.autopilot.modes import LandedState, Mode


def landed_states(flight: Flight) -> list[int]:
    states = [message.landed_state for message in flight.of("EXTENDED_SYS_STATE")]
    return [state for i, state in enumerate(states) if i == 0 or states[i - 1] != state]


@pytest.mark.parametrize("model", ["px4", "ideal"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_flight_goes_through_the_landed_states_1_3_2_4_1(model: str, seed: int) -> None:
    flight = Flight(
        dynamics=DynamicsParameters(model=model),  # type: ignore[arg-type]
        gust=GustParameters(),
        noise=NoiseParameters(),
        seed=seed,
    )
    flight.take_off(5.0)
    assert flight.position.down == pytest.approx(-5.0, abs=0.4)
    flight.command(mavlink.MAV_CMD_NAV_LAND)
    flight.run_while(lambda: flight.armed, 30.0)
    flight.run(0.4)
    assert landed_states(flight) == [1, 3, 2, 4, 1]
    assert flight.position.down == 0.0


def test_take_off_climbs_at_1_5_m_s_and_ends_in_hold() -> None:
    flight = Flight()
    flight.run(4.5)
    flight.arm()
    flight.run(1.0)
    flight.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, flight.autopilot.telemetry.altitude_amsl_m + 20.0)
    begun_s = flight.now_s
    flight.run_while(lambda: flight.position.down > -0.1, 10.0)
    assert flight.now_s - begun_s == pytest.approx(3.2, abs=0.8)  # the ramp; recorded 3.2 s
    flight.run_while(lambda: flight.position.down > -10.0, 20.0)
    assert flight.velocity.down == pytest.approx(-1.5, abs=0.15)
    flight.run_while(lambda: flight.mode is Mode.TAKEOFF, 20.0)
    assert flight.mode is Mode.LOITER
    flight.run(5.0)
    assert flight.position.down == pytest.approx(-20.0, abs=0.1)


def test_landing_sinks_at_0_7_m_s_and_disarms_2_s_after_the_landing_is_noticed() -> None:
    flight = Flight()
    flight.take_off(6.0)
    flight.command(mavlink.MAV_CMD_NAV_LAND)
    flight.run(3.0)
    assert flight.velocity.down == pytest.approx(0.7, abs=0.05)
    flight.run_while(lambda: flight.autopilot.commander.landed_state is not LandedState.ON_GROUND, 30.0)
    landed_s = flight.now_s
    flight.run_while(lambda: flight.armed, 5.0)
    assert flight.now_s - landed_s == pytest.approx(2.0, abs=0.05)


def test_after_landing_px4_falls_back_to_the_earlier_offboard_without_being_ready() -> None:
    flight = Flight()
    flight.take_off()
    flight.go_offboard()
    flight.stream(flight.setpoint(), 1.0)
    flight.command(mavlink.MAV_CMD_NAV_LAND)
    flight.run_while(lambda: flight.armed, 30.0)
    flight.run(1.1)
    message = flight.last("HEARTBEAT")
    assert (message.base_mode, message.custom_mode, message.system_status) == (17, 393216, 0)


def test_vehicle_disarms_10_s_after_arming_without_take_off() -> None:
    flight = Flight()
    flight.run(4.5)
    flight.arm()
    flight.run(9.9)
    assert flight.armed
    flight.run(0.2)
    assert not flight.armed


def test_hold_stays_where_the_vehicle_came_to_rest() -> None:
    flight = Flight()
    flight.take_off()
    flight.go_offboard()
    flight.stream(flight.setpoint(vx=3.0), 4.0)
    flight.set_mode(Mode.LOITER)
    flight.run(6.0)
    rest = flight.position
    flight.run(5.0)
    assert flight.position == pytest.approx(rest, abs=0.05)
    assert abs(flight.velocity.north) < 0.02


def test_return_climbs_goes_home_and_lands_there() -> None:
    flight = Flight(parameters={"RTL_RETURN_ALT": 12.0})
    flight.take_off()
    flight.go_offboard()
    flight.stream(flight.setpoint(vx=4.0), 6.0)
    flight.command(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH)
    highest = 0.0
    while flight.armed:
        flight.run(0.5)
        highest = min(highest, flight.position.down)
        assert flight.now_s < 120.0
    assert highest == pytest.approx(-12.0, abs=1.2)
    assert (flight.position.north, flight.position.east) == pytest.approx((0.0, 0.0), abs=0.3)


@pytest.mark.parametrize(("mode", "disarmed"), [(Mode.POSCTL, 81), (Mode.LOITER, 29), (Mode.OFFBOARD, 1)])
def test_base_mode_follows_the_mode(mode: Mode, disarmed: int) -> None:
    flight = Flight()
    flight.run(4.5)
    flight.set_mode(mode)
    flight.run(1.0)
    message = flight.last("HEARTBEAT")
    assert (message.base_mode, message.custom_mode) == (disarmed, mode.custom_mode)


def test_home_moves_to_the_place_of_arming() -> None:
    flight = Flight()
    flight.take_off()
    flight.go_offboard()
    flight.stream(flight.setpoint(vx=2.0), 4.0)
    flight.command(mavlink.MAV_CMD_NAV_LAND)
    flight.run_while(lambda: flight.armed, 30.0)
    flight.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_HOME_POSITION)
    assert flight.last("HOME_POSITION").x == pytest.approx(flight.position.north, abs=0.1)
    assert flight.position.north > 5.0


def test_estimator_errors_drive_the_true_motion_not_only_the_report() -> None:
    noisy = Flight(noise=NoiseParameters(position_sigma_m=0.3, velocity_sigma_m_s=0.0))
    noisy.take_off()
    wandering = []
    for _ in noisy.ticks(20.0, 2.0):
        wandering.append(noisy.position.north)
    assert 0.1 < max(wandering) - min(wandering) < 2.0
