"""Gaps that hide a charge or an exchange of the pack, and estimates of the cell that are held through them."""

from dataclasses import replace

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.kalman_filter.hypotheses import spawn_after_gap, spawn_hypotheses
from bms_estimator.kernels.kalman_filter.records import LN_Q, LN_R, NODE, Noise
from bms_estimator.model.arrays import Floats, SampleBlock
from bms_estimator.model.cell import load_cell
from bms_estimator.model.cell_sections import TableOcv
from bms_estimator.model.input_faults import InputFault
from bms_estimator.settings.observer import Sampling
from tests.estimator.anywhere.cases import OXIDE, PHOSPHATE, Capture, Case, capture
from tests.estimator.anywhere.cycles import Cycle, true_curve
from tests.estimator.anywhere.use import DAY_S, days
from tests.estimator.simulated_cell import TRUTH, measured, simulate_file

CASES = {
    "oxide": Case("", file_temperatures_c="generic", load_before_h=0.0, seed=41),
    "LFP": Case("", PHOSPHATE, file_temperatures_c=(25.0, 5.0), load_before_h=0.0, seed=42),
}
"""Drives from rest, with the generic cell file or with a file of the cell's type."""
HALF_HOUR_S = 1800


def drive(case: Case, soc: float, hours: float) -> Capture:
    """Return the capture of a drive from ``soc``."""
    return capture(replace(case, soc=soc, hours=hours))


def joined(first: SampleBlock, second: SampleBlock, gap_s: float) -> SampleBlock:
    """Return both blocks with ``gap_s`` between the last sample of the first and the first sample of the second."""
    second = second.copy()
    second["time_s"] += first["time_s"][-1] + gap_s - second["time_s"][0]
    return np.concatenate([first, second])


def cell_estimates(estimator: Estimator) -> tuple[Floats, Floats]:
    """Return capacity and OCV nodes of the likeliest hypothesis, and their variances."""
    f = estimator.record[0]["filter"]
    states = np.r_[LN_Q, NODE : f["mean"].shape[1]]
    return f["mean"][f["best"], states].copy(), np.diagonal(f["covariance"][f["best"]])[states].copy()


@pytest.mark.parametrize("gap_s", [60.0, 600.0, 7200.0])
@pytest.mark.parametrize("kind", CASES)
def test_a_full_pack_after_a_gap_is_recognized(kind: str, gap_s: float) -> None:
    """A nearly empty pack is exchanged or charged in the gap. A charge of two hours is no exchange."""
    before, after = drive(CASES[kind], 0.45, hours=0.6), drive(CASES[kind], 1.0, hours=1.3)
    estimator = Estimator(before.cell, initial_soc=0.45)
    trace = estimator.run(joined(before.samples, after.samples, gap_s))[before.samples.size :]
    error = np.abs(trace["soc"] - after.soc)[HALF_HOUR_S:]
    assert (error < 2.0 * trace["soc_std"][HALF_HOUR_S:]).mean() > 0.95
    assert np.sqrt(np.mean(error**2)) < 0.05
    suspects = InputFault(int(estimator.record["checks"]["suspects"][0]))
    assert (InputFault.PACK in suspects) == (gap_s < 3600.0)


def test_a_short_gap_early_in_the_search_keeps_what_is_known() -> None:
    """The std of the SOC is 6 to 20 %: one hypothesis continues with the biases and polarization from before the gap."""
    capture_of_drive = drive(CASES["LFP"], 0.6, hours=0.5)
    samples, start, gap_s = capture_of_drive.samples, 600, 70
    estimator = Estimator(capture_of_drive.cell, initial_soc=0.5)
    before = estimator.run(samples[:start])[-1].copy()
    assert 0.07 < before["soc_std"] < 0.18
    after = estimator.run(samples[start + gap_s : start + gap_s + 5])[-1]
    assert after["soc_std"] < 1.1 * before["soc_std"]


