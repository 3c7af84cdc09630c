"""Kalman filter compared with its definition: Jacobians, update, mixtures, and hours of operation."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import solve_continuous_lyapunov

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.filter_settings import filter_settings
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.open_loop import branch_currents
from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, TAUS
from bms_estimator.kernels.kalman_filter import ekf, gap_charge, hypotheses, temperature, window
from bms_estimator.kernels.kalman_filter import noise as ekf_noise
from bms_estimator.kernels.kalman_filter.mixture import merge_pair, mixture_moments, prune_and_merge
from bms_estimator.kernels.kalman_filter.records import B_SLOW, EKF_STATE, LN_Q, LN_R, NODE, OFFSET, SOC, STATES, X
from bms_estimator.model.cell import load_cell
from bms_estimator.model.sample import SAMPLE, SampleBlock
from bms_estimator.settings.observer import IdentifierSettings
from tests.estimator.anywhere.cases import CASES, Case, capture

CELL = load_cell("nmc", 3.0)
BRANCH = slice(X, X + BRANCHES)


def settings(**changes):
    p = filter_settings(CELL, ocv_grid(CELL), IdentifierSettings(), 1e-3, None)[0]
    for name, value in changes.items():
        p[name] = value
    return p


def somewhere(p, seed=1, time_s=1.0):
    """Return a state in the middle of a drive with a random mean and covariance and a window of five samples."""
    rng = np.random.default_rng(seed)
    s = np.zeros(1, EKF_STATE)[0]
    hypotheses.initialize_filter(s, p, 0.55, 1.5, 12.0)
    s["count"], s["best"] = 1, 0
    s["mean"][0] = 0.3 * rng.standard_normal(STATES) * np.sqrt(np.diag(s["covariance"][3]))
    s["mean"][0, SOC] = 0.55
    mixed = rng.standard_normal((STATES, STATES))
    std = np.sqrt(np.diag(s["covariance"][3]))
    s["covariance"][0] = (mixed @ mixed.T / STATES) * std[:, None] * std
    s["x_a"] = rng.normal(1.0, 0.5, BRANCHES)
    for current_a, voltage_v in zip(rng.normal(1.5, 0.5, 5), rng.normal(3.6, 0.01, 5), strict=True):
        window.integrate_current(s, p, time_s / 5, False, current_a, 12.0)
        window.add_to_window(s, current_a, voltage_v)
    return s


def linearised(s, p):
    return ekf.linearise(s, p, 0, s["mean"][0, SOC], s["covariance"][0, SOC, SOC])


def predicted(s, p, mean):
    s["mean"][0] = mean
    return linearised(s, p)[0]


def test_h_is_the_derivative_of_the_voltage_by_every_state_but_the_soc() -> None:
    p = settings()
    s = somewhere(p)
    mean = s["mean"][0].copy()
    linearised(s, p)
    h = s["h"].copy()
    for j in range(STATES):
        if j == SOC:
            continue
        step = np.zeros(STATES)
        step[j] = 1e-5
        by_difference = (predicted(s, p, mean + step) - predicted(s, p, mean - step)) / 2e-5
        assert h[j] == pytest.approx(by_difference, rel=1e-6, abs=1e-9), j


def test_h_by_the_soc_is_the_secant_of_the_ocv_over_one_std() -> None:
    p = settings(sensor_v2=0.0)
    s = somewhere(p)
    s["covariance"][0, SOC, SOC] = 0.1**2
    linearised(s, p)
    w, grid = s["window"], np.linspace(0.0, 1.0, p["ocv_v"].size)
    middle = s["mean"][0, SOC] + (w["charge_as"] - w["sum_as"] / w["samples"]) / p["capacity_as"]
    below, above = np.interp([middle - 0.1, middle + 0.1], grid, p["ocv_v"])
    assert s["h"][SOC] == pytest.approx((above - below) / 0.2, rel=1e-3)


def test_p_is_propagated_by_the_derivative_of_the_mean() -> None:
    """F P F' of the kernel, P with Q less P = 0 with Q, against F by finite differences.

    How fast the error of the OCV changes is itself another at another SOC, which is no part of F: here it is not.
    """
    p = settings(curve_soc=0.3)

    def after(mean, covariance):
        s = somewhere(p, time_s=20.0)
        s["mean"][0], s["covariance"][0] = mean, covariance
        ekf.transition_diagonal(s, p)
        ekf.predict(s, p, 0)
        return s["mean"][0].copy(), s["covariance"][0].copy()

    s = somewhere(p, time_s=20.0)
    mean, covariance = s["mean"][0].copy(), s["covariance"][0].copy()
    nothing = np.zeros((STATES, STATES))
    f = np.empty((STATES, STATES))
    for j in range(STATES):
        step = np.zeros(STATES)
        step[j] = 1e-4
        f[:, j] = (after(mean + step, nothing)[0] - after(mean - step, nothing)[0]) / 2e-4
    assert f[SOC, OFFSET] > 0.0
    assert f[SOC, LN_Q] > 0.0
    assert f[X, OFFSET] < -0.9
    by_kernel = after(mean, covariance)[1] - after(mean, nothing)[1]
    expected, nodes = f @ covariance @ f.T, np.arange(NODE, STATES)
    assert by_kernel[nodes, nodes] == pytest.approx(
        expected[nodes, nodes], abs=1.0 / ekf_noise.AGED_SOC
    )  # Q of these states depends on P
    by_kernel[nodes, nodes] = expected[nodes, nodes]
    assert by_kernel == pytest.approx(expected, rel=1e-6, abs=1e-12)


def test_the_update_equals_the_kalman_update() -> None:
    p = settings()
    s = somewhere(p)
    _, curved_v = linearised(s, p)
    mean, covariance, h = (np.array(x) for x in (s["mean"][0], s["covariance"][0], s["h"]))
    r = 0.05**2
    total = h @ covariance @ h + r + curved_v**2
    s["window"]["sum_v"] = s["window"]["samples"] * (linearised(s, p)[0] + 0.3 * np.sqrt(total))
    innovation_v, variance_v2, straight_v2 = ekf.update(s, p, 0, r)
    gain = covariance @ h / total
    assert (innovation_v, variance_v2) == pytest.approx((0.3 * np.sqrt(total), total))
    assert straight_v2 == pytest.approx(total - curved_v**2)
    assert s["mean"][0] == pytest.approx(mean + gain * innovation_v, rel=1e-9, abs=1e-12)
    assert s["covariance"][0] == pytest.approx(covariance - np.outer(gain, h @ covariance), rel=1e-9, abs=1e-15)


@pytest.mark.parametrize(
    ("name", "before", "std", "true_soc"),
    [*(("chen_mora", 0.045, 0.035, true) for true in (0.06, 0.08, 0.1, 0.13)), ("lfp", 0.037, 0.1, 0.21)],
)
def test_an_update_over_the_knee_near_empty_agrees_with_bayes(
    name: str, before: float, std: float, true_soc: float
) -> None:
    """SOC alone, compared with the posterior on a grid. The OCV is ten times as steep at the initial SOC."""
    cell, noise_v = load_cell(name, None if name == "chen_mora" else 3.0), 0.03
    p = filter_settings(cell, ocv_grid(cell), IdentifierSettings(), 1e-3, None)[0]
    s = np.zeros(1, EKF_STATE)[0]
    hypotheses.initialize_filter(s, p, before, 0.0, 25.0)
    s["count"], s["best"] = 1, 0
    s["mean"][0], s["covariance"][0] = 0.0, 0.0
    s["mean"][0, SOC], s["covariance"][0, SOC, SOC] = before, std**2
    grid = np.linspace(-0.05, 0.6, 4000)
    ocv_v = np.interp(grid, np.linspace(0.0, 1.0, p["ocv_v"].size), p["ocv_v"])
    voltage_v = np.interp(true_soc, grid, ocv_v)
    window.add_to_window(s, 0.0, voltage_v)
    ekf.update(s, p, 0, noise_v**2)
    weight = np.exp(-0.5 * ((grid - before) / std) ** 2 - 0.5 * ((ocv_v - voltage_v) / noise_v) ** 2)
    mean = np.average(grid, weights=weight)
    exact_std = np.sqrt(np.average((grid - mean) ** 2, weights=weight))
    assert abs(s["mean"][0, SOC] - mean) < exact_std
    assert 0.6 < np.sqrt(s["covariance"][0, SOC, SOC]) / exact_std < 1.6


def test_an_innovation_of_many_std_counts_as_one_of_two() -> None:
    p = settings()
    moved = []
    for stds in (2.0, 8.0):
        s = somewhere(p)
        s["covariance"][0][SOC] = s["covariance"][0][:, SOC] = (
            0.0  # otherwise the update would be linearized about another SOC
        )
        _, curved_v = linearised(s, p)
        h, covariance, before = (np.array(x) for x in (s["h"], s["covariance"][0], s["mean"][0]))
        std = np.sqrt(h @ covariance @ h + 0.05**2 + curved_v**2)
        s["window"]["sum_v"] = s["window"]["samples"] * (linearised(s, p)[0] + stds * std)
        ekf.update(s, p, 0, 0.05**2)
        moved.append(s["mean"][0, B_SLOW] - before[B_SLOW])
    assert moved[1] == pytest.approx(moved[0] * 2.0 / 8.0)


def test_the_load_before_switch_on_is_a_stationary_random_load() -> None:
    """The covariance is compared with the solution of the Lyapunov equation of load and RC pairs."""
    p = settings()
    s = np.zeros(1, EKF_STATE)[0]
    mean, covariance = s["mean"][0], s["covariance"][0]
    ekf_noise.initial_branch_currents(p, 2.0, mean, covariance)
    one_c, size = p["capacity_as"] / 3600.0, BRANCHES + 1
    a = -np.diag(np.concatenate([[1.0 / p["load_s"]], 1.0 / TAUS]))
    a[1:, 0] = 1.0 / TAUS
    noise = np.zeros((size, size))
    noise[0, 0] = 2.0 * (p["load_c"] * one_c) ** 2 / p["load_s"]
    joint = solve_continuous_lyapunov(a, -noise) + (p["load_level_c"] * one_c) ** 2
    known = joint[1:, 0] / joint[0, 0]
    expected_a = p["load_mean_c"] * one_c + known * (2.0 - p["load_mean_c"] * one_c)
    assert mean[BRANCH] == pytest.approx(expected_a)
    assert covariance[BRANCH, BRANCH] == pytest.approx(joint[1:, 1:] - np.outer(known, joint[0, 1:]))


@pytest.mark.parametrize(("first_c", "rms_c"), [(0.0, 0.3), (-0.2, 0.3), (1.0, 1.0), (2.5, 1.285), (-6.0, 1.285)])
def test_the_first_sample_of_a_drive_may_be_a_peak(first_c: float, rms_c: float) -> None:
    """The model's error follows the RMS of the load. The first sample increases it at most to the RMS before switch-on."""
    p = settings()
    one_c = p["capacity_as"] / 3600.0
    s = np.zeros(1, EKF_STATE)[0]
    hypotheses.initialize_filter(s, p, 0.55, first_c * one_c, 12.0)
    assert np.sqrt(s["rms_a2"]) == pytest.approx(rms_c * one_c, rel=1e-3)
    assert abs(s["mean_a"]) <= np.sqrt(s["rms_a2"]) * (1.0 + 1e-9)


