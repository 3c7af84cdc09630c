"""Means of samples over a second."""

import numpy as np
import pytest

from bms_estimator.calibration.guided_test.averages import means_of_windows
from bms_estimator.model.arrays import SAMPLE


def samples_at(rate_hz, seconds):
    samples = np.zeros(rate_hz * seconds, dtype=SAMPLE)
    samples["time_s"] = np.arange(samples.size) / rate_hz
    samples["current_a"] = np.random.default_rng(0).standard_normal(samples.size)
    samples["voltage_v"], samples["temperature_c"] = 3.7, np.nan
    return samples


def test_means_keep_the_charge_of_fast_samples() -> None:
    fast = samples_at(100, 60)
    fast["voltage_v"][7] = np.nan
    means = means_of_windows(fast)
    assert means.size == 60
    assert means["current_a"].sum() == pytest.approx(fast["current_a"].sum() / 100, abs=0.05)
    assert np.isfinite(means["voltage_v"]).all()


def test_slow_samples_stay_as_they_are() -> None:
    slow = samples_at(1, 60)
    means = means_of_windows(slow)
    for name in SAMPLE.names:
        np.testing.assert_array_equal(means[name], slow[name])
