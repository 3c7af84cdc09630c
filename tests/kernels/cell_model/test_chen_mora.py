"""Elements and exact response of Chen and Mora's cell model.

delta1 and delta2 are the SOCs at which the capacitances C_ts and C_tl are zero: delta(a8, a9, a7) and delta(a11, a12,
a10).
"""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.integrate import solve_ivp

from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model import chen_mora as kernel
from bms_estimator.kernels.cell_model.chen_mora import delta
from bms_estimator.model.cell import load_cell
from bms_estimator.model.cell_sections import TableOcv

CHEN_MORA = load_cell("chen_mora")
PARAMETERS = CHEN_MORA.a
DELTA_1 = delta(PARAMETERS[8], PARAMETERS[9], PARAMETERS[7])
DELTA_2 = delta(PARAMETERS[11], PARAMETERS[12], PARAMETERS[10])


def test_deltas_of_chen_and_mora_have_the_corrected_values() -> None:
    """Erratum 13 of the thesis corrects the values of (2.11) and (2.12)."""
    assert pytest.approx(0.005013, abs=5e-7) == DELTA_1
    assert pytest.approx(0.011156, abs=5e-7) == DELTA_2


def test_deltas_of_table_5_have_the_corrected_values() -> None:
    """The arguments are the parameters of Table 5 of the thesis."""
    assert delta(10.6712, 684.61, 759.2573) == pytest.approx(0.009698, abs=5e-7)
    assert delta(27.5014, 3666.6, 5999.6) == pytest.approx(0.017906, abs=5e-7)


def test_capacitances_are_zero_at_their_delta() -> None:
    assert kernel.c_ts(DELTA_1, PARAMETERS) == pytest.approx(0.0, abs=1e-9)
    assert kernel.c_tl(DELTA_2, PARAMETERS) == pytest.approx(0.0, abs=1e-8)


def test_simulated_cell_agrees_with_an_independent_integration() -> None:
    """The load changes every minute. (2.1)-(2.4) of the thesis are integrated by solve_ivp."""
    levels, level_s = 50, 60
    time_s = np.arange(0.0, levels * level_s, 1.0)
    current_a = np.repeat(np.random.default_rng(3).uniform(0.0, 0.5, levels), level_s)
    capacity_as = 0.275 * 3600.0
    voltage_v, _ = kernel.simulate_cell((1.0, 0.0, 0.0), time_s, current_a, capacity_as, PARAMETERS)

    x = np.array([1.0, 0.0, 0.0])  # SOC and the voltages of both RC pairs
    max_error_v = 0.0
    for j in range(0, len(time_s), level_s):
        i = current_a[j]

        def slope(_t: float, x: np.ndarray, i: float = i) -> list[float]:
            """Return dx/dt."""
            c_ts, c_tl = kernel.c_ts(x[0], PARAMETERS), kernel.c_tl(x[0], PARAMETERS)
            return [
                -i / capacity_as,
                -x[1] / (kernel.r_ts(x[0], PARAMETERS) * c_ts) + i / c_ts,
                -x[2] / (kernel.r_tl(x[0], PARAMETERS) * c_tl) + i / c_tl,
            ]

        solution = solve_ivp(slope, (0.0, level_s), x, t_eval=np.arange(level_s + 1.0), rtol=1e-10, atol=1e-12)
        for m in range(level_s):
            expected_v = kernel.terminal_voltage(tuple(solution.y[:, m]), i, PARAMETERS)
            max_error_v = max(max_error_v, abs(expected_v - voltage_v[j + m]))
        x = solution.y[:, -1]
    assert max_error_v < 1e-4


@given(st.floats(1e-3, 1e3), st.floats(-5, 5), st.floats(-0.5, 0.5), st.floats(1e-3, 1.0), st.floats(0.1, 1e4))
def test_two_steps_equal_one_step_of_twice_the_length(dt: float, i: float, v: float, r: float, tau: float) -> None:
    two_steps = kernel.rc_step(kernel.rc_step(v, i, r, tau, dt), i, r, tau, dt)
    assert two_steps == pytest.approx(kernel.rc_step(v, i, r, tau, 2 * dt), abs=1e-12)


def test_the_ocv_grid_agrees_with_the_formula_to_a_microvolt() -> None:
    value, slope = ocv_grid(CHEN_MORA)
    for soc in np.random.default_rng(1).uniform(0, 1, 500):
        assert kernel.ocv(soc, value, slope) == pytest.approx(kernel.emf(soc, PARAMETERS), abs=1e-6)


@given(st.floats(0, 1))
def test_soc_from_ocv_inverts_the_curve(soc: float) -> None:
    value, slope = ocv_grid(CHEN_MORA)
    assert kernel.soc_from_ocv(kernel.ocv(soc, value, slope), value, slope) == pytest.approx(soc, abs=1e-9)


def test_soc_from_ocv_returns_the_nearest_end_outside_the_curve() -> None:
    value, slope = ocv_grid(CHEN_MORA)
    assert kernel.soc_from_ocv(0.0, value, slope) == 0.0
    assert kernel.soc_from_ocv(9.0, value, slope) == 1.0


def test_an_ocv_table_is_increasing_between_its_points() -> None:
    cell = CHEN_MORA.model_copy(
        update={"ocv": TableOcv(form="table", soc=(0.0, 0.01, 0.5, 0.9, 1.0), ocv_v=(2.5, 3.2, 3.6, 3.61, 4.2))}
    )
    value, slope = ocv_grid(cell)
    ocv_v = [kernel.ocv(x, value, slope) for x in np.linspace(0, 1, 2001)]
    assert (np.diff(ocv_v) > 0).all()
