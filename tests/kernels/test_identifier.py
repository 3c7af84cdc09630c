"""The identifier's promises: it converges, knows how far to trust itself, and keeps its head for years."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.kernels.identifier_state import LN_TAU_TL, LN_TAU_TS, SOC
from tests.kernels import identifier_cases as cases

TWICE, HALF = (2.0,) * 5, (0.5,) * 5
MIXED, OPPOSED = (2.0, 0.5, 2.0, 2.0, 0.5), (0.5, 2.0, 0.5, 0.5, 2.0)
STARTS = [
    ("cell1_random_steps", TWICE),
    ("cell1_random_steps", MIXED),
    ("cell5_random_steps", TWICE),
    ("cell5_random_steps", OPPOSED),
    ("cell5_relaxation_c2", HALF),
    ("cell5_relaxation_c2", OPPOSED),
    ("cell1_hppc", MIXED),
    ("cell1_hppc", TWICE),
    ("cell5_hppc", HALF),
    ("cell1_dst", TWICE),
    ("cell1_dst", HALF),
]
CHEN_MORA = cases.cell("chen_mora")
CAPACITY_AH = CHEN_MORA.cell.capacity_ah


@pytest.mark.parametrize(("name", "factors"), STARTS)
def test_real_cells_from_a_wrong_start(shared_data: Path, name: str, factors: tuple[float, ...]) -> None:
    """SOC wrong by 0.20, every resistance and time constant by a factor of two."""
    run = cases.identify_capture(shared_data, name, factors)
    dst = name.endswith("dst")
    assert run.soc_rms_percent(3600.0) <= (0.9 if dst else 0.35)
    assert run.coverage() >= 0.9
    assert run.innovation_rms_mv(3600.0) <= (5.0 if dst else 2.2)
    judged = run.after(1800.0)
    assert np.abs(run.error[judged]).max() < 0.02
    tau_ts, tau_tl = run.trace["ln"][:, 2], run.trace["ln"][:, 4]
    assert (tau_tl - tau_ts).min() > np.log(4.5)
    assert np.exp(tau_ts[judged]).min() > 5.0
    assert 0.02 < np.mean(run.trace["nis"][judged]) < 1.0
    assert run.suspected() == 0


@pytest.mark.parametrize("name", cases.ROUND_SOC)
def test_the_shipped_cell_knows_the_soc_of_real_cells(shared_data: Path, name: str) -> None:
    """SOC wrong by 0.20, against what is known of the captures' first SOC without the estimator."""
    run = cases.identify_capture(shared_data, name)
    off = cases.ROUND_SOC[name] - cases.INITIAL_SOC[name]
    judged = run.after(3600.0)
    assert 100.0 * cases.rms(run.error[judged] - off) <= 0.35


@pytest.mark.parametrize(("rate_hz", "hours"), [(0.1, 8.0), (1.0, 6.0), (10.0, 6.0), (100.0, 2.5)])
@pytest.mark.parametrize("factors", [TWICE, HALF])
def test_a_simulated_cell_is_identified_at_any_rate(rate_hz: float, hours: float, factors: tuple[float, ...]) -> None:
    """The same settings from 0.1 to 100 Hz: 16 bit, pulses from full to SOC 0.2 and less."""
    time_s, current_a = cases.pulses(hours, rate_hz, 2.4 / hours * CAPACITY_AH)
    run = cases.identify_simulated(CHEN_MORA, cases.simulate(CHEN_MORA, time_s, current_a), factors)
    assert run.soc_rms_percent(1800.0) < 0.35
    assert run.coverage() > 0.95
    assert run.suspected() == 0
    last = np.flatnonzero(run.soc > 0.2)[-1:]
    errors = np.abs(run.element_errors(CHEN_MORA, last)[0])
    slow = rate_hz < 1.0  # what is faster than the step moves from R_ts to R_s
    assert errors[0] < (0.2 if slow else 0.02)
    assert errors[1] < (0.2 if slow else 0.12)
    assert errors[2:].max() < 0.12


def test_a_thousand_samples_a_second_are_no_more_than_they_are() -> None:
    """Quarter of an hour at 1 kHz: the SOC is right and the elements' uncertainty honest."""
    time_s, current_a = cases.pulses(0.25, 1000.0, 0.3 * CAPACITY_AH)
    run = cases.identify_simulated(CHEN_MORA, cases.simulate(CHEN_MORA, time_s, current_a), TWICE)
    assert run.soc_rms_percent(300.0) < 0.35
    errors = run.element_errors(CHEN_MORA, np.array([-1]))[0]
    assert np.all(np.abs(errors) < 2.5 * run.trace["ln_std"][-1])


def test_uneven_steps() -> None:
    """Steps between samples from 0.05 to 30 s."""
    step_s = np.exp(np.random.default_rng(1).normal(0.0, 1.0, 15_000))
    time_s = np.cumsum(step_s)
    even_s, even_a = cases.pulses(time_s[-1] / 3600.0, 1.0, 0.35 * CAPACITY_AH)
    current_a = even_a[np.minimum(time_s.astype(int), len(even_s) - 1)]
    run = cases.identify_simulated(CHEN_MORA, cases.simulate(CHEN_MORA, time_s, current_a), TWICE)
    assert run.soc_rms_percent(1800.0) < 0.5
    last = np.flatnonzero(run.soc > 0.2)[-1:]
    assert np.abs(run.element_errors(CHEN_MORA, last)).max() < 0.12


