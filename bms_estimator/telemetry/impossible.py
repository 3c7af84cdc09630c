"""Likely causes of measured values that cannot be true of a pack, whatever its state."""

import math
from typing import NamedTuple, Self

import numpy as np

from bms_estimator.kernels.alarms.quantities import MAX_SUM_DIFFERENCE, MEAN_HIGH_V, MEAN_LOW_V, MILLI
from bms_estimator.model.arrays import Floats
from bms_estimator.model.pack_model import PackModel
from bms_estimator.settings.alarm_kinds import Quantity

FACTORS = 10, 100, 1000
"""Usual factors between the scales or units of two devices."""
FACTOR_TOLERANCE = 0.1
"""Tolerance of a ratio that shows one of the factors."""
MIN_SWAPPED = 1e7
"""Absolute value from which the two words of a number are assumed to be swapped. A swap of the registers of a float or an
integer changes the number by a factor of 65,536 or more."""
STEPS = 1.0, 0.1, 0.01, 0.001
"""Usual resolutions of integers in protocols."""
WORD_BITS = 16, 32
"""Lengths of integers in protocols."""


class PackBounds(NamedTuple):
    """Bounds of the possible values of one pack. They are far wider than the limits of its alarms."""

    series: int
    max_a: float
    """Highest possible current [A]."""
    range_v: tuple[float, float]
    """Lowest and highest usual voltage of the pack [V]."""
    range_a: float
    """Highest usual current [A]."""

    @classmethod
    def of(cls, cell: PackModel) -> Self:
        """Return the bounds of the model of a whole pack."""
        c = cell.cell
        return cls(c.series_count, cell.possible_a, (c.voltage_min_v, c.voltage_max_v), c.current_max_a)

    def describe(self, quantity: Quantity, sample: np.void, cells_v: Floats) -> tuple[str, str]:
        """Return the likely cause of an impossible value as part of a sentence, and a sentence with value and cause.

        Args:
            quantity: Quantity whose value is impossible (``kernels.alarms.quantities.possible_values``).
            sample: The sample, dtype SAMPLE.
            cells_v: Its cell voltages [V]; empty if there are none.
        """
        if quantity == "current":
            return self._describe_current(float(sample["current_a"]))
        voltage_v, finite_v = float(sample["voltage_v"]), cells_v[np.isfinite(cells_v)]
        with np.errstate(over="ignore"):
            sum_v = float(finite_v.sum()) if finite_v.size == self.series else math.nan
        if quantity == "cells":
            return _describe_cells(sum_v, voltage_v)
        is_usual = MEAN_LOW_V <= sum_v / self.series <= MEAN_HIGH_V
        differs = abs(voltage_v - sum_v) > MAX_SUM_DIFFERENCE * max(abs(voltage_v), abs(sum_v))
        return self._describe_voltage(voltage_v, sum_v if is_usual and differs else math.nan)

    def _describe_current(self, ampere: float) -> tuple[str, str]:
        """Return the likely cause of an impossible current [A], and a sentence with it."""
        text = f"the current cannot be true: {ampere:.6g} A"
        if abs(ampere) <= self.max_a:  # possible, but the sample's voltage is in mV
            cause = _factor_question(MILLI)
            return cause, f"{text} with this voltage ({cause})"
        cause = _current_cause(ampere, self.range_a)
        text += f", and at most {self.max_a:.6g} A are possible"
        return cause, f"{text} ({cause})"

    def _describe_voltage(self, volt: float, sum_v: float) -> tuple[str, str]:
        """Return the likely cause of an impossible voltage, and a sentence with it.

        Args:
            volt: The voltage [V].
            sum_v: Sum of the cell voltages [V]; NaN if it does not contradict the voltage.
        """
        text = f"the pack's voltage cannot be true: {volt:.6g} V"
        if math.isfinite(sum_v):
            cause = _factor_question(volt / sum_v) or (
                "is the output switched off, or is another voltage measured?"
                if volt >= 0.0
                else "are the wires reversed?"
            )
            return cause, f"{text}, and the sum of the cells is {sum_v:.6g} V ({cause})"
        low_v, high_v = self.range_v
        fitting = next((factor for factor in FACTORS if low_v <= volt / factor <= high_v), None)
        if fitting:
            cause = _factor_question(fitting)
        elif abs(volt) >= MIN_SWAPPED:
            cause = "are the words of a 32-bit number swapped?"
        else:
            cause = "are the wires reversed?" if volt < 0.0 else "is pack.series right?"
        return cause, f"{text} of {self.series} cells in series ({cause})"


def _describe_cells(sum_v: float, pack_v: float) -> tuple[str, str]:
    """Return the likely cause of impossible cell voltages, and a sentence with it.

    Args:
        sum_v: Sum of the cell voltages [V].
        pack_v: Voltage of the pack [V].
    """
    cause = _factor_question(sum_v / pack_v) or "are the wires of the cells connected?"
    text = f"the cell voltages cannot be true: their sum is {sum_v:.6g} V, and the pack has {pack_v:.6g} V"
    return cause, f"{text} ({cause})"


def _current_cause(ampere: float, range_a: float) -> str:
    """Return the likely cause of an impossible current, as a question.

    Args:
        ampere: The current [A].
        range_a: Highest usual current [A].
    """
    for bits in WORD_BITS:
        for step_a in STEPS:
            if abs(2**bits * step_a - abs(ampere)) <= range_a:
                return f"is a signed number of {bits} bits read as an unsigned one?"
    if abs(ampere) >= MIN_SWAPPED:
        return "are the words of a 32-bit number swapped?"
    fitting = [factor for factor in FACTORS if abs(ampere) <= factor * range_a]
    return (
        f"is the unit or scale wrong by a factor of {' or '.join(map(str, fitting))}?"
        if fitting
        else "is the sensor broken?"
    )


def _factor_question(ratio: float) -> str:
    """Return the question for a value that is wrong by one of ``FACTORS``; empty for another ratio to the true value."""
    for factor in FACTORS:
        for error in (factor, 1 / factor):
            if abs(ratio / error - 1.0) <= FACTOR_TOLERANCE:
                return f"is the unit or scale wrong by a factor of {factor}?"
    return ""
