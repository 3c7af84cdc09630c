"""Prediction of the voltage by models of the thesis, and SOC by interpolation.

The models are that of constant parameters a1..a15, (5.3), and the static model of chapter 6, whose elements do not
depend on the SOC. The SOC by interpolation of the OCV is (7.1).
"""

import dataclasses

import numpy as np
import pytest

from bms_estimator.calibration.thesis.prediction import open_circuit, predict, soc_by_interpolation, static_elements
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import c_tl, c_ts, delta, ocv, r_s, r_tl, r_ts
from bms_estimator.model.cell import load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.reports.thesis.simulation import discharge
from tests.calibration.simulated_load import TRUTH, capture, constant, steps, wrong_start

CELL = load_cell("chen_mora")


def pulses(current_a=1.5, pulse_s=600, rounds=12):
    """Return a current at 1 Hz of pulses, each with a rest of the same duration [A]."""
    return np.tile(np.r_[np.full(pulse_s, current_a), np.zeros(pulse_s)], rounds)


LOADS = {"constant": constant(1.5, 7000), "pulse": pulses(), "variable steps": steps(4)}


@pytest.mark.parametrize("load", LOADS)
def test_the_error_of_the_true_model_is_the_noise(load):
    run = predict(TRUTH, capture(LOADS[load]), 0.98)
    assert np.sqrt(np.mean(run.error_v**2)) == pytest.approx(0.5e-3, rel=0.05)
    assert run.mean_percent < 0.02
    assert run.max_percent < 0.1


@pytest.mark.parametrize("load", LOADS)
def test_percentages_are_relative_to_the_measured_voltage(load):
    """Table 11 of the thesis uses these percentages."""
    run = predict(wrong_start(), capture(LOADS[load]), 0.98, lowest_soc=0.1)
    percent = 100.0 * np.abs(run.voltage_v - run.predicted_v) / run.voltage_v
    assert run.mean_percent == pytest.approx(percent.mean(), rel=1e-12)
    assert run.max_percent == pytest.approx(percent.max(), rel=1e-12)
    assert 0.1 < run.mean_percent < run.max_percent < 10.0


def test_a_voltage_error_of_one_percent_is_reported_as_one_percent():
    samples = capture(LOADS["pulse"], noise_v=0.0)
    samples["voltage_v"] /= 1.01
    run = predict(TRUTH, samples, 0.98)
    assert run.mean_percent == pytest.approx(1.0, abs=1e-3)
    assert run.max_percent == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize("soc_of_elements", [0.1, 0.5, 0.9])
def test_static_elements_are_those_of_one_soc_everywhere(soc_of_elements):
    static_a = static_elements(CELL.a, soc_of_elements)
    for element in (r_ts, r_tl, c_ts, c_tl, r_s):
        expected = element(soc_of_elements, CELL.a)
        assert [element(x, static_a) for x in (0.02, 0.5, 1.0)] == pytest.approx([expected] * 3, rel=1e-9)
    assert static_a[16:22] == pytest.approx(CELL.a[16:22])


@pytest.mark.parametrize("load", ["pulse", "variable steps"])
def test_the_static_model_has_larger_errors_near_empty_where_resistances_rise(load):
    samples = capture(LOADS[load])
    dynamic = predict(TRUTH, samples, 0.98)
    static = predict(TRUTH, samples, 0.98, a=static_elements(TRUTH.a, 0.5))
    assert static.mean_percent > 2.0 * dynamic.mean_percent
    near_empty = static.soc < 0.15
    assert static.error_percent[near_empty].mean() > 3.0 * static.error_percent[~near_empty].mean()
    at_soc_of_static_model = np.abs(static.soc - 0.5) < 0.02  # there both models agree
    assert np.abs(static.error_v[at_soc_of_static_model]).max() < 4e-3


