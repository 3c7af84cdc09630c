"""Buffer of samples for the alarms, and the intervals between samples."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.forecast.forecast import FORECAST, ForecastRows
from bms_estimator.kernels.cell_model.current_interpolation import GAP_RATIO
from bms_estimator.kernels.trace import TRACE
from bms_estimator.model.arrays import Floats
from bms_estimator.model.sample import SAMPLE, CellBlock, SampleBlock

INITIAL_ROWS = 256
"""Initial capacity of a buffer [rows]."""
RECENT_STEPS = 4.0
"""Maximum time between two long intervals that count as regular, in multiples of the longer interval."""
_NO_EXTREMES = np.array([math.nan, math.nan, 0.0])
"""Result of ``_cell_extremes`` for a sample without cell voltages."""


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
    _step_s: float = math.inf
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


class SampleBuffer:
    """Samples that the alarms have not evaluated yet, with their trace, forecasts and the extremes of their cell voltages.

    Attributes:
        size: Number of samples.
    """

    def __init__(self) -> None:
        self._samples, self._traces, self._forecasts = _Rows(SAMPLE), _Rows(TRACE), _Rows(FORECAST)
        self._extremes = _Rows(np.float64, (3,))

    @property
    def size(self) -> int:
        """Number of samples."""
        return self._samples.size

    def add(self, block: SampleBlock, trace: TraceBlock, cells: CellBlock, forecasts: ForecastRows) -> None:
        """Append a block."""
        self._samples.add(block, block.size)
        self._traces.add(trace, trace.size)
        self._forecasts.add(forecasts, trace.size)
        self._extremes.add(_cell_extremes(cells) if len(cells) == block.size else _NO_EXTREMES, block.size)

    def take(self) -> tuple[SampleBlock, TraceBlock, ForecastRows, Floats]:
        """Remove and return all rows.

        Returns:
            Samples with a finite time stamp; trace; forecast at each row of the trace; and for each of these samples the minimum and maximum cell voltage [V]
            and the number of cell voltages, shape (n, 3).
        """
        samples, trace, forecasts = self._samples.take(), self._traces.take(), self._forecasts.take()
        extremes_v, has_time = self._extremes.take(), np.isfinite(samples["time_s"])
        if not has_time.all():
            samples, extremes_v = samples[has_time], extremes_v[has_time]
        return samples, trace, forecasts, extremes_v


class _Rows:
    """Buffer of rows of one dtype. Rows are copied in place, because joining hundreds of short arrays takes milliseconds."""

    def __init__(self, dtype: Any, row_shape: tuple[int, ...] = ()) -> None:
        self._rows = np.zeros((INITIAL_ROWS, *row_shape), dtype=dtype)
        self.size = 0

    def add(self, values: Any, count: int) -> None:
        """Append ``count`` rows."""
        end = self.size + count
        if end > len(self._rows):
            # more than twice the capacity, so that rows are rarely moved
            more = np.zeros((end, *self._rows.shape[1:]), dtype=self._rows.dtype)
            self._rows = np.concatenate((self._rows, more))
        self._rows[self.size : end] = values
        self.size = end

    def take(self) -> Any:
        """Remove and return all rows; valid until the next call of ``add``."""
        rows, self.size = self._rows[: self.size], 0
        return rows


def _cell_extremes(cells: CellBlock) -> Floats:
    """Return minimum and maximum cell voltage [V] and number of cell voltages of each sample, shape (n, 3).

    The voltages of a sample without cell voltages are NaN.
    """
    if not cells.shape[1]:
        return np.tile(_NO_EXTREMES, (len(cells), 1))
    measured = np.count_nonzero(np.isfinite(cells), axis=1)
    return np.stack((np.fmin.reduce(cells, axis=1), np.fmax.reduce(cells, axis=1), measured), axis=1)
