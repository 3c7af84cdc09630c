"""Hand-over of a fit to the filter.

The fitted curves replace those in the filter's settings. SOC, capacity and offset of the fit, with their covariance, replace
those in the filter's state.
"""

import numpy as np

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.filter_settings import MIN_BIAS_OF_R_STD, MIN_SOC_STD
from bms_estimator.kernels.kalman_filter.ekf import MAX_SOC, MIN_SOC
from bms_estimator.kernels.kalman_filter.mixture import clear_hypothesis, copy_hypothesis, mixture_moments
from bms_estimator.kernels.kalman_filter.ocv_correction import NODE_CORRELATION
from bms_estimator.kernels.kalman_filter.records import (
    HYPOTHESES,
    LN_Q,
    LN_R,
    LN_R0,
    NODE,
    NODES,
    OFFSET,
    SOC,
    Noise,
)
from bms_estimator.kernels.pack_voltage import RESISTANCE_GROUPS
from bms_estimator.model.arrays import Floats
from bms_estimator.pack_model.cell_curves import SOC_GRID, CellCurves
from bms_estimator.pack_model.fit import CURVE as FIT_CURVE
from bms_estimator.pack_model.fit import LN_Q as FIT_LN_Q
from bms_estimator.pack_model.fit import LN_R as FIT_LN_R
from bms_estimator.pack_model.fit import NODE_SOC, PackFit
from bms_estimator.pack_model.fit import OFFSET as FIT_OFFSET
from bms_estimator.pack_model.fit import SOC as FIT_SOC
from bms_estimator.pack_model.intervals import HOUR_S

MIN_CURVE_STD_V = 0.003
"""Minimum std of the OCV of one cell [V]. Assumed."""
MIN_R_STD = Noise.r_std
"""Minimum relative std of the resistances: the default without a std in the cell file."""
MIN_SOC_STD_FRACTION = 0.55
"""Minimum std of the published SOC after a fit, as a fraction of the minimum with the curves of the cell file. Assumed: a fitted
pack is known better than a cell that was not measured."""
FILTER_STATES = np.array([SOC, LN_Q, OFFSET, *range(NODE, NODE + NODES)])
"""States of the filter that a fit determines jointly."""
FIT_RESULTS = np.array([FIT_SOC, FIT_LN_Q, FIT_OFFSET, *range(FIT_CURVE.start, FIT_CURVE.stop)])
"""Results of a fit in the order of ``FILTER_STATES``."""
FIRST_PARAMETER = 1
"""Position in ``FILTER_STATES`` of the first state after the SOC."""
MIN_SLOPE_V = 1e-3
"""Minimum slope of the fitted OCV of one cell [V per unit SOC], because a slope of 0 has no inverse."""


def adopt_curves(settings: np.void, file_settings: np.void, fit: PackFit) -> None:
    """Write the cell file's curves, corrected by the fit, to the filter's settings.

    Args:
        settings: Record of dtype EKF_SETTINGS; written.
        file_settings: Record of dtype EKF_SETTINGS by the cell file.
        fit: Fit of the history.
    """
    _adopt_ocv(settings, file_settings, fit)
    _adopt_resistances(settings, file_settings, fit)
    settings["hysteresis_v"] = fit.hysteresis * file_settings["hysteresis_v"]
    file_std = MIN_SOC_STD_FRACTION * float(file_settings["min_soc_std"])
    settings["min_soc_std"] = max(MIN_SOC_STD, file_std, smallest_soc_std(fit))


def _adopt_ocv(settings: np.void, file_settings: np.void, fit: PackFit) -> None:
    """Write the fitted OCV and its std. The error by direction is the varying part of the variance (``CURVE``)."""
    series = float(file_settings["series"])
    soc = np.linspace(0.0, 1.0, file_settings["ocv_v"].size)
    ocv_v = file_settings["ocv_v"] + series * np.interp(soc, SOC_GRID, fit.curve_v)
    settings["ocv_v"] = np.maximum.accumulate(ocv_v)  # an OCV increases with the SOC
    settings["ocv_slope_v"] = np.maximum(np.gradient(settings["ocv_v"], soc), MIN_SLOPE_V * series)
    node_v2 = np.maximum(np.interp(SOC_GRID, NODE_SOC, np.diag(fit.covariance)[FIT_CURVE]), MIN_CURVE_STD_V**2)
    direction_std_v = CellCurves(file_settings).direction_std_v
    settings["constant_error_v"], settings["varying_error_v"] = series * np.sqrt(node_v2), series * direction_std_v
    settings["curve_error_v"] = series * np.sqrt(node_v2 + direction_std_v**2)
    settings["node_correlation"] = NODE_CORRELATION


