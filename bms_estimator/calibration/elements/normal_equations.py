"""Normal equations of the ladder fit over one capture, and the linear model with its unknowns.

Each capture counts as ``ROWS_PER_CAPTURE`` rows, whatever its number of rows. The weight of a row is the time since the
previous row, divided by the time since the last change of current, so that each decade of time in a rest has equal weight. The
ends of long rests have additional weight, together as much as all other rows. The error of a row is relative to its voltage
drop if that is large. All constants of this module were chosen by the score of replays on drive cycles that were not part of
the fit.

The linear model is

    v = E_o(SOC) + d(SOC) + (T - 25 C) u(SOC) - sum_k [w_k(SOC) g_w(T) + s_k(SOC) g_s(T)] x_k

x_0 is the current and x_k the current filtered by RC pair k. g_w and g_s are the Arrhenius factors of the resistances'
parts with weak and strong temperature dependence. w and s are these parts, piecewise linear over SOC. d is a correction
of the open-circuit voltage (cubic spline), u a correction of its temperature coefficient. u also absorbs the voltage that
a cold cell has not relaxed after half an hour. Without u, the slow RC pairs absorb that voltage, and the predicted drop of
a cold drive is twice too large.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from bms_estimator.calibration.cleaning.clean_capture import CleanCapture, true_runs
from bms_estimator.calibration.ocv.overpotential import arrhenius, linear_interpolation_matrix
from bms_estimator.kernels.cell_model.open_loop import branch_currents
from bms_estimator.kernels.cell_model.rc_ladder import (
    HIGH_ACTIVATION_ENERGY,
    LOW_ACTIVATION_ENERGY,
    REFERENCE_C,
    RESISTANCES,
)
from bms_estimator.model.arrays import Floats, Masks
from bms_estimator.model.errors import UserError

SOC_NODES = np.array([0.0, 0.1, 0.2, 0.3, 0.45, 0.65, 0.85, 1.0])
"""SOC nodes of the resistances."""
KELVIN_NODES = np.array([0.0, 0.15, 0.3, 0.5, 0.75, 1.0])
"""SOC nodes of dE/dT."""
KNOTS = np.unique(np.round(np.r_[np.arange(0.0, 0.25, 0.025), np.arange(0.25, 1.0, 0.045), 1.0], 4))
"""SOC nodes of the correction of the OCV."""
SPLINES = KNOTS.size + 2
"""Number of spline coefficients of d."""
UNBOUNDED = SPLINES + KELVIN_NODES.size
"""Number of unknowns that may be negative. They precede the resistances."""
PART_SIZE = RESISTANCES * SOC_NODES.size
"""Number of unknowns in the weak part, and in the strong part, of the resistances."""


def correction_at(soc: Floats) -> Floats:
    """Return the cubic B-splines of d at ``soc``. Shape (n, SPLINES)."""
    knots = np.r_[np.zeros(3), KNOTS, np.ones(3)]
    return np.asarray(BSpline.design_matrix(np.clip(soc, 0.0, 1.0), knots, 3).toarray())


def model_rows(soc: Floats, temperature_c: Floats, currents: Floats) -> Floats:
    """Return the unweighted rows of the model. Shape (n, UNBOUNDED + 2 PART_SIZE)."""
    currents_at_nodes = currents[:, :, None] * linear_interpolation_matrix(soc, SOC_NODES)[:, None, :]
    drop_rows = currents_at_nodes.reshape(soc.size, -1)
    return np.hstack(
        [
            correction_at(soc),
            linear_interpolation_matrix(soc, KELVIN_NODES) * (temperature_c - REFERENCE_C)[:, None],
            -drop_rows * arrhenius(LOW_ACTIVATION_ENERGY, temperature_c)[:, None],
            -drop_rows * arrhenius(HIGH_ACTIVATION_ENERGY, temperature_c)[:, None],
        ]
    )


ROWS_PER_CAPTURE = 30.0
"""Number of independent rows that a capture counts as."""
ERROR_V = 4e-3
"""Std of a row at 25 C per cell [V]."""
ERROR_J = 22e3
"""Activation energy of the growth of ``ERROR_V`` in the cold [J/mol]."""
SOC_STD = 0.01
"""Std of the SOC after the SOC has changed by 1. The variance is proportional to the change, because at a knee far from the
start a cell deviates from its curve. This voltage error must not appear as a resistance."""
RELATIVE_STD = 0.1
"""Std of a row relative to its voltage drop. The drop is the largest of the currents x_0 to x_3 times the scale of the
resistances."""
STEP_ROWS = 30.0
"""Weight of all voltage jumps of a capture at clean current steps, in rows. Jumps determine R_0 and do not drift."""
STEP_V = 1e-3
"""Std of a voltage jump at a clean current step, per cell [V]."""
STEADY_FRACTION = 0.01
"""Maximum variation of the current before and after a clean step, as a fraction of the largest current. With a varying
current, a delay between voltage and current samples would change R_0."""
STEADY_S = 5.0
"""Duration for which the current is constant before and after a clean step [s]."""
MAX_STEP_S = 1.5
"""Maximum time between the two samples of a clean step [s]."""
COUNT_STD = 0.004
"""Relative std of the charge counted in a capture, and of the capacity at its temperature."""
STEP_FRACTION = 0.1
"""Minimum change of current at which the time since the last change restarts, as a fraction of the largest current."""
MIN_SINCE_STEP_S = 10.0
"""Minimum of the time since the last change of current, in the weight of a row [s]."""
MAX_ROW_S = 30.0
"""Maximum of the time since the previous row, in the weight of a row [s]."""
LONG_REST_S = 500.0
"""Minimum duration of a long rest [s]."""
REST_FRACTION = 0.01
"""Maximum current of a rest, as a fraction of the largest current."""
ROW_INTERVAL_S = 0.5
"""Minimum time between two rows [s]."""
MIN_SOC = 0.02
"""Minimum SOC of the rows."""
MAX_SOC = 1.01
"""Maximum SOC of the rows. It exceeds 1 by the error of the counted charge."""


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of one capture, with y the measured voltage less the given OCV.

    X are the rows of the model, W their weights. The miscount is the relative error of the counted charge.

    Attributes:
        information: X'WX with the miscount of the charge marginalized.
        information_vector: X'Wy with the miscount marginalized.
        miscount_cross: X'Wc, where c is the voltage change due to a miscount of 1.
        miscount_information: c'Wc plus the inverse prior variance of the miscount.
        miscount_vector: c'Wy plus the term of the miscount's prior.
    """

    information: Floats
    information_vector: Floats
    miscount_cross: Floats
    miscount_information: float
    miscount_vector: float

    def miscount(self, coefficients: Floats) -> float:
        """Return the relative error of the charge count at which the voltage of a fit matches the capture's."""
        return float((self.miscount_vector - self.miscount_cross @ coefficients) / self.miscount_information)


