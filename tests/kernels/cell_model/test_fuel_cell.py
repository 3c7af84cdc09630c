"""Fuel cell model: physical limits, exact step, sensitivities, and interface of the learning law."""

import inspect

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.integrate import solve_ivp

from bms_estimator.kernels.cell_model import fuel_cell
from bms_estimator.kernels.cell_model.fuel_cell import open_loop, polarisation
from bms_estimator.kernels.observer import chen_mora_sensitivity
from bms_estimator.kernels.observer.learning_law import NAMES, Model
from bms_estimator.kernels.observer.records import LEARNABLE
from bms_estimator.model.pack_model import load_fuel_cell
from tests import mann_stack

PEM = load_fuel_cell("pem_30w")
THETA = np.array([0.1, -0.05, 0.03, 0.2, 0.1, 0.05, 0.3, 0.0])
"""Logarithms of seven parameters relative to those of the file, and an unused value."""
STEPS = ((3.0, 0.01), (3.0, 0.02), (6.0, 0.005), (9.0, 0.1), (12.0, 0.1), (0.5, 0.03), (0.0, 0.5))
"""Currents [A], one beyond the limiting current, and durations [s]."""
currents_a, durations_s = st.floats(0.0, 8.0), st.floats(1e-4, 10.0)
"""Strategies of currents [A] and durations [s]."""


def file_constants() -> np.ndarray:
    """Return the model's constants of the file at the temperature of the file."""
    values = np.zeros(LEARNABLE)
    fuel_cell.load_file_constants(values, PEM.a, np.nan)
    return values


def steady_state(current_a: float, theta: np.ndarray = THETA) -> tuple[np.ndarray, np.ndarray]:
    """Return the states after a long time at ``current_a``, and their derivatives by theta."""
    x, dx = np.zeros(2), np.zeros((2, LEARNABLE))
    fuel_cell.steady_state(x, dx, theta, file_constants(), current_a)
    return x, dx