def _adopt_resistances(settings: np.void, file_settings: np.void, fit: PackFit) -> None:
    """Write the fitted resistances and their std."""
    for name in ("weak_ohm", "strong_ohm"):
        settings[name] = file_settings[name] * np.exp(fit.ln_r)[:, RESISTANCE_GROUPS]
    middle = SOC_GRID.size // 2
    settings["middle_ohm"] = settings["weak_ohm"][middle].sum() + settings["strong_ohm"][middle].sum()
    settings["r_std"] = r_std(fit)
    settings["bias_relative"] = min(
        float(file_settings["bias_relative"]), max(Noise.bias_relative, MIN_BIAS_OF_R_STD * r_std(fit))
    )


def smallest_soc_std(fit: PackFit) -> float:
    """Return the std at the SOC that is known best: the SOC at which errors of SOC and capacity cancel.

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
    """Write SOC, offset, capacity and their covariances with the curve to the filter's state.

    After a gap since the fit's last row each hypothesis of the filter keeps its SOC.
    """
    f, h = estimator.record[0]["filter"], estimator.record[0]["history"]
    p = estimator.settings_record[0]["filter"]
    f["learned_soc"] = p["learning_soc"]  # the first pass is complete: voltages change neither capacity nor curve
    if h["segment"] != fit.segment:
        for q in range(int(f["count"])):
            _adopt_parameters(f["mean"][q], f["covariance"][q], fit, p, FIRST_PARAMETER)
        return
    if f["best"] != 0:
        copy_hypothesis(f, int(f["best"]), 0)
    drawn_soc = (h["charge_as"] - fit.charge_as) / p["capacity_as"] * np.exp(-fit.mean[FIT_LN_Q])
    f["mean"][0][SOC] = np.clip(fit.mean[FIT_SOC] - drawn_soc, MIN_SOC, MAX_SOC)
    _adopt_parameters(f["mean"][0], f["covariance"][0], fit, p, 0)
    f["count"], f["best"], f["ln_weight"][0] = 1, 0, 0.0
    for q in range(1, HYPOTHESES):
        clear_hypothesis(f, q)
    mixture_moments(f)
    estimator.state["soc"] = f["soc"]


def _adopt_parameters(mean: Floats, covariance: Floats, fit: PackFit, p: np.void, first: int) -> None:
    """Write offset, capacity, curve and scales of the resistances, with their covariance, to one hypothesis.

    Args:
        mean: Mean of the hypothesis; written.
        covariance: Covariance of the hypothesis; written.
        fit: Fit of the history.
        p: Record of dtype EKF_SETTINGS with the fitted curves.
        first: First of ``FILTER_STATES`` whose covariance is written: 0 includes the SOC.
    """
    mean[LN_Q], mean[OFFSET] = fit.mean[FIT_LN_Q], fit.mean[FIT_OFFSET] * p["capacity_as"] / HOUR_S
    mean[NODE : NODE + NODES] = mean[LN_R0] = mean[LN_R] = 0.0  # the settings contain the fitted curves
    states = FILTER_STATES[first:]
    _decouple(covariance, [*states, LN_R0, LN_R])
    covariance[np.ix_(states, states)] = _state_covariance(fit, p)[first:, first:]
    covariance[SOC, SOC] = max(covariance[SOC, SOC], float(p["min_soc_std"]) ** 2)
    covariance[LN_R0, LN_R0] = covariance[LN_R, LN_R] = float(p["r_std"]) ** 2


def _state_covariance(fit: PackFit, p: np.void) -> Floats:
    """Return the fit's covariance in the units of the filter, in the order of ``FILTER_STATES``."""
    node_std_v = np.interp(NODE_SOC, SOC_GRID, series_curve_std(p)) / float(p["series"])
    unit = np.r_[1.0, 1.0, float(p["capacity_as"]) / HOUR_S, 1.0 / node_std_v]
    return np.asarray(fit.covariance[np.ix_(FIT_RESULTS, FIT_RESULTS)] * np.outer(unit, unit))


def series_curve_std(p: np.void) -> Floats:
    """Return the std of the OCV nodes of the pack [V]."""
    return np.asarray(p["constant_error_v"])


def _decouple(covariance: Floats, states: list[int]) -> None:
    """Set rows and columns of a covariance to 0."""
    covariance[states, :] = 0.0
    covariance[:, states] = 0.0
