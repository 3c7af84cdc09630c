"""The ladder's resistances from captures: one regularised linear least squares, all resistances positive.

    v = E_o(SOC) + d(SOC) + (T - 25 C) u(SOC) - sum_k [w_k(SOC) g_w(T) + s_k(SOC) g_s(T)] x_k

with x_0 the current, x_k the current filtered by branch k, g the Arrhenius factors of the ladder's two parts, w, s
piecewise linear over SOC, d a correction of the open-circuit voltage (cubic spline) and u one of its growth with
temperature. The problem is linear in all unknowns. u also takes what a cold cell has not relaxed after half an hour:
left to the
slow branches, it makes the drop of a drive in the cold twice too large.

What a capture weighs does not depend on how many rows it has: a row weighs the time since the row before over the time
since the current last changed (a rest counts each decade of time alike), the ends of long rests as much again together,
and each capture ``WORTH`` rows. Large drops are known relative to their size only. Chosen, as all sizes here, by the
score of replays on drive cycles that the fit had not seen.
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

TYPICAL_V = 0.09
"""The scale of all resistances: what R_0 and the fast branches take at 1 C, per cell [V]."""
NOTHING = 1e-6
"""A resistance below this part of it is at its bound, 0."""
ROUGH = 0.1
"""Std of the difference of one resistance between two nodes of SOC, and of two branches next to each other, in that scale:
the resistance of a decade of time is about the same from a second to an hour."""
LOW_SOC, LOW_ROUGH = 0.15, 4.0
"""SOC below which both may be larger, and the factor."""
BEND_V, EASY_BEND_SOC, EASY_BEND = 10.0, 0.12, 20.0
"""Std of d2d/dSOC2 per cell [V]; below this SOC it is larger by the last factor."""
STRETCHES = 20
"""Number of SOC intervals in each of which the OCV has an error of its own."""
PER_KELVIN_V = 1e-3
"""Std of u, per cell [V/K]."""
KNOWN_PER_KELVIN_V = 5e-5
"""Std of dE/dT where it was measured [V/K]."""
HELD_V, HELD_PER_KELVIN_V = 1e-6, 1e-9
"""Std of OCV [V] and dE/dT [V/K] that are not to be fitted."""

WORTH = 30.0
"""Independent rows that a capture counts as."""
ERROR_V, ERROR_J = 4e-3, 22e3
"""Std of a row at 25 C, per cell [V], and how it grows in the cold [J/mol]."""
SOC_STD = 0.01
"""Std of the SOC gained over the whole range, growing with the root of the charge. At a knee far from the start a
cell deviates from its curve, and that voltage error is not a resistance."""
RELATIVE = 0.1
"""Std relative to the drop that ``TYPICAL_V`` makes of the largest current of the last half minute."""
STEPS_WORTH, STEP_V = 30.0, 1e-3
"""Weight in rows, and std per cell [V], of a capture's voltage jumps at clean current steps. They determine R_0 and
do not drift."""
STEADY, STEADY_S, STEP_S = 0.01, 5.0, 1.5
"""A step is clean if the current before and after it moves by at most this fraction of the largest current for this
long [s], and if it is sampled this closely [s]. With a changing current a delay between voltage and current
samples would give another R_0."""
COUNT_STD = 0.004
"""Relative std of the charge counted in a capture, and of the capacity at its temperature."""
STEP_SHARE = 0.1
"""A change of current by this part of the capture's largest begins a new stretch."""
MIN_S, MAX_S = 10.0, 30.0
"""Minimum of the time since that step, and maximum of the time since the row before [s]."""
LONG_REST_S, REST_SHARE = 500.0, 0.01
"""Rest of this length, below this part of the largest current."""
ROW_S = 0.5
"""Rows are at least so far apart [s]."""
LOWEST, HIGHEST = 0.02, 1.01
"""SOC of the rows that count."""


