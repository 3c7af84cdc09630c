"""Results of ``step`` and ``run``, invalid samples, counted charge, and shipped cells."""

import math

import numpy as np
import pytest

from bms_estimator.estimator.estimator import SAMPLE_OUTCOMES, Estimator
from bms_estimator.estimator.stability_conditions import failed_conditions, lemma_conditions
from bms_estimator.kernels.kalman_filter.records import SCRATCH
from bms_estimator.kernels.step import SampleOutcome
from bms_estimator.model.arrays import SAMPLE, SampleBlock, SampleStatus
from bms_estimator.model.cell import load_cell, shipped_cells
from bms_estimator.settings.observer import ObserverSettings
from bms_estimator.telemetry.parameters import make_parameters_payload
from tests.estimator.simulated_cell import pulses, run_divided

CAPACITY_AS = 3.0 * 3600
"""Capacity of the cell ncr18650 [A s]."""

ELEMENTS = "r_s_ohm", "r_ts_ohm", "tau_ts_s", "r_tl_ohm", "tau_tl_s"
ESTIMATES = "soc", "soc_std", "innovation_v", *ELEMENTS
"""Columns of the trace with estimates of the identifier."""


def noisy_load(n: int = 5000) -> SampleBlock:
    """Return random samples with irregular times, of which some have no voltage or a voltage of 0."""
    rng = np.random.default_rng(7)
    samples = np.zeros(n, dtype=SAMPLE)
    samples["time_s"] = np.cumsum(rng.choice([0.01, 0.02, 1.0, 7.0], n))
    samples["current_a"] = rng.normal(0.5, 1.0, n)
    samples["voltage_v"] = 3.8 + rng.normal(0.0, 0.05, n)
    samples["voltage_v"][rng.integers(0, n, 20)] = np.nan
    samples["voltage_v"][rng.integers(0, n, 20)] = 0.0
    for name in ("temperature_c", "temperature_min_c", "temperature_max_c"):
        samples[name] = np.nan
    return samples


def test_step_and_run_are_bit_identical_for_any_block_size() -> None:
    run_divided(lambda: Estimator(load_cell("ncr18650"), initial_soc=0.8, identifier=None), noisy_load())


@pytest.mark.parametrize("series", [1, 4])
def test_soc_and_its_std_are_those_of_the_last_row(series: int) -> None:
    samples = noisy_load(200)
    samples["voltage_v"] *= series
    estimator = Estimator(load_cell("ncr18650").pack(series, 1), initial_soc=0.8)
    assert math.isnan(estimator.soc)
    assert math.isnan(estimator.weakest_cell_soc_std)
    last = estimator.run(samples)[-1]
    assert (estimator.soc, estimator.weakest_cell_soc_std) == (last["soc"], last["soc_std"])


def test_scratch_space_is_written_before_it_is_used() -> None:
    samples = pulses(hours=0.3)[0]
    samples["time_s"][300:] += 120.0
    samples["time_s"][600:] += 2e4
    saved, uninterrupted = (Estimator(load_cell("ncr18650"), initial_soc=0.7) for _ in range(2))
    trace = uninterrupted.run(samples)
    for j in range(0, samples.size, 20):
        saved.record["filter"][SCRATCH] = np.nan
        rows = saved.run(samples[j : j + 20])
        assert rows.tobytes() == trace[j : j + 20].tobytes()
    for estimator in (saved, uninterrupted):
        estimator.record["filter"][SCRATCH] = 0.0
    assert saved.record.tobytes() == uninterrupted.record.tobytes()


