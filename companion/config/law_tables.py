"""The table of the law: one class for each kind, which makes the law that is flown."""

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field, PlainValidator, SerializeAsAny

from companion.config.numbers import Gain
from companion.config.registry import KindTable, Registry
from companion.core.law.base import Law
from companion.core.law.intent import IntentGains, IntentHold, IntentLaw
from companion.core.law.paper import paper_gains
from companion.core.law.starling import Gains, StarlingLaw
from companion.core.prediction import Hold, PlainHold, PlainKind, Pull, ReturningHold

HoldKind = Literal["returning", PlainKind]
SATURATION_M, SATURATION_M_S = 1.0, 1.0
"""of the starling law's errors in place and velocity"""
RETURN_MIN_PER_S = 0.1
"""slower, a prediction runs away with its velocity, as with a damping of more than 10 s"""


class LawTable(KindTable):
    """What every law says: the rest of the vehicle reckons with it, whatever the law does."""

    hold: PlainKind = "damped"
    hold_damping_s: Annotated[float, Field(ge=0.05, le=10, allow_inf_nan=False)] = 0.7
    """shorter, a prediction forgets velocity within a tick or two; longer, it runs away with it"""
    a_max_m_s2: Annotated[float, Field(ge=2, le=20, allow_inf_nan=False)] = 5.0
    """most that the law asks for; at least twice what plans ask for (1 m/s^2): the rest keeps the formation against
    gusts"""
    r0_m: Annotated[float, Field(ge=0.1, le=1000, allow_inf_nan=False)] | None = None
    """range of separation, which slots must leave; None: half the spacing"""

    def law(self, r0_m: float) -> Law:
        """The law of one vehicle, with the range of separation resolved."""
        raise NotImplementedError

    def holding(self) -> Hold:
        """How a vehicle that flies this law is predicted, by itself and by all others; a law may have its own."""
        return PlainHold(self.hold, self.hold_damping_s)

    def faults(self) -> Iterator[str]:
        """What is wrong with the values together, as sentences that name the keys."""
        yield from ()


class StarlingTable(LawTable):
    """The default law."""

    kind: Literal["starling"] = "starling"
    hold: HoldKind = "returning"  # type: ignore[assignment]  # one kind more than the others have
    k_s: Gain = 3.0
    k_a: Gain = 3.0
    k_c: Gain = 4.0
    k_v: Gain = 1.0
    k_p: Gain = 0.3

    def law(self, r0_m: float) -> Law:
        """See `LawTable`."""
        return StarlingLaw(
            Gains(
                self.k_s, self.k_a, self.k_c, self.k_v, self.k_p, r0_m, self.a_max_m_s2, SATURATION_M, SATURATION_M_S,
                1.0, vertical=0.0,
            )
        )  # fmt: skip

    def holding(self) -> Hold:
        """See `LawTable`."""
        if self.hold != "returning":
            return super().holding()
        pull = Pull(self.k_v, self.k_p, SATURATION_M, self.a_max_m_s2)
        return ReturningHold(pull, PlainHold("damped", self.hold_damping_s))

    def faults(self) -> Iterator[str]:
        """See `LawTable`."""
        if self.hold == "returning" and self.k_v < RETURN_MIN_PER_S:
            yield (
                f'$.law.k_v must be at least {RETURN_MIN_PER_S:g} 1/s with $.law.hold = "returning", by which a '
                f'predicted velocity fades so, got {self.k_v:g}; or take hold = "damped"'
            )


class PaperTable(LawTable):
    """Eq. (2) of the paper as it stands, within the acceleration limit."""

    kind: Literal["paper"] = "paper"
    hold: PlainKind = "zero"
    k_s: Gain = 3.0
    k_a: Gain = 3.0
    k_c: Gain = 4.0

    def law(self, r0_m: float) -> Law:
        """See `LawTable`."""
        gains = paper_gains(self.k_s, self.k_a, self.k_c, r0_m)
        return StarlingLaw(gains._replace(a_max=self.a_max_m_s2, vertical=0.0))

    def faults(self) -> Iterator[str]:
        """See `LawTable`."""
        if self.hold == "damped":
            yield (
                '$.law.hold must be "zero" (the paper\'s) or "first" with $.law.kind = "paper", got "damped", which is '
                "none of the paper's: leave it out"
            )


class IntentTable(LawTable):
    """Published intent. Of the keys of the hold only the damping counts: the hold is its own."""

    kind: Literal["intent"] = "intent"
    k_s: Gain = 3.0
    k_e: Annotated[float, Field(ge=0.1, le=20, allow_inf_nan=False)] = 4.0
    """tracking of the own intended place (1/s^2): a softer one would not come back from a gust"""
    k_d: Gain = 4.0
    c_g: Annotated[float, Field(ge=0.1, le=10, allow_inf_nan=False)] = 2.0
    """how fast anchors approach each other (1/s): faster, delays of the exchange would ring"""
    c_max_m_s: Annotated[float, Field(ge=0.01, le=5, allow_inf_nan=False)] = 1.0
    """most speed of an anchor against the plan, which the safety radius counts in"""

    @property
    def _gains(self) -> IntentGains:
        return IntentGains(self.k_e, self.k_d, self.c_g, self.c_max_m_s, 1.0, 1.0)

    def law(self, r0_m: float) -> Law:
        """See `LawTable`."""
        apart = Gains(self.k_s, 0.0, 0.0, 0.0, 0.0, r0_m, self.a_max_m_s2, 1.0, 1.0, 1.0, vertical=0.0)
        return IntentLaw(self._gains, apart)

    def holding(self) -> Hold:
        """See `LawTable`."""
        return IntentHold(self._gains, self.a_max_m_s2, self.hold_damping_s)


LAWS = Registry("starling.laws", LawTable, StarlingTable, PaperTable, IntentTable)
"""the kinds of `law.kind`; the first is the default"""
AnyLaw = Annotated[SerializeAsAny[LawTable], PlainValidator(LAWS.validate)]
