"""Kalman filter: comparison of Jacobians, update and mixtures with their definitions, and operation over hours.

``s`` is a record of EKF_STATE and ``p`` of EKF_SETTINGS. x_k are the currents through the RC pairs, and h is the
derivative of the predicted voltage by the state.
"""

from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import solve_continuous_lyapunov

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.filter_settings import filter_settings
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.open_loop import branch_currents
from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, TAUS
from bms_estimator.kernels.kalman_filter import ekf, hypotheses, noise as ekf_noise, window
from bms_estimator.kernels.kalman_filter.mixture import merge_pair, mixture_moments, prune_and_merge
from bms_estimator.kernels.kalman_filter.records import B_SLOW, EKF_STATE, LN_Q, LN_R, NODE, OFFSET, SOC, STATES, X
from bms_estimator.model.arrays import SAMPLE, SampleBlock
from bms_estimator.model.cell import load_cell
from bms_estimator.settings.observer import IdentifierSettings, Sampling
from tests.estimator.anywhere.cases import CASES, Case, capture

CELL = load_cell("nmc", 3.0)
RC_CURRENTS = slice(X, X + BRANCHES)
"""Indices of the RC pairs' currents in the state vector."""
MIDDLE_SOC = 0.55
COOL_C = 12.0
"""Temperature between two of the cell file [C]."""
MEASUREMENT_V2 = 0.05**2
"""Variance of the measurement in updates [V^2]."""


def make_settings(**changes):
    """Return the filter settings of a generic NMC cell, with ``changes`` of their fields."""
    p = filter_settings(CELL, ocv_grid(CELL), IdentifierSettings(), 1e-3, None)[0]
    for name, value in changes.items():
        p[name] = value
    return p


def make_state(p, seed=1, time_s=1.0):
    """Return a state during a drive: one hypothesis with random mean and covariance, and a window of five samples.

    ``time_s`` is the duration of the window.
    """
    rng = np.random.default_rng(seed)
    s = np.zeros(1, EKF_STATE)[0]
    hypotheses.initialize_filter(s, p, MIDDLE_SOC, 1.5, COOL_C)
    s["count"], s["best"] = 1, 0
    std = np.sqrt(np.diag(s["covariance"][3]))  # initial std of one of the hypotheses
    s["mean"][0] = 0.3 * rng.standard_normal(STATES) * std
    s["mean"][0, SOC] = MIDDLE_SOC
    root = rng.standard_normal((STATES, STATES))
    s["covariance"][0] = (root @ root.T / STATES) * std[:, None] * std
    s["x_a"] = rng.normal(1.0, 0.5, BRANCHES)
    for current_a, voltage_v in zip(rng.normal(1.5, 0.5, 5), rng.normal(3.6, 0.01, 5), strict=True):
        window.integrate_current(s, p, time_s / 5, False, current_a, COOL_C)
        window.add_to_window(s, current_a, voltage_v)
    return s


def linearise(s, p):
    """Linearise about the first hypothesis.

    Returns:
        Predicted voltage [V], and std of the error due to the curvature of the OCV [V].
    """
    return ekf.linearise(s, p, 0, s["mean"][0, SOC], s["covariance"][0, SOC, SOC])


def predict_voltage(s, p, mean):
    """Return the predicted voltage if the first hypothesis has the mean ``mean`` [V]."""
    s["mean"][0] = mean
    return linearise(s, p)[0]


def test_h_is_the_derivative_of_the_voltage_by_every_state_except_the_soc() -> None:
    p = make_settings()
    s = make_state(p)
    mean = s["mean"][0].copy()
    linearise(s, p)
    h = s["h"].copy()
    for j in range(STATES):
        if j == SOC:
            continue
        step = np.zeros(STATES)
        step[j] = 1e-5
        by_difference = (predict_voltage(s, p, mean + step) - predict_voltage(s, p, mean - step)) / 2e-5
        assert h[j] == pytest.approx(by_difference, rel=1e-6, abs=1e-9), j


def test_h_of_the_soc_is_the_secant_of_the_ocv_between_plus_and_minus_one_std() -> None:
    p = make_settings(sensor_v2=0.0)
    s = make_state(p)
    soc_std = 0.1
    s["covariance"][0, SOC, SOC] = soc_std**2
    linearise(s, p)
    w, grid = s["window"], np.linspace(0.0, 1.0, p["ocv_v"].size)
    mean_soc_of_window = s["mean"][0, SOC] + (w["charge_as"] - w["sum_as"] / w["samples"]) / p["capacity_as"]
    below_v, above_v = np.interp([mean_soc_of_window - soc_std, mean_soc_of_window + soc_std], grid, p["ocv_v"])
    assert s["h"][SOC] == pytest.approx((above_v - below_v) / (2 * soc_std), rel=1e-3)


