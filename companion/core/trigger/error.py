"""The default trigger: Eq. (4) of the paper with a fixed threshold, raised a little by the formation's residual.

send when |e_p|^2 + gamma |e_v|^2 >= epsilon^2 + min(kappa |residual|, 0.1 m)^2

and, where no motion is shared, when |e_nu| >= epsilon_nu, the error of the published common velocity; and, where the
law publishes its intent (`core.law.intent`), when the intended place is off by max(epsilon_c, kappa_c |residual|).
"""

from math import hypot
from typing import NamedTuple

from companion.core.law.intent import IntentTrigger, anchor_exceeds
from companion.core.monitor import PeerMotion, prediction_error_bound_m
from companion.core.trigger.base import Situation

RAISED_MAX_M = 0.1
"""the most by which residuals raise the threshold: those of metres would blind the barrier"""


class ErrorTrigger(NamedTuple):
    """Parameters of the default trigger."""

    epsilon_m: float
    gamma_s2: float
    kappa: float
    epsilon_nu_m_s: float = 0.03
    epsilon_c_m: float = 0.005
    kappa_c: float = 0.8

    def fires(self, now: Situation) -> bool:
        """Eq. (4) with the threshold epsilon, raised by the residual; the common velocity's own threshold; the
        intended place's."""
        if now.error_common_2 >= self.epsilon_nu_m_s * self.epsilon_nu_m_s:
            return True
        if now.error_told_m > 0.0:
            intent = IntentTrigger(self.epsilon_c_m, self.kappa_c)
            if anchor_exceeds(now.error_told_m * now.error_told_m, now.mean_residual_2, intent):
                return True
        return exceeds(now.error_position_2, now.error_velocity_2, now.mean_residual_2, self)

    def error_bound_m(self, motion: PeerMotion) -> float:
        """The raised threshold, and what the latency adds."""
        raised_m = RAISED_MAX_M if self.kappa > 0.0 else 0.0
        return prediction_error_bound_m(hypot(self.epsilon_m, raised_m), self.gamma_s2, motion)

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
