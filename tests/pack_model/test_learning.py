"""Estimator with a slow fit: determinism, fits that fail, and the hand-over of a fit to the filter."""

import numpy as np
import pytest

from bms_estimator.estimator import Estimator
from bms_estimator.kernels.cell_model.rc_ladder import GRID
from bms_estimator.kernels.kalman_filter.records import LN_Q, LN_R, LN_R0, NODE, NODES, OFFSET, SOC, STATES
from bms_estimator.model.cell import load_cell
from bms_estimator.model.sample import SampleBlock
from bms_estimator.pack_model import fit as result
from bms_estimator.pack_model import learning
from bms_estimator.pack_model.cell_curves import SOC_GRID
from bms_estimator.pack_model.fit import FitError, PackFit
from bms_estimator.pack_model.handover import FILTER_STATES
from bms_estimator.pack_model.learning import SlowFit
from tests.estimator.simulated_cell import TRUTH, measured

INTERVAL_S = 1800.0
"""Interval between fits [s]."""
HALF_HOURS_C = (0.8, -0.8, 0.5, 0.0, -0.5, 0.9, 0.0, -0.9)
"""Current of each half hour, as a C-rate."""


@pytest.fixture(scope="module")
def samples() -> SampleBlock:
    current_a = np.repeat(HALF_HOURS_C, 1800) * TRUTH.cell.capacity_ah
    block, _ = measured(current_a, 0.7, np.random.default_rng(1))
    return block


def learner() -> SlowFit:
    return SlowFit(Estimator(load_cell("nca", TRUTH.cell.capacity_ah), initial_soc=0.5), interval_s=INTERVAL_S)


def run_in_parts(samples: SampleBlock, sizes: tuple[int, ...]) -> tuple[SlowFit, np.ndarray]:
    """Return the learner and its trace after blocks of the given sizes in turn."""
    slow_fit, traces, start, turn = learner(), [], 0, 0
    while start < samples.size:
        size = sizes[turn % len(sizes)]
        traces.append(slow_fit.run(samples[start : start + size]).copy())
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


def test_fit_that_fails_leaves_the_previous_one_in_use(
    samples: SampleBlock, whole: tuple[SlowFit, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    fits: list[PackFit] = []
    real_fit = learning.fit

    def first_fit_only(*args: object) -> PackFit:
        if fits:
            raise FitError("the history has no rows")
        fits.append(real_fit(*args))
        return fits[0]

    monkeypatch.setattr(learning, "fit", first_fit_only)
    slow_fit, trace = run_in_parts(samples, (samples.size,))
    assert slow_fit.fit is fits[0]
    assert (slow_fit.fits, slow_fit.failed) == (1, whole[0].fits - 1)
    assert np.isfinite(trace["soc"]).all()


def test_adopted_state_is_that_of_the_fit(samples: SampleBlock, monkeypatch: pytest.MonkeyPatch) -> None:
    """The SOC is counted on from the fit's last row. Covariances with the curve are in the filter's units."""
    slow_fit = learner()
    adopted: list[tuple[np.ndarray, np.ndarray, float, float]] = []
    adopt_state = learning.adopt_state

    def adopt_and_copy(estimator: Estimator, fitted: PackFit) -> None:
        adopt_state(estimator, fitted)
        f, h = estimator.record[0]["filter"], estimator.record[0]["history"]
        adopted.append((f["mean"][0].copy(), f["covariance"][0].copy(), float(h["charge_as"]), float(f["soc"])))

    monkeypatch.setattr(learning, "adopt_state", adopt_and_copy)
    slow_fit.run(samples)
    mean, covariance, charge_as, soc = adopted[-1]
    fitted, p = slow_fit.fit, slow_fit.estimator.settings_record[0]["filter"]
    assert fitted is not None
    assert slow_fit.fits == len(adopted)
    drawn_soc = (charge_as - fitted.charge_as) / p["capacity_as"] * np.exp(-fitted.mean[result.LN_Q])
    assert mean[SOC] == pytest.approx(fitted.mean[result.SOC] - drawn_soc, abs=1e-12)
    assert soc == pytest.approx(min(mean[SOC], 1.0), abs=1e-9)
    assert mean[LN_Q] == fitted.mean[result.LN_Q]
    one_c_a = float(p["capacity_as"]) / 3600.0
    assert mean[OFFSET] == pytest.approx(fitted.mean[result.OFFSET] * one_c_a)
    assert np.all(mean[NODE : NODE + NODES] == 0.0)
    assert covariance[LN_Q, OFFSET] == pytest.approx(fitted.covariance[result.LN_Q, result.OFFSET] * one_c_a)
    assert covariance[LN_R0, LN_R0] == covariance[LN_R, LN_R] == p["r_std"] ** 2
    np.testing.assert_array_equal(covariance, covariance.T)
    block = covariance[np.ix_(FILTER_STATES, FILTER_STATES)]
    assert np.linalg.eigvalsh(block).min() > -1e-9 * np.linalg.eigvalsh(block).max()


def test_hypotheses_keep_their_soc_if_a_gap_followed_the_fit(samples: SampleBlock) -> None:
    """The gap may hide a charge, so that the fit says nothing about the present SOC."""
    slow_fit = learner()
    slow_fit.run(samples)
    later = samples[:3].copy()
    later["time_s"] += samples["time_s"][-1] + 86400.0
    slow_fit.run(later)
    fitted, estimator = slow_fit.fit, slow_fit.estimator
    assert fitted is not None
    f = estimator.record[0]["filter"]
    count = int(f["count"])
    assert count > 1
    f["best"] = 1
    before = f["mean"][:count, SOC].copy()
    learning.adopt_state(estimator, fitted)
    assert f["count"] == count
    np.testing.assert_array_equal(f["mean"][:count, SOC], before)
    assert np.all(f["mean"][:count, LN_Q] == fitted.mean[result.LN_Q])


def test_fits_need_rows_or_throughput(samples: SampleBlock) -> None:
    slow_fit = learner()
    rest = samples.copy()
    rest["current_a"], rest["voltage_v"] = 0.0, 3.7
    slow_fit.run(rest)
    assert slow_fit.fits == slow_fit.failed == 0


def test_sizes_of_curves_and_states() -> None:
    """Results of a fit are mapped by position to the grid of the settings and to the last states of the filter."""
    assert SOC_GRID.size == GRID
    assert STATES == NODE + NODES