def test_the_covariance_is_propagated_by_the_derivative_of_the_mean() -> None:
    """Without Q, the predicted covariance is F P F'. F is computed by finite differences.

    Q is the prediction from a covariance of 0. ``curve_soc`` is so large that the error of the OCV hardly depends on
    the SOC, because F omits this dependence.
    """
    p = make_settings(curve_soc=0.3)

    def predict(mean, covariance):
        """Return the predicted mean and covariance."""
        s = make_state(p, time_s=20.0)
        s["mean"][0], s["covariance"][0] = mean, covariance
        ekf.transition_diagonal(s, p)
        ekf.predict(s, p, 0)
        return s["mean"][0].copy(), s["covariance"][0].copy()

    s = make_state(p, time_s=20.0)
    mean, covariance = s["mean"][0].copy(), s["covariance"][0].copy()
    zero = np.zeros((STATES, STATES))
    f = np.empty((STATES, STATES))
    for j in range(STATES):
        step = np.zeros(STATES)
        step[j] = 1e-4
        f[:, j] = (predict(mean + step, zero)[0] - predict(mean - step, zero)[0]) / 2e-4
    assert f[SOC, OFFSET] > 0.0
    assert f[SOC, LN_Q] > 0.0
    assert f[X, OFFSET] < -0.9
    without_q = predict(mean, covariance)[1] - predict(mean, zero)[1]
    expected, nodes = f @ covariance @ f.T, np.arange(NODE, STATES)
    # Q of the OCV nodes depends on P, so that their variances are compared with a tolerance.
    assert without_q[nodes, nodes] == pytest.approx(expected[nodes, nodes], abs=1.0 / ekf_noise.AGED_SOC)
    without_q[nodes, nodes] = expected[nodes, nodes]
    assert without_q == pytest.approx(expected, rel=1e-6, abs=1e-12)


def test_the_update_equals_the_kalman_update() -> None:
    p = make_settings()
    s = make_state(p)
    _, curvature_v = linearise(s, p)
    mean, covariance, h = (np.array(x) for x in (s["mean"][0], s["covariance"][0], s["h"]))
    innovation_variance_v2 = h @ covariance @ h + MEASUREMENT_V2 + curvature_v**2
    # The mean voltage of the window is 0.3 std above the prediction.
    s["window"]["sum_v"] = s["window"]["samples"] * (linearise(s, p)[0] + 0.3 * np.sqrt(innovation_variance_v2))
    innovation_v, variance_v2, linear_variance_v2 = ekf.update(s, p, 0, MEASUREMENT_V2)
    gain = covariance @ h / innovation_variance_v2
    assert (innovation_v, variance_v2) == pytest.approx((0.3 * np.sqrt(innovation_variance_v2), innovation_variance_v2))
    assert linear_variance_v2 == pytest.approx(innovation_variance_v2 - curvature_v**2)
    assert s["mean"][0] == pytest.approx(mean + gain * innovation_v, rel=1e-9, abs=1e-12)
    assert s["covariance"][0] == pytest.approx(covariance - np.outer(gain, h @ covariance), rel=1e-9, abs=1e-15)


@pytest.mark.parametrize(
    ("name", "prior_soc", "prior_std", "true_soc"),
    [*(("chen_mora", 0.045, 0.035, true_soc) for true_soc in (0.06, 0.08, 0.1, 0.13)), ("lfp", 0.037, 0.1, 0.21)],
)
def test_an_update_of_the_soc_over_the_ocv_knee_near_empty_agrees_with_bayes(
    name: str, prior_soc: float, prior_std: float, true_soc: float
) -> None:
    """The update of the SOC alone is compared with the posterior on a grid.

    The OCV is ten times as steep at the prior SOC as at the true one.
    """
    cell, noise_v = load_cell(name, None if name == "chen_mora" else 3.0), 0.03
    p = filter_settings(cell, ocv_grid(cell), IdentifierSettings(), 1e-3, None)[0]
    s = np.zeros(1, EKF_STATE)[0]
    hypotheses.initialize_filter(s, p, prior_soc, 0.0, 25.0)
    s["count"], s["best"] = 1, 0
    s["mean"][0], s["covariance"][0] = 0.0, 0.0
    s["mean"][0, SOC], s["covariance"][0, SOC, SOC] = prior_soc, prior_std**2
    grid = np.linspace(-0.05, 0.6, 4000)
    ocv_v = np.interp(grid, np.linspace(0.0, 1.0, p["ocv_v"].size), p["ocv_v"])
    voltage_v = np.interp(true_soc, grid, ocv_v)
    window.add_to_window(s, 0.0, voltage_v)
    ekf.update(s, p, 0, noise_v**2)
    weight = np.exp(-0.5 * ((grid - prior_soc) / prior_std) ** 2 - 0.5 * ((ocv_v - voltage_v) / noise_v) ** 2)
    mean = np.average(grid, weights=weight)
    exact_std = np.sqrt(np.average((grid - mean) ** 2, weights=weight))
    assert abs(s["mean"][0, SOC] - mean) < exact_std
    assert 0.6 < np.sqrt(s["covariance"][0, SOC, SOC]) / exact_std < 1.6


