"""Verdict on a cell model in plain sentences."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bms_estimator.calibration.validate import SocErrors, validate
from bms_estimator.calibration.verdict import (
    Coverage,
    Run,
    VoltageErrors,
    coverage,
    grade_soc,
    grade_voltage,
    judge,
    voltage_errors,
)
from bms_estimator.model.cell import Fit, Grade, fitted_to
from bms_estimator.model.columns import Columns
from bms_estimator.model.input_faults import InputFault
from tests.calibration.simulated_load import TRUTH, capture, steps

COVERAGE = Coverage(soc=(0.05, 1.0), temperature_c=(10.0, 50.0), discharge_c_rate=2.0, charge_c_rate=0.0, long_rests=3)
NO_SOC = SocErrors(math.nan, math.nan, 0, InputFault(0))


def comparison(rms_v=0.009, soc_errors=NO_SOC, name="steps", *, duration_s=9000, is_fitted=False):
    """Return a comparison with a capture from SOC 98 % whose RMS error above SOC 10 % is ``rms_v``."""
    validation = validate(Columns(capture(steps(duration_s=duration_s)), name), TRUTH)
    above = replace(validation.above, voltage_rms_v=rms_v, mean_abs_percent=0.2)
    return Run(name, replace(validation, above=above), soc_errors, is_fitted)


def test_the_verdict_names_error_range_and_grade_and_what_the_captures_do_not_cover():
    run = comparison()
    low = f"{100.0 * run.validation.soc.min():.0f}"
    assert judge([run], TRUTH, COVERAGE).text == (
        f"The model predicts the voltage within 9 mV (RMS per cell, on average 0.2 % of the voltage) between SOC {low} % and "
        "98 %: good. Not known, because the captures do not show it: below 10 °C; discharge above 2 C; charge."
    )


@pytest.mark.parametrize(
    ("rms_v", "mean_percent", "grade"),
    [
        (0.010, 0.5, Grade.GOOD),
        (0.011, 0.2, Grade.FAIR),
        (0.009, 0.6, Grade.FAIR),
        (0.031, 0.2, Grade.POOR),
        (0.009, 1.6, Grade.POOR),
        (math.nan, math.nan, Grade.POOR),
    ],
)
def test_the_worse_of_rms_and_mean_error_decides_the_grade(rms_v, mean_percent, grade):
    assert grade_voltage(VoltageErrors(rms_v, mean_percent, math.nan, (0.05, 1.0))) is grade


def test_the_error_near_empty_has_its_own_sentence():
    run = comparison(duration_s=18_000)
    error_v = np.where(run.validation.soc <= 0.1, 0.12, 0.0)
    run = replace(run, validation=replace(run.validation, error_v=error_v))
    assert "Below SOC 10 % the error is 120 mV." in judge([run], TRUTH, COVERAGE).text


def test_a_band_that_is_too_narrow_is_reported():
    assert judge([comparison(soc_errors=SocErrors(0.012, 0.97, 900, InputFault(0)))], TRUTH).sentences[1:] == (
        "The estimated SOC differs from coulomb counting by 1.2 % (RMS): good.",
    )
    assert judge([comparison(soc_errors=SocErrors(0.03, 0.6, 900, InputFault(0)))], TRUTH).sentences[1:] == (
        (
            "The estimated SOC differs from coulomb counting by 3.0 % (RMS): fair, but its ±2 std band is too narrow: only "
            "60 % of the samples are inside."
        ),
    )
    assert grade_soc(0.06) is Grade.POOR


def test_the_soc_has_no_grade_if_the_estimator_suspects_the_current():
    (_, sentence) = judge([comparison(soc_errors=SocErrors(0.06, 0.1, 900, InputFault.OFFSET))], TRUTH).sentences
    assert sentence.startswith("Coulomb counting is no reference: counted charge and voltage drift apart with time")


def test_the_grade_comes_from_captures_to_which_the_model_was_not_fitted():
    fitted, other = comparison(0.001, name="a.csv", is_fitted=True), comparison(0.02, name="b.csv")
    verdict = judge([fitted, other], TRUTH)
    assert verdict.grade is Grade.FAIR
    assert "Not part of the grade, because the cell file was fitted to them: a.csv." in verdict.sentences


def test_a_fitted_capture_has_the_grade_of_the_data_held_back():
    run = comparison(0.001, is_fitted=True)
    assert judge([run], TRUTH).grade is Grade.GOOD
    verdict = judge([run], fitted_to(TRUTH, ["0123"], Grade.POOR))
    assert verdict.grade is Grade.POOR
    assert verdict.sentences[1] == (
        "The cell file was fitted to this capture, so that its errors on other captures may be larger; on data that were "
        "held back from the fit it was poor."
    )


def test_the_fit_of_a_cell_file_follows_later_fits_and_scaling():
    cell = fitted_to(TRUTH, ["a"], Grade.GOOD)
    assert cell.pack(4, 2).fit == cell.fit
    assert fitted_to(cell, ["b"]).fit == Fit(captures=("a", "b"))
    assert fitted_to(TRUTH, []).fit is None


@pytest.mark.parametrize(
    ("changes", "condition"),
    [
        ({"temperature_c": None}, "the effect of temperature, which was not measured"),
        ({"temperature_c": (-5.0, 31.0)}, "above 31 °C"),
        ({"temperature_c": (24.8, 25.3)}, "temperatures other than 25 °C"),
        ({"soc": (0.2, 1.0)}, "SOC below 20 %"),
        ({"soc": (0.0, 0.8)}, "SOC above 80 %"),
        ({"charge_c_rate": 0.5}, "charge above 0.5 C"),
        ({"discharge_c_rate": 0.0}, "discharge"),
        ({"long_rests": 0}, "relaxation, because there is no rest of 5 minutes"),
    ],
)
def test_a_condition_without_captures_is_unknown(changes, condition):
    assert condition not in judge([comparison()], TRUTH, COVERAGE).unknown
    assert condition in judge([comparison()], TRUTH, replace(COVERAGE, **changes)).unknown


def test_errors_and_coverage_include_all_samples_of_all_captures():
    samples = capture(steps(), noise_v=1e-3)
    samples["temperature_c"] = np.linspace(20.0, 30.0, samples.size)
    validation = validate(Columns(samples, "steps"), TRUTH)
    errors, covered = voltage_errors([validation, validation], TRUTH), coverage([validation, validation], TRUTH)
    assert errors.rms_v == pytest.approx(validation.above.voltage_rms_v)
    assert errors.mean_percent == pytest.approx(validation.above.mean_abs_percent)
    assert errors.low_soc_rms_v > 0.0
    assert covered.soc == (validation.soc.min(), validation.soc.max())
    assert covered.temperature_c == pytest.approx((20.0, 30.0), abs=0.1)
    assert covered.discharge_c_rate == samples["current_a"].max() / TRUTH.cell.capacity_ah
    assert covered.long_rests > 0
