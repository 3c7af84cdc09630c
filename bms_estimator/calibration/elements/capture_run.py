"""Cleaned captures with SOC and temperature at each sample."""

from dataclasses import dataclass, replace

import numpy as np

from bms_estimator.calibration.cleaning.clean_capture import CleanCapture
from bms_estimator.calibration.cleaning.start_soc import initial_soc
from bms_estimator.calibration.ocv.overpotential import temperature_of
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel

MIN_SPAN_K = 10.0
"""Minimum temperature difference that gives activation energies and dE/dT [K]."""
FULL_TOLERANCE_V = 0.03
"""Tolerance within which the first rest of a capture has the voltage of a full cell, so that the capture starts full, per cell
[V]. This rule applies only away from 25 C, because cold rests are not relaxed and their voltage gives a wrong SOC."""
MIN_DEVIATION_K = 5.0
"""Minimum deviation from 25 C at which ``FULL_TOLERANCE_V`` applies [K]."""
MIN_CELL_C = -45.0
"""Lowest plausible cell temperature [C]."""
MAX_CELL_C = 85.0
"""Highest plausible cell temperature [C]."""
PERCENTILES = (2.0, 98.0)
"""Percentiles of the captures' temperatures that become the temperature range of the ladder [%]."""


@dataclass(frozen=True)
class Run:
    """Cleaned capture with the SOC (0..1) and the temperature [C] at each sample."""

    capture: CleanCapture
    soc: Floats
    temperature_c: Floats
    miscount: float = 0.0
    """Relative correction of the counted charge. ``soc`` includes the correction."""

    def with_added_miscount(self, added: float) -> "Run":
        """Return a copy with ``miscount`` increased by ``added`` and the changes of ``soc`` rescaled accordingly."""
        miscount = self.miscount + added
        uncorrected_change = (self.soc - self.soc[0]) / (1.0 + self.miscount)
        return replace(self, soc=self.soc[0] + (1.0 + miscount) * uncorrected_change, miscount=miscount)

    @property
    def capture_with_temperature(self) -> CleanCapture:
        """``capture`` with the temperatures replaced by ``temperature_c``."""
        return replace(self.capture, temperature_c=self.temperature_c)

    @property
    def mean_c(self) -> float:
        """Mean temperature [C]."""
        return float(self.temperature_c.mean())


def make_run(capture: CleanCapture, cell: CellModel, soc: float | None, temperature_c: float | None) -> Run:
    """Return a capture with its SOC by coulomb counting from ``soc``, or from the SOC of its first rest if None."""
    if temperature_c is not None:
        capture = replace(capture, temperature_c=temperature_of(capture, temperature_c))
    temperatures_c = temperature_of(capture)
    first_soc = initial_soc(capture, cell) if soc is None else soc
    full_v = ocv_grid(cell)[0][-1]
    is_far_from_reference = abs(float(temperatures_c[0]) - REFERENCE_C) > MIN_DEVIATION_K
    if (
        soc is None
        and is_far_from_reference
        and abs(full_v - capture.start_v) < FULL_TOLERANCE_V * cell.cell.series_count
    ):
        first_soc = 1.0
    return Run(capture, first_soc - capture.discharged_ah / cell.cell.capacity_ah, temperatures_c)


def temperature_contradictions(capture: CleanCapture, temperature_c: float | None) -> list[str]:
    """Return a message if the temperature of a capture is implausible."""
    temperatures_c = temperature_of(capture, REFERENCE_C if temperature_c is None else temperature_c)
    if temperatures_c.min() >= MIN_CELL_C and temperatures_c.max() <= MAX_CELL_C:
        return []
    measured = f"temperature_c runs from {temperatures_c.min():.1f} to {temperatures_c.max():.1f}"
    return [f"{capture.name}: {measured}, but cells are between {MIN_CELL_C:g} and {MAX_CELL_C:g} C"]


def temperature_range(runs: list[Run]) -> tuple[float, float]:
    """Return the ``PERCENTILES`` of the temperatures of captures [C]."""
    low_c, high_c = np.percentile(np.concatenate([run.temperature_c for run in runs]), PERCENTILES)
    return round(float(low_c), 1), round(float(high_c), 1)


def spans_temperature(low_c: float, high_c: float) -> bool:
    """Return True if captures at these temperatures [C] give activation energies and dE/dT."""
    return high_c - low_c >= MIN_SPAN_K
