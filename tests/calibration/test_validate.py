"""Validation of a cell file on a capture: errors, initial SOC, warnings, and rejected captures."""

import numpy as np
import pytest

from bms_estimator.calibration.validate import soc_errors, validate
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.rc_ladder import HYSTERESIS_ACTIVATION_ENERGY, arrhenius
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.cell_sections import TableOcv
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.input_faults import InputFault
from bms_estimator.pack.pack import Pack
from bms_estimator.sources.captures.replay import load_capture
from tests.calibration.simulated_load import LADDER, TRUTH, capture, constant, ladder_capture, steps

END_OF_CHARGE_S = 10_085.5
"""Time at which the charge of ``leaf/cc_1c`` ends [s]."""


def with_series_resistance(extra_ohm):
    """Return the true cell with an additional series resistance."""
    table = TRUTH.model_dump()
    table["r_s"]["offset_ohm"] += extra_ohm
    return CellModel.model_validate(table)


def test_the_error_of_the_true_cell_is_the_noise_of_the_voltage():
    result = validate(Columns(capture(steps(), noise_v=1e-3), "steps"), TRUTH)
    assert result.initial_soc == pytest.approx(0.98, abs=1e-3)
    assert result.initial_soc_from == "first rest"
    assert result.above.voltage_rms_v == pytest.approx(1e-3, rel=0.05)
    assert result.above.mean_abs_percent < result.all.mean_abs_percent * 1.5 < 0.05
    assert result.warnings == ()


def test_an_additional_series_resistance_is_measured():
    result = validate(Columns(capture(steps(), cell=with_series_resistance(0.005)), "steps"), TRUTH)
    assert result.extra_ohm == pytest.approx(0.005, abs=1e-4)
    assert result.with_extra_ohm.voltage_rms_v < 1e-3 < 3e-3 < result.above.voltage_rms_v
    assert result.resting.voltage_rms_v < 1e-3 < result.loaded.voltage_rms_v


def test_effects_of_temperature_and_hysteresis_on_the_ocv_are_subtracted_once():
    """A discharge at -15 C is validated with a file that contains hysteresis and temperature coefficient."""
    samples = ladder_capture(steps(), -15.0)
    # 40 K below 25 C, and the branch after discharge.
    samples["voltage_v"] -= 40.0 * 2e-4 + 0.01 * arrhenius(HYSTERESIS_ACTIVATION_ENERGY, -15.0)
    grid_v = ocv_grid(TRUTH)[0]
    soc = np.linspace(0.0, 1.0, grid_v.size)
    ocv = TableOcv(
        form="table",
        soc=tuple(soc),
        ocv_v=tuple(grid_v),
        hysteresis_v=(0.01,) * soc.size,
        per_kelvin_v=(2e-4,) * soc.size,
    )
    result = validate(
        Columns(samples, "cold"), TRUTH.model_copy(update={"ocv": ocv, "ladder": LADDER}), initial_soc=0.98
    )
    after_transition = (result.soc < 0.7) & (result.soc > 0.35)  # of the hysteresis
    assert np.sqrt(np.mean(result.error_v[after_transition] ** 2)) < 1.5e-3


def test_a_given_initial_soc_is_used():
    samples = capture(steps())
    result = validate(Columns(samples, "steps"), TRUTH, initial_soc=0.9)
    assert (result.initial_soc, result.initial_soc_from) == (0.9, "given")
    assert result.above.voltage_rms_v > 10e-3


def test_the_initial_soc_of_a_capture_that_starts_under_load_considers_the_ohmic_drop():
    result = validate(Columns(capture(constant(), soc=0.8), "constant"), TRUTH)
    assert result.initial_soc_from == "first sample under load"
    assert result.initial_soc == pytest.approx(0.8, abs=0.005)


def test_samples_below_soc_0_1_count_only_in_the_error_over_all_samples():
    result = validate(Columns(capture(steps()), "steps"), TRUTH)
    assert result.all.samples == result.time_s.size == result.error_v.size
    assert result.above.samples == int((result.soc > 0.1).sum()) < result.all.samples
    assert result.resting.samples + result.loaded.samples == result.above.samples