@pytest.mark.parametrize("first_c", [1.5, 3.0, 6.0])
def test_the_load_in_a_gap_after_a_peak_may_have_continued_or_ended(first_c: float) -> None:
    """The std is that of the long-term RMS load, 1.285 C."""
    p = settings()
    one_c = p["capacity_as"] / 3600.0
    s = np.zeros(1, EKF_STATE)[0]
    hypotheses.initialize_filter(s, p, 0.55, first_c * one_c, 12.0)
    unknown_c = gap_charge.gap_charge_std(s, p, first_c * one_c, 60.0) / (60.0 * one_c)
    assert first_c - 1.29 < unknown_c < first_c


def test_outside_the_temperatures_of_the_cell_file_r_grows() -> None:
    p = settings(low_c=0.0, high_c=30.0, model_j=0.0, sensor_v2=0.0)
    s = somewhere(p)
    variances = []
    for s["temperature_c"] in (10.0, 30.0, 60.0, -60.0):
        variances.append(ekf_noise.measurement_variance(s, p, 1.0, 5) / p["model_v"] ** 2)
    assert variances == pytest.approx([1.0, 1.0, 4.0, 9.0])


def test_errors_do_not_decrease_above_the_temperatures_of_the_cell_file() -> None:
    """Resistances decrease there, but errors of the model do not."""
    p = settings(low_c=0.0, high_c=30.0)
    s = somewhere(p)
    sizes = []
    for s["temperature_c"] in (30.0, 45.0, 60.0):
        temperature.update_arrhenius_factors(s)
        sizes.append((ekf_noise.measurement_variance(s, p, 1.0, 5), ekf_noise.bias_variance(s, p, 0)))
    assert sizes[1] == pytest.approx(1.5**2 * np.array(sizes[0]), rel=0.01)
    assert sizes[2] == pytest.approx(2.0**2 * np.array(sizes[0]), rel=0.01)


