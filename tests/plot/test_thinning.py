"""Thinning of lines: extremes and steps stay."""

import numpy as np
import pytest

from bms_estimator.plot.style import thin


def test_extremes_of_every_curve_stay_in_5_million_samples():
    size = 5_000_000
    x = np.arange(size, dtype=float)
    curves = np.zeros(size), np.ones(size)
    curves[0][[1_234_567, 4_000_001]] = -3.0, 2.0
    curves[1][[17, 3_333_333]] = 9.0, -9.0
    thinned_x, *thinned = thin(x, *curves)
    assert thinned_x.size <= 1201
    assert {1_234_567, 4_000_001, 17, 3_333_333} <= set(thinned_x.astype(int))
    for before, after in zip(curves, thinned, strict=True):
        assert (after.min(), after.max()) == (before.min(), before.max())


@pytest.mark.parametrize("seed", range(5))
def test_minimum_and_maximum_of_each_interval_stay(seed):
    curve = np.random.default_rng(seed).standard_normal(9_000)
    x, thinned = thin(np.arange(9_000.0), curve, points=300)
    for begin in range(0, 9_000, 90):
        interval = thinned[(x >= begin) & (x < begin + 90)]
        assert (interval.min(), interval.max()) == (curve[begin : begin + 90].min(), curve[begin : begin + 90].max())


def test_missing_values_hide_no_extreme():
    curve = np.full(10_000, np.nan)
    curve[7_777] = 5.0
    _, thinned = thin(np.arange(10_000.0), curve, points=100)
    assert np.nanmax(thinned) == 5.0


def test_short_curves_are_unchanged_and_the_last_point_stays():
    x, y = np.arange(1_000.0), np.zeros(1_000)
    assert thin(x, y)[0] is x
    assert thin(x, y, points=50)[0][-1] == 999.0


def test_pulses_stay_pulses_between_sparse_samples():
    minutes = 60.0 * np.arange(5_000.0)
    is_pulse = np.arange(5_000) % 100 >= 90
    current_a = np.where(is_pulse, 3.0, 0.0) + np.random.default_rng(1).normal(0.0, 0.01, 5_000)
    thinned_s, thinned_a = thin(minutes, current_a, points=600)
    assert thinned_s.size <= 901
    interpolated_a = np.interp(minutes, thinned_s, thinned_a)
    np.testing.assert_allclose(interpolated_a, np.where(is_pulse, 3.0, 0.0), atol=0.1)


def test_many_steps_do_not_exceed_the_number_of_points():
    curve = np.resize([0.0, 1.0], 100_000)
    assert thin(np.arange(100_000.0), curve, points=600)[0].size <= 901


def test_sparse_samples_of_an_increasing_abscissa_stay():
    dense_s, sparse_s = np.arange(0.0, 100.0, 0.01), np.arange(100.0, 10_100.0, 100.0)
    time_s = np.concatenate([dense_s, sparse_s])
    thinned_s, _ = thin(time_s, np.exp(-time_s / 2_000.0), points=600)
    assert set(sparse_s) <= set(thinned_s)


def test_an_abscissa_that_falls_keeps_the_extremes_of_each_interval():
    curve = np.random.default_rng(0).standard_normal(9_000)
    x, thinned = thin(np.arange(9_000.0, 0.0, -1.0), curve, points=300)
    assert (thinned.min(), thinned.max(), x[0]) == (curve.min(), curve.max(), 9_000.0)
    assert x.size > 200