@pytest.mark.parametrize("name", ["chen_mora", "ncr18650"])
@pytest.mark.parametrize("factors", [TWICE, MIXED])
def test_charge_and_discharge_with_either_form_of_ocv(name: str, factors: tuple[float, ...]) -> None:
    """(2.10) and a table; the SOC swings about 0.6."""
    model = cases.cell(name)
    time_s, current_a = cases.pulses(10.0, 1.0, 0.8 * model.cell.capacity_ah, both_ways=True, seed=5)
    run = cases.identify_simulated(model, cases.simulate(model, time_s, current_a, soc=0.6), factors)
    assert run.soc_rms_percent(3600.0) < 1.0  # after charge the OCV is known to 30 mV only
    assert run.coverage() > 0.95
    errors = np.abs(run.element_errors(model, np.array([-1]))[0])
    assert errors[0] < 0.02
    assert errors[1:].max() < 0.05


@pytest.mark.parametrize(("bits", "rate_hz", "r_s", "product"), [(16, 10.0, 0.01, 0.05), (10, 100.0, 0.03, 0.12)])
def test_converters_of_16_and_10_bit(bits: int, rate_hz: float, r_s: float, product: float) -> None:
    """RMS error over SOC 0.15..1 of a second discharge, after a first one from a start that is wrong by two."""
    hours = 4.0
    time_s, current_a = cases.pulses(hours, rate_hz, 0.637 * CAPACITY_AH)
    first = cases.simulate(CHEN_MORA, time_s, current_a, bits=bits)
    run = cases.identify_simulated(CHEN_MORA, first, TWICE)
    settings = cases.settings(CHEN_MORA, 1.0, noise_v=first.noise_v, resolution_v=first.resolution_v)
    state = run.state.copy()
    state[0]["mean"][SOC] = 1.0  # charged meanwhile
    state[0]["mean"][[1, 2]] = 0.0
    again = cases.simulate(CHEN_MORA, time_s, current_a, bits=bits, seed=1)
    run = cases.identify(settings, again.time_s, again.current_a, again.voltage_v, again.soc, state)
    samples = np.flatnonzero(run.after(0.0, 0.15))[:: int(10 * rate_hz)]
    errors = np.sqrt(np.mean(np.square(run.element_errors(CHEN_MORA, samples)), axis=0))
    assert errors[0] < r_s
    assert max(errors[2], errors[4]) < product


def test_errors_are_of_the_size_of_their_stds() -> None:
    """NEES of SOC and elements over cells drawn from what the start supposes: consistent, and not overconfident."""
    rng = np.random.default_rng(2)
    nees = []
    for seed in range(8):
        factors = np.exp(rng.normal(0.0, np.log(2.0) * 0.7, 5))
        factors[4] = max(factors[4], 0.5 * factors[2])
        time_s, current_a = cases.pulses(3.0, 1.0, 0.7 * CAPACITY_AH, seed=seed)
        x = cases.simulate(CHEN_MORA, time_s, current_a, seed=seed)
        run = cases.identify_simulated(CHEN_MORA, x, tuple(factors), wrong_soc=rng.normal(0.0, 0.15) - 0.2)
        samples = np.arange(1800, len(time_s), 1800)
        scaled = run.element_errors(CHEN_MORA, samples) / run.trace["ln_std"][samples]
        nees.append(np.mean(np.square(scaled)))
        assert run.coverage() > 0.9
    assert 0.02 < np.mean(nees) < 1.5


def test_resistance_that_grows_is_followed() -> None:
    """30 % in 10 h: R_s at most 5 % behind at any time after the first hour."""
    x = cases.elements(CHEN_MORA, 0.6)
    time_s, current_a = cases.pulses(10.0, 1.0, 0.8 * CAPACITY_AH, both_ways=True, seed=5)
    drop_v, soc = cases.simulate_ageing(time_s, current_a, CAPACITY_AH * 3600.0, 0.6, x, 0.3)
    voltage_v, step_v = cases.convert(cases.ocv(CHEN_MORA, soc) - drop_v, 12, 5.0, np.random.default_rng(0))
    settings = cases.settings(CHEN_MORA, 0.6, noise_v=0.5 * step_v, resolution_v=step_v)
    run = cases.identify(settings, time_s, current_a, voltage_v, soc)
    grown = np.log(1.0 + 0.3 * time_s / time_s[-1])
    lag = run.trace["ln"] - np.log(x) - grown[:, np.newaxis] * [1.0, 1.0, 0.0, 1.0, 0.0]
    assert np.abs(lag[3600:, 0]).max() < 0.05
    assert np.abs(lag[-1, [0, 1, 3]]).max() < 0.05


