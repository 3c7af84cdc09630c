"""Fraction of samples that are lost or unusable, the value of the alarm ``sensor_fault``."""

import math
from typing import NamedTuple

import numpy as np

from bms_estimator.kernels.alarms import FRACTION_S
from bms_estimator.model.arrays import Floats
from bms_estimator.telemetry.alarms.sample_intervals import SampleIntervals

UNUSABLE_KINDS = "not_finite", "range", "saturated"
"""Kinds of dropped samples that indicate a sensor fault."""


class SampleCounts(NamedTuple):
    """Numbers of samples since start."""

    good: int
    """Samples that the estimator accepted."""
    bad: int
    """Samples that were lost on the line, damaged, or rejected by the estimator."""


class FaultyFraction:
    """Fraction of lost and unusable samples between two calls of ``update``."""

    def __init__(self) -> None:
        self._intervals = SampleIntervals(math.inf)  # no interval is a gap, because losses are counted in gaps, too
        self._counts: SampleCounts | None = None
        self._counted_s = -math.inf

    def update(self, at_s: float, counts: SampleCounts) -> tuple[Floats, float] | None:
        """Return the time since the last call [s], shape (1,), and the fraction; None before ``FRACTION_S`` has passed.

        The fraction is NaN without a sample.

        Args:
            at_s: Time of the last sample on the samples' clock [s].
            counts: Numbers of samples since start.
        """
        if 0.0 <= at_s - self._counted_s < FRACTION_S:
            return None
        before, self._counts, self._counted_s = self._counts, counts, at_s
        _, observed_s = self._intervals.measure(np.array([at_s]))
        good, bad = (counts.good - before.good, counts.bad - before.bad) if before else (0, 0)
        return observed_s, bad / (good + bad) if good + bad > 0 else math.nan
