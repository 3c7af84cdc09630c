import numpy as np
import pytest

from bms_estimator.estimator.records import ocv_grid
from bms_estimator.kernels.cell import ocv, simulate_cell
from bms_estimator.kernels.sensitivity import sensitivities, spline_weights, whiten
from bms_estimator.model.cell import load_cell

CELL = load_cell("ncr18650")
GRID = ocv_grid(CELL)
COEFFICIENTS = 12


def load():
    """Steps of charge and discharge, short and long, from SOC 0.95 to below 0."""
    rng = np.random.default_rng(1)
    step_s = rng.choice([0.1, 1.0, 7.0, 60.0], 900)
    current_a = np.repeat(rng.choice([0.0, 0.0, -1.0, 1.5, 4.0], 90), 10)
    return np.r_[0.0, np.cumsum(step_s[:-1])], current_a


def run(z, *, jacobian):
    time_s, current_a = load()
    a = np.r_[np.nan, z[:15]]
    voltage_v = np.empty(time_s.size)
    table = np.empty((time_s.size, 17 + COEFFICIENTS) if jacobian else (0, 0))
    correction_v = np.ascontiguousarray(z[15 : 15 + COEFFICIENTS])
    sensitivities(time_s, current_a, current_a, z[-2], z[-1], 10800.0, a, *GRID, correction_v, voltage_v, table)
    return voltage_v, table


POINT = np.r_[CELL.a[1:16], np.linspace(-0.02, 0.03, COEFFICIENTS), 0.95, 0.004]


@pytest.mark.parametrize("column", range(POINT.size))
def test_derivatives_are_those_of_finite_differences(column):
    _, table = run(POINT, jacobian=True)
    h = 1e-4 * max(abs(POINT[column]), 1e-3)
    differences = []
    for width in (h, 2.0 * h):  # Richardson: error of fourth order
        up, down = POINT.copy(), POINT.copy()
        up[column] += width
        down[column] -= width
        differences.append((run(up, jacobian=False)[0] - run(down, jacobian=False)[0]) / (2.0 * width))
    expected = (4.0 * differences[0] - differences[1]) / 3.0
    # a table's slope bends at its nodes, and so does (2.7) where it is held: there a difference is none
    smooth = np.abs(differences[0] - differences[1]) < 1e-4 * np.abs(expected).max()
    assert smooth.mean() > 0.9
    assert np.abs(table[smooth, column] - expected[smooth]).max() < 1e-6 * np.abs(expected).max()


def test_without_correction_the_voltage_is_that_of_the_cell():
    time_s, current_a = load()
    elements = np.zeros(22)
    elements[1:16] = CELL.a[1:16]
    drop_v, soc = simulate_cell((0.95, 0.0, 0.0), time_s, current_a, 10800.0, elements)
    voltage_v, _ = run(np.r_[CELL.a[1:16], np.zeros(COEFFICIENTS), 0.95, 0.0], jacobian=False)
    stable = np.minimum.accumulate(soc) > 0.05
    expected = np.array([ocv(x, *GRID) for x in soc[stable]]) + drop_v[stable]
    assert stable.sum() > 100
    np.testing.assert_allclose(voltage_v[stable], expected, atol=1e-12)


def test_voltage_stays_finite_below_delta():
    voltage_v, table = run(POINT, jacobian=True)
    time_s, current_a = load()
    assert 0.95 - np.sum(current_a[:-1] * np.diff(time_s)) / 10800.0 < 0.0
    assert np.isfinite(voltage_v).all()
    assert np.isfinite(table).all()


@pytest.mark.parametrize("soc", [-0.3, 0.0, 1e-9, 0.31, 0.5, 1.0, 1.2])
def test_spline_weights_add_up_to_one_and_their_slopes_to_none(soc):
    w = np.zeros(8)
    first = spline_weights(soc, COEFFICIENTS, w)
    assert 0 <= first <= COEFFICIENTS - 4
    assert w[:4].sum() == pytest.approx(1.0)
    assert w[4:].sum() == pytest.approx(0.0, abs=1e-9)


def test_whitening_makes_coloured_noise_white():
    rng = np.random.default_rng(2)
    time_s = np.cumsum(rng.choice([1.0, 5.0, 30.0], 20000))
    drift = np.zeros(time_s.size)
    for j in range(1, drift.size):
        keep = np.exp(-(time_s[j] - time_s[j - 1]) / 60.0)
        drift[j] = keep * drift[j - 1] + 0.003 * np.sqrt(1.0 - keep**2) * rng.standard_normal()
    rows = (drift + 0.002 * rng.standard_normal(drift.size))[:, None]
    before = np.corrcoef(rows[1:, 0], rows[:-1, 0])[0, 1]
    whiten(rows, time_s, 0.002, 0.003, 60.0)
    assert before > 0.4
    assert abs(np.corrcoef(rows[1:, 0], rows[:-1, 0])[0, 1]) < 0.03
    assert rows.std() == pytest.approx(1.0, abs=0.03)
