"""A current that the voltage does not follow: a single one is rejected, a level that persists and a late voltage are not."""

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.step import SampleOutcome
from bms_estimator.model.arrays import SAMPLE, SampleBlock, SampleStatus
from bms_estimator.model.cell import load_cell
from bms_estimator.model.input_faults import InputFault
from tests.estimator.simulated_cell import TRUTH, measured, pulses, run_divided

WRAPPED_A = {"0.1 A": 6553.6, "0.01 A": 655.36, "unsigned, offset 3000 A": 3556.5}
"""Current that a small charge of 3 A becomes when a signed number of 16 bits is read as an unsigned one, plus 3 A [A]."""
STEP_A = 6.0
"""Current of a load step of the true cell: 2 C [A]."""


def without(block: SampleBlock, rows: np.ndarray) -> SampleBlock:
    """Return a block without some of its rows."""
    return np.delete(block, rows)


@pytest.mark.parametrize("glitch_a", [12.0, -12.0])
@pytest.mark.parametrize("run_length", [1, 2])
def test_absurd_currents_leave_the_estimate_of_a_run_without_their_samples(glitch_a: float, run_length: int) -> None:
    block, _ = pulses(0.9, hours=1.0)
    rows = np.concatenate([np.arange(30, 3500, 60) + n for n in range(run_length)])
    glitched = block.copy()
    glitched["current_a"][rows] = glitch_a
    estimator, expected = Estimator(TRUTH), Estimator(TRUTH)
    trace, expected_trace = estimator.run(glitched), expected.run(without(block, rows))
    assert trace.tobytes() == expected_trace.tobytes()
    assert estimator.state["dropped_contradicted"][0] == rows.size
    assert expected.state["dropped_contradicted"][0] == 0
    assert estimator.record["checks"]["suspects"][0] & InputFault.OUTLIERS


def test_doubtful_samples_leave_the_same_state_however_the_samples_are_divided() -> None:
    block, _ = pulses(0.9, hours=0.5)
    rng = np.random.default_rng(1)
    doubtful = rng.random(block.size) < 0.3
    block["current_a"][doubtful] = rng.choice([12.0, -12.0, 6.0, 65.53], int(doubtful.sum()))
    estimator = run_divided(lambda: Estimator(TRUTH), block)
    state = estimator.state[0]
    assert state["dropped_contradicted"] > 0
    waiting = estimator.record[0]["current_check"]["waiting"]
    assert (
        sum(state[name] for name in state.dtype.names if name.startswith("dropped_")) + state["samples"] + waiting
        == block.size
    )


@pytest.mark.parametrize("offset_a", WRAPPED_A.values(), ids=WRAPPED_A)
@pytest.mark.parametrize("capacity_ah", [100.0, 280.0])
def test_a_small_charge_that_wraps_around_is_not_integrated(offset_a: float, capacity_ah: float) -> None:
    block = np.zeros(600, SAMPLE)
    block["time_s"], block["temperature_c"] = np.arange(600.0), 25.0
    block["current_a"] = np.where(block["time_s"] % 60 == 30, offset_a - 3.0, -3.0)
    block["voltage_v"] = 53.0
    estimator = Estimator(load_cell("lfp", capacity_ah).pack(16, 1), initial_soc=0.5, voltage_resolution_v=0.1)
    estimator.run(block)
    counted = 0.5 + 3.0 * 599.0 / (3600.0 * capacity_ah)
    assert estimator.state["soc_coulomb"][0] == pytest.approx(counted, abs=1e-9)


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_a_current_around_zero_that_often_wraps_around_is_not_integrated(share: float) -> None:
    block = np.zeros(3600, SAMPLE)
    block["time_s"], block["temperature_c"], block["voltage_v"] = np.arange(3600.0), 25.0, 53.0
    wraps = np.random.default_rng(1).random(block.size) < share
    wraps[0] = False
    block["current_a"] = np.where(wraps, 655.35, 0.0)
    estimator = Estimator(load_cell("lfp", 100.0).pack(16, 1), initial_soc=0.5)
    estimator.run(block)
    assert estimator.state["soc_coulomb"][0] == 0.5
    assert estimator.state["dropped_contradicted"][0] == wraps.sum()
    assert estimator.record["checks"]["suspects"][0] & InputFault.OUTLIERS


