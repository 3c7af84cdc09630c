"""Replacement of the filter's state by the results of a fit of the pack's model, and its rescaling to other curves.

The filter stores resistances as ratios to the curves in its settings. When these curves change, the ratios are rescaled, so
that the resistances in ohm do not change.
"""

import math
from dataclasses import dataclass

import numpy as np

from bms_estimator.kernels.cell_model.rc_ladder import RESISTANCES, resistances
from bms_estimator.kernels.kalman_filter.ekf import MAX_SOC, MIN_SOC
from bms_estimator.kernels.kalman_filter.mixture import clear_hypothesis, copy_hypothesis, mixture_moments
from bms_estimator.kernels.kalman_filter.ocv_correction import reset_ocv_correction
from bms_estimator.kernels.kalman_filter.records import HYPOTHESES, LN_Q, LN_R, LN_R0, NODE, NODES, OFFSET, SOC
from bms_estimator.model.arrays import Floats, Records
from bms_estimator.model.input_faults import InputFault

FILTER_STATES = np.array([SOC, LN_Q, OFFSET, *range(NODE, NODE + NODES)])
"""States of the filter that a fit determines jointly."""
FIRST_PARAMETER = 1
"""Position in ``FILTER_STATES`` of the first state after the SOC."""


@dataclass(frozen=True)
class FittedState:
    """Results of a fit in the units of the filter.

    Attributes:
        soc: SOC at the present sample; None: the SOC of each hypothesis remains, because a gap followed the fit or the filter is surer.
        ln_q: Logarithm of the ratio of the capacity to the declared one.
        offset_a: Current offset [A].
        covariance: Covariance of ``FILTER_STATES``. The correction of the OCV is 0, because the settings have the fitted curves.
        is_exchanged: True if the voltages show another pack.
        faults: Faults that the fitted values show.
    """

    soc: float | None
    ln_q: float
    offset_a: float
    covariance: Floats
    is_exchanged: bool
    faults: InputFault


def write_fitted_state(f: np.void, p: np.void, state: FittedState) -> None:
    """Write the results of a fit to the filter.

    Args:
        f: Record of dtype EKF_STATE; written.
        p: Record of dtype EKF_SETTINGS with the fitted curves.
        state: Results of the fit.
    """
    f["learned_soc"] = p[
        "learning_soc"
    ]  # from now on voltages change neither capacity nor curve, because the fit has used them
    if state.soc is None:
        for i in range(int(f["count"])):
            _write_parameters(f["mean"][i], f["covariance"][i], state, p, FIRST_PARAMETER)
        return
    if f["best"] != 0:
        copy_hypothesis(f, int(f["best"]), 0)
    f["mean"][0][SOC] = np.clip(state.soc, MIN_SOC, MAX_SOC)
    _write_parameters(f["mean"][0], f["covariance"][0], state, p, 0)
    f["count"], f["best"], f["ln_weight"][0] = 1, 0, 0.0
    for i in range(1, HYPOTHESES):
        clear_hypothesis(f, i)
    mixture_moments(f)


def _write_parameters(mean: Floats, covariance: Floats, state: FittedState, p: np.void, first: int) -> None:
    """Write offset, capacity, curve and scales of the resistances, with their covariance, to one hypothesis.

    Args:
        mean: Mean of the hypothesis; written.
        covariance: Covariance of the hypothesis; written.
        state: Results of the fit.
        p: Record of dtype EKF_SETTINGS with the fitted curves.
        first: First of ``FILTER_STATES`` whose covariance is written: 0 includes the SOC.
    """
    mean[LN_Q], mean[OFFSET] = state.ln_q, state.offset_a
    mean[NODE : NODE + NODES] = mean[LN_R0] = mean[LN_R] = 0.0  # the settings contain the fitted curves
    states = FILTER_STATES[first:]
    replaced = [*states, LN_R0, LN_R]
    covariance[replaced, :] = covariance[:, replaced] = 0.0
    covariance[np.ix_(states, states)] = state.covariance[first:, first:]
    covariance[SOC, SOC] = max(covariance[SOC, SOC], float(p["min_soc_std"]) ** 2)
    covariance[LN_R0, LN_R0] = covariance[LN_R, LN_R] = float(p["r_std"]) ** 2


def present_ohm(settings: np.void, f: np.void) -> Floats:
    """Return the resistances of the settings' curves at the present SOC and temperature, shape (RESISTANCES,) [ohm].

    Args:
        settings: Record of dtype EKF_SETTINGS.
        f: Record of dtype EKF_STATE, after a sample.
    """
    ohm = np.zeros(RESISTANCES)
    resistances(
        float(f["soc"]), settings["weak_ohm"], settings["strong_ohm"], float(f["weak"]), float(f["strong"]), ohm
    )
    return ohm


def use_curves(f: np.void, settings: Records, curves: np.void) -> None:
    """Replace the curves in the filter's settings without a change of R_s in ohm.

    R_s is the series resistance learned from current steps. The filter stores it relative to R_0 of the curves.

    Args:
        f: Record of dtype EKF_STATE.
        settings: Shape (1,), dtype EKF_SETTINGS; written.
        curves: Record of dtype EKF_SETTINGS with the new curves.
    """
    before = present_ohm(settings[0], f)
    settings[0] = curves
    if f["started"]:
        f["step"]["ln_ratio"] += math.log(before[0] / present_ohm(settings[0], f)[0])


def return_to_cell_file(f: np.void, settings: Records, cell_file: np.void) -> None:
    """Replace the curves of a fit by those of the cell file.

    SOC, capacity and the resistances at the present SOC do not change. The correction of the OCV is reset to its prior.

    Args:
        f: Record of dtype EKF_STATE; written.
        settings: Shape (1,), dtype EKF_SETTINGS; written.
        cell_file: Record of dtype EKF_SETTINGS with the curves of the cell file.
    """
    before = present_ohm(settings[0], f)
    use_curves(f, settings, cell_file)
    if not f["started"]:
        return
    after = present_ohm(settings[0], f)
    variance = float(settings[0]["r_std"]) ** 2
    count = int(f["count"])
    for mean, covariance in zip(f["mean"][:count], f["covariance"][:count], strict=True):
        mean[LN_R0] += math.log(before[0] / after[0])
        mean[LN_R] += math.log(before[1:].sum() / after[1:].sum())
        # the learned variances are relative to the fitted curves; relative to the cell file only the prior is known
        for j in (LN_R0, LN_R):
            covariance[j, :] = covariance[:, j] = 0.0
            covariance[j, j] = variance
        reset_ocv_correction(settings[0], mean, covariance)
