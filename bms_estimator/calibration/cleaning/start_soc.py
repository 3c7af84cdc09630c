"""SOC at the first sample of a capture, and whether the cell is full there."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np

from bms_estimator.calibration.cleaning.clean_capture import CleanCapture
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import ocv, r_s, soc_from_ocv
from bms_estimator.model.cell import CellModel, TableOcv, generic_cells, load_cell

FULL_SOC = 0.97
"""Minimum SOC from the voltage of the first rest at which the cell counts as full. Rested full cells of one type differ by some
30 mV, and cells rest 20 to 50 mV below the voltage at the end of their charge."""
MAX_RANGE = 0.3
"""Maximum width of the range of SOCs that fit a voltage, if the voltage determines the SOC. With generic cells the width is
about 0.2 without a plateau, and 0.6 on the plateau of LFP."""
CURVE_STD_V = 0.005
"""Standard deviation of an OCV curve without an error column, per cell [V]."""
SAME_START_V = 0.02
"""Maximum difference of the first rests of captures that start at the same SOC, per cell [V]. Full charges vary by as
much."""
MAX_EXCESS = 0.1
"""Maximum discharged charge above the initial charge that the voltage indicates, as a fraction of the capacity. A larger excess
shows that the OCV curve is of another chemistry."""
MAX_MEDIAN_DIFFERENCE_V = 0.15
"""Maximum difference between the median voltage of a capture and the OCV at SOC 0.5 of a cell of its chemistry [V]."""


class StartOrigin(Enum):
    """Origin of the SOC at the first sample."""

    GIVEN = auto()
    FULL = auto()
    VOLTAGE = auto()
    UNKNOWN = auto()


@dataclass(frozen=True)
class StartSoc:
    """SOC at the first sample of a capture.

    Attributes:
        soc: SOC 0..1; NaN if the voltage does not determine it.
        origin: Origin of ``soc``.
        full_v: Minimum voltage of a full cell at rest, or at the beginning of a slow discharge [V].
        reason: Voltage of the first rest and the SOCs that it allows, as text.
    """

    soc: float = 1.0
    origin: StartOrigin = StartOrigin.GIVEN
    full_v: float = math.inf
    reason: str = ""

    @property
    def is_exact(self) -> bool:
        """True if the SOC was given, or the cell is full."""
        return self.origin in (StartOrigin.GIVEN, StartOrigin.FULL)


def starts_of(captures: Sequence[CleanCapture], cell: CellModel, initial_soc: float | None = None) -> list[StartSoc]:
    """Return the SOC at the first sample of each capture.

    Args:
        captures: Captures of one cell.
        cell: Cell whose OCV gives the SOC of a rest.
        initial_soc: SOC 0..1 of the captures that start at the highest voltage; None: their voltages determine it.
    """
    highest_v = max(capture.start_v for capture in captures) - SAME_START_V * cell.cell.series_count
    return [_start_of(capture, cell, initial_soc if capture.start_v >= highest_v else None) for capture in captures]


def initial_soc(capture: CleanCapture, cell: CellModel) -> float:
    """Return the SOC whose OCV is the voltage of the first rest or, without a rest, the first voltage plus i R_s."""
    return soc_from_ocv(_open_circuit_v(capture, cell), *ocv_grid(cell))


def undetermined_start(capture: CleanCapture, cell: CellModel) -> str | None:
    """Return the SOCs that the voltage of the first rest allows, as text; None if it determines the SOC."""
    low, high = _soc_range(capture, cell)
    return _range_text(capture, low, high) if high - low > MAX_RANGE else None


def _start_of(capture: CleanCapture, cell: CellModel, given: float | None) -> StartSoc:
    """Return the given SOC or, if None, the SOC from the first voltage."""
    low, high = _soc_range(capture, cell)
    soc, full_v = initial_soc(capture, cell), ocv(FULL_SOC, *ocv_grid(cell))
    reason = _range_text(capture, low, high)
    if given is not None:
        return StartSoc(given, StartOrigin.GIVEN, full_v, reason)
    if soc >= FULL_SOC or _is_full_of_another_chemistry(capture, cell, soc):
        return StartSoc(1.0, StartOrigin.FULL, min(full_v, capture.start_v), reason)
    if high - low > MAX_RANGE:
        return StartSoc(math.nan, StartOrigin.UNKNOWN, full_v, reason)
    return StartSoc(soc, StartOrigin.VOLTAGE, full_v, reason)


def _is_full_of_another_chemistry(capture: CleanCapture, cell: CellModel, soc: float) -> bool:
    """Return True if the capture draws more charge than ``soc`` allows, and its voltages fit a full generic cell."""
    capacity_ah, series = cell.cell.capacity_ah, cell.cell.series_count
    if capture.discharged_ah.max() < (soc + MAX_EXCESS) * capacity_ah:
        return False
    median_v = float(np.median(capture.voltage_v))
    grids = [ocv_grid(load_cell(name, capacity_ah).pack(series, 1)) for name in generic_cells()]
    return any(
        soc_from_ocv(capture.start_v, *grid) >= FULL_SOC
        and abs(median_v - ocv(0.5, *grid)) < MAX_MEDIAN_DIFFERENCE_V * series
        for grid in grids
    )


def _open_circuit_v(capture: CleanCapture, cell: CellModel) -> float:
    current_a = 0.0 if capture.resting_samples else float(capture.current_a[0])
    return capture.start_v + current_a * r_s(0.5, cell.a)


def _soc_range(capture: CleanCapture, cell: CellModel) -> tuple[float, float]:
    """Return the lowest and the highest SOC whose OCV agrees with the first voltage within the OCV's error and hysteresis."""
    grid_v = ocv_grid(cell)[0]
    soc = np.linspace(0.0, 1.0, grid_v.size)
    tolerance_v = np.full(soc.size, CURVE_STD_V * cell.cell.series_count)
    if isinstance(cell.ocv, TableOcv):
        if cell.ocv.error_v is not None:
            tolerance_v = np.interp(soc, cell.ocv.soc, cell.ocv.error_v)
        if cell.ocv.hysteresis_v is not None:
            tolerance_v += np.interp(soc, cell.ocv.soc, cell.ocv.hysteresis_v)
    allowed = soc[np.abs(grid_v - _open_circuit_v(capture, cell)) <= tolerance_v]
    nearest = initial_soc(capture, cell)
    return min(nearest, float(allowed.min(initial=1.0))), max(nearest, float(allowed.max(initial=0.0)))


def _range_text(capture: CleanCapture, low: float, high: float) -> str:
    begins = "its first rest" if capture.resting_samples else "its first sample"
    return f"{begins} at {capture.start_v:.3f} V fits SOC {low:.2f} to {high:.2f}"
