"""Stand-in for the fit in tests of its callers: it returns a fixed result at once."""

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.kalman_filter.records import NODES
from bms_estimator.kernels.pack_voltage import CURVE_NODES, DIRECTION_NODES
from bms_estimator.pack_model.cell_curves import SOC_GRID, CellCurves
from bms_estimator.pack_model.fit import CURVE, LN_Q, SOC, PackFit
from bms_estimator.pack_model.unknowns import DIRECTIONS

LN_CAPACITY = -0.1
"""ln of the fitted over the declared capacity."""
LN_SERIES, LN_PAIRS = 0.3, 0.2
"""ln of the fitted over the file's series resistance, and over the resistances of the RC pairs."""
UNKNOWNS = CURVE_NODES + DIRECTIONS * DIRECTION_NODES
"""Number of unknowns of the OCV's error and of the direction-dependent error."""
CURVE_V = 0.01
"""Fitted correction of the OCV of one cell [V]."""


def quick_fit(_: CellCurves, rows: NDArray[np.void], previous: PackFit | None = None) -> PackFit:
    """Return a fit with the filter's SOC at the last row, and the constants of this module."""
    assert previous is None or previous.row_elapsed_s.size, "the previous fit cannot be continued"
    last = rows[-1]
    mean, covariance = np.zeros(6 + NODES), 1e-3 * np.eye(6 + NODES)
    mean[SOC], mean[LN_Q], mean[CURVE] = last["soc"], LN_CAPACITY, CURVE_V
    covariance[CURVE, CURVE] = 1e-6 * np.eye(NODES)
    return PackFit(
        elapsed_s=float(last["elapsed_s"]),
        segment=float(last["segment"]),
        charge_as=float(last["charge_as"]),
        mean=mean,
        covariance=covariance,
        curve_v=np.full(SOC_GRID.size, CURVE_V),
        ln_r=np.tile([LN_SERIES, LN_PAIRS, LN_PAIRS], (SOC_GRID.size, 1)),
        hysteresis=0.5,
        row_elapsed_s=rows["elapsed_s"].copy(),
        row_soc=rows["soc"].copy(),
        cost=1.0,
        curves=(np.zeros(UNKNOWNS), np.ones(UNKNOWNS)),  # two minima, which are only saved and restored
    )
