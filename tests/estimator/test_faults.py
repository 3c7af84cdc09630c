"""Invalid input: the estimate stays finite, diagnostics report the fault, and the SOC becomes correct again."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import SAMPLE, SampleBlock
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.cell_sections import TableOcv
from bms_estimator.model.input_faults import InputFault
from bms_estimator.sources.captures.replay import load_capture
from tests.estimator.simulated_cell import TRUTH, pulses

FAULT_S = 3600.0, 7200.0
"""Start and end of the fault after the first sample [s]."""
CAPACITY_AH = 3.0
FIRST_SOC = {"cell1_random_steps": 0.98, "cell5_hppc": 0.98}
"""Initial SOC of captures that start neither full nor empty."""
CHANGING_LOADS = [
    "cell5_random_steps",
    *(pytest.param(name, marks=pytest.mark.thorough) for name in ("cell1_dst", "cell1_hppc")),
]
BLOCK_SAMPLES = 20
"""Number of samples between two evaluations of the diagnostics."""
Fault = Callable[[SampleBlock, np.ndarray], None]


def leave_unchanged(block: SampleBlock, during: np.ndarray) -> None:
    """Leave the samples unchanged."""


def reverse_current(block: SampleBlock, during: np.ndarray) -> None:
    """Reverse the sign of the current, as a sensor with swapped terminals."""
    block["current_a"][during] *= -1.0


def add_offset(block: SampleBlock, during: np.ndarray) -> None:
    """Add an offset of 1 % of a range of 5 A."""
    block["current_a"][during] += 0.05


def random_samples(during: np.ndarray) -> np.ndarray:
    """Return a mask of 1 % of the samples of ``during``."""
    return during & (np.random.default_rng(1).random(during.size) < 0.01)


def add_voltage_glitches(block: SampleBlock, during: np.ndarray) -> None:
    """Replace 1 % of the voltages by 2.6 V, which is within the range of the cell."""
    block["voltage_v"][random_samples(during)] = 2.6


def add_current_spikes(block: SampleBlock, during: np.ndarray) -> None:
    """Replace 1 % of the currents by 4.6 A, which is within the range of the sensor."""
    block["current_a"][random_samples(during)] = 4.6


def hold_voltage(block: SampleBlock, during: np.ndarray) -> None:
    """Hold the first voltage, as with a broken wire or a device that repeats an old value."""
    block["voltage_v"][during] = block["voltage_v"][np.argmax(during)]


def set_current_to_zero(block: SampleBlock, during: np.ndarray) -> None:
    """Set the current to zero, as a failed current sensor would."""
    block["current_a"][during] = 0.0


def repeat_time_stamps(block: SampleBlock, during: np.ndarray) -> None:
    """Replace every second time stamp by the previous one."""
    every_second = np.flatnonzero(during)[1::2]
    block["time_s"][every_second] = block["time_s"][every_second - 1]


@cache
def load_samples(path: Path) -> SampleBlock:
    """Return the samples of a capture file."""
    return load_capture(path).rows


class Run:
    """Run of an estimator over a capture with a fault: time [s], error of the SOC, its std, and diagnostics.

    The true SOC is counted. The initial SOC of the estimator is wrong by ``soc_error``.
    """

    def __init__(self, path: Path, cell: CellModel, fault: Fault = leave_unchanged, soc_error: float = -0.2) -> None:
        block = load_samples(path).copy()
        block = block[(block["voltage_v"] > 2.0) & (block["voltage_v"] < 4.4)]
        elapsed_s = block["time_s"] - block["time_s"][0]
        step_s = np.clip(np.diff(elapsed_s), 0.0, None)
        discharged_ah = np.r_[0.0, np.cumsum(block["current_a"][:-1] * step_s)] / 3600.0
        first_soc = FIRST_SOC.get(path.name.partition(".")[0], 1.0 if block["voltage_v"][0] > 4.0 else 0.0)
        true_soc = first_soc - discharged_ah / CAPACITY_AH
        fault(block, (elapsed_s >= FAULT_S[0]) & (elapsed_s < FAULT_S[1]))
        self.estimator = Estimator(cell, initial_soc=min(max(true_soc[0] + soc_error, 0.0), 1.0))
        traces, suspects = [], []
        for first in range(0, block.size, BLOCK_SAMPLES):
            traces.append(self.estimator.run(block[first : first + BLOCK_SAMPLES]).copy())
            suspects += [int(self.estimator.record["checks"]["suspects"][0])] * traces[-1].size
        trace = np.concatenate(traces)
        self.time_s, self.suspects = trace["time_s"] - block["time_s"][0], np.array(suspects)
        self.soc = np.interp(trace["time_s"], block["time_s"], true_soc)
        self.error, self.std = trace["soc"] - self.soc, trace["soc_std"]

    def after(self, time_s: float) -> np.ndarray:
        """Return a mask of the samples after ``time_s`` [s] whose true SOC is above 0.05."""
        return (self.time_s > time_s) & (self.soc > 0.05)

    def coverage(self, after_s: float = 900.0) -> float:
        """Return the fraction of samples after ``after_s`` [s] whose error is within two std."""
        judged = self.after(after_s)
        return float(np.mean(np.abs(self.error[judged]) < 2.0 * self.std[judged]))


@cache
def run_with_fault_of_an_hour(fault: Fault, path: Path) -> Run:
    """Return the run over a capture with ``fault`` from the first to the second hour."""
    return Run(path, TRUTH, fault)


@pytest.fixture
def captures(shared_data: Path) -> Path:
    """Return the folder of the captures of NCR18650 cells."""
    return shared_data / "ncr18650"


def capture(captures: Path, name: str) -> Path:
    """Return the path of a capture."""
    return captures / f"{name}.csv.gz"


@pytest.mark.parametrize("name", CHANGING_LOADS)
@pytest.mark.parametrize(
    "fault",
    [
        reverse_current,
        add_offset,
        add_voltage_glitches,
        add_current_spikes,
        repeat_time_stamps,
        hold_voltage,
        set_current_to_zero,
    ],
)
def test_the_soc_recovers_after_an_hour_of_bad_input(captures: Path, name: str, fault: Fault) -> None:
    """The SOC is correct again within an hour of valid input, and stays correct."""
    run = run_with_fault_of_an_hour(fault, capture(captures, name))
    assert np.isfinite(run.error).all()
    assert np.abs(run.error[run.after(FAULT_S[1] + 3600.0)]).max() < 0.025
    assert run.coverage() > 0.95


@pytest.mark.parametrize("name", CHANGING_LOADS)
@pytest.mark.parametrize(
    ("fault", "suspect"),
    [
        (reverse_current, InputFault.SIGN_OF_CURRENT),
        (add_voltage_glitches, InputFault.OUTLIERS),
        (hold_voltage, InputFault.VOLTAGE),
        (set_current_to_zero, InputFault.CURRENT),
    ],
)
def test_a_temporary_fault_is_reported_and_then_cleared(
    captures: Path, name: str, fault: Fault, suspect: InputFault
) -> None:
    run = run_with_fault_of_an_hour(fault, capture(captures, name))
    reported = run.suspects & suspect != 0
    assert reported[(run.time_s > FAULT_S[0]) & (run.time_s < FAULT_S[1])].any()
    assert not reported[run.time_s < FAULT_S[0]].any()
    assert run.suspects[-1] == 0


@pytest.mark.parametrize("name", CHANGING_LOADS)
@pytest.mark.parametrize("offset_a", [0.05, -0.05])
def test_an_offset_of_the_current_is_learned(captures: Path, name: str, offset_a: float) -> None:
    """The offset is 1 % of a range of 5 A and shifts the counted SOC by 1.7 % in an hour."""

    def add_offset_throughout(block: SampleBlock, _: np.ndarray) -> None:
        block["current_a"] += offset_a

    run = Run(capture(captures, name), TRUTH, add_offset_throughout)
    assert np.abs(run.error[run.after(900.0)]).max() < 0.025
    assert run.coverage() > 0.95


@pytest.mark.parametrize("name", CHANGING_LOADS)
def test_an_implausible_offset_is_reported(captures: Path, name: str) -> None:
    def add_large_offset(block: SampleBlock, _: np.ndarray) -> None:
        block["current_a"] += 0.15

    run = Run(capture(captures, name), TRUTH, add_large_offset)
    assert run.suspects[-1] & (InputFault.OFFSET | InputFault.CAPACITY)
    assert np.abs(run.error[run.after(3600.0)]).max() < 0.03


@pytest.mark.parametrize("name", CHANGING_LOADS[:2])
def test_a_capacity_20_percent_too_small_is_reported(captures: Path, name: str) -> None:
    smaller = TRUTH.cell.model_copy(update={"capacity_ah": 0.8 * TRUTH.cell.capacity_ah})
    run = Run(capture(captures, name), TRUTH.model_copy(update={"cell": smaller}))
    assert run.suspects[-1] & InputFault.CAPACITY
    assert np.abs(run.error[run.after(3600.0)]).max() < 0.03
    assert run.coverage() > 0.95


@pytest.mark.parametrize("name", CHANGING_LOADS)
def test_the_ocv_of_another_chemistry_is_reported(captures: Path, name: str) -> None:
    """The cell file has the OCV of LFP, with a plateau at 3.3 V."""
    soc = np.linspace(0.0, 1.0, 51)
    plateau_v = 3.275 + 0.05 * soc + 0.1 * np.tanh((soc - 0.98) * 40.0) - 0.5 * np.exp(-25.0 * soc)
    table = TableOcv(form="table", soc=tuple(soc), ocv_v=tuple(plateau_v))
    run = Run(capture(captures, name), TRUTH.model_copy(update={"ocv": table}))
    assert run.suspects[-1] == InputFault.OCV


@pytest.mark.parametrize("soc_error", [-0.2, pytest.param(0.2, marks=pytest.mark.thorough)])
def test_captures_without_faults_cause_no_diagnostics(captures: Path, soc_error: float) -> None:
    for path in sorted(captures.glob("*.csv.gz")):
        run = Run(path, TRUTH, soc_error=soc_error)
        assert not run.suspects.any(), path.name


def test_captures_of_a_leaf_cause_no_diagnostics(data: Path) -> None:
    for name in ("hppc_25c_from_full", "cc_1c"):
        assert not Run(data / "leaf" / f"{name}.csv.gz", load_cell("leaf")).suspects.any()


def test_the_true_soc_is_inside_the_interval_after_a_gap_of_an_hour(captures: Path) -> None:
    """The current in the gap is unknown, so that the std grows."""
    block = load_capture(capture(captures, "cell5_random_steps")).rows
    elapsed_s = block["time_s"] - block["time_s"][0]
    before, after = elapsed_s < FAULT_S[0], elapsed_s >= FAULT_S[1]
    soc = 1.0 - np.r_[0.0, np.cumsum(block["current_a"][:-1] * np.diff(elapsed_s))] / 3600.0 / CAPACITY_AH
    estimator = Estimator(TRUTH, initial_soc=0.8)
    std_before = estimator.run(block[before])["soc_std"][-1]
    trace = estimator.run(block[after])
    error = trace["soc"] - soc[after]
    assert trace["soc_std"][0] > std_before
    assert np.mean(np.abs(error) < 2.0 * trace["soc_std"]) > 0.95
    assert np.abs(error[3600:][soc[after][3600:] > 0.05]).max() < 0.025


@pytest.fixture(scope="module")
def load() -> tuple[SampleBlock, np.ndarray]:
    """Return three hours of samples of the true cell from full, and the true SOC."""
    return pulses()


def test_the_estimate_recovers_after_hours_of_random_input(load) -> None:
    """Random input causes no overflow, and the SOC converges afterwards."""
    valid, true_soc = load[0].copy(), load[1]
    rng, garbage = np.random.default_rng(0), valid.copy()
    garbage["current_a"] = rng.normal(0.0, 1.0, garbage.size) ** 9
    garbage["voltage_v"] = rng.normal(3.0, 2.0, garbage.size) ** 5
    garbage["temperature_c"] = rng.normal(0.0, 100.0, garbage.size) ** 3
    estimator = Estimator(TRUTH, initial_soc=0.5)
    assert np.isfinite(estimator.run(garbage)["soc"]).all()
    valid["time_s"] += garbage["time_s"][-1] + 1.0
    trace = estimator.run(valid)
    assert np.isfinite(trace["soc_std"]).all()
    assert np.abs(trace["soc"] - true_soc)[5400:].max() < 0.05


def test_a_non_finite_value_restores_the_last_good_state(load) -> None:
    block, true_soc = load
    estimator = Estimator(TRUTH, initial_soc=0.9)
    estimator.run(block[:3000])
    before = float(estimator.state["soc"][0])
    for field in ("mean", "covariance", "rms_a2", "temperature_c"):
        estimator.record["filter"][field][0] = np.nan
    estimator.run(block[3000:3002])
    assert estimator.record["counters"]["reset"][0] == 1
    assert estimator.state["soc"][0] == pytest.approx(before, abs=0.05)
    trace = estimator.run(block[3002:])
    assert estimator.record["counters"]["reset"][0] == 1
    assert abs(trace["soc"][-1] - true_soc[-1]) < 0.015


def test_two_outliers_are_rejected_but_a_lasting_change_of_the_voltage_is_accepted(load) -> None:
    block = load[0][:1000].copy()
    block["voltage_v"][500:502] = 2.6  # two outliers
    clean, glitched = Estimator(TRUTH, initial_soc=0.95), Estimator(TRUTH, initial_soc=0.95)
    clean.run(load[0][:1000])
    glitched.run(block)
    assert glitched.record["counters"][0].tolist() == (2, 0, 0)  # gated, reopened, reset
    assert glitched.state["soc"][0] == pytest.approx(clean.state["soc"][0], abs=1e-3)
    block["voltage_v"][500:] = 2.9  # a new level
    shifted = Estimator(TRUTH, initial_soc=0.95)
    shifted.run(block)
    assert shifted.record["counters"]["gated"][0] == 4  # the fifth successive sample is accepted
    assert shifted.record["counters"]["reopened"][0] == 1


def test_every_diagnostic_contains_a_remedy() -> None:
    for suspect in InputFault:
        assert "check" in suspect.text
    both = InputFault.OFFSET | InputFault.CAPACITY
    assert InputFault.OFFSET.text in both.text
    assert InputFault.CAPACITY.text in both.text
    assert not InputFault(0).text


@pytest.mark.parametrize("wrong_c", [-127.0, -300.0, 850.0, np.inf])
def test_an_implausible_temperature_is_ignored(wrong_c: float) -> None:
    block = pulses()[0][:1200]
    block["temperature_c"][600:] = np.nan
    without_temperature = Estimator(TRUTH, initial_soc=0.9).run(block.copy())
    block["temperature_c"][600:] = wrong_c
    trace = Estimator(TRUTH, initial_soc=0.9).run(block)
    assert np.array_equal(trace["soc"], without_temperature["soc"])
    assert np.array_equal(trace["soc_std"], without_temperature["soc_std"])


def small_loads_of_a_large_pack(days: float) -> SampleBlock:
    """Return samples every 10 s of a cell of 20 Ah whose load changes every 10 min: the voltage changes by less than its noise."""
    rng, steps = np.random.default_rng(2), int(days * 8640.0)
    block = np.zeros(steps, dtype=SAMPLE)
    block["time_s"], block["temperature_c"] = 10.0 * np.arange(steps), 25.0
    current_a = np.repeat(rng.gamma(1.5, 0.2, steps // 60 + 1), 60)[:steps]
    current_a -= current_a.mean()
    block["current_a"] = np.round(current_a, 2)
    voltage_v = 3.3 - 0.0008 * current_a + 0.001 * rng.standard_normal(steps)
    block["voltage_v"] = np.round(voltage_v, 3)
    return block


@pytest.mark.parametrize("fault", [leave_unchanged, reverse_current])
def test_noise_of_the_voltage_is_no_fault_of_the_current_s_sign(fault: Fault) -> None:
    """The noise alone does not show a wrong sign. A load of 10 A, whose changes exceed the noise, shows it."""
    block = small_loads_of_a_large_pack(days=6.0)
    if fault is reverse_current:
        block["voltage_v"] -= 0.0008 * 20.0 * block["current_a"]
        block["current_a"] *= 20.0
        fault(block, np.ones(block.size, dtype=bool))
    estimator, suspects = Estimator(load_cell("lfp", 20.0)), 0
    for first in range(0, block.size, BLOCK_SAMPLES):
        estimator.run(block[first : first + BLOCK_SAMPLES])
        suspects |= int(estimator.record["checks"]["suspects"][0])
    assert bool(suspects & InputFault.SIGN_OF_CURRENT) == (fault is reverse_current)