@dataclass(frozen=True)
class Moments:
    """Moments of one capture: X'WX and X'Wy of its rows, y less the given OCV, for any miscount.

    Attributes:
        information: X'WX, the miscount marginalised.
        right: X'Wy, the same.
        along: X'Wc, with c what a miscount of 1 would do to the voltage.
        own: c'Wc with the prior of the miscount.
        seen: c'Wy, the same.
    """

    information: Floats
    right: Floats
    along: Floats
    own: float
    seen: float

    def miscount(self, fit: "LadderFit") -> float:
        """Return the relative error of the charge count at which the fit's voltage matches the capture's."""
        return float((self.seen - self.along @ fit.coefficients) / self.own)


@dataclass(frozen=True)
class LadderFit:
    """The outcome.

    Attributes:
        correction: Coefficients of d, see ``correction_at``.
        per_kelvin_v: u at ``KELVIN_NODES`` [V/K].
        weak_ohm: Shape (RESISTANCES, SOC_NODES.size) [ohm].
        strong_ohm: Resistances with the strong temperature dependence [ohm].
        covariance: Covariance of weak and strong resistances in this order, each by rows; None of the bounds counted.
    """

    correction: Floats
    per_kelvin_v: Floats
    weak_ohm: Floats
    strong_ohm: Floats
    covariance: Floats

    @property
    def coefficients(self) -> Floats:
        """All that was sought, in the order of the columns."""
        parts = self.correction, self.per_kelvin_v, self.weak_ohm.ravel(), self.strong_ohm.ravel()
        return np.concatenate(parts)

    def branches(self, soc: float, first: int, end: int) -> tuple[float, float]:
        """Sum of resistances ``first`` to before ``end`` at ``soc`` and 25 C, and its standard error [ohm]."""
        place = linear_interpolation_matrix(np.array([soc]), SOC_NODES)[0]
        row = np.zeros((2, RESISTANCES, SOC_NODES.size))
        row[:, first:end] = place
        ohm = float((row[0] * (self.weak_ohm + self.strong_ohm)).sum())
        return ohm, float(np.sqrt(row.ravel() @ self.covariance @ row.ravel()))


@dataclass(frozen=True)
class Prior:
    """Prior of the fit.

    Attributes:
        ocv_error_v: Shape (201,), std of the OCV at evenly spaced SOC [V]; tiny: held.
        per_kelvin_v: Std of u [V/K]; tiny: held.
        scale_ohm: Scale of the resistances [ohm].
        series: Cells in series.
        shapes: Shape (2, RESISTANCES, SOC_NODES.size), how the weak and the strong part of each resistance usually go along SOC.
        weak_share: Shape (RESISTANCES, SOC_NODES.size), of each resistance; None: only the captures count.
    """

    ocv_error_v: Floats
    per_kelvin_v: float
    scale_ohm: float
    series: int
    shapes: Floats
    weak_share: Floats | None


EVEN = np.linspace(0.0, 1.0, 201)
SPLINES = KNOTS.size + 2
FREE = SPLINES + KELVIN_NODES.size
"""Unknowns that may be negative; those behind are resistances."""
PART = RESISTANCES * SOC_NODES.size


def correction_at(soc: Floats) -> Floats:
    """Cubic B-splines of d at ``soc``. Shape (n, SPLINES)."""
    knots = np.r_[np.zeros(3), KNOTS, np.ones(3)]
    return np.asarray(BSpline.design_matrix(np.clip(soc, 0.0, 1.0), knots, 3).toarray())