def voltages(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the voltage after each of ``STEPS``, and its derivatives by theta."""
    (x, dx), voltages_v, slopes = steady_state(0.0, theta), [], []
    for current_a, dt_s in STEPS:
        fuel_cell.advance(x, dx, theta, file_constants(), current_a, dt_s)
        psi = np.zeros(LEARNABLE)
        voltages_v.append(fuel_cell.output(x, dx, theta, file_constants(), current_a, psi))
        slopes.append(psi)
    return np.array(voltages_v), np.array(slopes)


def test_the_reversible_voltage_depends_on_temperature_and_pressures() -> None:
    """The arguments are the temperature [K] and the pressures of hydrogen and oxygen [atm]."""
    assert fuel_cell.nernst(298.15, 1.0, 1.0) == 1.229  # standard state
    # Larminie and Dicks, Fuel Cell Systems Explained, section 2.2: 1.19 V at 70 C
    assert fuel_cell.nernst(343.15, 1.0, 1.0) == pytest.approx(1.191, abs=5e-4)
    assert fuel_cell.nernst(343.15, 1.0, 0.21) < fuel_cell.nernst(343.15, 1.0, 1.0) < fuel_cell.nernst(343.15, 2.0, 1.0)


@pytest.mark.parametrize("j", range(len(fuel_cell.NAMES)), ids=fuel_cell.NAMES)
def test_sensitivities_of_the_voltage_agree_with_finite_differences(j: int) -> None:
    step = 1e-6 * np.eye(LEARNABLE)[j]
    differences = (voltages(THETA + step)[0] - voltages(THETA - step)[0]) / 2e-6
    np.testing.assert_allclose(voltages(THETA)[1][:, j], differences, atol=1e-7)
    assert np.abs(differences).max() > 1e-3, "the load determines the parameter"


@given(currents_a, currents_a, durations_s, durations_s)
def test_two_steps_under_one_current_equal_one_step(
    before_a: float, current_a: float, first_s: float, second_s: float
) -> None:
    (x, dx), (x_once, dx_once) = steady_state(before_a), steady_state(before_a)
    for dt_s in (first_s, second_s):
        fuel_cell.advance(x, dx, THETA, file_constants(), current_a, dt_s)
    fuel_cell.advance(x_once, dx_once, THETA, file_constants(), current_a, first_s + second_s)
    np.testing.assert_allclose(x, x_once, rtol=1e-9)
    np.testing.assert_allclose(dx, dx_once, rtol=1e-7, atol=1e-9)


def test_the_step_agrees_with_an_independent_integration() -> None:
    values = file_constants()
    tafel_v, farad, internal_a = (values[i] for i in (fuel_cell.TAFEL, fuel_cell.C_DL, fuel_cell.INTERNAL))
    x, dx = steady_state(0.2, np.zeros(LEARNABLE))
    end_v = steady_state(5.0, np.zeros(LEARNABLE))[0][0]

    def voltage_rate(_: float, v: np.ndarray) -> np.ndarray:
        """Return the rate of the activation loss [V/s]."""
        return (5.0 + internal_a) * -np.expm1((v - end_v) / tafel_v) / farad

    expected_v = solve_ivp(voltage_rate, (0.0, 0.02), [x[0]], rtol=1e-11, atol=1e-12).y[0, -1]
    fuel_cell.advance(x, dx, np.zeros(LEARNABLE), values, 5.0, 0.02)
    assert x[0] == pytest.approx(expected_v, abs=1e-8)
    assert 0.01 < end_v - x[0] < 2.0, "the transient has not ended"


@pytest.mark.parametrize("current_a", [0.5, 2.0, 5.0])
def test_a_small_step_decays_with_the_charge_transfer_resistance_of_tafel(current_a: float) -> None:
    """The time constant is C A / I, because the charge transfer resistance is A / I, with A of Tafel's equation."""
    values = file_constants()
    values[fuel_cell.B] = 1e-9  # almost no concentration loss
    relative_step = 1e-3
    reaction_a = current_a + values[fuel_cell.INTERNAL]
    tau_s = values[fuel_cell.C_DL] * values[fuel_cell.TAFEL] / reaction_a
    x, dx = np.zeros(2), np.zeros((2, LEARNABLE))
    fuel_cell.steady_state(x, dx, np.zeros(LEARNABLE), values, current_a)
    start_v = x[0]
    fuel_cell.advance(x, dx, np.zeros(LEARNABLE), values, (1.0 + relative_step) * current_a, tau_s)
    response = (x[0] - start_v) / (values[fuel_cell.TAFEL] / reaction_a * relative_step * current_a)
    assert response == pytest.approx(1.0 - np.exp(-1.0), rel=2e-3)


@given(st.lists(st.floats(-0.4, 0.4), min_size=7, max_size=7))
def test_a_polarisation_curve_falls_for_all_parameters(parameters: list[float]) -> None:
    theta = np.array([*parameters, 0.0])
    current_a = np.linspace(0.0, 15.0, 200)
    voltage_v, _ = polarisation(PEM.a, theta, current_a, np.full(200, np.nan))
    assert np.isfinite(voltage_v).all()
    assert (np.diff(voltage_v) < 0.0).all()


def test_a_constant_current_leads_to_the_polarisation_curve() -> None:
    current_a, no_temperature = np.repeat([1.0, 4.0], 100), np.full(200, np.nan)
    voltage_v, _ = open_loop(PEM.a, THETA, np.arange(200) * 0.1, current_a, no_temperature)
    curve_v, _ = polarisation(PEM.a, THETA, np.array([1.0, 4.0]), no_temperature[:2])
    assert voltage_v[[99, 199]] == pytest.approx(curve_v, abs=1e-9)


@pytest.mark.parametrize("celsius", [20.0, 60.0])
def test_temperature_dependence_of_the_losses_agrees_with_mann(celsius: float) -> None:
    """The resistance is compared at the stack's rated current of 3.25 A and a water content of 14."""
    values, kelvin = np.zeros(LEARNABLE), 273.15 + celsius
    fuel_cell.load_file_constants(values, PEM.a, celsius)
    cells = mann_stack.CELLS
    assert values[fuel_cell.TAFEL] == pytest.approx(-mann_stack.XI_4 * kelvin * cells, rel=1e-3)
    assert values[fuel_cell.ACTIVATION] == pytest.approx(cells * mann_stack._activation_v(kelvin), rel=0.01)
    assert values[fuel_cell.R] == pytest.approx(cells * mann_stack._cell_ohm(3.25, kelvin, 14.0), rel=0.03)
    assert values[fuel_cell.E] == pytest.approx(cells * mann_stack._nernst_v(kelvin), rel=1e-4)


def test_the_model_is_finite_under_charge_and_overload() -> None:
    for current_a in (-5.0, -1e-9, 0.0, 20.0):
        x, dx = steady_state(current_a)
        assert np.isfinite(x).all()
        assert np.isfinite(dx).all()


def test_cell_and_fuel_cell_models_define_the_functions_that_the_learning_law_calls() -> None:
    for function in ("load_constants", "steady_state", "advance", "output", "write"):
        parameter_names = [
            tuple(inspect.signature(getattr(m, function).py_func).parameters)
            for m in (chen_mora_sensitivity, fuel_cell)
        ]
        assert parameter_names[0] == parameter_names[1], function
    assert NAMES == {Model.CHEN_MORA: chen_mora_sensitivity.NAMES, Model.FUEL_CELL: fuel_cell.NAMES}
