"""Transfer of a fit's results to the filter.

The fitted curves replace those in the filter's settings. SOC, capacity and offset of the fit, with their covariance, replace
those in the filter's state. The SOC of a filter that is surer than the fit remains.
"""

import math

import numpy as np

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.filter_settings import MIN_BIAS_OF_R_STD, MIN_SOC_STD
from bms_estimator.estimator.fitted_state import FittedState
from bms_estimator.kernels.kalman_filter.ocv_correction import NODE_CORRELATION
from bms_estimator.kernels.kalman_filter.records import Noise
from bms_estimator.kernels.pack_voltage import RESISTANCE_GROUPS
from bms_estimator.model.arrays import Floats, exp
from bms_estimator.pack_model.cell_curves import SOC_GRID, CellCurves
from bms_estimator.pack_model.fit import (
    CURVE as FIT_CURVE,
    LN_Q as FIT_LN_Q,
    LN_R as FIT_LN_R,
    NODE_SOC,
    OFFSET as FIT_OFFSET,
    SOC as FIT_SOC,
    PackFit,
)
from bms_estimator.pack_model.intervals import HOUR_S

MIN_CURVE_STD_V = 0.003
"""Minimum std of the OCV of one cell [V]. Assumed."""
MIN_R_STD = Noise.r_std
"""Minimum relative std of the resistances; equal to the std that is assumed if the cell file has none."""
MIN_SOC_STD_FRACTION = 0.55
"""Minimum std of the published SOC after a fit, as a fraction of the minimum with the curves of the cell file. Assumed: a fitted
pack is known better than a cell that was not measured."""
FIT_RESULTS = np.array([FIT_SOC, FIT_LN_Q, FIT_OFFSET, *range(FIT_CURVE.start, FIT_CURVE.stop)])
"""Results of a fit in the order of ``FILTER_STATES``."""
MIN_SLOPE_V = 1e-3
"""Minimum slope of the fitted OCV of one cell [V per unit SOC], because a slope of 0 has no inverse."""


def use_fitted_curves(estimator: Estimator, fit: PackFit | None) -> None:
    """Use the curves of a fit in the filter, or without a fit the curves of the cell file."""
    settings = cell_file = estimator.cell_file_settings
    if fit is not None:
        settings = estimator.settings_record[0]["filter"].copy()
        adopt_curves(settings, cell_file, fit)
    estimator.use_curves(settings)


def adopt_curves(settings: np.void, file_settings: np.void, fit: PackFit) -> None:
    """Write the cell file's curves, corrected by the fit, to the filter's settings.

    Args:
        settings: Record of dtype EKF_SETTINGS; written.
        file_settings: Record of dtype EKF_SETTINGS with the values of the cell file.
        fit: Fit of the history.
    """
    _adopt_ocv(settings, file_settings, fit)
    _adopt_resistances(settings, file_settings, fit)
    settings["hysteresis_v"] = fit.hysteresis * file_settings["hysteresis_v"]
    file_std = MIN_SOC_STD_FRACTION * float(file_settings["min_soc_std"])
    settings["min_soc_std"] = max(MIN_SOC_STD, file_std, smallest_soc_std(fit))


def _adopt_ocv(settings: np.void, file_settings: np.void, fit: PackFit) -> None:
    """Write the fitted OCV and its std. The error that depends on the current's direction becomes ``varying_error_v``."""
    series = float(file_settings["series"])
    soc = np.linspace(0.0, 1.0, file_settings["ocv_v"].size)
    ocv_v = file_settings["ocv_v"] + series * np.interp(soc, SOC_GRID, fit.curve_v)
    settings["ocv_v"] = np.maximum.accumulate(ocv_v)  # an OCV increases with the SOC
    settings["ocv_slope_v"] = np.maximum(np.gradient(settings["ocv_v"], soc), MIN_SLOPE_V * series)
    curve_variance_v2 = np.maximum(
        np.interp(SOC_GRID, NODE_SOC, np.diag(fit.covariance)[FIT_CURVE]), MIN_CURVE_STD_V**2
    )
    direction_std_v = CellCurves(file_settings).direction_std_v
    settings["constant_error_v"], settings["varying_error_v"] = (
        series * np.sqrt(curve_variance_v2),
        series * direction_std_v,
    )
    settings["curve_error_v"] = series * np.sqrt(curve_variance_v2 + direction_std_v**2)
    settings["node_correlation"] = NODE_CORRELATION