def test_an_innovation_of_many_std_is_limited_to_two() -> None:
    """The effect of an innovation of 8 std on the slow bias is compared with that of 2 std."""
    p = make_settings()
    corrections_v = []
    for stds in (2.0, 8.0):
        s = make_state(p)
        # A certain SOC, because the update would otherwise be linearized about another SOC.
        s["covariance"][0][SOC] = s["covariance"][0][:, SOC] = 0.0
        _, curvature_v = linearise(s, p)
        h, covariance, before = (np.array(x) for x in (s["h"], s["covariance"][0], s["mean"][0]))
        std = np.sqrt(h @ covariance @ h + MEASUREMENT_V2 + curvature_v**2)
        s["window"]["sum_v"] = s["window"]["samples"] * (linearise(s, p)[0] + stds * std)
        ekf.update(s, p, 0, MEASUREMENT_V2)
        corrections_v.append(s["mean"][0, B_SLOW] - before[B_SLOW])
    assert corrections_v[1] == pytest.approx(corrections_v[0] * 2.0 / 8.0)


def test_rc_currents_at_switch_on_are_those_of_a_stationary_random_load() -> None:
    """Mean and covariance are those of the Lyapunov equation of load and RC pairs, given a first current of 2 A."""
    p = make_settings()
    s = np.zeros(1, EKF_STATE)[0]
    mean, covariance = s["mean"][0], s["covariance"][0]
    ekf_noise.initial_branch_currents(p, 2.0, mean, covariance)
    one_c, size = p["capacity_as"] / 3600.0, BRANCHES + 1
    a = -np.diag(np.concatenate([[1.0 / p["load_s"]], 1.0 / TAUS]))
    a[1:, 0] = 1.0 / TAUS
    noise = np.zeros((size, size))
    noise[0, 0] = 2.0 * (p["load_c"] * one_c) ** 2 / p["load_s"]
    # The load is a Gauss-Markov process plus a constant random level.
    joint = solve_continuous_lyapunov(a, -noise) + (p["load_level_c"] * one_c) ** 2
    gain = joint[1:, 0] / joint[0, 0]
    expected_a = p["load_mean_c"] * one_c + gain * (2.0 - p["load_mean_c"] * one_c)
    assert mean[RC_CURRENTS] == pytest.approx(expected_a)
    assert covariance[RC_CURRENTS, RC_CURRENTS] == pytest.approx(joint[1:, 1:] - np.outer(gain, joint[0, 1:]))


@pytest.mark.parametrize(("first_c", "rms_c"), [(0.0, 0.3), (-0.2, 0.3), (1.0, 1.0), (2.5, 1.285), (-6.0, 1.285)])
def test_the_first_sample_of_a_drive_is_treated_as_a_possible_peak(first_c: float, rms_c: float) -> None:
    """The RMS of the load, on which the model's error depends, starts at most at the long-term RMS of 1.285 C."""
    p = make_settings()
    one_c = p["capacity_as"] / 3600.0
    s = np.zeros(1, EKF_STATE)[0]
    hypotheses.initialize_filter(s, p, 0.55, first_c * one_c, 12.0)
    assert np.sqrt(s["rms_a2"]) == pytest.approx(rms_c * one_c, rel=1e-3)
    assert abs(s["mean_a"]) <= np.sqrt(s["rms_a2"]) * (1.0 + 1e-9)


