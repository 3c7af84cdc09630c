"""Invalid input: the estimate stays finite, diagnostics report the fault, and the estimate recovers."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from bms_estimator import Estimator, load_capture, load_cell
from bms_estimator.model.cell import CellModel, TableOcv
from bms_estimator.model.input_faults import InputFault
from bms_estimator.model.sample import SampleBlock
from tests.estimator.simulated_cell import TRUTH, pulses

FAULT_S = 3600.0, 7200.0
"""Start and end of the fault after the first sample [s]."""
CAPACITY_AH = 3.0
FIRST_SOC = {"cell1_random_steps": 0.98, "cell5_hppc": 0.98}
"""Initial SOC of captures that do not start full."""
CHANGING = ["cell5_random_steps", "cell1_dst", "cell1_hppc"]
PIECE = 20
"""Number of samples between two evaluations of the diagnostics."""
Fault = Callable[[SampleBlock, np.ndarray], None]


def good(block: SampleBlock, during: np.ndarray) -> None:
    """Return the samples without a fault."""


def flipped(block: SampleBlock, during: np.ndarray) -> None:
    block["current_a"][during] *= -1.0


def offset(block: SampleBlock, during: np.ndarray) -> None:
    """Return samples with an offset of 1 % of a range of 5 A."""
    block["current_a"][during] += 0.05


def now_and_then(during: np.ndarray) -> np.ndarray:
    return during & (np.random.default_rng(1).random(during.size) < 0.01)


def glitches(block: SampleBlock, during: np.ndarray) -> None:
    """Return samples with voltage glitches within the range of the cell."""
    block["voltage_v"][now_and_then(during)] = 2.6


def spikes(block: SampleBlock, during: np.ndarray) -> None:
    block["current_a"][now_and_then(during)] = 4.6


def stuck(block: SampleBlock, during: np.ndarray) -> None:
    """Return a capture with a stuck voltage: a broken wire, or an old value repeated."""
    block["voltage_v"][during] = block["voltage_v"][np.argmax(during)]


def dead(block: SampleBlock, during: np.ndarray) -> None:
    """Return samples of a dead current sensor."""
    block["current_a"][during] = 0.0


def repeated(block: SampleBlock, during: np.ndarray) -> None:
    """Return samples in which every second time stamp repeats the previous one."""
    twice = np.flatnonzero(during)[1::2]
    block["time_s"][twice] = block["time_s"][twice - 1]


rows = cache(lambda path: load_capture(path).rows)
"""Samples of a capture file."""


class Run:
    """Run over a capture with a fault and an initial SOC 0.2 too low: time [s], error of the SOC, std, diagnostics."""

    def __init__(self, path: Path, cell: CellModel, fault: Fault = good, wrong: float = -0.2) -> None:
        block = rows(path).copy()
        block = block[(block["voltage_v"] > 2.0) & (block["voltage_v"] < 4.4)]
        when_s = block["time_s"] - block["time_s"][0]
        moved_ah = np.r_[0.0, np.cumsum(block["current_a"][:-1] * np.clip(np.diff(when_s), 0.0, None))] / 3600.0
        self.soc = FIRST_SOC.get(path.name.partition(".")[0], 1.0 if block["voltage_v"][0] > 4.0 else 0.0)
        self.soc = self.soc - moved_ah / CAPACITY_AH
        fault(block, (when_s >= FAULT_S[0]) & (when_s < FAULT_S[1]))
        self.estimator = Estimator(cell, initial_soc=min(max(self.soc[0] + wrong, 0.0), 1.0))
        traces, suspects = [], []
        for first in range(0, block.size, PIECE):
            traces.append(self.estimator.run(block[first : first + PIECE]).copy())
            suspects += [int(self.estimator.record["checks"]["suspects"][0])] * traces[-1].size
        trace = np.concatenate(traces)
        self.time_s, self.suspects = trace["time_s"] - block["time_s"][0], np.array(suspects)
        self.soc = np.interp(trace["time_s"], block["time_s"], self.soc)
        self.error, self.std = trace["soc"] - self.soc, trace["soc_std"]

    def after(self, time_s: float) -> np.ndarray:
        return (self.time_s > time_s) & (self.soc > 0.05)

    def covered(self, after_s: float = 900.0) -> float:
        """Return the share of samples whose error is within two std."""
        judged = self.after(after_s)
        return float(np.mean(np.abs(self.error[judged]) < 2.0 * self.std[judged]))


@cache
def run_with_hour_of(fault: Fault, path: Path) -> Run:
    """Return the run over a capture with this fault."""
    return Run(path, TRUTH, fault)


@pytest.fixture
def captures(shared_data: Path) -> Path:
    return shared_data / "ncr18650"


def capture(captures: Path, name: str) -> Path:
    return captures / f"{name}.csv.gz"


@pytest.mark.parametrize("name", CHANGING)
@pytest.mark.parametrize("fault", [flipped, offset, glitches, spikes, repeated, stuck, dead])
def test_the_soc_recovers_after_an_hour_of_bad_input(captures: Path, name: str, fault: Fault) -> None:
    """The SOC is correct again within an hour of good input, and stays correct."""
    run = run_with_hour_of(fault, capture(captures, name))
    assert np.isfinite(run.error).all()
    assert np.abs(run.error[run.after(FAULT_S[1] + 3600.0)]).max() < 0.025
    assert run.covered() > (0.9 if fault is flipped else 0.95)


@pytest.mark.parametrize("name", CHANGING)
@pytest.mark.parametrize(
    ("fault", "suspect"),
    [
        (flipped, InputFault.SIGN_OF_CURRENT),
        (glitches, InputFault.OUTLIERS),
        (stuck, InputFault.VOLTAGE),
        (dead, InputFault.CURRENT),
    ],
)
def test_a_temporary_fault_is_reported_and_then_cleared(
    captures: Path, name: str, fault: Fault, suspect: InputFault
) -> None:
    run = run_with_hour_of(fault, capture(captures, name))
    named = run.suspects & suspect != 0
    assert named[(run.time_s > FAULT_S[0]) & (run.time_s < FAULT_S[1])].any()
    assert not named[run.time_s < FAULT_S[0]].any()
    assert run.suspects[-1] == 0


@pytest.mark.parametrize("name", CHANGING)
@pytest.mark.parametrize("offset_a", [0.05, -0.05])
def test_an_offset_of_the_current_is_learned(captures: Path, name: str, offset_a: float) -> None:
    """1 % of a range of 5 A: 1.7 % of the capacity in an hour."""

    def off(block: SampleBlock, _: np.ndarray) -> None:
        block["current_a"] += offset_a

    run = Run(capture(captures, name), TRUTH, off)
    assert np.abs(run.error[run.after(900.0)]).max() < 0.025
    assert run.covered() > 0.95


@pytest.mark.parametrize("name", CHANGING)
def test_an_implausible_offset_is_reported(captures: Path, name: str) -> None:
    def off(block: SampleBlock, _: np.ndarray) -> None:
        block["current_a"] += 0.15

    run = Run(capture(captures, name), TRUTH, off)
    assert run.suspects[-1] & (InputFault.OFFSET | InputFault.CAPACITY)
    assert np.abs(run.error[run.after(3600.0)]).max() < 0.03


@pytest.mark.parametrize("name", ["cell5_random_steps", "cell1_dst"])
def test_a_capacity_20_percent_too_small_is_reported(captures: Path, name: str) -> None:
    smaller = TRUTH.cell.model_copy(update={"capacity_ah": 0.8 * TRUTH.cell.capacity_ah})
    run = Run(capture(captures, name), TRUTH.model_copy(update={"cell": smaller}))
    assert run.suspects[-1] & InputFault.CAPACITY
    assert np.abs(run.error[run.after(3600.0)]).max() < 0.03
    assert run.covered() > 0.95


@pytest.mark.parametrize("name", CHANGING)
def test_the_ocv_of_another_chemistry_is_reported(captures: Path, name: str) -> None:
    """The wrong curve is that of LFP, with a plateau at 3.3 V."""
    soc = np.linspace(0.0, 1.0, 51)
    plateau_v = 3.275 + 0.05 * soc + 0.1 * np.tanh((soc - 0.98) * 40.0) - 0.5 * np.exp(-25.0 * soc)
    table = TableOcv(form="table", soc=tuple(soc), ocv_v=tuple(plateau_v))
    run = Run(capture(captures, name), TRUTH.model_copy(update={"ocv": table}))
    assert run.suspects[-1] == InputFault.OCV


@pytest.mark.parametrize("wrong", [-0.2, pytest.param(0.2, marks=pytest.mark.thorough)])
def test_good_captures_cause_no_diagnostics(captures: Path, wrong: float) -> None:
    for path in sorted(captures.glob("*.csv.gz")):
        run = Run(path, TRUTH, wrong=wrong)
        assert not run.suspects.any(), path.name


def test_captures_of_a_leaf_cause_no_diagnostics(data: Path) -> None:
    for name in ("hppc_25c_from_full", "cc_1c"):
        assert not Run(data / "leaf" / f"{name}.csv.gz", load_cell("leaf")).suspects.any()


def test_the_true_soc_is_inside_the_interval_after_a_gap_of_an_hour(captures: Path) -> None:
    """The current in the gap is unknown, and the std includes that."""
    block = load_capture(capture(captures, "cell5_random_steps")).rows
    when_s = block["time_s"] - block["time_s"][0]
    before, after = when_s < FAULT_S[0], when_s >= FAULT_S[1]
    soc = 1.0 - np.r_[0.0, np.cumsum(block["current_a"][:-1] * np.diff(when_s))] / 3600.0 / CAPACITY_AH
    estimator = Estimator(TRUTH, initial_soc=0.8)
    known = estimator.run(block[before])["soc_std"][-1]
    trace = estimator.run(block[after])
    error = trace["soc"] - soc[after]
    assert trace["soc_std"][0] > known
    assert np.mean(np.abs(error) < 2.0 * trace["soc_std"]) > 0.95
    assert np.abs(error[3600:][soc[after][3600:] > 0.05]).max() < 0.025


@pytest.fixture(scope="module")
def load() -> tuple[SampleBlock, np.ndarray]:
    return pulses()


def test_the_estimate_recovers_after_hours_of_random_input(load) -> None:
    """Random input causes no overflow, and the SOC converges afterwards."""
    rng, garbage = np.random.default_rng(0), load[0].copy()
    garbage["current_a"] = rng.normal(0.0, 1.0, garbage.size) ** 9
    garbage["voltage_v"] = rng.normal(3.0, 2.0, garbage.size) ** 5
    garbage["temperature_c"] = rng.normal(0.0, 100.0, garbage.size) ** 3
    estimator = Estimator(TRUTH, initial_soc=0.5)
    assert np.isfinite(estimator.run(garbage)["soc"]).all()
    back = load[0].copy()
    back["time_s"] += garbage["time_s"][-1] + 1.0
    trace = estimator.run(back)
    assert np.isfinite(trace["soc_std"]).all()
    assert np.abs(trace["soc"] - load[1])[5400:].max() < 0.05


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


def test_single_outliers_are_rejected_but_a_new_level_is_accepted(load) -> None:
    block = load[0][:1000].copy()
    block["voltage_v"][500:502] = 2.6
    clean, glitched = Estimator(TRUTH, initial_soc=0.95), Estimator(TRUTH, initial_soc=0.95)
    clean.run(load[0][:1000])
    glitched.run(block)
    assert glitched.record["counters"][0].tolist() == (2, 0, 0)
    assert glitched.state["soc"][0] == pytest.approx(clean.state["soc"][0], abs=1e-3)
    block["voltage_v"][500:] = 2.9
    moved = Estimator(TRUTH, initial_soc=0.95)
    moved.run(block)
    assert moved.record["counters"]["gated"][0] == 4
    assert moved.record["counters"]["reopened"][0] == 1


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
    without = Estimator(TRUTH, initial_soc=0.9).run(block.copy())
    block["temperature_c"][600:] = wrong_c
    trace = Estimator(TRUTH, initial_soc=0.9).run(block)
    assert np.array_equal(trace["soc"], without["soc"])
    assert np.array_equal(trace["soc_std"], without["soc_std"])
