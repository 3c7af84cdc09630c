"""Conversion of a saved state to another declared capacity of the pack, after its setting was corrected."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.cells.records import LEAK
from bms_estimator.kernels.kalman_filter.records import LN_Q, LN_R, LN_R0
from bms_estimator.pack.state import DeclaredValues, PackState


def with_capacity(
    state: PackState, before: DeclaredValues, after: DeclaredValues, filter_settings: np.void
) -> PackState:
    """Return a state with the values that are relative to the declared capacity or resistance converted.

    SOC, charges, and what was learned of capacity and resistances stay, in Ah and ohm. What was not learned follows the declared
    values: the posterior is divided by the old prior and multiplied by the new one. The fits of a history are dropped, because
    the next fit follows from its rows.

    Args:
        state: State of a pack whose declared values were ``before``.
        before: Declared values at the save.
        after: Present declared values.
        filter_settings: Record of dtype EKF_SETTINGS by the cell file.
    """
    ratio, ln_r = after.capacity_ah / before.capacity_ah, math.log(before.r_s_ohm / after.r_s_ohm)
    record = {name: v / ratio if name.endswith(".throughput_soc") else v for name, v in state.record.items()}
    mean, covariance = record["filter.mean"].copy(), record["filter.covariance"]
    shifts = {LN_Q: (-math.log(ratio), float(filter_settings["capacity_std"]))}
    curves = dict(state.curves)
    if curves:  # the resistances of the state are relative to these curves
        curves["ln_r"] = curves["ln_r"] + ln_r
    else:
        shifts |= dict.fromkeys((LN_R0, LN_R), (ln_r, float(filter_settings["r_std"])))
        record["filter.step.ln_ratio"] = record["filter.step.ln_ratio"] + ln_r * _learned_fraction(
            record["filter.step.variance"], float(filter_settings["r_std"])
        )
    for j, (shift, prior_std) in shifts.items():
        mean[..., j] += shift * _learned_fraction(covariance[..., j, j], prior_std)
    record["filter.mean"] = mean
    cells = dict(state.cells)
    if "cells" in cells:
        cells["cells"] = _with_self_discharge(cells["cells"], ratio)
    history = {name: state.history[name] for name in ("rows", "weak_cell_times") if name in state.history}
    if "rows" in history:
        history["rows"] = history["rows"].copy()
        history["rows"]["throughput_soc"] /= ratio
    return replace(state, record=record, curves=curves, cells=cells, history=history)


def _learned_fraction(variance: NDArray[Any], prior_std: float) -> NDArray[Any]:
    """Return the fraction of a state's information that does not come from its prior, 0..1."""
    return np.clip(1.0 - variance / prior_std**2, 0.0, 1.0)


def _with_self_discharge(cells: NDArray[Any], ratio: float) -> NDArray[Any]:
    """Return the states of single cells with their self-discharge, a C-rate, relative to another capacity."""
    cells = cells.copy()
    cells["mean"][..., LEAK] /= ratio
    cells["covariance"][..., LEAK, :] /= ratio
    cells["covariance"][..., :, LEAK] /= ratio
    return cells
