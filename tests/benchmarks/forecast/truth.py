"""Discharge of a capture until the cut-off: samples, cut-off voltage and time of the cut-off."""

from dataclasses import dataclass

import numpy as np

from bms_estimator.model.arrays import SampleBlock
from bms_estimator.sources.captures.replay import load_capture
from tests.benchmarks.forecast.captures import Case
from tests.benchmarks.recipes import HIGHEST_V, LOWEST_V, charge_ah

MIN_DISCHARGE_S = 900.0
"""Minimum time from the first sample to the cut-off [s]. A shorter capture is not a discharge."""
BEGIN_C = 0.01
"""Current at which the discharge begins [C]. Before it the cell may not have the temperature of the chamber yet."""
MIN_DISCHARGE = 0.2
"""Minimum charge drawn until the cut-off, as a fraction of the capacity."""


@dataclass(frozen=True)
class Discharge:
    """Discharge of a capture."""

    samples: SampleBlock
    """Samples until the cut-off, which the last sample reaches."""
    cutoff_v: float
    """Cut-off voltage [V]."""
    temperature_c: float
    """Temperature when the discharge begins, of cell and chamber [C]; NaN without a sensor."""

    @property
    def end_s(self) -> float:
        """Time of the cut-off, on the clock of the samples [s]."""
        return float(self.samples["time_s"][-1])


def read_discharge(case: Case) -> Discharge | None:
    """Read the discharge of a case. Return None if the capture is not a discharge."""
    rows = load_capture(case.path).rows
    rows = rows[(rows["voltage_v"] > LOWEST_V) & (rows["voltage_v"] < HIGHEST_V)]
    return discharge_of(rows, case.nominal_cutoff_v, case.recipe.capacity_ah)


def discharge_of(rows: SampleBlock, nominal_cutoff_v: float, capacity_ah: float) -> Discharge | None:
    """Return the samples until the cut-off, or None if they are not a discharge.

    The cut-off voltage is ``nominal_cutoff_v`` [V], or the lowest voltage while discharging if that is higher.
    """
    discharging = rows["current_a"] > 0.0
    if not discharging.any():
        return None
    cutoff_v = max(nominal_cutoff_v, float(rows["voltage_v"][discharging].min()))
    end = int(np.argmax(discharging & (rows["voltage_v"] <= cutoff_v)))
    until_end = rows[: end + 1]
    drawn_ah = charge_ah(until_end)
    if until_end["time_s"][-1] - until_end["time_s"][0] < MIN_DISCHARGE_S:
        return None
    if drawn_ah[-1] - drawn_ah.min() < MIN_DISCHARGE * capacity_ah:
        return None
    begin = int(np.argmax(until_end["current_a"] > BEGIN_C * capacity_ah))
    return Discharge(until_end, cutoff_v, float(until_end["temperature_c"][begin]))
