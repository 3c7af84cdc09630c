"""Buffer of samples for the alarms."""

import math
from typing import Any

import numpy as np

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.forecast.forecast import FORECAST, ForecastRows
from bms_estimator.kernels.trace import TRACE
from bms_estimator.model.arrays import Floats
from bms_estimator.model.sample import SAMPLE, CellBlock, SampleBlock

INITIAL_ROWS = 256
"""Initial capacity of a buffer [rows]."""
_NO_EXTREMES = np.array([math.nan, math.nan, 0.0])
"""Result of ``_cell_extremes`` for a sample without cell voltages."""


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
            Samples with a finite time stamp; their trace; the forecast at each row of the trace; and the minimum cell voltage [V],
            maximum cell voltage [V] and number of cell voltages of each sample, shape (n, 3).
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
