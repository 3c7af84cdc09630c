"""Sections of a cell file: circuit elements, open-circuit voltage, RC ladder, and bounds of the adaptive law.

Numbers in parentheses are equations of the thesis, and lemmas are those of the thesis. a1..a15 are the parameters of the circuit
elements over SOC. a16..a21 are the parameters of the open-circuit voltage.
"""

import itertools
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from bms_estimator.model.config_file import NotNegative, Positive, Strict

ELEMENTS = {
    "r_ts": (1, "amplitude_ohm", "offset_ohm"),  # (2.5)
    "r_tl": (4, "amplitude_ohm", "offset_ohm"),  # (2.6)
    "c_ts": (7, "amplitude_farad", "offset_farad"),  # (2.7)
    "c_tl": (10, "amplitude_farad", "offset_farad"),  # (2.8)
    "r_s": (13, "amplitude_ohm", "offset_ohm"),  # (2.9)
}
"""Index of the first parameter, key of the amplitude and key of the offset, by element."""
DEFAULT_RATE = 100.0
"""Default rate lambda_x + lambda_y of (3.18), that of most parameters of the shipped cell ``chen_mora`` [1/s]."""
CAPACITANCE_NUMBERS = (2, 3)
"""Positions of C_ts and C_tl in ``ELEMENTS``."""


class Resistance(Strict):
    """Resistance R(SOC) = amplitude e^(-exponent SOC) + offset, (2.5), (2.6), (2.9)."""

    amplitude_ohm: Positive
    exponent: Positive
    offset_ohm: Positive

    @property
    def a(self) -> tuple[float, float, float]:
        """The three parameters in the order of the thesis."""
        return self.amplitude_ohm, self.exponent, self.offset_ohm


class Capacitance(Strict):
    """Capacitance C(SOC) = -amplitude e^(-exponent SOC) + offset, (2.7), (2.8)."""

    amplitude_farad: Positive
    exponent: Positive
    offset_farad: Positive

    @property
    def a(self) -> tuple[float, float, float]:
        """The three parameters in the order of the thesis."""
        return self.amplitude_farad, self.exponent, self.offset_farad


class ChenMoraOcv(Strict):
    """OCV in the form (2.10): E_o(SOC) = -a16 e^(-a17 SOC) + a18 + a19 SOC - a20 SOC^2 + a21 SOC^3."""

    form: Literal["chen-mora"] = "chen-mora"
    amplitude_v: Positive = Field(description="a16")
    exponent: Positive = Field(description="a17")
    constant_v: float = Field(description="a18")
    linear_v: float = Field(description="a19")
    quadratic_v: float = Field(description="a20")
    cubic_v: float = Field(description="a21")

    @property
    def a(self) -> tuple[float, ...]:
        """Parameters a16..a21."""
        return self.amplitude_v, self.exponent, self.constant_v, self.linear_v, self.quadratic_v, self.cubic_v


class TableOcv(Strict):
    """OCV at 25 C as a table with monotone interpolation (PCHIP), with its error, hysteresis and temperature coefficient."""

    form: Literal["table"]
    soc: tuple[Annotated[float, Field(ge=0, le=1)], ...] = Field(min_length=4, description="increasing, from 0 to 1")
    ocv_v: tuple[Positive, ...] = Field(
        min_length=4,
        description="open-circuit voltage at each SOC, increasing: after discharge, or with hysteresis_v the mean of the "
        "voltages after discharge and after charge",
    )
    error_v: tuple[Positive, ...] | None = Field(default=None, description="standard deviation of ocv_v")
    hysteresis_v: tuple[NotNegative, ...] | None = Field(
        default=None, description="half of the difference of the open-circuit voltage after charge and after discharge"
    )
    per_kelvin_v: tuple[float, ...] | None = Field(default=None, description="temperature coefficient of ocv_v [V/K]")

    @model_validator(mode="after")
    def _increasing(self) -> Self:
        if len(self.soc) != len(self.ocv_v):
            raise ValueError(f"{len(self.soc)} SOCs but {len(self.ocv_v)} voltages: give one voltage for each SOC")
        for name, values in (("soc", self.soc), ("ocv_v", self.ocv_v)):
            steps = np.diff(values)
            if not (steps > 0).all():
                i = int(np.argmax(steps <= 0))
                raise ValueError(f"{name} must increase, but {values[i + 1]} follows {values[i]} at point {i + 2}")
        if (self.soc[0], self.soc[-1]) != (0.0, 1.0):
            raise ValueError(f"soc runs from {self.soc[0]} to {self.soc[-1]}: give the voltages at 0 and at 1, too")
        for name in ("error_v", "hysteresis_v", "per_kelvin_v"):
            column = getattr(self, name)
            if column is not None and len(column) != len(self.soc):
                raise ValueError(f"{len(self.soc)} SOCs but {len(column)} of {name}: give one for each SOC")
        return self


