"""Learning law: convergence under an informative load, bounds under any load, and recovery."""

import itertools

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.cell_model.chen_mora import simulate_cell
from bms_estimator.model.arrays import SAMPLE, SampleBlock
from bms_estimator.settings.observer import IdentifierSettings, ObserverSettings
from bms_estimator.telemetry.parameters import make_parameters_payload
from bms_estimator.telemetry.publish_window import ChargeEnergy, Window
from bms_estimator.telemetry.state import make_state_payload, no_forecast, remaining_capacity_ah
from tests.estimator.random_steps import (
    FIRST_SOC,
    HALF_SECONDS_PER_HOUR,
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
from tests.estimator.simulated_cell import run_divided

NOISE_V = 1e-3
"""Std of the voltage noise [V]."""
INITIAL_FACTORS = list(itertools.product((0.5, 2.0), repeat=5))[::5]
"""Wrong factors of the five parameters: every fifth combination of half and double."""
WRONG_FACTORS = (2.0, 0.5, 2.0, 0.5, 2.0)
R_S = 0
TIME_CONSTANTS = [2, 4]
"""Indices of R_s, and of tau_ts and tau_tl, among the five parameters R_s, R_ts, tau_ts, R_tl, tau_tl."""
K_BOUND = 6.0
"""Maximum of the adaptive gain k, at which gamma k is 0.1/s."""


@pytest.fixture(scope="module")
def ten_hours() -> SampleBlock:
    """Return ten hours of the true cell under random steps at 1 Hz."""
    return random_steps(10.0, NOISE_V)


@pytest.mark.parametrize("factors", INITIAL_FACTORS, ids=str)
def test_random_current_steps_determine_r_s_and_both_time_constants(
    ten_hours: SampleBlock, factors: tuple[float, ...]
) -> None:
    estimator = learner(file_off_by(*factors))
    estimator.run(ten_hours)
    error = relative_errors(estimator, factors)
    assert error[R_S] < 0.005
    assert error[TIME_CONSTANTS].max() < 0.02


def test_the_reasons_are_settling_after_a_start_under_load_and_then_learned() -> None:
    block = random_steps(1.0)
    block = block[int(np.argmax(block["current_a"] > 0.1)) :]
    estimator, reasons = learner(TRUTH), []
    for part in (block[:60], block[60:]):
        estimator.run(part)
        report = make_parameters_payload(estimator, 0.0)
        reasons.append({report.a["a13"].reason, report.elements["r_s_ohm"].reason})
    assert reasons == [
        {"settling after a start under load or a gap: nothing is learned for another 19 min"},
        {"learned by the adaptive law, which gives no std"},
    ]


def test_a_constant_current_does_not_determine_the_parameters() -> None:
    """In steady state only the sum of the resistances can be observed, and no time constant."""
    factors = (2.0, 0.5, 1.0, 2.0, 0.5)
    rng = np.random.default_rng(1)
    constant = measured(np.full(2 * HALF_SECONDS_PER_HOUR, 0.1 * RATED_A), NOISE_V, rng)
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


def test_a_parameter_is_limited_to_a_quarter_of_its_value_in_the_file(ten_hours: SampleBlock) -> None:
    """R_s of the file is 8 times the true one, so that the learned value is still twice the true one."""
    estimator = learner(file_off_by(8.0, 1.0, 1.0, 1.0, 1.0))
    estimator.run(ten_hours[:7200])
    assert estimator.record[0]["learning"]["theta"][R_S] == pytest.approx(np.log(0.25))
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
    tau_ts, tau_tl = TIME_CONSTANTS
    assert theta[tau_ts] < 0.0 < theta[tau_tl]


def test_k_stays_constant_if_the_innovation_is_within_the_dead_zone() -> None:
    block = random_steps(2.0, 0.1 * RESOLUTION_V)
    with_dead_zone, without = learner(TRUTH), learner(TRUTH, dead_zone_v=0.0, epsilon_v=4 * RESOLUTION_V)
    assert (with_dead_zone.run(block)["k"] == 1.0).all()
    assert without.run(block)["k"][-1] > 1.0


def test_k_is_bounded_under_persistent_noise() -> None:
    k = learner(TRUTH).run(random_steps(3.0, 0.05))["k"]
    assert 1.0 < k[600] < K_BOUND
    assert k[-1] == pytest.approx(K_BOUND)


def test_a_k_beyond_its_bound_does_not_disturb_the_parameters() -> None:
    """A checkpoint after hours of noise may contain such a k."""
    estimator, block = learner(file_off_by(*WRONG_FACTORS)), random_steps(10.0, 5e-3)
    estimator.run(block[:1])
    estimator.state["k"] = 113.0  # far above ``K_BOUND``
    estimator.run(block[1:])
    assert estimator.state["k"][0] == pytest.approx(K_BOUND)
    assert relative_errors(estimator, WRONG_FACTORS)[[R_S, *TIME_CONSTANTS]].max() < 0.03


def test_a_jump_of_a_resistance_is_learned_within_half_an_hour() -> None:
    """R_s rises to 1.5 times its value after three hours.

    The samples are at 1 Hz, one for two values of ``current_a``.
    """
    current_a = held_currents(6.0, np.random.default_rng(2))
    jump = len(current_a) // 4
    half_an_hour_later = jump + 1800
    before, after = (
        measured(current_a, NOISE_V, np.random.default_rng(3), cell) for cell in (TRUTH, file_off_by(1.5, 1, 1, 1, 1))
    )
    block = before.copy()
    block["voltage_v"][jump:] = after["voltage_v"][jump:]
    estimator = learner(TRUTH)
    estimator.run(block[:jump])
    assert relative_errors(estimator, (1.0,) * 5)[R_S] < 0.01
    factors_after_jump = (1.0 / 1.5, 1, 1, 1, 1)
    estimator.run(block[jump:half_an_hour_later])
    assert relative_errors(estimator, factors_after_jump)[R_S] < 0.05
    estimator.run(block[half_an_hour_later:])
    assert relative_errors(estimator, factors_after_jump)[R_S] < 0.01


def test_step_and_run_leave_the_same_state_to_the_last_bit(ten_hours: SampleBlock) -> None:
    run_divided(lambda: learner(file_off_by(*WRONG_FACTORS)), ten_hours[:2000])


def test_the_result_does_not_depend_on_the_sample_rate() -> None:
    """The same load is sampled at 100, 10 and 1 Hz.

    At 1 Hz the time of a current step is uncertain by half a second.
    """
    current_a = np.repeat(held_currents(2.0, np.random.default_rng(4)), 50)  # half seconds at 100 Hz
    time_s = 0.01 * np.arange(len(current_a))
    voltage_v, _ = simulate_cell((FIRST_SOC, 0.0, 0.0), time_s, current_a, TRUTH.cell.capacity_ah * 3600.0, TRUTH.a)
    thetas = []
    for every in (1, 10, 100):
        block = np.zeros(len(time_s[::every]), dtype=SAMPLE)
        block["time_s"], block["current_a"] = time_s[::every], current_a[::every]
        block["voltage_v"], block["temperature_c"] = voltage_v[::every], np.nan
        estimator = learner(file_off_by(*WRONG_FACTORS))
        estimator.run(block)
        thetas.append(estimator.record[0]["learning"]["theta"][:5].copy())
    assert thetas[1] == pytest.approx(thetas[0], abs=0.01)
    assert thetas[2] == pytest.approx(thetas[0], abs=0.1)


def test_a_pack_learns_the_same_relative_parameters_as_its_cell(ten_hours: SampleBlock) -> None:
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


def test_learning_stops_at_a_soc_below_the_stability_margin() -> None:
    """``adapting`` is 0 below delta2, the SOC at which C_tl of Chen and Mora would be 0."""
    block = measured(np.full(4 * HALF_SECONDS_PER_HOUR, 0.1 * RATED_A), 0.0, np.random.default_rng(1))
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
    block = measured(np.full(HALF_SECONDS_PER_HOUR, 0.1 * RATED_A), 0.0, np.random.default_rng(1))
    assert np.isfinite(estimator.run(block)["voltage_estimate_v"]).all()
    assert estimator.state["adapting"][0] == 0


def test_a_gap_does_not_change_parameters_and_learning_continues() -> None:
    """The gap is a rest of two hours without samples."""
    rng = np.random.default_rng(5)
    currents_a = held_currents(2.0, rng), np.zeros(2 * HALF_SECONDS_PER_HOUR), held_currents(3.0, rng)
    block = measured(np.concatenate(currents_a), NOISE_V, rng)
    estimator = learner(TRUTH)
    gap_start, gap_end = 7200, 14_400  # samples at 1 Hz
    estimator.run(block[:gap_start])
    theta = estimator.record[0]["learning"]["theta"].copy()
    estimator.run(block[gap_end : gap_end + 1])
    assert estimator.state["gaps"][0] == 1
    assert (estimator.record[0]["learning"]["theta"] == theta).all()
    estimator.run(block[gap_end + 1 :])
    assert relative_errors(estimator, (1.0,) * 5)[[R_S, *TIME_CONSTANTS]].max() < 0.1


def test_learned_parameters_are_preserved_after_a_restart_under_load(ten_hours: SampleBlock) -> None:
    estimator = learner(file_off_by(*WRONG_FACTORS))
    restart = 8 * 3600
    estimator.run(ten_hours[:restart])
    before = relative_errors(estimator, WRONG_FACTORS)
    estimator.resume(10.0)
    after_restart = ten_hours[restart:].copy()
    after_restart["time_s"] -= after_restart["time_s"][0]
    estimator.run(after_restart[:1])
    assert (relative_errors(estimator, WRONG_FACTORS) == before).all()
    estimator.run(after_restart)
    assert np.abs(relative_errors(estimator, WRONG_FACTORS) - before)[[R_S, *TIME_CONSTANTS]].max() < 0.1


@pytest.mark.parametrize("field", ["theta", "x", "information", "offset_v"])
def test_a_non_finite_state_is_initialized_again(ten_hours: SampleBlock, field: str) -> None:
    estimator = learner(file_off_by(*WRONG_FACTORS))
    estimator.run(ten_hours[:600])
    estimator.record[0]["learning"][field] = np.nan
    trace = estimator.run(ten_hours[600:])
    assert np.isfinite(trace["voltage_estimate_v"][1:]).all()
    assert relative_errors(estimator, WRONG_FACTORS)[R_S] < 0.01
    assert trace["lock"][-1] == 1


def test_invalid_samples_are_dropped(ten_hours: SampleBlock) -> None:
    with_invalid, clean = learner(TRUTH), learner(TRUTH)
    clean.run(ten_hours[:600])
    with_invalid.run(ten_hours[:300])
    with_invalid.step(300.5, np.nan, 3.8)
    with_invalid.step(300.5, 0.1, 60.0)  # 60 V is out of range
    with_invalid.run(ten_hours[300:600])
    assert with_invalid.record["learning"].tobytes() == clean.record["learning"].tobytes()


def test_with_the_filter_the_law_uses_the_soc_of_the_filter_but_its_own_parameters(
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
    # R_s = a13 exp(-a14 SOC) + a15 is scaled, so that the exponent a14 does not change.
    assert estimator.state["a"][0, 13:16] == pytest.approx(cell.a[13:16] * np.exp([theta[R_S], 0.0, theta[R_S]]))
    assert (estimator.state["target"] == estimator.settings["target"]).all()


def test_learned_parameters_are_published_with_their_source(ten_hours: SampleBlock) -> None:
    estimator = learner(file_off_by(*WRONG_FACTORS))
    estimator.run(ten_hours)
    report = make_parameters_payload(estimator, 0.0)
    assert report.a["a15"].source == report.elements["r_s_ohm"].source == "identified"
    assert report.a["a15"].value == estimator.state["a"][0, 15]
    assert "law" in (report.a["a15"].reason or "")
    assert report.a["a14"].source == "configured"


def test_the_learning_law_publishes_gamma_k_and_the_improved_law_publishes_n_of_k(ten_hours: SampleBlock) -> None:
    """The Nussbaum gain N(k) belongs to the laws of the thesis. Without the identifier, no law changes the limits delta1 and
    delta2 by data, so that ``delta_configured`` is true."""
    states = {}
    for law in ("learning", "improved"):
        estimator = Estimator(
            file_off_by(*WRONG_FACTORS), ObserverSettings(law=law), identifier=None, initial_soc=FIRST_SOC
        )
        window = Window()
        window.add(estimator.run(ten_hours[:600]), 0.0)
        summary = window.take()
        assert summary is not None
        states[law] = make_state_payload(
            summary, remaining_capacity_ah(estimator), no_forecast("none"), {}, 0.0, ChargeEnergy(), 3.0
        )
        k = float(estimator.state["k"][0])
        assert states[law].adaptive_gain_k == k
    learning, improved = states["learning"], states["improved"]
    assert learning.adaptive_gain_k is not None
    assert learning.adaptation_gain_hz == pytest.approx(learning.adaptive_gain_k / 60.0)  # gamma is 1/60 s
    assert (learning.nussbaum_gain, learning.delta_configured) == (None, True)
    assert (improved.adaptation_gain_hz, improved.delta_configured) == (None, True)
    assert improved.nussbaum_gain is not None
