"""Derivatives of the predicted voltages, and the minimization of the cost."""

import numpy as np
import pytest

from bms_estimator.kernels.accumulators.history import ROW_SOC
from bms_estimator.kernels.least_squares import backward_substitution, forward_substitution
from bms_estimator.pack_model.equations import FITTED_RMS, TOLERATED_EXCESS_SOC, Equations
from bms_estimator.pack_model.solve import cholesky, minimize
from tests.pack_model.histories import (
    Truth,
    cell_curves,
    equations_of,
    measured_rows,
    random_unknowns,
    reference_row,
    unknowns_of,
    with_voltages,
)

LINEAR = ("hysteresis", "start_hysteresis", "start_load", "entropy", "curve", "direction")
"""Kinds of unknowns in which the voltage is linear."""
EXPONENTIAL = ("ln_r", "shape", "arrhenius", "aging")
"""Kinds of unknowns that scale the resistances."""


@pytest.fixture(scope="module")
def equations() -> Equations:
    cell = cell_curves()
    rows = with_voltages(cell, measured_rows(cell), Truth())
    return equations_of(cell, np.concatenate([rows, reference_row(rows, 0.85, 0.01)]))


def analytical(equations: Equations, x: np.ndarray) -> np.ndarray:
    """Return the derivatives of all voltages by all unknowns, shape (n, unknowns)."""
    model = equations.model
    columns, values = model.derivatives(x, model.predict(x), use_file_slope=False)
    jacobian = np.zeros((columns.shape[0], equations.unknowns.size))
    np.add.at(jacobian, (np.arange(columns.shape[0])[:, None], columns), values)
    return jacobian


def numerical(equations: Equations, x: np.ndarray, j: int, step: float) -> np.ndarray:
    """Return the central difference of all voltages by unknown ``j``."""
    e = np.zeros(x.size)
    e[j] = step
    predict = equations.model.predict
    return (predict(x + e).voltage_v - predict(x - e).voltage_v) / (2.0 * step)


