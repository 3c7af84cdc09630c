"""Rows of the history: means over samples, and where one row ends and the next begins."""

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.accumulators.history import (
    FIRST_REST_S,
    MAX_ROW_S,
    MIN_ROW_S,
    REST_GROWTH,
    ROW_SOC,
)
from bms_estimator.model.arrays import SampleBlock
from bms_estimator.pack.pack import Pack
from bms_estimator.pack_model.slow_fit import SlowFit
from bms_estimator.settings.observer import Sampling
from tests.estimator.simulated_cell import TRUTH, measured

WINDOW_S = 1.0
"""Duration of the filter's window, by which the end of a row may be late [s]."""
DIRECTION_LAG_S = 400.0
"""Maximum lag of the direction after a change of the current [s]. Filtered over 120 s, 0.3 C falls to 0.015 C in 360 s."""
CAPACITY_AH = TRUTH.cell.capacity_ah
SECONDS = np.arange(9 * 3600)
USE_A = np.select(
    [SECONDS < 600, SECONDS < 4200, SECONDS < 15000, SECONDS < 18600, SECONDS < 18640],
    [0.0, 0.3 * CAPACITY_AH, 0.0, -0.3 * CAPACITY_AH, 0.5 * CAPACITY_AH],
    0.0,
)
"""A rest, a discharge, a rest of three hours, a charge, a discharge of 40 s, and a rest [A]."""


@pytest.fixture(scope="module")
def samples() -> SampleBlock:
    block, _ = measured(USE_A, 0.8, np.random.default_rng(1))
    block["temperature_c"] = 20.0 + SECONDS / 3600.0
    return block


@pytest.fixture(scope="module")
def rows(samples: SampleBlock) -> np.ndarray:
    slow_fit = SlowFit(Estimator(TRUTH, initial_soc=0.8), interval_s=np.inf)
    Pack(slow_fit.estimator, slow_fit).run(samples)
    return slow_fit.history.rows


def ends_s(rows: np.ndarray) -> np.ndarray:
    """Return the end of each row, counted from the first sample [s]."""
    return rows["elapsed_s"] + rows["duration_s"] / 2.0


def test_rows_contain_the_means_of_their_samples(samples: SampleBlock, rows: np.ndarray) -> None:
    voltage_step_v = 2e-3
    for row in rows:
        start_s, end_s = row["elapsed_s"] - row["duration_s"] / 2.0, row["elapsed_s"] + row["duration_s"] / 2.0
        own = samples[(samples["time_s"] > start_s - 0.5) & (samples["time_s"] < end_s - 0.5)]
        # samples at the border of a row may belong to its neighbor
        border_v = 2.0 * np.ptp(own["voltage_v"]) / own.size
        assert own.size == pytest.approx(row["duration_s"], abs=2.0)
        assert row["voltage_v"] == pytest.approx(own["voltage_v"].mean(), abs=border_v + voltage_step_v / own.size)
        assert row["current_a"] == pytest.approx(
            own["current_a"].mean(), abs=2.0 * np.ptp(own["current_a"]) / own.size + 1e-9
        )
        assert row["temperature_c"] == pytest.approx(own["temperature_c"].mean(), abs=0.05)


def test_rows_are_in_order_and_cover_the_samples(rows: np.ndarray) -> None:
    starts = rows["elapsed_s"] - rows["duration_s"] / 2.0
    assert np.all(starts[1:] >= ends_s(rows)[:-1] - 1.5 * WINDOW_S)
    assert rows["duration_s"].min() >= MIN_ROW_S
    assert rows["duration_s"].sum() > 0.95 * ends_s(rows)[-1]
    assert np.all(rows["segment"] == rows["segment"][0])
    assert np.isnan(rows["reference_soc"]).all()


def test_charge_is_the_mean_over_the_row(samples: SampleBlock, rows: np.ndarray) -> None:
    charge_as = np.cumsum(samples["current_a"])
    for row in rows:
        middle, half = int(row["elapsed_s"]), int(row["duration_s"] / 2.0)
        own_as = charge_as[max(middle - half, 0) : middle + half + 1]
        assert row["charge_as"] == pytest.approx(own_as.mean(), abs=2.0 * np.ptp(own_as) / own_as.size + 1e-6)


