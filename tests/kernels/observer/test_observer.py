"""Observer: exact steps, limit of Lemma 4.1.3, tracking, and lock."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from bms_estimator.estimator import Estimator
from bms_estimator.kernels.cell_model.chen_mora import simulate_cell
from bms_estimator.kernels.observer import observer
from bms_estimator.kernels.observer.records import OBSERVER_STATE
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.sample import SAMPLE, SampleBlock
from bms_estimator.settings.observer import ObserverSettings

PRINTED_LAW = ObserverSettings(dead_zone_v=0.0, rearm_gain=None)


def block(time_s: np.ndarray, current_a: np.ndarray, voltage_v: np.ndarray) -> SampleBlock:
    samples = np.zeros(len(time_s), dtype=SAMPLE)
    samples["time_s"], samples["current_a"], samples["voltage_v"] = time_s, current_a, voltage_v
    samples["temperature_c"] = np.nan
    return samples


def discharge(cell: CellModel, hours: float, rate_hz: float, current_a: float) -> SampleBlock:
    time_s = np.arange(int(hours * 3600 * rate_hz)) / rate_hz
    current = np.full(len(time_s), current_a)
    voltage_v, _ = simulate_cell((1.0, 0.0, 0.0), time_s, current, cell.cell.capacity_ah * 3600, cell.a)
    return block(time_s, current, voltage_v)


@given(st.floats(0.0, 50.0), st.floats(-1.0, 1.0), st.floats(0.05, 1e3), st.floats(0.05, 1e4), st.floats(1e-4, 3600.0))
def test_states_step_equals_the_matrix_exponential(
    gain: float, drop_v: float, tau_ts: float, tau_tl: float, dt_s: float
) -> None:
    state = np.zeros(1, dtype=OBSERVER_STATE)
    state["v_ts"], state["v_tl"] = 0.03, -0.02
    observer.states_step(state[0], gain, drop_v, tau_ts, tau_tl, dt_s)
    matrix = np.array(
        [[-1 / tau_ts - gain, -gain, -gain * drop_v], [-gain, -1 / tau_tl - gain, -gain * drop_v], [0.0, 0.0, 0.0]]
    )
    exact = expm(matrix * dt_s) @ [0.03, -0.02, 1.0]
    assert state["v_ts"][0] == pytest.approx(exact[0], abs=1e-9)
    assert state["v_tl"][0] == pytest.approx(exact[1], abs=1e-9)


@pytest.mark.parametrize("rate_hz", [0.1, 1.0, 10.0, 100.0])
def test_parameters_converge_to_the_limit_of_lemma_4_1_3_at_every_sample_rate(rate_hz: float) -> None:
    """Explicit Euler diverges here at 10 Hz and below: rates are 100 to 130 per second."""
    cell = load_cell("chen_mora")
    estimator = Estimator(cell, initial_soc=1.0, identifier=None)
    estimator.run(discharge(cell, 0.1, rate_hz, 0.05))
    for i in range(1, 13):
        assert estimator.state["a"][0, i] == pytest.approx(cell.bounds(i).limit, rel=1e-4)


def test_limits_are_those_of_table_5() -> None:
    cell = load_cell("chen_mora")
    printed = [0.55, 30.0, 0.055, 5.5, 150.0, 0.055, 760.8696, 10.6667, 684.6154, 6000.0, 27.5, 3666.6667]
    assert [cell.bounds(i).limit for i in range(1, 13)] == pytest.approx(printed, rel=1e-4)


def test_runtime_error_falls_below_ten_microvolts_within_seconds() -> None:
    """The valid part of Theorem 4.1.2 (erratum 3) states that the output is tracked."""
    cell = load_cell("chen_mora")
    trace = Estimator(cell, PRINTED_LAW, initial_soc=1.0, identifier=None).run(discharge(cell, 0.2, 100.0, 1e-4))
    settled = trace["time_s"] > 20.0
    assert np.abs(trace["innovation_v"][settled]).max() < 1e-5


def test_dead_zone_of_zero_is_the_printed_law_for_k() -> None:
    """k' = e^2 (3.13): k is the integral of the squared error, here by Simpson from the trace."""
    cell = load_cell("chen_mora")
    trace = Estimator(cell, PRINTED_LAW, initial_soc=0.98, identifier=None).run(discharge(cell, 0.01, 1000.0, 0.275))
    integral = np.trapezoid(trace["innovation_v"] ** 2, trace["time_s"])
    assert trace["k"][-1] - trace["k"][0] == pytest.approx(integral, rel=2e-2)


