"""Measured quantities that alarms need: which were measured before, and which of these are lost."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.arrays import Floats
from bms_estimator.settings.alarm_limits import Quantity

Counts = NDArray[np.int64]
QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
LOST: dict[Quantity, str] = {
    "voltage": "the voltage is no longer measured",
    "current": "the current is no longer measured",
    "temperature": "the temperature is no longer measured",
    "cells": "cell voltages are missing that were measured before",
}
"""Reasons for people."""


@dataclass
class _Input:
    """One quantity.

    Attributes:
        measured: Largest number of values that a sample had; 0: it was never measured.
        lost: Values have been missing for longer than the delay.
    """

    measured: int = 0
    lost: bool = False
    _missing_s: float | None = None
    """Time since the first sample in a row that lacks a value [s]; None: the last sample had all."""
    _back_s: float | None = None
    """Time since the first value after a loss [s]; None: no value yet."""

    def take(self, times_s: Floats, steps_s: Floats, counts: Counts, lost_s: float) -> list[float]:
        """Take the number of values in each sample. Returns the times at which it was lost or measured again [s]."""
        known = np.maximum.accumulate(np.concatenate(([self.measured], counts)))[1:]
        self.measured = int(known[-1])
        present = counts >= known
        if not self.lost and bool(present.all()):
            self._missing_s = None
            return []
        steps = zip(times_s.tolist(), steps_s.tolist(), present.tolist(), strict=True)
        return [at_s for at_s, step_s, there in steps if self._step(step_s, lost_s, present=there)]

    def _step(self, step_s: float, lost_s: float, *, present: bool) -> bool:
        """Take one sample. Returns whether ``lost`` has changed."""
        before = self.lost
        self._missing_s = None if present else 0.0 if self._missing_s is None else self._missing_s + step_s
        if self._missing_s is not None and self._missing_s >= lost_s:
            self.lost, self._back_s = True, None
        elif self.lost and (present or self._back_s is not None):
            self._back_s = 0.0 if self._back_s is None else self._back_s + step_s
            self.lost = self._back_s < lost_s
        return self.lost != before


@dataclass
class Inputs:
    """All quantities of one pack.

    Args:
        lost_s: A quantity is lost after this time without a value, and measured again after this time with values [s].
        series: Cells in series: more cell voltages than these are not expected.
    """

    lost_s: float
    series: int
    _inputs: dict[Quantity, _Input] = field(default_factory=lambda: {name: _Input() for name in QUANTITIES})

    @property
    def lost(self) -> tuple[Quantity, ...]:
        """Quantities that were measured before and are missing."""
        return tuple(name for name, each in self._inputs.items() if each.lost)

    @property
    def kept(self) -> dict[str, Any]:
        """State that outlives a restart, as ``restore`` takes it."""
        return {name: [each.measured, each.lost] for name, each in self._inputs.items() if each.measured}

    def measured(self, names: Collection[Quantity]) -> bool:
        """Return True if all of these were measured at some time."""
        return all(self._inputs[name].measured for name in names)

    def take(self, times_s: Floats, steps_s: Floats, counts: Mapping[Quantity, Counts]) -> list[float]:
        """Take samples.

        Args:
            times_s: Shape (n,): time of each sample [s].
            steps_s: Shape (n,): time since the sample before, 0 after a gap [s].
            counts: Shape (n,) each: number of values of a quantity in each sample.

        Returns:
            Times at which a quantity was lost or measured again [s].
        """
        bounded = {**counts, "cells": np.minimum(counts["cells"], self.series)}
        return [
            at_s
            for name, each in self._inputs.items()
            for at_s in each.take(times_s, steps_s, bounded[name], self.lost_s)
        ]

    def restore(self, kept: Mapping[str, Any]) -> None:
        """Go on from the state that an earlier run has saved.

        Raises:
            ValueError, TypeError: It is damaged.
        """
        for name, each in self._inputs.items():
            measured, lost = kept.get(name, (0, False))
            if not 0 <= int(measured) <= max(self.series, 1) or not isinstance(lost, bool):
                raise ValueError(f"{name}: measured = {measured}, lost = {lost}")
            each.measured, each.lost = int(measured), lost


def counted(values: Floats) -> Counts:
    """Shape (n,): 1 where a sample has a value, and 0 where it has none."""
    return np.isfinite(values).astype(np.int64)
