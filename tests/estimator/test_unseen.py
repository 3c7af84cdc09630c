"""Kills, restarts and gaps: the SOC interval includes unmeasured changes, and certain values are preserved."""

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import SampleBlock
from bms_estimator.model.input_faults import InputFault
from bms_estimator.settings.observer import IdentifierSettings
from tests.estimator.simulated_cell import TRUTH, measured, pulses

FULL_LOAD_A = 1.5 * TRUTH.cell.capacity_ah
SCORED_AFTER_S = 900
"""Time after the first sample from which on errors count [s]."""


def run_with_kills(block: SampleBlock, every_s: int, age_s: int, down_s: int, initial_soc: float) -> np.ndarray:
    """Run an estimator that is killed every ``every_s`` and resumes ``down_s`` later; return its trace.

    It resumes from a checkpoint that was saved ``age_s`` before the kill.
    """
    estimator, traces, first = Estimator(TRUTH, initial_soc=initial_soc), [], 0
    while first < block.size:
        traces.append(estimator.run(block[first : first + every_s - age_s]).copy())
        checkpoint = estimator.record.copy()
        traces.append(estimator.run(block[first + every_s - age_s : first + every_s]).copy())
        estimator.record[...] = checkpoint  # the kill
        estimator.resume(float(age_s + down_s))
        first += every_s + down_s
    return np.concatenate(traces)


def fraction_outside(trace: np.ndarray, true_soc: np.ndarray) -> float:
    """Return the fraction of samples after ``SCORED_AFTER_S`` whose true SOC is outside two standard deviations."""
    error = trace["soc"] - true_soc[trace["time_s"].astype(int)]
    return float(np.mean((np.abs(error) > 2.0 * trace["soc_std"])[trace["time_s"] >= SCORED_AFTER_S]))


@pytest.mark.parametrize("initial_soc", [0.7, 1.0])
@pytest.mark.parametrize("age_s", [2, 60])
@pytest.mark.parametrize("load", ["pulses", "constant"])
def test_the_true_soc_stays_in_the_interval_after_kills_under_load(load: str, age_s: int, initial_soc: float) -> None:
    """The process is killed every 100 s, with checkpoints up to a minute old and a downtime of 12 s."""
    constant = np.full(2000, FULL_LOAD_A)
    block, true_soc = pulses() if load == "pulses" else measured(constant, 0.9, np.random.default_rng(1))
    trace = run_with_kills(block, every_s=100, age_s=age_s, down_s=12, initial_soc=initial_soc)
    assert fraction_outside(trace, true_soc) < 0.02


def test_a_crash_loop_before_convergence_does_not_reduce_the_std() -> None:
    """Each start measures the voltage under the same polarization, so that the information is not independent."""
    block, true_soc = measured(np.full(1500, FULL_LOAD_A), 0.9, np.random.default_rng(2))
    trace = run_with_kills(block, every_s=40, age_s=2, down_s=12, initial_soc=0.7)
    assert fraction_outside(trace, true_soc) < 0.02


@pytest.mark.parametrize("every_s", [60, 600, 3600])
def test_restarts_at_rest_do_not_change_the_soc(every_s: int) -> None:
    """Each restart measures the same error of the OCV, so that restarts give no information."""
    block = measured(np.zeros(4 * 3600), 0.6, np.random.default_rng(3))[0]
    block["voltage_v"] += 0.02  # error of the OCV
    uninterrupted = Estimator(TRUTH, initial_soc=0.5).run(block)[-1]
    restarted = run_with_kills(block, every_s, age_s=1, down_s=3, initial_soc=0.5)[-1]
    assert restarted["soc"] == pytest.approx(uninterrupted["soc"], abs=1e-3)
    assert restarted["soc_std"] == pytest.approx(uninterrupted["soc_std"], rel=0.05)


