"""Fit of the pack's model to its history, from several starts, as a mixture of local minima.

Large residuals after a gap show an exchange of the pack. The std of a row covers the differences between cell file and cell.
The RMS residuals of one pack are therefore only 0.1 to 0.4 std (real captures of three cells with generic files). With another
pack after the gap, no common fit explains the rows of both packs, and the RMS residual after the gap is 0.5 to 2.4 std after
20 min to an hour of use.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.accumulators.history import HISTORY_ROW
from bms_estimator.kernels.kalman_filter.records import NODES
from bms_estimator.kernels.pack_voltage import CURVE_NODES, SHAPE_NODES
from bms_estimator.model.arrays import Floats
from bms_estimator.model.input_faults import InputFault
from bms_estimator.model.payloads.health import SocBound
from bms_estimator.pack_model.cell_curves import SOC_GRID, CellCurves, NodePosition
from bms_estimator.pack_model.equations import Equations, Residuals
from bms_estimator.pack_model.prediction import Reference
from bms_estimator.pack_model.solve import Minimum, minimize, single_threaded
from bms_estimator.pack_model.unknowns import SCALES

MAX_RMS_RATIO = 3.0
"""Ratio of the RMS residuals after and before the last gap above which the pack was exchanged."""
MIN_RESIDUAL = 0.15
"""Minimum of the RMS residual before the gap in the ratio [std]. A fit of a small number of rows leaves too small residuals."""
MIN_ROWS_AFTER, MIN_ROWS_BEFORE = 5, 50
"""Minimum numbers of rows with a voltage after and before the gap."""
MARGIN_K = 5.0
"""Maximum distance of the mean temperature after the gap from the temperature range before it [K]. At a larger distance the
error of the file's temperature dependence dominates the residuals."""


def is_exchanged(rows: NDArray[np.void], residuals: Residuals) -> bool:
    """Return True if another pack was measured after the last gap.

    Args:
        rows: Shape (n,), dtype HISTORY_ROW, in order of time.
        residuals: Residuals of a fit of all rows.
    """
    has_voltage = rows["duration_s"] > 0.0
    after = has_voltage & (rows["segment"] == rows["segment"][-1])
    before = has_voltage & ~after
    if after.sum() < MIN_ROWS_AFTER or before.sum() < MIN_ROWS_BEFORE:
        return False
    temperature_c = rows["temperature_c"]
    mean_c = temperature_c[after].mean()
    if not temperature_c[before].min() - MARGIN_K < mean_c < temperature_c[before].max() + MARGIN_K:
        return False
    return rms(residuals.voltage[after]) > MAX_RMS_RATIO * max(rms(residuals.voltage[before]), MIN_RESIDUAL)


def rms(values: Floats) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


STARTS = ((0.0, 0.0), (0.08, 0.0), (-0.08, 0.0), (0.16, 0.0), (-0.16, 0.0), (0.0, 0.08), (0.0, -0.08))
"""Starts of the minimization: shift of all SOCs, and ln of the true over the declared capacity. The cost of a flat curve has
several minima over the SOC."""
MAX_SHIFT_SOC, MAX_SHIFT_STD = 0.02, 4.0
"""Maximum shift of a start from a precise previous fit: an SOC, plus a multiple of the std of the fitted SOC."""
LIKELIHOOD_EXPONENT = 0.5
"""Exponent of the likelihood in the weights of minima. It is below 1, because errors of different passes are not quite
independent."""
NODE_SOC = np.linspace(0.0, 1.0, NODES)
"""SOCs of the filter's OCV nodes."""
SOC, LN_Q, OFFSET, LN_R, CURVE = 0, 1, 2, slice(3, 6), slice(6, 6 + NODES)
"""Positions in the vector of results, ``PackFit.mean``."""


