"""Update of the current sensor's offset by samples that report no current, and cases without an update."""

import numpy as np
import pytest

from bms_estimator.estimator import Estimator
from bms_estimator.kernels.kalman_filter import ekf
from bms_estimator.kernels.kalman_filter.records import EKF_STATE, OFFSET, STATES
from bms_estimator.model.cell import load_cell
from bms_estimator.model.sample import SAMPLE
from bms_estimator.settings.observer import IdentifierSettings
from bms_estimator.settings.sampling import Sampling
from tests.estimator.anywhere.cases import LFP, Case, capture, load_a
from tests.estimator.anywhere.score import score

CAPACITY_AH = 3.0
INITIAL_STD_A, ZERO_STD_A = 0.007 * CAPACITY_AH, 0.001 * CAPACITY_AH
SMALLEST_A = 0.002


def offset_after(reported_a, sampling=None, smallest_a=SMALLEST_A):
    """Return the offset and its std [A] after ten minutes of load and two minutes with the current ``reported_a``.

    During the load the sensor reports ``smallest_a`` for 20 s, which limits its resolution.
    """
    rng = np.random.default_rng(1)
    samples = np.zeros(720, dtype=SAMPLE)
    samples["time_s"] = np.arange(720.0)
    samples["current_a"][:600] = np.repeat(rng.uniform(1.0, 3.0, 30), 20)
    samples["current_a"][300:320] = smallest_a
    samples["current_a"][600:] = reported_a
    samples["voltage_v"], samples["temperature_c"] = 3.7 - 0.03 * samples["current_a"], 25.0
    estimator = Estimator(
        load_cell("nmc", CAPACITY_AH), initial_soc=0.6, **({"sampling": sampling} if sampling else {})
    )
    return run_and_get_offset(estimator, samples)


def run_and_get_offset(estimator, samples):
    """Return the offset and its std after the samples [A]."""
    estimator.run(samples)
    f = estimator.record[0]["filter"]
    return f["mean"][f["best"], OFFSET], np.sqrt(f["covariance"][f["best"], OFFSET, OFFSET])


def test_a_sensor_that_reports_no_current_at_rest_has_no_offset() -> None:
    offset_a, std_a = offset_after(0.0)
    assert abs(offset_a) < 1e-3
    assert ZERO_STD_A <= std_a < 1.2 * ZERO_STD_A


def test_a_zero_current_is_detected_with_noise() -> None:
    noise_a = np.random.default_rng(2).normal(0.0, 5e-3, 120)
    offset_a, std_a = offset_after(noise_a, smallest_a=1.0)
    assert abs(offset_a) < 2e-3
    assert std_a < 1.2 * ZERO_STD_A


@pytest.mark.parametrize(
    "arguments",
    [
        {"reported_a": 0.05},
        {"reported_a": -0.05},
        {"reported_a": 0.02},
        {"reported_a": 0.0, "smallest_a": 0.3},
        {"reported_a": 0.0, "sampling": Sampling(1.0, 0.0, 0.5)},
        {"reported_a": 0.0, "sampling": Sampling(1.0, 0.1)},
    ],
    ids=["50 mA", "-50 mA", "20 mA", "unknown resolution", "dead band", "coarse steps"],
)
def test_a_possible_load_or_hidden_current_gives_no_information(arguments) -> None:
    assert offset_after(**arguments)[1] > 0.7 * INITIAL_STD_A


LOAD = (100, 1.0, 1), (20, SMALLEST_A, 1), (100, 1.0, 1)


def offset_of(steps, estimator=None):
    """Return the offset and its std [A] after steps of (duration [s], current [A], sample period [s])."""
    steps = [*LOAD, *steps] if estimator is None else steps
    estimator = estimator or Estimator(load_cell("nmc", CAPACITY_AH), initial_soc=0.6)
    time_s, times, currents = 0.0, [], []
    for duration_s, current_a, step_s in steps:
        for _ in range(round(duration_s / step_s)):
            time_s += step_s
            times.append(time_s)
            currents.append(current_a)
    samples = np.zeros(len(times), dtype=SAMPLE)
    samples["time_s"], samples["current_a"] = times, currents
    samples["voltage_v"], samples["temperature_c"] = 3.7 - 0.03 * samples["current_a"], 25.0
    return run_and_get_offset(estimator, samples)


def test_samples_of_both_signs_are_no_rest() -> None:
    """Samples a minute apart have a mean of zero, as with changing clouds, but none reports zero."""
    alternating = [(60, current_a, 60) for current_a in (2.0, -2.0) * 10]
    assert offset_of(alternating)[1] > 0.7 * INITIAL_STD_A


