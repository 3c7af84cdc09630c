"""Identifier and observer together: identified values limit the adaptive law, and are saved and restored."""

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.identified_parameters import fitted_parameter, present_elements
from bms_estimator.kernels.cell_model import chen_mora
from bms_estimator.kernels.identifier import set_adaptation_targets
from bms_estimator.kernels.kalman_filter.element_map import CAPACITANCES, ELEMENTS
from bms_estimator.kernels.kalman_filter.noise import offset_variance
from bms_estimator.kernels.kalman_filter.records import LN_Q, OFFSET, SOC
from bms_estimator.model.arrays import SampleBlock
from bms_estimator.settings.observer import IdentifierSettings, ObserverSettings
from tests.estimator.simulated_cell import TRUTH, pulses, run_divided, wrong_cell

IDENTIFIER = IdentifierSettings()
AFTER_HALF_AN_HOUR = slice(1800, None)
"""Samples at 1 Hz from half an hour on."""


@pytest.fixture(scope="module")
def load_and_soc() -> tuple[SampleBlock, np.ndarray]:
    """Return three hours of samples of the true cell from full at 1 Hz, and the true SOC."""
    return pulses()


def test_step_and_run_leave_the_same_record_to_the_last_bit(load_and_soc) -> None:
    block = load_and_soc[0][:3000].copy()
    block["temperature_c"] = np.where(
        block["time_s"] % 7.0 == 0.0, np.nan, 25.0 + 10.0 * np.sin(block["time_s"] / 300.0)
    )
    run_divided(lambda: Estimator(TRUTH, identifier=IDENTIFIER, initial_soc=0.8), block)


def test_a_wrong_soc_and_wrong_resistances_are_corrected(load_and_soc) -> None:
    block, true_soc = load_and_soc
    estimator = Estimator(wrong_cell(2.0), identifier=IDENTIFIER, initial_soc=0.8)
    trace = estimator.run(block)
    error = (trace["soc"] - true_soc)[AFTER_HALF_AN_HOUR]
    assert np.abs(error).max() < 0.04
    assert np.mean(np.abs(error) < 2.0 * trace["soc_std"][AFTER_HALF_AN_HOUR]) > 0.95
    # The counted SOC keeps the initial error.
    assert trace["soc_coulomb"][5000] == pytest.approx(true_soc[5000] - 0.2, abs=1e-3)
    elements, soc, a = present_elements(estimator.record[0]), true_soc[-1], TRUTH.a
    assert elements["r_s_ohm"].value == pytest.approx(chen_mora.r_s(soc, a), rel=0.05)
    for name, truth in (("r_ts_ohm", chen_mora.r_ts(soc, a)), ("r_tl_ohm", chen_mora.r_tl(soc, a))):
        assert abs(elements[name].value - truth) < 3.0 * elements[name].std
        assert elements[name].relative_std < 0.4


def test_parameters_of_the_adaptive_law_converge_to_the_identified_values(load_and_soc) -> None:
    estimator = Estimator(wrong_cell(2.0), identifier=IDENTIFIER, initial_soc=0.8)
    estimator.run(load_and_soc[0])
    record, a = estimator.record[0], estimator.state[0]["a"]
    for soc in (0.3, 0.6, 0.9):
        assert chen_mora.r_s(soc, a) == pytest.approx(chen_mora.r_s(soc, TRUTH.a), rel=0.03)
        assert chen_mora.r_ts(soc, a) == pytest.approx(chen_mora.r_ts(soc, TRUTH.a), rel=0.5)
    for i in (1, 2, 3):  # a1..a3 of R_ts
        fit = fitted_parameter(record, i)
        assert fit is not None
        bounds = estimator.cell.bounds(i)
        assert a[i] == pytest.approx(min(max(fit.value, bounds.lower), bounds.upper), rel=1e-3)


def test_identified_values_are_limited_by_the_configured_bounds(load_and_soc) -> None:
    bounds = TRUTH.bounds(3).model_copy(update={"lower": 0.009, "upper": 0.01})
    estimator = Estimator(
        TRUTH.model_copy(update={"adaptation": {"a3": bounds}}), identifier=IDENTIFIER, initial_soc=1.0
    )
    estimator.run(load_and_soc[0])
    assert fitted_parameter(estimator.record[0], 3).value > 0.01
    assert estimator.state[0]["a"][3] == pytest.approx(0.01, rel=1e-3)


