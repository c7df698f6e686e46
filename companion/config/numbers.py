"""Kinds of number in fleet.toml with their bounds, and the base of its tables."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Real = Annotated[float, Field(ge=-1e5, le=1e5, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, le=1e5, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, le=1e5, allow_inf_nan=False)]
Gain = Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)]
Noise = Annotated[float, Field(ge=0, le=5, allow_inf_nan=False)]
"""standard deviation that an estimator, or the air, is assumed to have; with more nobody flies in formation"""
Wait = Annotated[float, Field(ge=1, le=3600, allow_inf_nan=False)]
"""a time for which a vehicle waits: a second at least, since the exchange takes some; no longer than batteries last"""
Wind = Annotated[float, Field(ge=-50, le=50, allow_inf_nan=False)]
"""of the simulated air (m/s); no multicopter stands in more"""
Percent = Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)]
VehicleId = Annotated[int, Field(ge=1, le=250)]


class Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)