def test_given_parameters_replace_those_of_the_cell():
    samples = capture(LOADS["pulse"])
    with_given_parameters = predict(TRUTH, samples, 0.98, a=wrong_start().a, lowest_soc=0.1)
    with_own_parameters = predict(wrong_start(), samples, 0.98, lowest_soc=0.1)
    assert np.array_equal(with_given_parameters.predicted_v, with_own_parameters.predicted_v)


def test_the_prediction_ends_before_a_capacitance_is_negative():
    samples = discharge(CELL, 0.275, 1.0)
    # SOCs at which the capacitances C_ts and C_tl are zero.
    max_delta = max(delta(CELL.a[8], CELL.a[9], CELL.a[7]), delta(CELL.a[11], CELL.a[12], CELL.a[10]))
    assert max_delta == pytest.approx(0.011156, abs=1e-6)  # erratum 13 of the thesis
    run = predict(CELL, samples, 1.0)
    assert max_delta < run.soc[-1] < 1.1 * max_delta
    assert samples["time_s"].size > run.time_s.size
    assert np.isfinite(run.predicted_v).all()
    assert predict(CELL, samples, 1.0, lowest_soc=0.2).soc[-1] == pytest.approx(0.2, abs=1e-3)


@pytest.mark.parametrize(("lowest_soc", "floor"), [(0.02, "0.020"), (0.0, "0.012")])  # delta2 is 0.011
def test_a_start_below_the_lowest_soc_is_rejected(lowest_soc, floor):
    samples = discharge(CELL, 0.275, 1.0)
    message = rf"{CELL.cell.name}: SOC is 0\.010 at the first sample, and the prediction ends below {floor}"
    with pytest.raises(UserError, match=message):
        predict(CELL, samples, 0.01, lowest_soc=lowest_soc)


def test_glitches_and_lost_samples_are_left_out():
    samples = capture(LOADS["variable steps"])
    samples["voltage_v"][[100, 5000, 9000]] = 0.0
    samples["voltage_v"][200] = np.nan
    run = predict(TRUTH, samples, 0.98)
    assert run.time_s.size == samples.size - 4
    assert run.max_percent < 0.5


def test_open_circuit_equals_the_curve_of_the_kernels():
    soc = np.random.default_rng(0).uniform(-0.02, 1.02, 500)
    grid = ocv_grid(TRUTH)
    assert open_circuit(TRUTH, soc) == pytest.approx([ocv(x, *grid) for x in soc], abs=1e-9)


@pytest.mark.parametrize("load", LOADS)
def test_the_soc_by_interpolation_agrees_with_counting(load):
    """Figures 41 and 42 of the thesis show this comparison."""
    run = predict(TRUTH, capture(LOADS[load], noise_v=0.0), 0.98)
    soc, ocv_v = soc_by_interpolation(TRUTH, run)
    assert soc == pytest.approx(run.soc, abs=2e-3)
    assert ocv_v == pytest.approx(open_circuit(TRUTH, run.soc), abs=1e-6)


def test_the_soc_by_interpolation_does_not_depend_on_a_wrong_initial_soc():
    samples = capture(LOADS["pulse"], soc=0.90, noise_v=0.0)
    run = predict(TRUTH, samples, 0.95)  # counting begins 5 % too high
    true_soc = run.soc - 0.05
    soc, _ = soc_by_interpolation(TRUTH, run)
    middle = (true_soc > 0.3) & (true_soc < 0.85)
    assert np.abs(soc - true_soc)[middle].max() < 5e-3


def test_the_soc_by_interpolation_is_0_or_1_beyond_the_ends_of_the_curve():
    run = predict(TRUTH, capture(np.zeros(10), noise_v=0.0), 0.98)
    for offset_v, end in ((1.0, 1.0), (-1.5, 0.0)):
        shifted = dataclasses.replace(run, voltage_v=run.voltage_v + offset_v)
        assert set(soc_by_interpolation(TRUTH, shifted)[0]) == {end}
