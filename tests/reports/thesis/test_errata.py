"""Computed errata of the thesis, compared with results by hand, by simulation, or by an identity.

Numbers in parentheses are equations of the thesis. ``bms_estimator.reports.thesis.errata`` lists the errata by number. x2 and
x3 are the voltages of both RC pairs, y is the terminal voltage, e the voltage error of the observer, u = -N e its
input, N the Nussbaum gain, and ^ marks an estimate.
"""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.stability_conditions import lemma_conditions
from bms_estimator.kernels.cell_model.chen_mora import (
    c_tl,
    c_ts,
    cell_step,
    emf,
    min_stable_exponent,
    r_s,
    r_tl,
    r_ts,
    terminal_voltage,
)
from bms_estimator.kernels.observer.observer import nussbaum_gain
from bms_estimator.model.cell import load_cell
from bms_estimator.reports.thesis import printed_pack, printed_values
from bms_estimator.reports.thesis.errata import errata, ocv_error_ohm
from bms_estimator.reports.thesis.simulated_experiment import pack, resistance_ohm
from bms_estimator.reports.thesis.simulation import Simulation, discharge, observer_settings, table_5_cell
from bms_estimator.reports.thesis.theorem_4_1_2 import quasi_steady

CHEN_MORA = load_cell("chen_mora")
CAPACITY_AS = CHEN_MORA.cell.capacity_ah * 3600.0
ONE_C_A = CHEN_MORA.cell.capacity_ah
"""Current of 1 C, 0.275 A."""
PACK_CAPACITY_AS = 6.6 * 3600.0
"""Capacity of the thesis's pack [A s]."""


@pytest.fixture(scope="module")
def steady_state():
    """Return cell and observer after half an hour at 1 C, when x2 and x3 change slowly."""
    return quasi_steady(CHEN_MORA, ONE_C_A)


def test_x2_and_x3_of_the_observer_have_the_ratio_of_the_time_constants(steady_state):
    """Erratum 15: x2 and x3 of the cell have the ratio of the resistances.

    The time constants are 32.8 s and 223 s, the resistances 46.7 and 49.8 mohm.
    """
    assert steady_state.tau_s == pytest.approx((32.81, 223.03), abs=0.01)
    assert steady_state.observer_v[1] / steady_state.observer_v[0] == pytest.approx(223.03 / 32.81, rel=0.002)
    assert steady_state.cell_v[1] / steady_state.cell_v[0] == pytest.approx(0.04984 / 0.04669, rel=0.001)
    assert 1e3 * np.array(steady_state.observer_v) == pytest.approx([6.01, 40.83], abs=0.01)
    assert 1e3 * np.array(steady_state.cell_v) == pytest.approx([12.84, 13.70], abs=0.01)


def test_the_voltage_error_does_not_vanish_while_a_current_flows(steady_state):
    """Erratum 16: e = -x2 / (N tau_ts) is proportional to the current."""
    assert 1e3 * steady_state.error_v == pytest.approx(-0.183, abs=0.0005)
    assert steady_state.error_v == pytest.approx(steady_state.predicted_v, rel=1e-3)
    small_current = quasi_steady(CHEN_MORA, 1e-4)
    assert 1e6 * small_current.error_v == pytest.approx(-0.0666, abs=0.0001)


def test_the_voltage_of_an_empty_cell_is_not_zero():
    """Erratum 17."""
    assert emf(0.0, CHEN_MORA.a) == pytest.approx(3.685 - 1.031)


def test_the_condition_on_a8_holds_exactly_if_c_ts_is_positive():
    """Erratum 18: a8 exceeds its bound exactly if C_ts > 0, so that the lemma assumes what it proves."""
    rng = np.random.default_rng(0)
    signs = set()
    for a7, a8, a9, soc in rng.uniform((100.0, 1.0, 100.0, 0.001), (1000.0, 50.0, 1000.0, 1.0), (2000, 4)):
        a = np.zeros(16)
        a[7:10] = a7, a8, a9
        is_positive = c_ts(soc, a) > 0.0
        assert (a8 > min_stable_exponent(soc, a9, a7)) == is_positive
        signs.add(is_positive)
    assert signs == {True, False}


def test_initial_values_of_table_10_violate_three_conditions_of_lemma_4_1_1():
    conditions = {c.name: c for c in lemma_conditions(pack())}
    for name, left, right in (
        ("1: a9(0) < a7(0)", 5_100_000, 4_512_000),
        ("2: a12(0) < a10(0)", 42_000_000, 36_300_000),
        ("1: rate of a7 < rate of a9", 135, 130),
    ):
        assert (conditions[name].holds, conditions[name].left, conditions[name].right) == (False, left, right)
    assert conditions["1: P9.l9 < P7.l7"].holds