def test_a_load_near_the_end_of_the_range_counts_once_the_voltage_follows() -> None:
    estimator = Estimator(load_cell("lfp", 100.0).pack(16, 1), initial_soc=0.5)
    estimator.step(0.0, 0.0, 53.0)
    assert estimator.step(1.0, 650.0, 53.0) is SampleOutcome.CONTRADICTED
    assert estimator.step(2.0, 650.0, 50.0) is SampleOutcome.ACCEPTED
    assert estimator.state["soc_coulomb"][0] == pytest.approx(0.5 - 650.0 / (3600.0 * 100.0))


@pytest.mark.parametrize("length", [1, 2, 60])
@pytest.mark.parametrize("late", [0, 1])
def test_a_load_step_counts_completely_even_if_the_voltage_is_one_sample_late(length: int, late: int) -> None:
    current_a = np.zeros(300)
    current_a[100 : 100 + length] = STEP_A
    block, _ = measured(current_a, 0.6, np.random.default_rng(1))
    block["voltage_v"][late:] = block["voltage_v"][: block.size - late].copy()
    estimator = Estimator(TRUTH, initial_soc=0.6)
    estimator.run(block)
    assert estimator.state["dropped_contradicted"][0] == 0
    assert estimator.state["samples"][0] == block.size
    counted_as = 0.5 * float((current_a[1:] + current_a[:-1]).sum())
    assert 3600.0 * 3.0 * (0.6 - estimator.state["soc_coulomb"][0]) == pytest.approx(counted_as, rel=0.3 * late + 1e-9)


def test_a_level_that_persists_is_believed_after_three_samples() -> None:
    estimator = Estimator(TRUTH, initial_soc=0.6)
    for time_s in range(10):
        estimator.step(float(time_s), 0.0, 3.7)
    outcomes = [estimator.step(10.0 + n, STEP_A + 0.5 * n, 3.7) for n in range(4)]
    assert outcomes == [SampleOutcome.CONTRADICTED] * 2 + [SampleOutcome.ACCEPTED] * 2
    assert estimator.state["dropped_contradicted"][0] == 0
    assert estimator.state["samples"][0] == 14
    counted_as = 0.5 * STEP_A + 3.0 * (STEP_A + 0.75)
    assert 3600.0 * 3.0 * (0.6 - estimator.state["soc_coulomb"][0]) == pytest.approx(counted_as, rel=1e-9)


@pytest.mark.parametrize("status", [SampleStatus.VOLTAGE_HELD, SampleStatus.CURRENT_HELD])
def test_a_held_value_is_no_evidence(status: SampleStatus) -> None:
    estimator = Estimator(TRUTH, initial_soc=0.6)
    estimator.step(0.0, 0.0, 3.7)
    assert estimator.step(1.0, STEP_A, 3.7, int(status)) is SampleOutcome.ACCEPTED


def test_after_a_gap_the_voltage_is_no_evidence() -> None:
    estimator = Estimator(TRUTH, initial_soc=0.6)
    estimator.step(0.0, 0.0, 3.7)
    estimator.step(1.0, 0.0, 3.7)
    assert estimator.step(61.0, STEP_A, 3.7) is SampleOutcome.ACCEPTED


def test_samples_that_wait_at_a_new_time_base_are_rejected() -> None:
    estimator = Estimator(TRUTH, initial_soc=0.6)
    estimator.step(0.0, 0.0, 3.7)
    assert estimator.step(1.0, STEP_A, 3.7) is SampleOutcome.CONTRADICTED
    estimator.resume(60.0)
    assert estimator.step(0.0, STEP_A, 3.7) is SampleOutcome.ACCEPTED
    assert estimator.state["dropped_contradicted"][0] == 1
