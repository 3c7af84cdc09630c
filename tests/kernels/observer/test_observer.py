"""Observer of the thesis: exact steps, limits of the parameters, tracking of the voltage, and lock.

Numbers in parentheses are equations of the thesis. docs/theory/thesis.md lists the differences between observer and
thesis. k is the adaptive gain, and N(k) the Nussbaum gain. The lock is lost while the error of the voltage is too
large.
"""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.linalg import expm

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.cell_model.chen_mora import simulate_cell
from bms_estimator.kernels.observer import observer
from bms_estimator.kernels.observer.records import OBSERVER_STATE
from bms_estimator.model.arrays import SAMPLE, SampleBlock
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.settings.observer import ObserverSettings

THESIS_LAW = ObserverSettings(dead_zone_v=0.0, rearm_gain=None)
"""Adaptation law as printed: every error raises k, and k is never reset."""


def make_samples(time_s: np.ndarray, current_a: np.ndarray, voltage_v: np.ndarray) -> SampleBlock:
    """Return samples without a temperature."""
    samples = np.zeros(len(time_s), dtype=SAMPLE)
    samples["time_s"], samples["current_a"], samples["voltage_v"] = time_s, current_a, voltage_v
    samples["temperature_c"] = np.nan
    return samples


def simulate_discharge(cell: CellModel, hours: float, rate_hz: float, current_a: float) -> SampleBlock:
    """Return samples of ``cell`` from full under the constant current ``current_a`` [A]."""
    time_s = np.arange(int(hours * 3600 * rate_hz)) / rate_hz
    current = np.full(len(time_s), current_a)
    voltage_v, _ = simulate_cell((1.0, 0.0, 0.0), time_s, current, cell.cell.capacity_ah * 3600, cell.a)
    return make_samples(time_s, current, voltage_v)


@given(st.floats(0.0, 50.0), st.floats(-1.0, 1.0), st.floats(0.05, 1e3), st.floats(0.05, 1e4), st.floats(1e-4, 3600.0))
def test_a_step_of_the_rc_voltages_equals_the_matrix_exponential(
    gain: float, drop_v: float, tau_ts: float, tau_tl: float, dt_s: float
) -> None:
    state = np.zeros(1, dtype=OBSERVER_STATE)
    state["v_ts"], state["v_tl"] = 0.03, -0.02
    observer.states_step(state[0], gain, drop_v, tau_ts, tau_tl, dt_s)
    matrix = np.array(
        [[-1 / tau_ts - gain, -gain, -gain * drop_v], [-gain, -1 / tau_tl - gain, -gain * drop_v], [0.0, 0.0, 0.0]]
    )
    # The third state is the constant 1.
    exact = expm(matrix * dt_s) @ [0.03, -0.02, 1.0]
    assert state["v_ts"][0] == pytest.approx(exact[0], abs=1e-9)
    assert state["v_tl"][0] == pytest.approx(exact[1], abs=1e-9)


@pytest.mark.parametrize("rate_hz", [0.1, 1.0, 10.0, 100.0])
def test_parameters_converge_to_the_limits_of_the_thesis_at_every_sample_rate(rate_hz: float) -> None:
    """The limits are those of Lemma 4.1.3. The parameters converge at rates of 100 to 130 per second, so that explicit
    Euler would diverge at 10 Hz and below.
    """
    cell = load_cell("chen_mora")
    estimator = Estimator(cell, initial_soc=1.0, identifier=None)
    estimator.run(simulate_discharge(cell, hours=0.1, rate_hz=rate_hz, current_a=0.05))
    for i in range(1, 13):
        assert estimator.state["a"][0, i] == pytest.approx(cell.bounds(i).limit, rel=1e-4)


def test_limits_of_the_parameters_are_those_of_table_5_of_the_thesis() -> None:
    cell = load_cell("chen_mora")
    printed_limits = [0.55, 30.0, 0.055, 5.5, 150.0, 0.055, 760.8696, 10.6667, 684.6154, 6000.0, 27.5, 3666.6667]
    assert [cell.bounds(i).limit for i in range(1, 13)] == pytest.approx(printed_limits, rel=1e-4)


def test_the_voltage_error_falls_below_ten_microvolts_within_20_seconds() -> None:
    """Theorem 4.1.2 of the thesis is partly wrong (erratum 3).

    The test checks the right part, that the output is tracked.
    """
    cell = load_cell("chen_mora")
    trace = Estimator(cell, THESIS_LAW, initial_soc=1.0, identifier=None).run(
        simulate_discharge(cell, hours=0.2, rate_hz=100.0, current_a=1e-4)
    )
    settled = trace["time_s"] > 20.0
    assert np.abs(trace["innovation_v"][settled]).max() < 1e-5