def test_the_printed_and_the_inferred_weights_of_table_5_both_violate_lemma_4_1_1():
    """The printed weights violate the condition of erratum 6. The weights of erratum 32 violate two other conditions."""
    failing = [[c.name for c in lemma_conditions(cell) if not c.holds] for cell in (CHEN_MORA, table_5_cell())]
    assert failing == [["1: P9.l9 < P7.l7"], ["1: rate of a7 < rate of a9", "2: P12.l12 < P10.l10"]]


def test_r_s_by_the_printed_sign_is_negative():
    """Erratum 19: the cell is half full and discharged with 0.275 A."""
    x, a = (0.5, 0.004, 0.007), CHEN_MORA.a
    y = terminal_voltage(x, ONE_C_A, a)
    assert (y + x[1] + x[2] - emf(0.5, a)) / ONE_C_A == pytest.approx(-r_s(0.5, a))


@pytest.mark.parametrize(("cell", "ohm"), [("chen_mora", 0.727), ("ncr18650", 0.0667), ("thunder_power_6s", 0.0303)])
def test_an_ocv_error_of_10_mv_causes_this_error_of_r_s_at_c_20(cell, ohm):
    assert ocv_error_ohm(load_cell(cell)) == pytest.approx(ohm, rel=1e-3)


def test_the_voltage_sensor_saturates_below_the_voltage_of_the_full_pack():
    """Erratum 20, by hand: 22.195 + 1.9215 x - 1.7590 x^2 + 3.0435 x^3 = 25 (the exponential is below 1e-16 there)."""
    soc = printed_pack.saturated_above_soc()
    assert soc == pytest.approx(0.9437, abs=1e-4)
    assert 22.195 + 1.9215 * soc - 1.7590 * soc**2 + 3.0435 * soc**3 == pytest.approx(25.0, abs=1e-6)
    assert emf(1.0, printed_pack.A) == pytest.approx(25.401)


def test_printed_currents_contradict_ohms_law():
    """The printed currents are smaller than those through the printed resistors by 4 to 10 %."""
    errors = printed_pack.current_errors_percent()
    assert [errors[load] for load in ("50 ohm", "25 ohm", "12.5 ohm")] == pytest.approx([-9.9, -6.3, -3.8], abs=0.05)


def test_the_mean_current_is_that_of_a_simulated_discharge():
    """The simulation discharges the pack through the resistor with all transients."""
    a, ohm, step_s = printed_pack.A, 12.5, 5.0
    x, discharged_as, duration_s, current_a = (1.0, 0.0, 0.0), 0.0, 0.0, 0.0
    while x[0] > printed_pack.EMPTY_SOC:
        current_a = terminal_voltage(x, current_a, a) / ohm
        x = cell_step(x, current_a, step_s, PACK_CAPACITY_AS, a)
        discharged_as, duration_s = discharged_as + step_s * current_a, duration_s + step_s
    assert printed_pack.mean_current_a(ohm) == pytest.approx(discharged_as / duration_s, rel=0.003)


def test_simulated_loads_have_their_nominal_resistance():
    for load in ("50 ohm", "25 ohm", "12.5 ohm"):
        assert f"{resistance_ohm(load):g} ohm" == load
    assert math.isinf(resistance_ohm(""))


def test_rc_products_of_table_10_have_these_mean_errors_against_chen_and_mora():
    """R_ts C_ts and R_tl C_tl of the thesis's pack are compared with those of another battery [%], as in Fig. 29."""
    assert printed_pack.product_errors() == pytest.approx((13.096, 8.942), abs=0.001)