def thesis_pack_on_an_adc(bits: int, hours: int = 16) -> SampleBlock:
    """E2: 22.2 V, 6.6 Ah, 0.416 A, a 0-25 V divider on an ADC with half a step of noise, 100 Hz.

    The load is taken off above the margins, where the simulated pack would become unstable (E14).
    """
    cell = load_cell("thunder_power_6s")
    time_s = np.arange(hours * 360_000) * 0.01
    current_a = np.where(time_s < 15.5 * 3600, 0.416, 0.0)
    voltage_v, _ = simulate_cell((1.0, 0.0, 0.0), time_s, current_a, 6.6 * 3600, cell.a)
    step_v = 25.0 / 2**bits
    noise = np.random.default_rng(1).uniform(-0.5, 0.5, len(time_s))
    return block(time_s, current_a, step_v * np.round(voltage_v / step_v + noise))


def test_thesis_pack_keeps_lock_for_16_hours_on_a_10_bit_adc() -> None:
    estimator = Estimator(
        load_cell("thunder_power_6s"), voltage_resolution_v=25 / 1024, initial_soc=1.0, identifier=None
    )
    trace = estimator.run(thesis_pack_on_an_adc(10))
    assert len(trace) == 16 * 360_000
    assert trace["lock"].all()
    assert estimator.state["gain_rearms"][0] == 0
    after_start = trace["k"][trace["time_s"] > 60.0]
    assert after_start[-1] - after_start[0] < 0.03
    assert trace["nussbaum_gain"].min() > 0.99


def test_without_dead_zone_lock_is_lost_reported_and_regained() -> None:
    estimator = Estimator(
        load_cell("thunder_power_6s"), PRINTED_LAW, voltage_resolution_v=25 / 1024, initial_soc=1.0, identifier=None
    )
    trace = estimator.run(thesis_pack_on_an_adc(10))
    assert estimator.state["lock_losses"][0] >= 1
    lost = np.flatnonzero(np.diff(trace["lock"]) < 0)
    regained = np.flatnonzero(np.diff(trace["lock"]) > 0)
    assert len(regained) == len(lost) == estimator.state["lock_losses"][0]
    assert trace["lock"].mean() > 0.99
    assert np.isfinite(trace["voltage_estimate_v"]).all()