def test_a_single_small_sample_does_not_determine_the_resolution() -> None:
    """A single sample may be a mean over a step. Two successive ones are a current."""
    edge = [(100, 1.0, 1), (1, SMALLEST_A, 1), (100, 1.0, 1), (120, 0.0, 1)]
    estimators = [Estimator(load_cell("nmc", CAPACITY_AH), initial_soc=0.6) for _ in range(2)]
    assert offset_of(edge, estimators[0])[1] > 0.7 * INITIAL_STD_A
    assert offset_of([*LOAD, *edge], estimators[1])[1] < 1.2 * ZERO_STD_A


@pytest.mark.parametrize("later_steps", [(), LOAD], ids=["no small current", "small current again"])
def test_the_resolution_is_determined_again_after_a_restart(later_steps) -> None:
    estimator = Estimator(load_cell("nmc", CAPACITY_AH), initial_soc=0.6)
    offset_of([*LOAD, (50, 0.0, 1)], estimator)
    estimator.resume(3600.0)
    std_a = offset_of([*later_steps, (130, 0.0, 1)], estimator)[1]
    if later_steps:
        assert std_a < 1.2 * ZERO_STD_A
    else:
        assert std_a > 0.7 * INITIAL_STD_A


def test_a_small_load_after_a_long_rest_is_not_averaged_with_the_rest() -> None:
    """Hours of zero current before the load do not reduce its mean: the smallest load, C/150, is no offset."""
    assert abs(offset_of([(7200, 0.0, 1), (3600, 0.02, 1)])[0]) < 2e-3


def test_a_constant_small_load_stays_in_the_interval() -> None:
    """An LFP cell on its plateau is discharged with C/600 for a day. The interval includes that the current is an offset."""
    hours, capacity_ah = 24.0, 100.0
    samples = np.zeros(round(3600.0 * hours) // 10, dtype=SAMPLE)
    samples["time_s"] = 10.0 * np.arange(samples.size)
    samples["current_a"] = capacity_ah / 600.0
    samples["current_a"][:60] = np.repeat([50.0, 0.1, 20.0], 20)
    samples["voltage_v"], samples["temperature_c"] = 3.29, 25.0
    estimator = Estimator(load_cell("lfp", capacity_ah), identifier=IdentifierSettings(soc_std=0.01), initial_soc=0.6)
    trace = estimator.run(samples)
    discharged = np.cumsum(samples["current_a"]) * 10.0 / 3600.0 / capacity_ah
    assert (np.abs(trace["soc"] - (0.6 - discharged)) < 2.0 * trace["soc_std"])[60:].all()


def test_a_direct_update_of_a_state_equals_the_kalman_update() -> None:
    rng = np.random.default_rng(3)
    s = np.zeros(1, EKF_STATE)[0]
    mixed = rng.standard_normal((STATES, STATES))
    before, mean = mixed @ mixed.T, rng.standard_normal(STATES)
    mean[0] = 0.5
    s["covariance"][0], s["mean"][0] = before, mean
    ekf.update_state_directly(s, 0, OFFSET, mean[OFFSET] + 0.01, 0.3)
    gain = before[OFFSET] / (before[OFFSET, OFFSET] + 0.3)
    assert s["mean"][0] == pytest.approx(mean + 0.01 * gain)
    assert s["covariance"][0] == pytest.approx(before - np.outer(gain, before[OFFSET]))
    assert (s["covariance"][0] == s["covariance"][0].T).all()


def test_rests_without_current_limit_the_error_of_the_soc_on_a_plateau() -> None:
    """An LFP cell is discharged from full for nine hours, with five minutes of rest in each half hour.

    Without rests, the offset would cause an error of up to 9 %.
    """
    case = Case("LFP, rests", **LFP, load_c=0.1, hours=9.0, soc=1.0, unseen_h=0.0, capacity=1.0, seed=32)
    seconds = round(3600.0 * case.hours)
    current_a = load_a(case, seconds)
    current_a[np.arange(seconds) % 1800 < 300] = 0.0
    recording = capture(case, current_a)
    stds = []
    for zero_std_c in (None, 1.0):
        estimator = Estimator(recording.cell, identifier=IdentifierSettings(capacity_std=0.015), initial_soc=0.8)
        if zero_std_c is not None:
            estimator.settings_record["filter"]["zero_std_c"] = zero_std_c
        trace = estimator.run(recording.samples)
        result = score(trace["time_s"], trace["soc"], trace["soc_std"], recording.soc)
        stds.append(result.std)
        assert result.rmse < 1.0
        assert result.cover > 95.0
    assert stds[0] < 0.7 * stds[1]
