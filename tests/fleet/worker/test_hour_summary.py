"""Row that summarizes an hour of a pack."""

import json
import math

import numpy as np
import pytest

from bms_estimator.edge.block import Block
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.fleet.hour_row import Hour
from bms_estimator.fleet.worker.hour_summary import (
    add,
    begin,
    hour_of,
    row,
)
from bms_estimator.kernels.accumulators.hour import HOUR_SUMS
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.model.cell import load_cell
from bms_estimator.model.pack_model import load_model
from bms_estimator.settings.observer import IdentifierSettings
from bms_estimator.settings.pack import PackSettings
from tests.estimator.simulated_cell import pulses
from tests.telemetry.test_parameters import file_with_ladder

STORE_HOUR = 500_000
"""Hour in which the edge's block store was created [hours since 1970]."""
STORE_ID_NS = STORE_HOUR * 3600 * 10**9
"""Creation time of the block store, which identifies it and is the origin of its time stamps [ns since 1970]."""
HOUR_SAMPLES = 3600
"""Number of samples of an hour at 1 Hz."""
PACK = PackSettings(name="p1", cell="ncr18650", series=1, parallel=2)


def add_blocks(sums, estimator, samples, store=STORE_ID_NS):
    """Run the estimator over ``samples`` in blocks of 60, and add the results to ``sums``."""
    for first in range(0, samples.size, 60):
        add(sums, estimator.run(samples[first : first + 60]), 60, store, estimator)


@pytest.fixture(scope="module")
def hour():
    """Return sums, estimator and samples of an hour at 1 Hz."""
    samples, _ = pulses(soc=0.8, hours=1.0)
    sums, estimator = np.zeros(1, HOUR_SUMS), Estimator(load_cell("ncr18650"))
    add_blocks(sums, estimator, samples)
    return sums, estimator, samples


def test_row_has_sums_means_and_extremes_of_the_measured_values(hour):
    sums, estimator, samples = hour
    summary = row(PACK, STORE_HOUR, sums, estimator)
    current, voltage = samples["current_a"], samples["voltage_v"]
    steps_ah = 0.5 * (current[1:] + current[:-1]) / 3600  # charge between two samples, which are 1 s apart
    assert (summary.pack, summary.hour, summary.cell, summary.series, summary.parallel) == (
        "p1",
        STORE_HOUR,
        "ncr18650",
        1,
        2,
    )
    assert (summary.samples, summary.dropped, summary.gaps, summary.seen_s) == (3600, 0, 0, 3599.0)
    assert summary.charge_out_ah == pytest.approx(steps_ah[steps_ah > 0].sum())
    assert summary.charge_in_ah == pytest.approx(-steps_ah[steps_ah < 0].sum())
    watts = current * voltage
    assert summary.energy_out_wh - summary.energy_in_wh == pytest.approx(0.5 * (watts[1:] + watts[:-1]).sum() / 3600)
    assert summary.voltage_v == pytest.approx(voltage.mean())
    assert (summary.voltage_min_v, summary.voltage_max_v) == (voltage.min(), voltage.max())
    assert (summary.current_min_a, summary.current_max_a) == (current.min(), current.max())
    assert (summary.temperature_c, summary.temperature_min_c, summary.temperature_max_c) == (25.0, 25.0, 25.0)
    time_since_last_load_s = 0.0 if current[-1] else pytest.approx(3599 - np.flatnonzero(current)[-1], abs=1)
    assert summary.rest_s == time_since_last_load_s


def test_row_has_the_estimates_at_the_end_of_the_hour(hour):
    sums, estimator, samples = hour
    summary, trace = row(PACK, STORE_HOUR, sums, estimator), Estimator(load_cell("ncr18650")).run(samples)
    assert (summary.soc, summary.soc_std) == (trace["soc"][-1], trace["soc_std"][-1])
    assert (summary.r_s_ohm, summary.tau_tl_std_s) == (trace["r_s_ohm"][-1], trace["tau_tl_std_s"][-1])
    assert summary.stability_margin_min is None
    assert np.isnan(trace["stability_margin"]).all()
    assert summary.innovation_rms_v == pytest.approx(np.sqrt(np.mean(trace["innovation_v"] ** 2)))
    assert 0.0 < summary.capacity_ratio_std < 0.1
    assert abs(summary.soc_offset_correlation) <= 1.0


def test_margin_is_the_minimum_over_samples_with_a_valid_margin() -> None:
    samples, _ = pulses()
    estimator, other = (
        Estimator(file_with_ladder(0.1), identifier=IdentifierSettings(), initial_soc=1.0) for _ in range(2)
    )
    estimator.run(samples[:-HOUR_SAMPLES])
    other.run(samples[:-HOUR_SAMPLES])
    sums = np.zeros(1, HOUR_SUMS)
    add_blocks(sums, estimator, samples[-HOUR_SAMPLES:])
    margin = other.run(samples[-HOUR_SAMPLES:])["stability_margin"]
    assert 0 < np.isfinite(margin).sum() < margin.size
    assert row(PACK, STORE_HOUR, sums, estimator).stability_margin_min == np.nanmin(margin)


