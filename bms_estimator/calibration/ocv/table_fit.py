"""Fit of the OCV table: one smooth curve through points of several sources, with its error.

One linear Gaussian model over all points (a smoothing spline with random effects; Wahba 1990, Rasmussen and Williams
2006, chapter 2):

    v = f(SOC) + (T - 25 C) u(SOC) + c(T) w(SOC) + f'(SOC) (s + q (1 - SOC)) + d(SOC) + noise

f is the curve, a cubic spline with a prior of the curvature of real cells. u is dE/dT. c(T) w(SOC) is the error of
rests that were too short at low temperature: c is its std, ``Points.cold_v``. w is common to all sources and can hardly
be distinguished from u, so that the priors divide the observed difference between both. s and q are the errors of a
source's first SOC and of its capacity. d is the systematic error of a source. The priors of u, w, s, q and d have mean
0. The curve's standard deviation follows from the posterior covariance and is large in gaps between points.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline, PchipInterpolator
from scipy.optimize import lsq_linear

from bms_estimator.calibration.ocv.chen_mora_fit import Points, check_points, rms_v, with_ends
from bms_estimator.calibration.ocv.overpotential import linear_interpolation_matrix
from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell_sections import TableOcv

KNOTS: Floats = np.unique(
    np.r_[np.arange(0.0, 0.06, 0.015), np.arange(0.06, 0.25, 0.03), np.arange(0.25, 0.96, 0.045), 0.97, 0.985, 0.993, 1]
)
"""Knots of the spline in SOC. With more knots, the curve of a layered oxide reproduces the errors of the points."""
NODES: Floats = np.unique(
    np.round(np.r_[np.arange(0.0, 0.1, 0.01), np.arange(0.1, 0.96, 0.02), np.arange(0.96, 1.001, 0.01)], 4)
)
"""SOC nodes of the table."""
BEND_V = 2.0
"""Prior std of d2V/dSOC2 on flat parts of the curve, per ``CELL_V`` [V]."""
BEND_SOC = 0.12
"""SOC range over which the slope may change by 100 %. The slope divided by this range adds to the prior std of
d2V/dSOC2, because steep parts bend more."""
EMPTY_SLOPE_V = 60.0
"""Slope dV/dSOC that every curve may have at SOC 0, per ``CELL_V`` [V]."""
EMPTY_SOC = 0.02
"""SOC over which ``EMPTY_SLOPE_V`` decays by a factor of e."""
FIRST_SLOPE_V = 0.8
"""Slope dV/dSOC that the first iteration assumes per ``CELL_V`` [V]."""
BEND_LENGTH = 0.05
"""Correlation length of the curvature in SOC."""
MIN_SLOPE_V = 1e-3
"""Minimum slope dV/dSOC per ``CELL_V``, so that the curve is invertible [V]."""
CELL_V = 4.0
"""Cell voltage to which the constants above are scaled [V]."""
MIN_SPAN_K = 10.0
"""Minimum temperature difference between points that determine dE/dT [K]."""
ENTROPY_V_PER_K = 3.5e-4
"""Prior std of dE/dT per ``CELL_V`` [V/K]. Published entropy profiles have 0.1 to 0.5 mV/K."""
ENTROPY_NODES = np.array([0.0, 0.1, 0.25, 0.5, 0.75, 1.0])
"""SOC nodes of dE/dT."""
DEVIATION_NODES = np.array([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
"""SOC nodes of the systematic error of a source."""
INDEPENDENT_ERROR_FRACTION = 0.7
"""Independent error of each point, as a fraction of the systematic error of its source. It covers the part of the
systematic error that varies between the nodes."""
SOC_STD = 0.004
"""Prior std of a source's first SOC. Charges do not end at the same SOC."""
CAPACITY_STD = 0.01
"""Prior relative std of a source's capacity. Cells age."""
EMPTY_STD_V = 0.05
"""Std of the voltage at SOC 0 without a rest there, per ``CELL_V`` [V]."""
FULL_STD_V = 0.005
"""Std of the voltage at SOC 1 without a rest there, per ``CELL_V`` [V]."""
MAX_SLOPE_V = 2.0
"""Upper limit of the slope f' that converts an error of SOC to one of voltage, per ``CELL_V`` [V]. At the ends of the
curve the slope is too uncertain."""
STD_OF_MEDIAN = 1.48
"""Standard deviation of a normal distribution over the median of its magnitude. The median is robust against
outliers."""
ITERATIONS = 4
"""Number of iterations. Each uses the slope f' and the errors of the sources of the previous iteration."""