@pytest.mark.parametrize("gap_s", [40, 400, 1500])
@pytest.mark.parametrize("restart", [False, True], ids=["gap", "restart"])
def test_the_true_soc_after_a_load_in_a_gap_is_inside_the_interval(gap_s: int, restart: bool) -> None:
    """The cell rests before the gap and after it. In the gap the load of 3 A flows, as before the rest."""
    load_a = np.repeat([0.0, 3.0, 0.0, 3.0, 0.0], [1200, 1200, 1200, gap_s, 600])
    block, true_soc = measured(load_a, 0.9, np.random.default_rng(4))
    estimator = Estimator(TRUTH, initial_soc=0.9)
    gap_start = 3600
    estimator.run(block[:gap_start])
    if restart:
        estimator.resume(gap_s + 1.0)
    after = estimator.run(block[gap_start + gap_s :])
    error = np.abs(after["soc"] - true_soc[gap_start + gap_s :])
    assert (error < 2.0 * after["soc_std"]).all()
    assert error[-1] < 0.02


def test_samples_before_a_gap_give_no_information_on_its_charge() -> None:
    """At 10 Hz an update uses the ten samples of a second. The gap begins after each number of them."""
    load_a = np.repeat([0.3, 1.0, 0.3], [3000, 1000, 100]) * TRUTH.cell.capacity_ah
    block, true_soc = measured(load_a, 0.5, np.random.default_rng(8), step_s=0.1)
    results = []
    for gap_start in range(3000, 3010):
        estimator = Estimator(TRUTH, initial_soc=0.5, identifier=IdentifierSettings(soc_std=0.02))
        estimator.run(block[:gap_start])
        after = estimator.run(block[4000:])[0]
        results.append((after["soc"], after["soc_std"]))
        assert abs(after["soc"] - true_soc[4000]) < 2.0 * after["soc_std"]
    soc, std = np.transpose(results)
    assert np.ptp(soc) < 0.1 * std.mean()
    assert np.ptp(std) < 0.1 * std.mean()


@pytest.mark.parametrize("period_s", [60, 120, 600, 1800])
def test_slow_sampling_is_no_gap(period_s: int) -> None:
    """The current at both ends of a step is measured. Therefore the std of the long-term load is not added."""
    block, true_soc = measured(np.repeat([0.0, 0.3], [3600, 7 * 3600]), 0.95, np.random.default_rng(6))
    estimator = Estimator(TRUTH, initial_soc=0.95)
    trace = estimator.run(block[::period_s])
    compared = trace["time_s"] >= 7200.0
    error = np.abs(trace["soc"] - true_soc[::period_s])[compared]
    assert error.max() < 0.01
    assert (error < 2.0 * trace["soc_std"][compared]).all()
    assert estimator.state["gaps"][0] == 1  # the first step, because the sample period is not known yet


def test_missing_samples_after_a_restart_are_a_gap() -> None:
    block = measured(np.zeros(2000), 0.6, np.random.default_rng(7))[0]
    estimator = Estimator(TRUTH, initial_soc=0.6)
    estimator.run(block[:300])
    estimator.resume(600.0)
    estimator.run(np.concatenate([block[900:1200], block[1250:]]))  # 50 samples are missing
    assert estimator.state["gaps"][0] == 1


def test_a_gap_does_not_reduce_the_std_during_a_sign_fault() -> None:
    block = pulses()[0][:6000].copy()
    block["current_a"] *= -1.0
    estimator = Estimator(TRUTH, initial_soc=1.0)
    estimator.run(block[:3600])
    assert estimator.record["checks"]["suspects"][0] == InputFault.SIGN_OF_CURRENT
    std_before = estimator.record["filter"]["soc_std"][0]
    estimator.run(block[5100:5101])  # a gap of 25 min
    assert estimator.record["filter"]["soc_std"][0] >= std_before


def test_without_the_filter_the_load_is_also_counted_for_the_downtime_of_a_restart() -> None:
    block, true_soc = measured(np.full(1000, 1.0), 0.9, np.random.default_rng(5))
    estimator = Estimator(TRUTH, initial_soc=0.9, identifier=None)
    estimator.run(block[:400])
    estimator.resume(201.0)
    assert estimator.run(block[600:])["soc"][-1] == pytest.approx(true_soc[-1], abs=1e-9)
