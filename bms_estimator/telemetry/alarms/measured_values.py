"""Values that alarms on measured quantities compare with their limits, from a buffer of samples."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.forecast.forecast import FORECAST, ForecastRows
from bms_estimator.kernels.trace import TRACE
from bms_estimator.model.arrays import Floats
from bms_estimator.model.sample import SAMPLE, CellBlock, SampleBlock, SampleStatus
from bms_estimator.settings.alarms import AlarmName

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


def measured_values(samples: SampleBlock, cells: Floats, charging_a: float) -> dict[AlarmName, Floats]:
    """Return the values that the alarms compare with their limits, each of shape (n,).

    Args:
        samples: Shape (n,), dtype SAMPLE.
        cells: Minimum and maximum [V] of the cell voltages in the first two columns, shape (n, 4).
        charging_a: Minimum current into the pack that counts as charging [A].
    """
    lowest_v, highest_v = cells[:, 0], cells[:, 1]
    voltage_v = samples["voltage_v"]
    coldest_c, hottest_c = _extreme_temperatures(samples)
    # beyond the range of the converter, and therefore beyond every limit
    voltage_is_saturated = has_bit(samples, SampleStatus.VOLTAGE_SATURATED)
    current_a = np.where(
        has_bit(samples, SampleStatus.CURRENT_SATURATED),
        np.copysign(np.inf, samples["current_a"]),
        samples["current_a"],
    )
    # the lowest temperature while charging; infinite while not charging, NaN if a quantity is not measured
    charging_c = np.where(current_a <= -charging_a, coldest_c, np.inf)
    charging_c[np.isnan(current_a) | np.isnan(coldest_c)] = np.nan
    return {
        "pack_over_voltage": np.where(voltage_is_saturated, np.inf, voltage_v),
        "pack_under_voltage": voltage_v,
        "cell_over_voltage": highest_v,
        "cell_under_voltage": lowest_v,
        "cell_imbalance": highest_v - lowest_v,
        "discharge_over_current": current_a,
        "charge_over_current": -current_a,
        "over_temperature": hottest_c,
        "under_temperature": coldest_c,
        "charging_below_freezing": charging_c,
    }


class WireLimits(NamedTuple):
    """Voltages that show a broken wire beside an alarm of the opposite side [V]."""

    low_v: float
    """Voltage of a pack with an over-voltage is not below this one."""
    low_cell_v: float
    """Voltage of the lowest cell beside one with an over-voltage is not below this one."""
    high_cell_v: float
    """Voltage of the highest cell beside one with an under-voltage is not above this one."""


def uncertain_values(
    samples: SampleBlock, cells: Floats, expected_cells: int, limits: WireLimits
) -> dict[AlarmName, NDArray[np.bool_]]:
    """Return where the true value of an alarm may be beyond its limit although the measured one is not, each of shape (n,).

    Heat destroys probes, a broken wire hides a voltage or lets it float to an end of the range, and a dead current sensor reads
    an end of its range.

    Args:
        samples: Shape (n,), dtype SAMPLE.
        cells: As for ``measured_values``, with the number of cell voltages in the third column.
        expected_cells: Largest number of cell voltages so far.
        limits: Voltages that show a broken wire.
    """
    has_probe_fault, is_saturated = (
        has_bit(samples, bit) for bit in (SampleStatus.PROBE_FAULT, SampleStatus.CURRENT_SATURATED)
    )
    lacks_cell = (cells[:, 2] > 0) & (cells[:, 2] < expected_cells)
    return {
        "pack_over_voltage": samples["voltage_v"] < limits.low_v,
        "pack_under_voltage": has_bit(samples, SampleStatus.VOLTAGE_SATURATED),
        "cell_over_voltage": lacks_cell | (cells[:, 0] < limits.low_cell_v),
        "cell_under_voltage": lacks_cell | (cells[:, 1] > limits.high_cell_v),
        "discharge_over_current": is_saturated,
        "charge_over_current": is_saturated,
        "over_temperature": has_probe_fault,
        "under_temperature": has_probe_fault,
        "charging_below_freezing": has_probe_fault & (samples["current_a"] < 0.0),
    }


def has_bit(samples: SampleBlock, bit: SampleStatus) -> NDArray[np.bool_]:
    """Return where a bit of the status is set, shape (n,)."""
    return np.asarray((samples["status"] & bit) != 0)


def _extreme_temperatures(samples: SampleBlock) -> tuple[Floats, Floats]:
    """Return the temperatures of the coldest and of the hottest probe [C], each of shape (n,).

    Samples of other programs may have only a mean temperature, or extremes that do not enclose it. The mean is then used.
    """
    mean_c, lowest_c, highest_c = (samples[f"temperature_{name}c"] for name in ("", "min_", "max_"))
    has_extremes = (lowest_c <= mean_c) & (mean_c <= highest_c)
    return np.where(has_extremes, lowest_c, mean_c), np.where(has_extremes, highest_c, mean_c)