def _adopt_resistances(settings: np.void, file_settings: np.void, fit: PackFit) -> None:
    """Write the fitted resistances and their std."""
    for name in ("weak_ohm", "strong_ohm"):
        settings[name] = file_settings[name] * exp(fit.ln_r)[:, RESISTANCE_GROUPS]
    middle = SOC_GRID.size // 2
    settings["middle_ohm"] = settings["weak_ohm"][middle].sum() + settings["strong_ohm"][middle].sum()
    settings["r_std"] = r_std(fit)
    # computed from the std as for the cell file, and never above its value
    settings["bias_relative"] = min(
        float(file_settings["bias_relative"]), max(Noise.bias_relative, MIN_BIAS_OF_R_STD * r_std(fit))
    )


def smallest_soc_std(fit: PackFit) -> float:
    """Return the smallest std over SOC. It is at the SOC at which the errors of SOC and capacity cancel.

    The voltages until the next fit have the same errors as the fitted ones. They therefore cannot lower the std of the SOC
    below this value.
    """
    covariance = fit.covariance
    capacity_variance = max(covariance[FIT_LN_Q, FIT_LN_Q], np.finfo(float).tiny)
    by_capacity = covariance[FIT_SOC, FIT_LN_Q] ** 2 / capacity_variance
    return float(np.sqrt(max(covariance[FIT_SOC, FIT_SOC] - by_capacity, 0.0)))


def r_std(fit: PackFit) -> float:
    """Return the relative std of the fitted resistances."""
    return max(float(np.sqrt(np.diag(fit.covariance)[FIT_LN_R].max())), MIN_R_STD)


def adopt_state(estimator: Estimator, fit: PackFit) -> None:
    """Set SOC, offset and capacity of the filter, with their covariances with the curve, after ``adopt_curves``.

    After a gap since the fit's last row each hypothesis of the filter keeps its SOC. A single hypothesis also keeps it if its std is
    smaller than the fit's.
    """
    h, f, p = estimator.record[0]["history"], estimator.record[0]["filter"], estimator.settings_record[0]["filter"]
    is_surer = f["count"] == 1 and f["soc_std"] ** 2 < fit.covariance[FIT_SOC, FIT_SOC]
    drawn_soc = (h["charge_as"] - fit.charge_as) / p["capacity_as"] * math.exp(-fit.mean[FIT_LN_Q])
    estimator.adopt(
        FittedState(
            soc=fit.mean[FIT_SOC] - drawn_soc if h["segment"] == fit.segment and not is_surer else None,
            ln_q=fit.mean[FIT_LN_Q],
            offset_a=fit.mean[FIT_OFFSET] * p["capacity_as"] / HOUR_S,
            covariance=_state_covariance(fit, p),
            is_exchanged=fit.is_exchanged,
            faults=fit.faults,
        )
    )


def _state_covariance(fit: PackFit, p: np.void) -> Floats:
    """Return the fit's covariance in the units of the filter, in the order of ``FILTER_STATES``."""
    node_std_v = np.interp(NODE_SOC, SOC_GRID, p["constant_error_v"]) / float(p["series"])
    unit = np.r_[1.0, 1.0, float(p["capacity_as"]) / HOUR_S, 1.0 / node_std_v]
    return np.asarray(fit.covariance[np.ix_(FIT_RESULTS, FIT_RESULTS)] * np.outer(unit, unit))