def moments(
    load: CleanCapture,
    soc: Floats,
    given_v: Floats,
    slope_v: Floats,
    temperature_c: Floats,
    scale_ohm: float,
    series: int,
    miscount: float,
) -> Moments:
    """Accumulate the moments of the regression over ``load``.

    Args:
        load: Load that starts at rest.
        soc: Shape (n,), counted, less the miscount.
        given_v: Shape (n,), the given OCV at SOC and temperature [V].
        slope_v: Shape (n,), its slope dE_o/dSOC [V].
        temperature_c: Shape (n,) [C].
        scale_ohm: Scale of the resistances [ohm].
        series: Cells in series.
        miscount: What the count was taken to be off, relative.

    Raises:
        UserError: No sample is within the SOCs that count.
    """
    currents = np.column_stack([load.current_a, branch_currents(load.time_s, load.current_a)])
    weight, last = _weights(load)
    inside = (soc > LOWEST) & (soc < HIGHEST)
    kept = (_apart(load.time_s) | last) & inside
    if not kept.any():
        raise UserError(
            f"{load.name}: no sample between SOC {LOWEST:g} and {HIGHEST:g} [--soc]: nothing tells of resistances"
        )
    load_a = np.abs(currents[:, :4]).max(axis=1)
    std_v = arrhenius(ERROR_J, temperature_c) * np.hypot(ERROR_V * series, RELATIVE * scale_ohm * load_a)
    std_v = np.hypot(std_v, SOC_STD * np.sqrt(np.abs(soc - soc[0])) * slope_v)
    weight = np.where(kept, weight, 0.0)
    root = (np.sqrt(WORTH * weight / weight.sum()) / std_v)[kept, None]
    first_root = root[:, 0]
    left_v = load.voltage_v - given_v
    rows = _rows(soc[kept], temperature_c[kept], currents[kept]) * root
    target = left_v[kept] * root[:, 0]
    after = _clean_steps(load) & inside
    before = np.r_[after[1:], False]
    if after.any():
        change_a = np.abs(load.current_a[after] - load.current_a[before])
        std_v = np.hypot(STEP_V * series, RELATIVE * scale_ohm * change_a) * arrhenius(ERROR_J, temperature_c[after])
        root = (np.sqrt(STEPS_WORTH / after.sum()) / std_v)[:, None]
        jump = _rows(soc[after], temperature_c[after], currents[after])
        jump -= _rows(soc[before], temperature_c[before], currents[before])
        rows = np.vstack([rows, jump * root])
        target = np.r_[target, (left_v[after] - left_v[before]) * root[:, 0]]
    counted = np.zeros(target.size)  # what the charge, wrong by its own size, would do
    counted[: kept.sum()] = slope_v[kept] * (soc[kept] - soc[0]) * first_root
    along, own = rows.T @ counted, float(counted @ counted + 1.0 / COUNT_STD**2)
    seen = float(counted @ target - miscount / COUNT_STD**2)
    return Moments(rows.T @ rows - np.outer(along, along) / own, rows.T @ target - along * seen / own, along, own, seen)


def _rows(soc: Floats, temperature_c: Floats, currents: Floats) -> Floats:
    """Return the unweighted rows of the model. Shape (n, FREE + 2 PART)."""
    places = (currents[:, :, None] * linear_interpolation_matrix(soc, SOC_NODES)[:, None, :]).reshape(soc.size, -1)
    return np.hstack(
        [
            correction_at(soc),
            linear_interpolation_matrix(soc, KELVIN_NODES) * (temperature_c - REFERENCE_C)[:, None],
            -places * arrhenius(WEAK_J, temperature_c)[:, None],
            -places * arrhenius(STRONG_J, temperature_c)[:, None],
        ]
    )


def fit_ladder(captures: list[Moments], prior: Prior) -> LadderFit:
    """Fit the resistances to all ``captures`` by least squares."""
    information = _prior_information(prior) + sum(one.information for one in captures)
    right = np.asarray(sum(one.right for one in captures))
    to_all = np.eye(FREE + 2 * PART)
    if prior.weak_share is not None:
        share = prior.weak_share.ravel()
        to_all = np.zeros((FREE + 2 * PART, FREE + PART))
        to_all[:FREE, :FREE] = np.eye(FREE)
        to_all[FREE : FREE + PART, FREE:], to_all[FREE + PART :, FREE:] = np.diag(share), np.diag(1.0 - share)
    information = to_all.T @ information @ to_all
    root = np.linalg.cholesky(information)
    lowest = np.r_[np.full(FREE, -np.inf), np.zeros(root.shape[0] - FREE)]
    target = np.linalg.solve(root, to_all.T @ right)
    found = to_all @ lsq_linear(root.T, target, bounds=(lowest, np.inf), tol=1e-12, max_iter=500).x
    covariance = to_all @ np.linalg.inv(information) @ to_all.T
    ohm = np.where(found[FREE:] > NOTHING * prior.scale_ohm, found[FREE:], 0.0)
    weak, strong = ohm.reshape(2, RESISTANCES, SOC_NODES.size)
    return LadderFit(found[:SPLINES], found[SPLINES:FREE], weak, strong, covariance[FREE:, FREE:])


