"""Parts of the learning law: exact steps and sensitivities of the model, and the step of the parameters.

theta is ln of each parameter over its value in the cell file, psi the derivative of the estimated voltage y^ by theta.
"""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bms_estimator.kernels.cell_model import chen_mora as elements
from bms_estimator.kernels.observer import chen_mora_sensitivity, learning_law
from bms_estimator.kernels.observer.records import LEARNABLE, LEARNING_SETTINGS, LEARNING_STATE
from bms_estimator.model.cell import load_cell

FILE_A = load_cell("chen_mora").a[:16]
"""Parameters of the cell file, a1..a15 at index 1 to 15."""
PARAMETERS = len(chen_mora_sensitivity.NAMES)
CONSTANTS = np.array([0.075, 0.047, 33.0, 0.05, 223.0, 3.8, 0.0, 0.0])
"""Constants of the model: R_s [ohm], R_ts [ohm], tau_ts [s], R_tl [ohm], tau_tl [s], OCV [V], and two unused ones."""
LOAD = [(0.3, 1.0), (-0.2, 40.0), (0.0, 300.0), (0.5, 0.01), (0.1, 90.0)]
"""Load: currents [A] and durations [s]."""
thetas = st.lists(st.floats(-1.2, 1.2), min_size=PARAMETERS, max_size=PARAMETERS)


def simulate(theta: np.ndarray, load: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Simulate a load that starts at rest; return the states, their derivatives by theta, psi, and y^ [V]."""
    x, dx, psi = np.zeros(2), np.zeros((2, LEARNABLE)), np.zeros(LEARNABLE)
    for current_a, dt_s in load:
        chen_mora_sensitivity.advance(x, dx, theta, CONSTANTS, current_a, dt_s)
    voltage_v = chen_mora_sensitivity.output(x, dx, theta, CONSTANTS, load[-1][0], psi)
    return x, dx, psi, voltage_v


@given(thetas)
def test_sensitivities_are_the_derivatives_of_states_and_output(theta: list[float]) -> None:
    center, half_step = np.array(theta + [0.0] * (LEARNABLE - PARAMETERS)), 1e-5
    _, dx, psi, _ = simulate(center, LOAD)
    for j in range(PARAMETERS):
        step = half_step * np.eye(LEARNABLE)[j]
        x_above, _, _, above_v = simulate(center + step, LOAD)
        x_below, _, _, below_v = simulate(center - step, LOAD)
        assert dx[:, j] == pytest.approx((x_above - x_below) / (2 * half_step), abs=1e-9)
        assert psi[j] == pytest.approx((above_v - below_v) / (2 * half_step), abs=1e-9)


@given(thetas, st.floats(1e-3, 1e4), st.integers(2, 50))
def test_a_long_step_equals_many_short_ones(theta: list[float], dt_s: float, parts: int) -> None:
    padded_theta = np.array(theta + [0.0] * (LEARNABLE - PARAMETERS))
    one_step = simulate(padded_theta, [(0.2, 30.0), (-0.1, dt_s)])
    many_steps = simulate(padded_theta, [(0.2, 30.0), *[(-0.1, dt_s / parts)] * parts])
    for expected, result in zip(one_step, many_steps, strict=True):
        assert expected == pytest.approx(result, abs=1e-12)


@given(thetas, st.floats(0.05, 1.0))
def test_the_parameters_that_are_written_for_theta_give_its_circuit_elements(theta: list[float], soc: float) -> None:
    a = np.zeros(16)
    chen_mora_sensitivity.write(np.array(theta), FILE_A, a)
    factor = np.exp(theta)  # of R_s, R_ts, tau_ts, R_tl, tau_tl
    assert elements.r_s(soc, a) == pytest.approx(factor[0] * elements.r_s(soc, FILE_A))
    for r, c, first in ((elements.r_ts, elements.c_ts, 1), (elements.r_tl, elements.c_tl, 3)):
        assert r(soc, a) == pytest.approx(factor[first] * r(soc, FILE_A))
        assert r(soc, a) * c(soc, a) == pytest.approx(factor[first + 1] * r(soc, FILE_A) * c(soc, FILE_A))


@given(st.integers(0, 1000))
def test_a_step_leads_to_the_least_squares_solution_with_leakage_to_the_middle(seed: int) -> None:
    rng = np.random.default_rng(seed)
    state, settings = np.zeros(1, LEARNING_STATE), np.zeros(1, LEARNING_SETTINGS)
    m, q = state[0], settings[0]
    samples = 3
    assert samples < PARAMETERS, "the leakage determines the other parameters"
    psi = rng.normal(size=(samples, PARAMETERS))
    q["count"], q["leak_v2s"][:PARAMETERS], q["middle"][:PARAMETERS] = PARAMETERS, 1e-3, rng.normal(size=PARAMETERS)
    m["information"][:PARAMETERS, :PARAMETERS] = np.tril(psi.T @ psi)
    m["pull"][:PARAMETERS], m["theta"][:PARAMETERS] = psi.T @ rng.normal(size=samples), rng.normal(size=PARAMETERS)
    assert learning_law.solve_parameter_step(state[0], settings[0])
    leakage = np.diag(q["leak_v2s"][:PARAMETERS])
    expected_theta = np.linalg.solve(psi.T @ psi + leakage, m["pull"][:PARAMETERS] + leakage @ q["middle"][:PARAMETERS])
    assert m["theta"][:PARAMETERS] + m["step"][:PARAMETERS] == pytest.approx(expected_theta, rel=1e-6, abs=1e-6)


def test_no_step_is_taken_if_the_information_matrix_is_not_positive_definite() -> None:
    state, settings = np.zeros(1, LEARNING_STATE), np.zeros(1, LEARNING_SETTINGS)
    settings["count"], settings["leak_v2s"] = PARAMETERS, 1e-6
    state["information"][0, 2, 2] = -1.0
    assert not learning_law.solve_parameter_step(state[0], settings[0])
