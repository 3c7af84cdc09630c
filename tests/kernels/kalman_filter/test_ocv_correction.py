"""Correction of the cell file's OCV by states of the filter, one for each node of the SOC."""

import math

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.identified_parameters import ocv_correction_with_std
from bms_estimator.kernels.kalman_filter.ocv_correction import (
    node_error_scale,
    node_position,
    ocv_correction,
    reset_ocv_correction,
)
from bms_estimator.kernels.kalman_filter.records import NODE, NODES, STATES
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.pack.pack import Pack
from bms_estimator.pack_model.slow_fit import SlowFit
from tests.estimator.anywhere.cases import OXIDE, Case, cell_file, load_a
from tests.estimator.anywhere.truth import simulate
from tests.fit_interval import fits_every

GENERIC = load_cell("nmc", 3.0)
CURVE_GRID = np.linspace(0.0, 1.0, 41)
"""SOC grid of the declared error of the OCV."""


def test_the_initial_variance_of_the_correction_equals_that_of_the_ocv_at_and_between_nodes() -> None:
    p = Estimator(GENERIC).settings_record[0]["filter"]
    x, covariance = np.ones(STATES), np.ones((STATES, STATES))  # values that the reset must replace
    reset_ocv_correction(p, x, covariance)
    assert (x[NODE:] == 0.0).all()
    assert (covariance[:NODE, NODE:] == 0.0).all()
    for soc in (0.0, 0.3, 0.325, 0.34, 0.9876, 1.0):
        i, fraction = node_position(soc)
        h = np.zeros(STATES)
        h[NODE + i], h[NODE + i + 1] = node_error_scale(p, soc, fraction) * np.array([1.0 - fraction, fraction])
        error_v = np.interp(soc, CURVE_GRID, p["constant_error_v"])
        assert np.isclose(h @ covariance @ h, error_v**2, rtol=1e-12)


def test_the_correction_is_interpolated_between_nodes_in_units_of_the_ocv_error() -> None:
    p = Estimator(GENERIC).settings_record[0]["filter"]
    x = np.zeros(STATES)
    x[NODE:] = np.arange(NODES)
    for soc in (0.05, 0.5, 0.95):
        error_v = np.interp(soc, CURVE_GRID, p["constant_error_v"])
        assert np.isclose(ocv_correction(p, x, soc), soc * (NODES - 1) * error_v)
    assert ocv_correction(p, x, -0.1) == ocv_correction(p, x, 0.0)
    assert ocv_correction(p, x, 1.1) == ocv_correction(p, x, 1.0)


def test_only_the_level_of_an_ocv_with_a_plateau_is_learned() -> None:
    """On a plateau the voltage determines neither SOC nor the shape of the OCV."""
    estimator = Estimator(load_cell("lfp", 2.0), initial_soc=0.5)
    for second in range(1200):
        estimator.step(float(second), current_a=1.0, voltage_v=3.35)
    correction_v, std_v = ocv_correction_with_std(estimator.record[0], estimator.settings_record[0], CURVE_GRID)
    assert correction_v.min() > 0.005
    assert np.ptp(correction_v) < 0.1 * correction_v.min()
    p = estimator.settings_record[0]["filter"]
    assert (std_v > 0.9 * p["varying_error_v"]).all()
    assert std_v.min() < 0.95 * p["curve_error_v"].min()


FIT_INTERVAL_S = 3.0 * 3600.0
"""Interval between two slow fits [s]."""