@dataclass(frozen=True)
class TableFit:
    """A smooth increasing table.

    Attributes:
        soc: Nodes from 0 to 1.
        ocv_v: Voltages at the nodes, increasing [V].
        error_v: Standard deviations of ``ocv_v`` [V].
        per_kelvin_v: dE/dT at the nodes [V/K]; None if the temperatures of the points do not determine it.
        residual_v: Shape (n,), points less curve [V].
        deviation_v: RMS of the systematic error of each source [V].
    """

    soc: Floats
    ocv_v: Floats
    error_v: Floats
    per_kelvin_v: Floats | None
    residual_v: Floats
    deviation_v: Floats

    def __call__(self, soc: Floats) -> Floats:
        """Return E_o(SOC) by PCHIP interpolation of the table [V]."""
        return np.asarray(PchipInterpolator(self.soc, self.ocv_v)(soc), dtype=np.float64)

    def error_at(self, soc: Floats) -> Floats:
        """Return the standard deviation of E_o(SOC) [V]."""
        return np.asarray(np.interp(soc, self.soc, self.error_v))

    def table(self, hysteresis_v: Floats | None = None, hysteresis_std_v: Floats | float = 0.0) -> TableOcv:
        """Return the ``[ocv]`` section of a cell file.

        Args:
            hysteresis_v: Hysteresis at the nodes [V]; None: unknown.
            hysteresis_std_v: Standard deviation of the hysteresis, which adds to the curve's error [V].
        """
        return TableOcv(
            form="table",
            soc=tuple(self.soc.tolist()),
            ocv_v=tuple(self.ocv_v.tolist()),
            error_v=tuple(np.hypot(self.error_v, hysteresis_std_v).tolist()),
            hysteresis_v=None if hysteresis_v is None else tuple(hysteresis_v.tolist()),
            per_kelvin_v=None if self.per_kelvin_v is None else tuple(self.per_kelvin_v.tolist()),
        )


@dataclass(frozen=True)
class _Model:
    """Rows of the linear model.

    The columns are the spline coefficients, the nodes of u and w if any, and for each source the nodes of d, s and q.

    Attributes:
        points: Rows of the points, not yet divided by their standard deviations.
        prior: Rows of the priors, divided by their standard deviations.
        splines: Number of spline coefficients.
        temperature_columns: Number of nodes of u and w; 0 if the temperatures of the points do not determine them.
    """

    points: Floats
    prior: Floats
    splines: int
    temperature_columns: int