@dataclass(frozen=True)
class PackFit:
    """Result of a fit: the state of the pack at the last row, and its curves. Voltages and resistances are of one cell."""

    elapsed_s: float
    """Time of the history's last row [s]."""
    segment: float
    """Segment of the last row."""
    charge_as: float
    """``charge_as`` of the last row [A s]."""
    mean: Floats
    """Mean of the results: SOC at the last row, ln of the true over the declared capacity, current offset as a C-rate, ln of
    three factors on the resistances, and the OCV's correction at ``NODES`` SOCs [V]."""
    covariance: Floats
    """Covariance of ``mean``."""
    curve_v: Floats
    """Correction of the OCV at ``GRID`` SOCs [V]."""
    ln_r: Floats
    """ln of the factor on the series resistance, fast and slow RC pairs at ``GRID`` SOCs, shape (GRID, 3)."""
    hysteresis: float
    """Factor on the cell file's hysteresis."""
    row_elapsed_s: Floats
    """Time of each row [s]."""
    row_soc: Floats
    """SOC of each row."""
    cost: float
    """Cost of the best minimum."""
    curves: tuple[Floats, ...]
    """Nodes of the OCV's error and of the direction-dependent error at each minimum, the best first. The next fit starts there."""
    first_segment: float = 0.0
    """Number of the first fitted segment. Earlier segments were measured on another pack."""
    is_exchanged: bool = False
    """True: the pack was exchanged in the gap before the last segment, so that only this segment is fitted."""
    faults: InputFault = field(default=InputFault(0))
    """Faults that the fitted values show."""
    soc_bound: SocBound | None = None
    """Lower bound of the std of the SOC in the use of the rows, which is not saved; None: not computed."""


FINITE_FIELDS = tuple(
    name for name in HISTORY_ROW.names or () if name not in {"gap_s", "reference_soc", "reference_std"}
)
"""Fields of a row that must be finite. A gap may be infinite, and a row without a known SOC has a NaN."""


class FitError(ValueError):
    """Error of a history without a finite fit, for example because a row is not finite."""


@single_threaded()
def fit(cell: CellCurves, rows: NDArray[np.void], previous: PackFit | None = None) -> PackFit:
    """Fit the pack's model. If the last gap hides an exchange of the pack, fit only the rows after it.

    Args:
        cell: Curves of the cell file.
        rows: Shape (n,), dtype HISTORY_ROW, in order of time.
        previous: Previous fit. Its best minima are additional starts.

    Raises:
        FitError: ``rows`` is empty, or the fit is not finite.
    """
    _require_finite(rows)
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # a result that is not finite raises an error below
            rows = rows_of_this_pack(rows, previous)
            result = _fit_at_reference(cell, rows, previous)
            if result.is_exchanged:
                last = rows[rows["segment"] == rows["segment"][-1]]
                result = replace(_fit_at_reference(cell, last, None), is_exchanged=True)
    except np.linalg.LinAlgError as error:
        raise FitError(f"the equations of {rows.size} history rows have no solution: {error}") from error
    if not (np.isfinite(result.mean).all() and np.isfinite(result.covariance).all()):
        raise FitError(f"the fit of {rows.size} history rows is not finite")
    return result


def rows_of_this_pack(rows: NDArray[np.void], previous: PackFit | None) -> NDArray[np.void]:
    """Return the rows without those before an exchange of the pack that the previous fit found."""
    return rows if previous is None else rows[rows["segment"] >= previous.first_segment]


def _require_finite(rows: NDArray[np.void]) -> None:
    """Raise a FitError if there are no rows, or if a row is not finite."""
    if rows.size == 0:
        raise FitError("the history has no rows: record some before the first fit")
    for name in FINITE_FIELDS:
        finite = np.isfinite(rows[name].reshape(rows.size, -1)).all(axis=1)
        if not finite.all():
            raise FitError(f"history row {np.argmin(finite)} of {rows.size}: {name} is not finite: remove the row")


def reference_of(previous: PackFit, rows: NDArray[np.void]) -> Reference:
    """Return SOC and resistances of the previous fit. Rows after that fit have the filter's SOC, which is based on it."""
    is_fitted = rows["elapsed_s"] <= previous.elapsed_s
    soc = np.where(is_fitted, np.interp(rows["elapsed_s"], previous.row_elapsed_s, previous.row_soc), rows["soc"])
    return Reference(soc, previous.mean[LN_R])


