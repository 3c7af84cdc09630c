"""Fit of an RC ladder's resistances to captures by regularized linear least squares with all resistances positive.

    v = E_o(SOC) + d(SOC) + (T - 25 C) u(SOC) - sum_k [w_k(SOC) g_w(T) + s_k(SOC) g_s(T)] x_k

x_0 is the current and x_k the current filtered by RC pair k. g_w and g_s are the Arrhenius factors of the resistances'
parts with weak and strong temperature dependence. w and s are these parts, piecewise linear over SOC. d is a correction
of the open-circuit voltage (cubic spline), u a correction of its temperature coefficient. The problem is linear in all
unknowns. u also absorbs the voltage that a cold cell has not relaxed after half an hour. Without u, the slow RC pairs
absorb that voltage, and the predicted drop of a cold drive is twice too large.

The weight of a capture does not depend on its number of rows. The weight of a row is the time since the previous row,
divided by the time since the last change of current, so that each decade of time in a rest has equal weight. The ends
of long rests have additional weight: together as much as all other rows. Each capture counts as ``ROWS_PER_CAPTURE``
rows. Large voltage drops have an error relative to their size. All constants of this module were chosen by the score of
replays on drive cycles that were not part of the fit.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.optimize import lsq_linear

from bms_estimator.calibration.cleaning.clean_capture import CleanCapture
from bms_estimator.calibration.cleaning.rests import true_runs
from bms_estimator.calibration.ocv.overpotential import arrhenius, linear_interpolation_matrix
from bms_estimator.kernels.cell_model.open_loop import branch_currents
from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C, RESISTANCES, STRONG_J, WEAK_J
from bms_estimator.model.arrays import Floats
from bms_estimator.model.errors import UserError

SOC_NODES = np.array([0.0, 0.1, 0.2, 0.3, 0.45, 0.65, 0.85, 1.0])
"""SOC nodes of the resistances."""
KELVIN_NODES = np.array([0.0, 0.15, 0.3, 0.5, 0.75, 1.0])
"""SOC nodes of dE/dT."""
KNOTS = np.unique(np.round(np.r_[np.arange(0.0, 0.25, 0.025), np.arange(0.25, 1.0, 0.045), 1.0], 4))
"""SOC nodes of the correction of the OCV."""

TYPICAL_DROP_V = 0.09
"""Typical voltage drop of R_0 and the fast RC pairs at 1 C, per cell [V]. It defines the scale of all resistances if a
capture has no current steps."""
ZERO_FRACTION = 1e-6
"""Fraction of the scale below which a fitted resistance counts as 0."""
ROUGHNESS_STD = 0.1
"""Prior std of the difference of a resistance between two SOC nodes, and between two neighboring RC pairs, relative to
the scale. The resistance per decade of time is about constant from a second to an hour."""
LOW_SOC = 0.15
"""SOC below which ``ROUGHNESS_STD`` is larger."""
LOW_SOC_ROUGHNESS = 4.0
"""Factor on ``ROUGHNESS_STD`` below ``LOW_SOC``."""
LEVEL_PRECISION = 1e-6
"""Inverse prior variance of a resistance relative to the scale. It only makes the information matrix regular."""
BEND_V = 10.0
"""Prior std of d2d/dSOC2 per cell [V]."""
LOW_BEND_SOC = 0.12
"""SOC below which the prior std is ``LOW_BEND_FACTOR`` times ``BEND_V``."""
LOW_BEND_FACTOR = 20.0
"""Factor on ``BEND_V`` below ``LOW_BEND_SOC``."""
OCV_INTERVALS = 20
"""Number of SOC intervals with independent errors of the given OCV."""
PER_KELVIN_STD_V = 1e-3
"""Prior std of u per cell [V/K]."""
MEASURED_PER_KELVIN_STD_V = 5e-5
"""Prior std of u per cell if the cell file contains a measured dE/dT [V/K]."""
FIXED_OCV_STD_V = 1e-6
"""Prior std of d if d is not fitted [V]."""
FIXED_PER_KELVIN_STD_V = 1e-9
"""Prior std of u if u is not fitted [V/K]."""

ROWS_PER_CAPTURE = 30.0
"""Number of independent rows that a capture counts as."""
ERROR_V = 4e-3
"""Std of a row at 25 C per cell [V]."""
ERROR_J = 22e3
"""Activation energy of the growth of ``ERROR_V`` in the cold [J/mol]."""
SOC_STD = 0.01
"""Std of the SOC after a change of 1. The variance grows with the change: at a knee far from the start a cell deviates
from its curve, and this voltage error must not appear as a resistance."""
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
        miscount_cross: X'Wc, where c is the voltage change by a miscount of 1.
        miscount_information: c'Wc plus the inverse prior variance of the miscount.
        miscount_vector: c'Wy plus the part of the miscount's prior.
    """

    information: Floats
    information_vector: Floats
    miscount_cross: Floats
    miscount_information: float
    miscount_vector: float

    def miscount(self, fit: "LadderFit") -> float:
        """Return the relative error of the charge count at which the fit's voltage matches the capture's."""
        return float((self.miscount_vector - self.miscount_cross @ fit.coefficients) / self.miscount_information)


