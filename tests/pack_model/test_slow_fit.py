"""Estimator with a slow fit: determinism, fits that fail, and the hand-over of a fit to the filter."""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator, TraceBlock
from bms_estimator.estimator.fitted_state import FILTER_STATES
from bms_estimator.kernels.kalman_filter.records import LN_Q, LN_R, LN_R0, NODE, NODES, OFFSET, SOC
from bms_estimator.model.arrays import SampleBlock, SampleStatus
from bms_estimator.model.cell import load_cell
from bms_estimator.model.input_faults import InputFault
from bms_estimator.pack.pack import Pack
from bms_estimator.pack_model import fit as fit_module, slow_fit as slow_fit_module
from bms_estimator.pack_model.fit import FitError, PackFit
from bms_estimator.pack_model.slow_fit import SlowFit, run_now
from bms_estimator.settings.observer import Sampling
from tests.estimator.simulated_cell import TRUTH, measured
from tests.pack_model.quick_fit import quick_fit

INTERVAL_S = 1800.0
"""Interval between fits [s]."""
HALF_HOURS_C = (0.8, -0.8, 0.5, 0.0, -0.5, 0.9, 0.0, -0.9)
"""Current of each half hour, as a C-rate."""


@pytest.fixture(scope="module")
def samples() -> SampleBlock:
    current_a = np.repeat(HALF_HOURS_C, 1800) * TRUTH.cell.capacity_ah
    block, _ = measured(current_a, 0.7, np.random.default_rng(1))
    return block


def run(slow_fit: SlowFit, samples: SampleBlock) -> TraceBlock:
    """Process samples with the estimator and its slow fit. Return the trace."""
    return Pack(slow_fit.estimator, slow_fit).run(samples).trace


def new_slow_fit() -> SlowFit:
    return SlowFit(Estimator(load_cell("nca", TRUTH.cell.capacity_ah), initial_soc=0.5), interval_s=INTERVAL_S)


def run_in_parts(samples: SampleBlock, sizes: tuple[int, ...]) -> tuple[SlowFit, np.ndarray]:
    """Return the slow fit and its trace after blocks of the given sizes in turn."""
    slow_fit, traces, start, turn = new_slow_fit(), [], 0, 0
    while start < samples.size:
        size = sizes[turn % len(sizes)]
        traces.append(run(slow_fit, samples[start : start + size]).copy())
        start, turn = start + size, turn + 1
    return slow_fit, np.concatenate(traces)


@pytest.fixture(scope="module")
def whole(samples: SampleBlock) -> tuple[SlowFit, np.ndarray]:
    return run_in_parts(samples, (samples.size,))


@pytest.mark.parametrize("sizes", [(977,), (1, 5000, 60)])
def test_blocks_of_any_size_give_the_same_trace(
    samples: SampleBlock, whole: tuple[SlowFit, np.ndarray], sizes: tuple[int, ...]
) -> None:
    slow_fit, trace = run_in_parts(samples, sizes)
    assert slow_fit.fits == whole[0].fits >= 2
    assert trace.tobytes() == whole[1].tobytes()
    assert slow_fit.estimator.record.tobytes() == whole[0].estimator.record.tobytes()