@pytest.mark.parametrize(
    ("kind", "step"), [*((kind, 1e-3) for kind in LINEAR), *((kind, 1e-5) for kind in EXPONENTIAL)]
)
def test_derivatives_by_unknowns_that_do_not_move_the_soc(equations: Equations, kind: str, step: float) -> None:
    x = random_unknowns(equations)
    jacobian, part = analytical(equations, x), getattr(equations.unknowns, kind)
    for j in range(part.start, part.stop):
        np.testing.assert_allclose(jacobian[:, j], numerical(equations, x, j, step), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("shift", [-0.25, 0.0, 0.15])
def test_derivative_by_soc_is_the_secant_over_the_soc_range_of_a_row(equations: Equations, shift: float) -> None:
    """The shifts move rows beyond SOC 0 and 1, where the fitted curves are constant."""
    x = random_unknowns(equations)
    x[equations.unknowns.soc] += shift
    jacobian, u = analytical(equations, x), equations.unknowns
    for j in range(u.soc.start, u.soc.stop):
        np.testing.assert_allclose(jacobian[:, j], numerical(equations, x, j, ROW_SOC / 2), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", ["offset", "ln_q"])
def test_derivatives_by_offset_and_capacity(equations: Equations, kind: str) -> None:
    """They contain the secant over SOC, so that single rows deviate from the derivative at a point."""
    x = random_unknowns(equations)
    x[equations.unknowns.curve] = x[equations.unknowns.direction] = 0.0
    jacobian, part = analytical(equations, x), getattr(equations.unknowns, kind)
    for j in range(part.start, part.stop):
        by_difference = numerical(equations, x, j, 1e-4)
        assert np.linalg.norm(jacobian[:, j] - by_difference) < 0.05 * np.linalg.norm(by_difference)


def test_gradient_of_the_cost(equations: Equations) -> None:
    """b is half of the negative gradient, with rows beyond the tolerated SOC, outliers and a known SOC.

    SOC, offset and capacity are left out, because their derivatives are secants.
    """
    x = random_unknowns(equations)
    x[equations.unknowns.soc] += 0.15
    r = equations.residuals(x)
    assert np.any(r.soc_excess > 0.0)
    assert np.any(np.abs(r.voltage) > 3.0)
    b = equations.normal_equations(r).b
    u = equations.unknowns
    for kind in ("full", *LINEAR, *EXPONENTIAL):
        part = getattr(u, kind)
        for j in range(part.start, part.stop):
            e = np.zeros(x.size)
            e[j] = 1e-6
            gradient = (equations.residuals(x + e).cost - equations.residuals(x - e).cost) / 2e-6
            assert -2.0 * b[j] == pytest.approx(gradient, rel=1e-3, abs=1e-3 * np.abs(b[part]).max() + 1e-3)


def test_cost_of_a_soc_beyond_its_range_decreases_along_the_step(equations: Equations) -> None:
    x = unknowns_of(equations, Truth(soc=1.0 + TOLERATED_EXCESS_SOC + 0.07))
    r = equations.residuals(x)
    normal = equations.normal_equations(r)
    step = np.linalg.solve(np.tril(normal.a) + np.tril(normal.a, -1).T, normal.b)
    assert equations.residuals(x + 0.1 * step).cost < r.cost


@pytest.mark.parametrize("shift", [0.0, 0.08, -0.08, 0.15])
def test_minimum_is_below_its_start_and_its_neighbors(equations: Equations, shift: float) -> None:
    start = unknowns_of(equations, Truth(ln_r=(0.3, 0.3, 0.3)))
    start[equations.unknowns.soc] += shift
    minimum = minimize(equations, start)
    assert minimum is not None
    assert minimum.cost < equations.residuals(start).cost
    variances, vectors = np.linalg.eigh(minimum.covariance_of(np.eye(start.size)))
    for variance, vector in zip(variances[-20:], vectors.T[-20:], strict=True):
        for sign in (-1.0, 1.0):
            neighbor = minimum.x + sign * np.sqrt(variance) * vector
            assert equations.residuals(neighbor).cost > minimum.cost


def test_a_known_minimum_is_not_found_again(equations: Equations) -> None:
    start = unknowns_of(equations, Truth(ln_r=(0.3, 0.3, 0.3)))
    minimum = minimize(equations, start)
    assert minimum is not None
    assert minimize(equations, start, [minimum]) is None


def test_normal_equations_sum_the_products_of_all_derivatives(equations: Equations) -> None:
    """The sum has the prior, the voltages and the known SOC. No SOC is beyond its range."""
    r = equations.residuals(unknowns_of(equations, Truth()))
    x, p, u = r.x, r.prediction, equations.unknowns
    columns, values = equations.model.derivatives(x, p, use_file_slope=False)
    known, soc_values = equations.known_rows, equations.model.soc_derivatives(x)[1]
    parts = [(columns, equations.weight[:, None] * values), (r.links.columns, r.links.values)]
    at = np.column_stack([equations.model.soc_derivatives(x)[0][known], np.full(known.size, u.full.start)])
    parts.append((at, np.column_stack([soc_values[known], equations.is_full]) / equations.known_std[:, None]))
    expected = equations.prior.precision.copy()
    for at, derivatives in parts:
        jacobian = np.zeros((at.shape[0], u.size))
        np.add.at(jacobian, (np.arange(at.shape[0])[:, None], at), derivatives)
        expected += jacobian.T @ jacobian
    a = np.tril(equations.normal_equations(r).a)
    np.testing.assert_allclose(a, np.tril(expected), rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_triangular_solutions() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(40, 60))
    a, b = root @ root.T, rng.normal(size=40)
    lower = np.linalg.cholesky(a)
    x = backward_substitution(lower, forward_substitution(lower, b))
    np.testing.assert_allclose(a @ x, b, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("segments", [1, 4])
def test_cholesky_factor_of_sparse_columns(segments: int) -> None:
    """The unknowns of one segment are the first. They are independent of the unknowns of other segments."""
    cell = cell_curves()
    parts = [
        with_voltages(cell, measured_rows(cell, days=1, segment=k, gap_s=7200.0), Truth()) for k in range(segments)
    ]
    for k, part in enumerate(parts):
        part["elapsed_s"] += k * 1e5
    history = equations_of(cell, np.concatenate(parts))
    a = history.normal_equations(history.residuals(history.prior.mean)).a
    expected = np.linalg.cholesky(np.tril(a) + np.tril(a, -1).T)
    factor = cholesky(a, history.unknowns.soc.start)
    np.testing.assert_allclose(np.tril(factor), expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_a_collapse_of_the_voltage_under_load_in_the_cold_has_hardly_any_weight() -> None:
    """At rest, the same voltage keeps its weight, because the surface of the particles is as full as their mean."""
    cell = cell_curves()
    rows = with_voltages(cell, measured_rows(cell), Truth())
    discharge = np.flatnonzero(rows["direction"] > 0.0)[5:10]
    rows["x_a"][discharge], rows["temperature_c"][discharge] = cell.one_c_a, 0.0
    before = equations_of(cell, rows).weight
    rows["voltage_v"][discharge] = 2.5 * cell.series
    assert (equations_of(cell, rows).weight[discharge] < 0.2 * before[discharge]).all()
    rows["direction"][discharge] = 0.0
    assert (equations_of(cell, rows).weight[discharge] >= before[discharge]).all()


def test_a_zone_that_the_model_cannot_fit_gets_its_residuals_as_std() -> None:
    cell = cell_curves()
    rows = with_voltages(cell, measured_rows(cell), Truth())
    fitted = equations_of(cell, rows)
    x = unknowns_of(fitted, Truth())
    is_misfit = (rows["direction"] < 0.0) & (rows["soc"] > 0.3) & (rows["soc"] < 0.4)
    assert not fitted.weaken_misfits(fitted.residuals(x))
    rows["voltage_v"][is_misfit] += 1.2 / fitted.weight[is_misfit] * cell.series
    misfit = equations_of(cell, rows)
    assert misfit.weaken_misfits(misfit.residuals(x))
    np.testing.assert_allclose(misfit.weight[is_misfit], fitted.weight[is_misfit] * FITTED_RMS / 1.2)
    np.testing.assert_array_equal(misfit.weight[~is_misfit], fitted.weight[~is_misfit])