@dataclass(frozen=True)
class LadderFit:
    """Result of the fit.

    Attributes:
        correction: Coefficients of d, see ``correction_at``.
        per_kelvin_v: u at ``KELVIN_NODES`` [V/K].
        weak_ohm: Shape (RESISTANCES, SOC_NODES.size), part with the weak temperature dependence [ohm].
        strong_ohm: Shape as of ``weak_ohm``, part with the strong temperature dependence [ohm].
        covariance: Covariance of the weak and then the strong resistances, each row by row. It neglects the bounds at
            0.
    """

    correction: Floats
    per_kelvin_v: Floats
    weak_ohm: Floats
    strong_ohm: Floats
    covariance: Floats

    @property
    def coefficients(self) -> Floats:
        """All unknowns, in the order of the columns."""
        parts = self.correction, self.per_kelvin_v, self.weak_ohm.ravel(), self.strong_ohm.ravel()
        return np.concatenate(parts)

    def branches(self, soc: float, first: int, end: int) -> tuple[float, float]:
        """Return the sum of resistances ``first`` to ``end`` - 1 at ``soc`` and 25 C, and its standard error [ohm]."""
        node_weights = linear_interpolation_matrix(np.array([soc]), SOC_NODES)[0]
        row = np.zeros((2, RESISTANCES, SOC_NODES.size))
        row[:, first:end] = node_weights
        ohm = float((row[0] * (self.weak_ohm + self.strong_ohm)).sum())
        return ohm, float(np.sqrt(row.ravel() @ self.covariance @ row.ravel()))


@dataclass(frozen=True)
class Prior:
    """Prior of the fit.

    Attributes:
        ocv_error_v: Std of d at ``EVEN_SOC`` [V]; ``FIXED_OCV_STD_V`` if d is not fitted.
        per_kelvin_v: Std of u [V/K]; ``FIXED_PER_KELVIN_STD_V`` if u is not fitted.
        scale_ohm: Scale of the resistances [ohm].
        series: Cells in series.
        shapes: Shape (2, RESISTANCES, SOC_NODES.size), typical course of the weak and strong part of each resistance
            over SOC, relative to a mean.
        weak_share: Shape (RESISTANCES, SOC_NODES.size), given fraction of each resistance that is the weak part; None:
            the captures determine it.
    """

    ocv_error_v: Floats
    per_kelvin_v: float
    scale_ohm: float
    series: int
    shapes: Floats
    weak_share: Floats | None


EVEN_SOC = np.linspace(0.0, 1.0, 201)
"""SOC grid of the prior of d."""
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