@pytest.mark.parametrize("first_c", [1.5, 3.0, 6.0])
def test_the_load_assumed_in_a_gap_after_a_peak_may_have_continued_or_ended(first_c: float) -> None:
    """The std of the unknown current includes that of the long-term RMS load, 1.285 C."""
    p = make_settings()
    one_c = p["capacity_as"] / 3600.0
    s = np.zeros(1, EKF_STATE)[0]
    hypotheses.initialize_filter(s, p, 0.55, first_c * one_c, 12.0)
    unknown_std_c = window.gap_charge_std(s, p, first_c * one_c, 60.0) / (60.0 * one_c)
    assert first_c - 1.29 < unknown_std_c < first_c


def test_measurement_variance_grows_outside_the_temperatures_of_the_cell_file() -> None:
    p = make_settings(low_c=0.0, high_c=30.0, model_j=0.0, sensor_v2=0.0)
    s = make_state(p)
    variances = []
    for s["temperature_c"] in (10.0, 30.0, 60.0, -60.0):
        variances.append(ekf_noise.measurement_variance(s, p, 1.0, 5) / p["model_v"] ** 2)
    # The std doubles within ``OUTSIDE_K`` (30 K) of the range.
    assert variances == pytest.approx([1.0, 1.0, 4.0, 9.0])


def test_errors_do_not_decrease_above_the_temperatures_of_the_cell_file() -> None:
    """Resistances decrease at high temperatures, but errors of the model increase by half of their value in 15 K."""
    p = make_settings(low_c=0.0, high_c=30.0)
    s = make_state(p)
    variances = []
    for s["temperature_c"] in (30.0, 45.0, 60.0):
        window.update_arrhenius_factors(s)
        variances.append((ekf_noise.measurement_variance(s, p, 1.0, 5), ekf_noise.bias_variance(s, p, 0)))
    assert variances[1] == pytest.approx(1.5**2 * np.array(variances[0]), rel=0.01)
    assert variances[2] == pytest.approx(2.0**2 * np.array(variances[0]), rel=0.01)


def test_bias_inflation_is_near_one_for_white_innovations_and_grows_for_persistent_ones() -> None:
    s = np.zeros(1, EKF_STATE)[0]
    s["fast_inflation"][0] = s["slow_inflation"][0] = 1.0
    rng, slow_inflations = np.random.default_rng(3), []
    for normalized_innovation in rng.standard_normal(20_000):
        ekf.adapt_bias_inflation(s, 0, 1.0, normalized_innovation)
        slow_inflations.append(s["slow_inflation"][0])
    # The mean is above 1, because ratios below 1 count as 1.
    assert np.mean(slow_inflations) == pytest.approx(1.3, abs=0.3)
    for _ in range(7200):
        ekf.adapt_bias_inflation(s, 0, 1.0, 0.2)  # small, but always of the same sign
    assert s["slow_inflation"][0] > 30.0
    assert s["fast_inflation"][0] > 3.0


@pytest.mark.parametrize("dt_s", [1.0, 10.0, 60.0, 600.0])
def test_bias_inflation_for_white_innovations_is_small_at_any_sample_period(dt_s: float) -> None:
    s = np.zeros(1, EKF_STATE)[0]
    s["fast_inflation"][0] = s["slow_inflation"][0] = 1.0
    rng, inflations = np.random.default_rng(4), []
    for normalized_innovation in rng.standard_normal(20_000):
        ekf.adapt_bias_inflation(s, 0, dt_s, normalized_innovation)
        inflations.append((s["fast_inflation"][0], s["slow_inflation"][0]))
    assert np.mean(inflations, axis=0) == pytest.approx([1.3, 1.3], abs=0.3)


def test_a_single_innovation_after_a_gap_causes_no_bias_inflation(drive) -> None:
    estimator = make_estimator(drive)
    f = estimator.record[0]["filter"]
    estimator.run(drive.samples[:1800])
    assert f["count"] == 1
    names = "fast_inflation", "slow_inflation", "minute_u", "ten_minutes_u"
    before, seeded_s = [float(f[name][0]) for name in names], float(f["seeded_s"])
    estimator.run(drive.samples[1830:1831])  # half a minute later
    assert [float(f[name][0]) for name in names] == before
    assert f["seeded_s"] == seeded_s + 31.0  # the sample was processed
    assert estimator.state["gaps"][0] == 1