def test_gain_is_rearmed_before_its_sign_changes() -> None:
    """Load steps also increase k. A service that runs for months must not lose lock because of them."""
    cell = load_cell("chen_mora")
    time_s = np.arange(0.0, 40_000.0, 1.0)
    current_a = np.where(time_s // 20 % 2 == 0, 0.5, -0.5)
    voltage_v, _ = simulate_cell((0.5, 0.0, 0.0), time_s, current_a, 0.275 * 3600, cell.a)
    estimator = Estimator(cell, ObserverSettings(**{"lambda": 50.0}), initial_soc=0.5, identifier=None)
    trace = estimator.run(block(time_s, current_a, voltage_v))
    assert estimator.state["gain_rearms"][0] > 0
    assert trace["nussbaum_gain"].min() >= 0.5
    assert trace["lock"].all()


def test_a_gain_of_the_wrong_sign_changes_and_the_error_decays() -> None:
    """N(k0) < 0 is equivalent to a wrong sign of b: the error grows until N(k) has changed its sign."""
    cell = load_cell("chen_mora")
    time_s = np.arange(0.0, 4_000.0, 1.0)
    current_a = np.full(time_s.size, 0.1)
    voltage_v, _ = simulate_cell((0.9, 0.0, 0.0), time_s, current_a, 0.275 * 3600, cell.a)
    samples = block(time_s, current_a, voltage_v + 0.2 * np.where(time_s // 20 % 2 == 0, 1.0, -1.0))
    settings = ObserverSettings(nussbaum="k2-cos", k0=2.0, dead_zone_v=0.0, rearm_gain=None)
    estimator = Estimator(cell, settings, initial_soc=0.9, identifier=None)
    trace = estimator.run(samples)
    gain, error_v = trace["nussbaum_gain"], np.abs(trace["tracking_error_v"])
    assert gain[0] < 0.0 < gain[-1]
    assert error_v.max() > 10.0 * 0.4  # ten times the disturbance
    assert error_v[-20:].max() < 0.41  # the disturbance alone
    assert estimator.state["lock_losses"][0] == 0


@pytest.mark.parametrize("nussbaum", ["k2-cos", "k-cos-sqrt", "ln-cos-sqrt-ln"])
def test_a_gain_that_starts_at_zero_is_not_rearmed(nussbaum: str) -> None:
    cell = load_cell("chen_mora")
    estimator = Estimator(cell, ObserverSettings(nussbaum=nussbaum), initial_soc=0.9, identifier=None)
    estimator.run(discharge(cell, 0.1, 10.0, 0.275))
    assert estimator.state["gain_rearms"][0] == 0
    assert estimator.state["k"][0] > 0.0


def test_a_capacitance_is_never_evaluated_where_it_is_negative() -> None:
    """A limit moves delta1 above the SOC within one sample. The margins are updated before the states."""
    cell = load_cell("chen_mora")
    estimator = Estimator(cell, initial_soc=0.5, identifier=None)
    samples = discharge(cell, 0.02, 1.0, 0.0)
    estimator.run(samples[:5])
    estimator.state["target"][0, 7] = 1e3 * estimator.state["a"][0, 9]
    trace = estimator.run(samples[5:])
    assert trace["delta_1"].max() > 0.5
    assert np.abs(trace["voltage_estimate_v"] - samples["voltage_v"][5:]).max() < 0.5
    assert np.isfinite(trace["voltage_estimate_v"]).all()


def test_adaptation_stops_above_the_margin_and_is_reported() -> None:
    cell = load_cell("chen_mora")
    trace = Estimator(cell, initial_soc=1.0, identifier=None)
    samples = discharge(cell, 0.95, 1.0, 0.275)
    samples["current_a"] *= 1.2  # coulomb counting reaches empty before the cell does
    rows = trace.run(samples)
    assert rows["soc"][-1] < max(rows["delta_1"][-1], rows["delta_2"][-1])
    assert rows["stability_margin"][-1] < 0
    assert trace.state["adapting"][0] == 0
    assert np.isfinite(rows["voltage_estimate_v"]).all()
    assert np.isfinite(trace.state["a"][0]).all()


@pytest.mark.parametrize("law", ["scheme-1", "scheme-2", "scheme-3"])
def test_schemes_track_the_cell_they_start_from(law: str) -> None:
    cell = load_cell("chen_mora").model_copy(update={"adaptation": {}})
    settings = ObserverSettings(law=law, dead_zone_v=0.0, rearm_gain=None)  # type: ignore[arg-type]
    estimator = Estimator(cell, settings, initial_soc=1.0, identifier=None)
    trace = estimator.run(discharge(cell, 0.5, 100.0, 0.0275))
    settled = trace["time_s"] > 60
    assert np.abs(trace["innovation_v"][settled]).max() < 5e-3
    assert (estimator.state["a"][0, 1:] > 0).all()
