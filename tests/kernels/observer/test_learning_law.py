"""Parts of the learning law: exact steps and sensitivities of the model, balance of information and leakage."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bms_estimator.kernels.cell_model import chen_mora as elements
from bms_estimator.kernels.observer import chen_mora_sensitivity, learning_law
from bms_estimator.kernels.observer.learning_records import LEARNABLE, LEARNING_SETTINGS, LEARNING_STATE
from bms_estimator.model.cell import load_cell

A = load_cell("chen_mora").a[:16]
COUNT = len(chen_mora_sensitivity.NAMES)
GIVEN = np.array([0.075, 0.047, 33.0, 0.05, 223.0, 3.8, 0.0, 0.0])
LOAD = [(0.3, 1.0), (-0.2, 40.0), (0.0, 300.0), (0.5, 0.01), (0.1, 90.0)]
"""Currents [A] and durations [s]."""
thetas = st.lists(st.floats(-1.2, 1.2), min_size=COUNT, max_size=COUNT)


def after(theta: np.ndarray, load: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return states, derivatives, psi and y^ [V] after a load that starts at rest."""
    x, dx, psi = np.zeros(2), np.zeros((2, LEARNABLE)), np.zeros(LEARNABLE)
    for current_a, dt_s in load:
        chen_mora_sensitivity.advance(x, dx, theta, GIVEN, current_a, dt_s)
    voltage_v = chen_mora_sensitivity.output(x, dx, theta, GIVEN, load[-1][0], psi)
    return x, dx, psi, voltage_v


@given(thetas)
def test_sensitivities_are_the_derivatives_of_states_and_output(theta: list[float]) -> None:
    at, h = np.array(theta + [0.0] * (LEARNABLE - COUNT)), 1e-5
    _, dx, psi, _ = after(at, LOAD)
    for j in range(COUNT):
        step = h * np.eye(LEARNABLE)[j]
        up, down = after(at + step, LOAD), after(at - step, LOAD)
        assert dx[:, j] == pytest.approx((up[0] - down[0]) / (2 * h), abs=1e-9)
        assert psi[j] == pytest.approx((up[3] - down[3]) / (2 * h), abs=1e-9)


@given(thetas, st.floats(1e-3, 1e4), st.integers(2, 50))
def test_a_long_step_equals_many_short_ones(theta: list[float], dt_s: float, parts: int) -> None:
    at = np.array(theta + [0.0] * (LEARNABLE - COUNT))
    whole = after(at, [(0.2, 30.0), (-0.1, dt_s)])
    split = after(at, [(0.2, 30.0), *[(-0.1, dt_s / parts)] * parts])
    for one, other in zip(whole, split, strict=True):
        assert one == pytest.approx(other, abs=1e-12)


@given(thetas, st.floats(0.05, 1.0))
def test_written_parameters_have_the_elements_of_theta(theta: list[float], soc: float) -> None:
    a = np.zeros(16)
    chen_mora_sensitivity.write(np.array(theta), A, a)
    ratio = np.exp(theta)
    assert elements.r_s(soc, a) == pytest.approx(ratio[0] * elements.r_s(soc, A))
    for r, c, at in ((elements.r_ts, elements.c_ts, 1), (elements.r_tl, elements.c_tl, 3)):
        assert r(soc, a) == pytest.approx(ratio[at] * r(soc, A))
        assert r(soc, a) * c(soc, a) == pytest.approx(ratio[at + 1] * r(soc, A) * c(soc, A))


@given(st.integers(0, 1000))
def test_the_step_solves_for_the_balance_of_information_and_leakage(seed: int) -> None:
    rng = np.random.default_rng(seed)
    state, settings = np.zeros(1, LEARNING_STATE), np.zeros(1, LEARNING_SETTINGS)
    m, q = state[0], settings[0]
    psi = rng.normal(size=(3, COUNT))  # fewer rows than parameters: the leakage determines the others
    q["count"], q["leak_v2s"][:COUNT], q["middle"][:COUNT] = COUNT, 1e-3, rng.normal(size=COUNT)
    m["information"][:COUNT, :COUNT] = np.tril(psi.T @ psi)
    m["pull"][:COUNT], m["theta"][:COUNT] = psi.T @ rng.normal(size=3), rng.normal(size=COUNT)
    assert learning_law.solve_parameter_step(state[0], settings[0])
    ridge = np.diag(q["leak_v2s"][:COUNT])
    balance = np.linalg.solve(psi.T @ psi + ridge, m["pull"][:COUNT] + ridge @ q["middle"][:COUNT])
    assert m["theta"][:COUNT] + m["step"][:COUNT] == pytest.approx(balance, rel=1e-6, abs=1e-6)


def test_theta_is_unchanged_if_the_matrix_is_not_positive_definite() -> None:
    state, settings = np.zeros(1, LEARNING_STATE), np.zeros(1, LEARNING_SETTINGS)
    settings["count"], settings["leak_v2s"] = COUNT, 1e-6
    state["information"][0, 2, 2] = -1.0
    assert not learning_law.solve_parameter_step(state[0], settings[0])