def _fit_at_reference(cell: CellCurves, rows: NDArray[np.void], previous: PackFit | None) -> PackFit:
    """Fit the rows. The std of each row is computed at the previous fit; without one, at a preliminary fit."""
    if previous is None:
        previous = _minimize_from_all_starts(cell, rows, Reference(rows["soc"], np.zeros(SCALES)), None)
    return _minimize_from_all_starts(cell, rows, reference_of(previous, rows), previous)


def _minimize_from_all_starts(
    cell: CellCurves, rows: NDArray[np.void], reference: Reference, previous: PackFit | None
) -> PackFit:
    """Return the mixture of the different minima that are reached from all starts."""
    equations = Equations(cell, rows, reference)
    minima = distinct_minima(equations, starts(equations, previous))
    residuals = equations.residuals(minima[0].x)
    if equations.weaken_misfits(residuals):
        minima = distinct_minima(equations, [m.x for m in minima])
    return replace(mixture(equations, minima), is_exchanged=is_exchanged(rows, residuals))


def distinct_minima(equations: Equations, from_starts: list[Floats]) -> list[Minimum]:
    """Return the different minima that are reached from the starts, the best first."""
    minima: list[Minimum] = []
    for start in from_starts:
        minimum = minimize(equations, start, minima)
        if minimum is not None:
            minima.append(minimum)
    return sorted(minima, key=lambda minimum: minimum.cost)


def starts(equations: Equations, previous: PackFit | None) -> list[Floats]:
    """Return the starts of the minimization: those near the previous fit, then those around the filter's SOC.

    A shift that exceeds the uncertainty of the previous fit is omitted, unless the age of the history has doubled or a long
    gap may hide a charge.
    """
    rows, results, max_shift = equations.rows, [], math.inf
    if previous is not None:
        results = starts_near(equations, previous)
        gap_s = rows["gap_s"][rows["segment"] > previous.segment].max(initial=0.0)
        # the binary exponent grows by 1 when the age doubles
        has_doubled = math.frexp(rows["elapsed_s"][-1])[1] != math.frexp(previous.elapsed_s)[1]
        if not has_doubled and gap_s < equations.model.cell.event_s:
            max_shift = MAX_SHIFT_SOC + MAX_SHIFT_STD * math.sqrt(previous.covariance[SOC, SOC])
    for shift, ln_q in STARTS:
        if abs(shift) > max_shift:
            continue
        x = equations.prior.mean.copy()
        x[equations.unknowns.soc] = filter_soc(equations, ln_q) + shift
        x[equations.unknowns.ln_q] = ln_q
        results.append(x)
    return results


def filter_soc(equations: Equations, ln_q: float) -> Floats:
    """Return the SOC at the start of each interval, from the filter's SOC at its end and the charge counted in it."""
    intervals = equations.intervals
    drawn_soc = intervals.drawn_soc[intervals.ends] * math.exp(-ln_q)
    return np.asarray(equations.rows["soc"][intervals.ends] + drawn_soc)


def starts_near(equations: Equations, previous: PackFit) -> list[Floats]:
    """Return the starts at the two best minima of the previous fit, the best last."""
    return [start_near(equations, previous, curves) for curves in previous.curves[1::-1]]


def start_near(equations: Equations, previous: PackFit, curves: Floats) -> Floats:
    """Return a start near the previous fit.

    Args:
        equations: Equations of the present history.
        previous: Previous fit.
        curves: One of ``previous.curves``.
    """
    u = equations.unknowns
    x = equations.prior.mean.copy()
    x[u.curve.start :] = curves
    x[u.ln_q], x[u.offset] = previous.mean[LN_Q], previous.mean[OFFSET]
    x[u.ln_r] = previous.mean[LN_R]
    x[u.soc] = start_soc_near(equations, previous)
    return x


