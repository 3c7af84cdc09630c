"""Parameters a16..a21 of (2.10) of the thesis, fitted to the OCV table of a cell file."""

from functools import cache
from typing import NamedTuple

import numpy as np

from bms_estimator.model.cell import CellModel, TableOcv
from bms_estimator.model.monotone_cubic import MonotoneCubic

POINTS = 101
"""Number of evenly spaced SOCs at which (2.10) is fitted."""


class OcvFormulaFit(NamedTuple):
    """Fit of the polynomial and exponential (2.10) to an OCV table.

    Attributes:
        a: a16..a21.
        std: Standard errors; NaN for a parameter at its bound.
        rms_v: Deviation of the formula from the table, RMS over SOC [V].
    """

    a: tuple[float, ...]
    std: tuple[float, ...]
    rms_v: float


def fit_ocv_formula(cell: CellModel) -> OcvFormulaFit | None:
    """Fit (2.10) to a cell's OCV table; None if the cell file gives (2.10) itself."""
    return _fit_table(cell.ocv) if isinstance(cell.ocv, TableOcv) else None


@cache
def _fit_table(ocv: TableOcv) -> OcvFormulaFit:
    from bms_estimator.calibration.ocv.chen_mora_fit import fit_chen_mora  # noqa: PLC0415
    from bms_estimator.calibration.ocv.points import Points, rms_v  # noqa: PLC0415

    soc = np.linspace(0.0, 1.0, POINTS)
    fit = fit_chen_mora(Points(soc, MonotoneCubic(ocv.soc, ocv.ocv_v)(soc), np.ones(POINTS)))
    return OcvFormulaFit(tuple(map(float, fit.a)), tuple(map(float, fit.std)), rms_v(fit.residual_v))