def normal_equations(
    load: CleanCapture,
    soc: Floats,
    given_v: Floats,
    slope_v: Floats,
    temperature_c: Floats,
    scale_ohm: float,
    series: int,
    miscount: float,
) -> NormalEquations:
    """Return the normal equations of the regression over ``load``.

    Args:
        load: Capture that starts at rest.
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
    currents = np.column_stack([load.current_a, branch_currents(load.time_s, load.current_a)])  # x_0, x_1, ...
    weight, is_rest_end = _weights(load)
    inside = (soc > MIN_SOC) & (soc < MAX_SOC)
    selected = (_first_of_each_slot(load.time_s) | is_rest_end) & inside
    if not selected.any():
        raise UserError(
            f"{load.name}: no sample between SOC {MIN_SOC:g} and {MAX_SOC:g} [--soc], so that resistances are undetermined"
        )
    max_current_a = np.abs(currents[:, :4]).max(axis=1)  # of x_0 to x_3, see RELATIVE_STD
    std_v = arrhenius(ERROR_J, temperature_c) * np.hypot(ERROR_V * series, RELATIVE_STD * scale_ohm * max_current_a)
    std_v = np.hypot(std_v, SOC_STD * np.sqrt(np.abs(soc - soc[0])) * slope_v)
    weight = np.where(selected, weight, 0.0)
    root_weight = (np.sqrt(ROWS_PER_CAPTURE * weight / weight.sum()) / std_v)[selected]
    residual_v = load.voltage_v - given_v
    rows = _rows(soc[selected], temperature_c[selected], currents[selected]) * root_weight[:, None]
    target = residual_v[selected] * root_weight
    # the rows of voltage jumps: each is the difference between the samples after and before a clean step
    is_after_step = _clean_steps(load) & inside
    is_before_step = np.r_[is_after_step[1:], False]
    if is_after_step.any():
        change_a = np.abs(load.current_a[is_after_step] - load.current_a[is_before_step])
        step_std_v = np.hypot(STEP_V * series, RELATIVE_STD * scale_ohm * change_a) * arrhenius(
            ERROR_J, temperature_c[is_after_step]
        )
        step_root_weight = np.sqrt(STEP_ROWS / is_after_step.sum()) / step_std_v
        jump = _rows(soc[is_after_step], temperature_c[is_after_step], currents[is_after_step])
        jump -= _rows(soc[is_before_step], temperature_c[is_before_step], currents[is_before_step])
        rows = np.vstack([rows, jump * step_root_weight[:, None]])
        target = np.r_[target, (residual_v[is_after_step] - residual_v[is_before_step]) * step_root_weight]
    by_miscount = np.zeros(target.size)  # weighted voltage change by a relative miscount of 1; 0 for jumps
    by_miscount[: selected.sum()] = slope_v[selected] * (soc[selected] - soc[0]) * root_weight
    miscount_cross, miscount_information = rows.T @ by_miscount, float(by_miscount @ by_miscount + 1.0 / COUNT_STD**2)
    miscount_vector = float(by_miscount @ target - miscount / COUNT_STD**2)
    return NormalEquations(
        information=rows.T @ rows - np.outer(miscount_cross, miscount_cross) / miscount_information,
        information_vector=rows.T @ target - miscount_cross * miscount_vector / miscount_information,
        miscount_cross=miscount_cross,
        miscount_information=miscount_information,
        miscount_vector=miscount_vector,
    )


def _rows(soc: Floats, temperature_c: Floats, currents: Floats) -> Floats:
    """Return the unweighted rows of the model. Shape (n, UNBOUNDED + 2 PART_SIZE)."""
    currents_at_nodes = currents[:, :, None] * linear_interpolation_matrix(soc, SOC_NODES)[:, None, :]
    drop_rows = currents_at_nodes.reshape(soc.size, -1)
    return np.hstack(
        [
            correction_at(soc),
            linear_interpolation_matrix(soc, KELVIN_NODES) * (temperature_c - REFERENCE_C)[:, None],
            -drop_rows * arrhenius(WEAK_J, temperature_c)[:, None],
            -drop_rows * arrhenius(STRONG_J, temperature_c)[:, None],
        ]
    )


def fit_ladder(captures: list[NormalEquations], prior: Prior) -> LadderFit:
    """Fit the resistances to all ``captures`` by least squares."""
    information = _prior_information(prior) + sum(capture.information for capture in captures)
    information_vector = np.asarray(sum(capture.information_vector for capture in captures))
    # matrix that gives all unknowns from the free ones; with a given weak fraction, only the sums of both parts are free
    from_free = np.eye(UNBOUNDED + 2 * PART_SIZE)
    if prior.weak_share is not None:
        weak_fraction = prior.weak_share.ravel()
        from_free = np.zeros((UNBOUNDED + 2 * PART_SIZE, UNBOUNDED + PART_SIZE))
        from_free[:UNBOUNDED, :UNBOUNDED] = np.eye(UNBOUNDED)
        from_free[UNBOUNDED : UNBOUNDED + PART_SIZE, UNBOUNDED:] = np.diag(weak_fraction)
        from_free[UNBOUNDED + PART_SIZE :, UNBOUNDED:] = np.diag(1.0 - weak_fraction)
    information = from_free.T @ information @ from_free
    # least squares with the Cholesky factor as rows has these normal equations
    cholesky = np.linalg.cholesky(information)
    lower_bounds = np.r_[np.full(UNBOUNDED, -np.inf), np.zeros(cholesky.shape[0] - UNBOUNDED)]
    target = np.linalg.solve(cholesky, from_free.T @ information_vector)
    unknowns = from_free @ lsq_linear(cholesky.T, target, bounds=(lower_bounds, np.inf), tol=1e-12, max_iter=500).x
    covariance = from_free @ np.linalg.inv(information) @ from_free.T
    ohm = np.where(unknowns[UNBOUNDED:] > ZERO_FRACTION * prior.scale_ohm, unknowns[UNBOUNDED:], 0.0)
    weak, strong = ohm.reshape(2, RESISTANCES, SOC_NODES.size)
    return LadderFit(unknowns[:SPLINES], unknowns[SPLINES:UNBOUNDED], weak, strong, covariance[UNBOUNDED:, UNBOUNDED:])


def _prior_information(prior: Prior) -> Floats:
    """Return the information matrix of the prior of all unknowns."""
    table = np.zeros((UNBOUNDED + 2 * PART_SIZE, UNBOUNDED + 2 * PART_SIZE))
    spline = correction_at(EVEN_SOC)
    deviation = spline / prior.ocv_error_v[:, None] * np.sqrt(OCV_INTERVALS / EVEN_SOC.size)
    bend = np.diff(spline, 2, axis=0) * (EVEN_SOC.size - 1) ** 2 / (BEND_V * prior.series)
    bend[EVEN_SOC[1:-1] < LOW_BEND_SOC] /= LOW_BEND_FACTOR
    table[:SPLINES, :SPLINES] = deviation.T @ deviation + bend.T @ bend / OCV_INTERVALS
    table[SPLINES:UNBOUNDED, SPLINES:UNBOUNDED] = np.eye(KELVIN_NODES.size) / prior.per_kelvin_v**2
    for first, shape in zip((UNBOUNDED, UNBOUNDED + PART_SIZE), prior.shapes, strict=True):
        rough = _rough_rows() / (ROUGHNESS_STD * prior.scale_ohm) / shape.ravel()
        part = rough.T @ rough + LEVEL_PRECISION * np.eye(PART_SIZE) / prior.scale_ohm**2
        table[first : first + PART_SIZE, first : first + PART_SIZE] = part
    return table


def _rough_rows() -> Floats:
    """Return the differences of one part's resistances along SOC and between neighboring RC pairs, as rows."""
    unknowns = np.eye(PART_SIZE).reshape(RESISTANCES, SOC_NODES.size, PART_SIZE)  # index 0 is R_0, which is no RC pair
    std_factor = np.where(SOC_NODES < LOW_SOC, LOW_SOC_ROUGHNESS, 1.0)
    along = (unknowns[:, 1:] - unknowns[:, :-1]) / std_factor[None, :-1, None]
    across = (unknowns[2:] - unknowns[1:-1]) / std_factor[None, :, None]
    return np.vstack([along.reshape(-1, PART_SIZE), across.reshape(-1, PART_SIZE)])


