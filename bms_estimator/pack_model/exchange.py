"""Detection of an exchange of the pack in a gap, by large residuals after the gap.

The std of a row covers the differences between cell file and cell. The RMS residuals of one pack are therefore only 0.1 to
0.4 std (real captures of three cells with generic files). With another pack after the gap, no common fit explains the rows of
both packs, and the RMS residual after the gap is 0.5 to 2.4 std after 20 min to an hour of use.
"""

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.arrays import Floats
from bms_estimator.pack_model.equations import Residuals

MAX_RATIO = 3.0
"""Ratio of the RMS residuals after and before the last gap above which the pack was exchanged."""
MIN_RESIDUAL = 0.15
"""Minimum of the RMS residual before the gap in the ratio [std]. A fit of a small number of rows leaves too small residuals."""
MIN_ROWS_AFTER, MIN_ROWS_BEFORE = 5, 50
"""Minimum numbers of rows with a voltage after and before the gap."""
MARGIN_K = 5.0
"""Maximum distance of the mean temperature after the gap from the temperature range before it [K]. At a larger distance the
error of the file's temperature dependence dominates the residuals."""


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