def test_inflation_is_one_for_white_innovations_and_grows_for_persistent_ones() -> None:
    s = np.zeros(1, EKF_STATE)[0]
    s["fast_inflation"][0] = s["slow_inflation"][0] = 1.0
    rng, slow = np.random.default_rng(3), []
    for u in rng.standard_normal(20_000):
        ekf.adapt_bias_inflation(s, 0, 1.0, u)
        slow.append(s["slow_inflation"][0])
    assert np.mean(slow) == pytest.approx(1.3, abs=0.3)  # ratios below 1 count as 1
    for _ in range(7200):
        ekf.adapt_bias_inflation(s, 0, 1.0, 0.2)
    assert s["slow_inflation"][0] > 30.0
    assert s["fast_inflation"][0] > 3.0


@pytest.mark.parametrize("dt_s", [1.0, 10.0, 60.0, 600.0])
def test_inflation_of_white_innovations_is_small_for_any_sample_period(dt_s: float) -> None:
    s = np.zeros(1, EKF_STATE)[0]
    s["fast_inflation"][0] = s["slow_inflation"][0] = 1.0
    rng, both = np.random.default_rng(4), []
    for u in rng.standard_normal(20_000):
        ekf.adapt_bias_inflation(s, 0, dt_s, u)
        both.append((s["fast_inflation"][0], s["slow_inflation"][0]))
    assert np.mean(both, axis=0) == pytest.approx([1.3, 1.3], abs=0.3)


