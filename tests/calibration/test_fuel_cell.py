"""Identification of a fuel cell: determined parameters are within their errors, and others are not changed."""

from pathlib import Path

import numpy as np
import pytest

from bms_estimator.calibration.fuel_cell_fit import KEYS, Source, fit_fuel_cell
from bms_estimator.kernels.cell_model.fuel_cell import open_loop, polarisation
from bms_estimator.kernels.observer.records import LEARNABLE
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import FuelCellModel, load_fuel_cell
from bms_estimator.sources.captures.curves import read_polarisation
from tests import mann_stack
from tests.mann_stack import CURVE_A

PEM = load_fuel_cell("pem_30w")
DATA = Path(__file__).parents[1] / "data" / "fuel_cell"
TRUE_FACTORS = np.array([1.0, 1.3, 0.9, 1.05, 1.6, 0.8, 1.1, 1.4, *[1.0] * 8])
"""True parameters relative to those of the file, at index 1 to 7."""
IMPEDANCE_OHM = 0.061
"""High-frequency resistance of the cell of ``nafion112_oxygen``, by impedance, from the paper of the data set."""


def simulate_sources(truth: FuelCellModel, *, seed: int, highest_a: float = 8.0) -> list[Source]:
    """Return a polarisation curve and a record of current steps (10 s at 500 Hz) of the model with 3 mV of noise."""
    rng, theta = np.random.default_rng(seed), np.zeros(LEARNABLE)
    time_s, current_a = mann_stack.random_steps(10.0, 500.0, seed=seed, highest_a=highest_a)
    no_curve_c, no_record_c = np.full(CURVE_A.size, np.nan), np.full(time_s.size, np.nan)  # no temperature
    curve_v, _ = polarisation(truth.a, theta, CURVE_A, no_curve_c)
    record_v, _ = open_loop(truth.a, theta, time_s, current_a, no_record_c)
    return [
        Source("curve", None, CURVE_A, curve_v + rng.normal(0.0, 0.003, CURVE_A.size), no_curve_c),
        Source("steps", time_s, current_a, record_v + rng.normal(0.0, 0.003, time_s.size), no_record_c),
    ]


def test_identified_parameters_are_within_their_errors() -> None:
    """Seven parameters of five stacks are identified. Their errors match their std on average and for each parameter."""
    truth = PEM.identified(PEM.a * TRUE_FACTORS, {})
    errors_over_std = []
    for seed in range(5):
        fit = fit_fuel_cell(simulate_sources(truth, seed=seed), PEM)
        assert fit.undetermined == {}
        assert fit.rms_v["steps"] == pytest.approx(0.003, rel=0.05)
        for key in KEYS:
            ln_error = np.log(getattr(fit.model.fuel_cell, key) / getattr(truth.fuel_cell, key))
            errors_over_std.append(ln_error / fit.model.std[key])
    assert np.abs(errors_over_std).max() < 3.5
    assert 0.5 < np.sqrt(np.mean(np.square(errors_over_std))) < 1.5


def test_a_curve_alone_does_not_determine_the_double_layer() -> None:
    fit = fit_fuel_cell(simulate_sources(PEM, seed=1)[:1], PEM)
    assert "steps of the current" in fit.undetermined["c_dl_farad"]
    assert fit.model.fuel_cell.c_dl_farad == PEM.fuel_cell.c_dl_farad
    assert "c_dl_farad" not in fit.model.std
    assert fit.model.fuel_cell.r_ohm == pytest.approx(PEM.fuel_cell.r_ohm, rel=3.0 * fit.model.std["r_ohm"])


def test_steps_far_from_the_limit_do_not_determine_the_concentration_loss() -> None:
    fit = fit_fuel_cell(simulate_sources(PEM, seed=2, highest_a=2.0)[1:], PEM)
    assert "concentration_v" in fit.undetermined
    assert "near the limiting one" in fit.undetermined["concentration_v"]
    assert fit.model.fuel_cell.c_dl_farad == pytest.approx(0.067, rel=3.0 * fit.model.std["c_dl_farad"])


