"""Means of samples over a second, because single samples of a current sensor are noisy."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bms_estimator.model.arrays import CellBlock, SampleBlock

WINDOW_S = 1.0
"""Minimum duration of the samples of a mean [s]."""


@dataclass(frozen=True)
class Average:
    """Mean of the samples of about a second.

    Attributes:
        time_s: Time of the last sample [s].
        current_a: Mean current, positive on discharge [A].
        voltage_v: Mean voltage [V].
        temperature_c: Mean temperature of the hottest probe [°C]; NaN without a sensor.
        min_cell_v: Voltage of the lowest cell [V]; NaN if unknown.
        max_cell_v: Voltage of the highest cell [V]; NaN if unknown.
    """

    time_s: float
    current_a: float
    voltage_v: float
    temperature_c: float = math.nan
    min_cell_v: float = math.nan
    max_cell_v: float = math.nan


def means_of_windows(samples: SampleBlock) -> SampleBlock:
    """Return one mean sample for each ``WINDOW_S``, because a test of hours at 100 Hz has millions of samples.

    Samples without current or voltage are omitted. Samples at 1 Hz or slower are returned unchanged.
    """
    usable: SampleBlock = samples[np.isfinite(samples["current_a"]) & np.isfinite(samples["voltage_v"])]
    if usable.size == 0:
        return usable
    window = np.floor((usable["time_s"] - usable["time_s"][0]) / WINDOW_S)
    begins = np.flatnonzero(np.diff(window, prepend=-1.0))
    means: SampleBlock = usable[begins].copy()
    counts = np.diff(begins, append=usable.size)
    for name in ("time_s", "current_a", "voltage_v", "temperature_c"):
        means[name] = np.add.reduceat(usable[name], begins) / counts
    return means


class Averager:
    """Averager of a stream of sample blocks over windows of at least ``WINDOW_S``, which may span blocks."""

    def __init__(self) -> None:
        self._pending: list[SampleBlock] = []
        self._cells: list[CellBlock] = []
        self._begin_s = math.nan

    def feed(self, samples: SampleBlock, cells_v: CellBlock) -> Iterator[Average]:
        """Yield the means that end within a block.

        Args:
            samples: Shape (n,), times not decreasing.
            cells_v: Shape (n, m), cell voltages [V]; empty if unknown.
        """
        usable = np.isfinite(samples["current_a"]) & np.isfinite(samples["voltage_v"]) & np.isfinite(samples["time_s"])
        has_cells = cells_v.shape[0] == samples.size and cells_v.size > 0
        samples, cells_v = samples[usable], cells_v[usable] if has_cells else cells_v[:0]
        while samples.size:
            if math.isnan(self._begin_s):
                self._begin_s = float(samples["time_s"][0])
            end = int(np.searchsorted(samples["time_s"], self._begin_s + WINDOW_S)) + 1
            self._pending.append(samples[:end])
            self._cells.append(cells_v[:end])
            if end > samples.size:
                return
            yield self._mean()
            samples, cells_v = samples[end:], cells_v[end:]

    def _mean(self) -> Average:
        rows = np.concatenate(self._pending)
        cells_v = np.concatenate([block.ravel() for block in self._cells])
        cells_v = cells_v[np.isfinite(cells_v)]
        hottest_c = np.fmax(rows["temperature_c"], rows["temperature_max_c"])[np.isfinite(rows["temperature_c"])]
        self._pending, self._cells, self._begin_s = [], [], float(rows["time_s"][-1])
        return Average(
            time_s=float(rows["time_s"][-1]),
            current_a=float(rows["current_a"].mean()),
            voltage_v=float(rows["voltage_v"].mean()),
            temperature_c=float(hottest_c.mean()) if hottest_c.size else math.nan,
            min_cell_v=float(cells_v.min()) if cells_v.size else math.nan,
            max_cell_v=float(cells_v.max()) if cells_v.size else math.nan,
        )
