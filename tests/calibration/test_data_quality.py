"""Quality of a capture's data."""

import numpy as np
import pytest

from bms_estimator.calibration.cleaning.data_quality import data_quality
from bms_estimator.model.arrays import SAMPLE


@pytest.fixture
def samples():
    """Return 1,000 samples at 10 Hz with a resolution of 5 mV and 0.1 A."""
    rows = np.zeros(1_000, dtype=SAMPLE)
    rows["time_s"] = 0.1 * np.arange(1_000)
    rows["voltage_v"] = 3.5 + 0.005 * (np.arange(1_000) % 7)
    rows["current_a"] = 0.1 * (np.arange(1_000) % 3)
    rows["temperature_c"] = 25.0
    return rows


def test_period_and_resolution_are_those_of_the_values(samples):
    quality = data_quality(samples)
    assert (quality.samples, quality.gaps, quality.not_finite, quality.temperature_fraction) == (1_000, 0, 0, 1.0)
    assert quality.period_s == pytest.approx(0.1)
    assert quality.duration_s == pytest.approx(99.9)
    assert quality.voltage_resolution_v == pytest.approx(0.005)
    assert quality.current_resolution_a == pytest.approx(0.1)


def test_gaps_and_faults_of_the_clock_are_counted(samples):
    samples["time_s"][500:] += 60.0
    samples["time_s"][700] = samples["time_s"][699]
    samples["time_s"][900:] -= 5.0
    quality = data_quality(samples)
    assert (quality.gaps, quality.repeated_times, quality.backward_steps) == (1, 1, 1)
    assert quality.longest_gap_s == pytest.approx(60.1)


def test_rests_that_are_recorded_more_slowly_are_no_gaps(samples):
    samples["time_s"] = np.cumsum(np.where(np.arange(1_000) < 900, 0.1, 60.0))
    assert data_quality(samples).gaps == 0
    samples["time_s"][950:] += 3600.0
    assert data_quality(samples).gaps == 1


def test_missing_values_are_counted(samples):
    samples["voltage_v"][10:20] = np.nan
    samples["temperature_c"][:250] = np.nan
    quality = data_quality(samples)
    assert (quality.not_finite, quality.temperature_fraction) == (10, 0.75)


def test_constant_values_have_no_resolution_and_one_sample_no_period(samples):
    samples["voltage_v"] = 3.7
    assert np.isnan(data_quality(samples).voltage_resolution_v)
    assert np.isnan(data_quality(samples[:1]).period_s)