def test_the_derivative_of_the_overpotential_needs_the_rate_of_the_soc():
    """Erratum 23: (4.60) with dE/dx1 x1' equals y1', and with dE/dx1 alone it does not.

    x1 is the SOC, E the open-circuit voltage, and y1 = -x2 - x3 the overpotential. The current is constant, so that
    di/dt = 0.
    """
    a, current_a, dt_s = CHEN_MORA.a, ONE_C_A, 1e-3
    before = (0.5, 0.004, 0.007)
    after = cell_step(before, current_a, dt_s, CAPACITY_AS, a)
    y_rate = (terminal_voltage(after, current_a, a) - terminal_voltage(before, current_a, a)) / dt_s
    y1_rate = -(after[1] + after[2] - before[1] - before[2]) / dt_s
    r_s_rate = (r_s(after[0], a) - r_s(before[0], a)) / dt_s
    emf_slope_v = (emf(0.5 + 1e-6, a) - emf(0.5 - 1e-6, a)) / 2e-6
    soc_rate = -current_a / CAPACITY_AS
    assert y_rate - emf_slope_v * soc_rate + current_a * r_s_rate == pytest.approx(y1_rate, rel=1e-4)
    assert abs(y_rate - emf_slope_v + current_a * r_s_rate) > 1e3 * abs(y1_rate)


def test_inferred_weights_of_a7_have_the_same_ratio_in_both_tables():
    """Erratum 24: the ratio is 14 to 13."""
    for table in ("5", "10"):
        x, y = printed_values.INFERRED_WEIGHTS[table][7]
        assert x / y == 14.0 / 13.0


def test_bounds_of_table_5_and_10_differ_in_a4_only():
    differing = [
        i
        for i in printed_values.BOUNDS
        if printed_values.bounds("5", i).limit != pytest.approx(printed_values.bounds("10", i).limit)
    ]
    assert differing == [4]


@pytest.fixture(scope="module")
def simulation():
    """Return the thesis's simulation of Chen and Mora's cell."""
    return Simulation()


def solve_shift_of_a2(start, law):
    """Return the change of a2 in the first minute by (3.16) of scheme 1 or (3.17) of scheme 2.

    scipy solves the equations of cell, observer and law with tolerances instead of a fixed step: (2.2), (2.3), (3.2),
    (3.3) and (3.12) to (3.14).
    """
    cell, initial_a = CHEN_MORA.a, np.array(printed_values.CHEN_MORA_ROUNDED)
    return_rates = np.array([100.0 if law == "scheme-2" and i in printed_values.SMALL else 0.0 for i in range(1, 16)])
    settings = observer_settings(law, start.lambda_, start.alpha)
    gain = Estimator(CHEN_MORA, settings, identifier=None).settings[0]

    def rates(_, state):
        """Return the derivatives of SOC, RC voltages of cell and observer, k, and a1..a15."""
        (soc, x2, x3, observed_x2, observed_x3, k), a = state[:6], np.r_[0.0, state[6:]]
        n = nussbaum_gain(k, gain)
        e = (observed_x2 + observed_x3 - x2 - x3 - ONE_C_A * r_s(soc, cell)) / (1.0 + n * r_s(soc, a))
        return np.r_[
            -ONE_C_A / CAPACITY_AS,
            (ONE_C_A - x2 / r_ts(soc, cell)) / c_ts(soc, cell),
            (ONE_C_A - x3 / r_tl(soc, cell)) / c_tl(soc, cell),
            -observed_x2 / (r_ts(soc, a) * c_ts(soc, a)) - n * e,
            -observed_x3 / (r_tl(soc, a) * c_tl(soc, a)) - n * e,
            e * e,
            e * e + return_rates * (initial_a - a[1:]),
        ]

    initial_state = np.r_[1.0, 0.0, 0.0, 0.5 * start.start_v, 0.5 * start.start_v, 0.0, initial_a]
    solution = solve_ivp(rates, (0.0, 60.0), initial_state, method="LSODA", rtol=1e-9, atol=1e-12)
    return solution.y[7, -1] - initial_a[1]


@pytest.mark.thorough
@pytest.mark.parametrize("n", [0, 1, 2])
def test_fitted_initial_voltages_give_tables_2_and_3_by_the_differential_equations(simulation, n):
    """Erratum 25: each of the starts fits Tables 2 and 3, and not only with the step of the kernel."""
    start = (simulation.fitted_start, *simulation.other_starts)[n]
    for law, run, shift in (
        ("scheme-1", start.scheme_1, printed_values.TABLE_2_SHIFT),
        ("scheme-2", start.scheme_2, printed_values.TABLE_3_SHIFT),
    ):
        assert run.average[2] - printed_values.CHEN_MORA_ROUNDED[1] == pytest.approx(shift, abs=5e-5)
        after_a_minute = np.interp(60.0, run.time_s, run.a[:, 2]) - printed_values.CHEN_MORA_ROUNDED[1]
        assert solve_shift_of_a2(start, law) == pytest.approx(after_a_minute, abs=2e-4)


