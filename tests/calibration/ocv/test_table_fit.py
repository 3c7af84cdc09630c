"""Fit of the OCV table to points of a known curve with known errors and a known temperature coefficient."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from bms_estimator.calibration.ocv.chen_mora_fit import Points, chen_mora, join_points, max_v, rms_v
from bms_estimator.calibration.ocv.table_fit import NODES, fit_table
from bms_estimator.reports.thesis.printed_values import TABLE_1

GRID = np.linspace(0.0, 1.0, 401)


def true_v(soc):
    """Return the OCV of Table 1 of the thesis at each SOC [V]."""
    return chen_mora(np.array(TABLE_1), soc)


def make_points(soc, *, noise_v=0.0, offset_v=0.0, std_v=1e-3, systematic_std_v=2e-3, temperature_c=np.nan, seed=0):
    """Return points of one capture; ``systematic_std_v`` is the std of an error that all points share [V]."""
    ocv_v = true_v(soc) + offset_v + noise_v * np.random.default_rng(seed).standard_normal(soc.size)
    ones = np.ones(soc.size)
    return Points(
        soc, ocv_v, std_v * ones, systematic_std_v=systematic_std_v * ones, temperature_c=temperature_c * ones
    )


def slope_v(fit, soc):
    """Return the slope of the curve as the kernels of the estimator interpolate it [V]."""
    return PchipInterpolator(fit.soc, fit.ocv_v).derivative()(soc)


@pytest.mark.parametrize(("noise_v", "max_error_v"), [(0.0, 1.5e-3), (3e-3, 4e-3)])
def test_table_is_increasing_and_near_the_true_curve(noise_v, max_error_v):
    fit = fit_table(
        make_points(np.linspace(0.02, 0.99, 40), noise_v=noise_v, std_v=noise_v + 5e-4, systematic_std_v=5e-4)
    )
    assert (fit.soc[0], fit.soc[-1]) == (0.0, 1.0)
    assert (np.diff(fit.ocv_v) > 0.0).all()
    assert (np.diff(fit(GRID)) > 0.0).all()
    inside = (GRID > 0.15) & (GRID < 0.98)
    assert max_v(fit(GRID[inside]) - true_v(GRID[inside])) < max_error_v
    assert rms_v(fit.residual_v) < 5e-4 + 1.2 * noise_v


def test_slopes_between_clustered_noisy_points_are_those_of_the_curve():
    """The points are 0.004 apart with errors of 3 mV, so that lines through them have slopes of several volts."""
    soc = np.concatenate([z + np.array([0.0, 0.004, 0.008, 0.02]) for z in np.arange(0.05, 0.95, 0.05)])
    points = make_points(soc, noise_v=3e-3, std_v=5e-4, systematic_std_v=2e-3)
    assert np.abs(np.diff(points.ocv_v) / np.diff(soc)).max() > 1.5
    inside = GRID[(GRID > 0.15) & (GRID < 0.9)]
    true_slope_v = (true_v(inside + 1e-4) - true_v(inside - 1e-4)) / 2e-4
    assert slope_v(fit_table(points), inside) == pytest.approx(true_slope_v, abs=0.15)


def test_points_that_fall_give_an_increasing_table():
    soc = np.linspace(0.0, 1.0, 41)
    points = Points(soc, 3.4 + 0.7 * soc - 0.2 * ((soc > 0.4) & (soc < 0.6)), np.full(soc.size, 1e-3))
    fit = fit_table(points)
    assert (np.diff(fit.ocv_v) > 0.0).all()
    assert (slope_v(fit, GRID) >= 0.0).all()


def test_the_error_of_the_curve_equals_the_scatter_of_the_fits():
    soc = np.linspace(0.05, 0.98, 30)
    fits = [
        fit_table(make_points(soc, noise_v=2e-3, std_v=2e-3, systematic_std_v=1e-4, seed=seed)) for seed in range(40)
    ]
    inside = (NODES > 0.15) & (NODES < 0.95)
    error_over_std = np.array([(fit.ocv_v - true_v(NODES)) / fit.error_v for fit in fits])[:, inside]
    assert 0.3 < np.sqrt(np.mean(error_over_std**2)) < 1.1


def test_the_error_is_larger_in_a_gap_beyond_the_points_and_if_captures_disagree():
    soc = np.linspace(0.1, 0.98, 45)
    without_gap = fit_table(make_points(soc))
    with_gap = fit_table(make_points(soc[(soc < 0.4) | (soc > 0.7)]))
    middle = int(np.argmin(np.abs(NODES - 0.56)))
    assert with_gap.error_v[middle] > 1.5 * without_gap.error_v[middle]
    assert without_gap.error_v[0] > 5.0 * without_gap.error_v[middle]
    agreeing = fit_table(join_points([make_points(soc), make_points(soc)]))
    disagreeing = fit_table(join_points([make_points(soc, offset_v=0.015), make_points(soc, offset_v=-0.015)]))
    assert disagreeing.error_v[middle] > 1.5 * agreeing.error_v[middle]
    assert disagreeing.deviation_v == pytest.approx([0.015, 0.015], rel=0.5)


def test_the_more_certain_source_determines_the_curve():
    soc = np.linspace(0.05, 0.98, 45)
    fit = fit_table(
        join_points([make_points(soc, systematic_std_v=1e-3), make_points(soc, offset_v=0.02, systematic_std_v=0.02)])
    )
    inside = (NODES > 0.15) & (NODES < 0.95)
    assert max_v((fit.ocv_v - true_v(NODES))[inside]) < 2e-3


def test_known_end_voltages_are_reached_and_unknown_ones_are_extrapolated():
    soc = np.linspace(0.1, 0.9, 33)
    points = Points(soc, 3.4 + 0.7 * soc, np.full(soc.size, 1e-3))
    without_ends = fit_table(points)
    assert without_ends.ocv_v[[0, -1]] == pytest.approx([3.4, 4.1], abs=2e-3)
    with_ends = fit_table(replace(points, empty_v=3.0, full_v=4.2))
    assert with_ends.ocv_v[[0, -1]] == pytest.approx([3.0, 4.2], abs=0.02)
    assert with_ends.error_v[0] < without_ends.error_v[0]


@pytest.mark.parametrize("per_kelvin_v", [3e-4, -2e-4])
def test_the_temperature_coefficient_is_between_its_true_value_and_0(per_kelvin_v):
    soc = np.linspace(0.05, 0.98, 45)
    at_temperatures = [
        make_points(soc, offset_v=per_kelvin_v * (t - 25.0), temperature_c=t, systematic_std_v=5e-4)
        for t in (15.0, 25.0, 45.0)
    ]
    fitted_per_kelvin_v = fit_table(join_points(at_temperatures)).per_kelvin_v
    assert fitted_per_kelvin_v is not None
    assert fitted_per_kelvin_v[10:-10] == pytest.approx(np.full(NODES.size - 20, per_kelvin_v), rel=0.25)
    cold = make_points(soc, offset_v=-30.0 * per_kelvin_v, temperature_c=-5.0, systematic_std_v=4e-3)
    cold = replace(cold, cold_v=np.full(soc.size, 0.016))
    with_cold_rests = fit_table(join_points([at_temperatures[1], cold])).per_kelvin_v
    assert with_cold_rests is not None
    # Incomplete relaxation in the cold is an equally likely cause of the difference.
    assert (np.abs(with_cold_rests[10:-10]) < 0.6 * abs(per_kelvin_v)).all()


@pytest.mark.parametrize("temperatures_c", [(25.0, 30.0), (np.nan, np.nan)])
def test_the_temperature_coefficient_requires_different_temperatures(temperatures_c):
    soc = np.linspace(0.05, 0.98, 45)
    fit = fit_table(join_points([make_points(soc, temperature_c=t) for t in temperatures_c]))
    assert fit.per_kelvin_v is None
    assert fit.table().per_kelvin_v is None


def test_points_of_cells_in_series_give_the_table_times_their_number():
    soc = np.linspace(0.05, 0.98, 45)
    cell_points = make_points(soc, noise_v=1e-3)
    pack_points = replace(
        cell_points,
        ocv_v=6.0 * cell_points.ocv_v,
        std_v=6.0 * cell_points.std_v,
        systematic_std_v=6.0 * cell_points.systematic_std_v,
    )
    assert fit_table(pack_points).ocv_v == pytest.approx(6.0 * fit_table(cell_points).ocv_v, rel=2e-3)