def test_rc_currents_after_a_gap_have_the_std_of_an_unknown_load() -> None:
    """The std is that of 4000 draws of a load, a constant level plus a Gauss-Markov process, over three minutes."""
    p, rng = make_settings(), np.random.default_rng(6)
    load_a, correlation_s, gap_s, draws = 2.0, p["load_s"], 180, 4000
    level_a = load_a * rng.standard_normal(draws)
    process_a, x = load_a * rng.standard_normal(draws), np.zeros((BRANCHES, draws))
    for _ in range(gap_s):
        x += (1.0 - np.exp(-1.0 / TAUS))[:, None] * (level_a + process_a - x)
        process_a += -process_a * (1.0 - np.exp(-1.0 / correlation_s))
        process_a += load_a * np.sqrt(1.0 - np.exp(-2.0 / correlation_s)) * rng.standard_normal(draws)
    covariance, f = np.zeros((STATES, STATES)), np.ones(STATES)
    f[RC_CURRENTS] = np.exp(-gap_s / TAUS)
    ekf_noise.add_gap_noise(p, covariance, f, load_a, gap_s / p["capacity_as"])
    assert np.sqrt(np.diag(covariance)[RC_CURRENTS]) == pytest.approx(x.std(axis=1), rel=0.15)


@pytest.mark.parametrize("gap_s", [1.0, 6.0, 10.0, 30.0, 180.0, 3600.0])
def test_the_covariance_added_in_a_gap_is_symmetric_and_positive_semidefinite(gap_s: float) -> None:
    p, covariance, f = make_settings(), np.zeros((STATES, STATES)), np.ones(STATES)
    f[RC_CURRENTS] = np.exp(-gap_s / TAUS)
    ekf_noise.add_gap_noise(p, covariance, f, 2.0, gap_s / p["capacity_as"])
    assert covariance == pytest.approx(covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > -1e-12


def moments_of_mixture(mean, covariance, weight):
    """Return mean and covariance of a mixture of normal distributions with these means, covariances and weights."""
    weight = weight / weight.sum()
    mixture_mean = weight @ mean
    deviation = mean - mixture_mean
    between = np.einsum("q,qj,qk->jk", weight, deviation, deviation)
    return mixture_mean, np.einsum("q,qjk->jk", weight, covariance) + between


def make_hypotheses(p, count=3):
    """Return a state with several random hypotheses, whose SOCs differ by 0.1, and their weights."""
    s = make_state(p)
    rng = np.random.default_rng(4)
    for q in range(count):
        root = rng.standard_normal((STATES, STATES))
        s["mean"][q], s["covariance"][q] = rng.standard_normal(STATES), root @ root.T / 400.0
        s["mean"][q, SOC] = 0.3 + 0.1 * q
        s["ln_weight"][q] = -0.4 * q
    s["count"], s["best"] = count, 0
    return s, np.exp(s["ln_weight"][:count])


@pytest.mark.parametrize("series", [1.0, 6.0])
def test_the_published_soc_and_std_are_those_of_the_mixture(series: float) -> None:
    """In a pack of several cells in series, the std also covers the imbalance of the cells."""
    p = make_settings(series=series)
    s, weight = make_hypotheses(p)
    mean, covariance = moments_of_mixture(s["mean"][:3], s["covariance"][:3], weight)
    mixture_moments(s)
    assert s["soc"] == pytest.approx(mean[SOC])
    assert s["soc_std"] == pytest.approx(np.sqrt(covariance[SOC, SOC]))
    spread = p["cell_spread"] * (1.0 - mean[SOC]) if series > 1.0 else 0.0
    assert hypotheses.weakest_cell_soc_std(s, p) == pytest.approx(np.sqrt(covariance[SOC, SOC] + spread**2))


def test_merging_preserves_mean_and_covariance() -> None:
    s, weight = make_hypotheses(make_settings(), 2)
    mean, covariance = moments_of_mixture(s["mean"][:2], s["covariance"][:2], weight)
    merge_pair(s, 0, 1)
    assert s["mean"][0] == pytest.approx(mean)
    assert s["covariance"][0] == pytest.approx(covariance)
    assert np.exp(s["ln_weight"][0]) == pytest.approx(weight.sum())


def test_unlikely_hypotheses_are_removed_and_similar_ones_merged() -> None:
    s, _ = make_hypotheses(make_settings(), 4)
    s["covariance"][:4, SOC, SOC] = 0.02**2
    s["mean"][:4, SOC] = 0.3, 0.5, 0.505, 0.7
    s["ln_weight"][:4] = 0.0, -0.1, -0.1, -20.0
    prune_and_merge(s)
    assert s["count"] == 2
    assert s["mean"][:2, SOC] == pytest.approx([0.3, 0.5025])


@pytest.mark.parametrize("right", [0, 1])
def test_a_hypothesis_with_a_large_bias_loses_weight(right: int) -> None:
    """The bias of the wrong hypothesis, 0.2 V, has absorbed its error, so that its innovations are small."""
    p, socs = make_settings(), (0.4, 0.7)
    s, _ = make_hypotheses(p, 2)
    voltage_v = 0.0
    wrong = 1 - right
    for q in (wrong, right):
        s["mean"][q], s["covariance"][q] = 0.0, 1e-6 * np.eye(STATES)
        s["mean"][q, SOC] = socs[q]
        voltage_v = ekf.linearise(s, p, q, socs[q], 1e-6)[0]
    s["mean"][wrong, B_SLOW] = voltage_v - ekf.linearise(s, p, wrong, socs[wrong], 1e-6)[0]
    s["ln_weight"][:2] = 0.0
    assert abs(s["mean"][wrong, B_SLOW]) > 0.2
    for _ in range(60):
        window.integrate_current(s, p, 1.0, False, s["current_a"], 25.0)
        s["window"]["samples"] = 0
        window.add_to_window(s, s["current_a"], voltage_v)
        hypotheses.update_hypotheses(s, p)
    likely = s["mean"][: s["count"], SOC][s["ln_weight"][: s["count"]] > -3.0]
    assert likely == pytest.approx([socs[right]], abs=0.05)


FAST_CASE = Case("100 Hz", rate_hz=100.0, hours=0.25, load_before_h=0.3, seed=5)


def make_estimator(drive, soc_error=0.2):
    """Return an estimator for a capture, whose initial SOC is wrong by ``soc_error``."""
    return Estimator(drive.cell, initial_soc=float(drive.soc[0] + soc_error))


@pytest.mark.parametrize("dt_s", [1.0, 10.0, 60.0])
def test_rc_currents_of_the_calibration_equal_those_of_the_filter(dt_s: float) -> None:
    current_a = np.repeat(np.random.default_rng(0).uniform(0.0, 3.0, 50), 4)
    samples = np.zeros(current_a.size, dtype=SAMPLE)
    samples["time_s"], samples["current_a"] = dt_s * np.arange(current_a.size), current_a
    samples["voltage_v"], samples["temperature_c"] = 3.7, 25.0
    estimator, x_a = Estimator(load_cell("nmc", 30.0), sampling=Sampling(period_s=dt_s)), []
    for sample in samples:
        estimator.run(sample[None])
        x_a.append(estimator.record[0]["filter"]["x_a"].copy())
    assert branch_currents(samples["time_s"], current_a) == pytest.approx(np.array(x_a), abs=1e-9)


@pytest.fixture(scope="module")
def drive():
    """Return the capture of a drive at 1 Hz."""
    return capture(next(case for case in CASES if case.name == "oxide 25C"))


@pytest.fixture(scope="module")
def fast():
    """Return the capture of a drive at 100 Hz."""
    return capture(FAST_CASE)


@pytest.mark.parametrize("rate_hz", [0.1, 1.0, 100.0, 1000.0])
def test_the_covariance_stays_valid_at_any_rate(drive, fast, rate_hz: float) -> None:
    """At 1000 Hz, the time stamps of the capture at 100 Hz are changed."""
    samples = {0.1: drive.samples[::10], 1.0: drive.samples, 100.0: fast.samples, 1000.0: fast.samples.copy()}[rate_hz]
    if rate_hz == 1000.0:
        samples["time_s"] = samples["time_s"][0] + np.arange(samples.size) / rate_hz
    assert_covariance_stays_valid(make_estimator(drive if rate_hz <= 1.0 else fast), np.array_split(samples, 40))


@pytest.mark.parametrize("gap_s", [2, 6, 12, 60])
def test_the_covariance_stays_valid_through_gaps(drive, gap_s: int) -> None:
    # Each part is 30 s of samples, and ``gap_s`` without samples follow.
    parts = [part[: part.size - gap_s] for part in np.split(drive.samples[:3600], range(gap_s + 30, 3600, gap_s + 30))]
    assert_covariance_stays_valid(make_estimator(drive), parts)


def assert_covariance_stays_valid(estimator: Estimator, parts: list[SampleBlock]) -> None:
    """Assert that the covariance is valid at the first and the last sample of each part, and that nothing is reset."""
    f = estimator.record[0]["filter"]
    for part in parts:
        for samples in (part[:1], part[1:]):
            estimator.run(samples)
            assert_valid_covariances(f)
    assert estimator.record[0]["counters"]["reset"] == 0


def assert_valid_covariances(f) -> None:
    """Assert that the covariance of each hypothesis is symmetric, finite and, except for rounding, positive definite."""
    assert 1 <= f["count"] <= len(f["mean"])
    for covariance in f["covariance"][: f["count"]]:
        assert np.array_equal(covariance, covariance.T)
        scale = np.sqrt(np.diag(covariance))
        assert np.isfinite(scale).all()
        assert (scale > 0.0).all()
        assert np.linalg.eigvalsh(covariance / scale[:, None] / scale).min() > -1e-9


def test_100_samples_a_second_give_the_result_of_one_sample_a_second(fast) -> None:
    """The mean of all samples of a second is used in a single update."""
    at_100_hz = make_estimator(fast).run(fast.samples)[::100].copy()
    at_1_hz = make_estimator(fast).run(fast.samples[::100])
    assert at_100_hz["time_s"] == pytest.approx(at_1_hz["time_s"])
    late = slice(300, None)
    assert np.abs(at_100_hz["soc"] - at_1_hz["soc"])[late].max() < 0.004
    assert at_100_hz["soc_std"][late] == pytest.approx(at_1_hz["soc_std"][late], rel=0.1)


def test_hypotheses_converge_to_one(drive) -> None:
    estimator = make_estimator(drive)
    f = estimator.record[0]["filter"]
    estimator.run(drive.samples[:1])
    assert f["count"] > 3
    counts = []
    for part in np.array_split(drive.samples[1:], 20):
        estimator.run(part)
        counts.append(f["count"])
    assert all(after <= before for before, after in pairwise(counts))
    assert counts[-1] == 1


def test_rows_of_removed_hypotheses_are_zero(drive) -> None:
    """Hypotheses are merged or removed during convergence, and when new ones are spawned."""
    estimator = make_estimator(drive)
    f = estimator.record[0]["filter"]
    rows = "mean", "covariance", "ln_weight", "minute_u", "ten_minutes_u", "fast_inflation", "slow_inflation"
    counts = set()
    for part in np.array_split(drive.samples[:600], 20):
        estimator.run(part)
        counts.add(int(f["count"]))
        assert not any(f[name][f["count"] :].any() for name in rows)
    assert len(counts) > 1
    for soc_std, count in ((0.2, len(f["mean"])), (0.01, 1)):
        hypotheses.spawn_hypotheses(f, estimator.settings_record[0]["filter"], 0.5, soc_std)
        assert f["count"] == count
    assert not any(f[name][1:].any() for name in rows)


@pytest.mark.parametrize("soc", [0.0, 0.5, 1.0])
def test_an_soc_set_by_the_user_is_published(drive, soc: float) -> None:
    estimator = make_estimator(drive)
    estimator.run(drive.samples[:600])
    estimator.set_soc(soc)
    f = estimator.record[0]["filter"]
    assert f["soc"] == pytest.approx(soc, abs=0.01)
    assert 0.03 < f["soc_std"] < 0.06


@pytest.mark.parametrize("soc_error", [-0.3, -0.1, 0.0, 0.1, 0.3])
def test_an_soc_set_by_the_user_is_corrected_if_the_voltage_contradicts(drive, soc_error: float) -> None:
    """After 5 min the true SOC is inside the interval, and after 20 min the estimate is near it."""
    estimator = make_estimator(drive)
    estimator.run(drive.samples[:600])
    estimator.set_soc(float(drive.soc[600]) + soc_error)
    trace = estimator.run(drive.samples[600:2400])
    error = np.abs(trace["soc"] - drive.soc[600:2400])
    assert (error < 2.0 * trace["soc_std"])[300:].all()
    assert error[1200:].max() < 0.01


def test_a_certain_but_wrong_soc_is_reinitialized(drive) -> None:
    """The SOC is 0.3 too low with a std of 0.01.

    Within 10 min the true SOC is inside the interval, and after 20 min the estimate is near it.
    """
    estimator = make_estimator(drive)
    estimator.run(drive.samples[:600])
    hypotheses.spawn_hypotheses(
        estimator.record[0]["filter"], estimator.settings_record[0]["filter"], float(drive.soc[600]) - 0.3, 0.01
    )
    trace = estimator.run(drive.samples[600:2400])
    error = np.abs(trace["soc"] - drive.soc[600:2400])
    assert estimator.record[0]["filter"]["reopened"] >= 1
    assert (error < 2.0 * trace["soc_std"])[600:].all()
    assert error[1200:].max() < 0.04


def test_a_non_finite_temperature_is_replaced_by_the_next_sample(drive) -> None:
    estimator, samples = make_estimator(drive), drive.samples[:700].copy()
    samples["temperature_c"] = 8.0
    estimator.run(samples[:600])
    f = estimator.record[0]["filter"]
    f["temperature_c"] = np.nan
    estimator.run(samples[600:610])
    assert estimator.record[0]["counters"]["reset"] == 1
    assert f["temperature_c"] == 8.0


def test_short_readings_of_85_degrees_have_a_limited_effect_on_the_temperature(drive) -> None:
    estimator, samples = make_estimator(drive), drive.samples[:1200].copy()
    samples["temperature_c"] = 25.0
    samples["temperature_c"][[0, 1]] = samples["temperature_c"][600:630] = 85.0
    used_c = []
    for sample in samples:
        estimator.run(sample[None])
        used_c.append(float(estimator.record[0]["filter"]["temperature_c"]))
    assert max(used_c[60:]) < 28.5
    assert used_c[-1] == pytest.approx(25.0, abs=0.1)


@pytest.mark.parametrize("downtime_s", [7200.0, np.inf])
def test_the_measured_temperature_is_used_at_once_after_a_restart(drive, downtime_s: float) -> None:
    """After the restart the std of the bias is that of a cold cell, also if the cell was warm before."""
    bias_v = []
    for before_c in (25.0, -15.0):
        estimator, samples = make_estimator(drive), drive.samples[:602].copy()
        samples["temperature_c"][:600], samples["temperature_c"][600:] = before_c, -15.0
        estimator.run(samples[:600])
        estimator.resume(downtime_s)
        estimator.run(samples[600:])
        f = estimator.record[0]["filter"]
        assert f["temperature_c"] == pytest.approx(-15.0, abs=0.1)
        bias_v.append(np.sqrt(f["covariance"][: f["count"], B_SLOW, B_SLOW]))
    assert bias_v[0].max() == pytest.approx(bias_v[1].max(), rel=0.3)


@pytest.mark.parametrize("field", ["mean", "covariance", "ln_weight"])
def test_non_finite_values_are_reset_and_counted(drive, field: str) -> None:
    estimator = make_estimator(drive)
    estimator.run(drive.samples[:1800])
    before = estimator.state["soc"][0]
    estimator.record[0]["filter"][field][0] = np.nan
    trace = estimator.run(drive.samples[1800:2400])
    assert estimator.record[0]["counters"]["reset"] == 1
    assert np.isfinite(trace["soc"][2:]).all()
    assert np.isfinite(trace["soc_std"][2:]).all()
    assert trace["soc"][5] == pytest.approx(before, abs=0.05)
    assert estimator.record[0]["filter"]["mean"][0, LN_R] != 0.0


@pytest.mark.parametrize(("soc", "is_limited"), [(1.02, True), (-0.02, True), (0.6, False)])
def test_an_soc_outside_0_to_1_is_limited_and_does_not_update_offset_capacity_and_ocv(
    soc: float, is_limited: bool
) -> None:
    p = make_settings()
    s = make_state(p)
    s["mean"][0, SOC] = soc
    before, std = s["mean"][0].copy(), np.sqrt(np.diag(s["covariance"][0]))
    ekf.update(s, p, 0, 1e-4)
    states = [OFFSET, LN_Q, *range(NODE, STATES)]
    if is_limited:
        assert np.array_equal(s["mean"][0, states], before[states])
        assert np.array_equal(np.sqrt(np.diag(s["covariance"][0]))[states], std[states])
    else:
        assert np.all(s["mean"][0, states] != before[states])
    assert s["mean"][0, LN_R] != before[LN_R]


@pytest.mark.parametrize(
    ("current_c", "r_std", "is_unchanged"), [(0.9, 0.7, True), (-0.9, 0.7, True), (0.1, 0.7, False), (0.9, 0.1, False)]
)
def test_a_constant_current_does_not_update_the_capacity_with_uncertain_resistances(
    current_c: float, r_std: float, is_unchanged: bool
) -> None:
    p = make_settings(r_std=r_std)
    s = make_state(p)
    s["x_a"][:] = s["mean_a"] = CELL.cell.capacity_ah * current_c
    s["rms_a2"] = s["mean_a"] ** 2
    before = s["mean"][0, LN_Q]
    ekf.update(s, p, 0, 1e-4)
    assert (s["mean"][0, LN_Q] == before) == is_unchanged