def _first_of_each_slot(time_s: Floats) -> NDArray[np.bool_]:
    """Return a mask of the first sample in each slot of ``ROW_INTERVAL_S``."""
    slot = np.floor(time_s / ROW_INTERVAL_S)
    return np.asarray(np.r_[True, np.diff(slot) > 0.0], dtype=np.bool_)


def _weights(load: CleanCapture) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the relative weight of each row, and a mask of the last rows of long rests."""
    largest_a = float(np.abs(load.current_a).max())
    step_s = np.clip(np.diff(load.time_s, append=load.time_s[-1] + 1.0), 0.0, MAX_ROW_S)
    changed = np.r_[True, np.abs(np.diff(load.current_a)) > STEP_FRACTION * largest_a]
    since_s = load.time_s - load.time_s[np.maximum.accumulate(np.where(changed, np.arange(changed.size), 0))]
    weight = step_s / np.maximum(since_s + step_s, MIN_SINCE_STEP_S)
    weight /= weight.sum()
    resting = np.abs(load.current_a) < REST_FRACTION * largest_a
    ends = [end - 1 for first, end in true_runs(resting) if load.time_s[end - 1] - load.time_s[first] > LONG_REST_S]
    weight[ends] += 1.0 / max(len(ends), 1)
    last = np.zeros(weight.size, dtype=np.bool_)
    last[ends] = True
    return weight, last


def _clean_steps(load: CleanCapture) -> NDArray[np.bool_]:
    """Return a mask of the samples directly after clean current steps (see ``STEADY_FRACTION``)."""
    largest_a = float(np.abs(load.current_a).max())
    change_a = np.abs(np.diff(load.current_a, prepend=load.current_a[0]))
    step_s = np.diff(load.time_s, prepend=load.time_s[0])
    changes = np.flatnonzero(change_a > STEADY_FRACTION * largest_a)
    bounds_s = np.r_[load.time_s[0], load.time_s[changes], load.time_s[-1]]
    steady = (bounds_s[1:-1] - bounds_s[:-2] >= STEADY_S) & (bounds_s[2:] - bounds_s[1:-1] >= STEADY_S)
    clean = np.zeros(change_a.size, dtype=np.bool_)
    clean[changes[steady]] = True
    return np.asarray(clean & (change_a > STEP_FRACTION * largest_a) & (step_s <= MAX_STEP_S))