@pytest.mark.parametrize("gap_s", [60.0, 600.0])
@pytest.mark.parametrize("kind", CASES)
def test_a_loss_of_samples_while_parked_does_not_change_the_soc(kind: str, gap_s: float) -> None:
    """On a plateau the voltage cannot exclude another SOC, so that the SOC before the gap remains likely."""
    case = replace(CASES[kind], soc=0.75, hours=2.0)
    parked = capture(case, np.r_[drive(case, 0.75, hours=0.5).samples["current_a"], np.zeros(5400)])
    estimator = Estimator(parked.cell, initial_soc=0.75)
    start = 4000
    before = estimator.run(parked.samples[:start])[-1].copy()
    after = estimator.run(parked.samples[start + round(gap_s) :])[60:]
    assert np.abs(after["soc"] - before["soc"]).max() < before["soc_std"]
    assert after["soc_std"].max() < 2.0 * before["soc_std"]
    assert InputFault.PACK not in InputFault(int(estimator.record["checks"]["suspects"][0]))


def test_an_soc_set_by_the_user_ends_the_diagnostic_of_an_exchange() -> None:
    before, after = drive(CASES["oxide"], 0.45, hours=0.6), drive(CASES["oxide"], 1.0, hours=1.0)
    estimator = Estimator(before.cell, initial_soc=0.45)
    samples = joined(before.samples, after.samples, 600.0)
    estimator.run(samples[:-100])
    assert InputFault.PACK in InputFault(int(estimator.record["checks"]["suspects"][0]))
    estimator.set_soc(float(after.soc[-100]))
    estimator.run(samples[-100:])
    assert InputFault.PACK not in InputFault(int(estimator.record["checks"]["suspects"][0]))


def test_capacity_and_ocv_are_learned_in_the_first_pass_of_the_curve_and_then_held() -> None:
    load_a = np.tile(np.repeat([0.5, -0.5], 4320), 2) * TRUTH.cell.capacity_ah  # 0.6 of the capacity each way
    block = measured(load_a, 0.9, np.random.default_rng(1))[0]
    estimator = Estimator(load_cell("nca", TRUTH.cell.capacity_ah), initial_soc=0.9)
    estimator.run(block[:7000])
    assert cell_estimates(estimator)[0].any()
    estimator.run(block[7000:8640])
    assert estimator.record[0]["filter"]["learned_soc"] == Noise().learning_soc
    mean, variance = cell_estimates(estimator)
    estimator.run(block[8640:])
    held_mean, held_variance = cell_estimates(estimator)
    assert held_mean == pytest.approx(mean, rel=1e-2)  # LN_Q decays slowly because of aging
    assert (held_variance >= variance).all()


def test_capacity_and_ocv_are_not_learned_after_a_gap() -> None:
    before, after = drive(CASES["oxide"], 0.8, hours=1.0), drive(CASES["oxide"], 0.7, hours=1.0)
    estimator = Estimator(before.cell, initial_soc=0.8)
    samples = joined(before.samples, after.samples, 600.0)
    estimator.run(samples[: before.samples.size + 1])
    mean, variance = cell_estimates(estimator)
    estimator.run(samples[before.samples.size + 1 :])
    held_mean, held_variance = cell_estimates(estimator)
    assert held_mean == pytest.approx(mean, rel=1e-2)  # LN_Q decays slowly because of aging
    assert (held_variance >= variance).all()


def test_a_wrong_sign_of_the_current_does_not_change_held_estimates_of_the_cell() -> None:
    before, after = drive(CASES["oxide"], 0.8, hours=0.7), drive(CASES["oxide"], 0.7, hours=1.0)
    samples = joined(before.samples, after.samples, 600.0)
    begin = before.samples.size + 300
    samples["current_a"][begin : begin + 900] *= -1.0
    estimator = Estimator(before.cell, initial_soc=0.8)
    estimator.run(samples[:begin])
    mean, _ = cell_estimates(estimator)
    estimator.run(samples[begin : begin + 900])
    assert estimator.record["checks"]["suspects"][0] == InputFault.SIGN_OF_CURRENT
    estimator.run(samples[begin + 900 :])
    assert estimator.record["checks"]["suspects"][0] != InputFault.SIGN_OF_CURRENT
    assert cell_estimates(estimator)[0] == pytest.approx(mean, rel=1e-2)