def test_glitches_are_left_out_and_counted():
    samples = capture(steps())
    samples["voltage_v"][[500, 900, 5000]] = [0.0, 1.0, np.nan]
    result = validate(Columns(samples, "steps"), TRUTH)
    assert result.glitches == 3
    assert result.above.voltage_rms_v < 1e-3


def test_a_capture_of_another_cell_is_rejected_with_its_numbers():
    table = TRUTH.model_dump()
    table["cell"]["capacity_ah"] = 0.5
    with pytest.raises(UserError, match=r"steps: SOC runs from -\d\.\d+ to 0\.98\d, outside 0\.\.1.* of 0\.5 Ah"):
        validate(Columns(capture(steps()), "steps"), CellModel.model_validate(table))
    with pytest.raises(UserError, match=r"SOC runs from -0\.\d+ to 0\.600, outside"):
        validate(Columns(capture(steps()), "steps"), TRUTH, initial_soc=0.6)


def test_too_few_samples_are_rejected():
    with pytest.raises(UserError, match=r"^steps: 3 good samples are too few, at least 5 are needed$"):
        validate(Columns(capture(steps())[:3], "steps"), TRUTH)


def test_a_wrong_sign_causes_a_warning_with_its_size():
    samples = capture(steps(duration_s=6000), soc=0.5)
    samples["current_a"] *= -1.0
    result = validate(Columns(samples, "steps"), TRUTH)
    assert "sign is wrong" in result.warnings[0]
    assert np.isfinite(result.all.voltage_rms_v)
    assert result.all.voltage_rms_v > 0.1


def test_simulation_continues_below_delta2_and_below_empty():
    """Below delta2, the lowest SOC of the observer, the capacitance C_tl of the formula is negative."""
    current_a = np.r_[np.zeros(10), np.full(9000, 1.3)]
    samples = capture(current_a, soc=0.98)
    with_discharge_below_empty = np.concatenate([samples, samples[-600:]])
    with_discharge_below_empty["time_s"] = np.arange(with_discharge_below_empty.size)
    result = validate(Columns(with_discharge_below_empty, "empty"), TRUTH)
    assert result.final_soc < 0.0
    assert np.isfinite(result.error_v).all()


def test_a_charge_from_empty_is_validated(data):
    recording = load_capture(data / "leaf" / "cc_1c.csv.gz")
    charge = Columns(recording.rows[recording["time_s"] < END_OF_CHARGE_S], "charge")
    result = validate(charge, load_cell("leaf"))
    assert result.initial_soc < 0.02
    assert result.final_soc > 0.98
    assert result.above.voltage_rms_v == pytest.approx(6.32e-3, abs=0.05e-3)
    assert result.warnings == ()


def test_errors_of_the_leaf_cell_on_its_own_pulses(data):
    """The cell file was fitted to this capture, so that the errors are due to the form of the elements."""
    result = validate(load_capture(data / "leaf" / "hppc_25c_from_full.csv.gz"), load_cell("leaf"))
    assert (result.initial_soc, result.final_soc) == pytest.approx((1.0, 0.001), abs=0.0005)
    assert (result.above.samples, result.all.samples) == (11715, 13000)
    above_soc_0_1, all_samples = (
        (1e3 * errors.voltage_rms_v, errors.mean_abs_percent, errors.max_abs_percent)  # [mV], [%], [%]
        for errors in (result.above, result.all)
    )
    assert above_soc_0_1 == pytest.approx((6.45, 0.0999, 0.915), rel=0.005)
    assert all_samples == pytest.approx((16.14, 0.1996, 4.644), rel=0.005)


def test_voltages_of_the_other_side_of_a_step_are_no_wrong_sign():
    """Some cyclers write the first record of a step with the voltage before it."""
    load = np.concatenate([np.zeros(1800), *(np.r_[np.full(720, 1.5), np.zeros(1800)] for _ in range(8))])
    samples = capture(load)[::10].copy()
    first = np.flatnonzero(np.diff(samples["current_a"])) + 1
    samples["voltage_v"][first] = samples["voltage_v"][first - 1]
    errors = soc_errors(Pack(Estimator(TRUTH)), samples, validate(Columns(samples, "cycler"), TRUTH))
    assert errors.faults == InputFault(0)
    assert errors.rms < 0.01