def test_a_single_innovation_after_a_gap_causes_no_inflation(drive) -> None:
    estimator = start(drive)
    f = estimator.record[0]["filter"]
    estimator.run(drive.samples[:1800])
    assert f["count"] == 1
    names = "fast_inflation", "slow_inflation", "minute_u", "ten_minutes_u"
    before, seeded_s = [float(f[name][0]) for name in names], float(f["seeded_s"])
    estimator.run(drive.samples[1980:1981])
    assert [float(f[name][0]) for name in names] == before
    assert f["seeded_s"] == seeded_s + 181.0  # the sample was processed
    assert estimator.state["gaps"][0] == 1


def test_rc_pairs_after_a_gap_have_the_covariance_of_an_unknown_load() -> None:
    """The covariance is compared with 4000 draws of a load with a level and a Gauss-Markov process over three minutes."""
    p, rng, load_a, t, gap_s = settings(), np.random.default_rng(6), 2.0, settings()["load_s"], 180
    level_a = load_a * rng.standard_normal(4000)
    process_a, x = load_a * rng.standard_normal(4000), np.zeros((BRANCHES, 4000))
    for _ in range(gap_s):
        x += (1.0 - np.exp(-1.0 / TAUS))[:, None] * (level_a + process_a - x)
        process_a += -process_a * (1.0 - np.exp(-1.0 / t))
        process_a += load_a * np.sqrt(1.0 - np.exp(-2.0 / t)) * rng.standard_normal(4000)
    covariance, f = np.zeros((STATES, STATES)), np.ones(STATES)
    f[BRANCH] = np.exp(-gap_s / TAUS)
    ekf_noise.add_gap_noise(p, covariance, f, load_a, gap_s / p["capacity_as"])
    assert np.sqrt(np.diag(covariance)[BRANCH]) == pytest.approx(x.std(axis=1), rel=0.15)


