"""Event trigger: when the peers can no longer predict this vehicle, and must be told.

error      send when |e_p|^2 + gamma |e_v|^2 >= epsilon^2 + min(kappa |residual|, 0.1 m)^2     (Eq. 4, threshold ours)
switching  send when |e_p|^2 + gamma |e_v|^2 >= delta_i(t)                                (Eqs. 3-5 of the paper)
           delta_i = alpha e^(-beta t) + delta_min if |e_p| + |e_v| > eta, else delta_f
periodic   send every period
all        never silent longer than T_max; e = own state - what the peers predict

What an error fires is never closer than t_min to the message before. Near mode (`core.near`) comes on top of each.

Each kind is a class that says when it fires and how far, while nothing is lost, a vehicle may be from what its peers
predict: the safety radius is made from that, so no kind can be flown without saying it.
"""

from math import exp, hypot, sqrt
from typing import Literal, NamedTuple, Protocol

from companion.core.monitor import PeerMotion, prediction_error_bound_m, unheard_error_m

RAISED_MAX_M = 0.1
"""the most by which residuals raise the default trigger's threshold: those of metres would blind the barrier"""
TriggerKind = Literal["error", "switching", "periodic"]


class Situation(NamedTuple):
    """What a trigger decides upon."""

    error_position_2: float
    """squared distance of the own position from what the peers predict (m^2)"""
    error_velocity_2: float
    """the same of the velocity (m^2/s^2)"""
    mean_residual_2: float
    """squared mean residual of the formation (m^2)"""
    formation_s: float
    """time since the vehicle flies in formation"""
    time_ns: int
    """own clock; each vehicle's is shifted by its own part of a second, so that periods do not end together"""
    sent_ns: int
    """when the last message was sent, by the same clock"""


class Trigger(Protocol):
    """When to tell the peers, and what they may be wrong by meanwhile."""

    def fires(self, now: Situation) -> bool:
        """Whether a message is wanted, t_min aside."""

    def error_bound_m(self, motion: PeerMotion) -> float:
        """Bound on the peers' prediction error while nothing is lost (m)."""

    @property
    def waits(self) -> bool:
        """Whether t_min holds a message back: a period is its own bound, and would drift by it."""

    @property
    def cause(self) -> str:
        """The keys of fleet.toml that the bound comes from, with their values, for messages."""


class ErrorTrigger(NamedTuple):
    """Parameters of the default trigger."""

    epsilon_m: float
    gamma_s2: float
    kappa: float

    def fires(self, now: Situation) -> bool:
        """Eq. (4) with the threshold epsilon, raised by the residual."""
        return exceeds(now.error_position_2, now.error_velocity_2, now.mean_residual_2, self)

    def error_bound_m(self, motion: PeerMotion) -> float:
        """The raised threshold, and what the latency adds."""
        return prediction_error_bound_m(hypot(self.epsilon_m, RAISED_MAX_M), self.gamma_s2, motion)

    @property
    def waits(self) -> bool:
        """True: noise may fire twice in a row."""
        return True

    @property
    def cause(self) -> str:
        """Its threshold."""
        return f"$.trigger.epsilon_m = {self.epsilon_m:g} m"


def exceeds(error_position_2: float, error_velocity_2: float, mean_residual_2: float, t: ErrorTrigger) -> bool:
    """Whether the squared errors (m^2, m^2/s^2) reach the threshold; the squared mean residual (m^2) raises it."""
    raised_2 = min(t.kappa * t.kappa * mean_residual_2, RAISED_MAX_M * RAISED_MAX_M)
    return error_position_2 + t.gamma_s2 * error_velocity_2 >= t.epsilon_m * t.epsilon_m + raised_2


class SwitchingTrigger(NamedTuple):
    """Parameters of the paper's switching rule, Eq. (5)."""

    gamma_s2: float
    alpha: float
    beta: float
    delta_min: float
    delta_f: float
    eta: float

    def fires(self, now: Situation) -> bool:
        """Eq. (4) with the threshold of Eq. (5)."""
        return switching_exceeds(now.error_position_2, now.error_velocity_2, now.formation_s, self)

    def error_bound_m(self, motion: PeerMotion) -> float:
        """The largest threshold that ever is in force, and what the latency adds."""
        return prediction_error_bound_m(sqrt(max(self.alpha + self.delta_min, self.delta_f)), self.gamma_s2, motion)

    @property
    def waits(self) -> bool:
        """True: noise may fire twice in a row."""
        return True

    @property
    def cause(self) -> str:
        """Its thresholds."""
        return f"$.trigger.alpha = {self.alpha:g}, delta_min = {self.delta_min:g} and delta_f = {self.delta_f:g} m^2"


def switching_threshold(error_position_2: float, error_velocity_2: float, t_s: float, t: SwitchingTrigger) -> float:
    """delta_i(t) of Eq. (5), with E_i = |e_p| + |e_v| and t_s counted from the start of the flight in formation."""
    dynamic = sqrt(error_position_2) + sqrt(error_velocity_2) > t.eta
    return t.alpha * exp(-t.beta * t_s) + t.delta_min if dynamic else t.delta_f


def switching_exceeds(error_position_2: float, error_velocity_2: float, t_s: float, t: SwitchingTrigger) -> bool:
    """Eq. (4) with the threshold of Eq. (5)."""
    return error_position_2 + t.gamma_s2 * error_velocity_2 >= switching_threshold(
        error_position_2, error_velocity_2, t_s, t
    )


class PeriodicTrigger(NamedTuple):
    """One message in each period, whatever the errors."""

    period_s: float

    def fires(self, now: Situation) -> bool:
        """Whether a period has ended since the last message.

        The ends lie on a fixed grid of the clock, not one period after each message: control ticks that do not divide
        the period would else stretch every one of them to the next tick.
        """
        period_ns = max(round(self.period_s * 1e9), 1)
        return now.time_ns // period_ns > now.sent_ns // period_ns

    def error_bound_m(self, motion: PeerMotion) -> float:
        """What a vehicle can do unseen in one period, or in T_max where that is shorter, and the latency."""
        return unheard_error_m(min(self.period_s, motion.t_max_s) + motion.latency_s, motion)

    @property
    def waits(self) -> bool:
        """False."""
        return False

    @property
    def cause(self) -> str:
        """Its period."""
        return f"$.trigger.period_s = {self.period_s:g} s"


class Spacing(NamedTuple):
    """Bounds on the time between two messages, for every trigger."""

    t_min_s: float
    t_max_s: float

    def decide(self, since_last_s: float, silence_limit_s: float, fired: bool) -> bool:
        """Whether to send now; silence_limit_s is the jittered T_max, so that heartbeats do not bunch."""
        return since_last_s >= silence_limit_s or (fired and since_last_s >= self.t_min_s)
