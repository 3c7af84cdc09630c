"""Frozen voltages and currents are detected, and their effects are reverted.

Plausibly constant values cause no fault.
"""

from collections.abc import Callable

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import SampleBlock
from bms_estimator.model.cell import load_cell
from bms_estimator.model.input_faults import InputFault
from bms_estimator.settings.observer import Sampling
from tests.estimator.anywhere.use import drive
from tests.estimator.simulated_cell import TRUTH, measured, simulate_file

HOUR = 3600
FROZEN_SAMPLES = slice(HOUR, 3 * HOUR)
"""Samples with a frozen value, after an hour of valid samples and before another."""
FROZEN_FAULTS = InputFault.VOLTAGE | InputFault.CURRENT


def load_a(seconds: int, levels_a: tuple[float, ...], each_s: int = 60, seed: int = 1) -> np.ndarray:
    """Return a current at 1 Hz of random ``levels_a``, each held for ``each_s`` [A]."""
    return np.repeat(np.random.default_rng(seed).choice(levels_a, seconds // each_s), each_s)


BEFORE_A = load_a(HOUR, (0.0, 0.5, 1.0, 2.0, -0.5))
AFTER_A = load_a(HOUR, (0.0, 0.2, 0.4))
"""Current in the hour before and in the hour after the frozen samples [A]."""
PULSES_A = np.where(np.arange(2 * HOUR) % 120 < 5, 3.0, 0.3)
CONSTANT_A, STEPS_A = np.full(2 * HOUR, 0.45), load_a(2 * HOUR, (0.0, 0.3, 0.6, 1.2))
"""True currents while samples are frozen: 3 A for 5 s every two minutes, 0.45 A, and a step each minute [A]."""
VOLTAGE_ONLY, VOLTAGE_AND_CURRENT = ("voltage_v",), ("voltage_v", "current_a")
"""Fields that freeze."""


def run(estimator: Estimator, samples: SampleBlock) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return SOC, its std and the bits of ``InputFault`` after each sample."""
    results = []
    for n in range(samples.size):
        estimator.run(samples[n : n + 1])
        results.append((estimator.soc, estimator.weakest_cell_soc_std, estimator.record[0]["checks"]["suspects"]))
    soc, std, suspects = np.array(results).T
    return soc, std, suspects.astype(int)


@pytest.mark.parametrize(
    ("fields", "during_a", "is_sampled"),
    [
        (VOLTAGE_ONLY, CONSTANT_A, lambda n: n >= 0),
        (VOLTAGE_ONLY, STEPS_A, lambda n: n % 300 >= 12),
        (VOLTAGE_ONLY, STEPS_A, lambda n: n % 60 == 0),
        (VOLTAGE_ONLY, PULSES_A, lambda n: n >= 0),
        (VOLTAGE_AND_CURRENT, STEPS_A, lambda n: n >= 0),
    ],
    ids=["constant load", "gaps of 12 s", "a sample a minute", "at a pulse", "whole frames"],
)
def test_the_true_soc_stays_inside_the_interval_while_values_are_frozen(
    fields: tuple[str, ...], during_a: np.ndarray, is_sampled: Callable[[int], bool]
) -> None:
    samples, true_soc = measured(np.r_[BEFORE_A, during_a, AFTER_A], 0.8, np.random.default_rng(3))
    for name in fields:
        samples[name][FROZEN_SAMPLES] = samples[name][HOUR]
    sampled = is_sampled(np.arange(samples.size))
    samples, true_soc = samples[sampled], true_soc[sampled]
    step_s = float(np.median(np.diff(samples["time_s"])))
    soc, std, suspects = run(Estimator(TRUTH, initial_soc=0.7, sampling=Sampling(step_s)), samples)
    before = samples["time_s"] < HOUR
    is_reported = suspects & InputFault.VOLTAGE != 0
    assert is_reported.any()
    assert not (suspects[before] & FROZEN_FAULTS).any()
    assert suspects[-1] & FROZEN_FAULTS == 0
    # A repeated current is integrated until it is detected, so that the SOC is wrong until then.
    compared = is_reported if fields is VOLTAGE_AND_CURRENT else ~before
    assert (np.abs(soc - true_soc)[compared] < 2.5 * std[compared]).all()


def test_the_soc_is_corrected_once_a_current_sensor_that_reports_zero_is_detected() -> None:
    samples, true_soc = measured(np.r_[BEFORE_A, PULSES_A, AFTER_A], 0.8, np.random.default_rng(3))
    samples["current_a"][FROZEN_SAMPLES] = 0.0
    soc, std, suspects = run(Estimator(TRUTH, initial_soc=0.7), samples)
    is_reported = suspects & InputFault.CURRENT != 0
    assert is_reported.any()
    assert (np.abs(soc - true_soc)[is_reported] < 2.0 * std[is_reported]).all()


PARKED_AH = 60.0
"""Capacity of the cells of a parked car [Ah]."""
LFP_AH = 2.3
"""Capacity of the LFP cell [Ah], and its current of 1 C [A]."""


def simulate_lfp(current_a: np.ndarray, soc: float) -> SampleBlock:
    """Return samples of the generic LFP cell from rest at ``soc``, with a resolution of 1 mV."""
    return simulate_file(load_cell("lfp", LFP_AH), current_a, soc)[0]


@pytest.mark.parametrize(
    ("samples", "soc"),
    [
        (simulate_lfp(np.r_[np.zeros(60), np.full(1740, 2 * LFP_AH), np.zeros(900)], 0.98), 0.98),
        (simulate_lfp(np.r_[np.zeros(600), np.full(4280, -0.5 * LFP_AH), np.zeros(HOUR)], 0.4), 0.4),
    ],
    ids=["to empty", "to full"],
)
def test_an_ocv_knee_under_a_constant_current_causes_no_fault(samples: SampleBlock, soc: float) -> None:
    """The voltage changes under a constant current, and falls with the current at the end of the charge."""
    assert np.ptp(samples["voltage_v"]) > 0.2
    _, _, suspects = run(Estimator(load_cell("lfp", LFP_AH), initial_soc=soc), samples)
    assert not (suspects & (FROZEN_FAULTS | InputFault.SIGN_OF_CURRENT)).any()


def test_a_constant_voltage_charge_causes_no_fault() -> None:
    current_a = np.r_[np.full(HOUR, -1.5), -1.5 * np.exp(-np.arange(HOUR) / 1200.0)]  # time constant 20 min
    samples, _ = measured(current_a, 0.3, np.random.default_rng(3))
    samples["voltage_v"][HOUR:] = samples["voltage_v"][HOUR]
    _, _, suspects = run(Estimator(TRUTH, initial_soc=0.3), samples)
    assert not (suspects & FROZEN_FAULTS).any()


def test_a_coarse_voltage_with_a_configured_resolution_is_not_frozen() -> None:
    samples, _ = measured(load_a(2 * HOUR, (0.3, 0.6, 1.2)), 0.8, np.random.default_rng(3))
    samples["voltage_v"] = np.round(samples["voltage_v"], 1)
    estimator = Estimator(TRUTH, initial_soc=0.8, voltage_resolution_v=0.1)
    _, _, suspects = run(estimator, samples)
    assert not (suspects & FROZEN_FAULTS).any()


def two_levels(rng: np.random.Generator, size: int, apart_v: float = 0.013, samples: int = 3) -> np.ndarray:
    """Return a voltage that changes at random between two levels ``apart_v`` apart, after ``samples`` on average [V]."""
    return apart_v * (np.cumsum(rng.random(size) < 1 / samples) % 2)


@pytest.mark.parametrize("step_s", [1, 5, 10])
@pytest.mark.parametrize(
    "noise",
    [lambda rng, size: rng.normal(0.0, 0.013, size), two_levels, lambda rng, size: two_levels(rng, size, 0.026, 30)],
    ids=["white", "two levels", "two distant levels"],
)
@pytest.mark.parametrize("current_a", [0.0, 0.3], ids=["exactly 0 A", "constant offset"])
def test_a_noisy_voltage_of_a_parked_pack_is_no_frozen_current(
    current_a: float, noise: Callable[[np.random.Generator, int], np.ndarray], step_s: int
) -> None:
    """The converter's noise reaches the change of the voltage that proves a frozen current. It has no other cause than noise."""
    driven_a = load_a(1200, (0.0, 10.0, 20.0))
    samples, _ = simulate_file(load_cell("nmc", PARKED_AH), np.r_[driven_a, np.full(6 * HOUR, current_a)], 0.8)
    samples = samples[::step_s]
    samples["voltage_v"] += noise(np.random.default_rng(1), samples.size)
    estimator = Estimator(load_cell("nmc", PARKED_AH), initial_soc=0.8, sampling=Sampling(float(step_s)))
    _, _, suspects = run(estimator, samples)
    assert not (suspects & FROZEN_FAULTS).any()


@pytest.mark.parametrize("step_s", [1, 5, 10])
def test_a_shunt_that_reads_zero_in_a_drive_is_detected_at_each_sampling_rate(step_s: int) -> None:
    current_a = drive(np.random.default_rng(1), PARKED_AH, 0.4, HOUR)
    samples, _ = simulate_file(load_cell("nmc", PARKED_AH), current_a, 0.9)
    samples = samples[::step_s]
    samples["current_a"][samples["time_s"] >= 0.25 * HOUR] = 0.0
    estimator = Estimator(load_cell("nmc", PARKED_AH), initial_soc=0.9, sampling=Sampling(float(step_s)))
    _, _, suspects = run(estimator, samples)
    assert suspects[-1] & InputFault.CURRENT
