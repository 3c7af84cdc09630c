"""a16..a21 of (2.10) for a cell file that gives its OCV as a table: fitted to it, once for each table."""

from functools import cache
from typing import NamedTuple

import numpy as np

from bms_estimator.model.cell import CellModel, TableOcv

POINTS = 101
"""Evenly spaced SOCs that the fit is made at."""


class OcvFormulaFit(NamedTuple):
    """(2.10) fitted to a table.

    Attributes:
        a: a16..a21.
        std: Standard errors; NaN for one at its bound.
        rms_v: Deviation of the formula from the table, RMS over SOC [V].
    """

    a: tuple[float, ...]
    std: tuple[float, ...]
    rms_v: float


def formula(cell: CellModel) -> OcvFormulaFit | None:
    """Fit (2.10) to a cell's OCV table; None if the cell file gives (2.10) itself."""
    return _fitted(cell.ocv) if isinstance(cell.ocv, TableOcv) else None


@cache
def _fitted(ocv: TableOcv) -> OcvFormulaFit:
    from scipy.interpolate import PchipInterpolator  # noqa: PLC0415 - what fits is loaded only where there is a table

    from bms_estimator.calibration.ocv.chen_mora_fit import fit_chen_mora  # noqa: PLC0415
    from bms_estimator.calibration.ocv.points import Points, rms_v  # noqa: PLC0415

    soc = np.linspace(0.0, 1.0, POINTS)
    fit = fit_chen_mora(Points(soc, PchipInterpolator(ocv.soc, ocv.ocv_v)(soc), np.ones(POINTS)))
    return OcvFormulaFit(tuple(map(float, fit.a)), tuple(map(float, fit.std)), rms_v(fit.residual_v))