def test_without_a_dead_zone_k_grows_by_the_printed_law() -> None:
    """By (3.13), k' = e^2. The integral of the squared error is computed from the trace by the trapezoidal rule."""
    cell = load_cell("chen_mora")
    trace = Estimator(cell, THESIS_LAW, initial_soc=0.98, identifier=None).run(
        simulate_discharge(cell, hours=0.01, rate_hz=1000.0, current_a=0.275)
    )
    integral = np.trapezoid(trace["innovation_v"] ** 2, trace["time_s"])
    assert trace["k"][-1] - trace["k"][0] == pytest.approx(integral, rel=2e-2)


DIVIDER_V = 25.0
"""Voltage range of the ADC with its divider [V]."""
ADC_STEPS = 1024
SAMPLES_PER_HOUR = 360_000
HOURS_TO_FIRST_LOSS = 5
"""Hours within which the lock is lost and regained once if there is no dead zone."""


@cache
def thesis_pack_on_an_adc(hours: int) -> SampleBlock:
    """Return samples at 100 Hz of the first hours of the thesis's pack, measured by a real converter (erratum 2).

    The pack has 22.2 V and 6.6 Ah and is discharged with 0.416 A. A divider for 0 to 25 V and an ADC with half a step
    of noise measure its voltage. The load ends before the SOC falls below delta1 and delta2, at which the simulated
    pack would become unstable (erratum 14).
    """
    cell = load_cell("thunder_power_6s")
    time_s = np.arange(hours * SAMPLES_PER_HOUR) * 0.01
    load_end_s = 15.5 * 3600
    current_a = np.where(time_s < load_end_s, 0.416, 0.0)
    voltage_v, _ = simulate_cell((1.0, 0.0, 0.0), time_s, current_a, 6.6 * 3600, cell.a)
    step_v = DIVIDER_V / ADC_STEPS
    noise = np.random.default_rng(1).uniform(-0.5, 0.5, len(time_s))
    return make_samples(time_s, current_a, step_v * np.round(voltage_v / step_v + noise))


@pytest.mark.parametrize("hours", [HOURS_TO_FIRST_LOSS, pytest.param(16, marks=pytest.mark.thorough)])
def test_the_lock_is_held_for_hours_with_a_10_bit_adc(hours: int) -> None:
    estimator = Estimator(
        load_cell("thunder_power_6s"), voltage_resolution_v=DIVIDER_V / ADC_STEPS, initial_soc=1.0, identifier=None
    )
    trace = estimator.run(thesis_pack_on_an_adc(hours))
    assert len(trace) == hours * SAMPLES_PER_HOUR
    assert trace["lock"].all()
    assert estimator.state["gain_rearms"][0] == 0
    after_start = trace["k"][trace["time_s"] > 60.0]
    assert after_start[-1] - after_start[0] < 0.03
    assert trace["nussbaum_gain"].min() > 0.99


def test_without_a_dead_zone_the_lock_is_lost_and_regained_and_losses_are_counted() -> None:
    estimator = Estimator(
        load_cell("thunder_power_6s"),
        THESIS_LAW,
        voltage_resolution_v=DIVIDER_V / ADC_STEPS,
        initial_soc=1.0,
        identifier=None,
    )
    trace = estimator.run(thesis_pack_on_an_adc(HOURS_TO_FIRST_LOSS))
    assert estimator.state["lock_losses"][0] >= 1
    lost = np.flatnonzero(np.diff(trace["lock"]) < 0)
    regained = np.flatnonzero(np.diff(trace["lock"]) > 0)
    assert len(regained) == len(lost) == estimator.state["lock_losses"][0]
    assert trace["lock"].mean() > 0.99
    assert np.isfinite(trace["voltage_estimate_v"]).all()