def test_a_single_current_determines_only_the_total_loss() -> None:
    """The losses cannot be separated."""
    record = simulate_sources(PEM, seed=3)[1]
    constant = np.full(record.current_a.size, 3.0)
    voltage_v = np.random.default_rng(0).normal(9.4, 0.003, constant.size)
    fit = fit_fuel_cell([Source("constant", record.time_s, constant, voltage_v, record.temperature_c)], PEM)
    assert set(fit.undetermined) >= {"r_ohm", "tafel_slope_v", "c_dl_farad", "limiting_current_a"}


def test_data_without_information_are_rejected() -> None:
    voltage_v = np.array([2.0, 18.0, 4.0])
    with pytest.raises(UserError, match=r"determine no parameter.*r_ohm: it needs steps"):
        fit_fuel_cell([Source("noise", None, np.array([0.0, 1.0, 2.0]), voltage_v, np.full(3, np.nan))], PEM)


def test_a_stack_with_unmodelled_effects_is_predicted_to_some_millivolts() -> None:
    """The stack of ``mann_stack`` has a drying membrane, delayed oxygen and self-heating.

    Parameters fitted to a polarisation curve and a minute of current steps predict another minute.
    """
    curve = mann_stack.curve(CURVE_A)
    sources = [Source("curve", None, curve.current_a, curve.voltage_v, curve.temperature_c)]
    for seed in (1, 5):
        record = mann_stack.measured(*mann_stack.random_steps(60.0, 1000.0, seed=seed), seed=seed).every(5)
        columns = record.time_s, record.current_a, record.voltage_v, record.temperature_c
        sources.append(Source(f"steps {seed}", *columns))
    *fitted_sources, other_source = sources
    fit = fit_fuel_cell(fitted_sources, PEM)
    before_v, after_v = (
        np.sqrt(np.mean((other_source.voltage_v - other_source.predict(m.a, np.zeros(LEARNABLE))[0]) ** 2))
        for m in (PEM, fit.model)
    )
    assert after_v < 0.016
    assert after_v < before_v
    # The resistance includes other losses than that of the membrane (docs/theory/fuel-cell.md).
    assert fit.model.fuel_cell.r_ohm > 1.1 * record.r_ohm.mean()
    assert fit.model.fuel_cell.r_ohm < 1.35 * record.r_ohm.mean()


def test_a_real_polarisation_curve_gives_the_resistance_measured_by_impedance() -> None:
    """The cell of 1 cm2 has hydrogen and oxygen, Nafion 112, 25 psig and 100 % relative humidity.

    Points below 0.1 A/cm2 are not used: there the voltage falls by 50 mV within 34 mA, which does not follow Tafel's
    equation.
    """
    columns = read_polarisation(DATA / "nafion112_oxygen.csv")
    assert columns is not None
    current_a, voltage_v, temperature_c = columns[columns[:, 0] > 0.1].T.copy()
    fit = fit_fuel_cell(
        [Source("oxygen", None, current_a, voltage_v, temperature_c)], load_fuel_cell(DATA / "one_cm2.toml")
    )
    assert fit.rms_v["oxygen"] < 0.009
    assert set(fit.undetermined) == {"c_dl_farad", "internal_current_a"}
    assert fit.model.fuel_cell.r_ohm == pytest.approx(
        IMPEDANCE_OHM, abs=3.0 * fit.model.std["r_ohm"] * fit.model.fuel_cell.r_ohm
    )
    # found by this fit; the cell file has 5 A
    assert fit.model.fuel_cell.limiting_current_a == pytest.approx(4.39, rel=0.05)


def test_a_flooding_cell_on_air_does_not_determine_the_resistance() -> None:
    """A curve with a residual of 23 mV does not determine the resistance. The reason is reported."""
    columns = read_polarisation(DATA / "nafion112_air.csv")
    assert columns is not None
    current_a, voltage_v, temperature_c = columns[columns[:, 0] > 0.1].T.copy()
    fit = fit_fuel_cell(
        [Source("air", None, current_a, voltage_v, temperature_c)], load_fuel_cell(DATA / "one_cm2.toml")
    )
    assert {"r_ohm", "c_dl_farad"} <= set(fit.undetermined)
    assert fit.rms_v["air"] > 0.015
