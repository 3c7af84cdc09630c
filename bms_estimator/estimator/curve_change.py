"""Rescaling of the filter's state when the curves in its settings change.

The filter stores resistances as ratios to these curves. The ratios are rescaled, so that the resistances in ohm do not change.
"""

import math

import numpy as np

from bms_estimator.kernels.cell_model.rc_ladder import RESISTANCES, resistances
from bms_estimator.kernels.kalman_filter.ocv_correction import reset_ocv_correction
from bms_estimator.kernels.kalman_filter.records import LN_R, LN_R0
from bms_estimator.model.arrays import Floats, Records


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