def fit_table(points: Points) -> TableFit:
    """Fit a smooth increasing curve through points, with the systematic error of each source as a parameter.

    Raises:
        UserError: Too few points, or points that span too little SOC.
    """
    check_points(points)
    voltage_scale = float(np.median(points.ocv_v)) / CELL_V
    measured = points
    points = with_ends(points, EMPTY_STD_V * voltage_scale, FULL_STD_V * voltage_scale)
    sources = int(points.source.max()) + 1
    scatter_factor, systematic_factor = np.ones(sources), 1.0
    middles = _middles()
    empty_slope_v = voltage_scale * EMPTY_SLOPE_V * np.exp(-middles / EMPTY_SOC)
    middle_slope_v: Floats = np.full(middles.size, voltage_scale * FIRST_SLOPE_V)
    slope_v: Floats = np.zeros(points.soc.size)
    for _ in range(ITERATIONS):
        bend_rows = _bend_rows(voltage_scale * BEND_V + (middle_slope_v + empty_slope_v) / BEND_SOC)
        model = _model(points, slope_v, systematic_factor, bend_rows, voltage_scale)
        std_v = (
            np.hypot(points.std_v, INDEPENDENT_ERROR_FRACTION * points.systematic_std_v) * scatter_factor[points.source]
        )
        coefficients = _solve(model, points, std_v, voltage_scale)
        slope_v = np.clip(_spline(points.soc, 1) @ coefficients[: model.splines], 0.0, MAX_SLOPE_V * voltage_scale)
        middle_slope_v = _spline(middles, 1) @ coefficients[: model.splines]
        scatter_factor, systematic_factor = _error_factors(points, model, coefficients, systematic_factor)
    basis, entropy_basis = _spline(NODES), linear_interpolation_matrix(NODES, ENTROPY_NODES)
    rows = np.vstack([model.points / std_v[:, None], model.prior])
    covariance = np.linalg.pinv(rows.T @ rows, hermitian=True)[: model.splines, : model.splines]
    per_kelvin_at_nodes_v = coefficients[model.splines : model.splines + ENTROPY_NODES.size]
    # PCHIP and the inverse need strictly increasing values
    ocv_v = np.maximum.accumulate(basis @ coefficients[: model.splines] + 1e-9 * NODES)
    interpolate = PchipInterpolator(NODES, ocv_v)
    return TableFit(
        soc=NODES,
        ocv_v=ocv_v,
        error_v=np.sqrt(np.einsum("ij,jk,ik->i", basis, covariance, basis)),
        per_kelvin_v=entropy_basis @ per_kelvin_at_nodes_v if model.temperature_columns else None,
        residual_v=measured.ocv_v - interpolate(measured.soc),
        deviation_v=_deviations(points, model, coefficients),
    )


def _model(
    points: Points, slope_v: Floats, systematic_factor: float, bend_rows: Floats, voltage_scale: float
) -> _Model:
    """Return the rows of the model.

    Args:
        points: Points of all sources.
        slope_v: Slope f' of the curve at the points [V].
        systematic_factor: Factor on the declared systematic errors of all sources.
        bend_rows: Rows of the curvature prior.
        voltage_scale: Voltage of the cell relative to ``CELL_V``.
    """
    spline = _spline(points.soc)
    above_25_c = np.where(np.isfinite(points.temperature_c), points.temperature_c - REFERENCE_C, 0.0)
    columns, stds = [spline], [np.zeros(0)]
    if np.ptp(above_25_c) >= MIN_SPAN_K:
        by_soc = linear_interpolation_matrix(points.soc, ENTROPY_NODES)
        columns += [above_25_c[:, None] * by_soc, points.cold_v[:, None] * by_soc]
        stds += [np.full(ENTROPY_NODES.size, ENTROPY_V_PER_K * voltage_scale), np.ones(ENTROPY_NODES.size)]
    temperature_columns = sum(column_stds.size for column_stds in stds)
    for source in range(int(points.source.max()) + 1):
        of_source = (points.source == source)[:, None]
        deviation_columns_v = (
            systematic_factor
            * points.systematic_std_v[:, None]
            * linear_interpolation_matrix(points.soc, DEVIATION_NODES)
        )
        columns += [of_source * deviation_columns_v, of_source * _shifts(points.soc, slope_v)]
        stds += [np.ones(DEVIATION_NODES.size), np.array([SOC_STD, CAPACITY_STD])]
    weights = 1.0 / np.concatenate(stds)
    prior = np.zeros((bend_rows.shape[0] + weights.size, spline.shape[1] + weights.size))
    prior[: bend_rows.shape[0], : spline.shape[1]] = bend_rows
    prior[bend_rows.shape[0] :, spline.shape[1] :] = np.diag(weights)
    return _Model(np.hstack(columns), prior, spline.shape[1], temperature_columns)


def _shifts(soc: Floats, slope_v: Floats) -> Floats:
    """Return the derivatives of a voltage by s and by q. Shape (n, 2)."""
    return np.column_stack([slope_v, slope_v * (1.0 - soc)])


