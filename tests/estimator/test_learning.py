"""Learning law: convergence under an informative load, bounds under any load, and recovery."""

import itertools

import numpy as np
import pytest

from bms_estimator.estimator import Estimator
from bms_estimator.kernels.cell_model.chen_mora import simulate_cell
from bms_estimator.model.sample import SampleBlock
from bms_estimator.settings.observer import IdentifierSettings, ObserverSettings
from bms_estimator.telemetry.charge_energy import ChargeEnergy
from bms_estimator.telemetry.parameters import make_parameters_payload
from bms_estimator.telemetry.publish_window import Window
from bms_estimator.telemetry.remaining_charge import remaining_charge
from bms_estimator.telemetry.state import make_state_payload
from tests.estimator.random_steps import (
    FIRST_SOC,
    RATED_A,
    RESOLUTION_V,
    TRUTH,
    file_off_by,
    held_currents,
    learner,
    measured,
    random_steps,
    relative_errors,
)

NOISE_V = 1e-3
STARTS = list(itertools.product((0.5, 2.0), repeat=5))[::5]
"""Wrong factors of the five parameters: every fifth combination of half and double."""
WRONG_FACTORS = (2.0, 0.5, 2.0, 0.5, 2.0)
TIME_CONSTANTS = [2, 4]
"""Indices of tau_ts and tau_tl among the five parameters."""
K_BOUND = 6.0
"""Maximum of k, at which gamma k is 0.1/s."""


@pytest.fixture(scope="module")
def ten_hours() -> SampleBlock:
    return random_steps(10.0, NOISE_V)


@pytest.mark.parametrize("factors", STARTS, ids=str)
def test_a_load_of_random_steps_determines_all_elements(ten_hours: SampleBlock, factors: tuple[float, ...]) -> None:
    estimator = learner(file_off_by(*factors))
    estimator.run(ten_hours)
    error = relative_errors(estimator, factors)
    assert error[0] < 0.005
    assert error[TIME_CONSTANTS].max() < 0.02


def test_a_constant_current_determines_only_the_sum_of_the_resistances() -> None:
    """In steady state only the sum of the resistances can be observed, and no time constant."""
    factors = (2.0, 0.5, 1.0, 2.0, 0.5)
    rng = np.random.default_rng(1)
    constant = measured(np.full(7200 * 2, 0.1 * RATED_A), NOISE_V, rng)
    estimator = learner(file_off_by(*factors))
    estimator.run(constant)
    assert relative_errors(estimator, factors).max() > 0.4


def test_the_estimated_voltage_is_near_the_true_one_with_200_mv_of_noise() -> None:
    """The error is below a fifth of the noise."""
    noise_v = 0.2
    noisy, clean = random_steps(3.0, noise_v), random_steps(3.0)
    trace = learner(TRUTH).run(noisy)
    true_v = np.interp(trace["time_s"], clean["time_s"], clean["voltage_v"])
    error_v = trace["voltage_estimate_v"] - true_v
    assert np.sqrt(np.mean(np.square(error_v))) < 0.2 * noise_v


def test_an_element_beyond_its_bounds_is_limited(ten_hours: SampleBlock) -> None:
    estimator = learner(file_off_by(8.0, 1.0, 1.0, 1.0, 1.0))
    estimator.run(ten_hours[:7200])
    assert estimator.record[0]["learning"]["theta"][0] == pytest.approx(np.log(0.25))
    assert estimator.state["a"][0, 15] == pytest.approx(2.0 * TRUTH.a[15])


@pytest.mark.parametrize("tau_factors", [(8.0, 0.1), (100.0, 1e-3)], ids=str)
def test_a_file_with_reversed_time_constants_is_accepted(tau_factors: tuple[float, float]) -> None:
    short, long = tau_factors
    estimator = learner(file_off_by(1.0, 1.0, short, 1.0, long))
    q = estimator.settings_record[0]["learning"]
    assert (q["lower"] <= 0.0).all()
    assert (q["upper"] >= 0.0).all()
    estimator.run(random_steps(0.5, NOISE_V))
    theta = estimator.record[0]["learning"]["theta"]
    assert theta[2] < 0.0 < theta[4]


