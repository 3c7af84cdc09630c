"""Measured quantities that alarms need, and the loss of their measurement."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.alarms import MAX_SPACING_FRACTION, MIN_RESTORED_S
from bms_estimator.model.arrays import Floats
from bms_estimator.settings.alarm_kinds import Quantity

Counts = NDArray[np.int64]
QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
"""All measured quantities."""


@dataclass
class _Input:
    """State of one measured quantity.

    Attributes:
        max_count: Largest number of values in a sample so far; 0: the quantity was never measured.
        lost: True after values were missing for longer than the delay.
    """

    max_count: int = 0
    lost: bool = False
    _missing_s: float | None = None
    """Time since the beginning of the present series of samples without a value [s]; None: the last sample had all values."""
    _restored_s: float | None = None
    """Time with values since the loss [s]; None: no value has arrived since the loss."""
    _value_age_s: float = 0.0
    """Time since the last value of a lost quantity [s]."""

    def update(self, times_s: Floats, steps_s: Floats, counts: Counts, lost_s: float) -> list[float]:
        """Process the number of values in each sample. Return the times at which the quantity was lost or measured again [s].

        A negative number (unusable values) counts as missing also if the quantity was never measured.
        """
        expected = np.maximum.accumulate(np.concatenate(([self.max_count], counts)))[1:]
        self.max_count = int(expected[-1])
        present = counts >= expected
        if not self.lost and bool(present.all()):
            self._missing_s = None
            return []
        steps = zip(times_s.tolist(), steps_s.tolist(), present.tolist(), strict=True)
        return [at_s for at_s, step_s, is_present in steps if self._step(step_s, lost_s, present=is_present)]

    def _step(self, step_s: float, lost_s: float, *, present: bool) -> bool:
        """Process one sample. Return True if ``lost`` has changed."""
        was_lost, follows_value = self.lost, self._missing_s is None
        self._value_age_s += step_s
        self._missing_s = None if present else 0.0 if follows_value else (self._missing_s or 0.0) + step_s
        if self._missing_s is not None:
            if self._missing_s >= lost_s:
                self.lost, self._restored_s = True, None
        elif self.lost:
            continues = follows_value or self._value_age_s <= MAX_SPACING_FRACTION * lost_s
            self._restored_s = (
                self._restored_s + self._value_age_s if continues and self._restored_s is not None else 0.0
            )
            self._value_age_s, self.lost = 0.0, self._restored_s < max(lost_s, MIN_RESTORED_S)
        return self.lost != was_lost


@dataclass
class Inputs:
    """State of all measured quantities of one pack.

    Args:
        lost_s: Time of samples without a value after which a quantity is lost, and time of samples with values after which
            it is measured again, at least ``MIN_RESTORED_S`` [s].
        series: Number of cells in series, the maximum number of cell voltages.
    """

    lost_s: float
    series: int
    _inputs: dict[Quantity, _Input] = field(default_factory=lambda: {name: _Input() for name in QUANTITIES})

    @property
    def lost(self) -> tuple[Quantity, ...]:
        """Quantities that were measured before and are missing, or whose values are unusable."""
        return tuple(name for name, each in self._inputs.items() if each.lost)

    @property
    def saved_state(self) -> dict[str, Any]:
        """State for ``restore`` after a restart."""
        return {name: [each.max_count, each.lost] for name, each in self._inputs.items() if each.max_count or each.lost}

    @property
    def cells(self) -> int:
        """Largest number of cell voltages in a sample so far."""
        return self._inputs["cells"].max_count

    def were_measured(self, names: Collection[Quantity]) -> bool:
        """Return True if all these quantities were measured at some time."""
        return all(self._inputs[name].max_count for name in names)

    def expect(self, counts: Mapping[Quantity, int]) -> None:
        """Expect at least these numbers of values in a sample, because an earlier run measured them."""
        for name, count in counts.items():
            self._inputs[name].max_count = max(self._inputs[name].max_count, count)

    def update(self, times_s: Floats, steps_s: Floats, counts: Mapping[Quantity, Counts]) -> list[float]:
        """Process the number of values in each sample.

        Args:
            times_s: Time of each sample [s], shape (n,).
            steps_s: Time since the previous sample [s], 0 after a gap, shape (n,).
            counts: Number of values in each sample by quantity, negative for unusable ones, each of shape (n,).

        Returns:
            Times at which a quantity was lost or measured again [s].
        """
        bounded = {**counts, "cells": np.minimum(counts["cells"], self.series)}
        return [
            at_s
            for name, each in self._inputs.items()
            for at_s in each.update(times_s, steps_s, bounded[name], self.lost_s)
        ]

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Restore the state of an earlier run, which may have had more cells in series.

        Raises:
            ValueError, TypeError: ``saved`` is damaged.
        """
        for name, each in self._inputs.items():
            max_count, lost = saved.get(name, (0, False))
            if not isinstance(max_count, int) or max_count < 0 or not isinstance(lost, bool):
                raise ValueError(f"{name}: measured = {max_count}, lost = {lost}")
            each.max_count = min(max_count, self.series if name == "cells" else 1)  # ``series`` may have been edited
            each.lost = lost


def count_values(values: Floats) -> Counts:
    """Return 1 for each sample with a value, otherwise 0; shape (n,)."""
    return np.isfinite(values).astype(np.int64)
