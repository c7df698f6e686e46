"""PX4's commander: arming, flight modes, failsafes, landing detection. Sans-I/O; every rule of those is in this file.

Times are nanoseconds since boot. `step` is called on the autopilot's fixed grid after the dynamics have moved.
"""

from collections.abc import Callable
from enum import Enum, IntEnum

from sim.autopilot.dynamics import GRAVITY_M_S2, THRUST_MIN_G, Vehicle
from sim.autopilot.modes import (
    MODE_OF_LOSS_ACTION,
    NOT_ARMABLE_MODES,
    LandedState,
    Mode,
    OffboardLossAction,
    SystemStatus,
)
from sim.autopilot.parameters import ParameterTable

SECOND_NS = 1_000_000_000
HOME_SET_NS = 3_600_000_000
"""the home position is known this long after boot, as recorded"""
READY_NS = 4_000_000_000
"""armable this long after boot, as measured"""
KILL_DISARM_NS = 5 * SECOND_NS
"""a kill switch that stays on disarms after this long (COM_KILL_DISARM)"""


class Result(IntEnum):
    """MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4


class TakeoffState(Enum):
    """PX4's take-off state machine (Takeoff.cpp): motors turn up before the velocity loop may lift."""

    DISARMED = 0
    SPOOLUP = 1
    READY = 2
    RAMPUP = 3
    FLIGHT = 4