def test_the_dead_zone_keeps_k_constant() -> None:
    block = random_steps(2.0, 0.1 * RESOLUTION_V)
    still, without = learner(TRUTH), learner(TRUTH, dead_zone_v=0.0, epsilon_v=4 * RESOLUTION_V)
    assert (still.run(block)["k"] == 1.0).all()
    assert without.run(block)["k"][-1] > 1.0


def test_k_is_bounded_under_persistent_noise() -> None:
    k = learner(TRUTH).run(random_steps(3.0, 0.05))["k"]
    assert 1.0 < k[600] < K_BOUND
    assert k[-1] == pytest.approx(K_BOUND)


def test_a_k_beyond_its_bound_does_not_disturb_the_parameters() -> None:
    """A checkpoint after hours of noise may contain such a k."""
    estimator, block = learner(file_off_by(*WRONG_FACTORS)), random_steps(10.0, 5e-3)
    estimator.run(block[:1])
    estimator.state["k"] = 113.0
    estimator.run(block[1:])
    assert estimator.state["k"][0] == pytest.approx(K_BOUND)
    assert relative_errors(estimator, WRONG_FACTORS)[[0, *TIME_CONSTANTS]].max() < 0.03


def test_a_jump_of_a_resistance_is_learned() -> None:
    rng = np.random.default_rng(2)
    current_a = held_currents(6.0, rng)
    half = len(current_a) // 2
    before, after = (
        measured(current_a, NOISE_V, np.random.default_rng(3), cell) for cell in (TRUTH, file_off_by(1.5, 1, 1, 1, 1))
    )
    block = before.copy()
    block["voltage_v"][half // 2 :] = after["voltage_v"][half // 2 :]
    estimator = learner(TRUTH)
    estimator.run(block[: half // 2])
    assert relative_errors(estimator, (1.0,) * 5)[0] < 0.01
    estimator.run(block[half // 2 : half // 2 + 1800])
    assert relative_errors(estimator, (1.0 / 1.5, 1, 1, 1, 1))[0] < 0.05
    estimator.run(block[half // 2 + 1800 :])
    assert relative_errors(estimator, (1.0 / 1.5, 1, 1, 1, 1))[0] < 0.01


def test_step_and_run_leave_the_same_state_to_the_last_bit(ten_hours: SampleBlock) -> None:
    at_once, one_by_one = learner(file_off_by(*WRONG_FACTORS)), learner(file_off_by(*WRONG_FACTORS))
    block = ten_hours[:2000]
    at_once.run(block)
    for x in block:
        one_by_one.step(float(x["time_s"]), float(x["current_a"]), float(x["voltage_v"]), 0, float(x["temperature_c"]))
    assert at_once.record.tobytes() == one_by_one.record.tobytes()


def test_the_result_does_not_depend_on_the_sample_rate() -> None:
    """One run is sampled at 1, 10 and 100 Hz. At 1 Hz the time of a current step is uncertain by half a second."""
    current_a = np.repeat(held_currents(2.0, np.random.default_rng(4)), 50)
    time_s = 0.01 * np.arange(len(current_a))
    voltage_v, _ = simulate_cell((FIRST_SOC, 0.0, 0.0), time_s, current_a, 0.275 * 3600.0, TRUTH.a)
    thetas = []
    for every in (1, 10, 100):
        block = np.zeros(len(time_s[::every]), dtype=random_steps(0.01).dtype)
        block["time_s"], block["current_a"] = time_s[::every], current_a[::every]
        block["voltage_v"], block["temperature_c"] = voltage_v[::every], np.nan
        estimator = learner(file_off_by(*WRONG_FACTORS))
        estimator.run(block)
        thetas.append(estimator.record[0]["learning"]["theta"][:5].copy())
    assert thetas[1] == pytest.approx(thetas[0], abs=0.01)
    assert thetas[2] == pytest.approx(thetas[0], abs=0.1)


def test_a_pack_learns_the_scaled_values_of_its_cell(ten_hours: SampleBlock) -> None:
    cell, settings = learner(file_off_by(*WRONG_FACTORS)), ObserverSettings(law="learning")
    pack = Estimator(
        file_off_by(*WRONG_FACTORS).pack(6, 1),
        settings,
        identifier=None,
        initial_soc=FIRST_SOC,
        voltage_resolution_v=6 * RESOLUTION_V,
    )
    pack_samples = ten_hours[:7200].copy()
    pack_samples["voltage_v"] *= 6.0
    cell.run(ten_hours[:7200])
    pack.run(pack_samples)
    theta, cell_theta = (e.record[0]["learning"]["theta"] for e in (pack, cell))
    assert theta == pytest.approx(cell_theta, abs=1e-6)
    assert pack.state["k"][0] == pytest.approx(cell.state["k"][0])


def test_learning_stops_below_the_margins() -> None:
    block = measured(np.full(4 * 7200, 0.1 * RATED_A), 0.0, np.random.default_rng(1))
    estimator = learner(file_off_by(*WRONG_FACTORS), soc=0.02)
    estimator.run(block[:10])
    for part in np.array_split(block[10:], 20):
        theta = estimator.record[0]["learning"]["theta"].copy()
        was_below = estimator.state["adapting"][0] == 0
        trace = estimator.run(part)
        assert np.isfinite(trace["voltage_estimate_v"]).all()
        if was_below:
            assert estimator.record[0]["learning"]["theta"] == pytest.approx(theta, abs=0.0)
    assert estimator.state["adapting"][0] == 0
    assert estimator.state["soc"][0] < estimator.state["delta_2"][0]


@pytest.mark.parametrize("law", ["improved", "learning"])
def test_capacitances_are_positive_with_the_smallest_margin_guard(law: str) -> None:
    with pytest.raises(ValueError, match="margin_guard"):
        ObserverSettings.model_validate({"law": law, "margin_guard": 0.0})
    settings = ObserverSettings.model_validate({"law": law, "margin_guard": 1e-6})
    estimator = Estimator(TRUTH, settings, identifier=None, initial_soc=0.01, voltage_resolution_v=RESOLUTION_V)
    block = measured(np.full(7200, 0.1 * RATED_A), 0.0, np.random.default_rng(1))
    assert np.isfinite(estimator.run(block)["voltage_estimate_v"]).all()
    assert estimator.state["adapting"][0] == 0


def test_a_gap_does_not_change_parameters_and_learning_continues() -> None:
    """The gap is a rest of two hours without samples."""
    rng = np.random.default_rng(5)
    currents_a = held_currents(2.0, rng), np.zeros(2 * 7200), held_currents(3.0, rng)
    block = measured(np.concatenate(currents_a), NOISE_V, rng)
    estimator = learner(TRUTH)
    estimator.run(block[:7200])
    theta = estimator.record[0]["learning"]["theta"].copy()
    estimator.run(block[14_400:14_401])
    assert estimator.state["gaps"][0] == 1
    assert (estimator.record[0]["learning"]["theta"] == theta).all()
    estimator.run(block[14_401:])
    assert relative_errors(estimator, (1.0,) * 5)[[0, *TIME_CONSTANTS]].max() < 0.1


def test_learned_parameters_are_preserved_after_a_restart_under_load(ten_hours: SampleBlock) -> None:
    estimator = learner(file_off_by(*WRONG_FACTORS))
    estimator.run(ten_hours[:28_800])
    before = relative_errors(estimator, WRONG_FACTORS)
    estimator.resume(10.0)
    after_restart = ten_hours[28_800:].copy()
    after_restart["time_s"] -= after_restart["time_s"][0]
    estimator.run(after_restart[:1])
    assert (relative_errors(estimator, WRONG_FACTORS) == before).all()
    estimator.run(after_restart)
    assert np.abs(relative_errors(estimator, WRONG_FACTORS) - before)[[0, *TIME_CONSTANTS]].max() < 0.1


@pytest.mark.parametrize("field", ["theta", "x", "information", "offset_v"])
def test_a_non_finite_state_is_initialized_again(ten_hours: SampleBlock, field: str) -> None:
    estimator = learner(file_off_by(*WRONG_FACTORS))
    estimator.run(ten_hours[:600])
    estimator.record[0]["learning"][field] = np.nan
    trace = estimator.run(ten_hours[600:])
    assert np.isfinite(trace["voltage_estimate_v"][1:]).all()
    assert relative_errors(estimator, WRONG_FACTORS)[0] < 0.01
    assert trace["lock"][-1] == 1


def test_invalid_samples_are_dropped(ten_hours: SampleBlock) -> None:
    dirty, clean = learner(TRUTH), learner(TRUTH)
    clean.run(ten_hours[:600])
    dirty.run(ten_hours[:300])
    dirty.step(300.5, np.nan, 3.8)
    dirty.step(300.5, 0.1, 60.0)
    dirty.run(ten_hours[300:600])
    assert dirty.record["learning"].tobytes() == clean.record["learning"].tobytes()


def test_with_the_filter_the_law_uses_the_soc_of_the_filter_and_learns_its_own_parameters(
    ten_hours: SampleBlock,
) -> None:
    cell = file_off_by(*WRONG_FACTORS)
    estimator = Estimator(
        cell,
        ObserverSettings(law="learning"),
        identifier=IdentifierSettings(),
        initial_soc=FIRST_SOC,
        voltage_resolution_v=RESOLUTION_V,
    )
    estimator.run(ten_hours)
    theta = estimator.record[0]["learning"]["theta"]
    assert estimator.state["soc"][0] == estimator.record["filter"]["soc"][0]
    assert estimator.state["a"][0, 13:16] == pytest.approx(cell.a[13:16] * np.exp([theta[0], 0.0, theta[0]]))
    assert (estimator.state["target"] == estimator.settings["target"]).all()


def test_learned_parameters_are_published_with_their_source(ten_hours: SampleBlock) -> None:
    estimator = learner(file_off_by(*WRONG_FACTORS))
    estimator.run(ten_hours)
    report = make_parameters_payload(estimator, 0.0)
    assert report.a["a15"].source == report.elements["r_s_ohm"].source == "identified"
    assert report.a["a15"].value == estimator.state["a"][0, 15]
    assert "law" in (report.a["a15"].reason or "")
    assert report.a["a14"].source == "configured"


def test_gamma_k_has_its_own_field_and_delta_is_reported_as_configured(ten_hours: SampleBlock) -> None:
    """A law of the thesis, in contrast, has N(k) and adapts the parameters of delta1 and delta2."""
    states = {}
    for law in ("learning", "improved"):
        estimator = Estimator(
            file_off_by(*WRONG_FACTORS), ObserverSettings(law=law), identifier=None, initial_soc=FIRST_SOC
        )
        window = Window()
        window.add(estimator.run(ten_hours[:600]), 0.0)
        summary = window.take()
        assert summary is not None
        states[law] = make_state_payload(summary, remaining_charge(estimator, 0.0), {}, 0.0, ChargeEnergy(), 3.0)
        k = float(estimator.state["k"][0])
        assert states[law].adaptive_gain_k == k
    learning, improved = states["learning"], states["improved"]
    assert learning.adaptive_gain_k is not None
    assert learning.adaptation_gain_hz == pytest.approx(learning.adaptive_gain_k / 60.0)
    assert (learning.nussbaum_gain, learning.delta_configured) == (None, True)
    assert (improved.adaptation_gain_hz, improved.delta_configured) == (None, False)
    assert improved.nussbaum_gain is not None