def test_a_bound_on_one_parameter_does_not_change_the_element_at_visited_socs(load_and_soc) -> None:
    """The bound on a15 is far below its true value. The other parameters of R_s compensate for it at visited SOCs."""
    bound = TRUTH.bounds(15).model_copy(update={"upper": 0.08, "lower": 0.07})
    estimator = Estimator(
        TRUTH.model_copy(update={"adaptation": {"a15": bound}}), identifier=IDENTIFIER, initial_soc=1.0
    )
    estimator.run(load_and_soc[0])
    a, soc = estimator.state[0]["a"], float(estimator.state["soc"][0])
    assert a[15] <= 0.08
    assert chen_mora.r_s(soc, a) > 0.08


def test_the_law_ignores_a_fit_with_negative_capacitances_at_the_present_soc(load_and_soc) -> None:
    estimator = Estimator(TRUTH, identifier=IDENTIFIER, initial_soc=1.0)
    estimator.run(load_and_soc[0])
    record, soc = estimator.record[0], float(estimator.state["soc"][0])
    targets = record["observer"]["target"].copy()
    estimator.settings_record["lower"][0, 7:13], estimator.settings_record["upper"][0, 7:13] = 0.0, np.inf
    # a7..a9 of C_ts and a10..a12 of C_tl. The capacitances are negative below SOC 5.3 and 4.6 (delta1 and delta2).
    record["fit"]["a"][7:13] = [2e5, 1.0, 1e3, 1e6, 1.0, 1e4]
    for element in CAPACITANCES:
        set_adaptation_targets(record, estimator.settings_record[0], element)
    assert soc < 4.6
    assert np.array_equal(record["observer"]["target"], targets)


def test_an_unmeasured_gap_adds_no_weight_to_the_map_of_elements(load_and_soc) -> None:
    estimator = Estimator(TRUTH, identifier=IDENTIFIER, initial_soc=1.0)
    estimator.run(load_and_soc[0][:5000])
    weight_before, gap_s = estimator.record[0]["map"]["weight"].copy(), 36000.0
    unlearned_s = estimator.record[0]["unlearned_s"].copy()
    later = load_and_soc[0][5000:5300].copy()
    later["time_s"] += gap_s
    later["current_a"] = 0.0
    estimator.run(later[:1])
    assert estimator.record[0]["map"]["weight"] == pytest.approx(weight_before)
    assert estimator.record[0]["unlearned_s"] - unlearned_s == pytest.approx(gap_s, abs=2.0)
    # Learning continues in the bin of the present SOC. The median over the bins is not affected by it.
    estimator.run(later[1:])
    expected_fraction = np.exp(-gap_s / estimator.settings_record["map_memory_s"][0])
    visited = weight_before > 0.0
    remaining_fraction = estimator.record[0]["map"]["weight"][visited] / weight_before[visited]
    assert np.median(remaining_fraction) == pytest.approx(expected_fraction, rel=2e-3)


def test_a_long_gap_preserves_the_capacity_and_the_constant_part_of_the_offset(load_and_soc) -> None:
    estimator = Estimator(TRUTH, identifier=IDENTIFIER, initial_soc=1.0)
    estimator.run(load_and_soc[0][:-1])
    f = estimator.record[0]["filter"]
    (offset_a, ln_q), first = f["mean"][f["best"], [OFFSET, LN_Q]], f["covariance"][f["best"]].copy()
    p = estimator.settings_record[0]["filter"]
    estimator.resume(0.1 * p["offset_s"])  # a tenth of the time constant of the offset
    estimator.run(load_and_soc[0][-1:])
    # of an event in the gap: in a rest the voltage before and after it shows the offset
    mean, covariance = f["mean"][0], f["covariance"][0]
    assert mean[LN_Q] == pytest.approx(ln_q, rel=0.2)
    assert covariance[LN_Q, LN_Q] == pytest.approx(first[LN_Q, LN_Q], rel=0.2)
    assert covariance[LN_Q, LN_Q] < p["capacity_std"] ** 2
    assert abs(mean[OFFSET] - np.exp(-0.1) * offset_a) < 0.1 * np.sqrt(first[OFFSET, OFFSET])
    prior_variance = offset_variance(p)
    expected_variance = prior_variance - np.exp(-0.2) * (prior_variance - first[OFFSET, OFFSET])
    assert covariance[OFFSET, OFFSET] == pytest.approx(expected_variance, rel=0.05)


@pytest.mark.parametrize("law", ["scheme-1", "scheme-2"])
def test_identified_values_do_not_limit_laws_without_limits(load_and_soc, law: str) -> None:
    estimator = Estimator(TRUTH, ObserverSettings(law=law), identifier=IDENTIFIER, initial_soc=1.0)
    targets = estimator.settings[0]["target"].copy()
    estimator.run(load_and_soc[0])
    assert np.array_equal(estimator.state[0]["target"], targets)


