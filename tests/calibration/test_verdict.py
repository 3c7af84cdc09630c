"""Verdict on a cell model in plain sentences."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bms_estimator.calibration.validate import validate
from bms_estimator.calibration.verdict import (
    Coverage,
    Grade,
    SocErrors,
    VoltageErrors,
    coverage,
    grade_soc,
    grade_voltage,
    judge,
    voltage_errors,
)
from bms_estimator.model.columns import Columns
from tests.calibration.simulated_load import TRUTH, capture, steps

ERRORS = VoltageErrors(rms_v=0.009, mean_percent=0.2, low_soc_rms_v=math.nan, soc=(0.05, 1.0))
COVERAGE = Coverage(soc=(0.05, 1.0), temperature_c=(10.0, 50.0), discharge_c_rate=2.0, charge_c_rate=0.0, long_rests=3)


def test_the_verdict_names_error_range_and_grade_and_what_the_captures_do_not_cover():
    assert judge(ERRORS, COVERAGE).text == (
        "The model predicts the voltage within 9 mV (RMS per cell, on average 0.2 % of the voltage) between SOC 10 % and "
        "100 %: good. Not known: below 10 °C; discharge above 2 C; charge."
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
    text = judge(replace(ERRORS, low_soc_rms_v=0.12), COVERAGE).text
    assert "Below SOC 10 % the error is 120 mV." in text


def test_a_band_that_is_too_narrow_is_reported():
    assert judge(ERRORS, COVERAGE, SocErrors(0.012, 0.97)).sentences[1:] == (
        "The estimated SOC differs from coulomb counting by 1.2 % (RMS): good.",
    )
    assert judge(ERRORS, COVERAGE, SocErrors(0.03, 0.6)).sentences[1:] == (
        (
            "The estimated SOC differs from coulomb counting by 3.0 % (RMS): fair, but its ±2 std band is too narrow: only "
            "60 % of the samples are inside."
        ),
    )
    assert grade_soc(SocErrors(0.06, 1.0)) is Grade.POOR


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
    assert condition not in judge(ERRORS, COVERAGE).unknown
    assert condition in judge(ERRORS, replace(COVERAGE, **changes)).unknown


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
