"""Check of temperature probes: the temperatures of samples, and which probes are faulty."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bms_estimator.model.arrays import SAMPLE, SampleStatus
from bms_estimator.protocols.base.probe_check import (
    COOLING_K_PER_S,
    COOLING_TOLERANCE_K,
    SUSTAINED_S,
    CheckedProbes,
    ProbeCheck,
)

NAN = math.nan


def check_each_second(*rows_c: Sequence[float]) -> list[CheckedProbes]:
    """Return the results for samples at 1 Hz."""
    probes = ProbeCheck()
    return [probes.check(float(time_s), row_c) for time_s, row_c in enumerate(rows_c)]


@pytest.mark.parametrize(
    ("readings_c", "mean_lowest_highest_c", "faulty"),
    [
        pytest.param([25.0], (25.0, 25.0, 25.0), (), id="one probe"),
        pytest.param([20.0, 22.0, NAN], (21.0, 20.0, 22.0), (), id="absent probe"),
        pytest.param([25.0, 25.0, 90.0, 25.0], (25.0, 25.0, 90.0), (2,), id="hot probe counts for the highest"),
        pytest.param([25.0, -15.0, 25.0], (25.0, 25.0, 25.0), (1,), id="cold outlier"),
        pytest.param([25.0, -15.0], (5.0, -15.0, 25.0), (0, 1), id="of two probes none is known to be right"),
        pytest.param([25.0, 25.0, -15.0, -15.0], (5.0, -15.0, 25.0), (1, 2), id="two against two"),
        pytest.param([25.0, -30.0, -39.9, 127.0], (25.0, 25.0, 25.0), (1, 2, 3), id="open and shorted probes"),
        pytest.param([-273.1, 255.0, 3276.7, 20.0], (20.0, 20.0, 20.0), (0, 1, 2), id="impossible readings"),
        pytest.param([-40.0], (NAN, NAN, NAN), (0,), id="only an open probe"),
        pytest.param([], (NAN, NAN, NAN), (), id="no probe"),
    ],
)
def test_temperatures_are_those_of_the_credible_probes(
    readings_c: list[float], mean_lowest_highest_c: tuple[float, ...], faulty: tuple[int, ...]
) -> None:
    (result,) = check_each_second(readings_c)
    assert result[:3] == pytest.approx(mean_lowest_highest_c, nan_ok=True)
    assert tuple(n for n, is_faulty in enumerate(result.faulty) if is_faulty) == faulty


@pytest.mark.parametrize("rate_k_per_s", [1.0, 8.0, 20.0, 50.0])
def test_a_probe_in_thermal_runaway_counts_from_the_first_sample_on(rate_k_per_s: float) -> None:
    hot_c = [min(25.0 + rate_k_per_s * second, 180.0) for second in range(60)]
    results = check_each_second(*([25.0, 25.0, reading_c, 25.0] for reading_c in hot_c))
    assert [result.highest_c for result in results] == hot_c


def test_a_jump_that_stays_is_believed_within_seconds() -> None:
    results = check_each_second([25.0, 25.0], *[[25.0, 90.0]] * 5)
    assert [result.highest_c for result in results] == [25.0, 25.0, 90.0, 90.0, 90.0, 90.0]
    assert results[1].faulty == (False, True)


def test_a_rise_that_is_faster_than_possible_but_goes_on_is_believed() -> None:
    results = check_each_second(*([reading_c] for reading_c in (25.0, 80.0, 140.0, 190.0)))
    assert results[-1].highest_c == 190.0


def test_a_single_glitch_is_excluded_and_the_next_reading_is_believed() -> None:
    results = check_each_second([25.0], [85.0], [25.1], [-28.0], [25.2])
    assert [result.highest_c for result in results] == pytest.approx([25.0, NAN, 25.1, NAN, 25.2], nan_ok=True)


def test_a_probe_that_bounces_is_never_believed_and_counts_as_one_fault() -> None:
    probes = ProbeCheck()
    rows_c = [[25.0, 25.0, 25.0], *[[25.0, 25.0, 100.0 if n % 2 else -50.0] for n in range(200)]]
    results = [probes.check(float(n), row_c) for n, row_c in enumerate(rows_c)]
    assert {result.highest_c for result in results} == {result.lowest_c for result in results} == {25.0}
    assert probes.faults == 1


def test_a_probe_that_really_cools_to_the_reading_of_an_open_one_is_believed() -> None:
    results = check_each_second(*([20.0 - second] for second in range(65)))
    assert results[50].lowest_c == -30.0
    assert results[60].lowest_c == -40.0
    assert not any(any(result.faulty) for result in results)


def test_a_sample_after_a_long_gap_may_have_any_plausible_temperature() -> None:
    probes = ProbeCheck()
    probes.check(0.0, [25.0])
    assert probes.check(60.0, [75.0]).highest_c == 75.0


@pytest.mark.parametrize("others_c", [[], [30.0]])
def test_a_hot_probe_is_faulty_until_it_can_have_cooled_to_its_reading(others_c: list[float]) -> None:
    results = check_each_second(*[[*others_c, 70.0]] * 20, *[[*others_c, 0.0]] * 200)
    faulty_s = [second for second, result in enumerate(results) if result.faulty[-1] and second >= 20]
    assert faulty_s[0] == 20
    # until it can have cooled by 70 K less the tolerance; the time of the last sustained 70 degC is up to 10 s before the last hot sample at 19 s
    assert faulty_s[-1] == pytest.approx(19 + (70.0 - COOLING_TOLERANCE_K) / COOLING_K_PER_S, abs=SUSTAINED_S + 1.0)
    assert faulty_s == list(range(20, faulty_s[-1] + 1))


def test_a_hot_probe_cools_through_a_gap() -> None:
    probes = ProbeCheck()
    for second in range(20):
        probes.check(float(second), [70.0])
    assert probes.check(60.0, [20.0]).faulty == (True,)
    assert probes.check(150.0, [20.0]) == CheckedProbes(20.0, 20.0, 20.0, (False,))


def test_a_probe_that_heats_up_and_cools_is_credible() -> None:
    rise_c = [25.0 + 2.0 * second for second in range(30)]
    cooling_c = [rise_c[-1] - 0.5 * second for second in range(120)]
    results = check_each_second(*([reading_c + second % 3] for second, reading_c in enumerate(rise_c + cooling_c)))
    assert not any(result.faulty[0] for result in results)


def test_a_probe_that_dies_right_after_a_thermal_runaway_is_faulty() -> None:
    rise = [[40.0 + 5.0 * second] for second in range(20)]
    results = check_each_second(*rise, *[[41.0]] * 60)
    assert all(result.faulty[0] for result in results[20:])


@pytest.mark.parametrize("period_s", [11.0, 60.0])
def test_the_heat_of_a_slow_source_is_followed(period_s: float) -> None:
    probes = ProbeCheck()
    readings_c = [25.0, 50.0, *[75.0] * 10, 20.0]
    results = [probes.check(period_s * n, [reading_c]) for n, reading_c in enumerate(readings_c)]
    # the last reading is credible only if the probe can have cooled from 75 degC to it within a period, less the tolerance
    assert [result.faulty[0] for result in results] == [False] * 12 + [period_s * COOLING_K_PER_S < 50.0]


@pytest.mark.parametrize("usual_c", [25.0, 46.0, 60.0])
def test_glitches_of_a_few_samples_do_not_count_as_hot(usual_c: float) -> None:
    results = check_each_second(*[[usual_c]] * 30, *[[usual_c + 29.0]] * 5, *[[usual_c]] * 30)
    assert not any(result.faulty[0] for result in results)


@given(
    st.lists(st.sampled_from([NAN, -50.0, -39.9, -30.0, -25.0, 0.0, 20.0, 44.0, 48.0, 60.0, 90.0]), max_size=120),
    st.integers(min_value=1, max_value=40),
)
def test_blocks_of_a_single_probe_give_the_results_of_single_samples(readings_c: list[float], size: int) -> None:
    rows = np.zeros(len(readings_c), dtype=SAMPLE)
    rows["time_s"] = np.arange(rows.size) * 2.0
    rows["temperature_c"] = rows["temperature_min_c"] = rows["temperature_max_c"] = readings_c
    blocks, single = ProbeCheck(), ProbeCheck()
    for begin in range(0, rows.size, size):
        blocks.apply_to_single_probe(rows[begin : begin + size])
    expected = [single.check(2.0 * n, [reading_c]) for n, reading_c in enumerate(readings_c)]
    for name, field in (
        ("temperature_c", "mean_c"),
        ("temperature_min_c", "lowest_c"),
        ("temperature_max_c", "highest_c"),
    ):
        np.testing.assert_array_equal(rows[name], [getattr(each, field) for each in expected])
    assert ((rows["status"] & SampleStatus.PROBE_FAULT) != 0).tolist() == [each.faulty[0] for each in expected]
    assert blocks.faults == single.faults


@given(
    st.lists(st.lists(st.floats(), max_size=6), max_size=30),
    st.lists(st.floats(min_value=-10.0, max_value=100.0), min_size=30, max_size=30),
)
def test_any_readings_give_ordered_temperatures(rows_c: list[list[float]], steps_s: list[float]) -> None:
    probes, time_s = ProbeCheck(), 0.0
    for row_c, step_s in zip(rows_c, steps_s, strict=False):
        time_s += step_s
        mean_c, lowest_c, highest_c, faulty = probes.check(time_s, row_c)
        assert len(faulty) == len(row_c)
        assert math.isnan(mean_c) or -60.0 <= lowest_c <= mean_c <= highest_c <= 200.0


def test_the_rounded_mean_of_equal_readings_does_not_hide_a_hot_probe() -> None:
    for tenths in range(450):
        mean_c, lowest_c, highest_c, _ = ProbeCheck().check(0.0, [tenths / 10] * 3 + [95.0])
        assert lowest_c <= mean_c <= highest_c == 95.0  # otherwise the alarms judge the mean
