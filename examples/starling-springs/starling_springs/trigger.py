"""A trigger that loses its patience: the longer a vehicle has been silent, the smaller an error makes it speak.

send when |e_p|^2 + gamma |e_v|^2 >= (epsilon max(1 - t/patience, least))^2,    t since the last message
"""

from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from companion.config.trigger_tables import TriggerTable
from companion.core.monitor import PeerMotion, prediction_error_bound_m
from companion.core.trigger.base import Situation


class ImpatientTable(TriggerTable):
    """[trigger] with kind = "impatient"."""

    kind: Literal["impatient"] = "impatient"
    epsilon_m: Annotated[float, Field(ge=0.05, le=5, allow_inf_nan=False)] = 0.3
    gamma_s2: Annotated[float, Field(ge=1e-3, le=10, allow_inf_nan=False)] = 0.1
    patience_s: Annotated[float, Field(ge=1, le=60, allow_inf_nan=False)] = 10.0
    least: Annotated[float, Field(ge=0.1, le=1, allow_inf_nan=False)] = 0.4

    def trigger(self) -> "ImpatientTrigger":
        """The trigger of one vehicle."""
        return ImpatientTrigger(self.epsilon_m, self.gamma_s2, self.patience_s, self.least)


class ImpatientTrigger(NamedTuple):
    """See above; `Trigger` of `companion.core.trigger.base`."""

    epsilon_m: float
    gamma_s2: float
    patience_s: float
    least: float

    def fires(self, now: Situation) -> bool:
        """Whether the error is above what is left of the threshold."""
        silent_s = (now.time_ns - now.sent_ns) * 1e-9
        threshold_m = self.epsilon_m * max(1.0 - silent_s / self.patience_s, self.least)
        return now.error_position_2 + self.gamma_s2 * now.error_velocity_2 >= threshold_m * threshold_m

    def error_bound_m(self, motion: PeerMotion) -> float:
        """That of the largest threshold."""
        return prediction_error_bound_m(self.epsilon_m, self.gamma_s2, motion)

    @property
    def waits(self) -> bool:
        """True: noise may fire twice in a row."""
        return True

    @property
    def cause(self) -> str:
        """Its threshold."""
        return f"$.trigger.epsilon_m = {self.epsilon_m:g} m"