@pytest.mark.parametrize("rate_per_h", [0.0, 1.0 / 72.0])
def test_what_the_load_does_not_excite_does_not_drift(rate_per_h: float) -> None:
    """24 h of rest, and of constant current, after three hours of pulses."""
    hours = 3.0
    _, pulses_a = cases.pulses(hours, 1.0, 0.5 * CAPACITY_AH)
    time_s = np.arange((hours + 24.0) * 3600.0)
    current_a = np.full(len(time_s), rate_per_h * CAPACITY_AH)
    current_a[: len(pulses_a)] = pulses_a
    run = cases.identify_simulated(CHEN_MORA, cases.simulate(CHEN_MORA, time_s, current_a))
    after = run.trace["ln"][len(pulses_a) + 600]
    assert run.soc[-1] > 0.1
    assert np.abs(run.trace["ln"][-1] - after).max() < 0.02
    assert np.abs(run.error[-1]) < 0.01


def test_a_saved_record_goes_on_bit_by_bit() -> None:
    time_s, current_a = cases.pulses(2.0, 1.0, 0.3)
    x = cases.simulate(CHEN_MORA, time_s, current_a)
    whole = cases.identify_simulated(CHEN_MORA, x, TWICE)
    half = len(time_s) // 2
    settings = cases.settings(CHEN_MORA, 0.8, TWICE, noise_v=x.noise_v, resolution_v=x.resolution_v)
    first = replace(x, time_s=time_s[:half], current_a=current_a[:half], voltage_v=x.voltage_v[:half], soc=x.soc[:half])
    saved = cases.identify_simulated(CHEN_MORA, first, TWICE).state.tobytes()
    state = np.frombuffer(saved, dtype=whole.state.dtype).copy()
    cases.fast(state, settings, 1.0, current_a[half:], x.voltage_v[half:])
    assert state.tobytes() == whole.state.tobytes()


def test_covariance_after_a_million_samples() -> None:
    """Symmetric to the bit, positive, bounded: charge and discharge without end, rests in between."""
    time_s, current_a = cases.pulses(30_000.0 / 3600.0, 1.0, 0.8 * CAPACITY_AH, both_ways=True, seed=5)
    current_a -= np.mean(current_a)
    x = cases.simulate(CHEN_MORA, time_s, current_a, soc=0.6, bits=10)
    settings = cases.settings(CHEN_MORA, 0.4, TWICE, noise_v=x.noise_v, resolution_v=x.resolution_v)
    state = cases.new_state(settings)
    for _ in range(34):
        cases.fast(state, settings, 1.0, current_a, x.voltage_v)
        active = settings[0]["active"]
        covariance = state[0]["covariance"][:active, :active]
        assert np.array_equal(covariance, covariance.T)
        scale = np.sqrt(np.diag(covariance))
        assert np.linalg.eigvalsh(covariance / np.outer(scale, scale)).min() > 0.0
        assert np.all(np.diag(covariance) <= settings[0]["variance_ceiling"][:active])
    mean = state[0]["mean"]
    assert mean[SOC] == pytest.approx(x.soc[-1], abs=0.02)
    assert mean[LN_TAU_TL] - mean[LN_TAU_TS] > np.log(4.5)
    assert state[0]["reset"] == 0


def test_not_finite_goes_back_to_the_last_good_state() -> None:
    time_s, current_a = cases.pulses(1.0, 1.0, 0.3)
    x = cases.simulate(CHEN_MORA, time_s, current_a)
    settings = cases.settings(CHEN_MORA, 0.8, noise_v=x.noise_v, resolution_v=x.resolution_v)
    state = cases.new_state(settings)
    cases.fast(state, settings, 1.0, current_a[:1800], x.voltage_v[:1800])
    before = state[0]["mean"][SOC]
    state[0]["mean"][SOC] = np.nan
    cases.fast(state, settings, 1.0, current_a[1800:1801], x.voltage_v[1800:1801])
    assert state[0]["reset"] == 1
    assert state[0]["mean"][SOC] == pytest.approx(before, abs=0.01)
    cases.fast(state, settings, 1.0, current_a[1801:], x.voltage_v[1801:])
    assert state[0]["mean"][SOC] == pytest.approx(x.soc[-1], abs=0.01)


def test_samples_that_are_none_change_nothing() -> None:
    """Not finite, repeated, or from the past."""
    settings = cases.settings(CHEN_MORA, 0.8)
    state = cases.new_state(settings)
    cases.fast(state, settings, 1.0, np.full(100, 0.1), np.full(100, 3.9))
    mean = state[0]["mean"].copy()
    nan, one, volts = np.array([np.nan]), np.array([0.1]), np.array([3.9])
    for dt_s, current_a, voltage_v in ((1.0, nan, volts), (1.0, one, nan), (np.nan, one, volts), (0.0, one, volts)):
        cases.fast(state, settings, dt_s, current_a, voltage_v)
    cases.fast(state, settings, -5.0, one, volts)
    assert state[0]["ignored"] == 5
    assert np.array_equal(state[0]["mean"], mean)
