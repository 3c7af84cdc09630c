"""Capacity from rests with a known SOC (anchors), on cells that differ from the model.

The errors of the cell files have the standard deviations that the files declare.
"""

import numpy as np
import pytest

from bms_estimator.calibration.capacity import Capacity, measure_capacity
from bms_estimator.calibration.capacity_anchors import continuous_parts
from bms_estimator.model.arrays import SAMPLE, SampleBlock
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from tests.estimator.anywhere.cases import (
    OXIDE,
    PHOSPHATE,
    Case,
    cell_file,
)
from tests.estimator.anywhere.truth import Truth, simulate

WRONG_CAPACITY = 1.2
"""Capacity of the cell file relative to the true one, which must not influence the result."""
SENSOR_A = 0.004
"""Std of the offset of a good current sensor [A]."""
STEP_S = 10.0
"""Sample period [s]."""
DISCHARGE_S = 7200.0
"""Duration of a discharge at C/2 [s]."""


def simulate_capture(
    current_a: np.ndarray, truth: Truth = OXIDE, soc: float = 0.95, offset_a: float = 0.0
) -> SampleBlock:
    """Return samples with a period of ``STEP_S`` from rest at ``soc``."""
    rows = np.zeros(current_a.size, dtype=SAMPLE)
    rows["time_s"], rows["temperature_c"] = STEP_S * np.arange(current_a.size), 25.0
    curves = truth.ocv_v, truth.per_kelvin_v, truth.hysteresis_v, truth.ohm
    branch = 1.0  # the cell was charged
    voltage_v, _ = simulate(STEP_S, current_a, rows["temperature_c"], soc, branch, truth.capacity_ah, *curves)
    rows["voltage_v"], rows["current_a"] = np.round(voltage_v, 3), current_a + offset_a
    return rows


def load_and_rests_a(soc_span: float, rests: int = 6, rest_s: float = 2400.0) -> np.ndarray:
    """Return a current of rests with discharges at C/2 between them, which draw ``soc_span`` in total [A]."""
    discharge = np.full(round(soc_span / (rests - 1) * DISCHARGE_S / STEP_S), 0.5 * OXIDE.capacity_ah)
    rest = np.zeros(round(rest_s / STEP_S))
    return np.concatenate([rest, *(rests - 1) * [discharge, rest]])


def wrong_cell(seed: int = 1) -> CellModel:
    """Return a cell file with a random error of the OCV and ``WRONG_CAPACITY``."""
    return cell_file(Case("", seed=seed, file_capacity_ratio=WRONG_CAPACITY))


def capacity_from(rows: SampleBlock, model: CellModel, offset_std_a: float | None = None) -> Capacity:
    """Return the capacity measured from one capture."""
    return measure_capacity([Columns(rows, "drive")], model, offset_std_a=offset_std_a)


def test_the_error_of_the_capacity_matches_its_std() -> None:
    """Twelve cell files and sensors are drawn at random. At mid SOC the error of the OCV dominates."""
    errors_over_std = []
    for seed in range(12):
        offset_a = SENSOR_A * np.random.default_rng(seed).standard_normal()
        result = capacity_from(
            simulate_capture(load_and_rests_a(0.8), offset_a=offset_a), wrong_cell(seed), offset_std_a=SENSOR_A
        )
        assert result.std_ah < 0.03 * OXIDE.capacity_ah
        errors_over_std.append((result.capacity_ah - OXIDE.capacity_ah) / result.std_ah)
    assert 0.4 < np.sqrt(np.mean(np.square(errors_over_std))) < 1.3
    assert np.abs(errors_over_std).max() < 2.6


def test_a_wider_soc_span_gives_a_smaller_std() -> None:
    narrow, wide = (
        capacity_from(simulate_capture(load_and_rests_a(soc_span)), wrong_cell()).std_ah for soc_span in (0.3, 0.8)
    )
    assert wide < 0.6 * narrow


def test_a_return_to_the_same_socs_determines_the_offset_of_the_current_sensor() -> None:
    """At one SOC the error of the OCV is the same each time. A difference is therefore due to the offset."""
    down = load_and_rests_a(0.6)
    result = capacity_from(simulate_capture(np.concatenate([down, -down, down]), offset_a=0.02), wrong_cell())
    assert result.offset_std_a < 0.003
    assert result.offset_a == pytest.approx(0.02, abs=2.5 * result.offset_std_a)
    assert abs(result.capacity_ah - OXIDE.capacity_ah) < 2.5 * result.std_ah


def test_two_captures_give_a_smaller_std_than_one() -> None:
    first, second = (simulate_capture(load_and_rests_a(0.5), soc=soc) for soc in (0.95, 0.7))
    result_of_first = capacity_from(first, wrong_cell())
    both = measure_capacity([Columns(first, "first"), Columns(second, "second")], wrong_cell())
    assert both.std_ah < result_of_first.std_ah
    assert {a.capture for a in both.anchors} == {"first", "second"}
    assert abs(both.capacity_ah - OXIDE.capacity_ah) < 2.5 * both.std_ah


def test_a_gap_splits_a_capture_into_two_parts() -> None:
    """The unmeasured charge in the gap does not change the capacity."""
    rows = simulate_capture(load_and_rests_a(0.8))
    gap_start = int(np.flatnonzero(np.abs(rows["current_a"]) > 0.0)[rows.size // 5])  # during a load
    with_gap = np.concatenate([rows[:gap_start], rows[gap_start + 40 :]])
    result = capacity_from(with_gap, wrong_cell())
    assert len({a.part for a in result.anchors}) == 2
    assert abs(result.capacity_ah - OXIDE.capacity_ah) < 2.5 * result.std_ah


def test_a_rest_on_a_flat_curve_is_no_anchor() -> None:
    with pytest.raises(
        UserError,
        match=r"(?s)no capacity.*determines SOC to \+-0\.\d\d only, because the curve has a slope of 0\.\d{3} V",
    ):
        capacity_from(
            simulate_capture(load_and_rests_a(0.3) * PHOSPHATE.capacity_ah / OXIDE.capacity_ah, PHOSPHATE, soc=0.6),
            load_cell("lfp", 2.4),
        )


@pytest.mark.parametrize(
    ("current_a", "reason"),
    [
        (np.full(2000, 0.5), "no two rests give an SOC"),
        (load_and_rests_a(0.1), r"at most 0\.\d\d of SOC apart, at least 0\.15"),
        (load_and_rests_a(0.5, rest_s=20.0), "shorter than 30 s"),
    ],
)
def test_captures_without_anchors_are_rejected_with_the_reason(current_a: np.ndarray, reason: str) -> None:
    with pytest.raises(UserError, match=reason):
        capacity_from(simulate_capture(current_a), wrong_cell())


def test_a_capture_with_one_sample_is_one_part_without_a_numpy_warning() -> None:
    assert continuous_parts(simulate_capture(np.zeros(1)), OXIDE.capacity_ah) == [(0, 1)]
