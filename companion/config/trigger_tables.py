"""The table of the trigger: one class for each kind, which makes the trigger that is flown."""

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field, PlainValidator, SerializeAsAny

from companion.config.numbers import NotNegative, Positive
from companion.config.registry import KindTable, Registry
from companion.core.trigger.base import Trigger
from companion.core.trigger.error import ErrorTrigger
from companion.core.trigger.periodic import PeriodicTrigger
from companion.core.trigger.switching import SwitchingTrigger

Gamma = Annotated[float, Field(ge=1e-4, le=100, allow_inf_nan=False)]
"""an error of velocity counts as an error of place sqrt(gamma) seconds later (s^2)"""


class TriggerTable(KindTable):
    """What holds whatever the kind."""

    t_min_s: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 0.05
    """longer, an event would wait for longer than the safety radius allows for"""
    t_max_s: Annotated[float, Field(ge=0.5, le=60, allow_inf_nan=False)] = 10.0
    """shorter, a peer would be stale between two of its ticks"""
    near_period_s: Annotated[float, Field(ge=0.05, le=0.2, allow_inf_nan=False)] = 0.1
    """how often vehicles speak that are near each other; never off, since without it the safety filter does not hold
    under loss"""

    def trigger(self) -> Trigger:
        """The trigger of one vehicle."""
        raise NotImplementedError

    def faults(self) -> Iterator[str]:
        """What only several values of this table together show, as sentences."""
        if self.t_min_s > self.near_period_s:
            most = f"$.trigger.near_period_s = {self.near_period_s:g} s"
            yield f"$.trigger.t_min_s must be <= {most}, got {self.t_min_s:g}"
        if self.t_min_s >= self.t_max_s:
            yield f"$.trigger.t_min_s must be below $.trigger.t_max_s = {self.t_max_s:g} s, got {self.t_min_s:g}"


class ErrorTable(TriggerTable):
    """The default trigger."""

    kind: Literal["error"] = "error"
    epsilon_m: Annotated[float, Field(ge=0.01, le=5, allow_inf_nan=False)] = 0.3
    """below a centimetre every tick is an event; the safety radius grows with it"""
    gamma_s2: Gamma = 0.1
    kappa: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 0.3
    epsilon_nu_m_s: Annotated[float, Field(ge=0.01, le=5, allow_inf_nan=False)] = 0.03
    """of the common velocity, where no plan gives one"""
    epsilon_c_m: Annotated[float, Field(ge=0.001, le=5, allow_inf_nan=False)] = 0.005
    """of the intended place, with `law.kind = "intent"`: it is known without noise"""
    kappa_c: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 0.8

    def trigger(self) -> Trigger:
        """See `TriggerTable`."""
        return ErrorTrigger(
            self.epsilon_m, self.gamma_s2, self.kappa, self.epsilon_nu_m_s, self.epsilon_c_m, self.kappa_c
        )


class SwitchingTable(TriggerTable):
    """Eq. (5) of the paper."""

    kind: Literal["switching"] = "switching"
    gamma_s2: Gamma = 0.1
    alpha: NotNegative = 0.1
    beta: NotNegative = 0.3
    delta_min: Positive = 0.01
    delta_f: Positive = 0.02
    eta: NotNegative = 0.3

    def trigger(self) -> Trigger:
        """See `TriggerTable`."""
        return SwitchingTrigger(self.gamma_s2, self.alpha, self.beta, self.delta_min, self.delta_f, self.eta)


class PeriodicTable(TriggerTable):
    """At a fixed rate."""

    kind: Literal["periodic"] = "periodic"
    period_s: Positive = 0.05

    def trigger(self) -> Trigger:
        """See `TriggerTable`."""
        return PeriodicTrigger(self.period_s)

    def faults(self) -> Iterator[str]:
        """See `TriggerTable`."""
        yield from super().faults()
        if self.period_s < self.t_min_s:
            yield f"$.trigger.period_s must be >= $.trigger.t_min_s = {self.t_min_s:g} s, got {self.period_s:g}"


TRIGGERS = Registry("starling.triggers", TriggerTable, ErrorTable, SwitchingTable, PeriodicTable)
"""the kinds of `trigger.kind`; the first is the default"""
AnyTrigger = Annotated[SerializeAsAny[TriggerTable], PlainValidator(TRIGGERS.validate)]
