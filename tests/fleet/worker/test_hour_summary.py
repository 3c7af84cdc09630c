"""An hour of a pack in one row."""

import json
import math

import numpy as np
import pytest

from bms_estimator import Estimator, load_cell
from bms_estimator.edge.block import Block
from bms_estimator.fleet.worker.hour_summary import HOUR_SUMS, Hour, add, begin, hour_of, row
from bms_estimator.model.fuel_cell import load_any
from bms_estimator.model.sample import SAMPLE
from bms_estimator.settings.pack import PackSettings
from tests.estimator.simulated_cell import pulses

STORE = 500_000 * 3600 * 10**9
PACK = PackSettings(name="p1", cell="ncr18650", series=1, parallel=2)


def block(samples, number=1, store=STORE):
    return Block(store, number, 1, store / 1e9 + float(samples["time_s"][-1]), samples)


def work(sums, estimator, samples, store=STORE):
    for first in range(0, samples.size, 60):
        part = block(samples[first : first + 60], first // 60 + 1, store)
        add(sums, estimator.run(part.samples), part, estimator)


@pytest.fixture(scope="module")
def an_hour():
    """Sums, estimator and samples of an hour at 1 Hz."""
    samples, _ = pulses(soc=0.8, hours=1.0)
    sums, estimator = np.zeros(1, HOUR_SUMS), Estimator(load_cell("ncr18650"))
    work(sums, estimator, samples)
    return sums, estimator, samples


def test_a_row_says_what_was_measured(an_hour):
    sums, estimator, samples = an_hour
    found = row(PACK, 500_000, sums, estimator)
    current, voltage = samples["current_a"], samples["voltage_v"]
    steps = 0.5 * (current[1:] + current[:-1]) / 3600
    assert (found.pack, found.hour, found.cell, found.series, found.parallel) == ("p1", 500_000, "ncr18650", 1, 2)
    assert (found.samples, found.dropped, found.gaps, found.seen_s) == (3600, 0, 0, 3599.0)
    assert found.charge_out_ah == pytest.approx(steps[steps > 0].sum())
    assert found.charge_in_ah == pytest.approx(-steps[steps < 0].sum())
    watts = current * voltage
    assert found.energy_out_wh - found.energy_in_wh == pytest.approx(0.5 * (watts[1:] + watts[:-1]).sum() / 3600)
    assert found.voltage_v == pytest.approx(voltage.mean())
    assert (found.voltage_min_v, found.voltage_max_v) == (voltage.min(), voltage.max())
    assert (found.current_min_a, found.current_max_a) == (current.min(), current.max())
    assert (found.temperature_c, found.temperature_min_c, found.temperature_max_c) == (25.0, 25.0, 25.0)
    assert found.rest_s == (0.0 if current[-1] else pytest.approx(3599 - np.flatnonzero(current)[-1], abs=1))


def test_a_row_says_what_is_known_at_its_end(an_hour):
    sums, estimator, samples = an_hour
    found, trace = row(PACK, 500_000, sums, estimator), Estimator(load_cell("ncr18650")).run(samples)
    assert (found.soc, found.soc_std) == (trace["soc"][-1], trace["soc_std"][-1])
    assert (found.r_s_ohm, found.tau_tl_std_s) == (trace["r_s_ohm"][-1], trace["tau_tl_std_s"][-1])
    assert found.stability_margin_min == trace["stability_margin"].min()
    assert found.innovation_rms_v == pytest.approx(np.sqrt(np.mean(trace["innovation_v"] ** 2)))
    assert 0.0 < found.capacity_ratio_std < 0.1
    assert abs(found.soc_offset_correlation) <= 1.0


def test_a_row_is_json_that_reads_back(an_hour):
    text = row(PACK, 500_000, an_hour[0], an_hour[1]).model_dump_json()
    assert Hour.model_validate_json(text).model_dump_json() == text
    assert "NaN" not in text


def test_blocks_of_another_size_give_the_same_row(an_hour):
    sums, estimator, samples = an_hour
    whole, other = np.zeros(1, HOUR_SUMS), Estimator(load_cell("ncr18650"))
    add(whole, other.run(samples), block(samples), other)
    assert row(PACK, 1, whole, other) == row(PACK, 1, sums, estimator)


def test_the_next_hour_begins_at_nothing_and_has_the_step_from_the_last_sample():
    samples, _ = pulses(soc=0.8, hours=0.1)
    sums, estimator = np.zeros(1, HOUR_SUMS), Estimator(load_cell("ncr18650"))
    work(sums, estimator, samples[:180])
    first = row(PACK, 1, sums, estimator)
    begin(sums, estimator.record[0])
    work(sums, estimator, samples[180:])
    second = row(PACK, 2, sums, estimator)
    assert (first.samples, second.samples, first.seen_s, second.seen_s) == (180, 180, 179.0, 180.0)
    whole, other = np.zeros(1, HOUR_SUMS), Estimator(load_cell("ncr18650"))
    work(whole, other, samples)
    assert first.charge_out_ah + second.charge_out_ah == pytest.approx(row(PACK, 1, whole, other).charge_out_ah)


def test_nothing_is_counted_over_gaps_and_from_one_clock_to_another():
    samples, _ = pulses(soc=0.8, hours=0.1)
    samples["current_a"] = 1.0
    sums, estimator = np.zeros(1, HOUR_SUMS), Estimator(load_cell("ncr18650"))
    work(sums, estimator, samples[:60])
    work(sums, estimator, samples[120:180])  # a gap of 61 s
    estimator.resume(100.0)
    work(sums, estimator, samples[180:240], STORE + 1)  # another clock, though it seems to go on
    found = row(PACK, 1, sums, estimator)
    assert (found.gaps, found.seen_s) == (2, 3 * 59.0)
    assert found.charge_out_ah == pytest.approx(3 * 59.0 / 3600)


def test_what_is_dropped_and_not_known_is_said():
    samples = np.zeros(3, SAMPLE)
    samples["time_s"], samples["voltage_v"], samples["temperature_c"] = range(3), math.nan, math.nan
    sums, estimator = np.zeros(1, HOUR_SUMS), Estimator(load_cell("ncr18650"))
    add(sums, estimator.run(samples), block(samples), estimator)
    found = row(PACK, 1, sums, estimator)
    assert (found.samples, found.dropped) == (0, 3)
    assert found.soc is found.voltage_v is found.temperature_c is found.r_s_ratio is found.stability_margin_min is None


def test_a_fuel_cell_has_no_soc():
    samples = np.zeros(60, SAMPLE)
    samples["time_s"], samples["voltage_v"], samples["current_a"] = range(60), 30.0, 1.0
    sums, estimator = np.zeros(1, HOUR_SUMS), Estimator(load_any("pem_30w"))
    add(sums, estimator.run(samples), block(samples), estimator)
    found = json.loads(row(PACK, 1, sums, estimator).model_dump_json())
    assert (found["soc"], found["capacity_ah"], found["soc_std"]) == (None, None, None)


def test_a_block_belongs_to_the_hour_of_its_last_sample():
    samples = np.zeros(60, SAMPLE)
    samples["time_s"] = 3600.0 - 30.0 + np.arange(60)
    assert hour_of(block(samples)) == 500_001
    assert hour_of(block(samples[:30])) == 500_000
    samples["time_s"][-1] = math.inf
    assert hour_of(Block(STORE, 1, 1, 0.0, samples)) == 500_000