def test_the_gain_of_the_observer_changes_no_estimate() -> None:
    """With the identifier, the observer's voltage error changes only the observer, and a1..a12 by the e^2 of (3.18)."""
    samples = pulses()[0]
    on, off = (Estimator(load_cell("nca", 3.0), ObserverSettings(gain_limit=g), initial_soc=0.8) for g in (1e3, 1e-300))
    traces = [estimator.run(samples) for estimator in (on, off)]
    assert np.ptp(traces[0]["tracking_error_v"] - traces[1]["tracking_error_v"]) > 0.01
    of_the_filter = [name for name in on.record.dtype.names or () if name not in ("observer", "learning")]
    assert all(on.record[name].tobytes() == off.record[name].tobytes() for name in of_the_filter)
    assert all(traces[0][name].tobytes() == traces[1][name].tobytes() for name in ESTIMATES)
    reports = [make_parameters_payload(estimator, 0.0) for estimator in (on, off)]
    valid = {name for name, element in reports[0].elements.items() if element.valid}
    assert "r_s_ohm" in valid
    assert all(reports[0].elements[name] == reports[1].elements[name] for name in valid)
    assert reports[0].state_of_health == reports[1].state_of_health
    for name, parameter in reports[0].a.items():
        assert parameter.value == pytest.approx(reports[1].a[name].value, rel=1e-6)


def test_soc_has_no_std_without_the_identifier() -> None:
    estimator = Estimator(load_cell("ncr18650"), initial_soc=0.8, identifier=None)
    estimator.run(noisy_load(200))
    assert math.isnan(estimator.weakest_cell_soc_std)


def test_a_restored_state_resumes_identically() -> None:
    samples = noisy_load()
    uninterrupted = Estimator(load_cell("ncr18650"), initial_soc=0.8, identifier=None)
    uninterrupted.run(samples)
    first = Estimator(load_cell("ncr18650"), initial_soc=0.8, identifier=None)
    first.run(samples[:2000])
    second = Estimator(load_cell("ncr18650"), identifier=None)
    second.state[:] = first.state
    second.run(samples[2000:])
    assert uninterrupted.state.tobytes() == second.state.tobytes()


@pytest.mark.parametrize(
    ("time_s", "current_a", "voltage_v", "status", "outcome", "counter"),
    [
        (2.0, 0.1, float("nan"), 0, SampleOutcome.NOT_FINITE, "dropped_not_finite"),
        (2.0, float("inf"), 3.7, 0, SampleOutcome.NOT_FINITE, "dropped_not_finite"),
        (float("nan"), 0.1, 3.7, 0, SampleOutcome.NOT_FINITE, "dropped_not_finite"),
        (2.0, 0.1, 0.0, 0, SampleOutcome.OUT_OF_RANGE, "dropped_range"),
        (2.0, 400.0, 3.7, 0, SampleOutcome.OUT_OF_RANGE, "dropped_range"),
        (1.0, 0.1, 3.7, 0, SampleOutcome.REPEATED, "dropped_repeated"),
        (2.0, 0.1, 3.7, SampleStatus.VOLTAGE_SATURATED, SampleOutcome.SATURATED, "dropped_saturated"),
        (2.0, 0.1, 3.7, SampleStatus.CURRENT_SATURATED, SampleOutcome.SATURATED, "dropped_saturated"),
    ],
)
def test_a_bad_sample_is_dropped_counted_and_changes_nothing_else(
    time_s: float, current_a: float, voltage_v: float, status: int, outcome: SampleOutcome, counter: str
) -> None:
    estimator = Estimator(load_cell("ncr18650"), initial_soc=0.5, identifier=None)
    estimator.step(0.0, 0.1, 3.7)
    estimator.step(1.0, 0.1, 3.7)
    before = estimator.state.copy()
    assert estimator.step(time_s, current_a, voltage_v, int(status)) is outcome
    before[counter] += 1
    assert before.tobytes() == estimator.state.tobytes()


def test_outcomes_are_indexed_by_their_value() -> None:
    assert [SAMPLE_OUTCOMES[outcome] for outcome in SampleOutcome] == list(SampleOutcome)