def start_soc_near(equations: Equations, previous: PackFit) -> Floats:
    """Return a first estimate of the SOC at the start of each interval.

    Up to its last row, the previous fit supplies the SOC. The start of a later interval has the SOC of the interval before
    plus the charge counted since then, or, after a gap, the filter's SOC.
    """
    intervals, links, ln_q = equations.intervals, equations.links, previous.mean[LN_Q]
    start_s = equations.rows["elapsed_s"][intervals.starts]
    soc: Floats = np.interp(start_s, previous.row_elapsed_s, previous.row_soc)
    after_gap = filter_soc(equations, ln_q)
    drawn_soc = dict(zip(links.interval.tolist(), links.drawn_soc * math.exp(-ln_q), strict=True))
    for k in np.flatnonzero(start_s > previous.elapsed_s).tolist():
        soc[k] = after_gap[k] if intervals.is_new_segment[k] else soc[k - 1] - drawn_soc[k]
    return soc


def mixture(equations: Equations, minima: list[Minimum]) -> PackFit:
    """Return mean and covariance of the mixture of minima, of which the best is the first."""
    weights = mixture_weights(minima)
    mean, covariance = mixture_moments(weights, [_results(equations, m) for m in minima])
    u, rows = equations.unknowns, equations.rows
    last = rows[-1]
    x = weights @ np.array([m.x for m in minima])
    shape = NodePosition.of(SOC_GRID, SHAPE_NODES).interpolate(x[u.shape])
    return PackFit(
        elapsed_s=float(last["elapsed_s"]),
        segment=float(last["segment"]),
        charge_as=float(last["charge_as"]),
        mean=mean,
        covariance=covariance,
        curve_v=NodePosition.of(SOC_GRID, CURVE_NODES).interpolate(x[u.curve]),
        ln_r=shape[:, None] + x[u.ln_r],
        hysteresis=float(max(x[u.hysteresis].sum(), 0.0)),
        row_elapsed_s=rows["elapsed_s"].copy(),
        row_soc=weights @ np.array([equations.model.soc(m.x) for m in minima]),
        cost=minima[0].cost,
        curves=tuple(m.x[u.curve.start :] for m in minima),
        first_segment=float(rows["segment"][0]),
        faults=equations.prior.faults(u, x),
    )


def mixture_weights(minima: list[Minimum]) -> Floats:
    """Return the weights of minima by their cost.

    They contain no determinants of covariances, which would favor a larger capacity.
    """
    weights: Floats = np.exp(-0.5 * LIKELIHOOD_EXPONENT * (np.array([m.cost for m in minima]) - minima[0].cost))
    return np.asarray(weights / weights.sum())


def mixture_moments(weights: Floats, moments: list[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
    """Return mean and covariance of a mixture.

    Args:
        weights: Shape (n,), with sum 1.
        moments: Mean and covariance of each of the n parts.
    """
    means = np.array([mean for mean, _ in moments])
    mean = weights @ means
    covariance: Floats = sum(
        w * (cov + np.outer(part - mean, part - mean))
        for w, part, (_, cov) in zip(weights, means, moments, strict=True)
    )
    return mean, 0.5 * (covariance + covariance.T)  # symmetric to the last bit


def _results(equations: Equations, minimum: Minimum) -> tuple[Floats, Floats]:
    """Return mean and covariance of the results at one minimum. The results are linear functions of the unknowns."""
    u, x, model = equations.unknowns, minimum.x, equations.model
    derivatives = np.zeros((CURVE.stop, u.size))
    columns, values = model.soc_derivatives(x)
    derivatives[SOC, columns[-1]] = values[-1]
    derivatives[LN_Q, u.ln_q.stop - 1] = 1.0
    derivatives[OFFSET, u.offset.stop - 1] = 1.0
    derivatives[LN_R, u.ln_r] = np.eye(SCALES)
    position, nodes = NodePosition.of(NODE_SOC, CURVE_NODES), np.arange(CURVE.start, CURVE.stop)
    for at, weight in zip((position.below, position.below + 1), position.weights, strict=True):
        derivatives[nodes, u.curve.start + at] = weight
    mean = derivatives @ x
    mean[SOC] = model.soc(x)[-1]
    return mean, minimum.covariance_of(derivatives)