def simulate_partial_cycles(
    cell: CellModel, cycles: int, passes: float = math.inf, *, slow_fit: bool = False
) -> tuple[np.ndarray, np.ndarray, Estimator]:
    """Run an estimator whose initial SOC is 0.1 too high; return the error of the SOC, its std, and the estimator.

    The run ends after a charge throughput of ``passes`` times the capacity. Each cycle is a drive from SOC 0.85 to about 0.35,
    a rest, a charge and a rest.
    """
    pieces, soc, charge_c, rest_s = [], 0.85, 0.35, 2400
    for n in range(cycles):
        drive = load_a(Case("", seed=n), seconds=3600)
        # The drive ends after half of the capacity.
        drive = drive[: int(np.argmax(np.cumsum(drive) > 0.5 * 3600.0 * OXIDE.capacity_ah)) or drive.size]
        charge_a = charge_c * OXIDE.capacity_ah
        charge = np.full(round(drive.sum() / charge_a), -charge_a)
        pieces += [drive, np.zeros(rest_s), charge, np.zeros(rest_s)]
    current_a = np.concatenate(pieces)
    samples = np.zeros(current_a.size, dtype=SAMPLE)
    samples["time_s"], samples["current_a"], samples["temperature_c"] = np.arange(current_a.size), current_a, 25.0
    curves = OXIDE.ocv_v, OXIDE.per_kelvin_v, OXIDE.hysteresis_v, OXIDE.ohm
    branch = 1.0  # the cell was charged
    samples["voltage_v"], true_soc = simulate(
        1.0, current_a, samples["temperature_c"], soc, branch, OXIDE.capacity_ah, *curves
    )
    estimator = Estimator(cell, initial_soc=soc + 0.1)
    throughput = np.cumsum(np.abs(current_a)) / 3600.0 / OXIDE.capacity_ah
    with fits_every(FIT_INTERVAL_S):
        pack = Pack(estimator, SlowFit(estimator, interval_s=FIT_INTERVAL_S) if slow_fit else None)
        trace = pack.run(samples[throughput < passes]).trace
    true_soc = true_soc[: trace.size]
    return trace["soc"] - true_soc, trace["soc_std"].copy(), estimator


def test_repeated_cycles_do_not_make_the_soc_overconfident() -> None:
    """The cell file has its declared error. The interval contains the true SOC over six cycles."""
    nees = []
    for seed in (51, 54, 57):
        error, std, _ = simulate_partial_cycles(cell_file(Case("", seed=seed, file_capacity_ratio=1.03)), cycles=6)
        second_half = slice(error.size // 2, None)
        nees.append(np.mean((error[second_half] / std[second_half]) ** 2))
        assert np.mean(np.abs(error[second_half]) < 2.0 * std[second_half]) > 0.95
    assert np.mean(nees) < 1.5


def test_the_ocv_of_a_generic_cell_is_learned_in_the_first_pass_only() -> None:
    """The cycles between SOC 0.35 and 0.85 reach no steep part of the OCV that would determine the SOC. Therefore
    neither SOC nor OCV becomes certain. After the first pass the OCV is that of the cell file again, with its error.
    """
    soc = np.linspace(0.4, 0.8, 9)
    error, std, estimator = simulate_partial_cycles(GENERIC, cycles=1, passes=0.5)
    correction_v, std_v = ocv_correction_with_std(estimator.record[0], estimator.settings_record[0], soc)
    p = estimator.settings_record[0]["filter"]
    curve_error_v = np.interp(soc, np.linspace(0.0, 1.0, 401), OXIDE.ocv_v - p["ocv_v"])
    assert (np.abs(curve_error_v - correction_v) < 2.0 * std_v).all()
    assert (std_v < 0.9 * np.interp(soc, CURVE_GRID, p["curve_error_v"])).all()
    error, std, estimator = simulate_partial_cycles(GENERIC, cycles=6)
    assert (np.abs(error[900:]) < 2.0 * std[900:]).mean() > 0.95
    correction_v, std_v = ocv_correction_with_std(estimator.record[0], estimator.settings_record[0], soc)
    assert (correction_v == 0.0).all()
    assert std_v == pytest.approx(np.interp(soc, CURVE_GRID, p["curve_error_v"]), rel=1e-6)


def test_the_slow_fit_learns_the_ocv_of_a_generic_cell_as_far_as_the_soc_is_known() -> None:
    """The slow fit learns the curve over all cycles. Neither SOC nor OCV becomes certain."""
    soc, grid = np.linspace(0.4, 0.8, 9), np.linspace(0.0, 1.0, 401)
    error, std, estimator = simulate_partial_cycles(GENERIC, cycles=6, slow_fit=True)
    assert (np.abs(error[900:]) < 2.0 * std[900:]).mean() > 0.95
    p, file = estimator.settings_record[0]["filter"], estimator.cell_file_settings
    before_v = np.interp(soc, grid, OXIDE.ocv_v - file["ocv_v"])
    after_v = np.interp(soc, grid, OXIDE.ocv_v - p["ocv_v"])
    std_v = np.interp(soc, CURVE_GRID, p["curve_error_v"])
    assert (np.abs(after_v) < 2.0 * std_v).all()
    assert (std_v < 0.8 * np.interp(soc, CURVE_GRID, file["curve_error_v"])).all()
    assert np.std(after_v) < 0.5 * np.std(before_v)
