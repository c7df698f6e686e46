"""What the stub flies: in OFFBOARD what it is told, in PX4's own modes what the navigator leads to. Sans-I/O."""

from sim.autopilot.commander import Commander, TakeoffState
from sim.autopilot.dynamics import Vehicle
from sim.autopilot.modes import Mode
from sim.autopilot.navigator import Navigator
from sim.autopilot.offboard import SetpointStream
from sim.autopilot.setpoint import HOLD_STILL, Setpoint
from sim.autopilot.telemetry import Telemetry


class Flight:
    """The mode that flies, and what controls the vehicle in it; new with every boot."""

    def __init__(self, commander: Commander, navigator: Navigator, vehicle: Vehicle, telemetry: Telemetry) -> None:
        self.stream = SetpointStream()
        self.wants_takeoff = False
        """whether what is flown asks the vehicle to leave the ground"""
        self._commander = commander
        self._navigator = navigator
        self._vehicle = vehicle
        self._telemetry = telemetry
        self._mode = commander.mode

    def step(self, now_ns: int, dt_s: float) -> None:
        """Control the vehicle over one step."""
        commander, vehicle, telemetry = self._commander, self._vehicle, self._telemetry
        mode = commander.mode
        self.follow_mode(now_ns)
        if not commander.armed:
            self.wants_takeoff = False
            telemetry.setpoint = None
            vehicle.idle()
            return
        if mode is Mode.OFFBOARD:
            self.stream.watch(now_ns, commander.setpoint_last_ns)
            setpoint = self.stream.setpoint
        else:
            setpoint = self._setpoint(mode, now_ns, dt_s)
        if commander.takeoff_state is not TakeoffState.FLIGHT:
            self.wants_takeoff = self._asks_for_takeoff(mode, setpoint)
        if not commander.motors_run:
            telemetry.setpoint = None
            vehicle.idle()
            return
        telemetry.setpoint = setpoint
        vehicle.gains.speed_max_up_m_s = commander.speed_up_limit_m_s(now_ns)
        vehicle.thrust_min_g = commander.thrust_min_g
        vehicle.control(setpoint, dt_s)
        if mode is Mode.TAKEOFF and self._navigator.takeoff_done:
            commander.choose(Mode.LOITER, now_ns)

    def follow_mode(self, now_ns: int) -> None:
        """Begin to fly the commander's mode, if it has changed."""
        if self._commander.mode is not self._mode:
            self._enter(self._commander.mode, now_ns)

    def take_setpoint(self, setpoint: Setpoint, now_ns: int) -> None:
        """A valid one has come."""
        commander, stream = self._commander, self.stream
        commander.setpoint_seen = True
        commander.setpoint_last_ns = now_ns
        stream.count += 1
        if commander.mode is Mode.OFFBOARD:
            self.follow_mode(now_ns)
            stream.setpoint = setpoint if setpoint.is_flyable() else HOLD_STILL

    def _setpoint(self, mode: Mode, now_ns: int, dt_s: float) -> Setpoint:
        commander, vehicle = self._commander, self._vehicle
        if mode.is_manual and commander.pilot_present:
            return HOLD_STILL
        return self._navigator.setpoint(
            mode,
            vehicle.down_m + vehicle.position_error_down_m,
            self._telemetry.height_m,
            dt_s,
            lifted=not vehicle.on_ground,
            may_climb=commander.motors_run and commander.speed_up_limit_m_s(now_ns) > 0.0,
        )

    def _asks_for_takeoff(self, mode: Mode, setpoint: Setpoint) -> bool:
        if mode is Mode.TAKEOFF:
            return True
        if mode is not Mode.OFFBOARD:
            return False
        down = self._vehicle.down_m + self._vehicle.position_error_down_m
        return setpoint.down_m < down or setpoint.velocity_down_m_s < 0.0 or setpoint.acceleration_down_m_s2 < 0.0

    def _enter(self, mode: Mode, now_ns: int) -> None:
        before, self._mode = self._mode, mode
        if mode is Mode.OFFBOARD:
            self.stream.enter(now_ns)
            return
        vehicle = self._vehicle
        self._navigator.enter(
            mode,
            (
                vehicle.north_m + vehicle.position_error_north_m,
                vehicle.east_m + vehicle.position_error_east_m,
                vehicle.down_m + vehicle.position_error_down_m,
            ),
            (vehicle.velocity_north_m_s, vehicle.velocity_east_m_s, vehicle.velocity_down_m_s),
            keep_altitude=before is Mode.TAKEOFF and self._navigator.takeoff_done,
        )
