"""Load of a cell, and comparison of another program's voltage with the open-loop model."""

import numpy as np

from bms_estimator.calibration.validate import validate
from bms_estimator.model.arrays import SAMPLE, Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.columns import Columns

INITIAL_SOC = 0.95
STEP_S = 1.0


def load_profile(cell: CellModel, *, final_soc: float) -> tuple[Floats, Floats]:
    """Return times [s] and currents [A] of a rest, three cycles of discharge at 1C and charge at 0.3C, and 1C down to an SOC."""
    pattern = np.tile(np.repeat([1.0, -0.3], [600, 300]), 3)
    seconds_at_1c = (INITIAL_SOC - final_soc) * 3600.0 - pattern.sum()
    c_rate = np.concatenate([np.zeros(60), pattern, np.ones(int(seconds_at_1c))])
    return STEP_S * np.arange(c_rate.size), cell.cell.capacity_ah * c_rate


def difference_mv(
    cell: CellModel, time_s: Floats, current_a: Floats, voltage_v: Floats, temperature_c: float
) -> Floats:
    """Return the voltages of another program minus those of ``validate`` [mV]."""
    rows = np.zeros(time_s.size, SAMPLE)
    rows["time_s"], rows["current_a"], rows["voltage_v"] = time_s, current_a, voltage_v
    rows["temperature_c"] = temperature_c
    validation = validate(Columns(rows, "load"), cell, initial_soc=INITIAL_SOC)
    assert validation.glitches == 0
    return 1e3 * validation.error_v
