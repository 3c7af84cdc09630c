"""Correction of the OCV by states along SOC."""

import numpy as np

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.identified_parameters import ocv_correction_with_std
from bms_estimator.kernels.kalman_filter.ocv_correction import (
    node_error_scale,
    node_position,
    ocv_correction,
    reset_ocv_correction,
)
from bms_estimator.kernels.kalman_filter.records import NODE, NODES, STATES
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.sample import SAMPLE
from tests.estimator.anywhere.cases import OXIDE, Case, cell_file, load_a
from tests.estimator.anywhere.truth import simulate

GENERIC = load_cell("nmc", 3.0)


def test_the_initial_variance_equals_that_of_the_curve_at_and_between_nodes() -> None:
    p = Estimator(GENERIC).settings_record[0]["filter"]
    x, covariance = np.ones(STATES), np.ones((STATES, STATES))
    reset_ocv_correction(x, covariance)
    assert (x[NODE:] == 0.0).all()
    assert (covariance[:NODE, NODE:] == 0.0).all()
    for soc in (0.0, 0.3, 0.325, 0.34, 0.9876, 1.0):
        i, t = node_position(soc)
        row = np.zeros(STATES)
        row[NODE + i], row[NODE + i + 1] = node_error_scale(p, soc, t) * np.array([1.0 - t, t])
        error_v = np.interp(soc, np.linspace(0.0, 1.0, 41), p["curve_error_v"])
        assert np.isclose(row @ covariance @ row, p["learned"] * error_v**2, rtol=1e-12)


def test_the_correction_is_interpolated_in_units_of_the_error() -> None:
    p = Estimator(GENERIC).settings_record[0]["filter"]
    x = np.zeros(STATES)
    x[NODE:] = np.arange(NODES)
    for soc in (0.05, 0.5, 0.95):
        error_v = np.interp(soc, np.linspace(0.0, 1.0, 41), p["curve_error_v"])
        assert np.isclose(ocv_correction(p, x, soc), soc * (NODES - 1) * error_v * np.sqrt(p["learned"]))
    assert ocv_correction(p, x, -0.1) == ocv_correction(p, x, 0.0)
    assert ocv_correction(p, x, 1.1) == ocv_correction(p, x, 1.0)


def test_a_curve_with_a_plateau_is_not_learned() -> None:
    """On a plateau a voltage determines neither SOC nor curve, so that the error stays that of the file."""
    estimator = Estimator(load_cell("lfp", 2.0), initial_soc=0.5)
    for i in range(1200):
        estimator.step(float(i), 1.0, 3.25)
    f = estimator.record[0]["filter"]
    assert (f["mean"][f["best"]][NODE:] == 0.0).all()
    soc = np.linspace(0.0, 1.0, 41)
    correction_v, std_v = ocv_correction_with_std(estimator.record[0], estimator.settings_record[0], soc)
    assert (correction_v == 0.0).all()
    assert np.allclose(std_v, estimator.settings_record[0]["filter"]["curve_error_v"])


def partial_cycles(cell: CellModel, cycles: int) -> tuple[np.ndarray, np.ndarray, Estimator]:
    """Return the error of the SOC and its std over drives between about 0.85 and 0.3 with charges and rests between
    them."""
    pieces, soc = [], 0.85
    for n in range(cycles):
        drive = load_a(Case("", seed=n), 3600)
        drive = drive[: int(np.argmax(np.cumsum(drive) > 0.5 * 3600.0 * OXIDE.capacity_ah)) or drive.size]
        charged = np.full(round(drive.sum() / (0.35 * OXIDE.capacity_ah)), -0.35 * OXIDE.capacity_ah)
        pieces += [drive, np.zeros(2400), charged, np.zeros(2400)]
    current_a = np.concatenate(pieces)
    samples = np.zeros(current_a.size, dtype=SAMPLE)
    samples["time_s"], samples["current_a"], samples["temperature_c"] = np.arange(current_a.size), current_a, 25.0
    curves = OXIDE.ocv_v, OXIDE.per_kelvin_v, OXIDE.hysteresis_v, OXIDE.ohm
    samples["voltage_v"], true = simulate(1.0, current_a, samples["temperature_c"], soc, 1.0, 3.0, *curves)
    estimator = Estimator(cell, initial_soc=soc + 0.1)
    trace = estimator.run(samples)
    return trace["soc"] - true, trace["soc_std"].copy(), estimator


def test_repeated_cycles_do_not_make_the_soc_overconfident() -> None:
    """The cell file has its declared error. The interval contains the true SOC over six cycles."""
    errors = []
    for seed in (51, 54, 57):
        error, std, _ = partial_cycles(cell_file(Case("", seed=seed, capacity=1.03)), 6)
        last = slice(error.size // 2, None)
        errors.append(np.mean((error[last] / std[last]) ** 2))
        assert np.mean(np.abs(error[last]) < 2.0 * std[last]) > 0.95
    assert np.mean(errors) < 1.5


def test_a_generic_curve_is_learned_as_far_as_the_soc_is_known() -> None:
    """On a wrong curve between 0.35 and 0.85 no voltage determines the SOC, so that neither SOC nor curve becomes
    certain."""
    error, std, estimator = partial_cycles(GENERIC, 6)
    assert (np.abs(error[900:]) < 2.0 * std[900:]).mean() > 0.95
    soc = np.linspace(0.4, 0.8, 9)
    correction_v, std_v = ocv_correction_with_std(estimator.record[0], estimator.settings_record[0], soc)
    p = estimator.settings_record[0]["filter"]
    wrong_v = np.interp(soc, np.linspace(0.0, 1.0, 401), OXIDE.ocv_v - p["ocv_v"])
    assert (np.abs(wrong_v - correction_v) < 2.0 * std_v).all()
    assert (std_v < 0.8 * np.interp(soc, np.linspace(0.0, 1.0, 41), p["curve_error_v"])).all()
    assert np.std(wrong_v - correction_v) < 0.5 * np.std(wrong_v)