def test_without_the_identifier_nothing_is_learned(load_and_soc) -> None:
    estimator = Estimator(TRUTH, initial_soc=0.8, identifier=None)
    trace = estimator.run(load_and_soc[0])
    assert np.isnan(trace["soc_std"]).all()
    assert np.array_equal(trace["soc"], trace["soc_coulomb"])
    assert (estimator.record[0]["fit"]["bins"] == 0).all()


def test_a_saved_record_resumes_identically(load_and_soc) -> None:
    block = load_and_soc[0]
    uninterrupted, first, second = (Estimator(TRUTH, identifier=IDENTIFIER, initial_soc=0.9) for _ in range(3))
    uninterrupted.run(block)
    first.run(block[:5000])
    second.record[...] = first.record
    second.run(block[5000:])
    assert uninterrupted.record.tobytes() == second.record.tobytes()


def test_the_soc_is_less_certain_after_a_gap_and_then_converges(load_and_soc) -> None:
    block, true_soc = load_and_soc
    estimator = Estimator(TRUTH, identifier=IDENTIFIER, initial_soc=1.0)
    before = estimator.run(block[:5000])["soc_std"][-1]
    estimator.resume(1800.0)
    after = estimator.run(block[6800:])  # half an hour later
    assert after["soc_std"][1] > before
    assert np.abs(after["soc"] - true_soc[6800:])[AFTER_HALF_AN_HOUR].max() < 0.015


def test_gaps_do_not_accumulate_the_cell_imbalance_of_a_pack(load_and_soc) -> None:
    """The imbalance adds to the std only once, however many restarts follow each other."""
    stds = []
    for series in (1, 6):
        block = load_and_soc[0][:5000].copy()
        block["voltage_v"] *= series
        estimator = Estimator(TRUTH.pack(series, 1), identifier=IDENTIFIER, initial_soc=1.0)
        estimator.run(block)
        for _ in range(10):
            estimator.resume(0.0)
            estimator.run(block[-1:])
        stds.append(estimator.record[0]["filter"]["soc_std"])
    assert stds[1] < 1.1 * stds[0]


def test_a_soc_set_by_the_user_is_used_if_the_voltage_agrees(load_and_soc) -> None:
    block, true_soc = load_and_soc
    estimator = Estimator(TRUTH, identifier=IDENTIFIER, initial_soc=0.8)
    estimator.run(block[:10])
    estimator.set_soc(float(true_soc[9]))
    assert estimator.record[0]["observer"]["soc"] == true_soc[9]
    trace = estimator.run(block[10:600])
    assert np.abs(trace["soc"] - true_soc[10:600]).max() < 0.01


def test_a_clock_set_back_and_repeated_stamps_do_not_change_the_result(load_and_soc) -> None:
    block, true_soc = load_and_soc[0].copy(), load_and_soc[1]
    block["time_s"][4000:] -= 2000.0
    block["time_s"][6000:6020] = block["time_s"][5999]
    estimator = Estimator(TRUTH, identifier=IDENTIFIER, initial_soc=1.0)
    trace = estimator.run(block)
    assert estimator.state[0]["time_steps_back"] == 1
    assert estimator.state[0]["dropped_repeated"] == 20
    assert abs(trace["soc"][-1] - true_soc[-1]) < 0.01


def test_the_map_is_empty_before_its_first_sample() -> None:
    estimator = Estimator(TRUTH, identifier=IDENTIFIER)
    first_parameters = [fitted_parameter(estimator.record[0], 3 * element + 1) for element in range(ELEMENTS)]
    assert first_parameters == [None] * ELEMENTS


@pytest.mark.parametrize("soc", [-0.1, 1.5, float("nan")])
def test_a_soc_outside_0_to_1_is_rejected(soc: float) -> None:
    with pytest.raises(ValueError, match="is outside"):
        Estimator(TRUTH, identifier=IDENTIFIER).set_soc(soc)


def test_a_reset_restores_a_soc_that_was_set_by_the_user(load_and_soc) -> None:
    estimator = Estimator(TRUTH, identifier=IDENTIFIER, initial_soc=1.0)
    estimator.run(load_and_soc[0][:5000])
    estimator.set_soc(0.7)
    estimator.record["filter"]["mean"][0, :, SOC] = np.nan
    estimator.run(load_and_soc[0][5000:5002])
    assert estimator.record["counters"]["reset"][0] == 1
    assert estimator.state["soc"][0] == pytest.approx(0.7, abs=0.05)
