"""Fit of the open-circuit voltage of Chen and Mora, (2.10) of the thesis, to points of a known curve."""

import numpy as np
import pytest

from bms_estimator.calibration.ocv.chen_mora_fit import (
    Points,
    average,
    chen_mora,
    fit_chen_mora,
    max_v,
    pool_tests,
    rms_v,
)
from bms_estimator.calibration.ocv.relaxation_test import relaxation_test
from bms_estimator.calibration.ocv.table_fit import fit_table
from bms_estimator.model.cell import load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.reports.thesis.printed_values import TABLE_1, TABLE_8
from tests.calibration.simulated_load import TRUTH
from tests.calibration.simulated_relaxation import relaxation

GRID = np.linspace(0.0, 1.0, 501)


def make_points(soc, ocv_v, std_v=1e-3):
    """Return points of an OCV that all have the std ``std_v``."""
    soc = np.asarray(soc, dtype=float)
    return Points(soc, np.asarray(ocv_v, dtype=float), np.full(soc.size, std_v))


@pytest.mark.parametrize("a", [TABLE_1, TABLE_8], ids=["Table 1", "Table 8"])
def test_exact_points_give_the_true_parameters(a):
    soc = np.linspace(0.005, 1.0, 60)
    fit = fit_chen_mora(make_points(soc, chen_mora(np.array(a), soc)))
    assert fit.a == pytest.approx(a, rel=1e-4)
    assert max_v(fit.residual_v) < 1e-7


def test_shipped_cell_has_the_curve_of_table_1():
    ocv = load_cell("chen_mora").ocv
    assert ocv.a == pytest.approx(TABLE_1)
    soc = 0.37
    expected_v = -1.031 * np.exp(-35.0 * soc) + 3.685 + 0.2156 * soc - 0.1178 * soc**2 + 0.3201 * soc**3
    assert chen_mora(np.array(TABLE_1), np.array([soc]))[0] == pytest.approx(expected_v, rel=1e-15)


def test_standard_errors_equal_the_scatter_of_the_fits():
    """The scatter of the fits to 40 noisy sets of points is compared with their standard errors."""
    rng, soc = np.random.default_rng(0), np.linspace(0.01, 1.0, 80)
    exact_v = chen_mora(np.array(TABLE_1), soc)
    fits = [fit_chen_mora(make_points(soc, exact_v + 1e-3 * rng.standard_normal(soc.size))) for _ in range(40)]
    scatter = np.std([fit.a for fit in fits], axis=0, ddof=1)
    declared = np.mean([fit.std for fit in fits], axis=0)
    assert scatter == pytest.approx(declared, rel=0.4)
    assert np.mean([rms_v(fit.residual_v) for fit in fits]) == pytest.approx(1e-3, rel=0.1)


def test_points_above_the_knee_do_not_give_a_large_negative_voltage_at_soc_0():
    """Points above SOC 0.07 do not determine the amplitude of the exponential. The fit bounds it by the highest voltage."""
    soc = np.linspace(0.07, 1.0, 19)
    ocv_v = 3.2 + 0.1 * soc
    ocv_v[0] -= 0.15
    fit = fit_chen_mora(make_points(soc, ocv_v))
    assert fit.a[0] <= ocv_v.max()
    assert fit(np.array([0.0]))[0] > -0.1


def test_a_parameter_at_its_bound_has_no_standard_error():
    soc = np.linspace(0.0, 1.0, 40)
    fit = fit_chen_mora(make_points(soc, 3.5 + 0.6 * soc))  # a curve without exponential part
    assert np.isnan(fit.std[0])
    assert np.isfinite(fit.std[2:]).all()
    assert max_v(fit.residual_v) < 1e-5


def test_joint_fit_of_several_runs_is_better_than_the_mean_of_their_parameters():
    """(5.1)-(5.2) of the thesis average the parameters of the runs, which are strongly correlated."""
    rng, true_a = np.random.default_rng(4), np.array(TABLE_1)
    runs = []
    for count in (9, 10, 12):
        soc = np.linspace(0.2 / count, 1.0, count)
        runs.append(make_points(soc, chen_mora(true_a, soc) + 2e-3 * rng.standard_normal(count)))
    fits = [fit_chen_mora(run) for run in runs]
    mean = average(fits)
    assert mean == pytest.approx(sum(fit.a for fit in fits) / 3)  # (5.1), (5.2)
    soc, ocv_v = np.concatenate([run.soc for run in runs]), np.concatenate([run.ocv_v for run in runs])
    order = np.argsort(soc)
    joint = fit_chen_mora(make_points(soc[order], ocv_v[order]))
    above_knee = GRID[GRID > 0.05]
    true_v = chen_mora(true_a, above_knee)
    assert rms_v(joint(above_knee) - true_v) < rms_v(chen_mora(mean, above_knee) - true_v)
    assert rms_v(joint(above_knee) - true_v) < 2e-3


def test_points_of_several_captures_are_pooled_in_the_order_of_soc():
    relaxation_tests = [
        relaxation_test(relaxation(rounds=10, seed=seed), TRUTH.cell.capacity_ah, name="mine") for seed in (0, 1)
    ]
    pooled_points = pool_tests(relaxation_tests)
    assert pooled_points.soc.size == len(relaxation_tests[0].rests) + len(relaxation_tests[1].rests)
    assert (np.diff(pooled_points.soc) >= 0.0).all()
    assert pooled_points.full_v == pytest.approx(0.5 * (relaxation_tests[0].full_v + relaxation_tests[1].full_v))
    assert np.isnan(pooled_points.empty_v)  # neither capture ends empty


@pytest.mark.parametrize("fit", [fit_chen_mora, fit_table])
def test_too_few_points_or_too_small_a_span_are_rejected_with_their_numbers(fit):
    """Both fits use ``check_points``, whose minimum is the number of parameters of (2.10)."""
    with pytest.raises(UserError, match=r"5 points of the open-circuit voltage; \(2.10\) has 6 parameters"):
        fit(make_points(np.linspace(0.0, 1.0, 5), np.linspace(3.4, 4.1, 5)))
    with pytest.raises(UserError, match=r"points span SOC 0.50 to 0.70 only"):
        fit(make_points(np.linspace(0.5, 0.7, 12), np.linspace(3.4, 4.1, 12)))