def test_the_gain_is_rearmed_before_its_sign_changes() -> None:
    """Load steps also increase k, on which the sign of N(k) depends.

    They must not cause a loss of lock within months.
    """
    cell = load_cell("chen_mora")
    time_s = np.arange(0.0, 40_000.0, 1.0)
    current_a = np.where(time_s // 20 % 2 == 0, 0.5, -0.5)  # a step every 20 s
    voltage_v, _ = simulate_cell((0.5, 0.0, 0.0), time_s, current_a, 0.275 * 3600, cell.a)
    estimator = Estimator(cell, ObserverSettings(**{"lambda": 50.0}), initial_soc=0.5, identifier=None)
    trace = estimator.run(make_samples(time_s, current_a, voltage_v))
    assert estimator.state["gain_rearms"][0] > 0
    assert trace["nussbaum_gain"].min() >= 0.5
    assert trace["lock"].all()


def test_a_gain_with_the_wrong_sign_changes_its_sign_and_the_error_decays() -> None:
    """N(k0) < 0 has the effect of a wrong sign of the input gain. The error grows until N(k) has changed its sign."""
    cell = load_cell("chen_mora")
    time_s = np.arange(0.0, 4_000.0, 1.0)
    current_a = np.full(time_s.size, 0.1)
    voltage_v, _ = simulate_cell((0.9, 0.0, 0.0), time_s, current_a, 0.275 * 3600, cell.a)
    disturbance_v = 0.2
    square_wave_v = disturbance_v * np.where(time_s // 20 % 2 == 0, 1.0, -1.0)
    samples = make_samples(time_s, current_a, voltage_v + square_wave_v)
    settings = ObserverSettings(nussbaum="k2-cos", k0=2.0, dead_zone_v=0.0, rearm_gain=None)
    estimator = Estimator(cell, settings, initial_soc=0.9, identifier=None)
    trace = estimator.run(samples)
    gain, error_v = trace["nussbaum_gain"], np.abs(trace["tracking_error_v"])
    assert gain[0] < 0.0 < gain[-1]
    step_of_disturbance_v = 2.0 * disturbance_v
    assert error_v.max() > 10.0 * step_of_disturbance_v
    assert error_v[-20:].max() < step_of_disturbance_v + 0.01
    assert estimator.state["lock_losses"][0] == 0


@pytest.mark.parametrize("nussbaum", ["k2-cos", "k-cos-sqrt", "ln-cos-sqrt-ln"])
def test_a_gain_that_starts_at_zero_is_not_rearmed(nussbaum: str) -> None:
    cell = load_cell("chen_mora")
    estimator = Estimator(cell, ObserverSettings(nussbaum=nussbaum), initial_soc=0.9, identifier=None)
    estimator.run(simulate_discharge(cell, hours=0.1, rate_hz=10.0, current_a=0.275))
    assert estimator.state["gain_rearms"][0] == 0
    assert estimator.state["k"][0] > 0.0


def test_the_estimate_stays_finite_when_a_new_target_makes_a_capacitance_negative() -> None:
    """A new target of a7 moves delta1, below which C_ts is negative, above the SOC within one sample. The deltas are
    updated before the states.
    """
    cell = load_cell("chen_mora")
    estimator = Estimator(cell, initial_soc=0.5, identifier=None)
    samples = simulate_discharge(cell, hours=0.02, rate_hz=1.0, current_a=0.0)
    estimator.run(samples[:5])
    # delta1 increases with a7 / a9
    estimator.state["target"][0, 7] = 1e3 * estimator.state["a"][0, 9]
    trace = estimator.run(samples[5:])
    assert trace["delta_1"].max() > 0.5
    assert np.abs(trace["voltage_estimate_v"] - samples["voltage_v"][5:]).max() < 0.5
    assert np.isfinite(trace["voltage_estimate_v"]).all()


def test_adaptation_stops_below_delta1_and_delta2_and_the_stop_is_reported() -> None:
    cell = load_cell("chen_mora")
    estimator = Estimator(cell, initial_soc=1.0, identifier=None)
    samples = simulate_discharge(cell, hours=0.95, rate_hz=1.0, current_a=0.275)
    samples["current_a"] *= 1.2  # the counted SOC reaches 0 before the true SOC does
    trace = estimator.run(samples)
    assert trace["soc"][-1] < max(trace["delta_1"][-1], trace["delta_2"][-1])
    assert estimator.state["adapting"][0] == 0
    assert np.isfinite(trace["voltage_estimate_v"]).all()
    assert np.isfinite(estimator.state["a"][0]).all()


@pytest.mark.parametrize("law", ["scheme-1", "scheme-2", "scheme-3"])
def test_schemes_of_the_thesis_track_a_cell_with_their_initial_parameters(law: str) -> None:
    cell = load_cell("chen_mora").model_copy(update={"adaptation": {}})
    settings = ObserverSettings(law=law, dead_zone_v=0.0, rearm_gain=None)  # type: ignore[arg-type]
    estimator = Estimator(cell, settings, initial_soc=1.0, identifier=None)
    trace = estimator.run(simulate_discharge(cell, hours=0.5, rate_hz=100.0, current_a=0.0275))
    settled = trace["time_s"] > 60
    assert np.abs(trace["innovation_v"][settled]).max() < 5e-3
    assert (estimator.state["a"][0, 1:] > 0).all()