class Commander:
    """State of arming and modes of one vehicle, and the rules that change it."""

    def __init__(self, parameters: ParameterTable, vehicle: Vehicle) -> None:
        self._parameters = parameters
        self._vehicle = vehicle
        self.armed = False
        self.user_mode = Mode.LOITER
        """what the user chose: CURRENT_MODE.intended_custom_mode"""
        self.mode = Mode.LOITER
        """what flies"""
        self.failsafe = False
        self.landed_state = LandedState.ON_GROUND
        self.takeoff_state = TakeoffState.DISARMED
        self.setpoint_seen = False
        """an offboard set-point has arrived since boot"""
        self.setpoint_last_ns: int | None = None
        """time of the last valid offboard set-point"""
        self.position_valid = True
        self.pilot_present = False
        """somebody holds sticks"""
        self.killed = False
        self.battery_fraction = 1.0
        self._restored_mode = Mode.LOITER
        self._armed_at_ns = 0
        self._killed_at_ns = 0
        self._ramp_start_ns = 0
        self._contact_ns: int | None = None
        self._landed_at_ns: int | None = None
        self._setpoint_silence_ns = self._spoolup_ns = self._landing_trigger_ns = 0
        self._ramp_s = self._speed_up_max_m_s = self._ramp_start_m_s = self._battery_critical = 0.0
        self.read_parameters()
        self._blind_descent = Mode.DESCEND if parameters.version.descend_mode else Mode.LAND
        self.on_home_moved: Callable[[], None] = lambda: None
        """called when PX4 would set home anew: arming, lift-off, disarming"""

    def read_parameters(self) -> None:
        """Take over the parameters that are looked at in every step; to be called when any has changed."""
        number = self._parameters.number
        self._setpoint_silence_ns = round(number("COM_OF_LOSS_T") * SECOND_NS)
        self._spoolup_ns = round(number("COM_SPOOLUP_TIME") * SECOND_NS)
        self._landing_trigger_ns = round(number("LNDMC_TRIG_TIME") * SECOND_NS)
        self._ramp_s = number("MPC_TKO_RAMP_T")
        self._speed_up_max_m_s = number("MPC_Z_VEL_MAX_UP")
        self._ramp_start_m_s = -GRAVITY_M_S2 / max(number("MPC_Z_VEL_P_ACC"), 0.1)
        self._battery_critical = number("BAT_CRIT_THR")

    # What is true of the present state

    def ready(self, now_ns: int) -> bool:
        """The estimator and the sensors are up."""
        return now_ns >= READY_NS

    def setpoint_stream_alive(self, now_ns: int) -> bool:
        """The last valid offboard set-point is younger than COM_OF_LOSS_T."""
        if self.setpoint_last_ns is None:
            return False
        return now_ns - self.setpoint_last_ns <= self._setpoint_silence_ns

    def may_fly(self, mode: Mode, now_ns: int) -> bool:
        """What `mode` needs is there."""
        if mode is Mode.OFFBOARD:
            return self.setpoint_stream_alive(now_ns) and self.position_valid
        if mode is Mode.POSCTL:
            return self.pilot_present and self.position_valid
        if mode.is_manual:
            return self.pilot_present
        if mode is Mode.MISSION:
            return False  # there is never a mission in this stand-in
        if mode is Mode.TERMINATION:
            return True
        return self.position_valid

    def may_arm(self, now_ns: int) -> bool:
        """The preflight checks pass in the present mode."""
        return (
            self.ready(now_ns)
            and not self.killed
            and self.user_mode not in NOT_ARMABLE_MODES
            and self.may_fly(self.user_mode, now_ns)
        )

    @property
    def on_ground(self) -> bool:
        """The land detector's opinion."""
        return self.landed_state is LandedState.ON_GROUND

    def system_status(self, now_ns: int) -> SystemStatus:
        """HEARTBEAT.system_status."""
        if self.mode is Mode.TERMINATION or self.killed:
            return SystemStatus.TERMINATED
        if self.armed:
            return SystemStatus.FAILSAFE if self.failsafe else SystemStatus.ACTIVE
        return SystemStatus.STANDBY if self.may_arm(now_ns) else SystemStatus.NOT_READY

    @property
    def motors_run(self) -> bool:
        """Thrust may be more than idle."""
        return (
            self.armed
            and not self.killed
            and self.mode is not Mode.TERMINATION
            and self.takeoff_state in (TakeoffState.RAMPUP, TakeoffState.FLIGHT)
        )

    # What others ask for

    def arm(self, now_ns: int, *, force: bool = False) -> Result:
        """Answer to a request to arm."""
        if self.armed:
            return Result.ACCEPTED
        if not (self.may_arm(now_ns) or (force and self.ready(now_ns))):
            return Result.TEMPORARILY_REJECTED
        self.armed = True
        self._armed_at_ns = now_ns
        self._landed_at_ns = None
        self.on_home_moved()
        return Result.ACCEPTED

    def disarm(self, *, force: bool = False) -> Result:
        """Answer to a request to disarm."""
        if self.armed and not (self.on_ground or force):
            return Result.TEMPORARILY_REJECTED
        if self.armed:
            self._disarm()
        return Result.ACCEPTED

    def _disarm(self) -> None:
        self.armed = False
        self.failsafe = False
        if self.mode is not Mode.TERMINATION:
            self.mode = self.user_mode = self._restored_mode
        self._landed_at_ns = None
        self._contact_ns = None
        self.on_home_moved()

    def choose(self, mode: Mode, now_ns: int) -> Result:
        """Answer to a user's mode change: free while disarmed, in flight only what can be flown."""
        if self.mode is Mode.TERMINATION:
            return Result.TEMPORARILY_REJECTED
        if self.armed and not self.may_fly(mode, now_ns):
            return Result.TEMPORARILY_REJECTED
        self.user_mode = mode
        if mode not in NOT_ARMABLE_MODES:
            self._restored_mode = mode
        self._choose_active(now_ns)
        return Result.ACCEPTED

    def kill(self, now_ns: int) -> None:
        """The pilot's kill switch: motors stop at once."""
        if not self.killed:
            self.killed = True
            self._killed_at_ns = now_ns

    def move_sticks(self, now_ns: int) -> None:
        """A pilot moves the sticks fast: takes over automatic modes (COM_RC_OVERRIDE bit 0) and offboard (bit 1).

        Where MAN_OVERRIDE_SPD has taken its place: both, from 0 on.
        """
        self.pilot_present = True
        sticks = self._parameters.version.sticks
        if sticks == "COM_RC_OVERRIDE":
            override = self._parameters.integer(sticks)
        else:
            override = 3 if self._parameters.number(sticks) >= 0.0 else 0
        if (self.mode.is_auto and override & 1) or (self.mode is Mode.OFFBOARD and override & 2):
            self.choose(Mode.POSCTL, now_ns)

    # What happens by itself

    def step(self, now_ns: int, *, wants_takeoff: bool) -> None:
        """Failsafes, take-off state, landing detection, auto-disarm."""
        if self.killed and self.armed and now_ns - self._killed_at_ns >= KILL_DISARM_NS:
            self._disarm()
        self._choose_active(now_ns)
        if self.takeoff_state is not TakeoffState.FLIGHT or not self.armed:
            self._step_takeoff(now_ns, wants_takeoff)
        self._step_landed(now_ns)
        if self.armed and self.landed_state is LandedState.ON_GROUND:
            self._step_auto_disarm(now_ns)

    def _choose_active(self, now_ns: int) -> None:
        if self.mode is Mode.TERMINATION:
            return
        if not self.armed:
            self.mode, self.failsafe = self.user_mode, False
            return
        battery_mode = None if self.battery_fraction >= self._battery_critical else self._battery_action()
        if self.user_mode is Mode.OFFBOARD and not self.may_fly(Mode.OFFBOARD, now_ns):
            self._lose_offboard()
        elif not self.position_valid and (self.user_mode.is_auto or self.user_mode is Mode.POSCTL):
            # Without a position every such mode falls back to a blind descent.
            self.mode, self.failsafe = self._blind_descent, True
        elif battery_mode is not None and self.user_mode not in (battery_mode, Mode.LAND, Mode.TERMINATION):
            self.mode, self.failsafe = battery_mode, True
        else:
            self.mode, self.failsafe = self.user_mode, False

    def _battery_action(self) -> Mode | None:
        """Of a critical battery. COM_LOW_BAT_ACT: 0 warns, 2 lands, 3 returns, and lands in an emergency; 4, where it
        is one, returns, and stops the motors in an emergency."""
        action = self._parameters.integer("COM_LOW_BAT_ACT")
        if action not in self._parameters.version.battery_actions:
            return None
        if action in (3, 4):
            if self.battery_fraction >= self._parameters.number("BAT_EMERGEN_THR"):
                return Mode.RTL
            return Mode.LAND if action == 3 else Mode.TERMINATION
        return Mode.LAND if action == 2 else None

    def _lose_offboard(self) -> None:
        number = self._parameters.integer("COM_OBL_RC_ACT")
        known = number in OffboardLossAction.__members__.values()
        action = OffboardLossAction(number) if known else OffboardLossAction.POSITION
        if action is OffboardLossAction.DISARM:
            self._disarm()
            return
        mode = MODE_OF_LOSS_ACTION[action]
        if mode.is_auto and not self.position_valid:
            mode = self._blind_descent
        self.mode, self.failsafe = mode, True

    def _step_takeoff(self, now_ns: int, wants_takeoff: bool) -> None:
        if not self.armed:
            self.takeoff_state = TakeoffState.DISARMED
            return
        state = self.takeoff_state
        if state is TakeoffState.DISARMED:
            state = TakeoffState.SPOOLUP
        if state is TakeoffState.SPOOLUP and now_ns - self._armed_at_ns >= self._spoolup_ns:
            state = TakeoffState.READY
        if state is TakeoffState.READY and wants_takeoff:
            state = TakeoffState.RAMPUP
            self._ramp_start_ns = now_ns
            self._vehicle.reset_integrals()
        if state is TakeoffState.RAMPUP and self._ramp_progress(now_ns) >= 1.0:
            state = TakeoffState.FLIGHT
        self.takeoff_state = state

    def _ramp_progress(self, now_ns: int) -> float:
        duration_ns = self._ramp_s * SECOND_NS
        return 1.0 if duration_ns <= 0.0 else (now_ns - self._ramp_start_ns) / duration_ns

    @property
    def thrust_min_g(self) -> float:
        """Least thrust the loop may ask for; none during the take-off ramp."""
        return THRUST_MIN_G if self.takeoff_state is TakeoffState.FLIGHT else 0.0

    def speed_up_limit_m_s(self, now_ns: int) -> float:
        """Largest climb rate allowed now; the take-off ramp begins where the loop gives no thrust at all."""
        limit_m_s = self._speed_up_max_m_s
        if self.takeoff_state is not TakeoffState.RAMPUP:
            return limit_m_s
        start_m_s = self._ramp_start_m_s
        return start_m_s + (limit_m_s - start_m_s) * min(self._ramp_progress(now_ns), 1.0)

    def _step_landed(self, now_ns: int) -> None:
        vehicle = self._vehicle
        if not self.armed:
            self.landed_state = LandedState.ON_GROUND  # PX4 takes whatever is disarmed for landed
            self._contact_ns = None
            return
        if self.landed_state is LandedState.ON_GROUND:
            thrust_builds_up = vehicle.thrust_down_m_s2 < 0.7 * GRAVITY_M_S2
            if not vehicle.on_ground or (self.takeoff_state is TakeoffState.RAMPUP and thrust_builds_up):
                self._lift_off()
        elif vehicle.on_ground and self.takeoff_state is not TakeoffState.RAMPUP and vehicle.presses_down():
            if self._contact_ns is None:
                self._contact_ns = now_ns
            trigger_ns = self._landing_trigger_ns
            if now_ns - self._contact_ns >= trigger_ns:
                self.landed_state = LandedState.ON_GROUND
                self._landed_at_ns = now_ns
            if 3 * (now_ns - self._contact_ns) >= 2 * trigger_ns:
                self.takeoff_state = TakeoffState.READY  # "maybe landed": the motors idle
        else:
            self._contact_ns = None
        if self.landed_state is not LandedState.ON_GROUND:
            if self.mode is Mode.TAKEOFF:
                self.landed_state = LandedState.TAKEOFF
            elif self.mode is Mode.LAND:
                self.landed_state = LandedState.LANDING
            else:
                self.landed_state = LandedState.IN_AIR

    def _lift_off(self) -> None:
        self.landed_state = LandedState.IN_AIR
        self._contact_ns = None
        self._landed_at_ns = None
        self.on_home_moved()

    def _step_auto_disarm(self, now_ns: int) -> None:
        if self._landed_at_ns is not None:
            delay, since = self._parameters.number("COM_DISARM_LAND"), self._landed_at_ns
        else:
            delay, since = self._parameters.number("COM_DISARM_PRFLT"), self._armed_at_ns
        if delay > 0.0 and now_ns - since >= round(delay * SECOND_NS):
            self._disarm()