def test_row_is_restored_from_json(hour):
    text = row(PACK, STORE_HOUR, hour[0], hour[1]).model_dump_json()
    assert Hour.model_validate_json(text).model_dump_json() == text
    assert "NaN" not in text


def test_row_does_not_depend_on_the_size_of_the_blocks(hour):
    sums, estimator, samples = hour
    one_block_sums, other_estimator = np.zeros(1, HOUR_SUMS), Estimator(load_cell("ncr18650"))
    add(one_block_sums, other_estimator.run(samples), samples.size, STORE_ID_NS, other_estimator)
    assert row(PACK, 1, one_block_sums, other_estimator) == row(PACK, 1, sums, estimator)


def test_next_hour_starts_at_zero_and_includes_the_step_from_the_last_sample():
    samples, _ = pulses(soc=0.8, hours=0.1)
    sums, estimator = np.zeros(1, HOUR_SUMS), Estimator(load_cell("ncr18650"))
    add_blocks(sums, estimator, samples[:180])
    first = row(PACK, 1, sums, estimator)
    begin(sums, estimator.record[0])
    add_blocks(sums, estimator, samples[180:])
    second = row(PACK, 2, sums, estimator)
    assert (first.samples, second.samples, first.seen_s, second.seen_s) == (180, 180, 179.0, 180.0)
    whole_sums, other_estimator = np.zeros(1, HOUR_SUMS), Estimator(load_cell("ncr18650"))
    add_blocks(whole_sums, other_estimator, samples)
    whole = row(PACK, 1, whole_sums, other_estimator)
    assert first.charge_out_ah + second.charge_out_ah == pytest.approx(whole.charge_out_ah)


def test_time_and_charge_across_gaps_and_changes_of_the_store_are_not_counted():
    samples, _ = pulses(soc=0.8, hours=0.1)
    samples["current_a"] = 1.0
    sums, estimator = np.zeros(1, HOUR_SUMS), Estimator(load_cell("ncr18650"))
    add_blocks(sums, estimator, samples[:60])
    add_blocks(sums, estimator, samples[120:180])  # a gap of 61 s
    estimator.resume(unseen_s=100.0)
    # the timestamps of another store have another origin
    add_blocks(sums, estimator, samples[180:240], STORE_ID_NS + 1)
    summary = row(PACK, 1, sums, estimator)
    assert (summary.gaps, summary.seen_s) == (2, 3 * 59.0)  # 60 samples of each block span 59 s
    assert summary.charge_out_ah == pytest.approx(3 * 59.0 / 3600)  # at 1 A


def test_dropped_samples_are_counted_and_unknown_values_are_none():
    samples = np.zeros(3, SAMPLE)
    samples["time_s"], samples["voltage_v"], samples["temperature_c"] = range(3), math.nan, math.nan
    sums, estimator = np.zeros(1, HOUR_SUMS), Estimator(load_cell("ncr18650"))
    add(sums, estimator.run(samples), samples.size, STORE_ID_NS, estimator)
    summary = row(PACK, 1, sums, estimator)
    assert (summary.samples, summary.dropped) == (0, 3)
    unknown_values = (summary.soc, summary.voltage_v, summary.temperature_c, summary.r_s_ratio)
    assert (*unknown_values, summary.stability_margin_min) == (None,) * 5


def test_row_of_a_fuel_cell_has_no_soc_and_capacity():
    samples = np.zeros(60, SAMPLE)
    samples["time_s"], samples["voltage_v"], samples["current_a"] = range(60), 30.0, 1.0
    sums, estimator = np.zeros(1, HOUR_SUMS), Estimator(load_model("pem_30w"))
    add(sums, estimator.run(samples), samples.size, STORE_ID_NS, estimator)
    summary = json.loads(row(PACK, 1, sums, estimator).model_dump_json())
    assert (summary["soc"], summary["capacity_ah"], summary["soc_std"]) == (None, None, None)


def test_block_belongs_to_the_hour_of_its_last_sample():
    samples = np.zeros(60, SAMPLE)
    samples["time_s"] = 3600.0 - 30.0 + np.arange(60)
    for count, hour in ((60, STORE_HOUR + 1), (30, STORE_HOUR)):
        assert hour_of(Block(STORE_ID_NS, 1, 1, arrival_s=0.0, samples=samples[:count])) == hour


def test_block_with_an_infinite_last_time_belongs_to_the_hour_of_its_store():
    samples = np.zeros(60, SAMPLE)
    samples["time_s"] = 3600.0 + np.arange(60)
    samples["time_s"][-1] = math.inf
    assert (
        hour_of(Block(store_created_ns=STORE_ID_NS, number=1, oldest=1, arrival_s=0.0, samples=samples)) == STORE_HOUR
    )