def test_rows_end_at_changes_of_direction(rows: np.ndarray) -> None:
    """The direction is that of the current filtered by the RC pair ``TREND_PAIR``, and therefore changes later."""
    assert rows["direction"][[0, -1]].tolist() == [0.0, 0.0]
    changes_s = ends_s(rows)[:-1][np.diff(rows["direction"]) != 0.0]
    assert np.all(
        np.min(np.abs(changes_s[:, None] - [600.0, 4200.0, 15000.0, 18600.0, 18640.0]), axis=1) < DIRECTION_LAG_S
    )
    assert set(rows["direction"].tolist()) == {-1.0, 0.0, 1.0}
    for row in rows:
        if row["direction"] != 0.0 and row["duration_s"] > 600.0:
            assert np.sign(row["current_a"]) == row["direction"]


def test_rows_of_a_load_end_at_their_maximum_charge(rows: np.ndarray) -> None:
    moved_soc = np.abs(rows["current_a"]) * rows["duration_s"] / 3600.0 / CAPACITY_AH
    assert moved_soc.max() <= ROW_SOC * 1.02
    steady = (rows["direction"] != 0.0) & (np.abs(np.abs(rows["current_a"]) - 0.3 * CAPACITY_AH) < 1e-6)
    assert steady.sum() > 20
    assert np.median(moved_soc[steady]) == pytest.approx(ROW_SOC, rel=0.02)


def test_rows_of_a_rest_grow_with_its_duration(rows: np.ndarray) -> None:
    start = int(np.flatnonzero((rows["direction"] == 0.0) & (rows["elapsed_s"] > 4200.0))[0])
    end = int(np.flatnonzero((rows["direction"] != 0.0) & (rows["elapsed_s"] > 14000.0))[0])
    durations_s = rows["duration_s"][start:end]
    assert durations_s[0] == pytest.approx(FIRST_REST_S, abs=2.0 * WINDOW_S)
    rest_s = np.cumsum(durations_s)
    allowed_s = np.minimum(np.maximum(FIRST_REST_S, REST_GROWTH * rest_s), MAX_ROW_S)
    assert np.all(durations_s <= allowed_s + 2.0 * WINDOW_S)
    assert durations_s[-2] > 10.0 * FIRST_REST_S


def test_gap_that_may_hide_a_charge_begins_a_segment(samples: SampleBlock) -> None:
    later = samples.copy()
    later["time_s"][3000:] += 7200.0
    slow_fit = SlowFit(Estimator(TRUTH, initial_soc=0.8), interval_s=np.inf)
    Pack(slow_fit.estimator, slow_fit).run(later)
    rows = slow_fit.history.rows
    assert np.unique(rows["segment"]).size == 2
    first, second = rows[rows["segment"] == rows["segment"][0]], rows[rows["segment"] == rows["segment"][-1]]
    assert ends_s(first)[-1] == pytest.approx(3000.0, abs=60.0)
    assert np.all(second["gap_s"] == pytest.approx(7200.0, abs=2.0))
    assert second["elapsed_s"][0] - second["duration_s"][0] / 2.0 == pytest.approx(10200.0, abs=60.0)
    # the counters restart with the segment
    assert second["throughput_soc"][0] < ROW_SOC
    assert np.abs(second["hysteresis"][0]).max() < 1.0


@pytest.mark.parametrize("step_s", [1, 60])
def test_rows_of_a_slow_source_contain_the_uncertainty_of_the_current_between_samples(step_s: int) -> None:
    """The true mean current deviates from the measured one by about the std of the row."""
    rng = np.random.default_rng(1)
    levels_a = np.repeat(CAPACITY_AH * rng.choice([0.1, 0.4, 0.8], 900), 12)
    block, _ = measured(levels_a, 0.95, rng)
    slow = block[::step_s]
    slow_fit = SlowFit(Estimator(TRUTH, initial_soc=0.95, sampling=Sampling(period_s=float(step_s))), interval_s=np.inf)
    Pack(slow_fit.estimator, slow_fit).run(slow)
    rows = slow_fit.history.rows
    assert (rows["skew_a2"] == 0.0).all()
    if step_s == 1:
        assert (rows["between_a2"] == 0.0).all()
        return
    charge_as = np.cumsum(np.append(0.0, levels_a))
    ends = np.rint(rows["elapsed_s"][:, None] + rows["duration_s"][:, None] * [-0.5, 0.5]).astype(int)
    true_a = (charge_as[ends[:, 1]] - charge_as[ends[:, 0]]) / rows["duration_s"]
    ratio = np.sqrt(np.mean((true_a - rows["current_a"]) ** 2) / np.mean(rows["between_a2"]))
    assert 0.5 < ratio < 2.0
