"""Exchange of the pack in a gap, shown by voltages after the gap that the model of the pack before it does not explain.

The std of a row covers the differences between cell file and cell. The residuals of one pack are therefore a small
fraction of their std, after a gap as before it: 0.1 to 0.4 (RMS) for real captures of three cells with generic files. With
another pack after the gap, one fit of all rows agrees with neither: the residuals after the gap are 0.5 to 2.4 after 20 min to
an hour of use.
"""

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.arrays import Floats
from bms_estimator.pack_model.equations import Residuals

MAX_RATIO = 3.0
"""RMS residual after the last gap, divided by that before it, above which the pack was exchanged."""
MIN_RESIDUAL = 0.15
"""Lower limit of the RMS residual before the gap in this ratio [std], because few rows are fitted too well."""
MIN_ROWS_AFTER, MIN_ROWS_BEFORE = 5, 50
"""Minimum numbers of rows with a voltage after and before the gap. The pack before it must be known better."""
MARGIN_K = 5.0
"""Maximum distance of the mean temperature after the gap from the range of temperatures before it [K]. Farther away, the
residuals contain the error of the file's temperature dependence."""


def is_exchanged(rows: NDArray[np.void], residuals: Residuals) -> bool:
    """Return True if another pack was measured after the last gap.

    Args:
        rows: Shape (n,), dtype HISTORY_ROW, in order of time.
        residuals: Residuals of a fit of all rows.
    """
    has_voltage = rows["duration_s"] > 0.0
    after = has_voltage & (rows["segment"] == rows["segment"][-1])
    before = has_voltage & ~after
    if after.sum() < MIN_ROWS_AFTER or before.sum() < MIN_ROWS_BEFORE:
        return False
    temperature_c = rows["temperature_c"]
    mean_c = temperature_c[after].mean()
    if not temperature_c[before].min() - MARGIN_K < mean_c < temperature_c[before].max() + MARGIN_K:
        return False
    return rms(residuals.voltage[after]) > MAX_RATIO * max(rms(residuals.voltage[before]), MIN_RESIDUAL)


def rms(values: Floats) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))