def test_a_clock_set_back_is_counted_and_loses_a_single_step() -> None:
    estimator = Estimator(load_cell("ncr18650"), initial_soc=0.5, identifier=None)
    for time_s in (0.0, 1.0, 2.0, -500.0, -499.0):
        assert estimator.step(time_s, 3.0, 3.7) is SampleOutcome.ACCEPTED
    assert estimator.state["time_steps_back"][0] == 1
    # Three of the four steps count: 3 A for 3 s.
    assert estimator.state["soc"][0] == pytest.approx(0.5 - 3.0 * 3.0 / CAPACITY_AS)


def test_charge_is_counted_over_a_gap() -> None:
    estimator = Estimator(load_cell("ncr18650"), initial_soc=0.5, identifier=None)
    estimator.step(0.0, 1.0, 3.7)
    estimator.step(10.0, 1.0, 3.7)
    assert estimator.state["gaps"][0] == 1
    assert estimator.state["soc"][0] == pytest.approx(0.5 - 1.0 * 10.0 / CAPACITY_AS)


def test_slow_sampling_does_not_count_as_gaps() -> None:
    estimator = Estimator(load_cell("ncr18650"), initial_soc=0.5, identifier=None)
    for time_s in (0.0, 10.0, 20.0, 30.0, 90.0, 100.0):
        estimator.step(time_s, 1.0, 3.7)
    # The first step counts, because the sample period is not known yet. The step of 60 s is the second gap.
    assert estimator.state["gaps"][0] == 2


def test_the_smaller_current_of_both_ends_is_counted_over_a_gap() -> None:
    estimator = Estimator(load_cell("ncr18650"), initial_soc=0.5, identifier=None)
    for time_s, current_a in ((0.0, 1.0), (1800.0, 0.2), (3600.0, -1.0)):
        estimator.step(time_s, current_a, 3.7)
    assert estimator.state["soc"][0] == pytest.approx(0.5 - 0.2 * 1800.0 / CAPACITY_AS)


def test_one_wrong_time_stamp_does_not_empty_the_cell() -> None:
    estimator = Estimator(load_cell("ncr18650"), initial_soc=0.5, identifier=None)
    for time_s in (0.0, 1.0, 1e9, 2.0, 3.0):
        estimator.step(time_s, 0.3, 3.7)
    # The charge over a gap is limited to that of one hour: 0.3 A * 1 h / 3 Ah.
    assert estimator.state["soc_coulomb"][0] == pytest.approx(0.5 - 0.1, abs=1e-3)


def test_soc_starts_from_the_open_circuit_voltage_when_not_given() -> None:
    cell = load_cell("chen_mora")
    estimator = Estimator(cell, identifier=None)
    estimator.step(0.0, 0.0, 3.85)  # no current: the voltage is the OCV
    soc = float(estimator.state["soc"][0])
    a = cell.a  # a16..a21 are the coefficients of the OCV by Chen and Mora
    assert -a[16] * np.exp(-a[17] * soc) + a[18] + a[19] * soc - a[20] * soc**2 + a[21] * soc**3 == pytest.approx(3.85)


@pytest.mark.parametrize("name", shipped_cells())
def test_shipped_cells_load_and_step(name: str) -> None:
    cell = load_cell(name)
    assert Estimator(cell, identifier=None).step(0.0, 0.0, cell.cell.nominal_voltage_v) is SampleOutcome.ACCEPTED


def test_settings_of_table_5_violate_condition_1_of_lemma_4_1_1() -> None:
    """Erratum 6 of the thesis. P7.l7 is the sum of the bounds of a7, each times its weight. P9.l9 should be smaller."""
    cell = load_cell("chen_mora")
    assert [(c.name, c.left, c.right) for c in failed_conditions(cell)] == [("1: P9.l9 < P7.l7", 89000.0, 87500.0)]
    assert sum(c.holds for c in lemma_conditions(cell)) == 5


def test_default_bounds_satisfy_lemma_4_1_1() -> None:
    cell = load_cell("chen_mora").model_copy(update={"adaptation": {}})
    assert failed_conditions(cell) == []