class Ladder(Strict):
    """RC ladder: series resistance and RC pairs with fixed time constants (``kernels.cell_model.rc_ladder.TAU_S``).

    R(SOC, T) is the sum of two parts, given at 25 C. The weak part has the low activation energy, the strong part the high
    one. Each part is scaled with the Arrhenius factor of its activation energy.
    """

    soc: tuple[Annotated[float, Field(ge=0, le=1)], ...] = Field(min_length=2, description="increasing")
    weak_ohm: tuple[tuple[NotNegative, ...], ...] = Field(
        min_length=7,
        max_length=7,
        description="part with the low activation energy at 25 C: series resistance, then resistance of each RC pair, one value "
        "for each SOC",
    )
    strong_ohm: tuple[tuple[NotNegative, ...], ...] = Field(
        min_length=7,
        max_length=7,
        description="part with the high activation energy at 25 C: series resistance, then resistance of each RC pair, one value "
        "for each SOC",
    )
    std: Positive = Field(
        description="relative standard deviation of a common factor of all resistances between cells of this type"
    )
    error_v: Positive = Field(description="RMS voltage error of the fit to the captures, at 25 C")
    temperature_c: tuple[float, float] = Field(description="lowest and highest cell temperature of the captures")

    @model_validator(mode="after")
    def _equal_lengths(self) -> Self:
        if any(b <= a for a, b in itertools.pairwise(self.soc)):
            raise ValueError("soc must increase")
        for name in ("weak_ohm", "strong_ohm"):
            for row in getattr(self, name):
                if len(row) != len(self.soc):
                    raise ValueError(f"{len(self.soc)} SOCs but {len(row)} values in a row of {name}")
        if self.temperature_c[0] > self.temperature_c[1]:
            raise ValueError("temperature_c: the lowest temperature comes first")
        return self


class Bounds(Strict):
    """Settings of the adaptive law (3.18) for one parameter: bounds, weight of each bound, and initial value."""

    upper: Positive = Field(description="a_iu")
    lower: Positive = Field(description="a_il")
    weight_upper: Annotated[float, Field(ge=0)] = Field(description="lambda_x [1/s]")
    weight_lower: Annotated[float, Field(ge=0)] = Field(description="lambda_y [1/s]")
    initial: Positive | None = Field(default=None, description="a_i(t0); default: the limit of Lemma 4.1.3")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.lower > self.upper:
            raise ValueError(f"lower = {self.lower} is above upper = {self.upper}")
        if self.weight_upper + self.weight_lower <= 0:
            raise ValueError("weight_upper + weight_lower must be above 0")
        return self

    @property
    def rate(self) -> float:
        """Rate at which the parameter approaches its limit, lambda_x + lambda_y [1/s]."""
        return self.weight_upper + self.weight_lower

    @property
    def limit(self) -> float:
        """Value to which the parameter converges, whatever the data are (Lemma 4.1.3)."""
        return (self.weight_upper * self.upper + self.weight_lower * self.lower) / self.rate