def normal_equations(
    capture: CleanCapture,
    soc: Floats,
    given_v: Floats,
    slope_v: Floats,
    temperature_c: Floats,
    scale_ohm: float,
    series: int,
    miscount: float,
) -> NormalEquations:
    """Return the normal equations of the regression over ``capture``.

    Args:
        capture: Capture that starts at rest.
        soc: Shape (n,), counted SOC, corrected for ``miscount``.
        given_v: Shape (n,), the given OCV at SOC and temperature [V].
        slope_v: Shape (n,), slope dE_o/dSOC of the given OCV [V].
        temperature_c: Shape (n,) [C].
        scale_ohm: Scale of the resistances [ohm].
        series: Cells in series.
        miscount: Relative correction of the counted charge that ``soc`` includes.

    Raises:
        UserError: No sample lies within ``MIN_SOC`` to ``MAX_SOC``.
    """
    currents = np.column_stack([capture.current_a, branch_currents(capture.time_s, capture.current_a)])  # x_0, x_1, ...
    weight, is_rest_end = _weights(capture)
    inside = (soc > MIN_SOC) & (soc < MAX_SOC)
    selected = (_first_of_each_slot(capture.time_s) | is_rest_end) & inside & ~capture.mismatched
    if not selected.any():
        raise UserError(
            f"{capture.name}: no sample between SOC {MIN_SOC:g} and {MAX_SOC:g} [--soc], so that resistances are undetermined"
        )
    max_current_a = np.abs(currents[:, :4]).max(axis=1)  # of x_0 to x_3, see RELATIVE_STD
    std_v = arrhenius(ERROR_J, temperature_c) * np.hypot(ERROR_V * series, RELATIVE_STD * scale_ohm * max_current_a)
    std_v = np.hypot(std_v, SOC_STD * np.sqrt(np.abs(soc - soc[0])) * slope_v)
    weight = np.where(selected, weight, 0.0)
    root_weight = (np.sqrt(ROWS_PER_CAPTURE * weight / weight.sum()) / std_v)[selected]
    residual_v = capture.voltage_v - given_v
    rows = model_rows(soc[selected], temperature_c[selected], currents[selected]) * root_weight[:, None]
    target = residual_v[selected] * root_weight
    # the rows of voltage jumps: each is the difference between the samples after and before a clean step
    is_after_step = _clean_steps(capture) & inside
    is_before_step = np.r_[is_after_step[1:], False]
    if is_after_step.any():
        change_a = np.abs(capture.current_a[is_after_step] - capture.current_a[is_before_step])
        step_std_v = np.hypot(STEP_V * series, RELATIVE_STD * scale_ohm * change_a) * arrhenius(
            ERROR_J, temperature_c[is_after_step]
        )
        step_root_weight = np.sqrt(STEP_ROWS / is_after_step.sum()) / step_std_v
        jump = model_rows(soc[is_after_step], temperature_c[is_after_step], currents[is_after_step])
        jump -= model_rows(soc[is_before_step], temperature_c[is_before_step], currents[is_before_step])
        rows = np.vstack([rows, jump * step_root_weight[:, None]])
        target = np.r_[target, (residual_v[is_after_step] - residual_v[is_before_step]) * step_root_weight]
    miscount_column = np.zeros(target.size)  # weighted voltage change due to a miscount of 1; 0 for jumps
    miscount_column[: selected.sum()] = slope_v[selected] * (soc[selected] - soc[0]) * root_weight
    miscount_cross, miscount_information = (
        rows.T @ miscount_column,
        float(miscount_column @ miscount_column + 1.0 / COUNT_STD**2),
    )
    miscount_vector = float(miscount_column @ target - miscount / COUNT_STD**2)
    return NormalEquations(
        information=rows.T @ rows - np.outer(miscount_cross, miscount_cross) / miscount_information,
        information_vector=rows.T @ target - miscount_cross * miscount_vector / miscount_information,
        miscount_cross=miscount_cross,
        miscount_information=miscount_information,
        miscount_vector=miscount_vector,
    )