def test_a_reinitialization_of_the_soc_does_not_change_estimates_of_the_cell() -> None:
    use = drive(CASES["oxide"], 0.8, hours=1.0)
    estimator = Estimator(use.cell, initial_soc=0.8)
    estimator.run(use.samples[:600])
    f, p = estimator.record[0]["filter"], estimator.settings_record[0]["filter"]
    f["learned_soc"] = Noise().learning_soc
    spawn_hypotheses(f, p, float(use.soc[600]) - 0.4, 0.01)
    mean, _ = cell_estimates(estimator)
    estimator.run(use.samples[600:3000])
    assert f["reopened"] >= 1
    assert cell_estimates(estimator)[0] == pytest.approx(mean, rel=1e-2)


def test_days_of_use_do_not_make_the_soc_overconfident() -> None:
    """The cell file is the generic one. Each pass of the curve shows the same errors of the file, and not new ones."""
    truth = replace(OXIDE, ocv_v=true_curve(Cycle("nca", "discharge", 1.0, 0.9)))
    current_a = days(np.random.default_rng(101), truth.capacity_ah, 4, 0.9)
    use = capture(Case("", truth, file_temperatures_c=(25.0,), load_before_h=0.0), current_a)
    estimator = Estimator(load_cell("nca", 1.01 * truth.capacity_ah), initial_soc=0.7)
    trace = estimator.run(use.samples)
    inside = np.abs(trace["soc"] - use.soc) < 2.0 * trace["soc_std"]
    assert inside[DAY_S : 2 * DAY_S].mean() > 0.95
    assert inside[2 * DAY_S :].mean() > 0.95


def test_a_resistance_learned_near_empty_is_less_certain_near_full() -> None:
    use = drive(CASES["oxide"], 0.4, hours=0.6)
    estimator = Estimator(use.cell, initial_soc=0.4)
    estimator.run(use.samples)
    f = estimator.record[0]["filter"]
    spawn_after_gap(f, estimator.settings_record[0]["filter"], np.inf, False)
    assert (np.diff(f["covariance"][2:, LN_R, LN_R]) > 0.0).all()


def test_an_empty_cell_rests_in_a_gap() -> None:
    """Near empty the voltage of the pack exceeds the generic curve by a std, as at a higher SOC. No load was possible in the gap."""
    generic = load_cell("lco", 2.0)
    assert isinstance(generic.ocv, TableOcv)
    above_v = np.interp(generic.ocv.soc, (0.0, 0.03, 0.15), (0.1, 0.1, 0.0))
    true_v = tuple((np.array(generic.ocv.ocv_v) + above_v).tolist())
    truth = generic.model_copy(update={"ocv": generic.ocv.model_copy(update={"ocv_v": true_v})})
    current_a = np.r_[np.zeros(600), np.full(1720, 4.0), np.zeros(2200), np.full(1200, -1.5)]
    samples, true_soc = simulate_file(truth, current_a, 0.98)
    after = 600 + 1720 + 2180
    kept = np.r_[: 600 + 1720 + 20, after : samples.size]
    estimator = Estimator(generic, initial_soc=0.98, sampling=Sampling(2.0))
    trace = estimator.run(samples[kept][::2])
    in_charge = trace["time_s"] >= after
    error = (trace["soc"] - np.interp(trace["time_s"], samples["time_s"], true_soc))[in_charge]
    assert np.sqrt(np.mean(error**2)) < 0.08
    assert (np.abs(error) < 2.0 * trace["soc_std"][in_charge]).mean() > 0.9