def _prior_information(prior: Prior) -> Floats:
    table = np.zeros((FREE + 2 * PART, FREE + 2 * PART))
    spline = correction_at(EVEN)
    near = spline / prior.ocv_error_v[:, None] * np.sqrt(STRETCHES / EVEN.size)
    bend = np.diff(spline, 2, axis=0) * (EVEN.size - 1) ** 2 / (BEND_V * prior.series)
    bend[EVEN[1:-1] < EASY_BEND_SOC] /= EASY_BEND
    table[:SPLINES, :SPLINES] = near.T @ near + bend.T @ bend / STRETCHES
    table[SPLINES:FREE, SPLINES:FREE] = np.eye(KELVIN_NODES.size) / prior.per_kelvin_v**2
    for first, shape in zip((FREE, FREE + PART), prior.shapes, strict=True):
        rough = _rough_rows() / (ROUGH * prior.scale_ohm) / shape.ravel()
        part = rough.T @ rough + 1e-6 * np.eye(PART) / prior.scale_ohm**2
        table[first : first + PART, first : first + PART] = part
    return table


def _rough_rows() -> Floats:
    """Differences of one part's resistances along SOC, and between branches next to each other."""
    one = np.eye(PART).reshape(RESISTANCES, SOC_NODES.size, PART)
    wide = np.where(SOC_NODES < LOW_SOC, LOW_ROUGH, 1.0)
    along = (one[:, 1:] - one[:, :-1]) / wide[None, :-1, None]
    across = (one[2:] - one[1:-1]) / wide[None, :, None]
    return np.vstack([along.reshape(-1, PART), across.reshape(-1, PART)])


def _apart(time_s: Floats) -> NDArray[np.bool_]:
    """Rows that are ``ROW_S`` apart at least."""
    slot = np.floor(time_s / ROW_S)
    return np.asarray(np.r_[True, np.diff(slot) > 0.0], dtype=np.bool_)


def _weights(load: CleanCapture) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the weight of each row, up to a factor, and which rows are the last of a long rest."""
    largest_a = float(np.abs(load.current_a).max())
    step_s = np.clip(np.diff(load.time_s, append=load.time_s[-1] + 1.0), 0.0, MAX_S)
    changed = np.r_[True, np.abs(np.diff(load.current_a)) > STEP_SHARE * largest_a]
    since_s = load.time_s - load.time_s[np.maximum.accumulate(np.where(changed, np.arange(changed.size), 0))]
    weight = step_s / np.maximum(since_s + step_s, MIN_S)
    weight /= weight.sum()
    resting = np.abs(load.current_a) < REST_SHARE * largest_a
    ends = [end - 1 for first, end in true_runs(resting) if load.time_s[end - 1] - load.time_s[first] > LONG_REST_S]
    weight[ends] += 1.0 / max(len(ends), 1)
    last = np.zeros(weight.size, dtype=np.bool_)
    last[ends] = True
    return weight, last


def _clean_steps(load: CleanCapture) -> NDArray[np.bool_]:
    """Return the samples right after a current step that is held before and after it."""
    largest_a = float(np.abs(load.current_a).max())
    change_a = np.abs(np.diff(load.current_a, prepend=load.current_a[0]))
    step_s = np.diff(load.time_s, prepend=load.time_s[0])
    changes = np.flatnonzero(change_a > STEADY * largest_a)
    bounds_s = np.r_[load.time_s[0], load.time_s[changes], load.time_s[-1]]
    steady = (bounds_s[1:-1] - bounds_s[:-2] >= STEADY_S) & (bounds_s[2:] - bounds_s[1:-1] >= STEADY_S)
    clean = np.zeros(change_a.size, dtype=np.bool_)
    clean[changes[steady]] = True
    return np.asarray(clean & (change_a > STEP_SHARE * largest_a) & (step_s <= STEP_S))