def _first_of_each_slot(time_s: Floats) -> Masks:
    """Return a mask of the first sample in each slot of ``ROW_INTERVAL_S``."""
    slot = np.floor(time_s / ROW_INTERVAL_S)
    return np.asarray(np.r_[True, np.diff(slot) > 0.0], dtype=np.bool_)


def _weights(capture: CleanCapture) -> tuple[Floats, Masks]:
    """Return the relative weight of each row, and a mask of the last rows of long rests."""
    largest_a = float(np.abs(capture.current_a).max())
    step_s = np.clip(np.diff(capture.time_s, append=capture.time_s[-1] + 1.0), 0.0, MAX_ROW_S)
    changed = np.r_[True, np.abs(np.diff(capture.current_a)) > STEP_FRACTION * largest_a]
    last_change = np.maximum.accumulate(np.where(changed, np.arange(changed.size), 0))
    weight = step_s / np.maximum(capture.time_s - capture.time_s[last_change] + step_s, MIN_SINCE_STEP_S)
    weight /= weight.sum()
    resting = np.abs(capture.current_a) < REST_FRACTION * largest_a
    ends = [
        end - 1 for first, end in true_runs(resting) if capture.time_s[end - 1] - capture.time_s[first] > LONG_REST_S
    ]
    weight[ends] += 1.0 / max(len(ends), 1)
    last = np.zeros(weight.size, dtype=np.bool_)
    last[ends] = True
    return weight, last


def _clean_steps(capture: CleanCapture) -> Masks:
    """Return a mask of the samples directly after clean current steps (see ``STEADY_FRACTION``)."""
    largest_a = float(np.abs(capture.current_a).max())
    change_a = np.abs(np.diff(capture.current_a, prepend=capture.current_a[0]))
    step_s = np.diff(capture.time_s, prepend=capture.time_s[0])
    changes = np.flatnonzero(change_a > STEADY_FRACTION * largest_a)
    bounds_s = np.r_[capture.time_s[0], capture.time_s[changes], capture.time_s[-1]]
    steady = (bounds_s[1:-1] - bounds_s[:-2] >= STEADY_S) & (bounds_s[2:] - bounds_s[1:-1] >= STEADY_S)
    clean = np.zeros(change_a.size, dtype=np.bool_)
    clean[changes[steady]] = True
    clean &= ~(capture.mismatched | np.roll(capture.mismatched, 1))
    return np.asarray(clean & (change_a > STEP_FRACTION * largest_a) & (step_s <= MAX_STEP_S))
