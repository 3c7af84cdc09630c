"""Observed load: seconds at any sample rate, gaps, charges and rests."""

import numpy as np
import pytest

from bms_estimator.forecast.load_history import LoadHistory
from bms_estimator.kernels.forecast.load_seconds import MAX_LOAD_S
from bms_estimator.kernels.records import TRACE

CAPACITY_AS = 3600.0
"""Capacity of 1 Ah, so that currents in A are C-rates [A s]."""


def rows(current_a, step_s=1.0, begin_s=0.0):
    trace = np.zeros(len(current_a), TRACE)
    trace["time_s"] = begin_s + step_s * np.arange(trace.size)
    trace["current_a"] = current_a
    return trace


def history_of(*blocks, unmeasured_s=60.0):
    load = LoadHistory(CAPACITY_AS, unmeasured_s)
    for block in blocks:
        load.add(block)
    return load


@pytest.mark.parametrize("rate_hz", [0.1, 0.5, 1.0, 10.0, 1000.0])
def test_a_ramp_has_the_same_seconds_at_each_sample_rate(rate_hz):
    seconds = 100
    count = round(seconds * rate_hz) + 1
    load = history_of(rows(np.linspace(0.1, 0.6, count), 1.0 / rate_hz))
    assert load.seconds == pytest.approx(seconds, abs=1)
    assert load.mean_a.mean() == pytest.approx(0.35, abs=0.01)
    # tolerance: slope of the ramp times half of a second or of a sample interval, whichever is longer
    exact_a = np.interp(np.arange(load.seconds) + 0.5, [0, seconds], [0.1, 0.6])
    assert np.abs(load.mean_a - exact_a).max() < 0.5 * 0.5 / 100 * max(1.0 / rate_hz, 1.0) + 1e-6


def test_a_peak_within_a_second_is_its_largest_current_but_hardly_changes_its_mean():
    current_a = np.full(301, 0.1)
    current_a[155] = 3.0
    load = history_of(rows(current_a, 0.1))
    assert load.max_a.max() == pytest.approx(3.0)
    assert load.mean_a.max() == pytest.approx(0.1 + 0.1 * 2.9)
    assert (load.max_a > 1.0).sum() == 1


def test_any_division_into_blocks_gives_the_same_record():
    trace = rows(np.random.default_rng(1).choice([0.0, 0.5, 2.0, -0.5], 5000), 0.3)
    whole = history_of(trace)
    parts = history_of(*np.array_split(trace, 999))
    assert whole.record.tobytes() == parts.record.tobytes()


def test_a_gap_adds_no_time():
    load = history_of(rows(np.full(100, 0.5)), rows(np.full(100, 0.5), begin_s=10_000.0))
    assert load.seconds == 198
    assert np.allclose(load.mean_a, 0.5)


def test_a_clock_that_is_set_back_adds_no_time():
    load = history_of(rows(np.full(100, 0.5), begin_s=1e9), rows(np.full(100, 0.5)))
    assert load.seconds == 198


def test_the_buffer_keeps_the_latest_seconds():
    load = history_of(rows(np.arange(1, MAX_LOAD_S + 5002) / 1000.0))
    assert load.seconds == MAX_LOAD_S
    assert load.mean_a[-1] == pytest.approx((MAX_LOAD_S + 5000.5) / 1000.0)
    assert load.mean_a[0] == pytest.approx(5.0015)
    assert (np.diff(load.mean_a) > 0.0).all()


def test_a_long_charge_empties_the_buffer_and_regeneration_does_not():
    load = history_of(rows([0.5] * 1000 + [-0.1] * 120 + [0.5] * 500))
    assert load.seconds == 1619
    assert not load.is_charging
    load.add(rows([-0.5] * 1000, begin_s=1620.0))
    assert load.seconds == 0
    assert load.is_charging
    load.add(rows([0.3] * 400, begin_s=2620.0))
    assert load.seconds == pytest.approx(400, abs=2)
    assert load.mean_a.min() > 0.0
    assert not load.is_charging


def test_a_rest_at_the_beginning_is_left_out_and_a_long_one_is_cut():
    load = history_of(rows([0.0] * 1000 + [0.5] * 100 + [0.0] * 6000 + [0.5] * 100))
    assert load.seconds == pytest.approx(4200, abs=2)
    assert load.rest_s == 0
    load.add(rows([0.0] * 1000, begin_s=7200.0))
    assert load.rest_s == pytest.approx(1000, abs=2)


def test_a_saved_record_continues():
    trace = rows(np.random.default_rng(1).choice([0.0, 0.5, 2.0], 1000), 0.3)
    whole, saved, restored = history_of(trace), history_of(trace[:500]), LoadHistory(CAPACITY_AS)
    restored.record[...] = saved.record
    restored.add(trace[500:])
    assert restored.record.tobytes() == whole.record.tobytes()
