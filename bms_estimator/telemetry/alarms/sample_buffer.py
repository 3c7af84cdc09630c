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
_NO_CELLS = np.array([math.nan, math.nan, 0.0, math.nan])
"""Result of ``summarize`` for a sample without cell voltages."""
UNUSABLE = -1
"""Number of cell voltages of a sample whose cell voltages cannot be used."""


class SampleBuffer:
    """Samples that the alarms have not evaluated yet, with their trace, forecasts and a summary of their cell voltages.

    Attributes:
        size: Number of samples.
    """

    def __init__(self) -> None:
        self._samples, self._traces, self._forecasts = _Rows(SAMPLE), _Rows(TRACE), _Rows(FORECAST)
        self._cells = _Rows(np.float64, (4,))

    @property
    def size(self) -> int:
        """Number of samples."""
        return self._samples.size

    def add(
        self,
        block: SampleBlock,
        trace: TraceBlock,
        cells: CellBlock,
        forecasts: ForecastRows,
        *,
        cells_usable: bool = True,
    ) -> None:
        """Append a block. ``cells_usable`` is False if samples without cell voltages have some that cannot be used."""
        self._samples.add(block, block.size)
        self._traces.add(trace, trace.size)
        self._forecasts.add(forecasts, trace.size)
        summary = summarize(cells, block.size)
        if not cells_usable:
            summary[summary[:, 2] == 0, 2] = UNUSABLE
        self._cells.add(summary, block.size)

    def take(self) -> tuple[SampleBlock, TraceBlock, ForecastRows, Floats]:
        """Remove and return all rows.

        Returns:
            Samples with a finite time stamp; their trace; the forecast at each row of the trace; and minimum [V], maximum [V],
            number and mean [V] of the cell voltages of each sample, shape (n, 4).
        """
        samples, trace, forecasts = self._samples.take(), self._traces.take(), self._forecasts.take()
        cells, has_time = self._cells.take(), np.isfinite(samples["time_s"])
        if not has_time.all():
            samples, cells = samples[has_time], cells[has_time]
        return samples, trace, forecasts, cells


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


def summarize(cells: CellBlock, count: int) -> Floats:
    """Return minimum [V], maximum [V], number and mean [V] of the cell voltages of ``count`` samples, shape (count, 4).

    The voltages of a sample without cell voltages are NaN.
    """
    if len(cells) != count or not cells.shape[1]:
        return np.tile(_NO_CELLS, (count, 1))
    measured = np.count_nonzero(np.isfinite(cells), axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        mean_v = np.nansum(cells, axis=1) / np.where(measured, measured, np.nan)
    return np.stack((np.fmin.reduce(cells, axis=1), np.fmax.reduce(cells, axis=1), measured, mean_v), axis=1)
