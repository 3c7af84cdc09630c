"""Prior of the ladder fit, from the cell file: OCV errors, and shapes and temperature dependence of the resistances."""

import numpy as np

from bms_estimator.calibration.elements.ladder_columns import SOC_NODES
from bms_estimator.calibration.elements.ladder_fit import (
    EVEN_SOC,
    FIXED_OCV_STD_V,
    FIXED_PER_KELVIN_STD_V,
    MEASURED_PER_KELVIN_STD_V,
    PER_KELVIN_STD_V,
    ZERO_FRACTION,
    Prior,
)
from bms_estimator.calibration.ocv.hysteresis import RESTED_FRACTION_STD, has_plateau
from bms_estimator.calibration.ocv.slow_curve import PAIR_V
from bms_estimator.estimator.filter_settings import CURVE_ERROR_SOC, CURVE_ERROR_V
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.rc_ladder import RESISTANCES, weak_share
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel, Ladder, TableOcv

GENERIC_STD = 0.3
"""Minimum relative std of a generic ladder. A ladder with a smaller std was identified, so that its temperature range
comes from captures."""
SHAPE_MIN_SOC = 0.4
"""SOC above which a resistance is averaged to normalize its shape."""
SHAPE_LIMITS = (0.2, 20.0)
"""Limits of a resistance relative to its mean above ``SHAPE_MIN_SOC``."""


def ladder_prior(cell: CellModel, scale_ohm: float, *, refine_ocv: bool, spans_temperature: bool) -> Prior:
    """Return the prior of the fit to captures of a cell.

    Args:
        cell: Given cell.
        scale_ohm: Scale of the resistances [ohm].
        refine_ocv: Correct the OCV as well.
        spans_temperature: True if the captures give activation energies and dE/dT.
    """
    series, given = cell.cell.series_count, cell.ladder
    measured = isinstance(cell.ocv, TableOcv) and cell.ocv.per_kelvin_v is not None
    per_kelvin_std_v = MEASURED_PER_KELVIN_STD_V if measured else PER_KELVIN_STD_V
    return Prior(
        ocv_error_v=_curve_error(cell) if refine_ocv else np.full(EVEN_SOC.size, FIXED_OCV_STD_V),
        per_kelvin_std_v=(per_kelvin_std_v if spans_temperature and refine_ocv else FIXED_PER_KELVIN_STD_V) * series,
        scale_ohm=scale_ohm,
        series=series,
        shapes=_shapes(cell, scale_ohm),
        weak_share=None if spans_temperature else weak_share(SOC_NODES) if given is None else _weak_share_of(given),
    )


def ocv_error(cell: CellModel) -> Floats:
    """Return the std of the given OCV at ``EVEN_SOC`` [V]."""
    if isinstance(cell.ocv, TableOcv) and cell.ocv.error_v is not None:
        return np.interp(EVEN_SOC, cell.ocv.soc, cell.ocv.error_v)
    slope_v = np.interp(EVEN_SOC, np.linspace(0.0, 1.0, ocv_grid(cell)[1].size), ocv_grid(cell)[1])
    return np.hypot(CURVE_ERROR_V * cell.cell.series_count, CURVE_ERROR_SOC * slope_v)


def _shapes(cell: CellModel, scale_ohm: float) -> Floats:
    """Return the prior shape of the weak and strong part of each resistance over SOC, at ``SOC_NODES``.

    The shape of an identified ladder is used unchanged. For a generic ladder, the square root of the shape is used,
    because cells differ. The shape is constant for a cell with a voltage plateau, because the generic shape did not
    fit the captures of an LFP cell.
    """
    given, grid_v = cell.ladder, ocv_grid(cell)[0]
    if given is None or has_plateau(np.linspace(0.0, 1.0, grid_v.size), grid_v, cell.cell.series_count):
        return np.ones((2, RESISTANCES, SOC_NODES.size))
    rows = _at_nodes(given)
    mean_ohm = rows[:, :, SOC_NODES > SHAPE_MIN_SOC].mean(axis=2, keepdims=True)
    is_zero = mean_ohm < ZERO_FRACTION * scale_ohm  # a resistance of 0 has no shape
    shapes = np.clip(np.where(is_zero, 1.0, rows / np.where(is_zero, 1.0, mean_ohm)), *SHAPE_LIMITS)
    return np.asarray(np.sqrt(shapes) if given.std >= GENERIC_STD else shapes)


def _at_nodes(ladder: Ladder) -> Floats:
    """Return the weak and strong part at ``SOC_NODES``, shape (2, RESISTANCES, SOC_NODES.size) [ohm]."""
    parts = ladder.weak_ohm, ladder.strong_ohm
    return np.array([[np.interp(SOC_NODES, ladder.soc, ohm) for ohm in part] for part in parts])


def _weak_share_of(ladder: Ladder) -> Floats:
    """Return the fraction of each resistance with the weak temperature dependence, at ``SOC_NODES``."""
    weak, strong = _at_nodes(ladder)
    return np.where(weak + strong > 0.0, weak / np.maximum(weak + strong, 1e-12), weak_share(SOC_NODES))


def _curve_error(cell: CellModel) -> Floats:
    """Return the std of the OCV curve at ``EVEN_SOC`` [V], without the error of the hysteresis.

    Captures of drives are discharges. With the error of the hysteresis in the prior, the fit would correct the curve by
    that error, and the correction would have the wrong sign in charges.
    """
    error_v = ocv_error(cell)
    if not isinstance(cell.ocv, TableOcv) or cell.ocv.hysteresis_v is None:
        return error_v
    hysteresis_v = RESTED_FRACTION_STD * np.interp(EVEN_SOC, cell.ocv.soc, cell.ocv.hysteresis_v)
    square_v2: Floats = np.maximum(error_v**2 - hysteresis_v**2, (PAIR_V * cell.cell.series_count) ** 2)
    return np.sqrt(square_v2)
