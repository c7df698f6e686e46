"""The tables of law and trigger: which are chosen, and their parameters."""

from typing import Annotated, Literal

from pydantic import Field

from companion.config.numbers import Gain, NotNegative, Positive, Table
from companion.core.prediction import HoldKind
from companion.core.trigger import TriggerKind


class LawTable(Table):
    """Gains of the law."""

    kind: Literal["starling", "paper"] = "starling"
    hold: HoldKind = "damped"
    hold_damping_s: Annotated[float, Field(ge=0.05, le=10, allow_inf_nan=False)] = 0.7
    """shorter, a prediction forgets velocity within a tick or two; longer, it runs away with it"""
    k_s: Gain = 3.0
    k_a: Gain = 3.0
    k_c: Gain = 4.0
    k_v: Gain = 1.0
    k_p: Gain = 0.3
    a_max_m_s2: Annotated[float, Field(ge=2, le=20, allow_inf_nan=False)] = 5.0
    """at least twice what plans ask for (1 m/s^2): the rest keeps the formation against gusts"""
    r0_m: Annotated[float, Field(ge=0.1, le=1000, allow_inf_nan=False)] | None = None
    """range of separation; None: half the spacing"""


class TriggerTable(Table):
    """When to tell the peers."""

    kind: TriggerKind = "error"
    epsilon_m: Annotated[float, Field(ge=0.01, le=5, allow_inf_nan=False)] = 0.3
    """below a centimetre every tick is an event; the safety radius grows with it"""
    gamma_s2: Annotated[float, Field(ge=1e-4, le=100, allow_inf_nan=False)] = 0.1
    """an error of velocity counts as an error of place sqrt(gamma) seconds later"""
    kappa: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 0.3
    t_min_s: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 0.05
    """longer, an event would wait for longer than the safety radius allows for"""
    t_max_s: Annotated[float, Field(ge=0.5, le=60, allow_inf_nan=False)] = 10.0
    """shorter, a peer would be stale between two of its ticks"""
    period_s: Positive = 0.05
    """of kind "periodic" """
    near_period_s: Annotated[float, Field(ge=0.05, le=0.2, allow_inf_nan=False)] = 0.1
    """how often vehicles speak that are near each other; never off, since without it the safety filter does not hold
    under loss"""
    alpha: NotNegative = 0.1
    beta: NotNegative = 0.3
    delta_min: Positive = 0.01
    delta_f: Positive = 0.02
    eta: NotNegative = 0.3