@pytest.mark.parametrize(("period_s", "is_fitted"), [(10, True), (60, False)])
def test_there_is_no_fit_while_the_current_at_the_times_of_the_voltages_is_unknown(
    period_s: int, is_fitted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A load changes every 20 s. Voltage and current come in turn, half a period apart."""
    monkeypatch.setattr(slow_fit_module, "fit", quick_fit)
    rng = np.random.default_rng(1)
    current_a = np.repeat(rng.uniform(0.0, 1.0, 900), 20) * TRUTH.cell.capacity_ah
    current_a[9000:] *= -1.0
    samples = measured(current_a, 0.9, rng)[0][:: period_s // 2].copy()
    samples["status"][::2], samples["status"][1::2] = SampleStatus.CURRENT_HELD, SampleStatus.VOLTAGE_HELD
    slow_fit = SlowFit(Estimator(TRUTH, sampling=Sampling(period_s=period_s)), interval_s=INTERVAL_S)
    run(slow_fit, samples)
    assert slow_fit.history.rows.size > 5 * slow_fit_module.MIN_ROWS
    assert bool(slow_fit.fits) == is_fitted


def test_fit_that_fails_leaves_the_previous_one_in_use(samples: SampleBlock, monkeypatch: pytest.MonkeyPatch) -> None:
    fits: list[PackFit] = []
    real_fit = slow_fit_module.fit

    def first_fit_only(*args: object) -> PackFit:
        if fits:
            raise FitError("the history has no rows")
        first = real_fit(*args)
        fits.append(replace(first, covariance=0.1 * first.covariance))  # certain enough to be adopted
        return fits[0]

    monkeypatch.setattr(slow_fit_module, "fit", first_fit_only)
    slow_fit, trace = run_in_parts(samples, (samples.size,))
    assert slow_fit.fit
    assert slow_fit.fit == replace(fits[0], soc_bound=slow_fit.fit.soc_bound)
    assert slow_fit.fits == 1
    assert slow_fit.failed >= 1
    assert np.isfinite(trace["soc"]).all()


def test_adopted_state_is_that_of_the_fit_but_for_the_soc_of_a_surer_filter(
    samples: SampleBlock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The charge since the fit's last row is subtracted. Covariances with the curve are in the filter's units."""
    slow_fit = new_slow_fit()
    adopted: list[tuple[np.ndarray, np.ndarray, float, float]] = []
    adopt_state = slow_fit_module.adopt_state

    def adopt_and_copy(estimator: Estimator, fitted: PackFit) -> None:
        f, h = estimator.record[0]["filter"], estimator.record[0]["history"]
        f["soc_std"] = 1.0
        adopt_state(estimator, fitted)
        adopted.append((f["mean"][0].copy(), f["covariance"][0].copy(), float(h["charge_as"]), float(f["soc"])))

    monkeypatch.setattr(slow_fit_module, "adopt_state", adopt_and_copy)
    run(slow_fit, samples)
    mean, covariance, charge_as, soc = adopted[-1]
    fitted, p, f = slow_fit.fit, slow_fit.estimator.settings_record[0]["filter"], slow_fit.estimator.record[0]["filter"]
    assert fitted is not None
    assert slow_fit.fits == len(adopted)
    assert fitted.mean[fit_module.SOC] - mean[SOC] == pytest.approx(
        (charge_as - fitted.charge_as) / p["capacity_as"] * np.exp(-fitted.mean[fit_module.LN_Q]), abs=1e-12
    )
    assert soc == pytest.approx(min(mean[SOC], 1.0), abs=1e-9)
    assert mean[LN_Q] == fitted.mean[fit_module.LN_Q]
    one_c_a = float(p["capacity_as"]) / 3600.0
    assert mean[OFFSET] == pytest.approx(fitted.mean[fit_module.OFFSET] * one_c_a)
    assert np.all(mean[NODE : NODE + NODES] == 0.0)
    assert covariance[LN_Q, OFFSET] == pytest.approx(fitted.covariance[fit_module.LN_Q, fit_module.OFFSET] * one_c_a)
    assert covariance[LN_R0, LN_R0] == covariance[LN_R, LN_R] == p["r_std"] ** 2
    np.testing.assert_array_equal(covariance, covariance.T)
    eigenvalues = np.linalg.eigvalsh(covariance[np.ix_(FILTER_STATES, FILTER_STATES)])
    assert eigenvalues.min() > -1e-9 * eigenvalues.max()
    f["mean"][0][SOC] = 0.4
    larger = 1.1 * f["soc_std"] ** 2 / fitted.covariance[fit_module.SOC, fit_module.SOC]
    adopt_state(slow_fit.estimator, replace(fitted, covariance=larger * fitted.covariance))
    assert f["mean"][0][SOC] == 0.4


def test_a_fault_that_a_fit_shows_remains_until_a_fit_without_it(
    samples: SampleBlock, monkeypatch: pytest.MonkeyPatch
) -> None:
    faults = iter([InputFault.FITTED_TEMPERATURE, *[InputFault(0)] * 8])
    monkeypatch.setattr(slow_fit_module, "fit", lambda *args: replace(quick_fit(*args), faults=next(faults)))
    slow_fit = new_slow_fit()
    for block in np.array_split(samples, 8):  # half hours
        run(slow_fit, block)
        suspects = InputFault(int(slow_fit.estimator.record[0]["checks"]["suspects"]))
        assert (InputFault.FITTED_TEMPERATURE in suspects) == (slow_fit.fits == 1)
    assert slow_fit.fits > 1


def test_hypotheses_keep_their_soc_if_a_gap_followed_the_fit(samples: SampleBlock) -> None:
    """The gap may hide a charge, so that the fit has no information on the present SOC."""
    slow_fit = new_slow_fit()
    run(slow_fit, samples)
    later = samples[:3].copy()
    later["time_s"] += samples["time_s"][-1] + 86400.0
    run(slow_fit, later)
    fitted, estimator = slow_fit.fit, slow_fit.estimator
    assert fitted is not None
    f = estimator.record[0]["filter"]
    count = int(f["count"])
    assert count > 1
    f["best"] = 1
    before = f["mean"][:count, SOC].copy()
    slow_fit_module.adopt_state(estimator, fitted)
    assert f["count"] == count
    np.testing.assert_array_equal(f["mean"][:count, SOC], before)
    assert np.all(f["mean"][:count, LN_Q] == fitted.mean[fit_module.LN_Q])


def quick_fit_with(std: Callable[[], float]) -> Callable[..., PackFit]:
    """Return a fit with a std of the SOC."""

    def fit_with_std(*args: object) -> PackFit:
        fitted = quick_fit(*args)  # type: ignore[arg-type]
        fitted.covariance[fit_module.SOC, fit_module.SOC] = std() ** 2
        return fitted

    return fit_with_std


@pytest.mark.parametrize(("soc_std", "begin"), [(0.05, 1800), (0.07, 5400)])
def test_a_fit_of_less_than_a_cycle_is_adopted_only_if_its_std_is_small(
    samples: SampleBlock, monkeypatch: pytest.MonkeyPatch, soc_std: float, begin: int
) -> None:
    """The throughput exceeds 1 in the third half hour."""
    monkeypatch.setattr(slow_fit_module, "fit", quick_fit_with(lambda: soc_std))
    slow_fit = new_slow_fit()
    run(slow_fit, samples[:begin])
    assert slow_fit.fits == 0
    run(slow_fit, samples[begin : begin + 300])
    assert slow_fit.fits == 1


@pytest.mark.parametrize(("ratio", "is_adopted"), [(2.0, False), (0.9, True)])
def test_a_fit_after_few_rows_and_restarts_does_not_enlarge_the_std(
    samples: SampleBlock, monkeypatch: pytest.MonkeyPatch, ratio: float, is_adopted: bool
) -> None:
    """Six starts in half an hour leave a few rows in several segments, which do not determine the SOC."""
    slow_fit = new_slow_fit()
    f = slow_fit.estimator.record[0]["filter"]
    monkeypatch.setattr(slow_fit_module, "fit", quick_fit_with(lambda: ratio * float(f["soc_std"])))
    for start in range(6):
        part = samples[300 * start : 300 * (start + 1)]
        run(slow_fit, part)
        slow_fit.estimator.resume(600.0)
        slow_fit.resume(600.0, restored=True)
    assert np.unique(slow_fit.history.rows["segment"]).size > 3
    while slow_fit.estimator.record[0]["history"]["elapsed_s"] < 2.0 * INTERVAL_S:
        part = part.copy()
        part["time_s"] += 300.0
        run(slow_fit, part)
    assert (slow_fit.fits > 0) == is_adopted
    assert slow_fit.saved_fit is not None


def histories_of_fits(samples: SampleBlock) -> np.ndarray:
    """Return number of rows and age [s] of the history at the start of each fit in a day."""
    histories: list[tuple[int, float]] = []

    def submit(call: Callable[[], PackFit]) -> Future[PackFit]:
        histories.append((slow_fit.history.rows.size, float(slow_fit.estimator.record[0]["history"]["elapsed_s"])))
        return run_now(call)

    slow_fit = SlowFit(Estimator(load_cell("nca", TRUTH.cell.capacity_ah)), submit=submit, interval_s=3600.0)
    day = np.tile(samples, 6)
    day["time_s"] = np.arange(day.size)
    run(slow_fit, day)
    return np.array(histories).T


@pytest.mark.parametrize(("max_certain_std", "waits"), [(0.04, True), (0.02, False)])
def test_a_fit_after_a_certain_one_waits_until_the_history_has_grown(
    samples: SampleBlock, monkeypatch: pytest.MonkeyPatch, max_certain_std: float, waits: bool
) -> None:
    """The std of the SOC is 0.03."""
    monkeypatch.setattr(slow_fit_module, "fit", quick_fit)
    monkeypatch.setattr(slow_fit_module, "MIN_GROWTH", 0.3)
    monkeypatch.setattr(slow_fit_module, "MAX_CERTAIN_STD", max_certain_std)
    sizes, _ = histories_of_fits(samples)
    assert sizes.size > 3
    assert (np.diff(sizes) >= 0.3 * sizes[1:]).all() == waits


def test_a_short_history_is_fitted_more_often(samples: SampleBlock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slow_fit_module, "fit", quick_fit)
    _, times_s = histories_of_fits(samples)
    intervals_s = np.diff(times_s)
    assert intervals_s[0] == pytest.approx(1800.0, abs=15.0)
    assert intervals_s[-1] == pytest.approx(3600.0, abs=15.0)
    # the median, because a half hour with too few new rows has no fit
    assert np.median(intervals_s[times_s[:-1] < 6.0 * 3600.0]) == pytest.approx(1800.0, abs=15.0)
