"""Capacity from anchors, on cells that differ from the model, with cell files that are as wrong as their stated
error."""

import numpy as np
import pytest

from bms_estimator.calibration.capacity import Capacity, measure_capacity
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import SAMPLE, SampleBlock
from tests.estimator.anywhere.cases import OXIDE, PHOSPHATE, Case, Truth, cell_file
from tests.estimator.anywhere.truth import simulate

WRONG_CAPACITY = 1.2
"""Capacity of the cell file relative to the true one, which must not influence the result."""
SENSOR_A = 0.004
"""Std of the offset of a good current sensor [A]."""


def samples(current_a: np.ndarray, truth: Truth = OXIDE, soc: float = 0.95, offset_a: float = 0.0) -> SampleBlock:
    """Return samples at intervals of 10 s."""
    rows = np.zeros(current_a.size, dtype=SAMPLE)
    rows["time_s"], rows["temperature_c"] = 10.0 * np.arange(current_a.size), 25.0
    curves = truth.ocv_v, truth.per_kelvin_v, truth.hysteresis_v, truth.ohm
    volt, _ = simulate(10.0, current_a, rows["temperature_c"], soc, 1.0, truth.capacity_ah, *curves)
    rows["voltage_v"], rows["current_a"] = np.round(volt, 3), current_a + offset_a
    return rows


def loads(swing: float, rests: int = 6, rest_s: float = 2400.0) -> np.ndarray:
    """Return a current of rests with discharges of C/2 between them, over ``swing`` of SOC in total [A]."""
    one = np.full(round(swing / (rests - 1) * 720.0), 0.5 * OXIDE.capacity_ah)
    rest = np.zeros(round(rest_s / 10.0))
    return np.concatenate([rest, *(rests - 1) * [one, rest]])


def cell(seed: int = 1) -> CellModel:
    return cell_file(Case("", seed=seed, capacity=WRONG_CAPACITY))


def measured(rows: SampleBlock, model: CellModel, offset_std_a: float | None = None) -> Capacity:
    return measure_capacity([Columns(rows, "drive")], model, offset_std_a=offset_std_a)


def test_the_error_of_the_capacity_matches_its_std() -> None:
    """Twelve cell files and sensors. At mid SOC the error of the curve dominates."""
    errors = []
    for seed in range(12):
        offset_a = SENSOR_A * np.random.default_rng(seed).standard_normal()
        found = measured(samples(loads(0.8), offset_a=offset_a), cell(seed), offset_std_a=SENSOR_A)
        assert found.std_ah < 0.03 * OXIDE.capacity_ah
        errors.append((found.capacity_ah - OXIDE.capacity_ah) / found.std_ah)
    assert 0.4 < np.sqrt(np.mean(np.square(errors))) < 1.3
    assert np.abs(errors).max() < 2.6


def test_a_wider_soc_span_gives_a_smaller_std() -> None:
    narrow, wide = (measured(samples(loads(swing)), cell()).std_ah for swing in (0.3, 0.8))
    assert wide < 0.6 * narrow


def test_repeated_socs_determine_the_offset() -> None:
    """The errors of the curve are equal on the way down and up, so that a difference is due to the sensor's offset."""
    down = loads(0.6)
    found = measured(samples(np.concatenate([down, -down, down]), offset_a=0.02), cell())
    assert found.offset_std_a < 0.003
    assert found.offset_a == pytest.approx(0.02, abs=2.5 * found.offset_std_a)
    assert abs(found.capacity_ah - OXIDE.capacity_ah) < 2.5 * found.std_ah


def test_two_captures_give_a_smaller_std_than_one() -> None:
    one, other = (samples(loads(0.5), soc=soc) for soc in (0.95, 0.7))
    alone = measured(one, cell())
    both = measure_capacity([Columns(one, "one"), Columns(other, "other")], cell())
    assert both.std_ah < alone.std_ah
    assert {a.capture for a in both.anchors} == {"one", "other"}
    assert abs(both.capacity_ah - OXIDE.capacity_ah) < 2.5 * both.std_ah


def test_a_gap_splits_a_capture() -> None:
    """An unknown charge of 0.4 Ah in the gap does not change the capacity."""
    rows = samples(loads(0.8))
    middle = int(np.flatnonzero(np.abs(rows["current_a"]) > 0.0)[rows.size // 5])
    cut = np.concatenate([rows[:middle], rows[middle + 40 :]])
    found = measured(cut, cell())
    assert len({a.part for a in found.anchors}) == 2
    assert abs(found.capacity_ah - OXIDE.capacity_ah) < 2.5 * found.std_ah


def test_a_rest_on_a_flat_curve_is_no_anchor() -> None:
    with pytest.raises(
        UserError,
        match=r"(?s)no capacity.*determines SOC to \+-0\.\d\d only, because the curve has a slope of 0\.\d{3} V",
    ):
        measured(samples(loads(0.3) * PHOSPHATE.capacity_ah / 3.0, PHOSPHATE, soc=0.6), load_cell("lfp", 2.4))


@pytest.mark.parametrize(
    ("current_a", "why"),
    [
        (np.full(2000, 0.5), "no two rests give an SOC"),
        (loads(0.1), r"at most 0\.\d\d of SOC apart, at least 0\.15"),
        (loads(0.5, rest_s=20.0), "shorter than 30 s"),
    ],
)
def test_captures_without_anchors_are_rejected_with_the_reason(current_a: np.ndarray, why: str) -> None:
    with pytest.raises(UserError, match=why):
        measured(samples(current_a), cell())
