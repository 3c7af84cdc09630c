"""Sources with little information: one sample each minute, a coarse current, a dead band, and a delayed current."""

from dataclasses import replace

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.kalman_filter.records import EKF_SETTINGS, EKF_STATE
from bms_estimator.kernels.kalman_filter.window import rounding_charge_variance
from bms_estimator.model.arrays import SAMPLE, SampleBlock
from bms_estimator.settings.observer import BOARD, Sampling
from bms_estimator.settings.pack import Settings
from tests.benchmarks.resolution import Source, scores
from tests.estimator.simulated_cell import TRUTH, pulses

MINUTE = Sampling(period_s=60.0)
ROUNDED = Sampling(period_s=1.0, current_resolution_a=0.1)
WITH_DEAD_BAND = Sampling(period_s=1.0, current_resolution_a=0.1, current_dead_band_a=0.6)
ROUNDING_STD_A = 0.1 / np.sqrt(12.0)
"""Std of a current rounded to 0.1 A [A]."""


def constant_load(current_a: float, samples: int, step_s: float = 1.0) -> SampleBlock:
    """Return samples with this current, each ``step_s`` after the previous one, at 3.7 V and 25 C."""
    block = np.zeros(samples, dtype=SAMPLE)
    block["time_s"] = step_s * np.arange(samples)
    block["current_a"], block["voltage_v"], block["temperature_c"] = current_a, 3.7, 25.0
    return block


@pytest.mark.parametrize(
    ("source", "max_rmse", "max_std"),
    [
        (Source(rate_hz=1.0 / 60.0, ampere_step=0.1, volt_step=0.01), 3.2, 5.0),
        (Source(1.0, 0.1, dead_band_a=2.5, capacity_ah=100.0, house=True, standby_a=2.0), 2.4, 2.5),
        (Source(rate_hz=0.1, ampere_step=0.01, delay_s=1.0), 2.4, 3.0),
    ],
    ids=lambda value: value.name if isinstance(value, Source) else "",
)
def test_the_soc_is_inside_its_interval_with_little_information(
    source: Source, max_rmse: float, max_std: float
) -> None:
    """All scores and limits are in percent."""
    results = list(scores(source, seeds=range(1, 5)))
    assert np.mean([s.cover for s in results]) >= 95.0
    assert np.sqrt(np.mean([s.rmse**2 for s in results])) <= max_rmse
    assert np.mean([s.std for s in results]) <= max_std


def test_with_a_sample_each_minute_one_late_or_lost_sample_is_no_gap_but_ten_lost_samples_are() -> None:
    block, _ = pulses(hours=3.0)
    slow = block[::60].copy()
    slow["time_s"] += np.random.default_rng(1).uniform(0.0, 3.0, slow.size)
    slow = np.delete(slow, [30, 90])  # single lost samples
    estimator = Estimator(TRUTH, sampling=MINUTE)
    estimator.run(slow)
    assert estimator.state["gaps"][0] == 0
    estimator = Estimator(TRUTH, sampling=MINUTE)
    estimator.run(np.delete(slow, slice(100, 110)))
    assert estimator.state["gaps"][0] == 1


def test_the_current_is_interpolated_linearly_between_samples_a_minute_apart() -> None:
    samples = constant_load(0.0, 3, 70.0)
    samples["current_a"] = [0.0, 1.0, 1.0]
    estimator = Estimator(TRUTH, initial_soc=0.5, sampling=MINUTE)
    estimator.run(samples)
    discharged = (0.5 * 70.0 + 70.0) / (3600.0 * TRUTH.cell.capacity_ah)
    assert estimator.state["soc_coulomb"][0] == pytest.approx(0.5 - discharged)


@pytest.mark.parametrize(
    ("sampling", "current_a", "error_a"),
    [
        (ROUNDED, 0.3, ROUNDING_STD_A),
        (WITH_DEAD_BAND, 0.0, 0.6 / np.sqrt(3.0)),  # uniform within +-0.6 A
        (WITH_DEAD_BAND, 0.7, ROUNDING_STD_A),
    ],
)
def test_the_rounding_error_of_a_constant_reported_current_is_constant(
    sampling: Sampling, current_a: float, error_a: float
) -> None:
    f, p = np.zeros(1, dtype=EKF_STATE)[0], np.zeros(1, dtype=EKF_SETTINGS)[0]
    p["current_step_a"], p["dead_band_a"] = sampling.current_resolution_a, sampling.current_dead_band_a
    f["current_a"] = current_a
    variance_as2 = sum(rounding_charge_variance(f, p, sampling.period_s, current_a) for _ in range(3600))
    assert variance_as2 == pytest.approx((error_a * 3600.0) ** 2)
    # The error of a different current is independent.
    assert rounding_charge_variance(f, p, 1.0, current_a + 1.0) == pytest.approx(ROUNDING_STD_A**2)


def test_an_estimator_without_sampling_assumes_the_resolution_of_the_board_and_exact_gains() -> None:
    block, _ = pulses(hours=0.5)
    without_gains = replace(Settings().sampling, voltage_gain_std=0.0, current_gain_std=0.0)
    configured, by_default = Estimator(TRUTH, sampling=without_gains), Estimator(TRUTH)
    assert configured.run(block).tobytes() == by_default.run(block).tobytes()


def test_the_resolution_of_a_source_is_that_of_its_protocol_unless_configured() -> None:
    without_dead_band = Settings.model_validate({"sensor": {"protocol": "pylontech", "current_dead_band_a": 0.0}})
    assert without_dead_band.sampling == Sampling(2.0, 0.01, 0.0, 0.005, 0.005)
    assert Settings().sampling == BOARD
    minute = Settings.model_validate({"sensor": {"protocol": "text", "period_s": 60}})
    assert minute.sampling.period_s == minute.sensor.sample_period_s == 60.0
