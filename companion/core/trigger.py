"""Event trigger: when the peers can no longer predict this vehicle, and must be told.

error      send when |e_p|^2 + gamma |e_v|^2 >= epsilon^2 + min(kappa |residual|, 0.1 m)^2     (Eq. 4, threshold ours)
switching  send when |e_p|^2 + gamma |e_v|^2 >= delta_i(t)                                (Eqs. 3-5 of the paper)
           delta_i = alpha e^(-beta t) + delta_min if |e_p| + |e_v| > eta, else delta_f
periodic   send every period
all        never closer than t_min, never silent longer than T_max; e = own state - what the peers predict
"""

from math import exp, sqrt
from typing import Literal, NamedTuple

RAISED_MAX_M = 0.1
"""the most by which residuals raise the default trigger's threshold: those of metres would blind the barrier"""
TriggerKind = Literal["error", "switching", "periodic"]


class ErrorTrigger(NamedTuple):
    """Parameters of the default trigger."""

    epsilon_m: float
    gamma_s2: float
    kappa: float


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


def switching_threshold(error_position_2: float, error_velocity_2: float, t_s: float, t: SwitchingTrigger) -> float:
    """delta_i(t) of Eq. (5), with E_i = |e_p| + |e_v| and t_s counted from the start of the flight in formation."""
    dynamic = sqrt(error_position_2) + sqrt(error_velocity_2) > t.eta
    return t.alpha * exp(-t.beta * t_s) + t.delta_min if dynamic else t.delta_f


def switching_exceeds(error_position_2: float, error_velocity_2: float, t_s: float, t: SwitchingTrigger) -> bool:
    """Eq. (4) with the threshold of Eq. (5)."""
    return error_position_2 + t.gamma_s2 * error_velocity_2 >= switching_threshold(
        error_position_2, error_velocity_2, t_s, t
    )


class Spacing(NamedTuple):
    """Bounds on the time between two messages, for every trigger."""

    t_min_s: float
    t_max_s: float

    def decide(self, since_last_s: float, silence_limit_s: float, fired: bool) -> bool:
        """Whether to send now; silence_limit_s is the jittered T_max, so that heartbeats do not bunch."""
        return since_last_s >= silence_limit_s or (fired and since_last_s >= self.t_min_s)
