"""Replacement of the filter's state by the results of a fit of the pack's model."""

from dataclasses import dataclass

import numpy as np

from bms_estimator.kernels.kalman_filter.ekf import MAX_SOC, MIN_SOC
from bms_estimator.kernels.kalman_filter.mixture import clear_hypothesis, copy_hypothesis, mixture_moments
from bms_estimator.kernels.kalman_filter.records import HYPOTHESES, LN_Q, LN_R, LN_R0, NODE, NODES, OFFSET, SOC
from bms_estimator.model.arrays import Floats
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
