"""Estimator of the single cells of a pack with cell voltages. It uses the results of the pack's estimator."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.estimator import Estimator, TraceBlock
from bms_estimator.kernels.cell_model.chen_mora import OCV_POINTS
from bms_estimator.kernels.cells.cell_filter import BIAS_V
from bms_estimator.kernels.cells.records import BANK_STATE, CAPACITY, CELL, LEAK, RESISTANCE, SOC, STATES, ReadingFault
from bms_estimator.kernels.cells.step import run_cells
from bms_estimator.model.arrays import CellBlock, Floats, Records, SampleBlock
from bms_estimator.settings.alarm_limits import MIN_CELLS, balancing_voltage_v

LEAK_STDS = 2.5
"""Minimum difference between the self-discharges of a cell and of the median cell that counts as a short [std]."""
CONSTANT_FRACTION = 0.5
"""Fraction of ``BIAS_V`` that is constant, such as the offset of a converter."""
MAX_MEAN = np.array([1.0, 10.0, 10.0, 10.0, 1.0])
"""Maximum plausible magnitudes of the states of a cell."""
MEAN_SLOPE_SOC = (0.1, 0.9)
"""SOC range of the mean slope of the OCV, without its steep ends."""


@dataclass(frozen=True)
class CellDeviations:
    """Deviations of the cells of a pack, each an array of shape (m,).

    Attributes:
        at_s: Time of the estimate on the samples' clock [s].
        soc: SOC, 0..1.
        soc_std: Standard deviation of ``soc``.
        soc_deviation: SOC less the mean SOC of the cells.
        soc_deviation_std: Standard deviation of ``soc_deviation``.
        resistance_ratio: Resistance relative to the median of the cells.
        resistance_ratio_std: Standard deviation of ``resistance_ratio``.
        capacity_ratio: Capacity relative to the median of the cells.
        self_discharge_a: Self-discharge current above the median of the cells [A].
        self_discharge_std_a: Standard deviation of ``self_discharge_a`` [A].
        fault: Faults of the readings, each a ``ReadingFault``.
        reading_error_v: Error of the readings [V]; 0 without a fault.
        contact_ohm: Resistance of a faulty contact [ohm]; 0 without one.
    """

    at_s: float
    soc: Floats
    soc_std: Floats
    soc_deviation: Floats
    soc_deviation_std: Floats
    resistance_ratio: Floats
    resistance_ratio_std: Floats
    capacity_ratio: Floats
    self_discharge_a: Floats
    self_discharge_std_a: Floats
    fault: tuple[ReadingFault, ...]
    reading_error_v: Floats
    contact_ohm: Floats

    @property
    def weakest(self) -> int:
        """Index of the cell with the lowest SOC."""
        return int(np.argmin(self.soc))

    @property
    def proven_self_discharge_a(self) -> Floats:
        """``self_discharge_a`` where it exceeds ``LEAK_STDS`` standard deviations, otherwise 0 [A]."""
        significant = self.self_discharge_a >= LEAK_STDS * self.self_discharge_std_a
        return np.where(significant, self.self_discharge_a, 0.0)


class CellEstimator:
    """Estimators of all cells of one pack. They start with the first sample that has a cell voltage.

    Args:
        estimator: Estimator of the pack; read only. Without its identifier there is no estimate of the cells.

    Attributes:
        cells: State of the cells, shape (m,), dtype CELL; m is 0 before the first cell voltages.
        bank: State that the cells share, shape (1,), dtype BANK_STATE.
    """

    def __init__(self, estimator: Estimator) -> None:
        self._estimator, cell = estimator, estimator.cell
        self._series = cell.cell.series_count
        self._enabled = estimator.has_filter and self._series >= MIN_CELLS
        self._balancing_v = balancing_voltage_v(cell)
        self._deviations: CellDeviations | None = None
        self._deviations_window = 0  # number of the window of ``_deviations``
        self._start(0)

    def _start(self, count: int) -> None:
        """Begin with ``count`` cells before their first sample."""
        self.cells: Records = np.zeros(count, CELL)
        self.bank: Records = np.zeros(1, BANK_STATE)
        self._scratch = np.zeros(2 * count + STATES)

    @property
    def estimated_cells(self) -> int:
        """Number of cells whose voltages are needed; 0 if this pack has no estimators of single cells."""
        return self._series if self._enabled else 0

    def use_state(self, cells: Records, bank: Records) -> None:
        """Continue with the state of another pack of the same type. ``run`` then updates these records.

        Args:
            cells: Shape (series,), dtype CELL.
            bank: Shape (1,), dtype BANK_STATE.
        """
        if cells.size != self.cells.size:
            self._start(cells.size)
        self.cells, self.bank = cells, bank
        self._deviations, self._deviations_window = None, 0

    def run(self, samples: SampleBlock, cells_v: CellBlock, trace: TraceBlock) -> None:
        """Process a block of samples.

        The estimators start with the first sample that lacks at most one cell voltage. Earlier samples have no effect.

        Args:
            samples: Samples, shape (n,), dtype SAMPLE.
            cells_v: Cell voltages of the samples, shape (n, m) [V], with at most as many columns as cells in series; empty if
                none are measured.
            trace: Estimates of the accepted samples.
        """
        if not self._enabled or not trace.size or not (cells_v.size or self.cells.size):
            return
        if cells_v.shape != (samples.size, self._series):  # the other cells are not measured
            measured_v, cells_v = cells_v, np.full((samples.size, self._series), np.nan)
            cells_v[: len(measured_v), : measured_v.shape[1]] = measured_v
        if not self.cells.size:
            self._start(self._series)
        run_cells(
            self.cells,
            self.bank,
            self._estimator.settings_record["filter"],
            self._balancing_v,
            np.ascontiguousarray(samples["time_s"]),
            np.ascontiguousarray(cells_v),
            trace,
            self._scratch,
        )

    @property
    def _systematic_soc_std(self) -> float:
        """Std of a cell's SOC due to the constant part of its voltage error, which no average over time reduces."""
        p = self._estimator.settings_record["filter"][0]
        low, high = (round(soc * (OCV_POINTS - 1)) for soc in MEAN_SLOPE_SOC)
        slope_v = (p["ocv_v"][high] - p["ocv_v"][low]) / p["series"] / (MEAN_SLOPE_SOC[1] - MEAN_SLOPE_SOC[0])
        return CONSTANT_FRACTION * BIAS_V / float(slope_v)

    @property
    def deviations(self) -> CellDeviations | None:
        """Deviations of the cells at the end of the last window; None before the first window with cell voltages."""
        if not self.cells.size:
            return None
        window = int(self.bank["windows"][0])
        if window != self._deviations_window:
            self._deviations, self._deviations_window = self._compute_deviations(), window
        return self._deviations

    def _compute_deviations(self) -> CellDeviations:
        bank = self.bank[0]
        mean, variance = self.cells["mean"], np.diagonal(self.cells["covariance"], axis1=1, axis2=2)
        std = np.sqrt(np.maximum(variance, 0.0))
        std[:, SOC] = np.sqrt(std[:, SOC] ** 2 + self._systematic_soc_std**2)
        capacity_ah = float(self._estimator.settings["capacity_as"][0]) / 3600.0
        deviation = mean[:, SOC] - mean[:, SOC].mean()
        resistance, capacity = 1.0 + mean[:, RESISTANCE], 1.0 / np.maximum(1.0 + mean[:, CAPACITY], 0.1)
        pack_std = float(self._estimator.record["filter"]["soc_std"][0])
        return CellDeviations(
            at_s=float(bank["time_s"]),
            soc=np.clip(bank["soc"] + deviation, 0.0, 1.0),
            soc_std=np.sqrt(std[:, SOC] ** 2 + pack_std**2),
            soc_deviation=deviation,
            soc_deviation_std=std[:, SOC],
            resistance_ratio=resistance / np.median(resistance),
            resistance_ratio_std=std[:, RESISTANCE],
            capacity_ratio=capacity / np.median(capacity),
            self_discharge_a=capacity_ah * (mean[:, LEAK] - np.median(mean[:, LEAK])),
            self_discharge_std_a=capacity_ah * std[:, LEAK],
            fault=tuple(ReadingFault(int(fault)) for fault in self.cells["fault"]),
            reading_error_v=self.cells["error_v"].copy(),
            contact_ohm=np.where(self.cells["fault"] == ReadingFault.CONTACT, -self.cells["error_ohm"], 0.0),
        )

    @property
    def saved_state(self) -> Mapping[str, NDArray[Any]]:
        """Copy of the state for ``restore`` after a restart; empty before the first window."""
        return {"cells": self.cells.copy(), "bank": self.bank.copy()} if self.bank["windows"][0] else {}

    def restore(self, saved: Mapping[str, NDArray[Any]], unseen_s: float) -> str:
        """Restore a ``saved_state``. The next sample has another time base.

        Args:
            saved: State of an earlier run; an empty one has no effect.
            unseen_s: Time without samples [s]; infinite if unknown.

        Returns:
            Reason for which the state is invalid and was not restored; empty if it was restored.
        """
        if not saved or not self._enabled:
            return ""
        cells, bank = saved.get("cells"), saved.get("bank")
        if cells is None or bank is None or cells.dtype != CELL or bank.dtype != BANK_STATE or bank.shape != (1,):
            return "it was saved by another version"
        if cells.shape != (self._series,):
            return f"it has {cells.size} cells, and the pack has {self._series} in series"
        if reason := _invalid_reason(cells, bank):
            return reason
        self._start(self._series)
        self.cells[...], self.bank[...] = cells, bank
        self.resume(unseen_s)
        return ""

    def resume(self, unseen_s: float) -> None:
        """Prepare for samples with another time base, after a gap of ``unseen_s`` [s]; infinite if unknown."""
        self.bank["time_s"] = np.inf
        self.bank["unseen_s"] = unseen_s if math.isfinite(unseen_s) else 0.0

    def extend_gap(self, wait_s: float) -> None:
        """Extend the gap of ``resume`` by a further time without samples [s]."""
        self.bank["unseen_s"] += wait_s


def _invalid_reason(cells: Records, bank: Records) -> str:
    """Return the reason for which a saved state is invalid; empty if it is valid."""
    variance = np.diagonal(cells["covariance"], axis1=1, axis2=2)
    numbers = (
        cells["mean"],
        cells["covariance"],
        cells["sums"],
        *(bank[name] for name in bank.dtype.names or () if name != "time_s"),
    )
    if not all(np.isfinite(values).all() for values in numbers if values.dtype.kind == "f"):
        return "a value is not finite"
    if (variance < 0.0).any():
        return "a variance is negative"
    if (np.abs(cells["mean"]) > MAX_MEAN).any():
        return "a deviation of a cell is implausible"
    if not set(cells["fault"].tolist()) <= set(ReadingFault):
        return "a fault is unknown"
    return ""
