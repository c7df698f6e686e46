"""The paper's switching trigger, Eqs. (3) to (5).

send when |e_p|^2 + gamma |e_v|^2 >= delta_i(t)
delta_i = alpha e^(-beta t) + delta_min if |e_p| + |e_v| > eta, else delta_f
"""

from math import exp, sqrt
from typing import NamedTuple

from companion.core.monitor import PeerMotion, prediction_error_bound_m
from companion.core.trigger.base import Situation


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