def _solve(model: _Model, points: Points, std_v: Floats, voltage_scale: float) -> Floats:
    """Solve for the model's coefficients with increasing spline coefficients, so that the spline increases.

    The errors of a single source cannot be distinguished from the curve and are therefore 0.
    """
    columns = model.splines + model.temperature_columns if points.source.max() == 0 else model.points.shape[1]
    rows = np.vstack([model.points / std_v[:, None], model.prior])[:, :columns]
    target = np.r_[points.ocv_v / std_v, np.zeros(model.prior.shape[0])]
    # the unknowns are the increments of the spline coefficients, so that bounds make the spline increase
    from_increments = np.tril(np.ones((model.splines, model.splines)))
    rows[:, : model.splines] = rows[:, : model.splines] @ from_increments
    lower_bounds = np.full(rows.shape[1], -np.inf)
    lower_bounds[1 : model.splines] = MIN_SLOPE_V * voltage_scale * np.diff(_coefficient_socs())
    orthogonal, triangle = np.linalg.qr(rows)
    increments = lsq_linear(triangle, orthogonal.T @ target, bounds=(lower_bounds, np.inf), method="bvls").x
    coefficients = np.zeros(model.points.shape[1])
    coefficients[: model.splines], coefficients[model.splines : columns] = (
        from_increments @ increments[: model.splines],
        increments[model.splines :],
    )
    return coefficients


def _error_factors(
    points: Points, model: _Model, coefficients: Floats, systematic_factor: float
) -> tuple[Floats, float]:
    """Return the factors by which the observed errors exceed the declared errors, at least 1.

    The first value has a factor for the scatter of each source; the second is the factor for the systematic errors of all
    sources.
    """
    normalized = (points.ocv_v - model.points @ coefficients) / np.hypot(
        points.std_v, INDEPENDENT_ERROR_FRACTION * points.systematic_std_v
    )
    sources = int(points.source.max()) + 1
    scatter = [
        max(1.0, STD_OF_MEDIAN * float(np.median(np.abs(normalized[points.source == k])))) for k in range(sources)
    ]
    deviations = coefficients[model.splines + model.temperature_columns :].reshape(sources, -1)[
        :, : DEVIATION_NODES.size
    ]
    return np.array(scatter), max(1.0, systematic_factor * float(np.sqrt(np.mean(deviations**2))))


def _deviations(points: Points, model: _Model, coefficients: Floats) -> Floats:
    """Return the RMS of the systematic error over the points of each source [V]."""
    systematic_v = (
        model.points[:, model.splines + model.temperature_columns :]
        @ coefficients[model.splines + model.temperature_columns :]
    )
    sources = int(points.source.max()) + 1
    return np.array([rms_v(systematic_v[points.source == k]) for k in range(sources)])


def _knots() -> Floats:
    return np.concatenate([np.zeros(3), KNOTS, np.ones(3)])


def _coefficient_socs() -> Floats:
    """Return the SOC at which each coefficient of the spline acts (Greville abscissae)."""
    knots = _knots()
    return np.asarray((knots[1:-3] + knots[2:-2] + knots[3:-1]) / 3.0)


def _spline(soc: Floats, derivative: int = 0) -> Floats:
    """Return the cubic B-splines, or their derivatives, at ``soc``. Shape (n, splines)."""
    knots = _knots()
    curves = BSpline(knots, np.eye(knots.size - 4), 3)
    return np.asarray(curves(np.clip(soc, 0.0, 1.0), nu=derivative), dtype=np.float64)


def _edges() -> Floats:
    """Return the edges of the intervals of the curvature prior, four for each knot interval."""
    edges: Floats = np.unique(np.concatenate([np.linspace(a, b, 5) for a, b in itertools.pairwise(KNOTS)]))
    return edges


def _middles() -> Floats:
    edges = _edges()
    return np.asarray(0.5 * (edges[1:] + edges[:-1]))


def _bend_rows(std_v: Floats) -> Floats:
    """Return the rows of the curvature prior with std ``std_v``, weighted by interval length over ``BEND_LENGTH``."""
    weight = np.sqrt(np.diff(_edges()) / BEND_LENGTH) / std_v
    return np.asarray(_spline(_middles(), 2) * weight[:, None])