@pytest.mark.parametrize("gap_s", [1.0, 6.0, 10.0, 30.0, 180.0, 3600.0])
def test_the_noise_of_a_gap_is_a_covariance(gap_s: float) -> None:
    p, covariance, f = settings(), np.zeros((STATES, STATES)), np.ones(STATES)
    f[BRANCH] = np.exp(-gap_s / TAUS)
    ekf_noise.add_gap_noise(p, covariance, f, 2.0, gap_s / p["capacity_as"])
    assert covariance == pytest.approx(covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > -1e-12


def mixture(mean, covariance, weight):
    """Return mean and covariance of a mixture of normal distributions by definition."""
    weight = weight / weight.sum()
    total = weight @ mean
    away = mean - total
    return total, np.einsum("q,qjk->jk", weight, covariance) + np.einsum("q,qj,qk->jk", weight, away, away)


def several(p, count=3):
    s = somewhere(p)
    rng = np.random.default_rng(4)
    for q in range(count):
        mixed = rng.standard_normal((STATES, STATES))
        s["mean"][q], s["covariance"][q] = rng.standard_normal(STATES), mixed @ mixed.T
        s["mean"][q, SOC] = 0.3 + 0.1 * q
        s["covariance"][q] /= 400.0
        s["ln_weight"][q] = -0.4 * q
    s["count"], s["best"] = count, 0
    return s, np.exp(s["ln_weight"][:count])


@pytest.mark.parametrize("series", [1.0, 6.0])
def test_the_soc_is_mean_and_std_of_the_mixture(series: float) -> None:
    p = settings(series=series)
    s, weight = several(p)
    mean, covariance = mixture(s["mean"][:3], s["covariance"][:3], weight)
    mixture_moments(s)
    assert s["soc"] == pytest.approx(mean[SOC])
    assert s["soc_std"] == pytest.approx(np.sqrt(covariance[SOC, SOC]))
    spread = p["cell_spread"] * (1.0 - mean[SOC]) if series > 1.0 else 0.0
    assert hypotheses.weakest_cell_soc_std(s, p) == pytest.approx(np.sqrt(covariance[SOC, SOC] + spread**2))


def test_merging_preserves_mean_and_covariance() -> None:
    s, weight = several(settings(), 2)
    mean, covariance = mixture(s["mean"][:2], s["covariance"][:2], weight)
    merge_pair(s, 0, 1)
    assert s["mean"][0] == pytest.approx(mean)
    assert s["covariance"][0] == pytest.approx(covariance)
    assert np.exp(s["ln_weight"][0]) == pytest.approx(weight.sum())


def test_unlikely_hypotheses_are_removed_and_similar_ones_merged() -> None:
    s, _ = several(settings(), 4)
    s["covariance"][:4, SOC, SOC] = 0.02**2
    s["mean"][:4, SOC] = 0.3, 0.5, 0.505, 0.7
    s["ln_weight"][:4] = 0.0, -0.1, -0.1, -20.0
    prune_and_merge(s)
    assert s["count"] == 2
    assert s["mean"][:2, SOC] == pytest.approx([0.3, 0.5025])


@pytest.mark.parametrize("true", [0, 1])
def test_a_hypothesis_with_a_large_bias_loses_weight(true: int) -> None:
    """Its biases of 0.2 V have absorbed the errors, so that its innovations are small."""
    p, apart = settings(), (0.4, 0.7)
    s, _ = several(p, 2)
    voltage_v = 0.0
    for q in (1 - true, true):
        s["mean"][q], s["covariance"][q] = 0.0, 1e-6 * np.eye(STATES)
        s["mean"][q, SOC] = apart[q]
        voltage_v = ekf.linearise(s, p, q, apart[q], 1e-6)[0]
    s["mean"][1 - true, B_SLOW] = voltage_v - ekf.linearise(s, p, 1 - true, apart[1 - true], 1e-6)[0]
    s["ln_weight"][:2] = 0.0
    assert abs(s["mean"][1 - true, B_SLOW]) > 0.2
    for _ in range(60):
        window.integrate_current(s, p, 1.0, False, s["current_a"], 25.0)
        s["window"]["samples"] = 0
        window.add_to_window(s, s["current_a"], voltage_v)
        hypotheses.update_hypotheses(s, p)
    likely = s["mean"][: s["count"], SOC][s["ln_weight"][: s["count"]] > -3.0]
    assert likely == pytest.approx([apart[true]], abs=0.05)


DRIVE = next(case for case in CASES if case.name == "oxide 25C")
FAST = Case("100 Hz", rate_hz=100.0, hours=0.25, unseen_h=0.3, seed=5)


def start(seen, wrong=0.2):
    return Estimator(seen.cell, initial_soc=float(seen.soc[0] + wrong))


@pytest.mark.parametrize("dt_s", [1.0, 10.0, 60.0])
def test_calibration_interpolates_the_current_as_the_filter_does(dt_s: float) -> None:
    current_a = np.repeat(np.random.default_rng(0).uniform(0.0, 3.0, 50), 4)
    samples = np.zeros(current_a.size, dtype=SAMPLE)
    samples["time_s"], samples["current_a"] = dt_s * np.arange(current_a.size), current_a
    samples["voltage_v"], samples["temperature_c"] = 3.7, 25.0
    estimator, x_a = Estimator(load_cell("nmc", 30.0)), []
    for sample in samples:
        estimator.run(sample[None])
        x_a.append(estimator.record[0]["filter"]["x_a"].copy())
    assert branch_currents(samples["time_s"], current_a) == pytest.approx(np.array(x_a), abs=1e-9)


@pytest.fixture(scope="module")
def drive():
    return capture(DRIVE)


@pytest.fixture(scope="module")
def fast():
    return capture(FAST)


@pytest.mark.parametrize("rate_hz", [0.1, 1.0, 100.0, 1000.0])
def test_the_covariance_stays_valid_at_any_rate(drive, fast, rate_hz: float) -> None:
    """The covariance is exactly symmetric, has no variance below 0 beyond rounding, and is finite."""
    samples = {0.1: drive.samples[::10], 1.0: drive.samples, 100.0: fast.samples, 1000.0: fast.samples.copy()}[rate_hz]
    if rate_hz == 1000.0:
        samples["time_s"] = samples["time_s"][0] + np.arange(samples.size) / rate_hz
    stays_a_covariance(start(drive if rate_hz <= 1.0 else fast), np.array_split(samples, 40))


@pytest.mark.parametrize("gap_s", [2, 6, 12, 60])
def test_the_covariance_stays_valid_through_gaps(drive, gap_s: int) -> None:
    parts = [part[: part.size - gap_s] for part in np.split(drive.samples[:3600], range(gap_s + 30, 3600, gap_s + 30))]
    stays_a_covariance(start(drive), parts)


def stays_a_covariance(estimator: Estimator, parts: list[SampleBlock]) -> None:
    f = estimator.record[0]["filter"]
    for part in parts:
        for samples in (part[:1], part[1:]):
            estimator.run(samples)
            is_covariance(f)
    assert estimator.record[0]["counters"]["reset"] == 0


def is_covariance(f) -> None:
    assert 1 <= f["count"] <= len(f["mean"])
    for covariance in f["covariance"][: f["count"]]:
        assert np.array_equal(covariance, covariance.T)
        scale = np.sqrt(np.diag(covariance))
        assert np.isfinite(scale).all()
        assert (scale > 0.0).all()
        assert np.linalg.eigvalsh(covariance / scale[:, None] / scale).min() > -1e-9


def test_100_samples_a_second_give_the_result_of_one(fast) -> None:
    """The mean of a second's samples is one update for any number of samples."""
    slow = fast.samples[::100]
    many, few = (start(fast).run(samples).copy() for samples in (fast.samples, slow))
    many = many[::100]
    assert many["time_s"] == pytest.approx(few["time_s"])
    late = slice(300, None)
    assert np.abs(many["soc"] - few["soc"])[late].max() < 0.004
    assert many["soc_std"][late] == pytest.approx(few["soc_std"][late], rel=0.1)


def test_hypotheses_converge_to_one(drive) -> None:
    estimator = start(drive)
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
    """Rows of merged and removed hypotheses are zero, and all rows but one after convergence."""
    estimator = start(drive)
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
    estimator = start(drive)
    estimator.run(drive.samples[:600])
    estimator.set_soc(soc)
    f = estimator.record[0]["filter"]
    assert f["soc"] == pytest.approx(soc, abs=0.01)
    assert 0.03 < f["soc_std"] < 0.06


@pytest.mark.parametrize("wrong", [-0.3, -0.1, 0.0, 0.1, 0.3])
def test_an_soc_set_by_the_user_is_corrected_if_the_voltage_contradicts(drive, wrong: float) -> None:
    """After 5 min the true SOC is inside the interval, and after 20 min the estimate is near it."""
    estimator = start(drive)
    estimator.run(drive.samples[:600])
    estimator.set_soc(float(drive.soc[600]) + wrong)
    trace = estimator.run(drive.samples[600:2400])
    error = np.abs(trace["soc"] - drive.soc[600:2400])
    assert (error < 2.0 * trace["soc_std"])[300:].all()
    assert error[1200:].max() < 0.01


def test_a_certain_but_wrong_soc_is_reinitialized(drive) -> None:
    """The SOC is 0.3 too low with a std of 0.01. Within 10 min the true SOC is inside the interval, and after 20 min
    the estimate is near it."""
    estimator = start(drive)
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
    estimator, samples = start(drive), drive.samples[:700].copy()
    samples["temperature_c"] = 8.0
    estimator.run(samples[:600])
    f = estimator.record[0]["filter"]
    f["temperature_c"] = np.nan
    estimator.run(samples[600:610])
    assert estimator.record[0]["counters"]["reset"] == 1
    assert f["temperature_c"] == 8.0


def test_single_temperatures_of_85_degrees_are_limited(drive) -> None:
    estimator, samples = start(drive), drive.samples[:1200].copy()
    samples["temperature_c"] = 25.0
    samples["temperature_c"][[0, 1]] = samples["temperature_c"][600:630] = 85.0
    taken_c = []
    for sample in samples:
        estimator.run(sample[None])
        taken_c.append(float(estimator.record[0]["filter"]["temperature_c"]))
    assert max(taken_c[60:]) < 28.5
    assert taken_c[-1] == pytest.approx(25.0, abs=0.1)


@pytest.mark.parametrize("unseen_s", [7200.0, np.inf])
def test_the_measured_temperature_is_used_at_once_after_a_restart(drive, unseen_s: float) -> None:
    """The errors of the hypotheses are those of the cold cell, not of the warm cell before the restart."""
    bias_v = []
    for before_c in (25.0, -15.0):
        estimator, samples = start(drive), drive.samples[:602].copy()
        samples["temperature_c"][:600], samples["temperature_c"][600:] = before_c, -15.0
        estimator.run(samples[:600])
        estimator.resume(unseen_s)
        estimator.run(samples[600:])
        f = estimator.record[0]["filter"]
        assert f["temperature_c"] == pytest.approx(-15.0, abs=0.1)
        bias_v.append(np.sqrt(f["covariance"][: f["count"], B_SLOW, B_SLOW]))
    assert bias_v[0].max() == pytest.approx(bias_v[1].max(), rel=0.3)


@pytest.mark.parametrize("field", ["mean", "covariance", "ln_weight"])
def test_non_finite_values_are_reset_and_counted(drive, field: str) -> None:
    estimator = start(drive)
    estimator.run(drive.samples[:1800])
    before = estimator.state["soc"][0]
    estimator.record[0]["filter"][field][0] = np.nan
    trace = estimator.run(drive.samples[1800:2400])
    assert estimator.record[0]["counters"]["reset"] == 1
    assert np.isfinite(trace["soc"][2:]).all()
    assert np.isfinite(trace["soc_std"][2:]).all()
    assert trace["soc"][5] == pytest.approx(before, abs=0.05)
    assert estimator.record[0]["filter"]["mean"][0, LN_R] != 0.0


@pytest.mark.parametrize(("soc", "held"), [(1.02, True), (-0.02, True), (0.6, False)])
def test_a_limited_soc_does_not_update_offset_capacity_and_curve(soc: float, held: bool) -> None:
    p = settings()
    s = somewhere(p)
    s["mean"][0, SOC] = soc
    before, std = s["mean"][0].copy(), np.sqrt(np.diag(s["covariance"][0]))
    ekf.update(s, p, 0, 1e-4)
    taught = [OFFSET, LN_Q, *range(NODE, STATES)]
    assert not held or np.array_equal(s["mean"][0, taught], before[taught])
    assert not held or np.array_equal(np.sqrt(np.diag(s["covariance"][0]))[taught], std[taught])
    assert held or np.all(s["mean"][0, taught] != before[taught])
    assert s["mean"][0, LN_R] != before[LN_R]


@pytest.mark.parametrize(
    ("trend_c", "r_std", "held"), [(0.9, 0.7, True), (-0.9, 0.7, True), (0.1, 0.7, False), (0.9, 0.1, False)]
)
def test_a_constant_current_does_not_update_the_capacity_with_uncertain_resistances(
    trend_c: float, r_std: float, held: bool
) -> None:
    p = settings(r_std=r_std)
    s = somewhere(p)
    s["x_a"][:] = s["mean_a"] = 3.0 * trend_c
    s["rms_a2"] = s["mean_a"] ** 2
    before = s["mean"][0, LN_Q]
    ekf.update(s, p, 0, 1e-4)
    assert (s["mean"][0, LN_Q] == before) == held
