"""Intervals between samples, with and without gaps, and the fraction of faulty samples, for the alarm ``sensor_fault``."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bms_estimator.kernels.alarms import FRACTION_S, RECENT_STEPS
from bms_estimator.kernels.cell_model.current_interpolation import GAP_RATIO
from bms_estimator.model.arrays import Floats


@dataclass
class SampleIntervals:
    """Intervals between samples. A value is assumed to hold between two samples, unless there is a gap.

    A gap is much longer than the longest recent interval. Samples that arrive in bursts have one long interval before each
    burst. From the second burst on, these intervals do not count as gaps.

    Attributes:
        gap_s: Minimum length of a gap [s].
    """

    gap_s: float
    _last_s: float = math.nan
    """Time of the last sample [s]."""
    _step_s: float = math.inf
    """Last interval above 0 [s]."""
    _longest_s: float = 0.0
    """Longest recent interval [s]."""
    _longest_at_s: float = -math.inf
    """Time of the last interval that is about as long as ``_longest_s`` [s]."""

    def measure(self, times_s: Floats) -> tuple[Floats, Floats]:
        """Return the interval before each sample, and the time in it for which a value holds.

        Returns:
            Two arrays of shape (n,) [s]. The interval is 0 after the clock was set back. A value holds for the whole
            interval, or for 0 s in a gap.
        """
        passed_s = np.diff(times_s, prepend=self._last_s)
        passed_s = np.where(passed_s > 0.0, passed_s, 0.0)
        before_s = np.concatenate(([self._step_s], passed_s[:-1]))
        observed_s = np.where(passed_s > np.maximum(self.gap_s, GAP_RATIO * before_s), 0.0, passed_s)
        for i in np.flatnonzero(passed_s > self.gap_s).tolist():
            if self._is_regular(float(times_s[i]), float(passed_s[i])):
                observed_s[i] = passed_s[i]
        self._last_s, self._step_s = float(times_s[-1]), float(passed_s[-1]) or self._step_s
        return passed_s, observed_s

    def _is_regular(self, at_s: float, step_s: float) -> bool:
        """Return True if an interval of about this length occurred recently, and record the interval."""
        is_recent = abs(at_s - self._longest_at_s) <= RECENT_STEPS * self._longest_s
        is_regular = is_recent and step_s <= GAP_RATIO * self._longest_s
        if not is_recent or step_s >= self._longest_s:
            self._longest_s, self._longest_at_s = step_s, at_s
        elif GAP_RATIO * step_s >= self._longest_s:
            self._longest_at_s = at_s
        return is_regular


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