def test_the_ohmic_drop_is_part_of_the_observers_rc_voltages(steady_state):
    """Erratum 27: u R_s is 1/1500 of i R_s, and x2^ + x3^ is x2 + x3 of the cell plus the ohmic drop."""
    assert 1e3 * steady_state.ohmic_v == pytest.approx(ONE_C_A * 74.46, abs=0.01)
    assert 1e3 * steady_state.driven_v == pytest.approx(0.0136, abs=0.0001)
    assert sum(steady_state.observer_v) == pytest.approx(sum(steady_state.cell_v) + steady_state.ohmic_v, abs=3e-4)


@pytest.mark.parametrize("law", ["scheme-1", "scheme-2", "scheme-3"])
def test_a13_to_a15_have_nearly_no_effect_in_the_schemes(law):
    """Erratum 27: twice the R_s changes the output by less than 0.05 mV after the first minute."""
    samples = discharge(CHEN_MORA, ONE_C_A, 0.1)[:6000]  # ten minutes at 10 Hz
    estimates_v = []
    for factor in (1.0, 2.0):
        cell = CHEN_MORA.model_copy(update={"adaptation": {}})
        estimator = Estimator(cell, observer_settings(law), identifier=None, voltage_resolution_v=1e-6, initial_soc=1.0)
        estimator.settings[0]["a_initial"][[13, 15]] *= factor
        estimator.settings[0]["target"][[13, 15]] *= factor
        estimates_v.append(estimator.run(samples)["voltage_estimate_v"][600:])
    assert 0.0 < np.abs(estimates_v[1] - estimates_v[0]).max() < 5e-5


@pytest.mark.thorough
def test_the_printed_mean_error_needs_the_largest_error_half_of_the_time(corrections):
    """Erratum 28, by hand: 0.8 f + 0.1 (1 - f) = 0.4744, with the fraction f of the time."""
    assert "at least 53 % of the time" in corrections["E28"]


def test_the_experiments_last_from_two_to_thirty_two_hours(corrections):
    """Erratum 29: 6.6 Ah over 3.652 A, and twice 6.6 Ah over 0.416 A."""
    assert "in 1.8 h" in corrections["E29"]
    assert "takes 31.7 h" in corrections["E29"]


def test_the_bulb_of_the_experiments_draws_80_watts(corrections):
    """Erratum 30: the mean voltage is compared with a simulated discharge with its transients."""
    a, bulb_a, x, voltages_v = printed_pack.A, 3.652, (1.0, 0.0, 0.0), []
    while x[0] > printed_pack.EMPTY_SOC:
        x = cell_step(x, bulb_a, 2.0, PACK_CAPACITY_AS, a)
        voltages_v.append(terminal_voltage(x, bulb_a, a))
    assert printed_pack.mean_voltage_v(bulb_a) == pytest.approx(np.mean(voltages_v), rel=0.003)
    assert "are 80 W and 6.03 Ω" in corrections["E30"]


def test_differences_between_printed_and_true_currents_are_mostly_an_offset():
    """Erratum 31: a sensor with this offset and gain explains the differences within 3 mA."""
    offset_a, gain = printed_pack.current_sensor()
    assert (1e3 * offset_a, 100.0 * gain) == pytest.approx((-39.9, -1.66), abs=0.05)
    for load, ohm in printed_values.RESISTORS_OHM.items():
        true_a = printed_pack.mean_current_a(ohm)
        assert true_a * (1.0 + gain) + offset_a == pytest.approx(printed_values.CURRENTS_A[load], abs=0.003)


def test_estimates_of_table_10_contain_a_part_of_their_initial_values(corrections):
    """Erratum 33: a10 starts at 3.63e7 and its mean is 36.4 above the limit of 6000. a12 starts at 4.2e7, and its mean
    is 29.3 above the limit of 3666.67.
    """
    assert "a10 lies 36.4 above its limit after a start at 3.6e+07" in corrections["E33"]
    assert "a12 lies 29.3 above its limit after a start at 4.2e+07" in corrections["E33"]


@pytest.fixture(scope="module")
def corrections(simulation):
    """Return the corrected text of each erratum by its number: E1, E2 and so on."""
    return {f"E{n}": erratum.corrected for n, erratum in enumerate(errata(simulation), 1)}


def test_there_are_37_errata(corrections):
    assert len(corrections) == 37


def test_delta1_and_delta2_of_generic_cells_are_negative(corrections):
    """Erratum 37: a limit of the model is not a limit of the discharge."""
    assert "they are at most -0.0205" in corrections["E37"]
    assert all(corrections.values())
